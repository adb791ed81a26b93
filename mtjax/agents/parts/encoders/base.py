"""What an encoder is, and the plainest."""

import dataclasses
from typing import ClassVar

import flax.linen as nn

from mtjax.agents import parts
from mtjax.networks import MLP, Trunk, join
from mtjax.types import Array


@dataclasses.dataclass(frozen=True)
class Identity:
    """No encoder: an MLP on observation, task features and, in a critic, the action.

    Every encoder is a class like this one. Networks have a body that ends in the hidden layer on which heads stand; it
    is applied to the data of one task, and its parameters are shared by all tasks.
    """

    needs_features: ClassVar[bool] = False  # of the task; then an agent that is told nothing is refused

    def __post_init__(self):
        parts.require_choices(self)

    def refuses(self, conditioning: str) -> str:
        """Why it cannot work with what the networks are told of the task; empty if it can."""
        has_features = conditioning != "none" or not self.needs_features
        return "" if has_features else "works by the task's features, so conditioning cannot be none; use parameters"

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        """A module (observations (..., O), features (..., Z) or (Z,), [actions (..., A)]) -> (..., width)."""
        return Trunk(hidden, layer_norm)

    def front(self) -> nn.Module | None:
        """A module (observations (..., O)) -> (..., O') before the body, of which every task has its own."""
        return None


class EncodedTrunk(nn.Module):
    """An MLP that encodes the observation, then one on the encoding and everything else."""

    encoder_widths: tuple[int, ...]
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        *inner, size = self.encoder_widths
        encoding = nn.Dense(size, name="encoding")(MLP(tuple(inner), name="encoder")(obs))
        return MLP(self.hidden, self.layer_norm, name="trunk")(join(encoding, *action, task=features))


@dataclasses.dataclass(frozen=True)
class MLPEncoder(Identity):
    """An MLP that encodes the observation before task and action join it (MTRL's feed-forward encoder)."""

    encoder_widths: tuple[int, ...] = (64, 64)
    """Widths of the encoder's layers; the last is the size of the encoding."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_layers(self, "encoder_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return EncodedTrunk(self.encoder_widths, hidden, layer_norm)
