"""Poses of everything that a picture shows, from the positions of any engine's world.

MuJoCo's C engine and MuJoCo Warp do not return poses, and importing MJX takes seconds. This code computes what a
picture needs, in plain JAX. Vectors and quaternions are tuples of scalars, or of arrays with one number for each geom.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.types import Array, InputError

Vector = tuple[Any, ...]  # three numbers or arrays of the same shape
Quaternion = tuple[Any, ...]  # four of them
Axes = tuple[Vector, ...]  # the x, y and z axis of a frame

_MODE = mujoco.mjtCamLight
MODES = tuple(map(int, (_MODE.mjCAMLIGHT_FIXED, _MODE.mjCAMLIGHT_TRACK, _MODE.mjCAMLIGHT_TRACKCOM)))

# The fields of a model that poses depend on.
FIELDS = tuple(
    """
    qpos0 body_pos body_quat body_ipos body_mass jnt_pos jnt_axis geom_pos geom_quat cam_pos cam_quat cam_pos0
    cam_poscom0 cam_mat0 light_pos light_dir light_pos0 light_poscom0 light_dir0
    """.split()
)


class Pose(NamedTuple):
    """Where a thing is in the world and how it is turned, or many things."""

    position: Vector  # [m]
    axes: Axes


class Poses(NamedTuple):
    """Poses of geoms, of the camera and of lights."""

    geoms: Pose  # with numbers (ngeom,)
    camera: Pose
    lights: tuple[tuple[Vector, Vector], ...]  # position [m] and direction of each


def require_known(model: mujoco.MjModel) -> None:
    """Refuse cameras and lights that turn towards a body.

    Raises:
        InputError: the first camera or a light does so.
    """
    if not model.ncam:
        raise InputError("the scene of this family has no camera")
    if model.cam_mode[0] not in MODES or not np.all(np.isin(model.light_mode, MODES)):
        raise InputError("the first camera and all lights must be of the mode fixed, track or trackcom")


def locate(model: mujoco.MjModel, leaf: Callable[[str], Array], qpos: Array) -> Poses:
    """Return the poses of all geoms, of the first camera and of the lights.

    Args:
        model: gives the tree of bodies.
        leaf: a field of the task's own scene, by its name.
        qpos: (nq,).
    """
    frames = _frames(model, leaf, qpos)
    position, quat = _mount(_of(frames, model.geom_bodyid), tuple(leaf("geom_pos").T), tuple(leaf("geom_quat").T))
    lights = tuple(_light(model, leaf, frames, i) for i in range(model.nlight))
    return Poses(Pose(position, axes_of(quat)), _camera(model, leaf, frames), lights)


class _Joints(NamedTuple):
    """The joints of one body, or of all, up to the largest number that a body has; (J,) each."""

    anchor: Array  # (J, 3)
    axis: Array  # (J, 3)
    slid: Array  # [m]; 0 for all but slides
    angle: Array  # [rad]; 0 for all but hinges
    ball: Array  # bool
    free: Array  # bool
    given: Array  # (J, 7) what free joints and balls have in place of a number


def _frames(model: mujoco.MjModel, leaf: Callable[[str], Array], qpos: Array) -> Array:
    """Return position and rotation of every body (nbody, 7).

    A scan over bodies compiles in a tenth of the time: unrolled, XLA repeats all parents in each body's kernel.
    """

    def place(frames: Array, body: tuple) -> tuple[Array, None]:
        number, parent, position, quat, joints = body
        position, quat = _mount(_of(frames, parent), tuple(position), tuple(quat))
        for j in range(joints.slid.shape[0]):
            position, quat = _move(position, quat, jax.tree.map(lambda x, j=j: x[j], joints), special)
        return frames.at[number].set(jnp.stack([*position, *quat])), None

    joints, special = _joints(model, leaf, qpos)
    numbers = np.arange(1, model.nbody, dtype=np.int32)
    world = jnp.zeros((model.nbody, 7)).at[:, 3].set(1.0)
    bodies = (numbers, np.int32(model.body_parentid[1:]), leaf("body_pos")[1:], leaf("body_quat")[1:], joints)
    return jax.lax.scan(place, world, jax.tree.map(jnp.asarray, bodies))[0]


def _joints(model: mujoco.MjModel, leaf: Callable[[str], Array], qpos: Array) -> tuple[_Joints, bool]:
    """Return the joints of all bodies but the world (nbody - 1, J), and whether any is free or a ball."""
    most = int(model.body_jntnum.max(initial=1))
    slots = model.body_jntadr[1:, None] + np.arange(most)
    real = np.arange(most) < model.body_jntnum[1:, None]
    slots = np.where(real, slots, 0)
    kind = np.where(real, model.jnt_type[slots] if model.njnt else 0, -1)
    at = model.jnt_qposadr[slots] if model.njnt else slots
    moved = qpos[at] - leaf("qpos0")[at] if model.njnt else jnp.zeros(slots.shape)
    is_kind = lambda name: kind == int(getattr(mujoco.mjtJoint, f"mjJNT_{name}"))
    ball, free = is_kind("BALL"), is_kind("FREE")
    given = qpos[np.minimum(at[..., None] + np.arange(7), max(model.nq - 1, 0))]
    joints = _Joints(
        anchor=leaf("jnt_pos")[slots],
        axis=leaf("jnt_axis")[slots],
        slid=jnp.where(is_kind("SLIDE"), moved, 0.0),
        angle=jnp.where(is_kind("HINGE"), moved, 0.0),
        ball=jnp.asarray(ball),
        free=jnp.asarray(free),
        given=given,
    )
    return joints, bool(np.any(ball | free))


def _move(position: Vector, quat: Quaternion, joint: _Joints, special: bool) -> tuple[Vector, Quaternion]:
    """Return a body's frame after one of its joints."""
    axis, anchor = tuple(joint.axis), tuple(joint.anchor)
    position = _add(position, _times(joint.slid, turn(quat, axis)))
    turned = _about(axis, joint.angle)
    if special:
        turned = _choose(joint.ball, _unit(tuple(joint.given[:4])), turned)
    held = _add(position, turn(quat, anchor))
    quat = _multiply(quat, turned)
    position = _add(held, _times(-1.0, turn(quat, anchor)))
    if not special:
        return position, quat
    free = tuple(joint.given[:3]), _unit(tuple(joint.given[3:]))
    return _choose(joint.free, free[0], position), _choose(joint.free, free[1], quat)


