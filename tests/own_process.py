"""The environment of processes that tests start."""

import os
from pathlib import Path

import mtjax


def environment(**more: str) -> dict[str, str]:
    """Return this process's, in which mtjax is this checkout and all else is imported from where it is here."""
    paths = [str(Path(mtjax.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths)), **more}
