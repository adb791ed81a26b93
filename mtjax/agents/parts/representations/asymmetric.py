"""Asymmetric lets the actor see pictures, and the critics the state."""

import dataclasses
from typing import Any

import flax.linen as nn

from mtjax import frames
from mtjax.agents.networks import Params
from mtjax.agents.parts.representations.seeing import Seeing
from mtjax.agents.parts.vision import Sight
from mtjax.types import Array, InputError


@dataclasses.dataclass(frozen=True)
class Asymmetric(Seeing):
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

    def require(self, obs: Any) -> None:
        if not frames.shown(obs) or frames.state(obs) is None:
            raise InputError(
                "representation=asymmetric shows pictures to the actor and the state to the critics; "
                "give --env.pixels=64 --env.state=also"
            )

    def acts_on(self, obs: Any) -> Any:
        return {frames.PICTURES: obs[frames.PICTURES]}

    def perceive(self, params: Params, features: Array, obs: Any) -> tuple[Array, Array]:
        """Return the features of the task, and the states (..., O)."""
        return features, obs[frames.STATE]

    def actor_inputs(self, params: Params, features: Array, obs: Any) -> tuple[Array, Any]:
        """Return the features of the task, and the observation without its state."""
        return features, self.acts_on(obs)

    @property
    def sight(self) -> nn.Module:  # type: ignore[override]
        return Sight(self.latent_widths[-1], self.vision)
