"""Evaluations and metrics of a run as pandas tables."""

import importlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mtjax.agents.swept import Point
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.learning.evaluation import Evaluations
from mtjax.names import InputError


def pandas() -> Any:
    """Import and return pandas.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module("pandas")
    except ImportError:
        raise InputError("tables need pandas: pip install 'mtjax[pandas]'") from None


def frame_of(
    env: FamilyOrMixture, evaluations: Evaluations, seeds: Sequence[int], points: Sequence[Point] = (), /, **fixed: Any
) -> Any:
    """Return a run's evaluations as a table.

    Its columns are those of ``fixed``; the swept numbers, or the member of a population; seed, steps, split and task;
    the task's parameters; the mean ``return`` of its episodes; and further metrics, such as success.
    """
    values = {split: env.params(split) for split in evaluations.returns}
    rows, each = [], len(evaluations.returns["train"]) // max(len(points), 1)
    for split, returns in evaluations.returns.items():
        scores = {"return": returns} | {name: x[split] for name, x in evaluations.metrics.items()}
        means = {name: np.mean(x, axis=-1) for name, x in scores.items()}  # (S, V, T)
        numbers = np.asarray(env.tasks(split).id)
        for s, v, t in np.ndindex(*returns.shape[:3]):
            point = points[s // each] if points else {}
            rows.append(
                {
                    **fixed,
                    **point,
                    "seed": int(seeds[s % len(seeds)]),
                    "steps": int(evaluations.steps[v]),
                    "split": split,
                    "task": int(numbers[t]),
                    **{name: x[t] for name, x in values[split].items()},
                    **{name: float(x[s, v, t]) for name, x in means.items()},
                }
            )
    return pandas().DataFrame(rows)


def members(seeds: Sequence[int] | np.ndarray) -> tuple[list[int], list[dict[str, int]]]:
    """Return the seeds (S,) of a population and its members' numbers, for ``frame_of``: their settings change."""
    return [int(seed) for seed in seeds], [{"member": k} for k in range(len(seeds))]


def metrics_frame(rows: Iterable[Mapping[str, Any]]) -> Any:
    """Return the lines of metrics.csv as a table; empty entries are NaN."""
    number = lambda x: np.nan if x == "" else float(x)
    whole = ("seed", "iteration", "steps")
    made = [{name: int(x) if name in whole else number(x) for name, x in row.items()} for row in rows]
    return pandas().DataFrame(made)
