"""Measures of learning tasks one after another, from evaluations of all tasks (Continual World; Wolczyk et al. 2021).

Scores p_i are from 0 to 1, such as success; returns are divided by what a good policy earns. Of N tasks the i-th is
learned while evaluations ``spans[i]`` take place, the last of them where it ends.
"""

from collections.abc import Sequence

import numpy as np

Spans = Sequence[slice]


def spans_of(evaluations: int, tasks: int) -> list[slice]:
    """Return which evaluations fall into each of the tasks, which take equally long, the first evaluation after a part.

    Raises:
        ValueError: tasks do not have equally many evaluations.
    """
    each, rest = divmod(evaluations, tasks)
    if rest or not each:
        raise ValueError(f"{evaluations} evaluations are not equally many for each of {tasks} tasks")
    return [slice(i * each, (i + 1) * each) for i in range(tasks)]


def performance(scores: np.ndarray) -> np.ndarray:
    """Return the mean score (S,) of all tasks at the end: 1 / N sum_i p_i(T), from scores (S, V, N)."""
    return scores[:, -1].mean(axis=-1)


def forgetting(scores: np.ndarray, spans: Spans) -> np.ndarray:
    """Return F_i = p_i(end of i) - p_i(T) (S, N), from scores (S, V, N). It is 0 for the last task."""
    ends = [span.stop - 1 for span in spans]
    return np.stack([scores[:, end, i] - scores[:, -1, i] for i, end in enumerate(ends)], axis=-1)


def areas(scores: np.ndarray, spans: Spans) -> np.ndarray:
    """Return AUC_i (S, N), the mean score of each task over the evaluations in which it is learned."""
    return np.stack([scores[:, span, i].mean(axis=-1) for i, span in enumerate(spans)], axis=-1)


def forward_transfer(areas: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Return FT_i = (AUC_i - AUC_i^alone) / (1 - AUC_i^alone) (S, N), given areas (S, N) in sequence and alone.

    It is NaN for a task that has the best score from the start when it is learned alone.
    """
    room = 1 - alone
    return np.where(room > 0, (areas - alone) / np.where(room > 0, room, 1), np.nan)
