"""Figures of returns, written to PNG files without a display.

Axes: ``S`` seeds, ``V`` evaluations, ``T`` tasks, ``E`` episodes. Bands and bars are 95 % percentile bootstrap
intervals over seeds; there are none for a single seed. Whole seeds are resampled, because one agent learns all tasks.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mtjax.stats import mean_interval
from mtjax.types import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which colour-blind readers can tell apart, without its yellow.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")  # one more than colours, so that later pairs differ too
_DOTS_PER_INCH = 120


def learning_curve(path: str | Path, steps: np.ndarray, returns: Mapping[str, np.ndarray], title: str) -> None:
    """Draw return against environment steps, one line a split: the mean over seeds, tasks and episodes.

    Args:
        path: the PNG file to write.
        steps: (V,) environment steps at the evaluations.
        returns: split -> (S, V, T, E); an empty array is left out.
        title: title of the figure.
    """
    figure, axes = _new_figure()
    for index, (split, values) in enumerate(returns.items()):
        if np.size(values):
            _draw_curve(axes, steps, values, f"{split} ({_count(np.shape(values)[2], 'task')})", index)
    _label_steps(axes)
    axes.set_title(title)
    _save(figure, axes, path)


def return_by_parameter(
    path: str | Path,
    parameter: str,
    unit: str,
    values: Mapping[str, np.ndarray],
    returns: Mapping[str, np.ndarray],
) -> None:
    """Draw each task's mean return against its parameter, one marker shape a split.

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
    axes.set_xlabel(f"{parameter} [{unit}]")
    _save(figure, axes, path)


def compare(path: str | Path, curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Draw several agents' returns against environment steps.

    Args:
        path: the PNG file to write.
        curves: agent -> (steps (V,), returns on the training tasks (S, V, T, E)).
    """
    figure, axes = _new_figure()
    for index, (agent, (steps, returns)) in enumerate(curves.items()):
        if np.size(returns):
            _draw_curve(axes, steps, returns, f"{agent} ({_count(len(returns), 'seed')})", index)
    _label_steps(axes)
    axes.set_ylabel("return on training tasks")
    _save(figure, axes, path)


def _new_figure() -> tuple["Figure", "Axes"]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), dpi=_DOTS_PER_INCH, layout="constrained")
    axes = figure.add_subplot()
    axes.set_ylabel("return")
    axes.grid(color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _draw_curve(axes: "Axes", steps: np.ndarray, returns: np.ndarray, label: str, index: int) -> None:
    mean, low, high = _intervals(np.mean(returns, axis=(2, 3)))
    colour, marker = _COLOURS[index % len(_COLOURS)], _MARKERS[index % len(_MARKERS)]
    every = max(1, len(mean) // 10)
    axes.plot(steps, mean, color=colour, marker=marker, markersize=4, markevery=every, label=label)
    axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)


def _draw_points(axes: "Axes", values: np.ndarray, returns: np.ndarray, label: str, index: int) -> None:
    mean, low, high = _intervals(np.mean(returns, axis=2))
    colour, marker = _COLOURS[index % len(_COLOURS)], _MARKERS[index % len(_MARKERS)]
    # Rounding can put the bounds of equal seeds on the wrong side of their mean, which Matplotlib refuses.
    bars = np.maximum([mean - low, high - mean], 0)
    axes.errorbar(values, mean, bars, color=colour, fmt=marker, markersize=6, capsize=3, label=label)


def _intervals(scores: np.ndarray) -> np.ndarray:
    """Return mean, low and high (3, columns) over the seeds of scores (S, columns)."""
    return np.array([mean_interval(column[:, None]) for column in scores.T]).T


def _label_steps(axes: "Axes") -> None:
    from matplotlib.ticker import EngFormatter, MaxNLocator

    axes.set_xlabel("environment steps")
    axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 5, 10], integer=True, min_n_ticks=1))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _save(figure: "Figure", axes: "Axes", path: str | Path) -> None:
    if not axes.get_legend_handles_labels()[1]:
        raise InputError(f"there is nothing to draw in {path}: every array of returns is empty")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=_DOTS_PER_INCH)
