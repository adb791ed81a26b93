"""MOORE mixes experts whose representations are made orthogonal."""

import dataclasses
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.encoders.base import Identity
from mtjax.agents.parts.encoders.mixture import Experts, TaskWeights, check_experts, mix
from mtjax.types import Array, InputError

_SHARE, _LENGTH = 1e-4, 1e-3  # relative and absolute lengths below which a residual shrinks to 0


def orthonormal(vectors: Array) -> Array:
    """Make K vectors (K, ..., D) orthonormal by the modified Gram-Schmidt process, in their order.

    With the part r_k of u_k that is orthogonal to all v before it:
        v_k = r_k / sqrt(|r_k|^2 + (10^-4 |u_k|)^2 + (10^-3)^2)
    If u_k is 0, or lies in the span of the vectors before it, v_k is nearly 0, with a finite gradient by which experts
    can separate again. Otherwise |r_k| is by far the largest term, and v_k has length 1.
    """
    floors = _SHARE**2 * jnp.sum(jnp.square(vectors), axis=-1, keepdims=True) + _LENGTH**2
    basis, residuals = [], vectors
    for floor in floors:
        length = jnp.sum(jnp.square(residuals[0]), axis=-1, keepdims=True)
        first, residuals = residuals[0] * jax.lax.rsqrt(length + floor), residuals[1:]
        residuals = residuals - jnp.sum(residuals * first, axis=-1, keepdims=True) * first
        basis.append(first)
    return jnp.stack(basis)


class OrthogonalMixture(nn.Module):
    """Returns tanh of the task's weighted sum of orthonormal representations of the input."""

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
    """MOORE mixes orthogonal experts (Hendawy, Peters and D'Eramo 2024).

    K experts h_k take the observation x and, in a critic, the action. For a task with features c, with an MLP w:
        U = [h_1(x), ..., h_K(x)],   V = Gram-Schmidt(U),   z = tanh(V w(c))
    The task's head is applied to z, as the paper has only a linear output after the mixture, one for each task
    (heads=per-task). ``hidden`` are the widths of an expert. Its last layer is linear; layer normalisation, if any, is
    before the ReLU of the others. The paper has hidden layers of 400, K = 4 for MT10 and 6 for MT50.

    Differs from the paper: there w(c) = W c for one-hot task numbers c, so that every task's weights are free. Weights
    that are linear in few features would not be: for tasks along one parameter they would lie on a line, and two
    mixtures would make all others. ``weight_widths=()`` with conditioning=one-hot is the paper's, plus a bias, without
    which z would be 0 for a task whose features are 0. Gram-Schmidt is finite where experts are 0 or dependent.
    """

    needs_features: ClassVar[bool] = True
    num_experts: int = 4
    """Number of orthogonal experts, at most the width of the last hidden layer."""
    weight_widths: tuple[int, ...] = (64,)
    """Widths of the hidden layers from the task's features to its weights; without any, weights are linear."""

    def __post_init__(self):
        check_experts(self.num_experts, (1,))
        parts.require_widths(self, "weight_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        if hidden[-1] < self.num_experts:
            raise InputError(
                f"{self.num_experts} orthogonal experts need a last hidden layer as wide, not {hidden[-1]}"
            )
        return OrthogonalMixture(self.num_experts, hidden, layer_norm, self.weight_widths)
