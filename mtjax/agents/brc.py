"""BRC: soft actor-critic with large, regularised, categorical critics that all tasks share."""

import dataclasses
from typing import Annotated, Literal

from mtjax.agents.base import FLAT, Conditioning
from mtjax.agents.parts.encoders import BroNet, Encoder
from mtjax.agents.parts.scaling import ReturnScaling, Scaling
from mtjax.agents.parts.values import C51, Value
from mtjax.agents.sac import SAC


@dataclasses.dataclass(frozen=True)
class BRC(SAC):
    """Bigger, regularised, categorical critics for many tasks (Nauman et al. 2025, "BRC"), as SAC of other parts.

    Every task i has a learned vector e_i, and all tasks share the rest:
        Q_n(s, a, e_i / |e_i|) and pi(s, e_i / |e_i|) are residual, layer-normalised networks    (encoder=bronet)
        Q_n is a distribution over returns in [-10, 10], fitted by its cross-entropy             (value=c51)
        the mean of both critics' distributions bootstraps, and its mean guides the actor        (critic_reduction=mean)
        rewards are divided so that the task's largest return fits the range                     (scaling=return)
    with one temperature, a target entropy of -A/2 and AdamW. Each part's class has its equations.

    Differs from the authors' code:
        Size: actor and critics have the widths ``hidden``; there, critics have two blocks of 4096 and the actor one of
        256.
        Head: output layers begin by LeCun's initialisation; there they are orthogonal times sqrt 2, as all layers, and
        those of the log standard deviations, which lie in [-10, 2], orthogonal. Here these lie in [-5, 2].
        Batch: every update draws ``batch_size`` transitions of each task; there, 1024 of all tasks together, in
        proportions that chance decides.
        Embeddings: the actor and each critic learn their own, which begin as long as the root of their size; there,
        critics share one and lend it the actor, whose loss does not move it, and it begins about as long as 1.
        Temperature: its Adam has a first decay of 0.9; there, 0.5.
        Mixtures: each task has the target entropy of its own actions; there, of the padded ones.
        The body begins as ``BroNet`` says, and ``ReturnScaling`` says how it finds the largest return.
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
