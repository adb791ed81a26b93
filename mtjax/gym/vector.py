"""Many worlds of one family as a Gymnasium vector environment: one compiled program steps them all."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mtjax.gym.env import begin, draw_seeds, family_named, read_action, spaces_of
from mtjax.gym.tasks import TaskStream, TaskTable, read_options
from mtjax.types import Array, Env, InputError, Step


class Programs(NamedTuple):
    """A family's functions over worlds, mapped along one flat axis and compiled once for each number of worlds."""

    reset: Any  # tasks, seeds (worlds, 2) -> Step
    step: Any  # tasks, state, actions -> Step


@lru_cache
def _programs(family: Env) -> Programs:
    reset = jax.vmap(lambda task, seed: begin(family, task, seed))
    return Programs(jax.jit(reset), jax.jit(jax.vmap(family.step)))


@jax.jit
def _where(mask: Array, ours: Step, theirs: Step) -> Step:
    """Our step for the worlds in ``mask``, their step for the others."""
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
    """Return ``num_envs`` worlds of the family ``name``, or of MTEnv's ``name``, as a Gymnasium vector environment.

    Args:
        name: as ``mtjax.make`` knows it, or one of ``MTENV_IDS``.
        num_envs: worlds, spread evenly over the tasks.
        tasks: the split whose tasks the worlds hold: train, interpolation, extrapolation or all.
        task_obs: what is seen of the task: its context, its id, or none.
        resample_tasks: every episode has a task of its own, drawn from the split.
        settings: fields of the family.

    Raises:
        InputError: a name or a value is not one of these.
    """
    return FamilyVectorEnv(family_named(name, settings), num_envs, tasks, task_obs, resample_tasks)


class FamilyVectorEnv(TaskStream, VectorEnv):
    """Worlds of one family, each with a task of its own; ``FamilyEnv`` is the same for one world.

    Worlds are task-major: with T tasks world i holds task ``i * T // num_envs`` of the split, so that where T divides
    ``num_envs`` an array (num_envs, ...) reshapes to (T, num_envs // T, ...). Observations, task observations and task
    states have the worlds as leading axis. ``reset`` changes no task, unless every episode has its own.

    An episode that ends returns its own last observation; the next step ignores the world's action, starts it anew and
    returns its first observation with a reward of 0 (``AutoresetMode.NEXT_STEP``).
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
        self.family, self.num_envs, self._resample = family, num_envs, resample_tasks
        self._programs = _programs(family)
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}
        self._table = TaskTable(family, tasks, task_obs)
        self.single_observation_space, self.single_action_space = spaces_of(family, self._table)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.set_task_state(self._table.chosen[np.arange(num_envs) * len(self._table.chosen) // num_envs])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin an episode in every world, or in those of the option ``reset_mask`` (num_envs,).

        The other option is ``task_seed``.
        """
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
        """Advance every world one step under ``actions`` (num_envs, A), or start it anew if its episode has ended."""
        if self._step is None:
            raise gymnasium.error.ResetNeeded("call reset() first, and after each change of the tasks")
        step = self._programs.step(self._tasks, self._step.state, read_action(actions, self.action_space))
        self._elapsed += 1
        if self._ended.any():
            step = self._restart(self._ended, step)
        self._step = step
        reward, terminated = np.array(step.reward), np.array(step.terminated)
        truncated = self._elapsed >= self.family.episode_length
        self._ended = terminated | truncated
        return self._observe(step), reward, terminated, truncated, self._table.describe(self._rows)

    def get_task_obs(self) -> np.ndarray:
        """What may be seen of the present tasks."""
        return self._table.observe(self._rows)

    def get_task_state(self) -> list[int]:
        """All that is needed to enter the present tasks again."""
        return self._rows.tolist()

    def set_task_state(self, task_state: Sequence[int] | np.ndarray) -> None:
        """Enter a task in every world. The episodes of the former ones are over: reset next."""
        if len(task_state) != self.num_envs:
            raise InputError(f"give a task state for each of the {self.num_envs} worlds, not {len(task_state)}")
        self._enter(np.array([self._table.check(state) for state in task_state]))
        self._step: Step | None = None
        self._ended, self._elapsed = np.zeros(self.num_envs, bool), np.zeros(self.num_envs, int)

    def sample_task_state(self) -> list[int]:
        """Draw a task for every world from the tasks' stream, without entering it."""
        return self._table.sample(self.np_random_task, self.num_envs)

    def reset_task_state(self) -> None:
        """Draw a task for every world and enter it."""
        self.set_task_state(self.sample_task_state())

    def _enter(self, rows: np.ndarray) -> None:
        self._rows, self._tasks = rows, self._table.enter(rows)

    def _restart(self, worlds: np.ndarray, step: Step | None) -> Step:
        """Begin an episode in ``worlds`` (num_envs,) bool; the others stay where ``step`` brought them."""
        if self._resample:
            rows = self._rows.copy()
            rows[worlds] = self._table.sample(self.np_random_task, int(worlds.sum()))
            self._enter(rows)
        fresh = self._programs.reset(self._tasks, draw_seeds(self.np_random, self.num_envs))
        self._elapsed = np.where(worlds, 0, self._elapsed)
        return fresh if step is None else _where(worlds, fresh, step)

    def _observe(self, step: Step) -> dict[str, Any]:
        return {"env_obs": np.array(step.obs), "task_obs": self.get_task_obs()}
