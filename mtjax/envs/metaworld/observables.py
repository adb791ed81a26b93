"""What rewards read of a world, and how Meta-World writes orientations."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp

from mtjax.types import Array


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


def scalar_last(quat: Array) -> Array:
    """Return a unit quaternion (w, x, y, z) as SciPy writes a rotation matrix: x, y, z, w, with the largest positive.

    It is what ``Rotation.from_matrix(xmat).as_quat()`` returns. Orientations that Meta-World reads from ``xquat`` stay
    w, x, y, z.
    """
    turned = jnp.roll(quat, -1)
    largest = turned[jnp.argmax(jnp.abs(turned))]
    return jnp.where(largest < 0, -turned, turned)
