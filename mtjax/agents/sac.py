"""SAC trains soft actor-critic on many tasks at once; its variants override single methods."""

import dataclasses
from typing import Annotated, Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mtjax.agents import combinations, replay_batches, unit_resets
from mtjax.agents.base import BaseAgent, Inputs, Memory
from mtjax.agents.fit import Fit, above_least, descend
from mtjax.agents.hyperparameters import FLAT
from mtjax.agents.networks import Params
from mtjax.agents.parts.continual import Continual
from mtjax.agents.parts.plasticity import Plasticity
from mtjax.agents.parts.targets import Target
from mtjax.agents.parts.values import Value, reduce
from mtjax.agents.rates import scheduled
from mtjax.agents.replay_batches import ActorAux, Batch, CriticAux, Sample
from mtjax.agents.state import AgentState, Nets, over_tasks
from mtjax.experience import Replay
from mtjax.parallel.axes import when
from mtjax.types import Acted, Array, Key, Metrics, Task, Transition, Weighted


@dataclasses.dataclass(frozen=True)
class SAC(BaseAgent):
    """SAC trains one soft actor-critic on all tasks, by default blind to the task (Haarnoja et al. 2018; "MT-SAC").

    Per transition of task i, with temperature a_i, N critics Q_n and target critics Qbar_n:
        y = r + discount gamma (min_n Qbar_n(s', a') - a_i log pi(a'|s')),  a' ~ pi(s')     (critic target)
        L_Q = sum_n (Q_n(s, a) - y)^2                                                        (critic loss)
        L_pi = a_i log pi(a|s) - min_n Q_n(s, a),  a ~ pi(s)                                 (actor loss)
        L_a = a_i (-log pi(a|s) - H)                                                         (temperature loss)
    averaged over the batch of a task, then over tasks. ``discount`` is 0 only where an episode terminated, so that a
    time limit bootstraps. The actor loss and the target critics use the critic that this update has changed.

    Differs from the paper: critics have layer normalisation; by default the learning rate is 1e-3, the target entropy H
    is -A/2 and each task has its own temperature; a tanh brings log standard deviations into [-5, 2].
    """

    adjustable: ClassVar[tuple[str, ...]] = (
        *BaseAgent.adjustable,
        *("temperature_lr", "temperature_momentum", "tau", "target_entropy"),
    )
    temperature_lr: float = 1e-3
    """Adam's learning rate of the temperatures."""
    temperature_momentum: float = 0.9
    """First decay rate of the temperatures' Adam; 0.5 in SAC-AE and BRC."""
    tau: float = 0.005
    """Step of the target critic towards the new critic at each update, as a share of the distance."""
    num_critics: int = 2
    """Number of critics."""
    critic_reduction: Literal["min", "mean"] = "min"
    """How the critics' values become one, for targets and for the actor: their minimum or their mean."""
    initial_temperature: float = 0.1
    """Temperature before training."""
    target_entropy: float = -0.5
    """Entropy to which the temperature is tuned, per action dimension."""
    shared_temperature: bool = False
    """Use one temperature for all tasks instead of one for each task."""
    unit_head: bool = False
    """Keep the weights of each output of actor and critics at length 1."""
    value: Annotated[Value, FLAT] = dataclasses.field(default_factory=Value)
    target: Annotated[Target, FLAT] = dataclasses.field(default_factory=Target)
    continual: Annotated[Continual, FLAT] = dataclasses.field(default_factory=Continual)
    plasticity: Annotated[Plasticity, FLAT] = dataclasses.field(default_factory=Plasticity)
    experience: Annotated[Replay, FLAT] = dataclasses.field(default_factory=Replay)

    def __post_init__(self):
        super().__post_init__()
        combinations.check_replayed(self)

    losses = replay_batches.losses

    # Networks.

    def init_networks(self, state: AgentState, inputs: Inputs, key: Key) -> AgentState:
        (actor_key, critic_key), num_tasks, action = jax.random.split(key), state.num_tasks, inputs.action
        actor = self.actor.init(actor_key, num_tasks, self.policy.outputs(len(action)), *inputs.actor)
        init_critic = lambda k: self.critic.init(k, num_tasks, self.value.outputs, *inputs.critic, action)
        keys, every = jax.random.split(critic_key, self.num_critics), Params(shared=0, own=1)
        critic = jax.vmap(init_critic, out_axes=every)(keys)  # type: ignore
        log = jnp.log if isinstance(self.initial_temperature, Array) else np.log
        log = jnp.full(1 if self.shared_temperature else num_tasks, log(self.initial_temperature)).astype(jnp.float32)
        temperature = Params({"log": log}, {}) if self.shared_temperature else Params({}, {"log": log})
        kept = self.continual.init(actor, num_tasks, inputs.actor, self.policy.outputs(len(action)))
        kept = kept | unit_resets.begin(self, {"actor": actor, "critic": critic})
        state = state.with_nets(**kept, actor=actor, critic=critic, temperature=temperature)
        return state._replace(slow=replay_batches.slow_copies(self, state.nets))

    @property
    def fits(self) -> dict[str, Fit]:
        rate = scheduled(self, self.temperature_lr, self.experience.policy_delay)
        return super().fits | {"temperature": Fit(("temperature",), optax.adam(rate, self.temperature_momentum))}

    def act(self, state: AgentState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) for one observation (O,) of one task; without a key, the mean action."""
        return self.acted(self.policy_outputs(*self.view.acting(state, memory, obs, task)), task, key)

    def acted(self, outputs: Array, task: Task, key: Key | None) -> Acted:
        """Draw an action (A,) from the policy's outputs, and keep of it what targets ask for."""
        drawn = self.policy.draw(outputs, task.action_mask, key)
        return Acted(drawn.action, self.target.keep(drawn), outputs)

    # Losses of one task.

    def sample(self, nets: Nets, batch: Batch, obs: Any, key: Key) -> Sample:
        """Sample the policy's actions at observations (B, O) of a batch."""
        action, _, log_prob = self.policy.draw(self.policy_outputs(nets, batch.features, obs), batch.mask, key)
        return Sample(action, log_prob, log_prob)

    def sample_and_fit(self, nets: Nets, batch: Batch, key: Key) -> tuple[Sample, Any]:
        """Sample actions at a batch's observations for the actor loss, with new running statistics of the actor."""
        return self.sample(nets, batch, batch.obs, key), {}

    def q(self, nets: Nets, features: Array, obs: Any, action: Array) -> Array:
        """Return every critic's outputs (N, B, outputs)."""
        features, inputs = self.view.critic_inputs(nets, features, obs)
        return jax.vmap(self.critic.apply, (0, None, None, None))(nets["critic"], features, inputs, action)

    def values(self, nets: Nets, features: Array, obs: Any, action: Array) -> Array:
        """Return every critic's estimate of the value (N, B)."""
        return self.value.mean(self.q(nets, features, obs, action))

    def judge(self, state: AgentState, tasks: Task, steps: Transition) -> Array:
        """Return the values (T, B) of steps (T, B, ...), each as of its task, over the task's temperature."""
        batch = replay_batches.prepare(self, state, jax.tree.map(lambda x: jnp.expand_dims(x, 2), steps), tasks)

        def of_task(nets: Nets, batch: Batch) -> Array:
            q = self.values(nets, batch.features, batch.obs, batch.action)
            return reduce(q, self.critic_reduction == "min") / batch.temperature

        return over_tasks(of_task, state.nets, batch)

    def critic_target(self, nets: Nets, slow: Nets, batch: Batch, key: Key) -> Any:
        """Compute the critic target y (B, ...), in the form that ``value.loss`` takes."""
        action, _, cost = self.sample(nets, batch, batch.next_obs, key)
        next_q = self.q(slow, batch.features, batch.next_obs, action)
        q = lambda: self.q(slow, batch.features, batch.obs, batch.action)
        bonus = replay_batches.bonus(self, nets, batch, cost, next_q, q)
        return self.value.target(next_q, self.critic_reduction == "min", batch.reward, batch.discount, bonus)

    def critic_loss(self, nets: Nets, batch: Batch, target: Any) -> tuple[Array, CriticAux]:
        q = self.q(nets, batch.features, batch.obs, batch.action)
        loss = jnp.mean(jnp.sum(self.value.loss(q, target), axis=0))
        return replay_batches.fitted(self, loss, q, target, nets, batch)

    def actor_loss(self, nets: Nets, batch: Batch, key: Key) -> tuple[Array, ActorAux]:
        """Compute the actor loss, with what holds the actor to earlier tasks of a sequence."""
        (action, log_prob, cost), statistics = self.sample_and_fit(nets, batch, key)
        held = self.continual.penalty(nets, self, jax.random.fold_in(key, 1))
        value = reduce(self.values(nets, batch.features, batch.obs, action), self.critic_reduction == "min")
        loss, entropy = jnp.mean(batch.temperature * cost - value), -jnp.mean(log_prob)
        return loss + held, ActorAux({"actor_loss": loss, "entropy": entropy}, entropy, statistics)

    def temperature_loss(self, nets: Nets, entropy: Array, action_size: Array) -> tuple[Array, None]:
        """Compute the loss of one task's temperature, by the entropy () of its policy."""
        excess = entropy - self.target_entropy * action_size
        return jnp.sum(jnp.exp(nets["temperature"].parts["log"]) * excess), None

    # Update of all tasks.

    def update(
        self, state: AgentState, window: Transition, tasks: Task, key: Key, number: Array
    ) -> tuple[AgentState, Metrics]:
        """Take one gradient step on windows (T, B, L, ...) of the training tasks; metrics are (T,).

        Args:
            number: () as in ``BaseAgent.update``; actor and temperatures learn at every ``policy_delay``-th.
        """
        target_key, actor_key, critic_order, actor_order = jax.random.split(key, 4)
        batch = replay_batches.prepare(self, state, window, tasks, jax.random.fold_in(key, 1))
        batch = self.view.keyed(batch, jax.random.fold_in(key, 2))
        before = state.nets["representation"]
        importance = self.sampler.weights(state.nets["sampler"].own, batch.temperature)

        data = replay_batches.critic_data(self, state, batch, target_key)
        loss = above_least(self, self.critic_loss)
        state, fitted = descend(self.fits, "critic", state, loss, data, critic_order, importance)
        state = replay_batches.with_statistics(state, "critic", fitted.aux.statistics)

        def improve(state: AgentState) -> tuple[AgentState, Metrics]:
            seen = {"representation": representation.without(self.representation.own_target).filled(before)}
            data, before_step = (batch, jax.random.split(actor_key, len(batch.temperature))), state.nets
            state, improved = descend(self.fits, "actor", state, self.actor_loss, data, actor_order, importance, seen)
            state = state._replace(nets=self.continual.kept(before_step, state.nets))
            state = replay_batches.with_statistics(state, "actor", improved.aux.statistics)
            data = (improved.aux.entropy, replay_batches.action_sizes(batch.action, batch.mask))
            state, _ = descend(self.fits, "temperature", state, self.temperature_loss, data, actor_order)
            return state, improved.aux.metrics | improved.metrics

        representation, delay = state.nets["representation"], self.experience.policy_delay
        turn = (number + 1) % delay == 0
        state, actor_metrics = improve(state) if delay == 1 else when(turn, improve, state)
        if delay > 1:
            weigh = lambda x: Weighted(x, jnp.full(x.shape, turn, jnp.float32))
            actor_metrics = {name: weigh(x) for name, x in actor_metrics.items()}

        state = replay_batches.renew_scales(self, replay_batches.update_target(self, state), fitted.aux.expected)
        state = unit_resets.renew(self, state, batch, jax.random.fold_in(key, 3), number)
        return state, fitted.aux.metrics | actor_metrics | {"temperature": batch.temperature} | fitted.metrics
