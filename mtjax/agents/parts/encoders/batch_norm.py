"""Batch normalisation, by the statistics of each task, keeps the critic's loss well conditioned."""

import dataclasses
from typing import ClassVar

import flax.linen as nn
import jax.numpy as jnp

from mtjax.agents.networks import STATISTICS, ReLU, UnitDense
from mtjax.agents.parts.encoders.base import Identity
from mtjax.types import Array


class BatchNormTrunk(nn.Module):
    """Applies layers with batch normalisation, by running statistics unless these may change."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        running = not self.is_mutable_collection(STATISTICS)
        normalize = lambda x: nn.BatchNorm(running, momentum=0.99, epsilon=1e-3, use_fast_variance=False)(x)
        x = normalize(jnp.concatenate([obs, *action], axis=-1))
        for i, width in enumerate(self.widths):
            x = normalize(UnitDense(width)(x))
            if features.shape[-1]:
                x = x + nn.Dense(width, use_bias=False, name=f"task_{i}")(features)
            x = ReLU()(x)
        return x


@dataclasses.dataclass(frozen=True)
class BatchNorm(Identity):
    """Normalises inputs and hidden layers over the batch of a task (CrossQ, Bhatt et al. 2024; XQC, Palenicek et al.).

    With features z of the task and, for every unit, BN(x) = scale (x - mean) / sqrt(variance + 0.001) + bias:
        x = BN([s, a]);   x <- relu(BN(W x) + V z)   for each width of ``hidden``
    Rows of W have length 1 after every step of an optimiser (weight normalisation). A network that is being fitted
    takes mean and variance of the batch, and the task's running statistics move towards these by a hundredth. Every
    other network takes the running ones. Each task has its own, and they follow its data whatever ``tune`` says. Scale
    and bias are like other parameters of the body. For the paper's output layers use unit-head. Its norms do not depend
    on critic-layer-norm and actor-layer-norm.

    Differs from the papers: there is one task there. A task's features are often the same in all of its batch, and BN
    would subtract whatever they add; so V z comes after it. Rows of W begin as independent directions (there,
    orthogonal).
    """

    has_statistics: ClassVar[bool] = True

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return BatchNormTrunk(hidden)
