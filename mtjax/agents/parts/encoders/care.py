"""CARE attends to a mixture of encoders by the task's context."""

import dataclasses
from functools import partial
from typing import ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import MLP, join, to_unit
from mtjax.agents.parts.encoders.base import Identity
from mtjax.agents.parts.encoders.mixture import Experts, check_experts
from mtjax.types import Array, InputError


class Mixture(nn.Module):
    """Encodes observations as a context-dependent mixture, and applies the rest of the network to the encoding."""

    num_experts: int
    expert_widths: tuple[int, ...]
    variant: str
    temperature: float
    unit_attention: bool
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        size = self.expert_widths[-1]
        context = nn.Dense(size, name="context_out")(MLP(self.expert_widths[:-1], name="context")(features))  # (..., D)
        encodings = Experts(self.num_experts, self.expert_widths, name="experts")(obs)  # (K, ..., D)
        if self.variant == "paper":
            scale = partial(to_unit, floor=1e-6) if self.unit_attention else lambda x: x
            products = scale(encodings) * scale(jax.lax.stop_gradient(context))
            scores = jnp.sum(products, axis=-1) / self.temperature  # (K, ...)
        else:
            gate = nn.Dense(self.num_experts, name="gate_out")(MLP((size, size), name="gate")(context))
            gate = jnp.broadcast_to(gate, (*obs.shape[:-1], self.num_experts))  # the same in every state of a task
            scores = jnp.moveaxis(gate, -1, 0)
        attention = jax.nn.softmax(scores, axis=0)  # (K, ...)
        self.sow("intermediates", "attention", attention)
        encoding = jnp.sum(attention[..., None] * encodings, axis=0)
        if self.variant == "paper":
            encoding = MLP((size,), name="after")(encoding)
        return MLP(self.hidden, self.layer_norm, name="trunk")(join(encoding, *action, task=context))


@dataclasses.dataclass(frozen=True)
class CARE(Identity):
    """CARE learns representations by contextual attention (Sodhani, Zhang and Pineau 2021).

    For a task with context features c and K encoders E_j of the observation s:
        z_context = C(c)                                   (context encoder)
        a_j = softmax_j <E_j(s), sg(z_context)> / tau      (attention; no gradient into the context here)
        z = MLP(sum_j a_j E_j(s))                          (mixture)
    and SAC's actor and critics take [z, z_context]. The context encoder learns through that z_context alone.

    ``variant="mtrl"`` computes what the authors' MTRL code does: the weights are softmax(MLP(z_context)), the same in
    every state; gradients flow through them; and no MLP follows the mixture.

    Differs from the paper: inner products are divided by tau, by default the square root of the encoding's size, as
    otherwise the attention is nearly one-hot from the start and learning is slow (``attention_temperature=1`` is the
    paper's). The context comes from the conditioning, by default the task's physical parameters, and in a mixture which
    family it is of. The paper embeds a description of the task by a frozen language model, as ``conditioning="text"``
    does with ``text=MODEL``. Actor and critics have a mixture and a context encoder each, trained by their own loss. In
    the paper one context encoder learns from all losses; MTRL shares some of the actor's parameters with the critic and
    leaves others at their initial values.
    """

    needs_features: ClassVar[bool] = True
    num_experts: int = 6
    """Number of encoders in the mixture."""
    expert_widths: tuple[int, ...] = (64, 64)
    """Widths of the layers in each encoder and in the context encoder; the last is the size of the encoding."""
    variant: Literal["paper", "mtrl"] = "paper"
    """Use the attention of the paper, or the gate of the authors' code."""
    attention_temperature: float = 0.0
    """Divisor of the inner products: 1 as in the paper; 0 for the square root of the encoding's size, or with
    ``unit_attention`` for 0.2."""
    unit_attention: bool = False
    """Scale encodings and context to length 1 before the paper's inner products, so that scores stay bounded."""

    def __post_init__(self):
        parts.require_not_negative(self, "attention_temperature")
        check_experts(self.num_experts, self.expert_widths)
        if self.unit_attention and self.variant == "mtrl":
            raise InputError("unit-attention is of the paper's attention; variant=mtrl computes no inner products")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        default = 0.2 if self.unit_attention else self.expert_widths[-1] ** 0.5
        temperature = self.attention_temperature or default
        shape = (self.num_experts, self.expert_widths, self.variant)
        return Mixture(*shape, temperature, self.unit_attention, hidden, layer_norm)
