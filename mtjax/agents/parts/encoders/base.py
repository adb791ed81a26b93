"""``Identity`` is the interface of encoders, and the one that encodes nothing."""

import dataclasses
from typing import ClassVar

import flax.linen as nn

from mtjax.agents import parts
from mtjax.agents.networks import MLP, Trunk, join
from mtjax.agents.parts.knowing import Knowing
from mtjax.types import Array


@dataclasses.dataclass(frozen=True)
class Identity:
    """Builds an MLP on observation, task features and, in a critic, the action.

    Every encoder is a class with these methods. The body of a network ends in the hidden layer below the heads. It is
    applied to the data of one task, and all tasks share its parameters.
    """

    needs_features: ClassVar[bool] = False  # if so, conditioning=none is refused
    has_statistics: ClassVar[bool] = False  # if so, only agents that keep running statistics of batches take it

    def refuses(self, conditioning: Knowing, otherwise: bool) -> str:
        """Return why the encoder cannot work with a conditioning; empty if it can.

        Args:
            otherwise: whether features of the task come from the representation too.
        """
        has_features = conditioning.tells or otherwise or not self.needs_features
        return "" if has_features else "works by the task's features, so conditioning cannot be none; use parameters"

    def require(self, num_tasks: int) -> None:
        """Check that the encoder can be had for so many training tasks.

        Raises:
            InputError: it cannot.
        """

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        """Return a module (observations (..., O), features (..., Z) or (Z,), [actions (..., A)]) -> (..., width)."""
        return Trunk(hidden, layer_norm)

    def front(self) -> nn.Module | None:
        """Return a module (observations (..., O)) -> (..., O') before the body, one for each task; None for none."""
        return None


class EncodedTrunk(nn.Module):
    """Encodes the observation by an MLP, and applies another to the encoding, the features and the action."""

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
    """Encodes the observation by an MLP of its own, without task and action (MTRL's feed-forward encoder)."""

    encoder_widths: tuple[int, ...] = (64, 64)
    """Widths of the encoder's layers; the last is the size of the encoding."""

    def __post_init__(self):
        parts.require_layers(self, "encoder_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return EncodedTrunk(self.encoder_widths, hidden, layer_norm)
