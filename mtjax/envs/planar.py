"""Places and velocities of the bodies of a model that moves in the x-z plane.

MuJoCo's sensors give the same after another pass over the whole model. This code computes only what an observation
needs, in one kernel.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.engines.base import World
from mtjax.types import Array, InputError, Task

Vector = tuple[Array, Array]  # x and z


class Planar(NamedTuple):
    """Places and velocities of every body. The first body is the world."""

    angle: Array  # (nbody,) rotation about the y axis [rad], from z towards x
    position: Array  # (nbody, 2) x and z of the body's frame [m]
    centre: Array  # (nbody, 2) x and z of its centre of mass [m]
    velocity: Array  # (nbody, 2) of its centre of mass [m/s]

    def offset(self, body: int, point: Array) -> Array:
        """Return x and z (2,) [m] of a point (3,) of a body's frame, relative to the frame's origin."""
        return jnp.stack(_rotate(self.angle[body], (point[0], point[2])))


def locate(model: mujoco.MjModel, leaf: Callable[[str], Array], qpos: Array, qvel: Array) -> Planar:
    """Return places and velocities of all bodies.

    Args:
        model: gives the tree, whose joints are slides in the plane and hinges across it.
        leaf: a field of the task's own compiled model, by its name.
        qpos: (nq,).
        qvel: (nv,).
    """
    body_pos, body_quat, ipos = leaf("body_pos"), leaf("body_quat"), leaf("body_ipos")
    jnt_pos, start = leaf("jnt_pos"), leaf("qpos0")
    zero = jnp.zeros((), qpos.dtype)
    places, motions = [(zero, (zero, zero))], [(zero, (zero, zero))]
    centres, speeds = [(zero, zero)], [(zero, zero)]
    for body in range(1, model.nbody):
        (angle, place), (spin, speed) = places[model.body_parentid[body]], motions[model.body_parentid[body]]
        arm = _rotate(angle, (body_pos[body, 0], body_pos[body, 2]))
        place, speed = _add(place, arm), _add(speed, _cross(spin, arm))
        angle = angle + 2 * jnp.arctan2(body_quat[body, 2], body_quat[body, 0])
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            moved, rate, axis = qpos[joint] - start[joint], qvel[joint], model.jnt_axis[joint]
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE:
                x, z = _rotate(angle, (axis[0], axis[2]))
                place, speed = _add(place, (moved * x, moved * z)), _add(speed, (rate * x, rate * z))
                continue
            anchor = (jnt_pos[joint, 0], jnt_pos[joint, 2])
            before = _rotate(angle, anchor)
            angle, turn = angle + axis[1] * moved, spin + axis[1] * rate
            after = _rotate(angle, anchor)
            place = _add(place, (before[0] - after[0], before[1] - after[1]))
            lost = _cross(turn, after)
            speed = _add(_add(speed, _cross(spin, before)), (-lost[0], -lost[1]))
            spin = turn
        arm = _rotate(angle, (ipos[body, 0], ipos[body, 2]))
        places.append((angle, place))
        motions.append((spin, speed))
        centres.append(_add(place, arm))
        speeds.append(_add(speed, _cross(spin, arm)))
    pairs = lambda vectors: jnp.stack([jnp.stack(vector) for vector in vectors])
    angles = jnp.stack([angle for angle, _ in places])
    return Planar(angles, pairs([place for _, place in places]), pairs(centres), pairs(speeds))


def is_planar(model: mujoco.MjModel) -> bool:
    """Return whether every joint slides in the plane or turns about its normal."""
    hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    across, within = np.abs(model.jnt_axis[:, 1]), np.hypot(model.jnt_axis[:, 0], model.jnt_axis[:, 2])
    return bool(np.all(np.where(hinge, within, across) < 1e-9))


def planar(domain: Any, task: Task, world: World) -> Planar:
    """Return places and velocities of all bodies of a domain whose model moves in the x-z plane.

    Raises:
        InputError: the model leaves the plane.
    """
    model = domain.models[0]
    if not is_planar(model):
        raise InputError(f"the model of {type(domain).__name__} leaves the x-z plane; declare sensors instead")
    return locate(model, partial(domain.leaf, task), world.qpos, world.qvel)


def forward_velocity(domain: Any, task: Task, world: World) -> Array:
    """Return the velocity () [m/s] along x of the whole model's centre of mass."""
    mass = domain.leaf(task, "body_mass")
    return jnp.dot(mass, planar(domain, task, world).velocity[:, 0], precision="highest") / jnp.sum(mass)


def _rotate(angle: Array, vector: Vector) -> Vector:
    x, z = vector
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return x * cos + z * sin, z * cos - x * sin


def _cross(spin: Array, arm: Vector) -> Vector:
    """Return the velocity of the end of an arm that turns about y."""
    return spin * arm[1], -spin * arm[0]


def _add(one: Vector, other: Vector) -> Vector:
    return one[0] + other[0], one[1] + other[1]
