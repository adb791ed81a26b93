"""The acrobot domain of dm_control: two arms in a row are swung up by a motor between them."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax.numpy as jnp

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import SELF, Look
from mtjax.envs.parameters import DAMPING, GEAR, GRAVITY, body_mass
from mtjax.types import Array, Key, Task

_TARGET_RADIUS = 0.2  # [m]


@dataclasses.dataclass(frozen=True)
class AcrobotSwingup(Domain):
    """Swing-up: bring the tip of the lower arm to where it is with both arms upright, and keep it there.

    Observation (6,), all after the step: sines of the angles of upper and lower arm from upright, then their cosines;
        velocities of shoulder and elbow [rad/s].
    Action (1,): torque of the elbow in [-1, 1]; a gear of 2 N m.
    Reward: with the distance d from the tip to the target,
            r = 0.1^(x^2),  x = max(d - 0.2, 0)
            r = 1 if d <= 0.2, else 0  (sparse)
        The first is 1 within 0.2 m, and falls as a Gaussian to 0.1 at 1 m from that. Returns lie in [0, 1000].
    Start: shoulder and elbow uniform in [-pi, pi], at rest.
    Episode: 1000 steps of 0.01 s (one Runge-Kutta step of fourth order); it never terminates.

    Parameters that can vary:
        upper-mass, lower-mass: scale of the mass and inertia of the upper and of the lower arm (1 kg each).
        gravity: [m/s^2].
        damping: scale of the damping of both joints.
        gear: scale of the motor's torque.

    Differs from dm_control in: nothing.
    """

    sparse: bool = False
    """Give a reward of 1 at the goal and 0 elsewhere."""

    asks: ClassVar[str] = "Swing the acrobot up and balance it upright."
    parameters: ClassVar = MappingProxyType(
        {
            "upper-mass": body_mass("upper_arm"),
            "lower-mass": body_mass("lower_arm"),
            "gravity": GRAVITY,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "acrobot.xml"
    num_substeps: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 1000
    gpu_engine: ClassVar[str] = "mjx"
    default_iterations: ClassVar[int] = 1
    starts_untouched: ClassVar[bool] = True
    look: ClassVar = Look((0, -6, 2), 90, light=(0, 0, 6), colours=(("lower_arm", SELF),))

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        return start_joints(self.models[0], key), jnp.zeros(2)

    def observe(self, task: Task, world: World) -> Array:
        angles = jnp.cumsum(world.qpos)
        return jnp.concatenate([jnp.sin(angles), jnp.cos(angles), world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        margin = 0.0 if self.sparse else 1.0
        return tolerance(jnp.linalg.norm(self.to_target(task, world)), 0.0, _TARGET_RADIUS, margin)

    def to_target(self, task: Task, world: World) -> Array:
        """Return the vector (2,) [m] from the tip to the target, along x and z."""
        model, bodies, sites = self.models[0], self.leaf(task, "body_pos")[:, 2], self.leaf(task, "site_pos")[:, 2]
        shoulder, elbow = bodies[model.body("upper_arm").id], bodies[model.body("lower_arm").id]
        target, tip = sites[model.site("target").id], sites[model.site("tip").id]
        lengths, angles = jnp.stack([elbow, tip]), jnp.cumsum(world.qpos)
        return jnp.stack([-jnp.sum(lengths * jnp.sin(angles)), target - shoulder - jnp.sum(lengths * jnp.cos(angles))])
