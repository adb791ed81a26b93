"""The dog domain of dm_control: a dog of 73 joints stands, walks, trots and runs."""

import dataclasses
import math
from collections.abc import Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.dm_control.attitude import into_frame, upward
from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, GRAVITY, MASS, STRENGTH, body_mass, positive
from mtjax.types import Array, InputError, Key, Step, Task

_SECONDS = 15.0  # of an episode, in which the floor must not end
_STANDING = 0.9  # of the heights in the model's own pose
_UPRIGHT = math.cos(math.radians(30))
_JOLT = 2.0  # [m/s and rad/s] standard deviation of the velocities at a start
_OBJECT, _SENSOR = mujoco.mjtObj, mujoco.mjtSensor
_PAWS = ("palm_L", "palm_R", "sole_L", "sole_R")
_OF_FETCH = ("target", "wall_px", "wall_py", "wall_nx", "wall_ny")


def _whole_dog() -> mujoco.MjSpec:
    """Read the model of an installed dm_control, without what is fetched, cameras and lights.

    Raises:
        InputError: dm_control is not installed.
    """
    found = find_spec("dm_control")
    if found is None or not found.submodule_search_locations:
        raise InputError("the dog's model is a part of dm_control, which is not installed: pip install dm_control")
    spec = mujoco.MjSpec.from_file(str(Path(found.submodule_search_locations[0]) / "suite" / "dog.xml"))
    fetched = [spec.body("ball"), *(spec.geom(name) for name in _OF_FETCH)]
    for each in (*fetched, *spec.cameras, *spec.lights):
        spec.delete(each)
    return spec


@lru_cache
def _read_dog() -> mujoco.MjSpec:
    """Read the dog without what physics does not need.

    The bones are meshes that touch nothing. They give the bodies their mass and inertia, which are written down before
    the bones are dropped.
    """
    spec = _whole_dog()
    for skin in spec.skins:
        spec.delete(skin)
    whole = spec.compile()
    for body in spec.bodies[1:]:
        i = whole.body(body.name).id
        body.explicitinertial, body.mass = True, whole.body_mass[i]
        body.ipos, body.iquat, body.inertia = whole.body_ipos[i], whole.body_iquat[i], whole.body_inertia[i]
    for joint in spec.joints[1:]:  # the tail's springs follow from inertia; those of edited dogs shall be the same
        i = whole.joint(joint.name).id
        joint.springdamper, joint.stiffness[0] = [0, 0], whole.jnt_stiffness[i]
        joint.damping[0] = whole.dof_damping[whole.jnt_dofadr[i]]
    bones = [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH]
    for each in (*bones, *spec.meshes, *spec.materials, *spec.textures):
        spec.delete(each)
    for geom in spec.geoms:
        geom.material = ""
    for name in ("skull", "pelvis"):
        spec.add_sensor(name=name, type=_SENSOR.mjSENS_FRAMEQUAT, objtype=_OBJECT.mjOBJ_XBODY, objname=name)
    spec.add_sensor(name="height", type=_SENSOR.mjSENS_FRAMEPOS, objtype=_OBJECT.mjOBJ_XBODY, objname="pelvis")
    return spec


def _simplify(base: mujoco.MjModel) -> None:
    """Let all but the teeth touch the floor, and nothing itself."""
    body = (base.geom_contype > 0) & (base.geom_bodyid > 0) & (base.geom_condim == 1)
    base.geom_contype[:], base.geom_conaffinity[:] = base.geom_bodyid == 0, body
    base.opt.noslip_iterations = 0


