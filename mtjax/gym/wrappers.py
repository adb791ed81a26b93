"""Wrappers that choose tasks, and one that gives any Gymnasium environment MTEnv's interface."""

import copy
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs

from mtjax.gym.tasks import TaskStream
from mtjax.types import InputError

_MAX_DRAWS = 100  # for each task of a bag, before giving up


class TaskWrapper(gymnasium.Wrapper):
    """A wrapper that passes MTEnv's methods on to the environment inside, through other wrappers."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Begin an episode. The option ``task_seed`` seeds the tasks' random stream first."""
        options = dict(options or {})
        if "task_seed" in options:
            self.seed_task(options.pop("task_seed"))
        self._choose_task()
        obs, info = self.env.reset(seed=seed, options=options)
        return self._see(obs), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict]:
        """Advance one step."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        return self._see(obs), reward, terminated, truncated, info

    @property
    def np_random_task(self) -> np.random.Generator:
        """Return the generator of the tasks."""
        return self.env.get_wrapper_attr("np_random_task")

    def seed_task(self, seed: int | None = None) -> None:
        """Restart the tasks' random stream."""
        self.env.get_wrapper_attr("seed_task")(seed)

    def get_task_obs(self) -> Any:
        """Return the observation of the current task."""
        return self.env.get_wrapper_attr("get_task_obs")()

    def get_task_state(self) -> Any:
        """Return the state of the current task, from which it can be entered again."""
        return self.env.get_wrapper_attr("get_task_state")()

    def set_task_state(self, task_state: Any) -> None:
        """Enter a task."""
        self.env.get_wrapper_attr("set_task_state")(task_state)

    def sample_task_state(self) -> Any:
        """Draw a task without entering it."""
        return self.env.get_wrapper_attr("sample_task_state")()

    def reset_task_state(self) -> None:
        """Draw a task and enter it."""
        self.set_task_state(self.sample_task_state())

    def _choose_task(self) -> None:
        """Change the task before a reset. By default do nothing."""

    def _see(self, obs: Any) -> Any:
        """Return the observation that the wrapper shows. It must not change ``obs`` in place."""
        return obs


class SampleRandomTask(TaskWrapper, RecordConstructorArgs):
    """A wrapper that draws a new task at every reset."""

    def __init__(self, env: gymnasium.Env):
        RecordConstructorArgs.__init__(self)
        super().__init__(env)

    def _choose_task(self) -> None:
        self.reset_task_state()


class NTasks(TaskWrapper, RecordConstructorArgs):
    """A wrapper that draws tasks from a fixed bag of ``n`` different tasks.

    The bag is drawn when it is first needed. ``seed_task`` decides its content, and draws a new bag. The bag's first
    task is the current one until another is set.
    """

    def __init__(self, env: gymnasium.Env, n: int):
        RecordConstructorArgs.__init__(self, n=n)
        super().__init__(env)
        if n < 1:
            raise InputError(f"a bag holds at least 1 task, not {n}")
        self.n = n
        self._bag: list[Any] = []
        self._entered = False

    @property
    def tasks(self) -> list[Any]:
        """Return the states of the ``n`` tasks."""
        if not self._bag:
            self._bag = self._draw_bag()
        return list(self._bag)

    def seed_task(self, seed: int | None = None) -> None:
        """Restart the tasks' random stream, and draw a new bag. Its first task becomes the current one."""
        super().seed_task(seed)
        self._bag, self._entered = [], False

    def get_task_obs(self) -> Any:
        """Return the observation of the current task."""
        self._choose_task()
        return super().get_task_obs()

    def get_task_state(self) -> Any:
        """Return the state of the current task, from which it can be entered again."""
        self._choose_task()
        return super().get_task_state()

    def set_task_state(self, task_state: Any) -> None:
        """Enter a task, of the bag or not."""
        super().set_task_state(task_state)
        self._entered = True

    def sample_task_state(self) -> Any:
        """Draw a task of the bag without entering it."""
        return self.tasks[self.np_random_task.integers(self.n)]

    def _choose_task(self) -> None:
        if not self._entered:
            self.set_task_state(self.tasks[0])

    def _draw_bag(self) -> list[Any]:
        draw, bag = self.env.get_wrapper_attr("sample_task_state"), []
        for _ in range(_MAX_DRAWS * self.n):
            state = draw()
            if not any(_same(state, other) for other in bag):
                bag.append(state)
            if len(bag) == self.n:
                return bag
        raise InputError(f"found only {len(bag)} different tasks for a bag of {self.n}")


