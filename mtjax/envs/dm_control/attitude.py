"""How a free body is turned: quaternions (4,) as MuJoCo writes them, the real part first."""

import jax
import jax.numpy as jnp

from mtjax.types import Array, Key


def upward(quat: Array) -> Array:
    """Return the direction (3,) of the world's z axis in a body's own frame. Its last number is 1 in an upright one."""
    w, x, y, z = quat / jnp.linalg.norm(quat)
    return jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z])


def into_frame(quat: Array, vector: Array) -> Array:
    """Return a vector (3,) of the world in a body's own frame."""
    real, axis = quat[0] / jnp.linalg.norm(quat), -quat[1:] / jnp.linalg.norm(quat)
    twist = 2 * jnp.cross(axis, vector)
    return vector + real * twist + jnp.cross(axis, twist)


def any_attitude(key: Key) -> Array:
    """Draw a quaternion (4,), all rotations being equally likely."""
    quat = jax.random.normal(key, (4,))
    return quat / jnp.linalg.norm(quat)