@dataclasses.dataclass(frozen=True)
class Dog(Domain):
    """A dog whose tasks are to stand, or to stand and move.

    Observation (223,), all after the step: angles of all 73 joints [rad] and their velocities [rad/s]; heights of torso
        and pelvis [m]; the world's upward direction in the frames of skull, torso and pelvis; velocity of the centre of
        mass in the torso's frame [m/s]; the head's acceleration with gravity [m/s^2], velocity [m/s] and turning rate
        [rad/s]; forces at left and right foot and left and right hand, x, y and z each [N]; touch sensors of left and
        right palm and left and right sole [N]; the 38 motors' activations.
    Action (38,): motor commands in [-1, 1] of the back (extend, bend, twist), neck and tail (extend, bend), of the left
        and the right hind leg, of head and jaw, and of the left and the right foreleg, in the model's order; they act
        with a lag of 0.05 s.
    Reward: in [0, 1],
            r = stand (4 move + 1) / 5
        where stand is the product of six factors in [0, 1]. Two are 1 where torso and pelvis
        are at 0.9 of the height of the model's own pose or above, and fall as Gaussians to 0.1 on the ground; three are
        1 where head, torso and pelvis are upright to 30 degrees, and fall linearly to 0 upside down; one is 1 where the
        paws bear the whole weight or more, and falls linearly to 0.9 where they bear none. move is 1 where the velocity
        of the centre of mass along the torso's own x axis is between ``speed`` and twice that, and falls linearly to 0
        at rest and at three times that. Below a ``speed`` of 1 m/s it reaches 0 at 1 m/s from these bounds. Returns lie
        in [0, 1000].
    Start: the model's own pose turned by any angle about the vertical, with velocities along x and y and about z of a
        standard deviation of 2 m/s and 2 rad/s; activations uniform in [-1, 1].
    Episode: 1000 steps of 0.015 s (three substeps of 0.005 s); it never terminates.

    The model is read from an installed dm_control (``pip install dm_control``). Films show its skin. Through
    ``pixels`` painter warp shows its bones, and painter caster refuses, as it draws no meshes.

    Parameters that can vary:
        torso-mass: scale of mass and inertia of the torso.
        mass, friction, damping, strength: scale of all masses and inertias, of the sliding friction of all geoms, of
            the damping of all joints, of the force of all motors. gravity [m/s^2].
        speed: least velocity [m/s] at which the reward for moving is 1.

    Differs from dm_control in: nothing on MuJoCo C. MJX and Warp lack some pairs of shapes, and would take thousands:
    there the dog touches the floor alone and not itself, its teeth touch nothing, the solver stops after
    ``solver_iterations``, and no further iterations hold still what slips.
    """

    parameters: ClassVar = MappingProxyType(
        {
            "torso-mass": body_mass("torso"),
            "mass": MASS,
            "gravity": GRAVITY,
            "friction": FRICTION,
            "damping": DAMPING,
            "strength": STRENGTH,
        }
    )
    model_file: ClassVar = staticmethod(lambda: _read_dog().copy())  # dm_control's
    num_substeps: ClassVar[int] = 3
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 6
    simplify: ClassVar = staticmethod(_simplify)
    floor: ClassVar[float] = 15.0  # [m] half a side
    meshes: ClassVar[bool] = True
    look: ClassVar = Look((0, -1.5, 0.8), 59.036, light=(0, 0, 3), follow="torso")

    def seen_spec(self, values: Mapping[str, float]) -> mujoco.MjSpec:
        spec = _whole_dog()
        self.prepare(spec)
        for geom in spec.geoms if self.pixels else ():  # Warp draws no skin: bones come into view
            geom.group = 0 if geom.type == mujoco.mjtGeom.mjGEOM_MESH else geom.group
        return spec

    def prepare(self, spec: mujoco.MjSpec) -> None:
        spec.geom("floor").size = [self.floor, self.floor, 0.1]

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the leaves (R, ...) of every row of the table, with what the reward asks for (R, 3).

        These are the heights of torso and pelvis [m], and the body's weight [N].
        """
        built, distinct = super().build(), {id(model): model for model in self.models}
        found = {name: _demands(model) for name, model in distinct.items()}
        starts = np.float32(np.stack([found[id(model)] for model in self.models]))
        return built | {"goal": built["goal"] | {"starts": starts}}

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        turn_key, jolt_key = jax.random.split(jax.random.split(key)[1])
        model, half = self.models[0], jax.random.uniform(turn_key, maxval=math.pi)
        turned = jnp.stack([jnp.cos(half), jnp.sin(half)])
        qpos = jnp.asarray(model.qpos0, jnp.float32).at[jnp.array([3, 6])].set(turned)
        jolt = _JOLT * jax.random.normal(jolt_key, (3,))
        return qpos, jnp.zeros(model.nv).at[jnp.array([0, 1, 5])].set(jolt)

    def first_step(self, task: Task, world: World, key: Key) -> Step:
        """Begin an episode. Sensors are those of a dog whose motors do not act yet, as in dm_control."""
        act = jax.random.uniform(jax.random.split(key)[0], (self.models[0].na,), minval=-1.0)
        return super().first_step(task, world._replace(act=act), key)

    def _read(self, world: World) -> dict[str, Array]:
        """Return the values of all sensors by name."""
        ends = np.cumsum(self.models[0].sensor_dim)[:-1]
        names = [self.models[0].sensor(i).name for i in range(self.models[0].nsensor)]
        return dict(zip(names, jnp.split(world.sensors, ends), strict=True))

    def _upward(self, world: World, sensed: dict[str, Array]) -> Array:
        """Return the upward direction in the frames of skull, torso and pelvis (3, 3)."""
        return jnp.stack([upward(quat) for quat in (sensed["skull"], world.qpos[3:7], sensed["pelvis"])])

    def _heights(self, world: World, sensed: dict[str, Array]) -> Array:
        """Return the heights (2,) [m] of torso and pelvis."""
        return jnp.stack([world.qpos[2], sensed["height"][2]])

    def observe(self, task: Task, world: World) -> Array:
        sensed = self._read(world)
        pose = [self._heights(world, sensed), self._upward(world, sensed).ravel()]
        felt = ("accelerometer", "velocimeter", "gyro", "foot_L", "foot_R", "hand_L", "hand_R", *_PAWS)
        moving = [into_frame(world.qpos[3:7], sensed["torso_linvel"]), *(sensed[name] for name in felt)]
        return jnp.concatenate([world.qpos[7:], world.qvel[6:], *pose, *moving, world.act])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        speed, velocity = task.goal["speed"], self._read(world)["torso_linvel"]
        forwards = into_frame(world.qpos[3:7], velocity)[0]
        move = tolerance(forwards, speed, 2 * speed, jnp.maximum(speed, 1.0), "linear", value_at_margin=0)
        return self.standing(task, world) * (4 * move + 1) / 5

    def standing(self, task: Task, world: World) -> Array:
        """Return the reward's factor () in [0, 1] for a dog on its paws."""
        sensed, asked = self._read(world), task.goal["starts"]
        high = tolerance(self._heights(world, sensed), asked[:2], jnp.inf, asked[:2])
        up = self._upward(world, sensed)[:, 2]
        upright = tolerance(up, _UPRIGHT, jnp.inf, _UPRIGHT + 1, "linear", value_at_margin=0)
        borne = jnp.sum(jnp.concatenate([sensed[name] for name in _PAWS]))
        firm = tolerance(borne, asked[2], jnp.inf, asked[2], "linear", value_at_margin=0.9)
        return jnp.prod(high) * jnp.prod(upright) * firm


