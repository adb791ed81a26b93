"""The quadruped domain of dm_control: a heavy body on four legs walks and runs."""

import dataclasses
from types import MappingProxyType
from typing import Any, ClassVar

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.dm_control.attitude import any_attitude, upward
from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, GRAVITY, MASS, STRENGTH, body_mass, positive
from mtjax.types import Array, Key, Task

_SECONDS = 20.0  # of an episode, in which the floor must not end
_LIFT = 0.01  # [m] by which dm_control lifts a body out of the floor
_ANKLE = 0.05  # [m] from a foot's lower end to the middle of its toe


def _set_foot_length(spec: mujoco.MjSpec, length: float) -> None:
    for body in spec.bodies:
        if body.name.startswith("ankle"):
            body.geoms[0].fromto = [0, 0, 0, 0, 0, -length]
            body.bodies[0].pos = [0, 0, -length - _ANKLE]


@dataclasses.dataclass(frozen=True)
class QuadrupedWalk(Domain):
    """Walk: move forwards at 0.5 m/s or faster, the back up.

    Observation (78,), all after the step: of the legs front left, front right, back right and back left the angles of
        yaw, pitch, knee and ankle [rad], and then the velocities in the same order [rad/s]; the servos' activations, in
        the order of the action; velocity of the torso in its own frame [m/s]; its uprightness, from -1 to 1; its
        acceleration with gravity [m/s^2] and its turning rate [rad/s], in its own frame; arcsinh of forces [N] and then
        of torques [N m] at the four toes, x, y and z each.
    Action (12,): of the four legs in that order, what servos pull yaw, lift and extension to. [-1, 1] spans [-1, 1]
        rad, [-1, 1.1] rad and [-0.8, 0.8] rad; the servos follow with a lag of 0.1 s.
    Reward: in [0, 1],
            r = upright move
        where upright goes from 0 (back down) to 1, move is 1 where the torso's velocity along
        its own x axis is ``speed`` or more, falling linearly to 0.5 at rest and 0 at ``speed`` backwards. Returns lie
        in [0, 1000].
    Start: legs straight in the model's pose, the body turned anyhow, at rest, in the lowest of the heights 0, 0.01,
        0.02, ... m at which nothing touches; activations of 0.
    Episode: 1000 steps of 0.02 s (four substeps of 0.005 s); it never terminates.

    Parameters that can vary:
        foot-length: length [m] of the axis of all four feet, their mass by density; the toes stay 0.05 m below.
        torso-mass: scale of the torso's mass.
        mass, friction, damping, strength: scale of all masses, of the sliding friction of all geoms, of the damping of
            all joints, of the stiffness of all servos. gravity [m/s^2].
        speed: velocity [m/s] from which the reward for moving is 1.

    Differs from dm_control in: actions are scaled to the servos' ranges, where dm_control takes the angles themselves;
    under MJX the constraint solver stops after ``solver_iterations``, and limbs that stand on the floor have another
    friction (see ``humanoid.Humanoid``), in three states of random play in a thousand.
    """

    parameters: ClassVar = MappingProxyType(
        {
            "foot-length": positive("m", 0.25, _set_foot_length),
            "torso-mass": body_mass("torso"),
            "mass": MASS,
            "gravity": GRAVITY,
            "friction": FRICTION,
            "damping": DAMPING,
            "strength": STRENGTH,
            "speed": positive("m/s", 0.5),
        }
    )
    model_file: ClassVar[str] = "quadruped.xml"
    num_substeps: ClassVar[int] = 4
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 6
    look: ClassVar = Look((0, 4, 2), 63.435, turn=180, light=(0, 0, 4), follow="torso")

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Make the floor as long as a run at the family's own speed."""
        length = _SECONDS * self.parameters["speed"].nominal
        spec.geom("floor").size = [length, length, 0.5]

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the leaves (R, ...) of every row of the table, with places, axes and sizes (R, G, 15) of all shapes.

        They are in the torso's frame, in the model's own pose.
        """
        built, distinct = super().build(), {id(model): model for model in self.models}
        found = {name: _pose(model) for name, model in distinct.items()}
        starts = np.float32(np.stack([found[id(model)] for model in self.models]))
        return built | {"goal": built["goal"] | {"starts": starts}}

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        model, turned = self.models[0], any_attitude(key)
        height = _LIFT * jnp.maximum(jnp.ceil(-self._lowest(task, upward(turned)) / _LIFT), 0.0)
        rest = jnp.asarray(model.qpos0, jnp.float32)
        return rest.at[2].set(height).at[3:7].set(turned), jnp.zeros(model.nv)

    def _lowest(self, task: Task, up: Array) -> Array:
        """Return the height () [m] of the lowest point of all shapes over the torso's middle.

        Args:
            up: (3,) the upward direction in the torso's frame.
        """
        places, axes, sizes = jnp.split(task.goal["starts"], (3, 12), axis=1)
        dot = lambda x: jnp.einsum("...i,...i->...", x, up, precision="highest")
        along = dot(axes.reshape(-1, 3, 3))  # (G, 3) the direction in each shape's own frame
        radius, half, upright = sizes[:, 0], sizes[:, 1], jnp.abs(along[:, 2])
        kinds, kind = np.asarray(self.models[0].geom_type[1:]), mujoco.mjtGeom
        reach = jnp.select(
            [kinds == kind.mjGEOM_SPHERE, kinds == kind.mjGEOM_CAPSULE, kinds == kind.mjGEOM_CYLINDER],
            [radius, radius + half * upright, half * upright + radius * jnp.sqrt(jnp.maximum(1 - upright**2, 0.0))],
            jnp.linalg.norm(sizes * along, axis=1),  # an ellipsoid's
        )
        return jnp.min(dot(places) - reach)

    def observe(self, task: Task, world: World) -> Array:
        acceleration, turning, velocity, felt = jnp.split(world.sensors, (3, 6, 9))
        legs = [world.qpos[7:], world.qvel[6:], world.act]
        body = [velocity, upward(world.qpos[3:7])[2:], acceleration, turning]
        return jnp.concatenate([*legs, *body, jnp.arcsinh(felt)])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        speed, forwards = task.goal["speed"], world.sensors[6]
        move = tolerance(forwards, speed, jnp.inf, speed, "linear", value_at_margin=0.5)
        return (1 + upward(world.qpos[3:7])[2]) / 2 * move


@dataclasses.dataclass(frozen=True)
class QuadrupedRun(QuadrupedWalk):
    """Run: QuadrupedWalk at 5 m/s."""

    parameters: ClassVar = MappingProxyType({**QuadrupedWalk.parameters, "speed": positive("m/s", 5.0)})


def _pose(model: mujoco.MjModel) -> np.ndarray:
    """Return place (3), axes (9, each a row) and size (3) of all shapes but the floor (G, 15), from the torso."""
    data = mujoco.MjData(model)
    data.qpos[:3] = 0  # the torso's frame is then the world's
    mujoco.mj_kinematics(model, data)
    axes = data.geom_xmat.reshape(-1, 3, 3).swapaxes(1, 2).reshape(-1, 9)
    return np.concatenate([data.geom_xpos, axes, model.geom_size], axis=1)[1:]
