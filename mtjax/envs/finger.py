"""The finger domain of dm_control: a two-link finger must keep a free spinner turning."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.family import Family, Parameter, start_joints
from mtjax.envs.physics import World
from mtjax.types import Array, Key, Task

_SPIN_VELOCITY = 15.0  # [rad/s]
_MAX_DRAWS = 1000


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
    """Set the first radius of both touch sensors' ellipsoids; no mass, shape or motion changes."""
    for name in ("touchtop", "touchbottom"):
        site = spec.site(name)
        site.size = [size, *site.size[1:]]


@dataclasses.dataclass(frozen=True)
class FingerSpin(Family):
    """Spin: keep the spinner turning at 15 rad/s or more.

    Observation (9,), all after the step: angles of the proximal and distal joint [rad]; x and z of the spinner's tip
        relative to its hinge [m]; velocities of proximal, distal and hinge [rad/s]; log(1 + force) of the touch sensors
        at the top and the bottom of the fingertip [log N].
    Action (2,): motor commands of the proximal and distal joint in [-1, 1]; gears of 30 and 15 N m.
    Reward: 1 while the hinge turns at -15 rad/s or faster, else 0; returns lie in [0, 1000].
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

    Differs from dm_control in: the floor never collides (at nominal size it is out of reach; above size 1.07 the
    fingertip passes it), and under MJX the constraint solver stops after ``solver_iterations``.
    """

    parameters: ClassVar = MappingProxyType(
        {
            "size": Parameter("1", 1.0, 0.0, _scale_links),
            "touch-size": Parameter("m", 0.025, 0.0, _widen_touch),
        }
    )
    model_file: ClassVar[str] = "finger.xml"
    num_substeps: ClassVar[int] = 2
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 2
    starts_untouched: ClassVar[bool] = True

    def prepare(self, spec: mujoco.MjSpec) -> None:
        spec.joint("hinge").damping[0] = 0.03

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        model = self.table.models[0]

        def draw(carry):
            key, _, draws = carry
            key, joint_key = jax.random.split(key)
            return key, start_joints(model, joint_key), draws + 1

        def rejected(carry):
            _, qpos, draws = carry
            return self.simulator.touching(task, qpos) & (draws < _MAX_DRAWS)

        _, qpos, _ = jax.lax.while_loop(rejected, draw, draw((key, None, 0)))
        return qpos, jnp.zeros(model.nv)

    def observe(self, task: Task, world: World) -> Array:
        joints, tip, hinge, velocities, touch = jnp.split(world.sensors, (2, 5, 8, 11))
        return jnp.concatenate([joints, (tip - hinge)[jnp.array([0, 2])], velocities, jnp.log1p(touch)])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return (world.qvel[2] <= -_SPIN_VELOCITY).astype(jnp.float32)
