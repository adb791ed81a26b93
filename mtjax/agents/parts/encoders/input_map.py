"""The input map transforms each task's observations before the networks that all tasks share."""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp

from mtjax.agents.parts.encoders.base import Identity
from mtjax.types import Array


class AffineMap(nn.Module):
    """Maps observations to vectors of the same size by an affine map, initially the identity."""

    @nn.compact
    def __call__(self, obs: Array) -> Array:
        identity = lambda key, shape, dtype: jnp.eye(*shape, dtype=dtype)
        return nn.Dense(obs.shape[-1], kernel_init=identity, name="map")(obs)


@dataclasses.dataclass(frozen=True)
class InputMap(Identity):
    """Maps each task's observations to inputs of the shared network (domain adaptation).

    For task i, with networks f that all tasks share:
        f(phi_i(s), ...),   phi_i(s) = A_i s + b_i,   initially A_i = 1 and b_i = 0
    so that all tasks begin with the same network. It is the linear input network of Neto et al. (1995), one for each
    task. Actions and task features are not mapped.

    Differs from the paper: maps and shared network are trained together, from the start.
    """

    def front(self) -> nn.Module:
        return AffineMap()
