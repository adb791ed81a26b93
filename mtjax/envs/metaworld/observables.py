"""What rewards read of a world, and how Meta-World writes orientations."""

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mtjax.envs.engines.base import World
from mtjax.types import Array, Task

_OBJECTS = 14  # entries of an observation for objects
HALF = 4 + _OBJECTS
"""Entries of an observation for hand, gripper and objects."""
HALF_LOW = np.array([-0.525, 0.348, -0.0525, -1.0, *[-np.inf] * _OBJECTS], np.float32)
HALF_HIGH = np.array([0.525, 1.025, 0.7, 1.0, *[np.inf] * _OBJECTS], np.float32)


class Observables(NamedTuple):
    """What a world shows after a step, as rewards read it. In ``objects`` there is no observation and no action yet."""

    obs: Array  # (39,) clipped as Meta-World's
    action: Array  # (4,) as given by the agent, in [-1, 1]
    tcp: Array  # (3,) [m] tool centre: the mean of the sites rightEndEffector and leftEndEffector
    left_pad: Array  # (3,) [m] body leftpad
    right_pad: Array  # (3,) [m] body rightpad
    position: Mapping[str, Array]  # (3,) [m] of each watched thing, by its short name
    quat: Mapping[str, Array]  # (4,) w x y z of each watched thing
    qpos: Array  # (nq,)
    press: Any = ()  # (2,) [N] force of the left and the right pad on the geom ``pressed``, if the task names one


def shown(world: World, watched: Collection[str]) -> Observables:
    """Return the places of the gripper and of watched things, from the sensors of ``scene.read``."""
    left_pad, right_pad, left, right = world.sensors[9:21].reshape(4, 3)
    poses, press = jnp.split(world.sensors[21:], [7 * len(watched)])
    poses, nothing = poses.reshape(-1, 7), jnp.zeros(0)
    position = dict(zip(watched, poses[:, :3], strict=True))
    quat = dict(zip(watched, poses[:, 3:], strict=True))
    tcp = (left + right) / 2
    return Observables(nothing, nothing, tcp, left_pad, right_pad, position, quat, world.qpos, press[::3])


def half(family: Any, world: World) -> Array:
    """Return what is observed (18,) of hand, gripper and objects."""
    hand, left, right = world.sensors[:9].reshape(3, 3)
    opened = jnp.clip(jnp.linalg.norm(right - left) / 0.1, 0.0, 1.0)
    things = jnp.concatenate(family.objects(shown(world, family.watched)))
    return jnp.concatenate([hand, opened[None], things, jnp.zeros(_OBJECTS - things.size)])


def unclipped(family: Any, task: Task, world: World) -> Array:
    """Return the observation (39,) as it is at a reset."""
    goal = jnp.zeros(3) if family.goal_hidden else task.goal["target"]
    return jnp.concatenate([half(family, world), world.extra, goal])


def at(family: Any, task: Task, world: World, action: Array) -> Observables:
    """Return what a world shows after a step."""
    return shown(world, family.watched)._replace(obs=family.observe(task, world), action=action)


def scalar_last(quat: Array) -> Array:
    """Return a unit quaternion (w, x, y, z) as SciPy writes a rotation matrix: x, y, z, w, with the largest positive.

    It is what ``Rotation.from_matrix(xmat).as_quat()`` returns. Orientations that Meta-World reads from ``xquat`` stay
    w, x, y, z.
    """
    turned = jnp.roll(quat, -1)
    largest = turned[jnp.argmax(jnp.abs(turned))]
    return jnp.where(largest < 0, -turned, turned)
