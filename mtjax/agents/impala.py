"""IMPALA trains an actor-critic from rollouts of older policies, corrected by V-trace."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp

from mtjax.agents import critics, parts
from mtjax.agents.base import Inputs, Memory
from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.networks import Params
from mtjax.agents.on_policy import Batch, OnPolicy
from mtjax.agents.parts import targets
from mtjax.agents.rates import discounts_of_all
from mtjax.agents.state import AgentState, over_tasks
from mtjax.experience import Rollouts
from mtjax.types import Acted, Array, InputError, Key, Metrics, Task, Transition


@dataclasses.dataclass(frozen=True)
class IMPALA(OnPolicy):
    """IMPALA learns from what an older policy mu has played (Espeholt et al. 2018), with PopArt (Hessel et al. 2019).

    For a window of L steps of one environment, rho = min(1, pi(a|s) / mu(a|s)), and V-trace's targets v and advantages
    A of the present critic and policy (``targets.vtrace``), in each gradient step:
        L_pi = -rho log pi(a|s) A / s_i - c H(pi(s))                                        (actor loss)
        L_V = (V'(s) - (v - m_i) / s_i)^2 / 2                                               (critic loss)
    averaged over a task's windows, then over tasks. m_i and s_i are moving estimates of mean and standard deviation of
    the task's targets v, and V = m_i + s_i V'. When they move, which is before each gradient step, the head of the
    task is rescaled so that V does not change. So tasks with large rewards do not outweigh others.

    The policy that acts is the present one, or for ``actor_lag`` = k a copy that is renewed after every k rollouts, as
    where many machines act for one that learns. Evaluation plays the present policy.

    Differs from the papers: actor and critic share no parameters, so that the critic's loss needs no weight; Adam
    replaces RMSProp; observations are normalised by moments of the rollouts; a time limit cuts the sum and bootstraps;
    rewards are not clipped. The entropy of a Gaussian policy is estimated from one sample.
    """

    adjustable: ClassVar[tuple[str, ...]] = (*OnPolicy.adjustable, "actor_lag")
    in_training: ClassVar[Mapping[str, Any]] = MappingProxyType({"actor_lag": 0})
    gae_lambda: float = 1.0
    """Lambda of V-trace: 0 relies on the critic alone, 1 on the rewards of the rollout."""
    value_normalization: Literal["none", "running", "popart"] = "popart"
    value_rate: float = 0.01
    """Weight of a new batch of windows in the moving estimates of targets' mean and variance."""
    actor_lag: int = 0
    """Rollouts after which the policy that acts is renewed; 0 acts with the present policy."""
    experience: Annotated[Rollouts, FLAT] = dataclasses.field(
        default_factory=lambda: Rollouts(unroll=20, epochs=1, minibatches=4)
    )

    def __post_init__(self):
        super().__post_init__()
        parts.require_not_negative(self, "actor_lag")
        if self.actor_lag and self.representation.learns:
            raise InputError("actor-lag keeps a copy of the actor alone; use it with representation=plain")

    @property
    def unroll(self) -> int:
        return self.experience.unroll

    # The policy that acts.

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        state = super().init_networks(state, inputs, key)
        if not self.actor_lag:
            return state
        older = {name: net for name, net in state.nets.items() if name in ("actor", "knowing", "belief", "inputs")}
        state = state._replace(slow=state.slow | jax.tree.map(jnp.copy, older))
        return state.with_nets(lag=Params({"rollouts": jnp.int32(0)}, {}))

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        older = state.slow if self.actor_lag and key is not None else {}
        return super().act(state.with_nets(**older), memory, obs, task, key)

    def observe(self, state: AgentState, steps: Transition, tasks: Task) -> AgentState:
        state = super().observe(state, steps, tasks)
        if not self.actor_lag:
            return state
        rollouts = state.nets["lag"].shared["rollouts"] + 1
        due = rollouts % self.actor_lag == 0
        newer = {name: state.nets[name] for name in state.slow}
        slow = jax.tree.map(partial(jnp.where, due), newer, state.slow)
        return state.with_nets(lag=Params({"rollouts": rollouts}, {}))._replace(slow=slow)

    # Gradient steps.

    def prepare(self, state: AgentState, window: Transition, tasks: Task) -> tuple[AgentState, Batch]:
        flat, features, obs, next_obs = self.view.steps(state, window, tasks)
        log_ratio = over_tasks(self.log_ratio, state.nets, features, obs, flat.extras, tasks.action_mask)
        value, next_value = (critics.values(self, state, features, x) for x in (obs, next_obs))
        gamma = discounts_of_all(self, tasks)
        found = self.trace(window, gamma, critics.rewards(self, state, flat, tasks), value, next_value, log_ratio)
        target, advantage = (x.reshape(len(x), -1) for x in found)
        state, units = critics.renew(self, state, target)
        scaled = {"advantage": advantage / units.std[:, None], "value": value, "target": units.outputs(target)}
        models = critics.models(self, state, flat, tasks, next_obs)
        given = flat.extras._asdict() | scaled | models
        return state, Batch(obs=obs, features=features, mask=tasks.action_mask, **given)

    def trace(self, window: Transition, gamma: Array, *of_steps: Array) -> targets.VTrace:
        """Return V-trace (T, B, L) of windows, given rewards, values, next values and log ratios (T, B L)."""
        reward, value, next_value, log_ratio = (x.reshape(window.reward.shape) for x in of_steps)
        of_window = partial(targets.vtrace, lambda_=self.gae_lambda)
        of_task = jax.vmap(of_window, (0, 0, 0, 0, None))
        return jax.vmap(of_task)(window._replace(reward=reward), value, next_value, log_ratio, gamma)

    def gain(self, log_ratio: Array, batch: Batch) -> tuple[Array, Metrics]:
        """Return log pi(a|s) A, up to a constant; ``vtrace`` has weighed A by the ratio already."""
        return log_ratio * batch.advantage, {"ratio": jnp.mean(jnp.minimum(jnp.exp(log_ratio), 1.0))}
