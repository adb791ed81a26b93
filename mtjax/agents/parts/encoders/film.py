"""FiLM scales and shifts layers by the task."""

import dataclasses
from typing import ClassVar, Literal

import flax.linen as nn
import jax.numpy as jnp
import numpy as np

from mtjax.agents import parts
from mtjax.agents.networks import MLP, ReLU
from mtjax.agents.parts.encoders.base import Identity
from mtjax.types import Array


class ModulatedMLP(nn.Module):
    """Applies an MLP whose layers are scaled and shifted, before their ReLU or after it."""

    widths: tuple[int, ...]
    layer_norm: bool
    after_relu: bool

    @nn.compact
    def __call__(self, x: Array, scales: list[Array], shifts: list[Array]) -> Array:
        """Map inputs (..., x), with a scale and a shift for each layer, (..., width) or (..., 1)."""
        for width, scale, shift in zip(self.widths, scales, shifts, strict=True):
            x = nn.Dense(width)(x)
            x = nn.LayerNorm()(x) if self.layer_norm else x
            x = scale * ReLU()(x) + shift if self.after_relu else ReLU()(scale * x + shift)
        return x


class FiLMTrunk(nn.Module):
    """Applies a modulated MLP to observation and action; another MLP computes scales and shifts from the task."""

    widths: tuple[int, ...]
    layer_norm: bool
    film: str
    film_widths: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        scalar = self.film == "scalar"
        sizes = [1] * len(self.widths) if scalar else list(self.widths)
        # From zero, so that at the start every task has the same plain network.
        to_modulation = nn.Dense(2 * sum(sizes), kernel_init=nn.initializers.zeros, name="modulation")
        modulation = to_modulation(MLP(self.film_widths, name="generator")(features))
        read = jnp.split(modulation, np.cumsum(sizes + sizes)[:-1], axis=-1)
        scales, shifts = [1 + part for part in read[: len(sizes)]], read[len(sizes) :]
        x = jnp.concatenate([obs, *action], axis=-1)
        return ModulatedMLP(self.widths, self.layer_norm, scalar, name="trunk")(x, scales, shifts)


@dataclasses.dataclass(frozen=True)
class FiLM(Identity):
    """FiLM scales and shifts every layer by the task's features (Perez et al. 2018, equations 1 and 2).

    With the task's features c and an MLP g, layer l of the network on observation and action computes
        (d_1, ..., d_L, b_1, ..., b_L) = g(c),    x <- ReLU((1 + d_l) W_l x + b_l)
    with layer normalisation, if any, before the modulation. ``film="channel"`` is the paper's: a scale and a shift for
    every unit. ``film="scalar"`` is MTRL's: one scale and one shift for each layer, after its ReLU.

    Differs from the paper: the output layer of g starts at 0 (scales are 1 and shifts 0), and layer normalisation keeps
    its own scale and shift. Differs from MTRL: scales are 1 + d where MTRL's are d; the last layer has a ReLU
    like the others; and the actor's modulation is trained (MTRL leaves it at its initial values).
    """

    needs_features: ClassVar[bool] = True
    film: Literal["channel", "scalar"] = "channel"
    """Modulate every unit before its ReLU (channel), or each layer as a whole after its ReLU (scalar)."""
    film_widths: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers in the network of scales and shifts; without any it is linear."""

    def __post_init__(self):
        parts.require_widths(self, "film_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return FiLMTrunk(hidden, layer_norm, self.film, self.film_widths)
