"""``python -m mtjax.plot RUN ...``: draw figures of trained runs into a PNG, PDF or SVG file."""

import dataclasses
from collections.abc import Sequence

from mtjax.command import help, imports, parsing, process, refusals
from mtjax.names import SPLITS, InputError, become, command, load, nearest_error

FIGURES = ("auto", "curves", "families", "parameter", "iqm", "profile", "improvement", "posterior", "all")
ENDINGS = (".png", ".pdf", ".svg")
_PROGRAM = "python -m mtjax.plot"
_WAYS = {
    "RUN ... [FLAGS]": "RUN is a run's folder, a sweep's, or a pattern",
    "runs/*": "curves; runs of equal settings and other seeds are one line",
    "runs/* --figure=all": "all figures; intervals are over seeds, if they are three or more",
    "runs/* --import=FILE.py": "first run a file that registers your own",
}


@dataclasses.dataclass(frozen=True)
class Request:
    """Draw figures of trained runs: ``python -m mtjax.plot RUN ...``."""

    figure: str = "auto"
    """auto (curves, or families if the runs are of several), curves (return over steps, of one family), families (the
    same in a grid), parameter (return over the varied parameter), iqm (interquartile means of agents), profile (share
    of seeds and tasks above a return), improvement (probability of improvement over a baseline), posterior (what an
    agent believes of its task over a trial, of one run), or all that the runs allow."""
    split: str = "train"
    """train, interpolation or extrapolation: whose returns are drawn."""
    metric: str = "return"
    """return, or what else evaluations have, such as success (at the end of episodes) or success_ever (at any step)."""
    baseline: str = ""
    """The agent that improvement compares with; by default the first run's."""
    out: str = ""
    """The file to write, which ends with .png, .pdf or .svg; by default the figure's name and .png."""


@command
def main(argv: Sequence[str]) -> None:
    """Read the command line first, then import the code that draws."""
    if {"--help", "-h"} & {*argv}:
        return print(help.overview(_PROGRAM, _WAYS, [("what is drawn", "plot.py", "Request")]))
    argv = imports.import_files(argv)
    refusals.check_flags_of(Request, argv)
    runs, flags = _apart(argv)
    request = parsing.parse_with_tyro(Request, flags, Request(), _PROGRAM)
    if not runs:
        raise InputError("say which runs to draw: python -m mtjax.plot runs/*")
    for name, value, allowed in (("figure", request.figure, FIGURES), ("split", request.split, SPLITS)):
        if value not in allowed:
            raise nearest_error(name, value, allowed)
    if request.out and not request.out.lower().endswith(ENDINGS):
        raise InputError(f"--out must end with {', '.join(ENDINGS)}, not {request.out!r}")
    load("mtjax.report.drawing:draw")(runs, *dataclasses.astuple(request))


def _apart(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the runs, and the flags with their values."""
    runs, flags, words = [], [], iter(argv)
    for word in words:
        if not word.startswith("-"):
            runs.append(word)
            continue
        flags.append(word)
        if "=" not in word:
            flags += [value for value in [next(words, None)] if value is not None]
    return runs, flags


def run() -> None:
    """Run the command line."""
    process.main(main)


if __name__ == "__main__":
    run()
else:
    become(__name__, "mtjax.report.drawing:plot")
