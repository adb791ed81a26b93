"""The walker domain of dm_control: a planar biped."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, rewarded, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, GEAR, GRAVITY, MASS, body_mass, positive
from mtjax.envs.planar import forward_velocity, planar
from mtjax.types import Array, Key, Task, Transition

_STAND_HEIGHT = 1.2  # [m]


def _set_friction(spec: mujoco.MjSpec, value: float) -> None:
    for geom in spec.geoms:
        geom.friction = [value, *geom.friction[1:]]


def _set_foot_length(spec: mujoco.MjSpec, length: float) -> None:
    foot = spec.geom("left_foot")
    foot.size = [foot.size[0], length, 0]


@dataclasses.dataclass(frozen=True)
class Walker(Domain):
    """A walker whose tasks are to stand, or to stand and move.

    Observation (24,), all after the step: of torso, right thigh, leg and foot, and left thigh, leg and foot, the cosine
        and sine of the pitch; the height of the torso [m]; velocities of the torso along z and x [m/s] and about y, and
        of right hip, knee and ankle, and left hip, knee and ankle [rad/s].
    Action (6,): motor commands of right hip, knee and ankle, and left hip, knee and ankle in [-1, 1]; gears of 100, 50
        and 20 N m.
    Reward: in [0, 1],
            r = stand (5 move + 1) / 6,  stand = (3 height + upright) / 4
        where height is 1 with the torso
        at 1.2 m or more and falls as a Gaussian to 0.1 at 0.6 m, and upright goes from 0 (head down) to 1. move is 1
        where the forward velocity of the centre of mass is ``speed`` or more, and falls linearly to 0 at rest. Returns
        lie in [0, 1000].
    Start: the torso at its height of 1.3 m and at rest, with its pitch uniform in [-pi, pi] and all joints uniform in
        their range; limbs may begin inside the floor.
    Episode: 1000 steps of 0.025 s (ten substeps of 0.0025 s); it never terminates.

    Parameters that can vary:
        friction: sliding friction of all geoms, the floor's included; HiP-BMDP's ten tasks have 0.7, 0.8, ..., 1.6.
        foot-length: half-length [m] of the left foot, its mass by density; HiP-BMDP's 0.08, 0.09, ..., 0.17. The right
            foot keeps 0.1.
        torso-mass: scale of the torso's mass.
        mass, damping, gear: scale of all masses, of the damping of all joints, of the strength of all motors.
            gravity [m/s^2].
        speed: velocity [m/s] from which the reward for moving is 1.

    Differs from dm_control in: under MJX the constraint solver stops after ``solver_iterations``.
    """

    parameters: ClassVar = MappingProxyType(
        {
            "friction": positive("1", 0.7, _set_friction),
            "foot-length": positive("m", 0.1, _set_foot_length),
            "torso-mass": body_mass("torso"),
            "mass": MASS,
            "gravity": GRAVITY,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "walker.xml"
    num_substeps: ClassVar[int] = 10
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 8
    starts_untouched: ClassVar[bool] = True  # it has no force sensors
    relabels: ClassVar[tuple[str, ...]] = ("speed",)
    heading: ClassVar[float] = 1.0  # -1 backwards
    look: ClassVar = Look((0, -2, 0.7), 60, follow="torso")

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        return start_joints(self.models[0], key), jnp.zeros(self.models[0].nv)

    def observe(self, task: Task, world: World) -> Array:
        places = planar(self, task, world)
        axes = jnp.stack([jnp.cos(places.angle), jnp.sin(places.angle)], axis=1)[1:]
        return jnp.concatenate([axes.ravel(), places.position[1:2, 1], world.qvel])

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        model, obs = self.models[0], transition.next_obs
        cosines, sines = obs[:14].reshape(7, 2).T
        pitch = jnp.pad(jnp.arctan2(sines, cosines), (1, 0))  # the world's is 0
        bends = model.jnt_axis[2:, 1] * (pitch[1:] - pitch[model.body_parentid[1:]])
        height = obs[14] - self.leaf(task, "body_pos")[1, 2]
        qpos = jnp.concatenate([jnp.stack([height, 0.0]), bends])
        return rewarded(self, task, transition, World(qpos, obs[15:], jnp.zeros(model.nv), None))

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return self.standing(task, world) * (5 * self.move(task, world) + 1) / 6

    def standing(self, task: Task, world: World) -> Array:
        """Return the reward's factor () in [0, 1] for a high and upright torso."""
        places = planar(self, task, world)
        height = tolerance(places.position[1, 1], _STAND_HEIGHT, jnp.inf, _STAND_HEIGHT / 2)
        upright = (1 + jnp.cos(places.angle[1])) / 2
        return (3 * height + upright) / 4

    def move(self, task: Task, world: World) -> Array:
        """Return the reward's factor () in [0, 1] for forward velocity."""
        speed, velocity = task.goal["speed"], self.heading * forward_velocity(self, task, world)
        return tolerance(velocity, speed, jnp.inf, speed / 2, "linear", value_at_margin=0.5)