@dataclasses.dataclass(frozen=True)
class DogStand(Dog):
    """Stand: keep torso and pelvis high, the back and the head up and the weight on the paws.

    Reward: with ``Dog``'s product of six factors,
            r = stand
        There is no ``speed``. Returns lie in [0, 1000].
    """

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return self.standing(task, world)


@dataclasses.dataclass(frozen=True)
class DogWalk(Dog):
    """Walk: move forwards at 1 to 2 m/s, upright."""

    parameters: ClassVar = MappingProxyType({**Dog.parameters, "speed": positive("m/s", 1.0)})


@dataclasses.dataclass(frozen=True)
class DogTrot(Dog):
    """Trot: move forwards at 3 to 6 m/s, upright."""

    parameters: ClassVar = MappingProxyType({**Dog.parameters, "speed": positive("m/s", 3.0)})
    floor: ClassVar[float] = 3 * _SECONDS


@dataclasses.dataclass(frozen=True)
class DogRun(Dog):
    """Run: move forwards at 9 to 18 m/s, upright."""

    parameters: ClassVar = MappingProxyType({**Dog.parameters, "speed": positive("m/s", 9.0)})
    floor: ClassVar[float] = 9 * _SECONDS


def _demands(model: mujoco.MjModel) -> np.ndarray:
    data, torso = mujoco.MjData(model), model.body("torso").id
    mujoco.mj_kinematics(model, data)
    heights = data.xpos[[torso, model.body("pelvis").id], 2]
    return np.append(_STANDING * heights, -model.opt.gravity[2] * model.body_subtreemass[torso])
