"""Attentive sharing: state and task decide which of a few sub-networks a task uses."""

import dataclasses
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import MLP, ReLU, join
from mtjax.agents.parts.encoders.base import Identity
from mtjax.types import Array


class AttentiveTrunk(nn.Module):
    """Returns the hidden layers of K sub-networks, each times its weight, one after another."""

    num_subnetworks: int
    attention_widths: tuple[int, ...]
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        seen = jnp.concatenate([obs, *action], axis=-1)
        axes = {"in_axes": None, "out_axes": -2, "axis_size": self.num_subnetworks}
        each = nn.vmap(MLP, {"params": 0}, {"params": True}, **axes)  # type: ignore
        hidden = each(self.hidden, self.layer_norm, name="subnetworks")(seen)  # (..., K, D)
        hidden = ReLU(name="units")(hidden)  # they are not negative; diagnostics see what is outside of the map
        looks = MLP(self.attention_widths, name="attention")(join(seen, task=features))
        weights = nn.softmax(nn.Dense(self.num_subnetworks, name="scores")(looks))
        self.sow("intermediates", "weights", weights)
        # Without a barrier XLA may fuse these into a kernel that is wrong for every second task: see ``mixture.mix``.
        weights, hidden = jax.lax.optimization_barrier((weights, hidden))
        return (weights[..., None] * hidden).reshape(*hidden.shape[:-2], -1)


@dataclasses.dataclass(frozen=True)
class Attentive(Identity):
    """Attentive weighs the outputs of K shared sub-networks by state and task (Bram, Brunner, Richter and Wattenhofer
    2019).

    Sub-networks h_k of the state s, in a critic with the action, do not see the task. An attention network g sees both:
        w(s, c) = softmax(g(s, c)),    output = sum_k w_k(s, c) W_k h_k(s) + b
    The last layer W = [W_1 ... W_K] is the network's head, on all w_k h_k one after another. So values are weighed as
    in the paper, V = sum_k w_k V_k. Policies of discrete actions are a weighted geometric mean, pi ~ prod_k pi_k^w_k,
    and of a Gaussian the mean and the log standard deviation are weighted means. ``hidden`` are the widths of every
    sub-network. With heads=per-task, every task reads the sub-networks by a last layer of its own.

    The paper has K = floor((T + 2) / 4) + 1 for T tasks, which conditioning=one-hot tells apart. Tasks that are alike
    can use the same sub-networks, so that fewer are needed than there are tasks.

    Differs from the paper: policies are mixed before the softmax, where there sum_k w_k pi_k is mixed after it and a
    linear map W_i of every task follows; all sub-networks, and the attention, see the observation itself, where there
    convolutions that all share encode it; actor and critic share nothing.
    """

    needs_features: ClassVar[bool] = True
    num_subnetworks: int = 4
    """Number of sub-networks (K)."""
    attention_widths: tuple[int, ...] = (64,)
    """Widths of the hidden layers from state and task to the weights; without any, scores are linear."""

    def __post_init__(self):
        parts.require_counts(self, "num_subnetworks")
        parts.require_widths(self, "attention_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return AttentiveTrunk(self.num_subnetworks, self.attention_widths, hidden, layer_norm)
