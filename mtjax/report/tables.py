"""Returns of a run as tables of text."""

import numpy as np

from mtjax.evaluation import Evaluations
from mtjax.report.stats import seed_interval
from mtjax.training.policy import Policy


def _interval(scores: np.ndarray) -> str:
    """Mean of scores (S, T) with its 95% interval over seeds, if there are several."""
    point, low, high = seed_interval(scores)
    return f"{point:6.0f}" + (f"  [{low:.0f}, {high:.0f}]" if scores.shape[0] > 1 else "")


def split_table(evaluations: Evaluations) -> str:
    """Lay out the last evaluation of a run: mean return by split, and the worst task's."""
    lines = [f"{'split':15} {'tasks':>5} {'return':>7}  worst task"]
    for split, returns in evaluations.returns.items():
        if returns.size:
            scores = returns[:, -1].mean(axis=-1)  # (S, T)
            lines.append(f"{split:15} {scores.shape[1]:5} {_interval(scores):>7}  {scores.mean(axis=0).min():.0f}")
    return "\n".join(lines)


def task_table(policy: Policy, episodes: dict[str, np.ndarray]) -> str:
    """Lay out returns (S, T, episodes) by split and task."""
    lines = [f"{'split':15} {policy.env.task_axis[0]:>10} {'return':>7}   episodes from, to"]
    for split, returns in episodes.items():
        if not returns.size:
            continue
        for value, task in zip(policy.env.task_values(split), np.moveaxis(returns, 1, 0), strict=True):
            mean = _interval(task.mean(axis=-1, keepdims=True))
            lines.append(f"{split:15} {value:10.4g} {mean:>7}   {task.min():.0f}, {task.max():.0f}")
        lines.append(f"{split:15} {'all':>10} {_interval(returns.mean(axis=-1)):>7}")
    return "\n".join(lines)
