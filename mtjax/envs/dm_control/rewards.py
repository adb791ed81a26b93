"""Rewards as dm_control shapes them."""

import jax.numpy as jnp
import numpy as np

from mtjax.types import Array


def tolerance(
    x: Array,
    lower: Array | float,
    upper: Array | float,
    margin: Array | float = 0.0,
    sigmoid: str = "gaussian",
    value_at_margin: float = 0.1,
) -> Array:
    """Return 1 for ``x`` between the bounds, falling to ``value_at_margin`` at a distance ``margin`` from them.

    It is the function of that name in dm_control (Tassa et al. 2018, "DeepMind Control Suite", section 2.1).

    Args:
        x: () or any shape; the bounds and the margin may be arrays. A margin of 0 gives 0 outside the bounds.
        sigmoid: shape of the fall: "gaussian", "long_tail", "linear" or "quadratic". The last two reach 0 and stay
            there.
    """
    outside = jnp.maximum(jnp.maximum(lower - x, x - upper), 0.0)
    distance = outside / jnp.where(jnp.asarray(margin) > 0, margin, 1.0)
    falling = _SIGMOIDS[sigmoid](distance, value_at_margin)
    return jnp.where(outside == 0, 1.0, jnp.where(jnp.asarray(margin) > 0, falling, 0.0))


def _gaussian(distance: Array, value: float) -> Array:
    return jnp.exp(-0.5 * jnp.square(distance * np.sqrt(-2 * np.log(value))))


def _long_tail(distance: Array, value: float) -> Array:
    return 1 / (jnp.square(distance) * (1 / value - 1) + 1)


def _linear(distance: Array, value: float) -> Array:
    return jnp.maximum(1 - distance * (1 - value), 0.0)


def _quadratic(distance: Array, value: float) -> Array:
    return jnp.maximum(1 - jnp.square(distance) * (1 - value), 0.0)


_SIGMOIDS = {"gaussian": _gaussian, "long_tail": _long_tail, "linear": _linear, "quadratic": _quadratic}
