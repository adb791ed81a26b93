"""Figures of returns and of diagnostics, written to PNG files without a display.

Axes: ``S`` seeds, ``V`` evaluations, ``T`` tasks, ``E`` episodes. Bands and bars are 95 % percentile bootstrap
intervals over seeds. Fewer than three seeds have none. Whole seeds are resampled, because one agent learns all tasks.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mtjax.report.stats import seed_interval
from mtjax.types import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

# Okabe and Ito's palette, which colour-blind readers can tell apart, without its yellow.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_MOST_INSIDE = 4  # names within the axes; more stand beside them
_FAR_MORE = 4  # times the steps of another agent, from which on the axis of steps is logarithmic
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")  # one more than colours, so that later pairs differ too
DOTS_PER_INCH = 120


def learning_curve(
    path: str | Path, steps: np.ndarray, returns: Mapping[str, np.ndarray], title: str, warmup: int = 0
) -> None:
    """Draw return over environment steps, one line per split: the mean over seeds, tasks and episodes.

    Args:
        path: the PNG file to write.
        steps: (V,) environment steps at the evaluations.
        returns: split -> (S, V, T, E); an empty array is left out.
        title: title of the figure.
        warmup: steps under random actions before learning begins, which are shaded.
    """
    figure, axes = _new_figure()
    for index, (split, values) in enumerate(returns.items()):
        if np.size(values):
            draw_curve(axes, steps, values, f"{split} ({_count(np.shape(values)[2], 'task')})", index)
    if warmup:
        axes.axvspan(0, warmup, color="0.93", zorder=0, label="random actions")
    label_steps(axes)
    axes.set_title(title)
    _save(figure, axes, path)


def return_by_parameter(
    path: str | Path,
    parameter: str,
    unit: str,
    values: Mapping[str, np.ndarray],
    returns: Mapping[str, np.ndarray],
) -> None:
    """Draw each task's mean return over its parameter, one marker shape per split.

    Args:
        path: the PNG file to write.
        parameter: name of the parameter.
        unit: its unit.
        values: split -> (T,) the tasks' values of the parameter.
        returns: split -> (S, T, E); an empty array is left out.
    """
    figure, axes = _new_figure()
    for index, (split, scores) in enumerate(returns.items()):
        if np.size(scores):
            _draw_points(axes, values[split], scores, split, index)
    axes.set_xlabel(axis_label(parameter, unit))
    _save(figure, axes, path)


def return_by_task(path: str | Path, labels: Mapping[str, Sequence[str]], returns: Mapping[str, np.ndarray]) -> None:
    """Draw each task's mean return on a line of its own, one marker shape per split.

    Args:
        path: the PNG file to write.
        labels: split -> (T,) the tasks' names.
        returns: split -> (S, T, E); an empty array is left out.
    """
    names = list(dict.fromkeys(sorted(name for split in labels.values() for name in split)))
    figure, axes = _new_figure()
    figure.set_size_inches(7, 1.5 + 0.25 * len(names))
    for index, (split, scores) in enumerate(returns.items()):
        if np.size(scores):
            mean, low, high = _intervals(np.mean(scores, axis=2))
            bars, places = bars_of(mean, low, high), [names.index(name) for name in labels[split]]
            colour, marker = _COLOURS[index % len(_COLOURS)], _MARKERS[index % len(_MARKERS)]
            axes.errorbar(mean, places, xerr=bars, color=colour, fmt=marker, markersize=6, capsize=3, label=split)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("return")
    axes.set_ylabel("")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=DOTS_PER_INCH)


def compare(
    path: str | Path, curves: Mapping[str, tuple[np.ndarray, np.ndarray]], label: str = "return on training tasks"
) -> None:
    """Draw several agents' returns over environment steps, on a logarithmic axis if some took far more than others.

    Args:
        path: the PNG file to write.
        curves: agent -> (steps (V,), returns on the training tasks (S, V, T, E)).
        label: label of the axis of returns.
    """
    figure, axes = _new_figure()
    beside = len(curves) > _MOST_INSIDE
    if beside:
        figure.set_size_inches(9, max(4.5, 0.28 * len(curves)))
    for index, (agent, (steps, returns)) in enumerate(curves.items()):
        if np.size(returns):
            draw_curve(axes, steps, returns, f"{agent} ({_count(len(returns), 'seed')})", index)
    ends = [max(steps) for steps, returns in curves.values() if np.size(returns)]
    label_steps(axes, log=bool(ends) and max(ends) > _FAR_MORE * min(ends))
    axes.set_ylabel(label)
    _save(figure, axes, path, beside=beside)


def interference(
    path: str | Path,
    parameter: str,
    unit: str,
    values: np.ndarray,
    cosines: Mapping[str, np.ndarray | None],
    bars: Mapping[str, np.ndarray],
) -> None:
    """Draw the cosines of the training tasks' gradients, one heat map per network, and bars for each task below.

    Args:
        path: the PNG file to write.
        parameter: name of the parameter in which tasks differ.
        unit: its unit.
        values: (T,) the tasks' values of it.
        cosines: network -> (T, T), or None if tasks share none of its parameters.
        bars: title -> (T,).
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 7.5), dpi=DOTS_PER_INCH, layout="constrained")
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.75, 1))[:, 0]
    labels, name = [f"{value:.3g}" for value in values], axis_label(parameter, unit)
    maps, given = above.subplots(1, len(cosines), squeeze=False)[0], [x for x in cosines.values() if x is not None]
    limit = max((_limit(x) for x in given), default=1.0)
    images = [_draw_cosines(axes, who, x, limit) for axes, (who, x) in zip(maps, cosines.items(), strict=True)]
    for axes in (axes for axes, image in zip(maps, images, strict=True) if image is not None):
        _label_tasks(axes.xaxis, labels, name)
        _label_tasks(axes.yaxis, labels, name)
    if drawn := [image for image in images if image is not None]:
        above.colorbar(drawn[0], ax=list(maps), label="cosine of two tasks' gradients", shrink=0.8)
    charts = below.subplots(1, len(bars), squeeze=False)[0]
    for index, (axes, (title, heights)) in enumerate(zip(charts, bars.items(), strict=True)):
        axes.bar(range(len(heights)), heights, color=_COLOURS[index], width=0.7)
        axes.set_title(title)
        axes.grid(axis="y", color="0.9")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
        _label_tasks(axes.xaxis, labels, name)
    figure.savefig(path, dpi=DOTS_PER_INCH)


