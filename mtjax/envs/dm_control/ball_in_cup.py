"""The ball-in-cup domain of dm_control: swing a ball on a string up into a cup."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, start_apart
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, GEAR, GRAVITY, MASS, Parameter, body_mass, positive
from mtjax.envs.pixels import Mark
from mtjax.types import Array, Key, Task

_TAUT = 5 / 6  # of the string's length, from which a spin counts
_START_LOW, _START_HIGH = (-0.2, 0.2), (0.2, 0.5)  # [m] x and z of the ball's joints


def _set_string_length(spec: mujoco.MjSpec, length: float) -> None:
    spec.tendon("string").range = [0, length]


@dataclasses.dataclass(frozen=True)
class BallInCup(Domain):
    """Catch: bring the ball into the cup and keep it there.

    Observation (8,), all after the step: x and z of the cup and of the ball, relative to where they hang in the model
        [m]; their velocities in the same order [m/s].
    Action (2,): forces on the cup along x and z in [-1, 1]; gears of 5 N.
    Reward: with the ways x and z from the middle of the box that the cup encloses to the ball's centre, and the ball's
        radius R of 0.025 m,
            r = 1 if |x| < 0.05 - R and |z| < 0.05 - R, else 0
        The ball is then wholly inside the box of 0.1 m by 0.1 m. Returns lie in [0, 1000].
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
    look: ClassVar = Look((0, -1, 0.8), 63.435, diffuse=0.6, sun=True)

    def seen_spec(self, values: Mapping[str, float]) -> mujoco.MjSpec:
        """Return the model with the string as a thin capsule, since the physics has a tendon."""
        spec = self.compile_spec(values)
        shape = {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [spec.tendon("string").width, 0.1, 0]}
        spec.worldbody.add_geom(
            name="string", rgba=spec.tendon("string").rgba, mass=0, contype=0, conaffinity=0, **shape
        )
        spec.tendon("string").rgba = [0, 0, 0, 0]
        return spec

    def marks(self, task: Task, world: World) -> dict[str, Mark]:
        cup, ball = self.ends(task, world)
        length = jnp.maximum(jnp.linalg.norm(ball - cup), 1e-6)
        size = jnp.stack([jnp.float32(self.models[0].tendon_width[0]), length / 2, jnp.float32(0)])
        return {"string": Mark((cup + ball) / 2, size, (ball - cup) / length)}

    def ends(self, task: Task, world: World) -> tuple[Array, Array]:
        """Return the places (3,) [m] of the string's ends, at the cup and at the ball."""
        model, bodies, sites = self.models[0], self.leaf(task, "body_pos"), self.leaf(task, "site_pos")
        moved = [jnp.stack([x, jnp.float32(0), z]) for x, z in world.qpos.reshape(2, 2)]
        places = [bodies[model.body(name).id] + sites[model.site(name).id] for name in ("cup", "ball")]
        return places[0] + moved[0], places[1] + moved[1]

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        low, high = jnp.array([_START_LOW, _START_HIGH]).T
        draw = lambda key: jnp.concatenate([jnp.zeros(2), jax.random.uniform(key, (2,), minval=low, maxval=high)])
        return start_apart(self, task, key, draw), jnp.zeros(self.models[0].nv)

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos, world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        radius = self.leaf(task, "geom_size")[self.models[0].geom("ball").id, 0]
        room = self.leaf(task, "site_size")[self.models[0].site("target").id] - radius
        inside = jnp.abs(world.sensors) < room
        return (inside[0] & inside[2]).astype(jnp.float32)


@dataclasses.dataclass(frozen=True)
class BallInCupSpin(BallInCup):
    """Spin: swing the ball round and round the cup at 3 m/s or faster.

    As BallInCup, but for the reward. Not a task of dm_control: it has the same model, starts and episodes.

    Reward: with the velocity v at which the ball goes round the cup's bottom from x towards z as the cup sees it, its
        distance d from there, and the string's length L,
            r = clip(v / speed, 0, 1) clip(6 d / L - 4, 0, 1)
        The second factor is 1 from 5/6 of the string's length on, and 0 up to 2/3. Returns lie in [0, 1000].

    Further parameter: speed [m/s].
    """

    parameters: ClassVar = MappingProxyType({**BallInCup.parameters, "speed": positive("m/s", 3.0)})

    def reward(self, task: Task, world: World, action: Array) -> Array:
        cup, ball = self.ends(task, world)
        apart, velocity = ball - cup, world.qvel[2:] - world.qvel[:2]
        distance = jnp.maximum(jnp.linalg.norm(apart), 1e-6)
        around = (apart[0] * velocity[1] - apart[2] * velocity[0]) / distance
        speed, length = task.goal["speed"], self.leaf(task, "tendon_range")[0, 1]
        spinning = tolerance(around, speed, jnp.inf, speed, "linear", value_at_margin=0)
        return spinning * tolerance(distance, _TAUT * length, jnp.inf, length / 6, "linear", value_at_margin=0)
