"""Asymmetric lets the actor see pictures, and the critics the state."""

import dataclasses
from typing import Any, ClassVar

import flax.linen as nn

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.networks import Params
from mtjax.agents.parts.representations.base import Plain
from mtjax.agents.parts.vision import Sight, Vision, require_large, shift_pictures
from mtjax.types import Array, InputError, Key, Transition


@dataclasses.dataclass(frozen=True)
class Asymmetric(Plain):
    """Asymmetric is an actor that sees pictures p, with critics that see the state s (Pinto et al. 2018).

    The actor is pi(phi(p)). Its own loss trains phi: convolutions (``vision``), a linear layer, layer normalisation and
    tanh. Critics are networks on s, as without pictures: Q(s, a) in SAC and V(s) in PPO. Their losses touch no picture.
    So pictures cost one pass with gradients, in the actor's loss, and in SAC one without, for a' ~ pi(phi(p')).

    Training needs pictures and the state (``--env.pixels=64 --env.state=also``). Acting needs the pictures alone: a
    loaded policy takes observations with or without the state. With ``heads=disjoint`` every task has a phi of its own.

    In SAC each picture of a batch is shifted at random (``shift``), as in DrQ; in PPO none is.

    Differs from the paper: it takes DDPG, with bottlenecks and domain randomisation; here the agent is any of SAC, its
    variants and PPO.
    """

    latent_widths: tuple[int, ...] = (256, 50)
    """Widths of the encoder's layers; the last is the size of the latent state. Of pictures only the last counts."""
    vision: Vision = "drq"
    """Convolutions for pictures: drq (four, as in SAC-AE and DrQ), impala (fifteen in residual blocks) or grid (one,
    for grids of few cells)."""
    shift: int = 4
    """Shift pictures of a batch from the replay by up to so many pixels at random; 0 for none."""

    sees_pictures: ClassVar[bool] = True

    def __post_init__(self):
        parts.require_layers(self, "latent_widths")
        parts.require_not_negative(self, "shift")

    def require(self, obs: Any) -> None:
        if not frames.shown(obs) or frames.state(obs) is None:
            raise InputError(
                "representation=asymmetric shows pictures to the actor and the state to the critics; "
                "give --env.pixels=64 --env.state=also"
            )
        require_large(self.vision, obs)

    def acts_on(self, obs: Any) -> Any:
        return {frames.PICTURES: obs[frames.PICTURES]}

    def perceive(self, params: Params, features: Array, obs: Any) -> tuple[Array, Array]:
        """Return the features of the task, and the states (..., O)."""
        return features, obs[frames.STATE]

    def actor_inputs(self, params: Params, features: Array, obs: Any) -> tuple[Array, Any]:
        """Return the features of the task, and the observation without its state."""
        return features, self.acts_on(obs)

    def augment(self, batch: Transition, key: Key) -> Transition:
        return shift_pictures(batch, key, self.shift)

    @property
    def sight(self) -> nn.Module:  # type: ignore[override]
        return Sight(self.latent_widths[-1], self.vision)
