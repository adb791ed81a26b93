"""Probe environments: tiny problems with known Q-values. Each tests one part of a learner.

They are Andy Jones' five, with a task axis and a time limit. A probe is data, like a task, so one compiled program
serves all of them. Use them to check an agent of your own: train it on ``Probe(kind)``, and compare its values with
those in the docstrings of the rules.
"""

import dataclasses
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.parallel import axes
from mtjax.types import Array, Key, Spec, Step, Task

AFTER = 5.0
"""The observation after an episode has terminated, when its value must not matter."""
LIMIT = 2
"""Steps after which an episode is cut off."""
SPEC = Spec.vector(obs_size=1, action_size=1, context_size=1)


# The rules of each probe: scale, observation (), action () -> reward, next observation, terminated.


def _one_step(scale, obs, action):
    """One step that earns ``scale``: Q = scale. Needs the critic's fit to the reward, and ``discount``."""
    return scale, AFTER, True


def _by_observation(scale, obs, action):
    """One step from -1 or 1: Q = scale obs. Needs the observation to reach the critic."""
    return scale * obs, AFTER, True


def _delayed(scale, obs, action):
    """Two steps, from 0 and from 1. The last one earns: Q(1) = scale, Q(0) = gamma scale."""
    last = obs > 0.5
    return scale * last, jnp.where(last, AFTER, 1.0), last


def _by_action(scale, obs, action):
    """One step: Q = -(action - scale)^2. Each task has its own best action."""
    return -jnp.square(action - scale), AFTER, True


def _by_both(scale, obs, action):
    """One step from -1 or 1: Q = -(action - scale obs)^2. The best action depends on observation and task."""
    return -jnp.square(action - scale * obs), AFTER, True


def _endless(scale, obs, action):
    """No termination: 0 earns nothing, then 1 earns ``scale`` forever, so Q(1) = scale / (1 - gamma).

    If the time limit were a termination, Q(1) would be scale. If the observation after the reset were stored as the
    next one, Q(1) would be scale / (1 - gamma^2).
    """
    return scale * (obs > 0.5), 1.0, False


RULES = {
    "one-step": _one_step,
    "by-observation": _by_observation,
    "delayed": _delayed,
    "by-action": _by_action,
    "by-both": _by_both,
    "endless": _endless,
}
EITHER_SIGN = ("by-observation", "by-both")  # episodes begin at -1 or 1, and not at 0


class World(NamedTuple):
    """The state of every probe."""

    obs: Array  # (1,)
    age: Array  # () int32


def tasks_of(kind: str, scales=(1.0, -0.5), horizon: int = LIMIT) -> Task:
    """Return tasks (T, ...) of one probe. They differ in a scale, which is also their context."""
    scales = jnp.asarray(scales, jnp.float32)
    same = lambda value, dtype: jnp.full(scales.shape, value, dtype)
    goal = {
        "scale": scales,
        "kind": same(list(RULES).index(kind), jnp.int32),
        "either_sign": same(kind in EITHER_SIGN, bool),
    }
    row = jnp.arange(len(scales), dtype=jnp.int32)
    return Task(row, row, scales[:, None], {"scale": scales}, {}, goal, same(horizon, jnp.int32))


@dataclasses.dataclass(frozen=True)
class Probe:
    """An environment that is any of the probes, by the task's ``kind``."""

    ends_early: ClassVar[bool] = True
    reset_batches: ClassVar[int] = 16
    cheap_starts: ClassVar[bool] = False
    finite_horizon: ClassVar[bool] = False
    kind: str = "one-step"
    episode_length: int = LIMIT

    @property
    def spec(self) -> Spec:
        return SPEC

    def tasks(self, split: str = "train") -> Task:
        return tasks_of(self.kind, horizon=self.episode_length)

    def task_values(self, split: str) -> np.ndarray:
        return np.asarray(self.tasks(split).params["scale"])

    def reset(self, task: Task, key: Key) -> Step:
        state = World(self.start(task, key), jnp.int32(0))
        return Step(state, state.obs, jnp.float32(0), jnp.bool_(False))

    def step(self, task: Task, state: World, action: Array) -> Step:
        reward, obs, terminated = self.rules(task, state, action[0])
        obs = jnp.reshape(jnp.float32(obs), 1)
        return Step(World(obs, state.age + 1), obs, jnp.float32(reward), jnp.bool_(terminated))

    reset_worlds, step_worlds, renew_worlds = axes.reset_worlds, axes.step_worlds, axes.renew_worlds
    observe_worlds, where_worlds = axes.observe_worlds, staticmethod(axes.where_worlds)

    def start(self, task: Task, key: Key) -> Array:
        sign = jnp.where(jax.random.bernoulli(key, shape=(1,)), 1.0, -1.0)
        return jnp.where(task.goal["either_sign"], sign, 0.0)

    def rules(self, task: Task, state: World, action: Array):
        as_arrays = lambda rule: lambda *inputs: tuple(map(jnp.float32, rule(*inputs)))
        branches = [as_arrays(rule) for rule in RULES.values()]
        reward, obs, terminated = jax.lax.switch(task.goal["kind"], branches, task.goal["scale"], state.obs[0], action)
        return reward, obs, terminated > 0


PIXELS = 16
"""Height and width of the pictures of ``Pictured``."""


@dataclasses.dataclass(frozen=True)
class Pictured(Probe):
    """A probe that shows its observation: the left half of a picture is as bright as it is positive, else the right.

    With ``state="also"`` the observation itself comes beside the picture.
    """

    frames: int = 2
    state: str = "hidden"

    @property
    def spec(self) -> Spec:
        shown = {"pixels": jax.ShapeDtypeStruct((PIXELS, PIXELS, 1), jnp.uint8)}
        return SPEC._replace(obs=shown | ({"state": SPEC.obs} if self.state == "also" else {}), frames=self.frames)

    def reset(self, task: Task, key: Key) -> Step:
        return self.show(super().reset(task, key))

    def step(self, task: Task, state: World, action: Array) -> Step:
        return self.show(super().step(task, state, action))

    def show(self, step: Step) -> Step:
        """Return the step with a picture in place of its observation, or beside it."""
        left = jnp.arange(PIXELS) < PIXELS // 2
        bright = jnp.where(left, jnp.maximum(step.obs, 0.0), jnp.maximum(-step.obs, 0.0))
        picture = jnp.clip(200.0 * bright, 0, 255).astype(jnp.uint8)
        shown = {"pixels": jnp.broadcast_to(picture[None, :, None], (PIXELS, PIXELS, 1))}
        return step._replace(obs=shown | ({"state": step.obs} if self.state == "also" else {}))
