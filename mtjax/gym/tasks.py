"""Tasks of a single or a vector environment: their table, their observation and their random stream."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from mtjax.names import nearest_error
from mtjax.tasks import contexts_vary
from mtjax.types import Env, InputError, Task

TASK_OBS = ("context", "id", "none")


class TaskStream:
    """A random stream for tasks, separate from Gymnasium's own stream for environments.

    Environments derived from it can be pickled: ``_programs``, a cached property, is made again in the copy.
    """

    _np_random_task: np.random.Generator | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_programs"}

    @property
    def np_random_task(self) -> np.random.Generator:
        """Return the generator of the tasks. It has fresh entropy unless it was seeded."""
        if self._np_random_task is None:
            self.seed_task()
        return self._np_random_task  # type: ignore

    def seed_task(self, seed: int | None = None) -> None:
        """Restart the tasks' random stream. The current task stays."""
        # With a spawn key of its own the stream differs from that of an environment with the same seed.
        self._np_random_task = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))


class TaskTable:
    """The tasks of a family for Gymnasium. The state of a task is an int: its row in the family's table.

    Every task of the family can be entered, and so can each draw of a continuous range. Tasks are drawn from ``split``
    only.
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
        # A task with continuous ranges only stands for its draws.
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
        """Return the observation of the tasks in ``rows`` (...): contexts (..., C), ids (...), or nothing (..., 0)."""
        if self._task_obs == "id":
            return np.int64(self._tasks.id[rows])
        return np.array(self._tasks.context[rows][..., : self.space.shape[0]])  # type: ignore

    def enter(self, rows: Any) -> Task:
        """Return the tasks in ``rows`` (...) on the device."""
        return jax.tree.map(lambda x: jnp.asarray(x[rows]), self._tasks)

    def describe(self, rows: Any) -> dict[str, Any]:
        """Return number and parameters of the tasks in ``rows`` (...), for ``info``."""
        params = {name: _plain(x[rows]) for name, x in self._tasks.params.items()}
        return {"task_id": _plain(self._tasks.id[rows]), "params": params}

    def sample(self, random: np.random.Generator, count: int) -> list[int]:
        """Draw ``count`` task states. Continuous ranges get new values."""
        return random.choice(self._sampled, count).tolist()

    def check(self, state: Any) -> int:
        """Return a task state as an int, or raise InputError if it is not valid."""
        if not isinstance(state, (int, np.integer)) or not 0 <= state < len(self._tasks.id):
            raise InputError(f"a task state is a row from 0 to {len(self._tasks.id) - 1}, not {state!r}")
        return int(state)


def _plain(value: Any) -> Any:
    """Return the value of one task as a Python number, of several tasks as an array."""
    return value.item() if value.ndim == 0 else value


def _with_draws(listed: Task) -> Task:
    """Return all tasks and then all their draws on one axis. A draw has the number of its task."""
    if listed.draws is None:
        return listed
    drawn = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), listed.draws)
    of_tasks = lambda x: np.repeat(x, len(drawn.id) // len(listed.id), axis=0)
    context = drawn.context if contexts_vary(listed) else of_tasks(listed.context)
    drawn = drawn._replace(id=of_tasks(listed.id), context=context)
    return jax.tree.map(lambda *x: np.concatenate(x), listed._replace(draws=None), drawn)


def read_options(options: dict[str, Any] | None, allowed: tuple[str, ...]) -> dict[str, Any]:
    """Return the options of a reset, or raise InputError for one that does not exist."""
    options = dict(options or {})
    unknown = next((name for name in options if name not in allowed), None)
    if unknown is not None:
        raise nearest_error("option of reset", unknown, allowed)
    return options
