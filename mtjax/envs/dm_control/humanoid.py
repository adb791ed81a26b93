"""The humanoid domain of dm_control: a body of 21 joints stands, walks and runs."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.attitude import upward
from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, start_apart, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, GEAR, GRAVITY, MASS, body_mass, positive
from mtjax.types import Array, Key, Task

_STAND_HEIGHT = 1.4  # [m] of the head
_UPRIGHT = 0.9
_STILL = 2.0  # [m/s] margin of the reward for standing still
_ANKLE = 0.09  # [m] from a shin's lower end to the middle of its foot


def _set_shin_length(spec: mujoco.MjSpec, length: float) -> None:
    for side in ("left", "right"):
        spec.geom(f"{side}_shin").fromto = [0, 0, 0, 0, 0, -length]
        spec.body(f"{side}_foot").pos = [0, 0, -length - _ANKLE]


@dataclasses.dataclass(frozen=True)
class Humanoid(Domain):
    """A humanoid whose tasks are to stand still, or to move while it stands.

    Observation (67,), all after the step: angles of abdomen (z, y, x), right hip (x, z, y), knee and ankle (y, x), the
        same of the left leg, right shoulder (1, 2) and elbow, and the same of the left arm [rad]; height of the head
        [m]; left hand and foot, then right hand and foot as seen from the torso, in its frame, x, y and z each [m]; the
        world's upward direction in the torso's frame; velocity of the centre of mass [m/s]; velocities of the torso
        along the world's axes [m/s] and about its own [rad/s], and of the joints in their order [rad/s].
    Action (21,): motor commands in [-1, 1] of abdomen (y, z, x), right hip (x, z, y), knee and ankle (x, y), the same
        of the left leg, right shoulder (1, 2) and elbow, and the same of the left arm; gears from 20 to 120 N m.
    Reward: in [0, 1],
            r = standing upright (4 + thrift) / 5 * (5 move + 1) / 6
        where standing is 1 with the head at 1.4 m
        or more and falls as a Gaussian to 0.1 at 1.05 m; upright is 1 where the torso's uprightness is 0.9 or more and
        falls linearly to 0 head down; thrift is 1 less the mean square of the action; move is 1 where the horizontal
        velocity of the centre of mass, in any direction, is ``speed`` or more, and falls linearly to 0 at rest. Returns
        lie in [0, 1000].
    Start: every joint uniform in its range and the body turned at random, at rest with the torso at 1.5 m, drawn again
        until nothing touches. (The quaternion has four numbers uniform in [0, 1], scaled to unit length: dm_control's
        way, which favours some rotations.)
    Episode: 1000 steps of 0.025 s (five substeps of 0.005 s); it never terminates.

    Parameters that can vary:
        shin-length: length [m] of the axis of both shins, their mass by density; the feet stay 0.09 m below.
        torso-mass: scale of the torso's mass.
        mass, friction, damping, gear: scale of all masses, of the sliding friction of all geoms, of the damping of all
            joints, of the strength of all motors. gravity [m/s^2].
        speed: velocity [m/s] from which the reward for moving is 1.

    Differs from dm_control in: under MJX the constraint solver stops after ``solver_iterations``, and friction is
    another on a limb that stands on the floor within 30 degrees of upright: MJX turns the pyramid of friction to the
    world's axes there, and MuJoCo C to the limb's. That is one state of random play in twenty, in which velocities
    after a step differ by up to 2% of the fastest.
    """

    parameters: ClassVar = MappingProxyType(
        {
            "shin-length": positive("m", 0.3, _set_shin_length),
            "torso-mass": body_mass("torso"),
            "mass": MASS,
            "gravity": GRAVITY,
            "friction": FRICTION,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "humanoid.xml"
    num_substeps: ClassVar[int] = 5
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 6
    starts_untouched: ClassVar[bool] = True  # it has no force sensors
    look: ClassVar = Look((-3, 0, 1), 63.435, turn=-90, follow="torso")

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        model = self.models[0]
        return start_apart(self, task, key, lambda key: start_joints(model, key)), jnp.zeros(model.nv)

    def observe(self, task: Task, world: World) -> Array:
        velocity, head, limbs = jnp.split(world.sensors, (3, 6))
        return jnp.concatenate([world.qpos[7:], head[2:], limbs, upward(world.qpos[3:7]), velocity, world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        thrift = jnp.mean(tolerance(action, 0.0, 0.0, 1.0, "quadratic", value_at_margin=0))
        return self.standing(world) * (4 + thrift) / 5 * self.moving(task, world.sensors[:2])

    def standing(self, world: World) -> Array:
        """Return the reward's factor () in [0, 1] for a high head and an upright torso."""
        high = tolerance(world.sensors[5], _STAND_HEIGHT, jnp.inf, _STAND_HEIGHT / 4)
        uprightness = upward(world.qpos[3:7])[2]
        return high * tolerance(uprightness, _UPRIGHT, jnp.inf, _UPRIGHT + 1, "linear", value_at_margin=0)

    def moving(self, task: Task, velocity: Array) -> Array:
        """Return the reward's factor () in [0, 1] for the velocity (2,) [m/s] of the centre of mass along x and y."""
        speed = task.goal["speed"]
        move = tolerance(jnp.linalg.norm(velocity), speed, jnp.inf, speed, "linear", value_at_margin=0)
        return (5 * move + 1) / 6


@dataclasses.dataclass(frozen=True)
class HumanoidStand(Humanoid):
    """Stand: rise, hold the head high and the torso upright, and stay in place with little effort.

    Reward: as ``Humanoid``'s but for the last factor, with the velocity v of the centre of mass along x and y [m/s],
            r = standing upright (4 + thrift) / 5 * (0.1^((v_x / 2)^2) + 0.1^((v_y / 2)^2)) / 2
        There is no ``speed``. Returns lie in [0, 1000].
    """

    def moving(self, task: Task, velocity: Array) -> Array:
        return jnp.mean(tolerance(velocity, 0.0, 0.0, _STILL))


@dataclasses.dataclass(frozen=True)
class HumanoidWalk(Humanoid):
    """Walk: move in any direction at 1 m/s or faster, upright."""

    parameters: ClassVar = MappingProxyType({**Humanoid.parameters, "speed": positive("m/s", 1.0)})


@dataclasses.dataclass(frozen=True)
class HumanoidRun(Humanoid):
    """Run: HumanoidWalk at 10 m/s."""

    parameters: ClassVar = MappingProxyType({**Humanoid.parameters, "speed": positive("m/s", 10.0)})
