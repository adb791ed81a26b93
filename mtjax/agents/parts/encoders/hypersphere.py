"""The hypersphere keeps features and weights at length 1, so that neither grows while targets move."""

import dataclasses

import flax.linen as nn
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import ReLU, UnitDense, join, to_unit
from mtjax.agents.parts.encoders.base import Identity
from mtjax.agents.parts.encoders.residual import blocks
from mtjax.types import Array


class Scaler(nn.Module):
    """Multiplies units by factors that begin at ``start``.

    The factors are start / scale times parameters that begin at ``scale``. Adam moves every parameter by about its
    learning rate in a step, so that ``scale`` decides how fast the factors move.
    """

    start: float
    scale: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        scale = self.param("scale", nn.initializers.constant(self.scale), x.shape[-1:])
        return (self.start / self.scale) * scale * x


class HypersphereTrunk(nn.Module):
    """Embeds the inputs on the unit sphere, and moves on it from block to block."""

    width: int
    num_blocks: int
    expansion: int
    input_shift: float

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        gain = (2 / self.width) ** 0.5
        inputs = join(obs, *action, task=features)
        shift = jnp.full((*inputs.shape[:-1], 1), self.input_shift)
        x = to_unit(jnp.concatenate([inputs, shift], axis=-1))
        x = to_unit(Scaler(gain, gain)(UnitDense(self.width)(x)))
        for _ in range(self.num_blocks):
            x = self.block(x, gain / self.expansion**0.5)
        return Scaler(1.0, 1.0)(UnitDense(self.width)(x))

    def block(self, x: Array, gain: float) -> Array:
        """Move x (..., width) towards what an MLP with one hidden layer makes of it."""
        inner = ReLU()(Scaler(gain, gain)(UnitDense(self.expansion * self.width)(x)))
        aim = to_unit(UnitDense(self.width)(inner + 1e-8))  # never the zero vector, which has no direction
        step = Scaler(1 / (self.num_blocks + 1), self.width**-0.5)
        return to_unit(x + step(aim - x))


@dataclasses.dataclass(frozen=True)
class Hypersphere(Identity):
    """The hypersphere has a block of SimbaV2 for each width of ``hidden`` (Lee et al. 2025).

    With |v| = 1 for norm(v), W a matrix whose rows have length 1, and s and alpha learned vectors:
        x = norm(s * W norm([inputs, c]))                                (embedding, with the constant input-shift c)
        x <- norm((1 - alpha) * x + alpha * norm(W_2 relu(s * W_1 x)))   (each block; W_1 widens by ``expansion``)
        s * W x                                                          (last hidden layer)
    The constant c keeps the length of the inputs, which norm alone would lose. Every step of an optimiser ends with
    all rows of W back at length 1. With w units, all s begin at sqrt(2 / w), divided by the root of ``expansion`` in
    blocks, but the last at 1, and alpha begins at 1 / (blocks + 1). For the paper's output layers use unit-head, and
    for its normalisation of observations normalize-observations. Its norms do not depend on critic-layer-norm and
    actor-layer-norm.

    Differs from the paper: actor and critics have the same size (there, 2 blocks of 512 in critics and 1 of 128 in the
    actor); means and log standard deviations of the actor share the last hidden layer (there, each has its own); rows
    of W begin as independent directions (there, orthogonal).
    """

    expansion: int = 4
    """Factor between the width inside a block and the width of the block."""
    input_shift: float = 3.0
    """Constant that is put beside the inputs before their length becomes 1."""

    def __post_init__(self):
        parts.require_counts(self, "expansion")
        parts.require_positive(self, "input_shift")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return HypersphereTrunk(*blocks("hypersphere", hidden), self.expansion, self.input_shift)
