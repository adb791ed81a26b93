"""Distral gives every task its own policy, and keeps these near one policy that is distilled from all."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax.agents import combinations, parts
from mtjax.agents.base import Heads, Memory
from mtjax.agents.networks import Network, Params
from mtjax.agents.replay_batches import ActorAux, Batch, Sample
from mtjax.agents.sac import SAC
from mtjax.agents.state import AgentState, Nets
from mtjax.types import Acted, Array, InputError, Key, Task


@dataclasses.dataclass(frozen=True)
class Policies(Network):
    """Holds a network for every task, and one of the same shape that all tasks share: the distilled policy."""

    def init(self, key: Key, num_tasks: int, out: int, features: Array, *inputs: Array) -> Params:
        """Initialise the distilled policy, and every task's policy as a copy, so that all begin with divergence 0."""
        distilled = self._distilled.init(key, num_tasks, out, features, *inputs)
        own = jax.tree.map(lambda x: jnp.repeat(x[None], num_tasks, axis=0), distilled.shared)
        again = jax.tree.map(jnp.copy, distilled.own)
        return Params({"distilled": distilled.shared}, {**own, **distilled.own, "distilled": again})

    def apply_distilled(self, params: Params, features: Array, *inputs: Array) -> Array:
        """Map one task's inputs to the distilled policy's outputs (..., out)."""
        distilled = Params(params.shared["distilled"], params.own["distilled"])
        return self._distilled.apply(distilled, features, *inputs)

    @property
    def _distilled(self) -> Network:
        return self.as_kind(Network, own=())


@dataclasses.dataclass(frozen=True)
class Distral(SAC):
    """Distral distills and transfers policies (Teh et al. 2017, "KL + ent 1 col"), on soft actor-critic.

    Task i has a policy pi_i and critics of its own, and all share a distilled policy pi_0. The paper's equation 1,
        J = sum_i E_{pi_i} sum_t gamma^t (r_i - c_KL log(pi_i / pi_0) - c_Ent log pi_i),
    is, with alpha = c_KL / (c_KL + c_Ent) and 1 / beta = c_KL + c_Ent,
        J = sum_i E_{pi_i} sum_t gamma^t (r_i + alpha / beta log pi_0 - 1 / beta log pi_i)          (equation 2)
    SAC's temperature a_i takes the place of 1 / beta:
        y = r + discount gamma (min_n Qbar_n(s', a') - a_i (log pi_i(a'|s') - alpha log pi_0(a'|s')))   (critic target)
        L_pi_i = a_i (log pi_i(a|s) - alpha log pi_0(a|s)) - min_n Q_n(s, a),  a ~ pi_i(s)              (actor loss)
        L_pi_0 = -log pi_0(a|s),  a ~ pi_i(s), summed over tasks                                        (distillation)
    each on the data of task i alone. The gradient of L_pi_i passes through the action in log pi_0 to pi_i, and does not
    change pi_0. The gradient of L_pi_0 changes pi_0 alone, and minimises KL(pi_i || pi_0). Temperatures are tuned as in
    SAC, on the entropy of pi_i, so that c_KL = alpha a_i and c_Ent = (1 - alpha) a_i. With alpha = 0, every task has
    its own SAC, and pi_0 only imitates. The metric ``kl`` is the mean of KL(pi_i || pi_0) over the batch's
    observations.

    Training tasks use their own policies, other tasks the distilled one. By default, as in the paper, no policy sees
    features of its task; with another conditioning all do, pi_0 too.

    Differs from the paper: all policies begin equal, with divergence 0; learning is off-policy, with critics in place
    of returns, and temperatures are tuned. The paper weighs distillation by c_KL, which makes no difference under Adam,
    and discounts late steps. Its two-column policies are not implemented.
    """

    adjustable: ClassVar[tuple[str, ...]] = (*SAC.adjustable, "distral_alpha")
    distils: ClassVar[bool] = True
    stand_in: ClassVar[str] = "the distilled policy plays them"
    one_knowledge: ClassVar[bool] = True  # which the distilled policy shares
    heads: Heads = "disjoint"
    distral_alpha: float = 0.5
    """Share of the divergence from the distilled policy in the regulariser; the rest is entropy (alpha)."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_shares(self, "distral_alpha")
        combinations.require_heads(self, "disjoint", "distral gives every task a policy of its own")
        if self.representation.learns:
            raise InputError(
                "in distral every task would have a representation of its own, but the distilled policy needs one that "
                "all tasks share; use representation=plain"
            )

    @property
    def actor(self) -> Policies:
        return super().actor.as_kind(Policies)

    def distilled(self, nets: Nets, features: Array, obs: Any) -> Array:
        """Return the distilled policy's outputs (..., 2A)."""
        return self.actor.apply_distilled(nets["actor"], *self.view.actor_inputs(nets, features, obs))

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) by the task's own policy, or by the distilled one for a task that is not known."""
        inputs = self.view.acting(state, memory, obs, task)
        outputs = jnp.where(task.id < state.num_tasks, self.policy_outputs(*inputs), self.distilled(*inputs))
        return self.acted(outputs, task, key)

    def sample(self, nets: Nets, batch: Batch, obs: Any, key: Key) -> Sample:
        outputs = self.policy_outputs(nets, batch.features, obs)
        _, raw, log_prob = self.policy.draw(outputs, batch.mask, key)
        distilled = self.distilled(nets | {"actor": jax.lax.stop_gradient(nets["actor"])}, batch.features, obs)
        cost = log_prob - self.distral_alpha * self.policy.log_prob(distilled, raw, batch.mask)
        return Sample(self.policy.action(raw, batch.mask), log_prob, cost)

    def actor_loss(self, nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:
        loss, aux = super().actor_loss(nets, batch, key)
        own = self.policy_outputs(nets, batch.features, batch.obs)
        raw = self.policy.draw(own, batch.mask, key).raw  # the actions of that loss
        distilled = self.distilled(nets, batch.features, batch.obs)
        fit = jnp.mean(self.policy.log_prob(distilled, jax.lax.stop_gradient(raw), batch.mask))
        kl = jnp.mean(self.policy.divergence(own, distilled, batch.mask))
        return loss - fit, aux._replace(metrics=aux.metrics | {"kl": kl})
