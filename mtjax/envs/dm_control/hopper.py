"""The hopper domain of dm_control: a planar body on one leg."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, GEAR, GRAVITY, MASS, body_mass, positive
from mtjax.envs.planar import forward_velocity, planar
from mtjax.types import Array, Key, Task

_HEIGHTS = (0.6, 2.0)  # [m]


def _scale_foot(spec: mujoco.MjSpec, scale: float) -> None:
    foot = spec.body("foot")
    foot.geoms[0].fromto = foot.geoms[0].fromto * scale
    for site in foot.sites:
        site.pos = site.pos * scale


@dataclasses.dataclass(frozen=True)
class Hopper(Domain):
    """A hopper whose tasks are to stand, or to hop along.

    Observation (15,), all after the step: height of the torso relative to its initial 1 m [m], its pitch [rad], the
        angles of waist, hip, knee and ankle [rad]; velocities of the torso along x and z [m/s] and about y, and of the
        four joints [rad/s]; log(1 + force) of the touch sensors at toe and heel [log N].
    Action (4,): motor commands of waist, hip, knee and ankle in [-1, 1]; gears of 30, 40, 30 and 10 N m.
    Reward: with the forward velocity v of the centre of mass, and the height h of the torso's above the foot's,
            r = clip(v / speed, 0, 1) if 0.6 <= h <= 2, else 0
        Returns lie in [0, 1000].
    Start: the torso at its height of 1 m and at rest, with its pitch uniform in [-pi, pi] and all joints uniform in
        their range; limbs may begin inside the floor.
    Episode: 1000 steps of 0.02 s (four substeps of 0.005 s); it never terminates.

    Parameters that can vary:
        foot-length: scale of the foot's length about the ankle, its mass by density; the touch sensors stay at its ends
            and keep their size.
        torso-mass: scale of the mass of torso and nose.
        mass, friction, damping, gear: scale of all masses, of the sliding friction of all geoms, of the damping of all
            joints, of the strength of all motors. gravity [m/s^2].
        speed: velocity [m/s] from which the reward is 1.

    Differs from dm_control in: under MJX the constraint solver stops after ``solver_iterations``, an episode's first
    observation shows no touch (three starts in a thousand have some), and two limbs may touch in another way, which no
    number of iterations mends:
        Axes that cross. The nearest points of both are one, so that the contact has no normal of its own. MuJoCo C
            takes the one across the plane, and the limbs pass each other freely. In MJX's float32 the points differ by
            rounding, and the limbs are pushed apart in an arbitrary direction of the plane: velocities after a step
            differ by 3 to 11 rad/s. That is one start in a hundred, as rare in the first ten steps, and later one state
            of random play in a thousand or fewer.
        Axes parallel to within 0.0001 rad. MuJoCo C has a contact at either end of the shorter limb, MJX has one: 0.5
            rad/s in the one case that was seen, and two states of random play in ten thousand are such.
    """

    parameters: ClassVar = MappingProxyType(
        {
            "foot-length": positive("1", 1.0, _scale_foot),
            "torso-mass": body_mass("torso"),
            "mass": MASS,
            "gravity": GRAVITY,
            "friction": FRICTION,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "hopper.xml"
    num_substeps: ClassVar[int] = 4
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 4
    starts_untouched: ClassVar[bool] = True  # nearly: to solve for the rest costs MJX half a step's compilation more
    heading: ClassVar[float] = 1.0  # -1 backwards
    look: ClassVar = Look((0, -2.8, -0.2), 90, follow="torso")

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        return start_joints(self.models[0], key), jnp.zeros(self.models[0].nv)

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos[1:], world.qvel, jnp.log1p(world.sensors)])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        speed, velocity = task.goal["speed"], self.heading * forward_velocity(self, task, world)
        hopping = tolerance(velocity, speed, jnp.inf, speed / 2, "linear", value_at_margin=0.5)
        return self.standing(task, world) * hopping

    def standing(self, task: Task, world: World) -> Array:
        """Return whether the torso is high enough over the foot, ()."""
        height = planar(self, task, world).centre[:, 1]
        torso, foot = (self.models[0].body(name).id for name in ("torso", "foot"))
        return tolerance(height[torso] - height[foot], *_HEIGHTS)


@dataclasses.dataclass(frozen=True)
class HopperStand(Hopper):
    """Stand: hold the torso high over the foot with little effort.

    Reward: with the action a, and the height h of the torso's centre of mass above the foot's,
            r = 1 - mean(a^2) / 5 if 0.6 <= h <= 2, else 0
        There is no ``speed``. Returns lie in [0, 1000].
    """

    asks: ClassVar[str] = "Make the hopper stand."

    def reward(self, task: Task, world: World, action: Array) -> Array:
        effort = tolerance(action, 0.0, 0.0, 1.0, "quadratic", value_at_margin=0)
        return self.standing(task, world) * (4 + jnp.mean(effort)) / 5


@dataclasses.dataclass(frozen=True)
class HopperHop(Hopper):
    """Hop: move forwards at 2 m/s or faster, the torso high over the foot."""

    asks: ClassVar[str] = "Make the hopper hop forwards."
    parameters: ClassVar = MappingProxyType({**Hopper.parameters, "speed": positive("m/s", 2.0)})


@dataclasses.dataclass(frozen=True)
class HopperHopBackward(Hopper):
    """Hop backwards at 2 m/s or faster, the torso high over the foot.

    As HopperHop, but velocities backwards count. Not a task of dm_control: it has the same model, starts and episodes.

    Reward: with the forward velocity v and the height h as there,
            r = clip(-v / speed, 0, 1) if 0.6 <= h <= 2, else 0
        Returns lie in [0, 1000].
    """

    parameters: ClassVar = HopperHop.parameters
    heading: ClassVar[float] = -1.0