def _choose(mask: Array, ours: tuple, theirs: tuple) -> tuple:
    return tuple(jnp.where(mask, one, other) for one, other in zip(ours, theirs, strict=True))


def _of(frames: Array, body: Any) -> tuple[Vector, Quaternion]:
    """Return position and rotation of one body, or of several."""
    numbers = frames[body]
    return tuple(numbers[..., i] for i in range(3)), tuple(numbers[..., i] for i in range(3, 7))


def _camera(model: mujoco.MjModel, leaf: Callable[[str], Array], frames: Array) -> Pose:
    body, mode = model.cam_bodyid[0], model.cam_mode[0]
    if mode == _MODE.mjCAMLIGHT_FIXED:
        position, quat = _mount(_of(frames, body), tuple(leaf("cam_pos")[0]), tuple(leaf("cam_quat")[0]))
        return Pose(position, axes_of(quat))
    rows = leaf("cam_mat0")[0].reshape(3, 3)
    axes = tuple(tuple(rows[:, i]) for i in range(3))
    return Pose(_follow(model, leaf, frames, body, mode, "cam", 0), axes)


def _light(model: mujoco.MjModel, leaf: Callable[[str], Array], frames: Array, i: int) -> tuple[Vector, Vector]:
    body, mode = model.light_bodyid[i], model.light_mode[i]
    if mode == _MODE.mjCAMLIGHT_FIXED:
        position, quat = _of(frames, body)
        return _add(position, turn(quat, tuple(leaf("light_pos")[i]))), turn(quat, tuple(leaf("light_dir")[i]))
    return _follow(model, leaf, frames, body, mode, "light", i), tuple(leaf("light_dir0")[i])


def _follow(model, leaf, frames: Array, body: int, mode: int, kind: str, i: int) -> Vector:
    """Return the position of a camera or light that follows a body, or its subtree's centre of mass."""
    if mode == _MODE.mjCAMLIGHT_TRACK:
        return _add(_of(frames, body)[0], tuple(leaf(f"{kind}_pos0")[i]))
    return _add(_centre(model, leaf, frames, body), tuple(leaf(f"{kind}_poscom0")[i]))


def _centre(model: mujoco.MjModel, leaf: Callable[[str], Array], frames: Array, root: int) -> Vector:
    """Return the centre of mass of a body and its descendants."""
    inside = np.zeros(model.nbody, bool)
    for body in range(model.nbody):
        inside[body] = body == root or (body > 0 and inside[model.body_parentid[body]])
    members = np.flatnonzero(inside)
    position, quat = _of(frames, members)
    masses = leaf("body_mass")[members]
    centres = _add(position, turn(quat, tuple(leaf("body_ipos")[members].T)))
    return tuple(jnp.sum(masses * x) / jnp.sum(masses) for x in centres)


def axes_of(quat: Quaternion) -> Axes:
    """Return the axes of a rotated frame."""
    w, x, y, z = quat
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def turn(quat: Quaternion, vector: Vector) -> Vector:
    """Rotate a vector."""
    w, *imaginary = quat
    twice = _times(2.0, _cross(imaginary, vector))
    return _add(_add(vector, _times(w, twice)), _cross(imaginary, twice))


def _mount(frame: tuple[Vector, Quaternion], position: Vector, quat: Quaternion) -> tuple[Vector, Quaternion]:
    """Return position and rotation in the world of what is mounted in a frame."""
    return _add(frame[0], turn(frame[1], position)), _multiply(frame[1], quat)


def _multiply(one: Quaternion, other: Quaternion) -> Quaternion:
    a, b, c, d = one
    w, x, y, z = other
    return (
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    )


def _about(axis: Vector, angle: Array) -> Quaternion:
    sin = jnp.sin(angle / 2)
    return jnp.cos(angle / 2), axis[0] * sin, axis[1] * sin, axis[2] * sin


def _unit(quat: Quaternion) -> Quaternion:
    scale = 1 / jnp.sqrt(sum(x * x for x in quat))
    return tuple(x * scale for x in quat)


def _cross(one, other) -> Vector:
    (a, b, c), (x, y, z) = one, other
    return b * z - c * y, c * x - a * z, a * y - b * x


def _add(one: Vector, other: Vector) -> Vector:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _times(scale, vector: Vector) -> Vector:
    return scale * vector[0], scale * vector[1], scale * vector[2]
