"""Vectors of length 1, and layers whose weights are such vectors."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.types import Array, Key


def to_unit(x: Array, axis: int = -1, floor: float = 1e-30) -> Array:
    """Scale vectors along an axis to length 1.

    The gradient is finite at zero too. Vectors whose squared length is not far above the ``floor`` stay shorter.
    """
    return x * jax.lax.rsqrt(jnp.sum(jnp.square(x), axis=axis, keepdims=True) + floor)


def init_direction(key: Key, shape: tuple[int, int]) -> Array:
    """Draw weights (inputs, outputs) with a vector of length 1 and of random direction for each output."""
    return to_unit(nn.initializers.lecun_normal()(key, shape), axis=-2)


class UnitDense(nn.Module):
    """Applies a linear layer without bias, in which the weights of each output are a vector of length 1.

    Optimisers keep that length of every leaf called ``direction`` (``descent.on_sphere``).
    """

    width: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return x @ self.param("direction", init_direction, (x.shape[-1], self.width))
