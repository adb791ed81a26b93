"""What an environment and a batch of them share: the tasks they can enter, what is seen of them, and their stream."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from mtjax.names import nearest_error
from mtjax.types import Env, InputError, Task

TASK_OBS = ("context", "id", "none")


class TaskStream:
    """A random stream for tasks, apart from Gymnasium's own, which is for environments."""

    _np_random_task: np.random.Generator | None = None

    @property
    def np_random_task(self) -> np.random.Generator:
        """The generator that tasks are drawn with; of fresh entropy unless it was seeded."""
        if self._np_random_task is None:
            self.seed_task()
        return self._np_random_task  # type: ignore

    def seed_task(self, seed: int | None = None) -> None:
        """Start the stream of tasks anew; the task stays."""
        # With a spawn key of its own the stream differs from that of an environment with the same seed.
        self._np_random_task = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))


class TaskTable:
    """The tasks of a family as Gymnasium's users see them: a task's state is its row in the family's table, an int.

    Every task of the family can be entered, and so can each draw of a continuous range; ``split`` says which of them
    are sampled.
    """

    def __init__(self, family: Env, split: str, task_obs: str):
        if task_obs not in TASK_OBS:
            raise nearest_error("task_obs", task_obs, TASK_OBS)
        self._task_obs = task_obs
        listed = jax.tree.map(np.asarray, family.tasks("all"))
        chosen = np.asarray(family.tasks(split).id)
        if not len(chosen):
            raise InputError(f"this family has no {split} tasks")
        self._tasks = _with_draws(listed)
        rows = np.arange(len(self._tasks.id))
        # Where ranges are continuous, a listed task only stands for its draws.
        sampled = np.isin(self._tasks.id, chosen) & (rows >= (0 if listed.draws is None else len(listed.id)))
        self._sampled = rows[sampled]
        self.first = int(np.flatnonzero(listed.id == chosen[0])[0])
        self.chosen = np.flatnonzero(np.isin(listed.id, chosen))
        self.space = self._space(len(listed.id))

    def _space(self, count: int) -> spaces.Space:
        if self._task_obs == "id":
            return spaces.Discrete(count)
        size = self._tasks.context.shape[1] if self._task_obs == "context" else 0
        return spaces.Box(-np.inf, np.inf, (size,), np.float32)

    def observe(self, rows: Any) -> Any:
        """What may be seen of the tasks in ``rows`` (...): contexts (..., C), ids (...), or nothing (..., 0)."""
        if self._task_obs == "id":
            return np.int64(self._tasks.id[rows])
        return np.array(self._tasks.context[rows][..., : self.space.shape[0]])  # type: ignore

    def enter(self, rows: Any) -> Task:
        """The tasks in ``rows`` (...), on the device."""
        return jax.tree.map(lambda x: jnp.asarray(x[rows]), self._tasks)

    def describe(self, rows: Any) -> dict[str, Any]:
        """For ``info``: number and parameters of the tasks in ``rows`` (...)."""
        params = {name: _plain(x[rows]) for name, x in self._tasks.params.items()}
        return {"task_id": _plain(self._tasks.id[rows]), "params": params}

    def sample(self, random: np.random.Generator, count: int) -> list[int]:
        """Draw ``count`` task states; where ranges are continuous, with fresh values."""
        return random.choice(self._sampled, count).tolist()

    def check(self, state: Any) -> int:
        """Return a task state, or raise InputError if it is none."""
        if not isinstance(state, (int, np.integer)) or not 0 <= state < len(self._tasks.id):
            raise InputError(f"a task state is a row from 0 to {len(self._tasks.id) - 1}, not {state!r}")
        return int(state)


def _plain(value: Any) -> Any:
    """One task's as a number of Python's, several tasks' as an array."""
    return value.item() if value.ndim == 0 else value


def _with_draws(listed: Task) -> Task:
    """All tasks and then all of their draws, with the number of the task for which they are drawn, on one axis."""
    if listed.draws is None:
        return listed
    drawn = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), listed.draws)
    drawn = drawn._replace(id=np.repeat(listed.id, len(drawn.id) // len(listed.id)))
    return jax.tree.map(lambda *x: np.concatenate(x), listed._replace(draws=None), drawn)


def read_options(options: dict[str, Any] | None, allowed: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of a reset, or raise InputError for one that does not exist."""
    options = dict(options or {})
    unknown = next((name for name in options if name not in allowed), None)
    if unknown is not None:
        raise nearest_error("option of reset", unknown, allowed)
    return options
