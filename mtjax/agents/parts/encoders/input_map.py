"""A linear map of the observation for every task, before what all tasks share."""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp

from mtjax.agents.parts.encoders.base import Identity
from mtjax.types import Array


class AffineMap(nn.Module):
    """An affine map of the observation onto one of the same size, at first the identity."""

    @nn.compact
    def __call__(self, obs: Array) -> Array:
        identity = lambda key, shape, dtype: jnp.eye(*shape, dtype=dtype)
        return nn.Dense(obs.shape[-1], kernel_init=identity, name="map")(obs)


@dataclasses.dataclass(frozen=True)
class InputMap(Identity):
    """Every task maps its observations into those that the shared network reads (domain adaptation).

    For task i, with networks f that all tasks share:
        f(phi_i(s), ...),   phi_i(s) = A_i s + b_i,   at first A_i = 1 and b_i = 0
    so that tasks begin as one and move apart as their dynamics or sensors differ: the linear input network of
    Neto et al. (1995), one a task. Actions and task features are left as they are.

    Differs from the paper: maps and shared network are trained together, from the start.
    """

    def front(self) -> nn.Module:
        return AffineMap()
