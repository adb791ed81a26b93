"""The values of a family's parameters in every task, and the split into training and held-out tasks."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from mtjax.checks import shown
from mtjax.envs.parameters import Parameter
from mtjax.names import InputError, nearest_error

COMBINATIONS = ("grid", "paired", "random")
SCHEMES = ("dense", "hip-bmdp", "none")
_HIP_BMDP = {"train": (3, 4, 7, 8), "interpolation": (5, 6), "extrapolation": (2, 9)}
MOST_TASKS = 10_000
_LARGEST = 1e30  # beyond it, 32-bit numbers overflow in the physics
_FORMS = "lo:hi:n (n even steps), lo:hi (a new value each episode) or a list a,b,c"


class Axis(NamedTuple):
    """The values of one parameter: one for each task, or a range from which every episode draws."""

    points: np.ndarray  # (n,), or the two ends of a range
    continuous: bool
    named: bool  # values are numbers of names, and held-out tasks have no others

    @property
    def between(self) -> bool:
        """Return whether values lie between two others."""
        return len(self.points) > 1 and not self.named


@dataclasses.dataclass(frozen=True, eq=False)
class Variation:
    """The values of all varied parameters by split. A row is a task, a column a parameter.

    A table of tasks has a row for every task of every split, and then one for every draw.
    """

    names: tuple[str, ...]
    rows: Mapping[str, np.ndarray]  # split -> (T, names)
    draws: np.ndarray | None  # (T, P, names) values for the first tasks of all; each episode of one takes one
    low: np.ndarray  # (names,) ends of the training range
    high: np.ndarray

    @property
    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """Return the parameters that differ between training tasks or episodes, with their ends."""
        ends = zip(self.names, self.low.tolist(), self.high.tolist(), strict=True)
        return tuple((name, low, high) for name, low, high in ends if low < high)

    @property
    def varied(self) -> tuple[str, ...]:
        """Return the parameters that differ between training tasks or episodes."""
        return tuple(name for name, _, _ in self.ranges)

    @property
    def redrawn(self) -> tuple[str, ...]:
        """Return the parameters whose values episodes draw anew, in at least one task."""
        spread = () if self.draws is None else np.ptp(self.draws, axis=1).max(axis=0, initial=0.0)
        return tuple(name for name, most in zip(self.names, spread, strict=False) if most > 0)

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of tasks of each split."""
        return {split: len(rows) for split, rows in self.rows.items()}

    @cached_property
    def values(self) -> dict[str, np.ndarray]:
        """Return the values (R,) of each varied parameter in every row of the table, in float64."""
        parts = [*self.rows.values(), *([] if self.draws is None else self.draws)]
        return dict(zip(self.names, np.concatenate(parts).T, strict=True))

    @property
    def count(self) -> int:
        """Return the number R of rows of the table."""
        return sum(map(len, [*self.rows.values(), *([] if self.draws is None else self.draws)]))

    @property
    def places(self) -> dict[str, np.ndarray]:
        """Return the rows of the table (T,) of each split."""
        counts = self.counts
        ends = np.cumsum(list(counts.values()))
        return {split: np.arange(end - counts[split], end) for split, end in zip(counts, ends, strict=True)}

    @property
    def drawn(self) -> np.ndarray | None:
        """Return the rows of the table (tasks of all splits, P) that episodes draw. A task without draws has its own.

        None: no task has draws.
        """
        if self.draws is None or not len(self.draws):
            return None
        listed = sum(self.counts.values())
        rows = np.repeat(np.arange(listed)[:, None], self.draws.shape[1], axis=1)
        rows[: len(self.draws)] = np.arange(listed, self.count).reshape(len(self.draws), -1)
        return rows

    def for_rows(self, make: Callable[[dict[str, float]], Any], names: Iterable[str]) -> tuple[Any, ...]:
        """Return what ``make`` returns for the values of ``names`` in every row of the table. Equal rows share it."""
        used = [name for name in self.values if name in names]
        rows = list(zip(*(self.values[name].tolist() for name in used), strict=True)) or [()] * self.count
        made = {row: make(dict(zip(used, row, strict=True))) for row in dict.fromkeys(rows)}
        return tuple(made[row] for row in rows)