@dataclasses.dataclass(frozen=True)
class WalkerStand(Walker):
    """Stand: hold the torso high and upright.

    Reward: with ``Walker``'s factors,
            r = (3 height + upright) / 4
        There is no ``speed``. Returns lie in [0, 1000].
    """

    asks: ClassVar[str] = "Make the walker stand upright."

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return self.standing(task, world)


@dataclasses.dataclass(frozen=True)
class WalkerWalk(Walker):
    """Walk: move forwards at 1 m/s or faster, upright."""

    asks: ClassVar[str] = "Make the walker walk forwards."
    parameters: ClassVar = MappingProxyType({**Walker.parameters, "speed": positive("m/s", 1.0)})


@dataclasses.dataclass(frozen=True)
class WalkerRun(Walker):
    """Run: move forwards at 8 m/s or faster, upright."""

    asks: ClassVar[str] = "Make the walker run forwards."
    parameters: ClassVar = MappingProxyType({**Walker.parameters, "speed": positive("m/s", 8.0)})


@dataclasses.dataclass(frozen=True)
class WalkerWalkBackward(Walker):
    """Walk backwards at 1 m/s or faster, upright.

    As WalkerWalk, but velocities backwards count. Not a task of dm_control: it has the same model, starts and episodes.

    Reward: as ``Walker``'s, with the forward velocity v of the centre of mass,
            r = stand (5 move + 1) / 6,  move = clip(-v / speed, 0, 1)
    """

    parameters: ClassVar = WalkerWalk.parameters
    heading: ClassVar[float] = -1.0


@dataclasses.dataclass(frozen=True)
class WalkerRunBackward(Walker):
    """Run backwards: WalkerWalkBackward at 8 m/s.

    Reward: as ``Walker``'s, with the forward velocity v of the centre of mass,
            r = stand (5 move + 1) / 6,  move = clip(-v / speed, 0, 1)
    """

    parameters: ClassVar = WalkerRun.parameters
    heading: ClassVar[float] = -1.0


@dataclasses.dataclass(frozen=True)
class WalkerSpeed(Walker):
    """Speed: move forwards at the task's velocity, neither slower nor faster.

    As WalkerWalk, but for the reward. (With WalkerWalk's own, whoever masters the fastest task has mastered them all.)
    The observation does not show the velocity asked for: the task's context does.

    Reward: as ``Walker``'s, with the forward velocity v of the centre of mass,
            r = stand (5 move + 1) / 6,  move = max(1 - |v - speed| / speed, 0)
        so that move falls to 0 at rest and at twice the velocity asked for.
    """

    asks: ClassVar[str] = "Make the walker move at the given speed."
    parameters: ClassVar = WalkerWalk.parameters

    def move(self, task: Task, world: World) -> Array:
        speed = task.goal["speed"]
        return tolerance(forward_velocity(self, task, world), speed, speed, speed / 2, "linear", value_at_margin=0.5)
