"""XQC trains soft actor-critic with batch normalisation, weight normalisation and categorical critics."""

import dataclasses
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import replay_batches
from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.parts.encoders import BatchNorm, Encoder
from mtjax.agents.parts.knowing import Knowing, Parameters
from mtjax.agents.parts.scaling import ReturnNormalization, Scaling
from mtjax.agents.parts.values import C51, Value
from mtjax.agents.replay_batches import Batch, CriticAux, Sample
from mtjax.agents.sac import SAC
from mtjax.agents.state import Nets
from mtjax.types import Array, Key


class Aim(NamedTuple):
    """Holds what the critics' loss needs beside the batch."""

    target: Any  # (B, ...) as ``Value.loss`` takes it
    next_action: Array  # (B, A) of the policy


@dataclasses.dataclass(frozen=True)
class XQC(SAC):
    """XQC is SAC whose critics are well conditioned (Palenicek et al. 2025, "XQC: well-conditioned optimization").

    Batch normalisation, weight normalisation and the cross-entropy bound the critics' gradients and the condition
    number of their Hessian:
        every layer normalises the batch of a task, and its weights have length 1    (encoder=batch-norm, unit_head)
        Q_n is a distribution over returns in [-5, 5], fitted by its cross-entropy   (value=c51)
        rewards are divided by the standard deviation of returns                     (scaling=return-std)
    Critics and target critics see both ends of the transitions as one batch (CrossQ; Bhatt et al. 2024):
        [Q_n(s, a), Q_n(s', a')] = Q_n([s, s'], [a, a']),  a' ~ pi(s')
    so that one mean and variance normalise both. The critics' first half is fitted to a target from the target critics'
    second half. The policy normalises by the batch in its own loss. Elsewhere networks use the running statistics of
    their task: the policy for a' and for acting, and critics in the policy's loss. Each part's class has its equations.

    Differs from the authors' code:
        Rates: by default learning rates stay at 3e-4; there they fall to 3e-5 (lr_schedule=linear, lr_final=0.1). By
        default actor and temperatures learn at every update; there, at every third (policy_delay=3).
        Size: actor and critics have the widths ``hidden``; there, critics have four layers of 512 and the actor four
        of 256 (critic_hidden=(512, 512, 512, 512), actor_hidden=(256, 256, 256, 256)).
        Tasks: networks see the task's parameters, and every task has its own temperature and statistics; there is one
        task there.
        Rewards: the largest sum of rewards fits the range too; there, the standard deviation alone divides.
        Actor: log standard deviations lie in [-5, 2] by a tanh; there, they are clipped to [-10, 2].
        ``BatchNorm`` describes how the task enters, and the initial weights.
    """

    fits_statistics: ClassVar[bool] = True
    actor_lr: float = 3e-4
    critic_lr: float = 3e-4
    temperature_lr: float = 3e-4
    initial_temperature: float = 0.01
    conditioning: Annotated[Knowing, FLAT] = dataclasses.field(default_factory=Parameters)
    unit_head: bool = True
    encoder: Annotated[Encoder, FLAT] = dataclasses.field(default_factory=BatchNorm)
    value: Annotated[Value, FLAT] = dataclasses.field(default_factory=lambda: C51(value_low=-5.0, value_high=5.0))
    scaling: Annotated[Scaling, FLAT] = dataclasses.field(default_factory=ReturnNormalization)

    # Losses of one task. That of the actor is SAC's, with actions of a policy that normalises by the batch.

    def q_of_both(self, nets: Nets, batch: Batch, next_action: Array) -> tuple[Array, Array, Any]:
        """Apply every critic to both ends of the transitions as one batch.

        Returns:
            outputs (N, B, outputs) at (s, a), those at (s', a'), and new statistics (N, ...).
        """
        join = lambda now, later: jnp.concatenate([now, later])
        ends = [self.view.critic_inputs(nets, batch.features, obs) for obs in (batch.obs, batch.next_obs)]
        (features, inputs), (next_features, next_inputs) = ends
        features = join(features, next_features) if features.ndim == 2 else features
        data = (features, jax.tree.map(join, inputs, next_inputs), join(batch.action, next_action))
        outputs, found = jax.vmap(self.critic.fit, (0, None, None, None))(nets["critic"], *data)
        now, later = jnp.split(outputs, 2, axis=1)
        return now, later, found

    def critic_target(self, nets: Nets, slow: Nets, batch: Batch, key: Key) -> Aim:
        action, _, cost = self.sample(nets, batch, batch.next_obs, key)
        q, next_q, _ = self.q_of_both(slow, batch, action)
        low, bonus = self.critic_reduction == "min", replay_batches.bonus(self, nets, batch, cost, next_q, lambda: q)
        return Aim(self.value.target(next_q, low, batch.reward, batch.discount, bonus), action)

    def critic_loss(self, nets: Nets, batch: Batch, target: Aim) -> tuple[Array, CriticAux]:
        q, _, statistics = self.q_of_both(nets, batch, target.next_action)
        loss = jnp.mean(jnp.sum(self.value.loss(q, target.target), axis=0))
        return replay_batches.fitted(self, loss, q, target.target, nets, batch, statistics)

    def sample_and_fit(self, nets: Nets, batch: Batch, key: Key) -> tuple[Sample, Any]:
        outputs, statistics = self.actor.fit(nets["actor"], *self.view.actor_inputs(nets, batch.features, batch.obs))
        action, _, log_prob = self.policy.draw(outputs, batch.mask, key)
        return Sample(action, log_prob, log_prob), statistics