def write_values(given: str | float | Sequence[float], name: str = "a parameter") -> str:
    """Return a parameter's values in the notation of the command line.

    Raises:
        InputError: they are neither text nor numbers.
    """
    if isinstance(given, str):
        return given
    try:
        points = np.atleast_1d(np.array(given, np.float64)) if given is not None else None
    except (TypeError, ValueError, OverflowError):
        points = None
    if points is None or points.ndim > 1:
        raise InputError(f"the values of {name} are {_FORMS}, or numbers; not {shown(given)}")
    return ",".join(repr(float(x)) for x in points)


def require_ranges(family: str, given: Mapping[str, Any]) -> None:
    """Refuse lists of values where a family by itself draws tasks between the ends of ranges.

    Raises:
        InputError: a parameter has several values.
    """
    for name, values in given.items():
        text = write_values(values, name)
        if "," in text or text.count(":") > 1:
            raise InputError(
                f"{family} draws its tasks at random, from a range such as {name}=lo:hi; for tasks with the values "
                f"{text} add --env.combine=grid"
            )


def require_allowed(name: str, numbers: Iterable[float], parameter: Parameter) -> None:
    """Raise InputError where a number is outside a parameter's range."""
    wrong = next((x for x in numbers if not abs(x) <= _LARGEST or not _allowed(x, parameter)), None)
    if wrong is not None:
        most = min(parameter.maximum, _LARGEST)
        limit = f" and at most {most:g}" if most < _LARGEST or not wrong <= most else ""
        raise InputError(f"{name} must be greater than {parameter.minimum:g}{limit}, not {wrong:g}")


def read_axis(name: str, text: str, parameter: Parameter) -> Axis:
    """Read "lo:hi:n", "lo:hi" or "a,b,c".

    Raises:
        InputError: the text is none of these, or a value is outside the parameter's range or has no name.
    """
    if not text.strip():
        raise InputError(f"{name} has no values; give {_FORMS}")
    parts = text.split(":")
    try:
        numbers = [_number(x, parameter) for x in (text.split(",") if len(parts) == 1 else parts[:2])]
        count = int(parts[2]) if len(parts) == 3 else len(numbers)
        if len(parts) > 3:
            raise ValueError
    except ValueError:
        raise InputError(f"cannot read the values {text!r} of {name}; give {_FORMS}") from None
    if count > MOST_TASKS:
        raise InputError(f"{name} can have {MOST_TASKS} values at most, each of which is a task, not {count}")
    if len(parts) == 3 and count < 2:
        asked = "one value" if count == 1 else f"{count} values"
        raise InputError(f"{text} asks for {asked} of {name}; give it alone, or a range of at least two")
    require_allowed(name, numbers, parameter)
    points = np.linspace(numbers[0], numbers[1], count) if len(parts) == 3 else np.array(numbers)
    if parameter.names and (len(parts) == 2 or np.any(points % 1)):
        told = ", ".join(f"{i} ({called})" for i, called in enumerate(parameter.names))
        raise InputError(f"{name} is one of {told}; list them, such as {','.join(parameter.names[:2])}; not {text}")
    axis = Axis(points, len(parts) == 2, bool(parameter.names))
    if len(parts) > 1 and numbers[1] <= numbers[0] and axis.points.size > 1:
        raise InputError(f"the range of {name} must go from low to high, not {text}")
    return axis


def _number(text: str, parameter: Parameter) -> float:
    """Return a value that is given as a number or by its name."""
    return float(parameter.names.index(text.strip()) if text.strip() in parameter.names else text)


def _allowed(value: Any, parameter: Parameter) -> bool:
    return parameter.minimum + 1e-9 < value <= parameter.maximum + 1e-9


