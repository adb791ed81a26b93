"""Meta-World's funnels: floors in the air about a place, above which a hand or a thing should come to it."""

import jax.numpy as jnp

from mtjax.envs.metaworld.rewards import near
from mtjax.types import Array


def funnel(radius: Array, neck: Array | float, steepness: float, height: float) -> Array:
    """Return the floor's height () at a horizontal distance ``radius`` from the place: 0 inside the neck."""
    outside = radius > neck
    return jnp.where(outside, steepness * jnp.log(jnp.where(outside, radius - neck, 1.0)) + height, 0.0)


def above(height: Array, floor: Array, margin: Array | float) -> Array:
    """Return 1 above the floor, falling with a long tail below it."""
    return near(jnp.maximum(floor - height, 0.0), 0.01, margin)
