"""Runs and their evaluations as pandas tables, one row for each seed, evaluation and task."""

import importlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtjax.envs.tabled import Tabled
from mtjax.evaluation import Evaluations
from mtjax.names import InputError, public
from mtjax.report import collect
from mtjax.training.points import Point


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
    env: Tabled, evaluations: Evaluations, seeds: Sequence[int], points: Sequence[Point] = (), /, **fixed: Any
) -> Any:
    """Return a run's evaluations as a table.

    Its columns are those of ``fixed``; the swept numbers; seed, steps, split and task; the task's parameters; the mean
    ``return`` of its episodes; and further metrics, such as success.
    """
    values = {split: env.params(split) for split in evaluations.returns}
    rows = []
    for split, returns in evaluations.returns.items():
        scores = {"return": returns} | {name: x[split] for name, x in evaluations.metrics.items()}
        means = {name: np.mean(x, axis=-1) for name, x in scores.items()}  # (S, V, T)
        numbers = np.asarray(env.tasks(split).id)
        for s, v, t in np.ndindex(*returns.shape[:3]):
            point = points[s // len(seeds)] if points else {}
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


def metrics_frame(rows: Iterable[Mapping[str, Any]]) -> Any:
    """Return the lines of metrics.csv as a table; empty entries are NaN."""
    number = lambda x: np.nan if x == "" else float(x)
    whole = ("seed", "iteration", "steps")
    made = [{name: int(x) if name in whole else number(x) for name, x in row.items()} for row in rows]
    return pandas().DataFrame(made)


@public
def runs(pattern: str | Path | Iterable[str | Path] = "runs/*") -> Any:
    """Return all evaluations of runs as one table, with the columns run, env, agent and swept settings first.

    Args:
        pattern: a folder, a pattern such as "runs/*", or several of them. Runs of sweeps are found inside.

    Raises:
        InputError: there is no such run, or pandas is missing.
    """
    made = []
    for found in collect.read(pattern):
        config = found.config
        fixed = {"run": str(found.directory), "env": config.env, "agent": config.agent, **found.settings}
        seeds = config.plan.all_seeds
        made.append(frame_of(config.family, found.evaluations, seeds, config.points, **fixed))
    return pandas().concat(made, ignore_index=True)
