"""BRC trains soft actor-critic with large, regularised, categorical critics that all tasks share."""

import dataclasses
from typing import Annotated, Literal

from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.parts.encoders import BroNet, Encoder
from mtjax.agents.parts.knowing import Embedding, Knowing
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
        Embeddings begin with a length of about the square root of their size, there of about 1.
        Temperature: its Adam has a first decay of 0.9; there, 0.5 (temperature_momentum).
        Mixtures: each task's target entropy counts its own actions; there, padded ones too.
        ``BroNet`` describes the initial weights of the body, and ``ReturnScaling`` the largest return.
    """

    actor_lr: float = 3e-4
    critic_lr: float = 3e-4
    temperature_lr: float = 3e-4
    weight_decay: float = 1e-4
    conditioning: Annotated[Knowing, FLAT] = dataclasses.field(
        default_factory=lambda: Embedding(embedding_size=32, unit_embedding=True)
    )
    critic_reduction: Literal["min", "mean"] = "mean"
    shared_temperature: bool = True
    encoder: Annotated[Encoder, FLAT] = dataclasses.field(default_factory=BroNet)
    value: Annotated[Value, FLAT] = dataclasses.field(default_factory=C51)
    scaling: Annotated[Scaling, FLAT] = dataclasses.field(default_factory=ReturnScaling)
