"""Poses of everything that a picture shows, from the positions of any engine's world.

MuJoCo's C engine and MuJoCo Warp do not return poses, and importing MJX takes seconds. This code computes what a picture
needs, in plain JAX. Vectors and quaternions are tuples of scalars, so that XLA fuses the whole into one kernel.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.types import Array, InputError

Vector = tuple[Array, Array, Array]
Quaternion = tuple[Array, Array, Array, Array]
Axes = tuple[Vector, Vector, Vector]  # the x, y and z axis of a frame

_JOINT, _MODE = mujoco.mjtJoint, mujoco.mjtCamLight
MODES = tuple(map(int, (_MODE.mjCAMLIGHT_FIXED, _MODE.mjCAMLIGHT_TRACK, _MODE.mjCAMLIGHT_TRACKCOM)))

# The fields of a model that poses depend on.
FIELDS = tuple(
    """
    qpos0 body_pos body_quat body_ipos body_mass jnt_pos jnt_axis geom_pos geom_quat cam_pos cam_quat cam_pos0
    cam_poscom0 cam_mat0 light_pos light_dir light_pos0 light_poscom0 light_dir0
    """.split()
)


class Pose(NamedTuple):
    """Where a thing is in the world and how it is turned."""

    position: Vector  # [m]
    axes: Axes


class Poses(NamedTuple):
    """Poses of geoms, of the camera and of lights."""

    geoms: tuple[Pose, ...]
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
    bodies = _bodies(model, leaf, qpos)
    geoms = [
        _mount(bodies[model.geom_bodyid[i]], pos, quat)
        for i, (pos, quat) in enumerate(zip(_rows(leaf("geom_pos")), _rows(leaf("geom_quat")), strict=True))
    ]
    poses = tuple(Pose(position, axes_of(quat)) for position, quat in geoms)
    lights = tuple(_light(model, leaf, bodies, i) for i in range(model.nlight))
    return Poses(poses, _camera(model, leaf, bodies), lights)


def _bodies(model: mujoco.MjModel, leaf: Callable[[str], Array], qpos: Array) -> list[tuple[Vector, Quaternion]]:
    """Return position and rotation of every body."""
    places, turns = list(_rows(leaf("body_pos"))), list(_rows(leaf("body_quat")))
    anchors, axes, start = list(_rows(leaf("jnt_pos"))), list(_rows(leaf("jnt_axis"))), leaf("qpos0")
    zero, one = jnp.float32(0), jnp.float32(1)
    bodies = [((zero, zero, zero), (one, zero, zero, zero))]
    for body in range(1, model.nbody):
        position, quat = _mount(bodies[model.body_parentid[body]], places[body], turns[body])
        first = model.body_jntadr[body]
        for joint in range(first, first + model.body_jntnum[body]):
            at, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
            if kind == _JOINT.mjJNT_FREE:
                position, quat = tuple(qpos[at : at + 3]), _unit(tuple(qpos[at + 3 : at + 7]))
            elif kind == _JOINT.mjJNT_SLIDE:
                position = _add(position, _times(qpos[at] - start[at], turn(quat, axes[joint])))
            else:
                moved = (
                    _about(axes[joint], qpos[at] - start[at])
                    if kind == _JOINT.mjJNT_HINGE
                    else _unit(tuple(qpos[at : at + 4]))
                )
                anchor = _add(position, turn(quat, anchors[joint]))
                quat = _multiply(quat, moved)
                position = _add(anchor, _times(-1.0, turn(quat, anchors[joint])))
        bodies.append((position, quat))
    return bodies


def _camera(model: mujoco.MjModel, leaf: Callable[[str], Array], bodies: list) -> Pose:
    body, mode = model.cam_bodyid[0], model.cam_mode[0]
    if mode == _MODE.mjCAMLIGHT_FIXED:
        position, quat = _mount(bodies[body], tuple(leaf("cam_pos")[0]), tuple(leaf("cam_quat")[0]))
        return Pose(position, axes_of(quat))
    rows = leaf("cam_mat0")[0].reshape(3, 3)
    axes = tuple(tuple(rows[:, i]) for i in range(3))
    return Pose(_follow(model, leaf, bodies, body, mode, "cam", 0), axes)  # type: ignore


def _light(model: mujoco.MjModel, leaf: Callable[[str], Array], bodies: list, i: int) -> tuple[Vector, Vector]:
    body, mode = model.light_bodyid[i], model.light_mode[i]
    if mode == _MODE.mjCAMLIGHT_FIXED:
        position, quat = bodies[body]
        return _add(position, turn(quat, tuple(leaf("light_pos")[i]))), turn(quat, tuple(leaf("light_dir")[i]))
    return _follow(model, leaf, bodies, body, mode, "light", i), tuple(leaf("light_dir0")[i])


def _follow(model: mujoco.MjModel, leaf: Callable[[str], Array], bodies, body: int, mode: int, kind: str, i: int):
    """Return the position of a camera or light that follows a body, or its subtree's centre of mass."""
    if mode == _MODE.mjCAMLIGHT_TRACK:
        return _add(bodies[body][0], tuple(leaf(f"{kind}_pos0")[i]))
    return _add(_centre(model, leaf, bodies, body), tuple(leaf(f"{kind}_poscom0")[i]))


def _centre(model: mujoco.MjModel, leaf: Callable[[str], Array], bodies: list, root: int) -> Vector:
    """Return the centre of mass of a body and its descendants."""
    masses, centres = leaf("body_mass"), list(_rows(leaf("body_ipos")))
    inside = {root}
    for body in range(root + 1, model.nbody):
        if model.body_parentid[body] in inside:
            inside.add(body)
    total, sums = 0.0, (jnp.float32(0),) * 3
    for body in sorted(inside):
        position, quat = bodies[body]
        total = total + masses[body]
        sums = _add(sums, _times(masses[body], _add(position, turn(quat, centres[body]))))
    return _times(1 / total, sums)


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


def _rows(array: Array) -> Iterator[tuple]:
    return (tuple(array[i]) for i in range(len(array)))


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
    return tuple(x * scale for x in quat)  # type: ignore


def _cross(one, other) -> Vector:
    (a, b, c), (x, y, z) = one, other
    return b * z - c * y, c * x - a * z, a * y - b * x


def _add(one: Vector, other: Vector) -> Vector:
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]


def _times(scale, vector: Vector) -> Vector:
    return scale * vector[0], scale * vector[1], scale * vector[2]
