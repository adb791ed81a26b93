"""Metrics of a run as rows of a CSV file."""

import csv
import itertools
import json
import re
import shutil
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtjax.names import naming, notice, replacing

_NUMBER = re.compile(r"(-?([0-9]+(\.[0-9]+)?(e[+-][0-9]+)?|inf))?")  # or nothing
_OF_EACH_TASK = ("td_error", "critic_gradient_norm", "actor_gradient_norm")  # beside the return
_OVER_TASKS = {"lost": np.sum}  # how a row holds metrics, if not by their means
_CLOCKS = ("seconds", "wall_seconds")


class Rows(Sequence):
    """The rows of a run's metrics, alike in their names. Each is kept as one text, a sixth of the memory of a dict."""

    def __init__(self):
        self._names: list[str] = []
        self._texts: list[str] = []

    def extend(self, rows: Sequence[dict[str, Any]]) -> None:
        """Add rows, whose values are numbers and text."""
        self._names = self._names or list(rows[0])
        self._texts += [json.dumps(list(row.values())) for row in rows]

    def __len__(self) -> int:
        return len(self._texts)

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[i] for i in range(*place.indices(len(self)))]
        return dict(zip(self._names, json.loads(self._texts[place]), strict=True))

    def __repr__(self) -> str:
        return f"Rows({len(self)} of {len(self._names)} values)"


def append_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Append rows to a CSV file. A new file gets a header; an old file keeps its columns."""
    is_new = not path.exists() or not path.stat().st_size
    names = list(rows[0]) if is_new else _columns(path)
    with naming(path), path.open("a", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=names, extrasaction="ignore")
        if is_new:
            writer.writeheader()
        writer.writerows(rows)


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write a CSV file anew; whoever reads it sees a whole one."""
    with replacing(path) as new:
        append_rows(new, rows)


def aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return lines of cells as texts. Each column is as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(x.rjust(w) for x, w in zip(line, widths, strict=True)) for line in lines]


def _columns(path: Path) -> list[str]:
    with path.open(newline="") as file:
        return next(csv.reader(file))


def truncate_rows(
    path: Path, iteration: int, columns: Sequence[str] = (), each: int = 0, longest: int = 0
) -> tuple[float, float]:
    """Drop the rows of metrics after an iteration, because a resumed run writes them again.

    Every line is read by itself. If some cannot be read, the file is kept beside the rows that can, and a notice says
    so. Another tells of rows that are gone without a trace. A digit that has changed is not noticed.

    Args:
        columns: the columns that the run writes. They take the place of a damaged first line.
        each: how many rows every chunk has, and
        longest: its iterations at most; 0 if that is unknown.

    Returns:
        the seconds of training up to that iteration, and those of the wall clock.
    """
    if not path.exists():
        if iteration:
            notice(f"{str(path)!r} is missing; the run goes on without its earlier rows")
        return 0.0, 0.0
    *whole, torn = path.read_bytes().decode("utf-8", "replace").split("\n")
    first, *lines = map(_values, whole or [""])
    names = list(columns) if columns and any(len(line) == len(columns) for line in lines) else first
    rows = [dict(zip(names, line, strict=True)) for line in lines if _is_whole(names, line)]
    kept = [row for row in rows if int(row["iteration"]) <= iteration]
    order = [int(row["iteration"]) for row in rows]
    last = max((int(row["iteration"]) for row in kept), default=0)
    complete = last >= iteration and _is_complete([int(row["iteration"]) for row in kept], each, longest)
    spoiled = names != first or len(rows) < len(lines) or order != sorted(order) or last < iteration
    if iteration and (spoiled or (torn and not complete)):
        aside = path.with_suffix(".damaged.csv")
        shutil.copyfile(path, aside)
        notice(f"{str(path)!r} is damaged: {len(kept)} rows up to step {last} are left; it is kept as {aside.name!r}")
    elif iteration and not complete:
        notice(f"{str(path)!r} lacks rows of the run: {len(kept)} up to step {last} are left")
    with replacing(path) as new, new.open("w", newline="") as file:
        if kept:
            writer = csv.DictWriter(file, fieldnames=names)
            writer.writeheader()
            writer.writerows(kept)
    seconds, wall = (max((float(row[name]) for row in kept), default=0.0) for name in _CLOCKS)
    return seconds, wall


def last_iteration(path: Path) -> int:
    """Return the iteration of the last row of metrics that can be read; 0 if there is none."""
    if not path.exists():
        return 0
    names, *lines = map(_values, path.read_bytes().decode("utf-8", "replace").split("\n"))
    whole = (line for line in reversed(lines) if _is_whole(names, line))
    return int(dict(zip(names, next(whole, ()), strict=False)).get("iteration", 0))


def keep_steps(path: Path, last: int) -> None:
    """Drop the lines of a CSV file whose first value, the step, is after ``last`` or none; the header stays."""
    header, *lines = path.read_bytes().decode().splitlines(keepends=True) or [""]
    step = lambda line: line.split(",", 1)[0]
    kept = [line for line in lines if line.endswith("\n") and step(line).isdecimal() and int(step(line)) <= last]
    with replacing(path) as new:
        new.write_bytes((header + "".join(kept)).encode())


def _is_complete(iterations: Sequence[int], each: int, longest: int) -> bool:
    """Return whether no row is missing between others: every chunk has as many, and none is longer than it may be."""
    counts = Counter(iterations)
    long = longest and any(b - a > longest for a, b in itertools.pairwise([0, *sorted(counts)]))
    return not long and (not each or set(counts.values()) <= {each})


def _values(line: str) -> list[str]:
    """Return the values of a line of a CSV file; none if it cannot be read."""
    try:
        return next(csv.reader([line]), [])
    except csv.Error:  # a line without end
        return []


def _is_whole(names: Sequence[str], line: Sequence[str]) -> bool:
    """Return whether a line holds a number, or nothing, in every column, and when it was written."""
    row = dict(zip(names, line, strict=False))
    when = row.get("iteration", "").isdecimal() and all(row.get(name, "")[:1].isdecimal() for name in _CLOCKS)
    return when and len(names) == len(line) and all(map(_NUMBER.fullmatch, line))


def metric_rows(metrics: dict[str, np.ndarray], seeds: np.ndarray, common: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per seed of a chunk's metrics (S, T) or (S,): means over tasks, and some for each task.

    Lost worlds are counted over all tasks.
    """
    rows = []
    for s, seed in enumerate(seeds):
        row = {"seed": int(seed), **common, "return": number(_mean(metrics["return"][s]))}
        for name, x in metrics.items():
            if name not in ("return", "bad_step", "bad_reward"):
                row[name] = number(_OVER_TASKS.get(name, _mean)(x[s]))
        for name in (*_OF_EACH_TASK, "return"):
            row |= {f"{name}_{t}": number(x) for t, x in enumerate(metrics[name][s] if name in metrics else ())}
        rows.append(row)
    return rows


def _mean(x: np.ndarray) -> float:
    """Return the mean of the finite entries, or NaN if there are none."""
    return float(np.mean(x[np.isfinite(x)])) if np.any(np.isfinite(x)) else np.nan


def number(x: Any) -> str:
    """Format a number for a file with seven digits. NaN becomes an empty string."""
    return "" if np.isnan(x) else f"{float(x):.7g}"
