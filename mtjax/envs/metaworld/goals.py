"""Goals as Meta-World's benchmarks draw them for a seed, number for number."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import islice
from typing import Any, Protocol

import numpy as np


class Drawn(Protocol):
    """What is known of a task's goals before any is drawn."""

    drawn: Any  # least and greatest vector

    def allowed(self, vec: np.ndarray) -> bool: ...


@lru_cache
def draw_goals(tasks: tuple[Drawn, ...], seed: int, count: int) -> tuple[np.ndarray, ...]:
    """Draw the vectors (count, K) of the goals of every task.

    It follows ``metaworld._make_tasks``: one stream of NumPy's first generator serves all tasks of a benchmark, one
    after another. To find a goal it resets an environment, which draws twice and keeps the second vector.
    """
    random = np.random.RandomState(seed)
    every_second = lambda found: [*islice(found, 1, 2 * count, 2)]
    return tuple(np.stack(every_second(_allowed(task, random))) for task in tasks)


def _allowed(task: Drawn, random: np.random.RandomState) -> Iterator[np.ndarray]:
    """Yield goals without end. Drawn vectors that are no goals are left out."""
    while True:
        if task.allowed(vec := random.uniform(*task.drawn)):
            yield vec
