"""SimbaV2 trains soft actor-critic with features and weights on unit spheres, and categorical critics."""

import dataclasses
from typing import Annotated, Literal

from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.parts.encoders import Encoder, Hypersphere
from mtjax.agents.parts.knowing import Knowing, Parameters
from mtjax.agents.parts.scaling import ReturnNormalization, Scaling
from mtjax.agents.parts.values import C51, Value
from mtjax.agents.sac import SAC


@dataclasses.dataclass(frozen=True)
class SimbaV2(SAC):
    """SimbaV2 is SAC whose networks keep features and weights at length 1 (Lee et al. 2025).

    "Hyperspherical normalization for scalable deep reinforcement learning" keeps the norms of weights, features and
    gradients the same while data and targets move, so that larger networks and more updates go on helping:
        observations are normalised by running moments                                   (normalize_observations)
        every layer's output lies on the unit sphere, and blocks interpolate on it       (encoder=hypersphere)
        each unit's weights, those of outputs too, return to length 1 after every step   (unit_head)
        Q_n is a distribution over returns in [-5, 5], fitted by its cross-entropy       (value=c51)
        rewards are divided by the standard deviation of returns, within that range      (scaling=return-std)
    Each part's class has its equations.

    Differs from the authors' code:
        Rates: by default learning rates stay at 1e-4; there they fall to 5e-5 (lr_schedule=linear, lr_final=0.5).
        Discount: by default gamma is 0.99 for all tasks; there it is 1 - 5 / h for h decisions in an episode, within
        [0.95, 0.995] (discounting=horizon), which is 0.99 for their 500.
        Size: actor and critics have the widths ``hidden``; there, critics have two blocks of 512 and the actor one of
        128 (critic_hidden=(512, 512), actor_hidden=(128,)).
        Critics: the mean of two critics bootstraps and guides the actor. There it is the minimum where episodes
        terminate, and elsewhere there is one critic.
        Order: the critics' step comes before the actor's; there, after it.
        Actor: log standard deviations lie in [-5, 2]; there, in [-10, 2].
        Tasks: networks see the task's parameters, and every task has its own temperature and reward statistics; there
        is one task there.
        Observations are clipped to +-10 after normalisation, by moments of the batches that are learned from; there,
        of the steps that are played, without clipping.
        ``Hypersphere`` describes the last hidden layer and the initial weights.
    """

    actor_lr: float = 1e-4
    critic_lr: float = 1e-4
    temperature_lr: float = 1e-4
    initial_temperature: float = 0.01
    normalize_observations: bool = True
    conditioning: Annotated[Knowing, FLAT] = dataclasses.field(default_factory=Parameters)
    critic_reduction: Literal["min", "mean"] = "mean"
    unit_head: bool = True
    encoder: Annotated[Encoder, FLAT] = dataclasses.field(default_factory=Hypersphere)
    value: Annotated[Value, FLAT] = dataclasses.field(default_factory=lambda: C51(value_low=-5.0, value_high=5.0))
    scaling: Annotated[Scaling, FLAT] = dataclasses.field(default_factory=ReturnNormalization)
