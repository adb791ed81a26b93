"""Metrics of a run as rows of a CSV file."""

import csv
import itertools
import os
from pathlib import Path
from typing import Any

import numpy as np

_OF_EACH_TASK = ("td_error", "critic_gradient_norm", "actor_gradient_norm")  # beside the return


def append_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Append rows to a CSV file. A new file gets a header; an old file keeps its columns."""
    is_new = not path.exists() or not path.stat().st_size
    names = list(rows[0]) if is_new else _columns(path)
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=names, extrasaction="ignore")
        if is_new:
            writer.writeheader()
        writer.writerows(rows)


def _columns(path: Path) -> list[str]:
    with path.open(newline="") as file:
        return next(csv.reader(file))


def truncate_rows(path: Path, iteration: int) -> float:
    """Drop the rows of metrics after an iteration, because a resumed run writes them again.

    Returns:
        the seconds of training up to that iteration.
    """
    if not path.exists():
        return 0.0
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        kept = list(itertools.takewhile(lambda row: _is_whole(row) and int(row["iteration"]) <= iteration, reader))
        names = reader.fieldnames or []
    replacement = path.with_suffix(".new")
    with replacement.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=names)
        writer.writeheader()
        writer.writerows(kept)
    os.replace(replacement, path)
    return max((float(row["seconds"]) for row in kept), default=0.0)


def _is_whole(row: dict[str, str | None]) -> bool:
    """Return whether a line is complete. A killed process may leave half of one."""
    return None not in row.values() and row["iteration"].isdigit()  # type: ignore


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
