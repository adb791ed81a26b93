"""A Gymnasium environment of one world of a family, with MTEnv's interface."""

import os
from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import gymnasium
import jax
import numpy as np
from gymnasium import spaces

from mtjax import envs
from mtjax.envs.mixtures import require_family
from mtjax.envs.pixels import Drawable
from mtjax.frames import PICTURES, shown
from mtjax.gym.tasks import TaskStream, TaskTable, read_options
from mtjax.names import nearest_error
from mtjax.report import render
from mtjax.types import Action, Array, Discrete, Env, InputError, MultiDiscrete, Step, Task

MTENV_IDS = {
    "MT-CartPole-v0": "control-cartpole",
    "MT-Acrobat-v0": "control-acrobot",  # MTEnv spells it so
    "MT-TabularMDP-v0": "tabular-mdp",
    "MT-TwoGoalMaze-v0": "two-goal-maze",
    "MT-HiPBMDP-Finger-Spin-vary-size-v0": "finger-spin-vary-touch-size",
    "MT-HiPBMDP-Cheetah-Run-vary-torso-length-v0": "cheetah-run-vary-torso-length",
    "MT-HiPBMDP-Walker-Walk-vary-friction-v0": "walker-walk-vary-friction",
    "MT-HiPBMDP-Walker-Walk-vary-len-v0": "walker-walk-vary-foot-length",
}
_SEEN = "MT-HiPBMDP-"
_AS_SEEN: dict[str, Any] = {"pixels": 84, "frames": 3, "repeat": 2}  # as MTEnv shows these families
_METAWORLD = "MT-MetaWorld-"


class Programs(NamedTuple):
    """The jitted functions of a family, shared by all its environments."""

    reset: Any  # task, seed (2,) uint32 -> Step
    step: Any  # task, state, action -> Step


@lru_cache
def _home() -> int:
    """Return the process that first made an environment, also in its forks."""
    return os.getpid()


def require_no_fork() -> None:
    """Refuse a fork of a process in which JAX runs: its threads are missing there, and the first call would hang.

    Raises:
        InputError: this process is one.
    """
    if _home() != os.getpid():
        raise InputError(
            "JAX hangs in a forked process: give vectorization_mode='vector_entry_point', which steps all worlds in "
            "one program, or vector_kwargs={'context': 'spawn'} beside 'async'"
        )


def begin(family: Env, task: Task, seed: Array) -> Step:
    """Begin an episode with the random key ``seed`` (2,) uint32."""
    return family.reset(task, jax.random.wrap_key_data(seed, impl="threefry2x32"))


@lru_cache
def _programs(family: Env) -> Programs:
    return Programs(jax.jit(lambda task, seed: begin(family, task, seed)), jax.jit(family.step))


def draw_seeds(random: np.random.Generator, *shape: int) -> np.ndarray:
    """Draw the seeds (..., 2) of episodes."""
    return random.integers(2**32, size=(*shape, 2), dtype=np.uint32)


def spaces_of(family: Env, table: TaskTable) -> tuple[spaces.Dict, spaces.Space]:
    """Return the observation space and the action space of one world."""
    obs = spaces.Dict({"env_obs": _space_of(family.spec.obs), "task_obs": table.space})
    return obs, _space_of_actions(family.spec.action)


def _space_of_actions(action: Action) -> spaces.Space:
    match action:
        case Discrete(size):
            return spaces.Discrete(size)
        case MultiDiscrete(sizes):
            return spaces.MultiDiscrete(list(sizes))
    return spaces.Box(-1.0, 1.0, action.shape, np.float32)


def _space_of(obs: Any) -> spaces.Space:
    """Return the space of an array, or of a dictionary or tuple of spaces; pictures alone are no dictionary."""
    if _pictures_alone(obs):
        return _space_of(obs[PICTURES])
    if isinstance(obs, Mapping):
        return spaces.Dict({str(name): _space_of(x) for name, x in obs.items()})
    if isinstance(obs, tuple | list):
        return spaces.Tuple(map(_space_of, obs))
    if obs.dtype == np.bool_:
        return spaces.MultiBinary(obs.shape)
    if np.issubdtype(obs.dtype, np.integer):
        known = np.iinfo(obs.dtype)
        return spaces.Box(known.min, known.max, obs.shape, obs.dtype.type)
    return spaces.Box(-np.inf, np.inf, obs.shape, np.float32)


def _pictures_alone(obs: Any) -> bool:
    return shown(obs) and len(obs) == 1


def observed(obs: Any) -> Any:
    """Return an observation on the host, in the form of its space."""
    obs = obs[PICTURES] if _pictures_alone(obs) else obs
    return jax.tree.map(np.array, obs)


def played(family: Env) -> Any:
    """Return what Gymnasium steps: a family, or one with pictures whose observations hold the last few of them."""
    return envs.stacked(family) if shown(family.spec.obs) else family


def read_action(action: Any, space: spaces.Space) -> np.ndarray:
    """Return actions as float32, or as int32 if they are discrete.

    Raises:
        InputError: their shape is not that of the space, or they are none of the choices.
    """
    action, chosen = np.asarray(action), np.issubdtype(space.dtype, np.integer)
    if action.shape != space.shape:
        raise InputError(f"an action has the shape {space.shape}, not {action.shape}")
    if chosen and not (np.issubdtype(action.dtype, np.integer) and space.contains(action.astype(space.dtype)[()])):
        raise InputError(f"an action is one of {space}, not {action}")
    return action.astype(np.int32 if chosen else np.float32)


