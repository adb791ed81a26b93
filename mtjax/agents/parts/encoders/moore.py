"""MOORE: a mixture of experts whose representations are kept orthogonal."""

import dataclasses
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.encoders.base import Identity
from mtjax.agents.parts.encoders.mixture import Experts, TaskWeights, check_experts, mix
from mtjax.types import Array, InputError

_SHARE, _LENGTH = 1e-4, 1e-3  # a vector of which less is new counts for little; slopes are bounded by the inverses


def orthonormal(vectors: Array) -> Array:
    """Make K vectors (K, ..., D) orthonormal by the modified Gram-Schmidt process, in their order.

    With the part r_k of u_k that is orthogonal to all v before it:
        v_k = r_k / sqrt(|r_k|^2 + (10^-4 |u_k|)^2 + (10^-3)^2)
    so that a vector that is 0, or lies in the span of those before it, gives nearly 0, smoothly and with a finite
    slope, by which experts can part again; all others give the unit vector, as |r_k| is much the largest term.
    """
    floors = _SHARE**2 * jnp.sum(jnp.square(vectors), axis=-1, keepdims=True) + _LENGTH**2
    basis, rest = [], vectors
    for floor in floors:
        length = jnp.sum(jnp.square(rest[0]), axis=-1, keepdims=True)
        first, rest = rest[0] * jax.lax.rsqrt(length + floor), rest[1:]
        rest = rest - jnp.sum(rest * first, axis=-1, keepdims=True) * first
        basis.append(first)
    return jnp.stack(basis)


class OrthogonalMixture(nn.Module):
    """The task's weighted sum of orthonormal representations of the input, squashed."""

    num_experts: int
    widths: tuple[int, ...]
    layer_norm: bool
    weight_widths: tuple[int, ...] = ()

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        inputs = jnp.concatenate([obs, *action], axis=-1)
        basis = orthonormal(Experts(self.num_experts, self.widths, self.layer_norm, name="experts")(inputs))
        weights = TaskWeights(self.num_experts, self.weight_widths, name="weights")(features)
        return jnp.tanh(mix(weights, basis))


@dataclasses.dataclass(frozen=True)
class MOORE(Identity):
    """A mixture of orthogonal experts (Hendawy, Peters and D'Eramo 2024).

    K experts h_k read the observation and, in a critic, the action. For a task of features c, with an MLP w:
        U = [h_1(x), ..., h_K(x)],   V = Gram-Schmidt(U),   z = tanh(V w(c))
    and the task's head stands on z, as nothing follows the mixture but the paper's linear output, one for each task
    (heads=per-task). ``hidden`` are the widths of an expert; the last layer is linear, and where layer normalisation is
    asked for it comes before the ReLU of the others. The paper has hidden layers of 400, K = 4 for MT10 and 6 for MT50.

    Differs from the paper: there w(c) = W c for one-hot task numbers c, so that every task's weights are free. Linear
    in few parameters they would not be: of tasks along one parameter they would be a line, and two mixtures of experts
    would make all others. ``weight_widths=()`` with conditioning=one-hot is the paper's, but for a bias, without which
    a task whose features are 0 would be told nothing of its observation. Gram-Schmidt is finite where experts are 0 or
    dependent.
    """

    needs_features: ClassVar[bool] = True
    num_experts: int = 4
    """Orthogonal experts; no more than the last hidden layer has units."""
    weight_widths: tuple[int, ...] = (64,)
    """Widths of the hidden layers between the task's features and its weights; none makes these linear."""

    def __post_init__(self):
        check_experts(self.num_experts, (1,))
        parts.require_widths(self, "weight_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        if hidden[-1] < self.num_experts:
            raise InputError(
                f"{self.num_experts} orthogonal experts need a last hidden layer as wide, not {hidden[-1]}"
            )
        return OrthogonalMixture(self.num_experts, hidden, layer_norm, self.weight_widths)
