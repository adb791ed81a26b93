"""The point-mass domain of dm_control: a ball is pushed over a floor to a goal."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, rewarded, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, GEAR, MASS, REWARD_SCALE, Parameter
from mtjax.types import Array, Key, Task, Transition

_ARENA = 0.29  # [m] as far as the ball goes from the middle along x and y
_FALL = 0.41  # [m] half the arena's diagonal


def _move_target(axis: int):
    def edit(spec: mujoco.MjSpec, value: float) -> None:
        position = spec.geom("target").pos.copy()
        position[axis] = value
        spec.geom("target").pos = position

    return edit


@dataclasses.dataclass(frozen=True)
class PointMass(Domain):
    """Easy: bring the ball to the goal and keep it there.

    Observation (4,), all after the step: position of the ball, x and y [m]; its velocity [m/s]. The goal is not seen:
        it is what the task is.
    Action (2,): forces along x and y in [-1, 1]; gears of 0.1 N, which is a terminal velocity of 0.1 m/s.
    Reward: with the distance d from the goal,
            r = 0.1^((x / 0.015)^2) (4 + q) / 5,  x = max(d - 0.015, 0)
        where q is the mean over both forces of what falls quadratically from 1 without force to 0 at full
        force. Returns lie in [0, 1000].
    Start: uniform in the arena, whose sides are 0.58 m, at rest.
    Episode: 1000 steps of 0.02 s; it never terminates.

    Parameters that can vary:
        goal-x, goal-y: where the goal is [m], in the middle at 0.
        mass: scale of the ball's mass (0.3 kg).
        damping: scale of the damping along both axes.
        gear: scale of both motors' forces.
        reward-scale: factor of the reward, 1 unless it varies.

    Differs from dm_control in: nothing but the constraint solver under MJX, which stops after ``solver_iterations``;
    it acts only where the ball meets a wall.
    """

    asks: ClassVar[str] = "Move the ball to the goal."
    parameters: ClassVar = MappingProxyType(
        {
            "goal-x": Parameter("m", 0.0, _move_target(0), -_ARENA, _ARENA),
            "goal-y": Parameter("m", 0.0, _move_target(1), -_ARENA, _ARENA),
            "mass": MASS,
            "damping": DAMPING,
            "gear": GEAR,
            "reward-scale": REWARD_SCALE,
        }
    )
    model_file: ClassVar[str] = "point_mass.xml"
    num_substeps: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 1000
    gpu_engine: ClassVar[str] = "mjx"
    default_iterations: ClassVar[int] = 2
    starts_untouched: ClassVar[bool] = True
    relabels: ClassVar[tuple[str, ...]] = ("goal-x", "goal-y", "reward-scale")
    look: ClassVar = Look((0, 0, 0.75), 0, light=(0, 0, 1))

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        return start_joints(self.models[0], key), jnp.zeros(2)

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos, world.qvel])

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        qpos, qvel = jnp.split(transition.next_obs, 2)
        return rewarded(self, task, transition, World(qpos, qvel, jnp.zeros(2), None))

    def reward(self, task: Task, world: World, action: Array) -> Array:
        distance, radius = self._target(task, world)
        gentle = jnp.mean(tolerance(action, 0.0, 0.0, 1.0, "quadratic", 0.0))
        return task.goal["reward-scale"] * tolerance(distance, 0.0, radius, radius) * (4 + gentle) / 5

    def _target(self, task: Task, world: World) -> tuple[Array, Array]:
        """Return distance () from the goal and the goal's radius () [m]."""
        target = self.models[0].geom("target").id
        position, size = self.leaf(task, "geom_pos")[target], self.leaf(task, "geom_size")[target]
        return jnp.linalg.norm(world.qpos - position[:2]), size[0]


@dataclasses.dataclass(frozen=True)
class PointMassNavigate(PointMass):
    """Navigate from the middle to a goal, by a reward that shows the way. All else is as in ``PointMass``.

    The two-dimensional navigation of Finn et al. 2017 ("Model-agnostic meta-learning"), whose reward is the negative
    squared distance from the goal; dm_control's own vanishes a few radii away, so that a goal must be found by chance.

    Reward: with the distance d from the goal,
            r = max(1 - x / 0.41, 0),  x = max(d - 0.015, 0)
        where 0.41 m is half the arena's diagonal. Returns lie in [0, 100].
    Start: in the middle, at rest.
    Episode: 100 steps of 0.1 s (five substeps of 0.02 s); a corner of the arena is some 32 steps away.
    """

    asks: ClassVar[str] = "Move the ball to its goal."
    num_substeps: ClassVar[int] = 5
    episode_steps: ClassVar[int] = 100
    hides: ClassVar[tuple[str, ...]] = ("target",)

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        return jnp.zeros(2), jnp.zeros(2)

    def reward(self, task: Task, world: World, action: Array) -> Array:
        distance, radius = self._target(task, world)
        return task.goal["reward-scale"] * tolerance(distance, 0.0, radius, _FALL, "linear", 0.0)
