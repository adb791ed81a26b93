"""A Gymnasium vector environment of many worlds of a family, stepped by one compiled program."""

from collections.abc import Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mtjax.gym.env import begin, draw_seeds, family_named, observed, played, read_action, require_no_fork, spaces_of
from mtjax.gym.tasks import TaskStream, TaskTable, read_options
from mtjax.types import Array, Env, InputError, Step


class Programs(NamedTuple):
    """The jitted functions of a family, mapped over worlds and compiled once for each number of worlds."""

    reset: Any  # tasks, seeds (worlds, 2) -> Step
    step: Any  # tasks, state, actions -> Step


@lru_cache
def _programs(family: Env) -> Programs:
    reset = jax.vmap(lambda task, seed: begin(family, task, seed))
    return Programs(jax.jit(reset), jax.jit(jax.vmap(family.step)))


@jax.jit
def _where(mask: Array, ours: Step, theirs: Step) -> Step:
    """Return ``ours`` for the worlds in ``mask`` and ``theirs`` for the others."""
    pick = lambda x, y: jnp.where(mask.reshape(mask.shape + (1,) * (x.ndim - 1)), x, y)
    return jax.tree.map(pick, ours, theirs)


def make_vec(
    name: str,
    num_envs: int = 1,
    *,
    tasks: str = "train",
    task_obs: str = "context",
    resample_tasks: bool = False,
    **settings: Any,
) -> "FamilyVectorEnv":
    """Return many worlds of a family as a Gymnasium vector environment.

    Args:
        name: a name of ``mtjax.make``, or one of ``MTENV_IDS`` (see ``mtjax.gym.make``).
        num_envs: number of worlds, spread evenly over the tasks.
        tasks: the split of the worlds' tasks: train, interpolation, extrapolation or all.
        task_obs: the observation of the task: "context", "id" or "none".
        resample_tasks: draw a new task from the split for every episode.
        settings: fields of the family.

    Raises:
        InputError: a name or a value is not one of these.
    """
    return FamilyVectorEnv(family_named(name, settings), num_envs, tasks, task_obs, resample_tasks)


class FamilyVectorEnv(TaskStream, VectorEnv):
    """Worlds of one family, each with its own task. ``FamilyEnv`` is the same for one world.

    Worlds are task-major: with T tasks, world i has task ``i * T // num_envs`` of the split. If T divides ``num_envs``,
    an array (num_envs, ...) reshapes to (T, num_envs // T, ...). Worlds are the leading axis of observations, task
    observations and task states. ``reset`` changes no task unless ``resample_tasks`` is set.

    The last step of an episode returns the episode's own last observation. The next step ignores the world's action,
    begins a new episode and returns its first observation with a reward of 0 (``AutoresetMode.NEXT_STEP``).
    """

    def __init__(
        self,
        family: Env,
        num_envs: int,
        tasks: str = "train",
        task_obs: str = "context",
        resample_tasks: bool = False,
    ):
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, not {num_envs}")
        require_no_fork()
        self.family, self.num_envs, self._resample = family, num_envs, resample_tasks
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self._table = TaskTable(family, tasks, task_obs)
        self.single_observation_space, self.single_action_space = spaces_of(played(family), self._table)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.set_task_state(self._table.chosen[np.arange(num_envs) * len(self._table.chosen) // num_envs])

    @cached_property
    def _programs(self) -> Programs:
        return _programs(played(self.family))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin an episode in every world, or in the worlds of the option ``reset_mask`` (num_envs,) bool.

        The other option is ``task_seed``.
        """
        require_no_fork()
        super().reset(seed=seed)
        options = read_options(options, ("task_seed", "reset_mask"))
        if "task_seed" in options:
            self.seed_task(options["task_seed"])
        everywhere = np.ones(self.num_envs, bool)
        worlds = np.asarray(options.get("reset_mask", everywhere))
        if worlds.shape != (self.num_envs,) or worlds.dtype != bool:
            raise InputError(f"reset_mask must be {self.num_envs} bools, not {worlds.dtype} of shape {worlds.shape}")
        if self._step is None:
            worlds = everywhere
        self._step = self._restart(worlds, self._step)
        self._ended = self._ended & ~worlds
        return self._observe(self._step), self._table.describe(self._rows)

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Advance every world one step under ``actions`` (num_envs, A). Worlds whose episode has ended are reset."""
        if self._step is None:
            raise gymnasium.error.ResetNeeded("call reset() first, and after each change of the tasks")
        step = self._programs.step(self._tasks, self._step.state, read_action(actions, self.action_space))
        self._elapsed += 1
        if self._ended.any():
            step = self._restart(self._ended, step)
        self._step = step
        reward, terminated = np.array(step.reward), np.array(step.terminated)
        cut_off = False if step.truncated is None else np.asarray(step.truncated)
        truncated = (self._elapsed >= self.family.episode_length) | cut_off
        self._ended = terminated | truncated
        info = self._table.describe(self._rows) | {name: np.array(x) for name, x in step.metrics.items()}
        return self._observe(step), reward, terminated, truncated, info

    def get_task_obs(self) -> np.ndarray:
        """Return the observation of the current tasks."""
        return self._table.observe(self._rows)

    def get_task_state(self) -> list[int]:
        """Return the states of the current tasks, from which they can be entered again."""
        return self._rows.tolist()

    def set_task_state(self, task_state: Sequence[int] | np.ndarray) -> None:
        """Enter a task in every world. This ends all episodes; call ``reset`` next."""
        if len(task_state) != self.num_envs:
            raise InputError(f"give a task state for each of the {self.num_envs} worlds, not {len(task_state)}")
        self._enter(np.array([self._table.check(state) for state in task_state]))
        self._step: Step | None = None
        self._ended, self._elapsed = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, int)

    def sample_task_state(self) -> list[int]:
        """Draw a task for every world from the tasks' random stream without entering it."""
        return self._table.sample(self.np_random_task, self.num_envs)

    def reset_task_state(self) -> None:
        """Draw a task for every world and enter it."""
        self.set_task_state(self.sample_task_state())

    def _enter(self, rows: np.ndarray) -> None:
        self._rows, self._tasks = rows, self._table.enter(rows)

    def _restart(self, worlds: np.ndarray, step: Step | None) -> Step:
        """Begin an episode in ``worlds`` (num_envs,) bool. The others keep their state in ``step``."""
        if self._resample:
            rows = self._rows.copy()
            rows[worlds] = self._table.sample(self.np_random_task, int(worlds.sum()))
            self._enter(rows)
        fresh = self._programs.reset(self._tasks, draw_seeds(self.np_random, self.num_envs))
        self._elapsed = np.where(worlds, 0, self._elapsed)
        if step is None:
            return fresh
        return _where(worlds, fresh._replace(metrics=jax.tree.map(jnp.zeros_like, step.metrics)), step)

    def _observe(self, step: Step) -> dict[str, Any]:
        return {"env_obs": observed(step.obs), "task_obs": self.get_task_obs()}
