"""Metrics of a run as rows of a CSV file."""

import csv
import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtjax.names import naming, notice, replacing

_OF_EACH_TASK = ("td_error", "critic_gradient_norm", "actor_gradient_norm")  # beside the return
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


def _columns(path: Path) -> list[str]:
    with path.open(newline="") as file:
        return next(csv.reader(file))


def truncate_rows(path: Path, iteration: int) -> tuple[float, float]:
    """Drop the rows of metrics after an iteration, because a resumed run writes them again.

    What can be read of a damaged file is kept. The file itself is then kept beside it, and a notice says so.

    Returns:
        the seconds of training up to that iteration, and those of the wall clock.
    """
    if not path.exists():
        if iteration:
            notice(f"{str(path)!r} is missing; the run goes on without its earlier rows")
        return 0.0, 0.0
    names, rows = _read_rows(path)
    good = [row for row in rows if _is_whole(row)]
    kept = [row for row in good if int(row["iteration"]) <= iteration]
    last = max((int(row["iteration"]) for row in kept), default=0)
    if iteration and (last < iteration or any(not _is_whole(row) for row in rows[:-1])):
        aside = path.with_suffix(".damaged.csv")
        shutil.copyfile(path, aside)
        notice(f"{str(path)!r} is damaged: {len(kept)} rows up to step {last} are left; it is kept as {aside.name!r}")
    with replacing(path) as new, new.open("w", newline="") as file:
        if kept:
            writer = csv.DictWriter(file, fieldnames=names)
            writer.writeheader()
            writer.writerows(kept)
    seconds, wall = (max((float(row[name]) for row in kept), default=0.0) for name in _CLOCKS)
    return seconds, wall


def _read_rows(path: Path) -> tuple[list[str], list[dict[str, Any]]]:
    """Return the columns and rows of a CSV file as far as they can be read."""
    rows = []
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        reader = csv.DictReader(file)
        try:
            names = list(reader.fieldnames or ())
            rows.extend(reader)
        except csv.Error:  # a line without end
            names = list(reader.fieldnames or ()) if rows else []
            rows.append({})
    return names, rows


def _is_whole(row: dict[Any, Any]) -> bool:
    """Return whether a line of metrics is complete. A killed process may leave half of one."""
    iteration, clocks = str(row.get("iteration")), [str(row.get(name)) for name in _CLOCKS]
    if None in row or None in row.values() or not (iteration.isascii() and iteration.isdigit()):
        return False
    return all(re.fullmatch(r"[0-9]+(\.[0-9]+)?", clock) for clock in clocks)


def metric_rows(metrics: dict[str, np.ndarray], seeds: np.ndarray, common: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per seed of a chunk's metrics (S, T) or (S,): means over tasks, and some for each task."""
    rows = []
    for s, seed in enumerate(seeds):
        row = {"seed": int(seed), **common, "return": number(_mean(metrics["return"][s]))}
        row |= {name: number(_mean(x[s])) for name, x in metrics.items() if name not in ("return", "bad_step")}
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
