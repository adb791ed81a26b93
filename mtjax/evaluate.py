"""``python -m mtjax.evaluate --run=DIR``: score, plot and film a trained run on every task of every split."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from mtjax import commands
from mtjax.names import InputError, load, nearest_error

_MOST_EPISODES, _LARGEST_SEED = 100_000, 2_000_000_000


@dataclasses.dataclass(frozen=True)
class Request:
    """Evaluate a trained run: ``python -m mtjax.evaluate --run=DIR``."""

    run: str = ""
    """The run's folder."""
    point: int = 0
    """Number of the setting in sweep.csv, if the run holds several settings of a sweep."""
    episodes: int = 10
    """Episodes of each task and seed."""
    seed: int = 0
    """Seed of the starting states."""
    video: bool = False
    """Film the first ten seconds of an episode of each task (mp4 if ffmpeg is installed, else gif)."""
    diagnostics: bool = False
    """Measure conflicts between the tasks' gradients, and unused units of the networks, from the run's replay."""


def main(argv: Sequence[str]) -> None:
    """Read the command line first, then import the evaluation code and score the run."""
    request = _parse(argv)
    load("mtjax.report.scoring:report")(*dataclasses.astuple(request))


def _parse(argv: Sequence[str]) -> Request:
    argv = commands.import_files(argv)
    known = [f"--{f.name}" for f in dataclasses.fields(Request)] + ["--no-video", "--no-diagnostics", "--help", "-h"]
    for word in argv:
        if word.startswith("-") and word.split("=")[0] not in known:
            raise nearest_error("flag", word.split("=")[0], known)
    request = commands.parse_with_tyro(Request, argv, Request(), "python -m mtjax.evaluate")
    if not request.run:
        raise InputError("say which run to evaluate: --run=DIR")
    if not 1 <= request.episodes <= _MOST_EPISODES:
        raise InputError(f"episodes must be at least 1 and at most {_MOST_EPISODES}, not {request.episodes}")
    if not 0 <= request.seed <= _LARGEST_SEED:
        raise InputError(f"seed must be at least 0 and at most {_LARGEST_SEED}, not {request.seed}")
    commands.require_run(Path(request.run))
    return request


def run() -> None:
    """Run the command line."""
    commands.main(main)


if __name__ == "__main__":
    run()
