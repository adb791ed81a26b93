"""Returns of a run as tables of text."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from mtjax.checks import amount
from mtjax.envs.family import Family
from mtjax.envs.task_table import Part
from mtjax.learning import trials
from mtjax.learning.evaluation import Evaluations, Scores, of_tasks
from mtjax.report.stats import seed_interval
from mtjax.saved.policy import Policy

_SUCCESS = ("success", "success_ever")  # at the end of episodes, and at any step
_TOLD = "  success, at any step"


def _interval(scores: np.ndarray) -> str:
    """Return the mean of scores (S, T) as text, with its 95% interval if there are enough seeds for one."""
    point, low, high = seed_interval(scores)
    return f"{amount(point):>6}" + (f"  [{amount(low)}, {amount(high)}]" if np.isfinite(low) else "")


def split_table(evaluations: Evaluations, parts: Sequence[Part] = ()) -> str:
    """Return a run's last evaluation as text: mean and worst task's return by split; of a mixture also by family.

    Where tasks tell success, its share at the end of episodes and at any step follow.
    """
    scores = [evaluations.returns, *(evaluations.metrics.get(name, {}) for name in _SUCCESS)]
    last = {  # each (S, T)
        split: [x[split][:, -1].mean(axis=-1) for x in scores if split in x]
        for split, returns in evaluations.returns.items()
        if returns.size
    }
    told = _TOLD if evaluations.metrics.get("success") else ""
    lines = [f"{'split':15} {'tasks':>5} {'return':>7}  worst task{told}"]
    lines += [_split_line(split, *found) for split, found in last.items()]
    lines += _trial_lines(
        *({split: x[:, -1] for split, x in found.items()} for found in scores), trial=evaluations.trial
    )
    for part in parts if len(parts) > 1 else ():
        lines.append(part.name)
        own = {split: [x[:, part.places[split]] for x in found] for split, found in last.items()}
        lines += [_split_line(split, *found) for split, found in own.items() if found[0].size]
    return "\n".join(lines)


def _trial_lines(returns: Mapping[str, np.ndarray], *success: Mapping[str, np.ndarray], trial: int) -> list[str]:
    """Return lines for each split with the first and the last episode of trials, if these are several.

    Where tasks tell success, lines of its share at the end and at any step of episodes follow that of the return.
    """
    lines = [f"{split:15} {trials.describe(x, trial)}" for split, x in returns.items() if x.size and trial > 1]
    for of, found in zip(("at the end", "at any step"), success, strict=False):
        known = {split: x for split, x in found.items() if np.isfinite(x).any() and trial > 1}
        lines += [f"{split:15} success {of}: {trials.describe(x, trial)}" for split, x in known.items()]
    return lines


def _split_line(split: str, returns: np.ndarray, *success: np.ndarray) -> str:
    line = f"{split:15} {returns.shape[1]:5} {_interval(returns):>7}  {amount(returns.mean(axis=0).min()):<10}"
    known = [x[np.isfinite(x)] for x in success]  # of a mixture, some families may not tell
    return line.rstrip() if not known or not known[0].size else line + "".join(f"  {x.mean():7.2f}" for x in known)


def task_table(policy: Policy, scores: dict[str, Scores], named: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a table of returns by family, split and task, and of success where tasks tell it.

    Args:
        named: other names of splits.
    """
    called = lambda split: named.get(split, split)
    parts = policy.env.parts
    lines = []
    for part in parts:
        lines += [part.name] if part.name else []
        names = {split: _task_names(part.family, split) for split in scores}
        width = max(10, *(len(name) for own in names.values() for name in own))
        own = {split: of_tasks(found, part.places[split]) for split, found in scores.items()}
        told = _TOLD if any(map(_success, own.values())) else ""
        head = f"{'split':15} {part.family.task_axis[0]:>{width}} {'return':>7}{told}"
        lines.append(f"{head}   episodes from, to")
        for split, found in own.items():
            for t, name in enumerate(names[split]):
                task = of_tasks(found, [t])
                ends = f"{amount(task.returns.min())}, {amount(task.returns.max())}"
                lines.append(f"{_mean_line(called(split), name, task, width):<{len(head)}}   {ends}")
            lines += [_mean_line(called(split), "all", found, width)] if found.returns.size else []
    if len(parts) > 1:
        lines.append("all families")
        lines += [_mean_line(called(split), "all", found) for split, found in scores.items() if found.returns.size]
    every = [{called(split): one.returns for split, one in scores.items()}]
    known = [name for name in _SUCCESS if all(name in one.metrics for one in scores.values())]
    every += [{called(split): one.metrics[name] for split, one in scores.items()} for name in known]
    lines += _trial_lines(*every, trial=policy.trial)
    return "\n".join(lines)


def _mean_line(split: str, name: str, scores: Scores, width: int = 10) -> str:
    return f"{split:15} {name:>{width}} {_interval(scores.returns.mean(axis=-1)):>7}{_success(scores)}"


def _success(scores: Scores) -> str:
    """Return the shares of success as text. Of a mixture some families may not tell it."""
    known = [x[np.isfinite(x)] for name in _SUCCESS if (x := scores.metrics.get(name)) is not None]
    return "".join(f"  {x.mean():7.2f}" for x in known if x.size)


def _task_names(family: Family, split: str) -> list[str]:
    """Return the value of the varied parameter in every task of a split; of several, each with its name."""
    if len(family.varied) < 2:
        return family.labels(split)
    return [family.describe(row) for row in family.table.rows[split].tolist()]
