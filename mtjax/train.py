"""``python -m mtjax.train``: train an agent on a family of tasks, and keep all there is to know of it in a folder."""

import sys
import types
from collections.abc import Sequence
from typing import TYPE_CHECKING

from mtjax import commands
from mtjax.names import load

if TYPE_CHECKING:
    from mtjax.training.run import Result


def main(argv: Sequence[str]) -> None:
    """Answer what names alone can answer; then import what trains, and run what the command line asks for."""
    own = any(word.startswith("--import=") for word in argv)  # whose settings are read with the rest
    argv = commands.import_files(argv)
    commands.check_names(argv)
    if not own:
        commands.check_flags(argv)
    if argv in (["--help"], ["-h"]):
        print(commands.overview())
        return
    if "--list" in argv:
        print(commands.catalogue())
        return
    load("mtjax.training.main:main")(argv, load("mtjax.cli:parse"))


class _CallableModule(types.ModuleType):
    """Lets ``mtjax.train(...)`` stay a function after ``import mtjax.train`` has put this module in its place."""

    def __call__(self, *args, **kwargs) -> "Result":
        return load("mtjax.training.run:train")(*args, **kwargs)


def run() -> None:
    """Entry point of the command line."""
    commands.main(main)


sys.modules[__name__].__class__ = _CallableModule

if __name__ == "__main__":
    run()
