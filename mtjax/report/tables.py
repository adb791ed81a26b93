"""Returns of a run as tables of text."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from mtjax.envs.family import Part
from mtjax.evaluation import Evaluations
from mtjax.report.stats import seed_interval
from mtjax.training.policy import Policy


def _interval(scores: np.ndarray) -> str:
    """Return the mean of scores (S, T) as text, with its 95% interval if there are enough seeds for one."""
    point, low, high = seed_interval(scores)
    return f"{point:6.0f}" + (f"  [{low:.0f}, {high:.0f}]" if np.isfinite(low) else "")


def split_table(evaluations: Evaluations, parts: Sequence[Part] = ()) -> str:
    """Return a run's last evaluation as text: mean and worst task's return by split; of a mixture also by family."""
    last = {split: x[:, -1].mean(axis=-1) for split, x in evaluations.returns.items() if x.size}  # (S, T)
    lines = [f"{'split':15} {'tasks':>5} {'return':>7}  worst task"]
    lines += [_split_line(split, scores) for split, scores in last.items()]
    for part in parts if len(parts) > 1 else ():
        lines.append(part.name)
        found = {split: scores[:, part.places[split]] for split, scores in last.items()}
        lines += [_split_line(split, scores) for split, scores in found.items() if scores.size]
    return "\n".join(lines)


def _split_line(split: str, scores: np.ndarray) -> str:
    return f"{split:15} {scores.shape[1]:5} {_interval(scores):>7}  {scores.mean(axis=0).min():.0f}"


def task_table(policy: Policy, episodes: dict[str, np.ndarray], named: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a table of returns (S, T, episodes) by family, split and task.

    Args:
        named: other names of splits.
    """
    called = lambda split: named.get(split, split)
    parts = policy.env.parts
    lines = []
    for part in parts:
        lines += [part.name] if part.name else []
        lines.append(f"{'split':15} {part.family.task_axis[0]:>10} {'return':>7}   episodes from, to")
        for split, returns in episodes.items():
            own = returns[:, part.places[split]]
            if not own.size:
                continue
            for label, task in zip(part.family.labels(split), np.moveaxis(own, 1, 0), strict=True):
                mean = _interval(task.mean(axis=-1, keepdims=True))
                lines.append(f"{called(split):15} {label:>10} {mean:>7}   {task.min():.0f}, {task.max():.0f}")
            lines.append(_all_line(called(split), own))
    if len(parts) > 1:
        lines.append("all families")
        lines += [_all_line(called(split), returns) for split, returns in episodes.items() if returns.size]
    return "\n".join(lines)


def _all_line(split: str, returns: np.ndarray) -> str:
    return f"{split:15} {'all':>10} {_interval(returns.mean(axis=-1)):>7}"
