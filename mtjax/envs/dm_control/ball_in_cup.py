"""The ball-in-cup domain of dm_control: swing a ball on a string up into a cup."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, GEAR, GRAVITY, MASS, Parameter, body_mass
from mtjax.envs.pixels import Mark
from mtjax.types import Array, Key, Task

_START_LOW, _START_HIGH = (-0.2, 0.2), (0.2, 0.5)  # [m] x and z of the ball's joints


def _set_string_length(spec: mujoco.MjSpec, length: float) -> None:
    spec.tendon("string").range = [0, length]


@dataclasses.dataclass(frozen=True)
class BallInCup(Domain):
    """Catch: bring the ball into the cup and keep it there.

    Observation (8,), all after the step: x and z of the cup and of the ball, relative to where they hang in the model
        [m]; their velocities in the same order [m/s].
    Action (2,): forces on the cup along x and z in [-1, 1]; gears of 5 N.
    Reward: 1 while the ball is wholly inside the box of 0.1 m by 0.1 m that the cup encloses, else 0; returns lie in
        [0, 1000].
    Start: the cup at rest in its place, the ball at rest, with x uniform in [-0.2, 0.2] m and z in [0.4, 0.7] m above
        the ground, drawn again until nothing touches.
    Episode: 1000 steps of 0.02 s (ten substeps of 0.002 s); it never terminates.

    Parameters that can vary:
        string-length: the greatest distance [m] of the ball from the cup's bottom; above 0.29, so that no episode
            begins with the string stretched.
        ball-mass: scale of the ball's mass.
        mass, friction, damping, gear: scale of all masses, of the sliding friction of all geoms, of the damping of the
            cup's joints, of the strength of both motors. gravity [m/s^2].

    Differs from dm_control in: cup and ground do not collide (at gear 1 the cup stays 0.17 m above it, from 1.6 or so
    it can pass it), and under MJX the constraint solver stops after ``solver_iterations``.
    """

    asks: ClassVar[str] = "Catch the ball in the cup."
    parameters: ClassVar = MappingProxyType(
        {
            "string-length": Parameter("m", 0.3, _set_string_length, minimum=0.29),
            "ball-mass": body_mass("ball"),
            "mass": MASS,
            "gravity": GRAVITY,
            "friction": FRICTION,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "ball_in_cup.xml"
    num_substeps: ClassVar[int] = 10
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 2
    starts_untouched: ClassVar[bool] = True
    look: ClassVar = Look((0, -1, 0.8), 63.435, sun=True)

    def add_marks(self, spec: mujoco.MjSpec) -> None:
        """Add the string as a thin capsule, since the physics has a tendon."""
        shape = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [spec.tendon("string").width, 0.1, 0]}
        spec.worldbody.add_geom(
            name="string", rgba=spec.tendon("string").rgba, mass=0, contype=0, conaffinity=0, **shape
        )
        spec.tendon("string").rgba = [0, 0, 0, 0]

    def marks(self, task: Task, world: World) -> dict[str, Mark]:
        model, bodies, sites = self.models[0], self.leaf(task, "body_pos"), self.leaf(task, "site_pos")
        ends = []
        for i, name in enumerate(("cup", "ball")):
            x, z = world.qpos[2 * i], world.qpos[2 * i + 1]
            ends.append(bodies[model.body(name).id] + sites[model.site(name).id] + jnp.stack([x, jnp.float32(0), z]))
        apart = ends[1] - ends[0]
        length = jnp.maximum(jnp.linalg.norm(apart), 1e-6)
        size = jnp.stack([jnp.float32(model.tendon_width[0]), length / 2, jnp.float32(0)])
        return {"string": Mark((ends[0] + ends[1]) / 2, size, apart / length)}

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        low, high = jnp.array([_START_LOW, _START_HIGH]).T
        draw = lambda key: jnp.concatenate([jnp.zeros(2), jax.random.uniform(key, (2,), minval=low, maxval=high)])
        return self.start_apart(task, key, draw), jnp.zeros(self.models[0].nv)

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos, world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        radius = self.leaf(task, "geom_size")[self.models[0].geom("ball").id, 0]
        room = self.leaf(task, "site_size")[self.models[0].site("target").id] - radius
        inside = jnp.abs(world.sensors) < room
        return (inside[0] & inside[2]).astype(jnp.float32)