def family_named(name: str, settings: dict[str, Any]) -> Env:
    """Return the family with a name of mtjax, or of MTEnv and then with its settings."""
    if name.startswith(_METAWORLD):
        raise InputError(f"{name}: each task of Meta-World is an environment here, such as 'metaworld-reach'")
    if name.startswith("MT-") and name not in MTENV_IDS:
        raise nearest_error("environment of MTEnv", name, MTENV_IDS)
    family = envs.make(MTENV_IDS.get(name, name), **(_AS_SEEN if name.startswith(_SEEN) else {}) | settings)
    require_family(family, "Gymnasium's environments have one space of observations and one of actions")
    return family


def make(
    name: str, *, tasks: str = "train", task_obs: str = "context", render_mode: str | None = None, **settings: Any
) -> "FamilyEnv":
    """Return a family as a Gymnasium environment.

    Args:
        name: a name of ``mtjax.make``, or one of ``MTENV_IDS``. As in MTEnv, the families of HiP-BMDP then show
            pictures of 84 x 84 and take each action for two steps; ``pixels=0`` shows the state.
        tasks: the split from which tasks are drawn: train, interpolation, extrapolation or all.
        task_obs: the observation of the task: "context", "id" or "none".
        render_mode: "rgb_array" for families whose worlds can be drawn, or None.
        settings: fields of the family.

    Raises:
        InputError: a name or a value is not one of these.
    """
    return FamilyEnv(family_named(name, settings), tasks, task_obs, render_mode)


class FamilyEnv(TaskStream, gymnasium.Env):
    """A family with MTEnv's interface. ``reset`` begins an episode of the current task and never changes the task.

    Observation: ``env_obs`` (O,) is the observation of the world, or its last pictures (H, W, N C), newest last.
        ``task_obs`` is that of the task: its context (C,), its number among all tasks of the family, or nothing (0,).
    Action: (A,) in [-1, 1], or the numbers of choices. A time limit truncates.
    Task state: an int. With the family's settings it identifies the task. The environment starts with the first task
        of the split. After a change of the task call ``reset`` before ``step``.
    Random streams: ``reset(seed=...)`` seeds that of the environment; ``seed_task(seed)`` or
        ``reset(options={"task_seed": seed})`` seeds that of the tasks. Unseeded streams start from fresh entropy.
    Info: ``task_id`` is the task's number, ``params`` its parameters in SI units. After a step it has the family's
        metrics too, such as ``success``.
    """

    def __init__(self, family: Env, tasks: str = "train", task_obs: str = "context", render_mode: str | None = None):
        require_no_fork()
        self.family, self.render_mode = family, render_mode
        self.metadata = _metadata(family)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(
                f"render_mode must be one of {[None, *self.metadata['render_modes']]}, not {render_mode!r}"
            )
        self._table = TaskTable(family, tasks, task_obs)
        self.observation_space, self.action_space = spaces_of(played(family), self._table)
        self._elapsed = 0
        self.set_task_state(self._table.first)

    @cached_property
    def _programs(self) -> Programs:
        return _programs(played(self.family))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        """Begin an episode of the current task. The only option is ``task_seed``."""
        require_no_fork()
        super().reset(seed=seed)
        options = read_options(options, ("task_seed",))
        if "task_seed" in options:
            self.seed_task(options["task_seed"])
        self._step, self._elapsed = self._programs.reset(self._task, draw_seeds(self.np_random)), 0
        return self._observe(), self._table.describe(self._row)

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """Advance one step under ``action`` (A,)."""
        if self._step is None:
            raise gymnasium.error.ResetNeeded("call reset() first, and after each change of the task")
        step = self._programs.step(self._task, self._step.state, read_action(action, self.action_space))
        self._step, self._elapsed = step, self._elapsed + 1
        truncated = self._elapsed >= self.family.episode_length or bool(step.truncated)
        info = self._table.describe(self._row) | {name: float(x) for name, x in step.metrics.items()}
        return self._observe(), float(step.reward), bool(step.terminated), truncated, info

    def render(self) -> np.ndarray | None:
        """Return a picture (height, width, 3) uint8 of the world as it is now."""
        if self.render_mode is None or self._step is None:
            raise InputError("to draw, give render_mode='rgb_array' to make, and reset first")
        state = self._step.state.world if shown(self.family.spec.obs) else self._step.state
        return render.film(self.family, int(self._task.row), jax.tree.map(lambda x: x[None], state))[0]  # type: ignore

    def get_task_obs(self) -> Any:
        """Return the observation of the current task."""
        return self._table.observe(self._row)

    def get_task_state(self) -> int:
        """Return the state of the current task, from which it can be entered again."""
        return self._row

    def set_task_state(self, task_state: int) -> None:
        """Enter a task. This ends the episode; call ``reset`` next."""
        self._row = self._table.check(task_state)
        self._task = self._table.enter(self._row)
        self._step: Step | None = None

    def sample_task_state(self) -> int:
        """Draw a task from the tasks' random stream without entering it."""
        return self._table.sample(self.np_random_task, 1)[0]

    def reset_task_state(self) -> None:
        """Draw a task and enter it."""
        self.set_task_state(self.sample_task_state())

    def _observe(self) -> dict[str, Any]:
        return {"env_obs": observed(self._step.obs), "task_obs": self.get_task_obs()}  # type: ignore


def _metadata(family: Env) -> dict[str, Any]:
    if not (isinstance(family, Drawable) and family.films):
        return {"render_modes": []}
    return {
        "render_modes": ["rgb_array"],
        "render_fps": round(family.film_speed / family.seconds_per_step),
    }