class NTasksId(NTasks):
    """A fixed bag of ``n`` tasks. The state and the observation of a task are its place in the bag, an int."""

    def __init__(self, env: gymnasium.Env, n: int):
        super().__init__(env, n)
        inner = env.observation_space
        if not isinstance(inner, spaces.Dict):
            raise InputError(f"observations must have env_obs and task_obs, and the space is {inner}")
        self.observation_space = spaces.Dict({**inner.spaces, "task_obs": spaces.Discrete(n)})
        self._place = 0

    def get_task_obs(self) -> np.int64:
        """Return the task's place in the bag."""
        return np.int64(self.get_task_state())

    def get_task_state(self) -> int:
        """Return the task's place in the bag."""
        self._choose_task()
        return self._place

    def set_task_state(self, task_state: int) -> None:
        """Enter the task in this place of the bag."""
        if not isinstance(task_state, (int, np.integer)) or not 0 <= task_state < self.n:
            raise InputError(f"a task state is a place in the bag from 0 to {self.n - 1}, not {task_state!r}")
        super().set_task_state(self.tasks[task_state])
        self._place = int(task_state)

    def sample_task_state(self) -> int:
        """Draw a place in the bag."""
        return int(self.np_random_task.integers(self.n))

    def _choose_task(self) -> None:
        if not self._entered:
            self.set_task_state(0)

    def _see(self, obs: dict[str, Any]) -> dict[str, Any]:
        return {**obs, "task_obs": self.get_task_obs()}


class EnvToMTEnv(TaskStream, TaskWrapper, RecordConstructorArgs):
    """A wrapper that gives any Gymnasium environment MTEnv's interface.

    The state of a task is an element of ``task_observation_space``, and is also its observation. Entering a task calls
    ``apply_task(env.unwrapped, task_state)``; without ``apply_task`` tasks differ in name alone. The first task is
    drawn when it is needed. If agents may not see the whole state, override ``get_task_obs`` and
    ``sample_task_state``.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        task_observation_space: spaces.Space,
        apply_task: Callable[[gymnasium.Env, Any], None] | None = None,
    ):
        RecordConstructorArgs.__init__(self, task_observation_space=task_observation_space, apply_task=apply_task)
        TaskWrapper.__init__(self, env)
        self._task_space = copy.deepcopy(task_observation_space)
        self._apply_task = apply_task
        self._task_state: Any = None
        self.observation_space = spaces.Dict({"env_obs": env.observation_space, "task_obs": task_observation_space})

    def get_task_obs(self) -> Any:
        """Return the observation of the current task, which is its state."""
        return self.get_task_state()

    def get_task_state(self) -> Any:
        """Return the state of the current task, from which it can be entered again."""
        self._choose_task()
        return copy.deepcopy(self._task_state)

    def set_task_state(self, task_state: Any) -> None:
        """Enter a task."""
        self._task_state = copy.deepcopy(task_state)
        if self._apply_task is not None:
            self._apply_task(self.env.unwrapped, task_state)

    def sample_task_state(self) -> Any:
        """Draw a task without entering it."""
        self._task_space.seed(int(self.np_random_task.integers(2**31)))
        return self._task_space.sample()

    def _choose_task(self) -> None:
        if self._task_state is None:
            self.reset_task_state()

    def _see(self, obs: Any) -> dict[str, Any]:
        return {"env_obs": obs, "task_obs": self.get_task_obs()}


def _same(one: Any, other: Any) -> bool:
    same_shape = jax.tree.structure(one) == jax.tree.structure(other)
    return same_shape and all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))
