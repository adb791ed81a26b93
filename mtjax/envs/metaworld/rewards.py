"""Rewards as Meta-World shapes them, for one world."""

from collections.abc import Mapping

import jax.numpy as jnp

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.metaworld.observables import Observables
from mtjax.types import Array

_XZ = jnp.s_[::2]


def distance(one: Array, other: Array) -> Array:
    """Return the distance () between two points."""
    return jnp.linalg.norm(one - other)


def near(x: Array, radius: Array | float, margin: Array | float) -> Array:
    """Return 1 for a distance ``x`` of at most ``radius``, falling with a long tail beyond it."""
    return tolerance(x, 0.0, radius, margin, "long_tail")


def hamacher(a: Array | float, b: Array | float) -> Array:
    """Return Hamacher's product of two numbers in [0, 1]: an "and" of soft truths."""
    both = jnp.asarray(a + b - a * b)
    return jnp.where(both > 0, a * b / jnp.where(both > 0, both, 1.0), 0.0)


def effort(at: Observables, desired: float = 1.0) -> Array:
    """Return how firmly () the action closes the gripper, as a part of ``desired``, in [0, 1]."""
    return jnp.clip(at.action[3], 0.0, desired) / desired


def in_hand(at: Observables, thing: Array, within: float) -> Array:
    """Return whether () the tool centre is within a distance [m] of a thing (3,), and the fingers are apart."""
    return (distance(thing, at.tcp) < within) & (at.obs[3] > 0)


def caging(
    at: Observables,
    began: Mapping[str, Array],
    obj: Array,
    *,
    obj_radius: float,
    pad_success_thresh: float,
    xz_thresh: float,
    object_reach_radius: float = 0.0,
    desired_gripper_effort: float = 1.0,
    high_density: bool = False,
    medium_density: bool = False,
    obj_init: Array | None = None,
) -> Array:
    """Return the reward () in [0, 1] for a gripper about the object, and closed: Meta-World's usual one.

    Args:
        obj: (3,) where the object is.
        obj_radius: [m] pads closer than this are too close.
        pad_success_thresh: [m] pads within this distance along y hold the object.
        xz_thresh: [m] in x and z, a tool centre within this distance is over the object.
        object_reach_radius: [m] of the medium density's reward for being near.
        desired_gripper_effort: the closing action that is enough.
        high_density: average it with the reward for the pads' places.
        medium_density: average it with a reward for being near.
        obj_init: (3,) where the object began; None: ``began["obj_init"]``.
    """
    obj_init = began["obj_init"] if obj_init is None else obj_init
    pads = jnp.stack([at.left_pad[1], at.right_pad[1]])
    margin = jnp.abs(jnp.abs(pads - obj_init[1]) - pad_success_thresh)
    beside = tolerance(jnp.abs(pads - obj[1]), obj_radius, pad_success_thresh, margin, "long_tail")
    start = distance(obj_init[_XZ], began["init_tcp"][_XZ]) - xz_thresh
    caged = hamacher(hamacher(*beside), near(distance(at.tcp[_XZ], obj[_XZ]), xz_thresh, start))
    gripping = jnp.where(caged > 0.97, effort(at, desired_gripper_effort), 0.0)
    held = hamacher(caged, gripping)
    if high_density:
        held = (held + caged) / 2
    if medium_density:
        reach = jnp.abs(distance(obj_init, began["init_tcp"]) - object_reach_radius)
        held = (held + near(distance(obj, at.tcp), object_reach_radius, reach)) / 2
    return held


def pads_caging(
    at: Observables,
    began: Mapping[str, Array],
    obj: Array,
    *,
    obj_radius: float,
    xz_thresh: float,
    grip_margin: float | None = None,
    pad_success_thresh: float = 0.05,
) -> Array:
    """Return the other caging reward () in [0, 1]: that of pick-place, push-back, sweep, sweep-into and soccer.

    Meta-World means to take the pads' places at the start for its margins, but holds views of MuJoCo's data, which
    move with the pads. So the margins follow the pads.

    Args:
        obj: (3,) where the object is.
        obj_radius: [m] pads closer than this are too close.
        xz_thresh: [m] in x and z, a tool centre within this distance is over the object.
        grip_margin: [m] pads within the radius and this grip it (push-back, sweep, soccer). None: the closing action
            grips it (pick-place).
        pad_success_thresh: [m] pads within this distance along y hold the object.
    """
    aside = jnp.stack([at.left_pad[1] - obj[1], obj[1] - at.right_pad[1]])
    margin = jnp.abs(jnp.abs(aside) - pad_success_thresh)
    beside = hamacher(*tolerance(aside, obj_radius, pad_success_thresh, margin, "long_tail"))
    start = distance(began["obj_init"][_XZ], began["init_tcp"][_XZ]) - xz_thresh
    caged = hamacher(beside, near(distance(at.tcp[_XZ], obj[_XZ]), xz_thresh, start))
    if grip_margin is None:
        return (hamacher(caged, jnp.where(caged > 0.97, effort(at), 0.0)) + caged) / 2
    gripping = hamacher(*tolerance(aside, obj_radius, obj_radius + grip_margin, margin, "long_tail"))
    return (caged + jnp.where(caged > 0.95, gripping, 0.0)) / 2
