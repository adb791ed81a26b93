"""Figures over several runs. Each function draws on Matplotlib axes and returns them.

They take folders of runs, patterns such as "runs/*", or results of ``mtjax.train`` by name. Bands and bars are 95 %
intervals over whole seeds; fewer than three seeds have none. ``save`` writes PNG, PDF or SVG, by the file's ending.
"""

import math
import textwrap
from collections.abc import Sized
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtjax.names import InputError, nearest_error, public
from mtjax.report import figures, read_runs
from mtjax.report.beliefs import posterior
from mtjax.report.read_runs import Learned
from mtjax.report.stats import iqm as iqm_of
from mtjax.report.stats import probability_of_improvement, seed_interval
from mtjax.types import SPLITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ENDINGS = (".png", ".pdf", ".svg")
_THRESHOLDS = 101
_MOST_NAMED = 3  # families in a title
_LETTERS, _KEY = 13, 6  # in an inch of a legend, and as many as the line before a name takes


@public
def learning_curves(runs: Any = "runs/*", split: str = "train", ax: "Axes | None" = None) -> "Axes":
    """Draw the mean return of a split over environment steps, a line for each agent, of runs of one family."""
    found = _of_split(runs, split)
    _require_one_family(found, "curves", "; draw the figure families (--figure=families)")
    axes = ax if ax is not None else figures.new_axes()
    for index, one in enumerate(found):
        figures.draw_curve(axes, one.steps, one.returns[split], _label(one), index)
    figures.label_steps(axes)
    axes.set_ylabel(found[0].score)
    axes.set_title(found[0].env)
    return _finish(axes)


@public
def families(runs: Any = "runs/*", split: str = "train") -> "list[Axes]":
    """Draw learning curves of several families in a grid, and return the axes of each."""
    from matplotlib.figure import Figure

    found = _of_split(runs, split)
    names = list(dict.fromkeys(one.env for one in found))
    columns = min(math.ceil(math.sqrt(len(names))), 4)
    lines = math.ceil(len(names) / columns)
    figure = Figure(figsize=(4.5 * columns, 3.2 * lines), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False).ravel()
    agents = list(dict.fromkeys(one.agent for one in found))
    for axes, name in zip(grid, names, strict=False):
        figures.style(axes)
        for one in (one for one in found if one.env == name):
            figures.draw_curve(axes, one.steps, one.returns[split], one.agent, agents.index(one.agent))
        figures.label_steps(axes)
        axes.set_ylabel(found[0].score)
        axes.set_title(name)
        figures.show_from_zero(axes)
    for axes in grid[len(names) :]:
        axes.set_visible(False)
    handles = {h.get_label(): h for axes in grid for h in axes.get_lines()}
    room = int(_LETTERS * figure.get_figwidth())
    wrapped = [textwrap.fill(name, room - _KEY) for name in handles]
    fit = room // (_KEY + max(len(line) for name in wrapped for line in name.splitlines()))
    given = {"ncols": max(1, min(len(handles), 5, fit)), "frameon": False, "loc": "outside lower center"}
    figure.legend(list(handles.values()), wrapped, **given)
    return list(grid[: len(names)])


@public
def return_by_parameter(runs: Any = "runs/*", ax: "Axes | None" = None) -> "Axes":
    """Draw each task's last mean return over its parameter, all splits in one line for each agent.

    Training tasks are filled, held-out tasks are open. The range of training is shaded. Where several parameters vary,
    tasks are numbered, and no line joins them.
    """
    found = _of_split(runs, "train")
    _require_one_family(found, "parameter")
    axes = ax if ax is not None else figures.new_axes()
    for index, one in enumerate(found):
        splits = [split for split in SPLITS if one.returns[split].size]
        values = np.concatenate([one.values[split] for split in splits])
        scores = np.concatenate([one.final(split) for split in splits], axis=1)
        order, colour = np.argsort(values), figures.colour(index)
        if one.axis == ("task", "number"):
            axes.plot([], [], "o", color=colour, label=_label(one))
        else:
            figures.draw_line(axes, values[order], scores[:, order], _label(one), index, marker="")
        for split in splits:
            filled = {"markerfacecolor": colour if split == "train" else "white", "color": colour, "markersize": 5}
            axes.plot(one.values[split], one.final(split).mean(axis=0), "o", **filled)
    trained = found[0].values["train"]
    axes.axvspan(float(np.min(trained)), float(np.max(trained)), color="0.95", zorder=0)
    axes.set_xlabel(figures.axis_label(*found[0].axis))
    axes.set_ylabel(found[0].score)
    axes.set_title(found[0].env)
    return _finish(axes)


@public
def iqm(runs: Any = "runs/*", split: str = "train", ax: "Axes | None" = None) -> "Axes":
    """Draw each agent's interquartile mean of the last returns, over seeds and the tasks of all families."""
    scores, score, title = _scores(runs, split)
    axes = ax if ax is not None else _row_axes(scores)
    for index, (agent, x) in enumerate(scores.items()):
        mean, low, high = seed_interval(x, iqm_of)
        bars = figures.bars_of(*np.array([[mean], [low], [high]]))
        axes.errorbar([mean], [index], xerr=bars, fmt="o", color=figures.colour(index), capsize=4, label=agent)
    _name_rows(axes, list(scores))
    axes.set_xlabel(f"interquartile mean of the {score}, {split}")
    axes.set_title(title)
    return axes


