"""The pendulum domain of dm_control: a weak motor swings a pole up and holds it there."""

import dataclasses
import math
from types import MappingProxyType
from typing import ClassVar

import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, GEAR, GRAVITY, positive
from mtjax.types import Array, Key, Task

_UPRIGHT = math.cos(math.radians(8))


def _set_mass(spec: mujoco.MjSpec, mass: float) -> None:
    spec.geom("mass").mass = mass


def _set_length(spec: mujoco.MjSpec, length: float) -> None:
    spec.geom("pole").fromto = [0, 0, 0, 0, 0, length]
    spec.geom("mass").pos = [0, 0, length]


@dataclasses.dataclass(frozen=True)
class PendulumSwingup(Domain):
    """Swing-up: swing the pole up and hold it upright.

    Observation (3,), all after the step: cosine and sine of the pole's angle from upright; its velocity [rad/s].
    Action (1,): torque in [-1, 1]; a gear of 1 N m, a fifth of what holds the pole level.
    Reward: with the angle theta from upright, in degrees,
            r = 1 if |theta| <= 8, else 0
        Returns lie in [0, 1000].
    Start: the pole uniform in [-pi, pi], at rest.
    Episode: 1000 steps of 0.02 s; it never terminates.

    Parameters that can vary:
        mass: of the ball at the pole's end [kg]; the pole has none.
        length: from the hinge to the middle of the ball [m].
        gravity: [m/s^2].
        damping: scale of the hinge's damping.
        gear: scale of the motor's torque.

    Differs from dm_control in: nothing.
    """

    asks: ClassVar[str] = "Swing the pendulum up and hold it upright."
    parameters: ClassVar = MappingProxyType(
        {
            "mass": positive("kg", 1.0, _set_mass),
            "length": positive("m", 0.5, _set_length),
            "gravity": GRAVITY,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "pendulum.xml"
    num_substeps: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 1000
    gpu_engine: ClassVar[str] = "mjx"
    default_iterations: ClassVar[int] = 1
    starts_untouched: ClassVar[bool] = True
    look: ClassVar = Look((0, -1.5, 2), 45)

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        return start_joints(self.models[0], key), jnp.zeros(1)

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([jnp.cos(world.qpos), jnp.sin(world.qpos), world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return (jnp.cos(world.qpos[0]) >= _UPRIGHT).astype(jnp.float32)


@dataclasses.dataclass(frozen=True)
class PendulumSpin(PendulumSwingup):
    """Spin: turn the pole round and round at 6 rad/s or faster.

    As PendulumSwingup, but for the reward. The motor can keep up a mean of some 8 rad/s. The pole is slower than
    that by 2 rad/s at the top. Not a task of dm_control: it has the same model, starts and episodes.

    Reward: with the pole's velocity omega in the hinge's positive sense [rad/s],
            r = clip(omega / speed, 0, 1)
        Returns lie in [0, 1000].

    Further parameter: speed [rad/s].
    """

    parameters: ClassVar = MappingProxyType({**PendulumSwingup.parameters, "speed": positive("rad/s", 6.0)})

    def reward(self, task: Task, world: World, action: Array) -> Array:
        speed = task.goal["speed"]
        return tolerance(world.qvel[0], speed, jnp.inf, speed, "linear", value_at_margin=0)
