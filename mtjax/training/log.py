"""What a run writes while it goes: a line of metrics a chunk, on the terminal and in a file."""

import csv
import itertools
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

_OF_EACH_TASK = ("td_error", "critic_gradient_norm", "actor_gradient_norm")  # beside the return


def append_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    """Append rows to a CSV file, with a header if it is new; an old one keeps its columns."""
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
    """Drop the rows of metrics that lie after an iteration, as a resumed run will write them again.

    Returns:
        the seconds of training up to there.
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
    """Whether a line was written to its end: a process that is killed may leave half of one."""
    return None not in row.values() and row["iteration"].isdigit()  # type: ignore


def metric_rows(metrics: dict[str, np.ndarray], seeds: np.ndarray, common: dict[str, Any]) -> list[dict[str, Any]]:
    """Lay out one chunk's metrics (S, T) or (S,) as one row a seed: means over tasks, and a few for each task."""
    rows = []
    for s, seed in enumerate(seeds):
        row = {"seed": int(seed), **common, "return": number(_mean(metrics["return"][s]))}
        row |= {name: number(_mean(x[s])) for name, x in metrics.items() if name not in ("return", "bad_step")}
        for name in (*_OF_EACH_TASK, "return"):
            row |= {f"{name}_{t}": number(x) for t, x in enumerate(metrics[name][s] if name in metrics else ())}
        rows.append(row)
    return rows


def _mean(x: np.ndarray) -> float:
    """Mean of what is there, NaN of nothing."""
    return float(np.mean(x[np.isfinite(x)])) if np.any(np.isfinite(x)) else np.nan


def number(x: Any) -> str:
    """Format a number for a file: seven digits, nothing for NaN."""
    return "" if np.isnan(x) else f"{float(x):.7g}"


class Console:
    """Live progress: a bar on a terminal, plain lines elsewhere. Silent if asked to be."""

    def __init__(self, total_steps: int, quiet: bool = False, label: str = ""):
        self.total, self.quiet, self.bar, self.label = total_steps, quiet, None, f"{label}  " if label else ""
        if quiet or not sys.stdout.isatty():
            return
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self.bar = Progress(BarColumn(24), TextColumn("{task.description}"), TimeRemainingColumn(), transient=False)
        self.task = self.bar.add_task("compiling", total=total_steps)
        self.bar.start()

    def say(self, text: str) -> None:
        """Print a line."""
        if self.bar is not None:
            self.bar.console.print(text, highlight=False, markup=False)
        elif not self.quiet:
            print(text, flush=True)

    def progress(self, steps: int, seconds: float, rate: float, returns: np.ndarray) -> None:
        """Show where training is; ``returns`` (S, T) of this chunk's episodes, NaN where none ended."""
        known = returns[np.isfinite(returns)]
        score = f"return {known.mean():.0f} ({known.min():.0f} to {known.max():.0f})" if known.size else "return -"
        text = f"{self.label}{steps:,} of {self.total:,} steps  {seconds:.1f} s  {rate:,.0f} steps/s  {score}"
        if self.bar is not None:
            self.bar.update(self.task, completed=steps, description=text)
        else:
            self.say(text)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
