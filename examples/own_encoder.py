"""An encoder of your own: a network that the task gates, unit by unit.

python -m mtjax.train --import=examples/own_encoder.py --agent.encoder=gated --agent.gate-widths 32
"""

import dataclasses
from typing import ClassVar

import flax.linen as nn
import jax.numpy as jnp

import mtjax
from mtjax.agents.networks import MLP
from mtjax.agents.parts.encoders import Encoder


class GatedTrunk(nn.Module):
    """Layers whose units are multiplied by gates in (0, 2) that the task sets."""

    hidden: tuple[int, ...]
    gate_widths: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs, features, *action):
        """Map one task's observations (..., O), features (Z,) and, in a critic, actions (..., A) to (..., width)."""
        x = jnp.concatenate([obs, *action], axis=-1)
        gated_by = MLP(self.gate_widths)(features)
        for width in self.hidden:
            x = nn.Dense(width)(x)
            x = nn.LayerNorm()(x) if self.layer_norm else x
            x = nn.relu(x) * 2 * nn.sigmoid(nn.Dense(width)(gated_by))
        return x


@dataclasses.dataclass(frozen=True)
class Gated(Encoder):
    """A network whose units the task gates. Its fields are flags: --agent.gate-widths."""

    needs_features: ClassVar[bool] = True  # if so, conditioning=none is refused
    gate_widths: tuple[int, ...] = (64,)
    """Widths of the network from the task's features to the gates."""

    def body(self, hidden, layer_norm):
        return GatedTrunk(hidden, self.gate_widths, layer_norm)


mtjax.register("gated", Gated)
