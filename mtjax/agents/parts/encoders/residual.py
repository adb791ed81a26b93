"""Residual bodies with layer normalisation keep learning at sizes at which plain MLPs stop."""

import dataclasses

import flax.linen as nn

from mtjax.agents import parts
from mtjax.agents.networks import ReLU, join
from mtjax.agents.parts.encoders.base import Identity
from mtjax.types import Array, InputError

_he = nn.initializers.he_normal()


class BroNetTrunk(nn.Module):
    """Applies a dense layer with norm and ReLU, then residual blocks."""

    width: int
    num_blocks: int

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        dense = lambda x: nn.LayerNorm()(nn.Dense(self.width, kernel_init=_he)(x))
        x = ReLU()(dense(join(obs, *action, task=features)))
        for _ in range(self.num_blocks):
            x = x + dense(ReLU()(dense(x)))
        return x


class SimBaTrunk(nn.Module):
    """Applies a linear layer, residual blocks and a last norm."""

    width: int
    num_blocks: int
    expansion: int

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        x = nn.Dense(self.width)(join(obs, *action, task=features))
        for _ in range(self.num_blocks):
            inner = ReLU()(nn.Dense(self.expansion * self.width, kernel_init=_he)(nn.LayerNorm()(x)))
            x = x + nn.Dense(self.width, kernel_init=_he)(inner)
        return nn.LayerNorm()(x)


def blocks(name: str, hidden: tuple[int, ...]) -> tuple[int, int]:
    """Return width and number of residual blocks, one for every hidden layer.

    Raises:
        InputError: hidden layers differ in width, so that blocks could not be added.
    """
    if len(set(hidden)) > 1:
        raise InputError(f"{name} has a block of one width for each hidden layer; hidden={hidden} has several")
    return hidden[0], len(hidden)


@dataclasses.dataclass(frozen=True)
class BroNet(Identity):
    """BroNet has a residual block for each width of ``hidden`` (Nauman et al. 2024, "Bigger, Regularized, Optimistic").

        x = relu(LN(Dense(inputs)));   x <- x + LN(Dense(relu(LN(Dense(x)))))   in each block
    Its norms do not depend on critic-layer-norm and actor-layer-norm.

    Differs from the paper: by default actor and critics have the same size (there, 2 blocks of 512 in critics and 1 of
    256 in the actor: critic_hidden=(512, 512) and actor_hidden=(256,)). Kernels start by He's initialisation, and heads
    by LeCun's; the authors' are orthogonal times sqrt 2, which has He's scale but needs a QR decomposition for each.
    Only the network is implemented, not the paper's optimistic exploration, quantiles and resets.
    """

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return BroNetTrunk(*blocks("bronet", hidden))


@dataclasses.dataclass(frozen=True)
class SimBa(Identity):
    """SimBa has a residual block for each width of ``hidden`` (Lee et al. 2024).

        x = Dense(inputs);   x <- x + Dense(relu(Dense_4w(LN(x))))   in each block;   LN(x)
    Its norms do not depend on critic-layer-norm and actor-layer-norm. For the paper's scaling of observations use
    normalize-observations, and for its weight decay weight-decay.

    Differs from the paper: by default actor and critics have the same size (there, 2 blocks of 512 in critics and 1 of
    128 in the actor: critic_hidden=(512, 512) and actor_hidden=(128,)); the first layer starts by LeCun's
    initialisation, where the authors' is orthogonal.
    """

    expansion: int = 4
    """Factor between the width inside a block and the width of the block."""

    def __post_init__(self):
        parts.require_counts(self, "expansion")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return SimBaTrunk(*blocks("simba", hidden), self.expansion)
