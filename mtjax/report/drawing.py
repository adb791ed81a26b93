"""Figures of runs: ``mtjax.plot`` in Python, and the command, which writes them into files."""

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mtjax.names import InputError, nearest_error, public
from mtjax.report import plots, read_runs

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_AUTO = "auto"


@public
def plot(
    runs: Any = "runs/*",
    figure: str = "auto",
    *,
    split: str = "train",
    metric: str = "return",
    baseline: str = "",
    out: str | Path = "",
) -> "Axes | list[Axes]":
    """Draw a figure of runs, as ``python -m mtjax.plot`` does, and return Matplotlib's axes.

    Args:
        runs: folders, or patterns such as "runs/*"; or results of ``mtjax.train``, also by name in a mapping.
        figure: auto (curves, or families if the runs are of several), curves, families (which returns several axes),
            parameter, iqm, profile, improvement, or posterior of one run (several axes too), which may be a policy.
        split: train, interpolation or extrapolation: whose returns are drawn.
        metric: "return", or what else evaluations have, such as "success".
        baseline: the agent that improvement compares with; by default the first run's.
        out: a file to write too, which ends with .png, .pdf or .svg.

    Raises:
        InputError: there is no such figure or run, or the runs do not allow it.
    """
    if figure not in (_AUTO, *plots.FIGURES):
        raise nearest_error("figure", figure, (_AUTO, *plots.FIGURES))
    found = cache(lambda: _learned(runs, metric))
    axes = _draw(_named(figure, found), runs, found, split, baseline)
    if out:
        plots.save(axes, out)
    return axes


def draw(runs: Sequence[str], figure: str, split: str, metric: str, baseline: str, out: str) -> None:
    """Draw a figure of runs, or all that these runs allow, and print the files.

    Args:
        figure: a name of ``plots.FIGURES``, "auto" or "all".
        metric: "return", or another score of evaluations.
        out: the file to write; of all figures, the ending counts and the names follow from the stem.
    """
    found = cache(lambda: _learned(runs, metric))
    names = list(plots.FIGURES) if figure == "all" else [_named(figure, found)]
    path = Path(out or ("runs.png" if figure == "all" else f"{names[0]}.png"))
    drawn = 0
    for name in names:
        file = path if figure != "all" else path.with_name(f"{path.stem}-{name}{path.suffix}")
        try:
            axes = _draw(name, runs, found, split, baseline)
        except InputError as error:
            if figure != "all":
                raise
            print(f"{name}: left out, as {error}")
            continue
        print(f"written to {plots.save(axes, file)}")
        drawn += 1
    if not drawn:
        raise InputError("there was nothing to draw")


def _learned(runs: Any, metric: str) -> list[read_runs.Learned]:
    return read_runs.learned(runs) if metric == "return" else read_runs.of_metric(runs, metric)


def _named(figure: str, learned: Callable[[], list[read_runs.Learned]]) -> str:
    """Return the figure's name: for "auto" that of learning curves, of one family or of several."""
    if figure != _AUTO:
        return figure
    return "families" if len({one.env for one in learned()}) > 1 else "curves"


def _draw(
    name: str, runs: Any, learned: Callable[[], list[read_runs.Learned]], split: str, baseline: str
) -> "Axes | list[Axes]":
    given = {} if name == "parameter" else {"split": split}
    given |= {"baseline": baseline} if name == "improvement" and baseline else {}
    return plots.FIGURES[name](runs if name == "posterior" else learned(), **given)