def vary(
    given: Mapping[str, str],
    parameters: Mapping[str, Parameter],
    combine: str,
    num_tasks: int,
    split: str,
    num_draws: int,
    seed: int,
) -> Variation:
    """Return the parameter values of every task of every split.

    Args:
        given: the values of each varied parameter, as ``read_axis`` reads them.
        combine: how several parameters combine: every combination ("grid"), value by value ("paired"), or
            ``num_tasks`` tasks drawn uniformly between each one's least and greatest value ("random").
        split: "dense" trains on all values. Interpolation tasks lie between neighbouring training values.
            Extrapolation tasks lie one and two steps beyond each end of each parameter. A step is the spacing at that
            end (in a grid, a tenth of a continuous range); steps that leave a parameter's range are left out.
            "hip-bmdp" splits ten tasks (Zhang et al. 2021, by the indices of MTRL's configuration). "none" holds
            nothing out.
        num_draws: number of values drawn from the continuous ranges of one task.
        seed: seed of random tasks and draws.

    Raises:
        InputError: a name is unknown, or the values do not fit each other or the split.
    """
    for name in given:
        if not parameters:
            raise InputError(f"unknown parameter {name!r}; this family has none")
        if name not in parameters:
            raise nearest_error("parameter", name, parameters)
    names = tuple(given)
    axes = {name: read_axis(name, text, parameters[name]) for name, text in given.items()}
    limits = [parameters[name] for name in names]
    random = np.random.default_rng(seed)
    if combine == "random":
        rows = _random_rows(axes, limits, num_tasks, split, random)
    else:
        rows = _listed_rows(axes, limits, combine, split)
    low, high = _ends(list(axes.values()), rows["train"], combine)
    continuous = [i for i, axis in enumerate(axes.values()) if axis.continuous and combine != "random"]
    draws = _draw(rows["train"], continuous, low, high, num_draws, random) if continuous else None
    return Variation(names, rows, draws, low, high)


def require_known(combine: str, split: str) -> None:
    """Raise InputError unless parameters combine, and tasks are split, in a way that there is."""
    for kind, value, allowed in (("combine", combine, COMBINATIONS), ("split", split, SCHEMES)):
        if value not in allowed:
            raise nearest_error(kind, value, allowed)


def count_tasks(settings: Mapping[str, Any]) -> int:
    """Return the number of training tasks from a family's settings alone, as ``outline`` needs it."""
    if "num_tasks" in settings:
        return settings["num_tasks"]
    given = settings.get("vary", {})
    anything = dict.fromkeys(given, Parameter("", 0.0, minimum=-np.inf))
    combine, split = settings.get("combine", "grid"), settings.get("split", "dense")
    return len(vary(given, anything, combine, 1, split, 1, 0).rows["train"])