def _draw_cosines(axes: "Axes", network: str, cosine: np.ndarray | None, limit: float) -> "AxesImage | None":
    axes.set_title(network)
    axes.set_facecolor("0.92")
    axes.set_box_aspect(1)
    axes.spines[:].set_visible(False)
    if cosine is None:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.text(0.5, 0.5, "tasks share no parameters,\nso none can conflict", ha="center", va="center", color="0.3")
        return None
    pairs = np.ma.masked_array(cosine, np.eye(len(cosine), dtype=bool))  # each task's with itself is 1
    image = axes.imshow(pairs, cmap="RdBu", vmin=-limit, vmax=limit)
    if len(cosine) <= 10:
        for (row, column), value in np.ndenumerate(cosine):
            if row != column:
                colour = "white" if abs(value) > 0.65 * limit else "black"
                axes.text(column, row, f"{value:.2f}", ha="center", va="center", fontsize=7, color=colour)
    return image


def _limit(cosine: np.ndarray) -> float:
    """Return a round number that no cosine between different tasks exceeds."""
    largest = np.max(np.abs(cosine[~np.eye(len(cosine), dtype=bool)]), initial=0.0)
    return next((limit for limit in (0.1, 0.2, 0.5) if largest <= limit), 1.0)


def _label_tasks(axis: "Axis", labels: list[str], name: str) -> None:
    """Put the tasks' values on an axis, at most ten of them."""
    every = -(-len(labels) // 10)
    axis.set_ticks(range(0, len(labels), every), labels[::every])
    axis.set_tick_params(length=0, labelsize=8, labelrotation=45 if axis.axis_name == "x" and len(labels) > 5 else 0)
    axis.set_label_text(name)


def new_axes(height: float = 4) -> "Axes":
    """Return the axes of a new figure, of a height in inches, that no window shows."""
    from matplotlib.figure import Figure

    axes = Figure(figsize=(6, height), dpi=DOTS_PER_INCH, layout="constrained").add_subplot()
    style(axes)
    return axes


def style(axes: "Axes") -> None:
    """Give axes of returns the look of all figures."""
    axes.set_ylabel("return")
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _new_figure() -> tuple["Figure", "Axes"]:
    axes = new_axes()
    return axes.figure, axes  # type: ignore


def colour(index: int) -> str:
    """Return the colour of a line by its number."""
    return _COLOURS[index % len(_COLOURS)]


def draw_curve(axes: "Axes", steps: np.ndarray, returns: np.ndarray, label: str, index: int) -> None:
    """Draw the mean of returns (S, V, T, E) over steps (V,), with its interval over seeds."""
    draw_line(axes, steps, np.mean(returns, axis=(2, 3)), label, index)


def draw_line(
    axes: "Axes", x: np.ndarray, scores: np.ndarray, label: str, index: int, marker: str | None = None
) -> str:
    """Draw the mean of scores (S, V) over x (V,), with a band where there is an interval. Return the colour."""
    mean, low, high = _intervals(scores)
    marker = _MARKERS[index % len(_MARKERS)] if marker is None else marker
    every = max(1, len(mean) // 10)
    axes.plot(x, mean, color=colour(index), marker=marker, markersize=4, markevery=every, label=label)
    if np.isfinite(low).any():
        axes.fill_between(x, low, high, color=colour(index), alpha=0.15, linewidth=0)
    return colour(index)


def _draw_points(axes: "Axes", values: np.ndarray, returns: np.ndarray, label: str, index: int) -> None:
    mean, low, high = _intervals(np.mean(returns, axis=2))
    looks = {"color": colour(index), "fmt": _MARKERS[index % len(_MARKERS)], "markersize": 6, "capsize": 3}
    axes.errorbar(values, mean, bars_of(mean, low, high), label=label, **looks)


def bars_of(mean: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray | None:
    """Return the lengths (2, columns) of error bars, or None if there are no intervals, so that no legend shows one."""
    if not np.isfinite(low).any():
        return None
    # Rounding can put the bounds of equal seeds on the wrong side of their mean, which Matplotlib refuses.
    return np.maximum([mean - low, high - mean], 0)


def axis_label(parameter: str, unit: str) -> str:
    """Return a parameter's name with its unit, if it has one."""
    return parameter if unit in ("", "1") else f"{parameter} [{unit}]"


def _intervals(scores: np.ndarray) -> np.ndarray:
    """Return mean, low and high (3, columns) over the seeds of scores (S, columns)."""
    return np.array([seed_interval(column) for column in scores.T]).T


def label_steps(axes: "Axes", log: bool = False) -> None:
    """Label the axis of environment steps."""
    from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator

    axes.set_xlabel("environment steps")
    if log:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=[1, 2, 5]))
        axes.xaxis.minorticks_off()
    else:
        axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True, min_n_ticks=1))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def show_from_zero(axes: "Axes") -> None:
    """Let the axis of returns begin at zero, or below negative returns, and leave room above."""
    low, high = axes.dataLim.intervaly
    axes.set_ylim(min(0.0, 1.05 * low), 1.05 * high if high > 0 else None)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _save(figure: "Figure", axes: "Axes", path: str | Path, beside: bool = False) -> None:
    if not axes.get_legend_handles_labels()[1]:
        raise InputError(f"there is nothing to draw in {path}: every array of returns is empty")
    show_from_zero(axes)
    axes.legend(frameon=False, **({"loc": "center left", "bbox_to_anchor": (1, 0.5)} if beside else {}))
    figure.savefig(path, dpi=DOTS_PER_INCH)
