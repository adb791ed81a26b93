"""The reacher domain of dm_control: a two-link arm brings its finger to a target."""

import dataclasses
import math
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, GEAR, MASS, Parameter, positive
from mtjax.envs.pixels import Mark
from mtjax.types import Array, Key, Task, Transition

_NEAREST, _FARTHEST = 0.05, 0.2  # [m] of the target from the shoulder
_HEIGHT = 0.01  # [m] of arm and target


def _set_target_size(spec: mujoco.MjSpec, size: float) -> None:
    spec.geom("target").size = [size, 0, 0]


@dataclasses.dataclass(frozen=True)
class Reacher(Domain):
    """Reach: hold the finger on a target that is somewhere else in every episode.

    Observation (6,), all after the step: angles of shoulder and wrist [rad]; from the finger to the target, x and y
        [m]; velocities of shoulder and wrist [rad/s].
    Action (2,): torques of shoulder and wrist in [-1, 1]; gears of 0.05 N m.
    Reward: with the distance d of the finger's centre from that of the target, and the target's radius R,
            r = 1 if d <= R + 0.01, else 0
        Returns lie in [0, 1000].
    Start: shoulder uniform in [-pi, pi], wrist in its range of 160 degrees to both sides, at rest; the target in any
        direction, uniformly 0.05 to 0.2 m from the shoulder.
    Episode: 1000 steps of 0.02 s; it never terminates.

    Parameters that can vary:
        target-size: radius of the target [m]: 0.05 is dm_control's "easy", 0.015 its "hard".
        mass: scale of all masses and inertias.
        damping: scale of the damping of both joints.
        gear: scale of both motors' torques.

    Differs from dm_control in: nothing but the constraint solver under MJX, which stops after ``solver_iterations``;
    it acts only at the ends of the wrist's range.
    """

    asks: ClassVar[str] = "Hold the end of the arm on the target."
    parameters: ClassVar = MappingProxyType(
        {
            "target-size": positive("m", 0.05, _set_target_size),
            "mass": MASS,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "reacher.xml"
    num_substeps: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 1000
    gpu_engine: ClassVar[str] = "mjx"
    default_iterations: ClassVar[int] = 2
    starts_untouched: ClassVar[bool] = True
    relabels: ClassVar[tuple[str, ...]] = ("target-size", "target-angle", "target-radius")
    fresh_goals: ClassVar[bool] = True
    look: ClassVar = Look((0, 0, 0.75), 0, light=(0, 0, 1))

    def start(self, task: Task, key: Key) -> tuple[Array, Array, Array]:
        """Draw positions and velocities of the joints, and the place of the target (2,) [m]."""
        joint_key, target_key = jax.random.split(key)
        return start_joints(self.models[0], joint_key), jnp.zeros(2), self.target(task, target_key)

    def marks(self, task: Task, world: World) -> dict[str, Mark]:
        return {"target": Mark(jnp.append(world.extra, _HEIGHT))}

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos, world.extra - self.finger(task, world), world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        geoms = jnp.array([self.models[0].geom(name).id for name in ("target", "finger")])
        reach = jnp.sum(self.leaf(task, "geom_size")[geoms, 0])
        return tolerance(jnp.linalg.norm(world.extra - self.finger(task, world)), 0.0, reach)

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        target = self.target(task, key)
        recall = lambda obs: World(obs[:2], obs[4:], jnp.zeros(2), None, target)
        before, after = recall(transition.obs), recall(transition.next_obs)
        return transition._replace(
            obs=self.observe(task, before),
            reward=self.reward(task, after, transition.action),
            next_obs=self.observe(task, after),
        )

    def target(self, task: Task, key: Key) -> Array:
        """Return the place of the target (2,) [m] in an episode."""
        angle, radius = self.polar_target(task, key)
        return radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def polar_target(self, task: Task, key: Key) -> tuple[Array, Array]:
        """Return direction () [rad] and distance () [m] of the target from the shoulder in one episode."""
        angle_key, radius_key = jax.random.split(key)
        return (
            jax.random.uniform(angle_key, minval=-jnp.pi, maxval=jnp.pi),
            jax.random.uniform(radius_key, minval=_NEAREST, maxval=_FARTHEST),
        )

    def finger(self, task: Task, world: World) -> Array:
        """Return the middle of the finger (2,) [m]."""
        bodies = jnp.array([self.models[0].body(name).id for name in ("hand", "finger")])
        lengths, angles = self.leaf(task, "body_pos")[bodies, 0], jnp.cumsum(world.qpos)
        return jnp.stack([jnp.sum(lengths * jnp.cos(angles)), jnp.sum(lengths * jnp.sin(angles))])


@dataclasses.dataclass(frozen=True)
class ReacherTarget(Reacher):
    """Reach the task's target, which stays where it is and is not seen. All else is as in ``Reacher``.

    Observation (6,): as ``Reacher``'s, but with the position of the finger, x and y from the shoulder [m], in place of
        the way to the target, which would give the task away.

    Parameters that can vary, beside those of ``Reacher``:
        target-angle: direction of the target from the shoulder, counter-clockwise from x [rad].
        target-radius: its distance from the shoulder [m]; the finger reaches to 0.24.
    """

    asks: ClassVar[str] = "Hold the end of the arm on the target."
    parameters: ClassVar = MappingProxyType(
        {
            **Reacher.parameters,
            "target-angle": Parameter("rad", 0.0, minimum=-math.inf),
            "target-radius": positive("m", 0.15, maximum=0.24),
        }
    )
    fresh_goals: ClassVar[bool] = False
    hides: ClassVar[tuple[str, ...]] = ("target",)

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos, self.finger(task, world), world.qvel])

    def polar_target(self, task: Task, key: Key) -> tuple[Array, Array]:
        return task.goal["target-angle"], task.goal["target-radius"]
