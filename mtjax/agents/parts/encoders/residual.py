"""Residual bodies with layer normalisation, which go on learning where plain networks of their size do not."""

import dataclasses

import flax.linen as nn

from mtjax.agents.parts.encoders.base import Identity
from mtjax.networks import ReLU, join
from mtjax.types import Array, InputError

_he = nn.initializers.he_normal()


class BroNetTrunk(nn.Module):
    """Dense, norm and relu; then blocks that add to it."""

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
    """A linear layer, blocks that add to it, and a last norm."""

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
    """Width and number of residual blocks, one for every hidden layer.

    Raises:
        InputError: hidden layers differ in width, through which nothing could be added.
    """
    if len(set(hidden)) > 1:
        raise InputError(f"{name} has a block of one width for each hidden layer; hidden={hidden} has several")
    return hidden[0], len(hidden)


@dataclasses.dataclass(frozen=True)
class BroNet(Identity):
    """BroNet (Nauman et al. 2024, "Bigger, Regularized, Optimistic"), with a block for each width of ``hidden``.

        x = relu(LN(Dense(inputs)));   x <- x + LN(Dense(relu(LN(Dense(x)))))   in each block
    Norms are the body's own: critic-layer-norm and actor-layer-norm say nothing here.

    Differs from the paper: actor and critics are of one size (there, 2 blocks of 512 in critics and 1 of 256 in the
    actor); kernels start by He's initialisation, where the authors' are orthogonal times sqrt 2, which is of the same
    size and takes a QR decomposition each, and heads by LeCun's; of the paper's agent it is the network alone, without
    optimistic exploration, quantiles and resets.
    """

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return BroNetTrunk(*blocks("bronet", hidden))


@dataclasses.dataclass(frozen=True)
class SimBa(Identity):
    """SimBa (Lee et al. 2024, "Simplicity Bias for Scaling Up Parameters"), with a block for each width of ``hidden``.

        x = Dense(inputs);   x <- x + Dense(relu(Dense_4w(LN(x))))   in each block;   LN(x)
    Norms are the body's own: critic-layer-norm and actor-layer-norm say nothing here. The paper scales observations by
    their running statistics, which is normalize-observations, and decays weights, which is weight-decay.

    Differs from the paper: actor and critics are of one size (there, 2 blocks of 512 in critics and 1 of 128 in the
    actor); the first layer starts by LeCun's initialisation, where the authors' is orthogonal.
    """

    expansion: int = 4
    """Width inside a block, in widths of the block."""

    def __post_init__(self):
        if self.expansion < 1:
            raise InputError(f"expansion must be at least 1, not {self.expansion}")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return SimBaTrunk(*blocks("simba", hidden), self.expansion)