def _ends(axes: list[Axis], train: np.ndarray, combine: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and greatest training value (names,) of each parameter; of ranges, their ends."""
    ranged = [axis.continuous or combine == "random" for axis in axes]
    values = [axis.points if whole else column for axis, whole, column in zip(axes, ranged, train.T, strict=True)]
    return np.array([np.min(x) for x in values]), np.array([np.max(x) for x in values])


def _draw(train: np.ndarray, columns: list[int], low, high, count: int, random: np.random.Generator) -> np.ndarray:
    """Return values (T, P, names) for episodes of training tasks (T, names), drawn where a column is a range."""
    draws = np.repeat(train[:, None], count, axis=1)
    for i in columns:
        # One draw in each of P equal parts of the range: no gaps, whatever the seed.
        parts = random.permuted(np.tile(np.arange(count), (len(train), 1)), axis=1)
        draws[:, :, i] = low[i] + (parts + random.uniform(size=parts.shape)) / count * (high[i] - low[i])
    return draws


def _random_rows(axes, limits, num_tasks: int, split: str, random: np.random.Generator) -> dict[str, np.ndarray]:
    if num_tasks < 1:
        raise InputError(f"combine=random needs num-tasks of at least 1, not {num_tasks}")
    if split == "hip-bmdp":
        raise InputError("split hip-bmdp numbers listed tasks; with combine=random use --split=dense or none")
    named = next((name for name, axis in axes.items() if axis.named and len(axis.points) > 1), None)
    if named is not None:
        raise InputError(f"combine=random draws between values, and {named} has names; use --env.combine=grid")
    low, high = (np.array([end(axis.points) for axis in axes.values()]) for end in (np.min, np.max))
    if not np.any(high > low):
        raise InputError("combine=random needs a parameter with more than one value; use --env.combine=grid")
    train = random.uniform(low, high, (num_tasks, len(low)))
    held = min(num_tasks, 10) if split == "dense" else 0
    inside, beyond = random.uniform(low, high, (held, len(low))), random.uniform(low, high, (held, len(low)))
    wide = np.flatnonzero(high > low)
    kept = []
    for row in beyond if len(wide) else []:
        i = random.choice(wide)
        step = random.uniform(0, 0.2) * (high[i] - low[i])
        ends = [x for x in (low[i] - step, high[i] + step) if _allowed(x, limits[i])]
        if ends:
            row[i] = random.choice(ends)
            kept.append(row)
    return {"train": train, "interpolation": inside, "extrapolation": _stack(kept, len(low))}


def _listed_rows(axes: Mapping[str, Axis], limits, combine: str, split: str) -> dict[str, np.ndarray]:
    train = _combine([np.mean(a.points, keepdims=True) if a.continuous else a.points for a in axes.values()], combine)
    if split == "hip-bmdp":
        if len(train) != 10:
            raise InputError(f"split hip-bmdp numbers ten tasks, and this family has {len(train)}; use --split=dense")
        return {name: train[list(indices)] for name, indices in _HIP_BMDP.items()}
    if split == "none":
        return {"train": train, "interpolation": train[:0], "extrapolation": train[:0]}
    every = list(axes.values())
    if combine == "grid":
        between, beyond = _between_grid(every), _beyond_grid(every)
    elif any(axis.named and len(axis.points) > 1 for axis in every):
        between, beyond = [], []
    else:
        between, beyond = _between_rows(train), _beyond_rows(train)
    beyond = [row for row in beyond if all(_allowed(x, limit) for x, limit in zip(row, limits, strict=True))]
    width = train.shape[1]
    return {"train": train, "interpolation": _stack(between, width), "extrapolation": _stack(beyond, width)}


def _stack(rows, width: int) -> np.ndarray:
    return np.reshape(np.array(rows, np.float64), (len(rows), width))


def _combine(points: list[np.ndarray], combine: str) -> np.ndarray:
    if combine == "paired":
        counts = {len(p) for p in points if len(p) > 1} or {1}
        if len(counts) > 1:
            raise InputError(f"combine=paired needs as many values of each parameter, not {sorted(counts)}")
        rows = np.stack([np.broadcast_to(p, max(counts)) for p in points], axis=1) if points else np.zeros((1, 0))
    else:
        count = math.prod(len(p) for p in points)
        if count > MOST_TASKS:
            raise InputError(f"the grid has {count} tasks, and {MOST_TASKS} are most; give fewer values")
        if any(np.any(np.diff(p) <= 0) and np.any(np.diff(p) >= 0) for p in points):
            raise InputError("the values of a parameter must increase (or decrease), and these do not")
        rows = (
            np.stack([x.ravel() for x in np.meshgrid(*points, indexing="ij")], axis=1) if points else np.zeros((1, 0))
        )
    if len(np.unique(np.float32(rows), axis=0)) < len(rows):
        raise InputError("two tasks have the same values, as numbers of single precision")
    return rows


def _between_rows(train: np.ndarray) -> np.ndarray:
    return (train[:-1] + train[1:]) / 2


def _beyond_rows(train: np.ndarray) -> list[np.ndarray]:
    if len(train) < 2:
        return []
    first, last = train[1] - train[0], train[-1] - train[-2]
    return [train[0] - 2 * first, train[0] - first, train[-1] + last, train[-1] + 2 * last]


def _between_grid(axes: list[Axis]) -> np.ndarray:
    """Return the midpoints of all cells of the grid; of a continuous range, five values inside it."""
    if not any(axis.between for axis in axes):
        return np.zeros((0, len(axes)))
    return np.stack([x.ravel() for x in np.meshgrid(*map(_inside, axes), indexing="ij")], axis=1)


def _inside(axis: Axis) -> np.ndarray:
    if axis.continuous:
        return np.linspace(axis.points[0], axis.points[1], 7)[1:-1]
    return _between_rows(axis.points) if axis.between else axis.points


def _beyond_grid(axes: list[Axis]) -> list[np.ndarray]:
    """Return tasks with one parameter beyond its ends and the others at their middle value."""
    middle = np.array([np.mean(a.points) if a.continuous else a.points[(len(a.points) - 1) // 2] for a in axes])
    rows = []
    for i, axis in enumerate(axes):
        steps = np.linspace(axis.points[0], axis.points[1], 11) if axis.continuous else axis.points
        for value in [] if axis.named else _beyond_rows(steps):
            rows.append(np.where(np.arange(len(axes)) == i, value, middle))
    return rows


def scale(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Scale values (..., names) from the training range to [-1, 1]. A range of one value becomes 0."""
    half = (high - low) / 2
    return (values - (low + high) / 2) / np.where(half > 0, half, 1.0)
