"""The finger domain of dm_control: a two-link finger turns a free spinner."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.domain import Domain, start_apart, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import TARGET, Look
from mtjax.envs.parameters import DAMPING, FRICTION, GEAR, MASS, Parameter, positive
from mtjax.envs.pixels import Mark
from mtjax.envs.planar import planar
from mtjax.types import Array, Key, Task, Transition

_SPIN_VELOCITY = 15.0  # [rad/s]


def _scale_links(spec: mujoco.MjSpec, size: float) -> None:
    """Scale both links about the finger's base: lengths, radii, masses by density, and what is mounted on them."""
    spec.body("distal").pos = spec.body("distal").pos * size
    for body in ("proximal", "distal"):
        for geom in spec.body(body).geoms:
            geom.fromto = geom.fromto * size
            geom.size = geom.size * size
        for site in spec.body(body).sites:
            site.pos = site.pos * size


def _widen_touch(spec: mujoco.MjSpec, size: float) -> None:
    """Set the first radius of both touch sensors' ellipsoids. No mass, shape or motion changes."""
    for name in ("touchtop", "touchbottom"):
        site = spec.site(name)
        site.size = [size, *site.size[1:]]


def _set_spinner_frictionloss(spec: mujoco.MjSpec, value: float) -> None:
    spec.joint("hinge").frictionloss = value


def _set_spinner_damping(spec: mujoco.MjSpec, value: float) -> None:
    spec.joint("hinge").damping[0] = value


_BODY = {
    "size": positive("1", 1.0, _scale_links),
    "touch-size": positive("m", 0.025, _widen_touch),
    "spinner-frictionloss": positive("N m", 0.1, _set_spinner_frictionloss),
    "spinner-damping": positive("N m s/rad", 0.03, _set_spinner_damping),
    "mass": MASS,
    "friction": FRICTION,
    "damping": DAMPING,
    "gear": GEAR,
}
_LOOK = Look((0, -1, 0.8), 63.435, diffuse=0.6, sun=True)


def _start(finger: Domain, task: Task, key: Key) -> tuple[Array, Array]:
    """Draw positions and velocities of the three joints at which nothing touches."""
    model = finger.models[0]
    return start_apart(finger, task, key, lambda key: start_joints(model, key)), jnp.zeros(model.nv)


def _feel(finger: Domain, task: Task, world: World) -> Array:
    """Return what all tasks observe (9,): joints, the spinner's tip, their velocities and touch."""
    model = finger.models[0]
    point = finger.leaf(task, "site_pos")[model.site("tip").id]
    tip = planar(finger, task, world).offset(model.body("spinner").id, point)
    return jnp.concatenate([world.qpos[:2], tip, world.qvel, jnp.log1p(world.sensors)])


@dataclasses.dataclass(frozen=True)
class FingerSpin(Domain):
    """Spin: keep the spinner turning at 15 rad/s or more.

    Observation (9,), all after the step: angles of the proximal and distal joint [rad]; x and z of the spinner's tip
        relative to its hinge [m]; velocities of proximal, distal and hinge [rad/s]; log(1 + force) of the touch sensors
        at the top and the bottom of the fingertip [log N].
    Action (2,): motor commands of the proximal and distal joint in [-1, 1]; gears of 30 and 15 N m.
    Reward: with the hinge's velocity omega,
            r = 1 if omega <= -15, else 0
        Returns lie in [0, 1000].
    Start: both finger joints uniform in their range, the hinge uniform in [-pi, pi], at rest, drawn again until nothing
        touches.
    Episode: 1000 steps of 0.02 s (two substeps of 0.01 s); it never terminates.

    Parameters that can vary:
        size: scale of both finger links about the finger's base: lengths, radii, masses by density (so mass grows with
            size^3), the distal body, and the mounting points of the touch sensors. The sensors' own size, the motors
            and the joints' damping stay. Below 0.92 the finger cannot reach the spinner's thin side, so that some
            starts cannot be won; above 1.3 or so its growing mass makes the task hard for the same motors. Trained
            agents master every size from 0.95 to 1.13 (benchmarks/RESULTS.md).
        touch-size: first radius [m] of the ellipsoids in which the touch sensors feel, which is all that differs
            between the ten tasks MTEnv calls "finger-spin, vary size": they share one dynamics and one reward.
        spinner-frictionloss, spinner-damping: dry friction [N m] and damping [N m s/rad] of the hinge, 0.1 and 0.03.
        mass, friction, damping, gear: scale of all masses, of the sliding friction of all geoms, of the damping of all
            joints, of the strength of both motors. There is no gravity.

    Differs from dm_control in: the floor never collides (at nominal size it is out of reach; above size 1.07 the
    fingertip passes it), and under MJX the constraint solver stops after ``solver_iterations``.
    """

    asks: ClassVar[str] = "Spin the body with the finger."
    parameters: ClassVar = MappingProxyType(_BODY)
    model_file: ClassVar[str] = "finger.xml"
    num_substeps: ClassVar[int] = 2
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 2
    warp_iterations: ClassVar[int] = 4
    starts_untouched: ClassVar[bool] = True
    look: ClassVar = _LOOK

    def prepare(self, spec: mujoco.MjSpec) -> None:
        _set_spinner_damping(spec, 0.03)

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        return _start(self, task, key)

    def observe(self, task: Task, world: World) -> Array:
        return _feel(self, task, world)

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return (world.qvel[2] <= -_SPIN_VELOCITY).astype(jnp.float32)


