"""The swimmer domain of dm_control: a chain of links brings its nose to a target in the plane."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, start_joints
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import GEAR, MASS, WATER, positive
from mtjax.envs.pixels import Mark
from mtjax.types import Array, InputError, Key, Task

_LINK_LENGTH = 0.1  # [m]
_HEIGHT = 0.05  # [m] of the body and the target
_NEAR, _FAR = 0.3, 2.0  # [m] half-sides of the squares that targets are drawn from
_NEAR_SHARE = 0.2
_FEWEST, _MOST = 3, 64  # links
_OBJECT, _SENSOR = mujoco.mjtObj, mujoco.mjtSensor


def _set_link_length(spec: mujoco.MjSpec, length: float) -> None:
    """Set the length of every link behind the head's, which keep their mass."""
    for body in spec.bodies[2:]:
        gap = _LINK_LENGTH if body.parent.name == "head" else length  # from the middle of the link before
        body.pos = [0, (gap + length) / 2, 0]
        body.joints[0].pos = [0, -length / 2, 0]
        for geom in body.geoms:
            if geom.type == mujoco.mjtGeom.mjGEOM_BOX:
                geom.size = [geom.size[0], length / 2, geom.size[2]]
            else:
                geom.fromto = [0, -length / 2, 0, 0, length / 2, 0]


def _set_target_size(spec: mujoco.MjSpec, size: float) -> None:
    spec.geom("target").size = [size, 0, 0]


@dataclasses.dataclass(frozen=True)
class Swimmer(Domain):
    """Swim: bring the nose of a chain of links to a target, which is somewhere else in every episode.

    Observation (4 * links + 1,), all after the step: angles of the joints from the head on [rad]; x and y of the target
        as seen from the nose, in the head's frame [m]; then of every link its velocity along its own x and y [m/s] and
        about z [rad/s].
    Action (links - 1,): torques of the joints from the head on in [-1, 1]; gears of 0.0005 N m.
    Reward: with the distance d from the nose to the target's edge, 0 inside, and m, five of its radii,
            r = 1 / (1 + (3 d / m)^2)
        Returns lie in [0, 1000].
    Start: every joint uniform in its range of 360 degrees over the number of links to both sides, the body turned
        anyhow about its head, at rest; the target uniform in a square of 2 m to both sides of the head, or of 0.3 m in
        a fifth of the episodes.
    Episode: 1000 steps of 0.03 s (15 substeps of 0.002 s); it never terminates.

    ``links`` is the number of links, 3 or more: dm_control's swimmer6 has 6 and swimmer15 has 15.

    Parameters that can vary:
        link-length: length [m] of the links behind the head's, which keep their mass; the water pushes longer ones
            more.
        target-size: radius [m] of the target.
        water-density: density [kg/m^3] of the water.
        mass, gear: scale of all masses and of the strength of all motors.

    Differs from dm_control in: under MJX the constraint solver stops after ``solver_iterations``; it acts only at the
    ends of the joints' ranges.
    """

    links: int = 6
    """Number of links of the swimmer, the head's included."""

    parameters: ClassVar = MappingProxyType(
        {
            "link-length": positive("m", _LINK_LENGTH, _set_link_length),
            "target-size": positive("m", 0.1, _set_target_size),
            "water-density": WATER._replace(nominal=3000.0),
            "mass": MASS,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "swimmer.xml"
    num_substeps: ClassVar[int] = 15
    gpu_engine: ClassVar[str] = "mjx"  # nothing touches
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 4
    starts_untouched: ClassVar[bool] = True
    fresh_goals: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        if not _FEWEST <= self.links <= _MOST:
            raise InputError(f"links must be from {_FEWEST} to {_MOST}, not {self.links}")

    @property
    def look(self) -> Look:  # type: ignore
        """Return a camera that goes back as the swimmer grows, and a lamp that shows where a target out of sight is."""
        scale = self.links / 6
        mounted = {"light": (0, 0, 1.5), "diffuse": 0.8, "follow": "head", "mounted": True}
        return Look((0, -0.2 * scale, 0.5 * scale), 45, fovy=60, lamp="target", **mounted)

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Hang the other links behind the head, each with a motor and with sensors of its own."""
        parent, limit = spec.body("head"), 360 / self.links
        link, inertial, visual = (spec.find_default(name) for name in ("link", "inertial", "visual"))
        for i in range(self.links - 1):
            parent = parent.add_body(name=f"segment_{i}", pos=[0, _LINK_LENGTH, 0])
            parent.add_geom(visual, name=f"visual_{i}")
            parent.add_geom(inertial, name=f"inertial_{i}")
            parent.add_site(link, name=f"site_{i}")
            parent.add_joint(link, name=f"joint_{i}", range=[-limit, limit])
            spec.add_actuator(name=f"motor_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=f"joint_{i}")
            for name, kind in (("velocimeter", _SENSOR.mjSENS_VELOCIMETER), ("gyro", _SENSOR.mjSENS_GYRO)):
                spec.add_sensor(name=f"{name}_{i}", type=kind, objtype=_OBJECT.mjOBJ_SITE, objname=f"site_{i}")

    def start(self, task: Task, key: Key) -> tuple[Array, Array, Array]:
        """Draw positions and velocities of the joints, and the place of the target (2,) [m]."""
        joint_key, near_key, target_key = jax.random.split(key, 3)
        side = jnp.where(jax.random.bernoulli(near_key, _NEAR_SHARE), _NEAR, _FAR)
        target = jax.random.uniform(target_key, (2,), minval=-side, maxval=side)
        return start_joints(self.models[0], joint_key), jnp.zeros(self.models[0].nv), target

    def marks(self, task: Task, world: World) -> dict[str, Mark]:
        return {"target": Mark(jnp.append(world.extra, _HEIGHT))}

    def way(self, world: World) -> Array:
        """Return x and y (2,) [m] of the target as seen from the nose, in the head's frame."""
        nose, *axes = jnp.split(world.sensors[:9], 3)
        apart = jnp.append(world.extra, _HEIGHT) - nose
        return jnp.stack([jnp.dot(apart, axis, precision="highest") for axis in axes])

    def observe(self, task: Task, world: World) -> Array:
        moving = world.sensors[9:].reshape(-1, 6)[:, jnp.array([0, 1, 5])]
        return jnp.concatenate([world.qpos[3:], self.way(world), moving.ravel()])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        size = self.leaf(task, "geom_size")[self.models[0].geom("target").id, 0]
        return tolerance(jnp.linalg.norm(self.way(world)), 0.0, size, 5 * size, "long_tail")
