"""BRC trains soft actor-critic with large, regularised, categorical critics that all tasks share."""

import dataclasses
from typing import Annotated, Literal

from mtjax.agents.base import Conditioning
from mtjax.agents.choices import FLAT
from mtjax.agents.parts.encoders import BroNet, Encoder
from mtjax.agents.parts.scaling import ReturnScaling, Scaling
from mtjax.agents.parts.values import C51, Value
from mtjax.agents.sac import SAC


@dataclasses.dataclass(frozen=True)
class BRC(SAC):
    """BRC is SAC with bigger, regularised, categorical critics for many tasks (Nauman et al. 2025).

    Every task i has a learned vector e_i, and all tasks share the rest:
        Q_n(s, a, e_i / |e_i|) and pi(s, e_i / |e_i|) are residual, layer-normalised networks    (encoder=bronet)
        Q_n is a distribution over returns in [-10, 10], fitted by its cross-entropy             (value=c51)
        the mean of both critics' distributions bootstraps, and its mean guides the actor        (critic_reduction=mean)
        rewards are divided by the task's largest discounted sum, to fit returns to the range    (scaling=return)
    with one temperature, a target entropy of -A/2 and AdamW. Each part's class has its equations.

    Differs from the authors' code:
        Size: actor and critics have the widths ``hidden``; there, critics have two blocks of 4096 and the actor one of
        256, which are critic_hidden=(4096, 4096) and actor_hidden=(256,).
        Head: output layers begin by LeCun's initialisation; there they are orthogonal times sqrt 2, as all layers, and
        those of the log standard deviations, which lie in [-10, 2], orthogonal. Here these lie in [-5, 2].
        Batch: every update draws ``batch_size`` transitions of each task; there, 1024 at random from all tasks.
        Embeddings: the actor and each critic learn their own, whose initial length is about the square root of their
        size; there, all share one of initial length about 1, which the actor's loss does not train.
        Temperature: its Adam has a first decay of 0.9; there, 0.5 (temperature_momentum).
        Mixtures: each task's target entropy counts its own actions; there, padded ones too.
        ``BroNet`` describes the initial weights of the body, and ``ReturnScaling`` the largest return.
    """

    actor_lr: float = 3e-4
    critic_lr: float = 3e-4
    temperature_lr: float = 3e-4
    weight_decay: float = 1e-4
    conditioning: Conditioning = "embedding"
    embedding_size: int = 32
    unit_embedding: bool = True
    critic_reduction: Literal["min", "mean"] = "mean"
    shared_temperature: bool = True
    encoder: Annotated[Encoder, FLAT] = dataclasses.field(default_factory=BroNet)
    value: Annotated[Value, FLAT] = dataclasses.field(default_factory=C51)
    scaling: Annotated[Scaling, FLAT] = dataclasses.field(default_factory=ReturnScaling)