@public
def performance_profile(runs: Any = "runs/*", split: str = "train", ax: "Axes | None" = None) -> "Axes":
    """Draw the share of seeds and tasks whose last return is above each value, a line for each agent."""
    scores, score, title = _scores(runs, split)
    axes = ax if ax is not None else figures.new_axes()
    best = max(float(x.max()) for x in scores.values())
    thresholds = np.linspace(0, best or 1.0, _THRESHOLDS)
    for index, (agent, x) in enumerate(scores.items()):
        above = np.mean(x[:, :, None] > thresholds, axis=1)  # (S, thresholds)
        figures.draw_line(axes, thresholds, above, agent, index, marker="")
    axes.set_xlabel(f"{score}, {split}")
    axes.set_ylabel("share of seeds and tasks above")
    axes.set_title(title)
    return _finish(axes)


@public
def improvement(
    runs: Any = "runs/*", baseline: str | None = None, split: str = "train", ax: "Axes | None" = None
) -> "Axes":
    """Draw the probability that a seed of each agent scores higher than one of the baseline, on a random task.

    Args:
        baseline: the agent to compare with; by default the first.

    Raises:
        InputError: there is only one agent, or no baseline of that name.
    """
    scores, _, title = _scores(runs, split)
    first = next(iter(scores)) if baseline is None else baseline
    if first not in scores:
        raise nearest_error("agent", first, scores)
    others = [agent for agent in scores if agent != first]
    if not others:
        raise InputError(f"improvement compares agents, and there is only {first}")
    axes = ax if ax is not None else _row_axes(others)
    for index, agent in enumerate(others):
        mean, low, high = probability_of_improvement(scores[agent], scores[first])
        bars, colour = figures.bars_of(*np.array([[mean], [low], [high]])), figures.colour(list(scores).index(agent))
        axes.errorbar([mean], [index], xerr=bars, fmt="o", color=colour, capsize=4, label=agent)
    axes.axvline(0.5, color="0.6", linewidth=1)
    axes.set_xlim(0, 1)
    _name_rows(axes, others)
    axes.set_xlabel(f"probability of improvement over {first}, {split}")
    axes.set_title(title)
    return axes


FIGURES = {
    "curves": learning_curves,
    "families": families,
    "parameter": return_by_parameter,
    "iqm": iqm,
    "profile": performance_profile,
    "improvement": improvement,
    "posterior": posterior,
}


@public
def save(axes: "Axes | list[Axes]", path: str | Path) -> Path:
    """Write the figure of some axes as PNG, PDF or SVG, by the file's ending, and return the path.

    Raises:
        InputError: the ending is another, or the file exists already.
    """
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"a figure is written to a file that ends with {', '.join(ENDINGS)}, not to {str(path)!r}")
    if path.exists():
        raise InputError(f"{str(path)!r} exists already; give another name or remove it")
    one = axes[0] if isinstance(axes, list) else axes
    path.parent.mkdir(parents=True, exist_ok=True)
    one.figure.savefig(path, dpi=figures.DOTS_PER_INCH)
    return path


def _of_split(runs: Any, split: str) -> list[Learned]:
    """Return what was learned in runs that have tasks of a split."""
    if split not in SPLITS:
        raise nearest_error("split", split, SPLITS)
    found = [one for one in read_runs.learned(runs) if one.returns[split].size and len(one.steps)]
    if not found:
        raise InputError(f"no run was given that has {split} tasks")
    return found


def _scores(runs: Any, split: str) -> tuple[dict[str, np.ndarray], str, str]:
    """Return each agent's last returns (S, T) on the tasks of all families, what these are, and a title of families.

    Raises:
        InputError: an agent lacks a family that another has.
    """
    found = _of_split(runs, split)
    names = list(dict.fromkeys(one.env for one in found))
    scores = {}
    for agent in dict.fromkeys(one.agent for one in found):
        own = {one.env: one.final(split) for one in found if one.agent == agent}
        missing = [name for name in names if name not in own]
        if missing:
            raise InputError(f"{agent} has no run on {missing[0]}, so that agents cannot be compared over all families")
        seeds = min(map(len, own.values()))
        scores[agent] = np.concatenate([own[name][:seeds] for name in names], axis=1)
    return scores, found[0].score, "\n".join(names) if len(names) <= _MOST_NAMED else f"{len(names)} families"


def _row_axes(rows: Sized) -> "Axes":
    """Return axes that have room for rows with a point each, and no more."""
    return figures.new_axes(height=1.4 + 0.4 * len(rows))


def _require_one_family(found: list[Learned], figure: str, instead: str = "") -> None:
    names = list(dict.fromkeys(one.env for one in found))
    if len(names) > 1:
        raise InputError(f"the figure {figure} is of one family, and these runs are of {', '.join(names)}{instead}")


def _label(one: Learned) -> str:
    count = len(next(iter(one.returns.values())))
    return f"{one.agent} ({count} seed{'s' * (count != 1)})"


def _name_rows(axes: "Axes", names: list[str]) -> None:
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_ylabel("")


def _finish(axes: "Axes") -> "Axes":
    figures.show_from_zero(axes)
    axes.legend(frameon=False)
    return axes
