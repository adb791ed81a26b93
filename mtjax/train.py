"""``python -m mtjax.train``: train an agent on a family of tasks, and write the results to a folder."""

from collections.abc import Sequence

from mtjax.command import flag_files, help, imports, process, refusals
from mtjax.command.class_sources import OF_EVERY_RUN
from mtjax.names import become, command, load

_WAYS = {
    "[--env=NAME] [--agent=NAME] [FLAGS]": "",
    "--env=NAME --agent=NAME --help": "all flags of these, with defaults",
    "--list": "all families and agents",
    "--import=FILE.py ...": "first run a file that registers your own",
    "--resume=RUN": "go on with a run",
}


@command
def main(argv: Sequence[str]) -> None:
    """Check names and flags first, then import the training code and run the command line."""
    flags = flag_files.expand(argv)
    with flag_files.naming(argv), refusals.settings_as_flags():
        _run(flags)


def _run(argv: Sequence[str]) -> None:
    words = imports.import_files(argv)
    refusals.check_names(words)
    if len(words) == len(argv):  # else the full parser checks the flags of the user's own classes
        refusals.check_flags(words)
    if words in (["--help"], ["-h"]):
        print(help.overview("python -m mtjax.train", _WAYS, OF_EVERY_RUN))
        return
    if "--list" in words:
        print(help.catalogue())
        return
    load("mtjax.training.allocator:share_arenas")()  # before there are threads
    if "--distributed" not in words:  # else all processes find their devices together
        load("mtjax.parallel.hosts:find_devices")()
    load("mtjax.command.train:main")(argv)


def run() -> None:
    """Run the command line."""
    process.main(main)


if __name__ == "__main__":
    run()
else:
    become(__name__, "mtjax.command.api:train")