@dataclasses.dataclass(frozen=True)
class FingerTurn(Domain):
    """Turn: bring the spinner's tip into a target on the circle that it runs on.

    Observation (12,), all after the step: angles of the proximal and distal joint [rad]; x and z of the spinner's tip
        relative to its hinge [m]; velocities of proximal, distal and hinge [rad/s]; log(1 + force) of the touch sensors
        at the top and the bottom of the fingertip [log N]; x and z of the target relative to the hinge [m]; the
        distance from the tip to the target's surface, negative inside [m].
    Action (2,): motor commands of the proximal and distal joint in [-1, 1]; gears of 30 and 15 N m.
    Reward: with the distance d from the tip to the target's edge, negative inside,
            r = 1 if d <= 0, else 0
        Returns lie in [0, 1000].
    Start: both finger joints uniform in their range, hinge and target at angles uniform in [-pi, pi], at rest, drawn
        again until nothing touches.
    Episode: 1000 steps of 0.02 s (two substeps of 0.01 s); it never terminates.

    Parameters that can vary: those of ``FingerSpin``, where the hinge's damping is 0.5 N m s/rad, and
        target-size: radius [m] of the target; dm_control's turn-easy has 0.07 and turn-hard 0.03.

    Differs from dm_control as ``FingerSpin`` does.
    """

    asks: ClassVar[str] = "Turn the body with the finger until its tip is in the target."
    parameters: ClassVar = MappingProxyType(
        {
            **_BODY,
            "spinner-damping": positive("N m s/rad", 0.5, _set_spinner_damping),
            "target-size": positive("m", 0.07),
        }
    )
    model_file: ClassVar[str] = "finger.xml"
    num_substeps: ClassVar[int] = 2
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 2
    warp_iterations: ClassVar[int] = 4
    starts_untouched: ClassVar[bool] = True
    relabels: ClassVar[tuple[str, ...]] = ("target-size", "target-angle")
    fresh_goals: ClassVar[bool] = True
    look: ClassVar = _LOOK

    def seen_spec(self, values: Mapping[str, float]) -> mujoco.MjSpec:
        """Return the model with the target, and with the spinner's tip that has to be in it."""
        spec = self.compile_spec(values)
        seen = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "rgba": TARGET, "mass": 0, "contype": 0, "conaffinity": 0}
        site = spec.site("tip")
        spec.body("spinner").add_geom(name="tip", pos=site.pos, size=site.size, **seen)
        spec.worldbody.add_geom(name="target", size=[self.parameters["target-size"].nominal, 0, 0], **seen)
        return spec

    def marks(self, task: Task, world: World) -> dict[str, Mark]:
        hinge = self.leaf(task, "body_pos")[self.models[0].body("spinner").id]
        place = hinge + jnp.stack([world.extra[0], jnp.float32(0), world.extra[1]])
        return {"target": Mark(place, size=jnp.stack([task.goal["target-size"], 0.0, 0.0]))}

    def start(self, task: Task, key: Key) -> tuple[Array, ...]:
        target_key, joint_key = jax.random.split(key)
        return *_start(self, task, joint_key), self.target(task, self.target_angle(task, target_key))

    def target_angle(self, task: Task, key: Key) -> Array:
        """Return the target's angle () [rad] in an episode: 0 is up, positive towards x."""
        return jax.random.uniform(key, minval=-math.pi, maxval=math.pi)

    def target(self, task: Task, angle: Array) -> Array:
        """Return x and z (2,) [m] of the target from the hinge. Its distance is the first capsule's length."""
        radius = jnp.sum(self.leaf(task, "geom_size")[self.models[0].geom("cap1").id])
        return radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])

    def distance(self, task: Task, seen: Array, target: Array) -> Array:
        """Return the distance () [m] from the tip to the target's surface, negative inside, given ``seen`` (9,)."""
        return jnp.linalg.norm(target - seen[2:4]) - task.goal["target-size"]

    def show(self, task: Task, seen: Array, target: Array) -> Array:
        """Return the observation, given ``seen`` (9,), all but the target."""
        return jnp.concatenate([seen, target, self.distance(task, seen, target)[None]])

    def pay(self, task: Task, seen: Array, target: Array) -> Array:
        """Return the reward (), given ``seen`` (9,)."""
        return (self.distance(task, seen, target) <= 0).astype(jnp.float32)

    def observe(self, task: Task, world: World) -> Array:
        return self.show(task, _feel(self, task, world), world.extra)

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return self.pay(task, _feel(self, task, world), world.extra)

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        target = self.target(task, self.target_angle(task, key))
        before, after = transition.obs[:9], transition.next_obs[:9]
        return transition._replace(
            obs=self.show(task, before, target),
            reward=self.pay(task, after, target),
            next_obs=self.show(task, after, target),
        )


@dataclasses.dataclass(frozen=True)
class FingerTurnTarget(FingerTurn):
    """Turn to the task's target: FingerTurn with the target always at the task's angle.

    As FingerTurn, but for the observation (9,), which ends before the target: where that is, only the task's context
    shows.

    Further parameter: target-angle [rad], 0 up and positive towards x.
    """

    asks: ClassVar[str] = "Turn the body with the finger until its tip is in the target."
    parameters: ClassVar = MappingProxyType(
        {**FingerTurn.parameters, "target-angle": Parameter("rad", 0.0, minimum=-math.inf)}
    )
    fresh_goals: ClassVar[bool] = False
    hides: ClassVar[tuple[str, ...]] = ("target",)

    def target_angle(self, task: Task, key: Key) -> Array:
        return task.goal["target-angle"]

    def show(self, task: Task, seen: Array, target: Array) -> Array:
        return seen
