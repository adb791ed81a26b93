"""What a page shows of a run, as JSON: progress and returns, from the folder that the run writes."""

import contextlib
import csv
import math
import os
import re
import time
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mtjax.config import RunConfig
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.learning.evaluation import Evaluations, load_evaluations
from mtjax.names import SPLITS, InputError
from mtjax.report.scoring import GIVEN
from mtjax.saved import lock

_POINTS, _POINTS_OF_TASK = 300, 60  # of a curve
_RECENT = 10  # lines of metrics by which the time that is left is told
_COUNTS = ("seed", "iteration", "steps", "seconds", "wall_seconds")
_OF_TASK = re.compile(r"\w+_\d+")


class Metrics:
    """Holds the lines of metrics.csv. Each is read once, when the run has appended it."""

    def __init__(self, path: Path):
        self.path, self.file, self.read_to = path, 0, 0
        self.names: list[str] = []
        self.rows: list[np.ndarray] = []

    def update(self) -> None:
        """Read the lines that are new. A file that a resumed run has written anew is read from its start."""
        with contextlib.suppress(FileNotFoundError), self.path.open("rb") as file:
            found = os.fstat(file.fileno())
            if found.st_ino != self.file or found.st_size < self.read_to:
                self.file, self.read_to, self.names, self.rows = found.st_ino, 0, [], []
            file.seek(self.read_to)
            whole, end, _ = file.read().rpartition(b"\n")  # the last line may be half written
            self.read_to += len(whole + end)
            for values in csv.reader(whole.decode("utf-8", "replace").splitlines()):
                self._add(values)

    def _add(self, values: Sequence[str]) -> None:
        self.names = self.names or list(values)
        with contextlib.suppress(ValueError):  # the header, or a damaged line
            row = np.array([float(x) if x else np.nan for x in values])
            self.rows += [row] * (len(row) == len(self.names))

    def means(self, points: int) -> dict[str, np.ndarray]:
        """Return the means over seeds of every column, at most at so many iterations that are spread evenly."""
        if not self.rows:
            return {}
        rows = np.stack(self.rows)
        iterations, of = np.unique(rows[:, self.names.index("iteration")], return_inverse=True)
        spread = np.linspace(0, len(iterations) - 1, min(points, len(iterations))).round().astype(int)
        values = np.stack([_mean(rows[of == k], 0) for k in spread], axis=1)
        return dict(zip(self.names, values, strict=True))


class Watched(NamedTuple):
    """A run whose folder is looked at."""

    directory: Path
    config: RunConfig
    env: FamilyOrMixture  # whose tasks are listed, by default those of the run
    metrics: Metrics

    @classmethod
    def of(cls, directory: Path, config: RunConfig, env: FamilyOrMixture | None = None) -> "Watched":
        """Return a run by its folder and its configuration."""
        return cls(directory, config, env or config.family, Metrics(directory / "metrics.csv"))

    def told(self) -> dict[str, Any]:
        """Return all that the page shows, as values for ``json``, in which None stands for what is unknown.

        Curves are means over the run's seeds, and evaluations over their episodes too.
        """
        self.metrics.update()
        curves, of_tasks = self.metrics.means(_POINTS), self.metrics.means(_POINTS_OF_TASK)
        evaluations = self._evaluations()
        scores = {} if evaluations is None else {"return": evaluations.returns, **evaluations.metrics}
        means = lambda of_splits: {split: _mean(x, (0, 2, 3)) for split, x in of_splits.items()}
        return _plain(
            {
                "title": f"{self.config.agent} on {self.config.env}",
                "folder": str(self.directory),
                **self._progress(),
                "curves": {name: x for name, x in curves.items() if name == "steps" or _is_whole_runs(name)},
                "evaluated": [] if evaluations is None else evaluations.steps,
                "scores": {name: means(x) for name, x in scores.items()},
                "task_steps": of_tasks.get("steps", []),
                "tasks": self._tasks(evaluations, of_tasks),
            }
        )

    def _progress(self) -> dict[str, Any]:
        """Return the steps made and planned, those of all seeds a second, the seconds gone and left, and if it runs."""
        rows, total = self.metrics.rows[-_RECENT * self.config.members :], self.config.length * self.config.worlds
        found: dict[str, Any] = {"seeds": self.config.members, "total": total, "running": lock.is_held(self.directory)}
        if not rows:
            return found | {"steps": 0, "rate": None, "seconds": None, "left": None, "silent": None}
        columns = [self.metrics.names.index(name) for name in ("steps", "seconds", "wall_seconds")]
        (steps, _, clock), (made, trained, waited) = rows[-1][columns], rows[-1][columns] - rows[0][columns]
        times = {
            "rate": self.config.members * made / trained if min(made, trained) > 0 else None,  # as the console has it
            "seconds": clock,
            "left": max(total - steps, 0) * waited / made if made > 0 else None,
            "silent": time.time() - self.metrics.path.stat().st_mtime,
        }
        return found | {"steps": steps, **times}

    def _evaluations(self) -> Evaluations | None:
        """Return the run's evaluations; None if there are none yet, or their file cannot be read."""
        file = self.directory / "evaluations.npz"
        with contextlib.suppress(InputError, FileNotFoundError):
            return _read_evaluations(file, file.stat().st_mtime_ns)
        return None

    def _tasks(self, evaluations: Evaluations | None, curves: dict[str, np.ndarray]) -> list[dict[str, Any]]:
        """Return every task with its split, number and name; those of the run also with a curve and latest returns.

        The curve is of ``task_steps`` where something was trained, else of ``evaluated``.

        Args:
            curves: what metrics.csv has, by column.
        """
        own, found = self.env is self.config.family, []
        curves = curves if own else {}
        scores = evaluations.returns if own and evaluations is not None else {}
        for split in SPLITS:
            scored = (
                _mean(scores[split], (0, 3)) if split in scores else np.zeros((0, self.env.counts[split]))
            )  # (V, T)
            for t, label in enumerate(self.env.labels(split)):
                trained = curves.get(f"return_{t}", scored[:0, t]) if split == "train" else scored[:0, t]
                about = {"split": split, "task": t, "label": label, "called": split if own else GIVEN.get(split, split)}
                last = {"trained": _last(trained), "scored": _last(scored[:, t])}
                found.append({**about, **last, "curve": trained if len(trained) else scored[:, t]})
        return found


@lru_cache(1)
def _read_evaluations(file: Path, written: int) -> Evaluations:
    """Read evaluations once for each time at which their file was written."""
    return load_evaluations(file)


def _last(x: np.ndarray) -> Any:
    """Return the last finite entry, None if there is none."""
    known = x[np.isfinite(x)]
    return known[-1] if len(known) else None


def _is_whole_runs(name: str) -> bool:
    """Return whether a column of metrics.csv is a curve of the whole run, and not of one task."""
    return name not in _COUNTS and not _OF_TASK.fullmatch(name)


def _mean(x: np.ndarray, axis: Any) -> np.ndarray:
    """Return the means of the finite entries, NaN where there are none."""
    known = np.isfinite(x)
    count = known.sum(axis=axis)
    return np.where(count > 0, np.where(known, x, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


def _plain(x: Any) -> Any:
    """Return values as those of JSON, with nine digits; what is not finite is None."""
    match x:
        case dict():
            return {name: _plain(value) for name, value in x.items()}
        case list() | np.ndarray():
            return [_plain(value) for value in x]
        case float() | np.floating():
            return float(f"{x:.9g}") if math.isfinite(x) else None
        case np.integer():
            return int(x)
    return x
