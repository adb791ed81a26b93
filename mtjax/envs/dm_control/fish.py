"""The fish domain of dm_control: a fish in water rights itself, and swims to a target."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.attitude import any_attitude, upward
from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, MASS, STRENGTH, WATER, body_mass, positive
from mtjax.envs.pixels import Mark
from mtjax.types import Array, Key, Task

_BEND = 0.2  # [rad] of every joint at a start, to both sides
_TARGET_LOW, _TARGET_HIGH = (-0.4, -0.4, 0.1), (0.4, 0.4, 0.3)  # [m]


def _scale_fins(spec: mujoco.MjSpec, scale: float) -> None:
    for name in ("finright", "finleft"):
        fin = spec.geom(name)
        fin.size, fin.pos = fin.size * scale, fin.pos * scale


def _set_target_size(spec: mujoco.MjSpec, size: float) -> None:
    spec.geom("target").size = [size, 0, 0]


@dataclasses.dataclass(frozen=True)
class FishUpright(Domain):
    """Upright: turn the back up and keep it there.

    Observation (21,), all after the step: angles of tail, twist and second tail, and of roll and pitch of the right fin
        and the left [rad]; the torso's uprightness, from -1 to 1; velocities of the torso along the world's x, y and z
        [m/s] and about its own [rad/s], and of the seven joints in their order [rad/s].
    Action (5,): angles in [-1, 1] rad that servos pull to: of the tail, of its twist, of both fins' flap, and of the
        left and the right fin's pitch.
    Reward: with the uprightness u, which is 1 upright and 0 for a fish on its side,
            r = 0.1^((1 - u)^2)
        Returns lie in [0, 1000].
    Start: every joint uniform in [-0.2, 0.2] rad, the fish turned anyhow, at rest 0.1 m over the ground.
    Episode: 1000 steps of 0.04 s (ten substeps of 0.004 s); it never terminates.

    Parameters that can vary:
        fin-size: scale of both fins, their mass by density.
        torso-mass: scale of the torso's mass.
        water-density: density [kg/m^3] of the water.
        mass, damping, strength: scale of all masses, of the damping of all joints, of the stiffness of all servos.

    Differs from dm_control in: nothing.
    """

    parameters: ClassVar = MappingProxyType(
        {
            "fin-size": positive("1", 1.0, _scale_fins),
            "torso-mass": body_mass("torso"),
            "water-density": WATER._replace(nominal=5000.0),
            "mass": MASS,
            "damping": DAMPING,
            "strength": STRENGTH,
        }
    )
    model_file: ClassVar[str] = "fish.xml"
    num_substeps: ClassVar[int] = 10
    gpu_engine: ClassVar[str] = "mjx"  # nothing touches
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 1  # nothing is constrained
    starts_untouched: ClassVar[bool] = True
    look: ClassVar = Look((0, 0, 0.9), 0, light=(0, 0, 0.5), diffuse=0.6, follow="torso")

    def start(self, task: Task, key: Key) -> tuple[Array, ...]:
        turn_key, joint_key = jax.random.split(key)
        model = self.models[0]
        bends = jax.random.uniform(joint_key, (model.nq - 7,), minval=-_BEND, maxval=_BEND)
        place = jnp.asarray(model.qpos0[:3], jnp.float32)
        return jnp.concatenate([place, any_attitude(turn_key), bends]), jnp.zeros(model.nv)

    def upright(self, world: World) -> Array:
        """Return the height () of the tip of the torso's upward axis, in [-1, 1]."""
        return upward(world.qpos[3:7])[2]

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos[7:], self.upright(world)[None], world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return tolerance(self.upright(world), 1.0, 1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class FishSwim(FishUpright):
    """Swim: bring the mouth to a target that is somewhere else in every episode, upright if possible.

    Observation (24,): FishUpright's, with x, y and z of the target as seen from the mouth, in the mouth's frame [m],
        between uprightness and velocities.
    Action (5,): as FishUpright.
    Reward: in [0, 1],
            r = (7 near + upright) / 8
        where near is 1 with the mouth inside the target and falls as a Gaussian
        to 0.1 at a distance of twice the sum of their radii, and upright goes from 0 (back down) to 1.
    Start: as FishUpright, with the target uniform within 0.4 m along x and y, and 0.1 to 0.3 m over the ground.
    Episode: as FishUpright.

    Parameters that can vary: FishUpright's, and target-size: radius [m] of the target.

    Differs from dm_control in: nothing.
    """

    parameters: ClassVar = MappingProxyType(
        {**FishUpright.parameters, "target-size": positive("m", 0.04, _set_target_size)}
    )
    fresh_goals: ClassVar[bool] = True

    def start(self, task: Task, key: Key) -> tuple[Array, ...]:
        """Draw positions and velocities, and the place of the target (3,) [m]."""
        target_key, key = jax.random.split(key)
        low, high = jnp.array(_TARGET_LOW), jnp.array(_TARGET_HIGH)
        return *super().start(task, key), jax.random.uniform(target_key, (3,), minval=low, maxval=high)

    def marks(self, task: Task, world: World) -> dict[str, Mark]:
        return {"target": Mark(world.extra)}

    def way(self, world: World) -> Array:
        """Return the target (3,) [m] as seen from the mouth, in the mouth's frame."""
        mouth, *axes = jnp.split(world.sensors, 4)
        return jnp.stack([jnp.dot(world.extra - mouth, axis, precision="highest") for axis in axes])

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos[7:], self.upright(world)[None], self.way(world), world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        geoms = jnp.array([self.models[0].geom(name).id for name in ("mouth", "target")])
        reach = jnp.sum(self.leaf(task, "geom_size")[geoms, 0])
        near = tolerance(jnp.linalg.norm(self.way(world)), 0.0, reach, 2 * reach)
        return (7 * near + (1 + self.upright(world)) / 2) / 8
