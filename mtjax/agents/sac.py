"""SAC trains soft actor-critic on many tasks at once; its variants override single methods."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mtjax import normalize
from mtjax.agents import parts
from mtjax.agents.base import BaseAgent, Memory, Pair
from mtjax.agents.choices import FLAT
from mtjax.agents.parts.gradients import descent, surgery
from mtjax.agents.parts.representations import REPRESENTATIONS
from mtjax.agents.parts.scaling import SCALINGS
from mtjax.agents.parts.trajectory import append
from mtjax.agents.parts.values import VALUES, Value
from mtjax.experience import Replay, pictures
from mtjax.experience.multistep import Ends
from mtjax.maps import when
from mtjax.networks import OVER_TASKS, Network, Params, tanh_normal
from mtjax.types import Acted, Array, InputError, Key, Metrics, Sometimes, Spec, Task, Transition


class Optimizers(NamedTuple):
    """Holds the optimisers' states."""

    actor: Any
    critic: Any
    temperature: Any


class SACState(NamedTuple):
    """Holds everything that SAC learns, and what it remembers of the training tasks."""

    actor: Params
    critic: Params  # shared leaves (N, ...), own leaves (T, N, ...); beside them the representation, without N
    target: Params  # the target critic: a slow copy of the critic
    log_temperature: Array  # (T,), or (1,) if shared
    optimizers: Optimizers
    moments: normalize.Moments
    contexts: Array  # (T, C) of the training tasks; an unseen task finds its nearest among them
    vectors: Array | None  # (T, V) given task vectors, if conditioned on them
    surgery: Pair
    scales: Any  # memory of the scaling of rewards
    progress: Any  # memory of the sampler of tasks


class Batch(NamedTuple):
    """Holds the data for the losses of one task; for all tasks, leaves are (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    action: Array  # (B, A)
    reward: Array  # (B,) in the task's units
    discount: Array  # (B,) gamma, or 0 where the episode terminated
    next_obs: Any  # (B, O)
    features: Array  # (Z,) or (B, Z) features of the task, which networks take as inputs
    temperature: Array  # ()
    mask: Array | None  # (A,) 1 for actions that the task has, else 0; None: it has all
    model_targets: Any = None  # targets of the representation's models
    followed: Array | None = None  # (B,) bool: next_obs is what followed; None: it always is


class Sample(NamedTuple):
    """Holds actions that a policy has sampled."""

    action: Array  # (B, A)
    log_prob: Array  # (B,)
    cost: Array  # (B,) what the temperature weighs: log pi, in Distral less a share of log pi_0


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
    experience: Annotated[Replay, FLAT] = dataclasses.field(default_factory=Replay)

    def _check_numbers(self) -> None:
        if not 0 <= self.gamma <= 1 or not 0 < self.tau <= 1:
            raise InputError(f"gamma must be in [0, 1] and tau in (0, 1], not {self.gamma} and {self.tau}")
        super()._check_numbers()
        parts.require_positive(self, "temperature_lr", "num_critics", "initial_temperature")
        if not 0 <= self.temperature_momentum < 1:
            raise InputError(f"temperature-momentum must be in [0, 1), not {self.temperature_momentum}")

    def _check_combination(self) -> None:
        super()._check_combination()
        value, scaling = parts.name_of(VALUES, self.value), parts.name_of(SCALINGS, self.scaling)
        if scaling == "popart" and (self.heads == "shared" or value != "scalar"):
            raise InputError(
                "scaling=popart rescales a scalar head of every task's own; use value=scalar and heads=per-task or "
                f"disjoint, not {value} and {self.heads}"
            )
        if self.representation.predicts and self.experience.n_step > 1:
            name = parts.name_of(REPRESENTATIONS, self.representation)
            raise InputError(f"{name} learns models of single steps; use n-step=1, not {self.experience.n_step}")
        if scaling == "popart" and self.unit_head:
            raise InputError("scaling=popart rescales heads, which unit-head keeps at length 1; use one of them")

    # Networks.

    def network(self, hidden: tuple[int, ...], layer_norm: bool) -> Network:
        return dataclasses.replace(super().network(hidden, layer_norm), unit_head=self.unit_head)

    def init(self, spec: Spec, tasks: Task, key: Key) -> SACState:
        """Return the initial state for the training ``tasks`` (T, ...)."""
        common = self.init_common(spec, tasks, key)
        log = jnp.log if isinstance(self.initial_temperature, Array) else np.log
        log_temperature = jnp.full(1 if self.shared_temperature else len(tasks.id), log(self.initial_temperature))
        log_temperature = log_temperature.astype(jnp.float32)
        parameters = (common["actor"], common["critic"], log_temperature)
        return SACState(
            **common,
            target=jax.tree.map(jnp.copy, common["critic"].without(self.representation.without_target)),
            log_temperature=log_temperature,
            optimizers=Optimizers(*(o.init(p) for o, p in zip(self.optimizers, parameters, strict=True))),
        )

    def init_networks(self, num_tasks: int, inputs: Pair, action: Array, key: Key) -> Pair:
        actor_key, critic_key = jax.random.split(key)
        actor = self.actor.init(actor_key, num_tasks, 2 * len(action), *inputs.actor)
        init_critic = lambda k: self.critic.init(k, num_tasks, self.value.outputs, *inputs.critic, action)
        keys = jax.random.split(critic_key, self.num_critics)
        return Pair(actor, jax.vmap(init_critic, out_axes=Params(shared=0, own=1))(keys))  # type: ignore

    def reset_networks(self, state: SACState, spec: Spec, tasks: Task, key: Key) -> SACState:
        """Return a state with new networks, optimisers, temperatures and surgery; statistics of the data are kept."""
        return self.init(spec, tasks, key)._replace(
            moments=state.moments,
            contexts=state.contexts,
            vectors=state.vectors,
            scales=self.scaling.reset(state.scales),
            progress=state.progress,
        )

    @property
    def optimizers(self) -> Optimizers:
        temperature_lr = self.scheduled(self.temperature_lr, self.experience.policy_delay)
        return Optimizers(*self.network_optimizers, optax.adam(temperature_lr, self.temperature_momentum))

    # Acting.

    def act(self, state: SACState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) for one observation (O,) of one task; without a key, the mean action."""
        trained = task.id < len(state.contexts)
        outputs = self.behaviour(trained, *self.acting_inputs(state, memory, obs, task))
        return Acted(tanh_normal(outputs, key, task.action_mask)[0], memory.past, memory)

    def behaviour(self, trained: Array, actor: Params, critic: Params, features: Array, obs: Any) -> Array:
        """Return the outputs (2A,) of the policy that acts; ``trained`` () says whether the task was trained on."""
        return self.policy(actor, critic, features, obs)

    # Losses of one task.

    def policy(self, actor: Params, critic: Params, features: Array, obs: Any) -> Array:
        """Return the policy's outputs (..., 2A). The representation's parameters lie beside the critics'."""
        return self.actor.apply(actor, *self.actor_inputs(critic, features, obs))

    def sample(self, actor: Params, critic: Params, batch: Batch, obs: Any, key: Key) -> Sample:
        """Sample the policy's actions at observations (B, O) of a batch."""
        action, log_prob = tanh_normal(self.policy(actor, critic, batch.features, obs), key, batch.mask)
        return Sample(action, log_prob, log_prob)

    def q(self, critic: Params, features: Array, obs: Any, action: Array) -> Array:
        """Return every critic's outputs (N, B, outputs)."""
        return self.of_critics(self.critic.apply, critic, features, obs, action)

    def values(self, critic: Params, features: Array, obs: Any, action: Array) -> Array:
        """Return every critic's estimate of the value (N, B)."""
        return self.value.mean(self.q(critic, features, obs, action))

    def of_critics(self, apply: Callable, critic: Params, features: Array, obs: Any, action: Array) -> Any:
        """Apply ``apply``, a function with the signature of ``Network.apply``, to every critic: (N, ...)."""
        features, inputs = self.placed_representation.perceive(critic, features, obs)
        critics = critic.without(self.placed_representation.names)
        return jax.vmap(apply, (0, None, None, None))(critics, features, inputs, action)

    def critic_target(self, actor: Params, critic: Params, target_critic: Params, batch: Batch, key: Key) -> Any:
        """Compute the critic target y (B, ...), in the form that ``value.loss`` takes."""
        action, _, cost = self.sample(actor, critic, batch, batch.next_obs, key)
        return self.bootstrap(self.q(target_critic, batch.features, batch.next_obs, action), batch, cost)

    def bootstrap(self, outputs: Array, batch: Batch, cost: Array) -> Any:
        """Compute the critic target from the target critics' ``outputs`` (N, B, outputs) at the next states."""
        bonus = -batch.temperature * cost
        return self.value.target(outputs, self.critic_reduction == "min", batch.reward, batch.discount, bonus)

    def critic_loss(self, critic: Params, data: tuple[Batch, Any]) -> tuple[Array, Metrics]:
        batch, target = data
        return self.fitting_loss(self.q(critic, batch.features, batch.obs, batch.action), target, critic, batch)

    def fitting_loss(self, outputs: Array, target: Any, critic: Params, batch: Batch) -> tuple[Array, Metrics]:
        """Compute the critic loss of ``outputs`` (N, B, outputs) for a result of ``bootstrap``."""
        loss = jnp.mean(jnp.sum(self.value.loss(outputs, target), axis=0))
        values, expected = self.value.mean(outputs), self.value.expected(target)
        td_error = jnp.mean(jnp.abs(values - expected))
        metrics = {"critic_loss": loss, "value": jnp.mean(values), "td_error": td_error}
        metrics |= {"target": expected}  # ``update`` hands it to the scaling
        return self.placed_representation.join(loss, metrics, critic, batch)

    def actor_loss(self, actor: Params, data: tuple[Batch, Params, Key]) -> tuple[Array, Metrics]:
        batch, critic, key = data
        return self.policy_loss(self.sample(actor, critic, batch, batch.obs, key), critic, batch)

    def policy_loss(self, sample: Sample, critic: Params, batch: Batch) -> tuple[Array, Metrics]:
        """Compute the actor loss of actions sampled at a batch's observations."""
        action, log_prob, cost = sample
        values = self.values(critic, batch.features, batch.obs, action)
        value = minimum(values) if self.critic_reduction == "min" else jnp.mean(values, axis=0)
        loss = jnp.mean(batch.temperature * cost - value)
        return loss, {"actor_loss": loss, "entropy": -jnp.mean(log_prob)}

    def temperature_loss(self, log_temperature: Array, entropy: Array, action_size: int | Array) -> Array:
        return jnp.mean(jnp.exp(log_temperature) * (entropy - self.target_entropy * action_size))

    # Update of all tasks.

    def update(
        self, state: SACState, transitions: Transition, tasks: Task, key: Key, actor_turn: Array | None = None
    ) -> tuple[SACState, Metrics]:
        """Take one gradient step on a batch (T, B, ...) of the training tasks; metrics are (T,).

        Args:
            actor_turn: () bool, whether actor and temperatures learn too; None if they always do.
        """
        target_key, actor_key, critic_order, actor_order = jax.random.split(key, 4)
        transitions = self.placed_representation.augment(transitions, jax.random.fold_in(key, 1))
        state, batch = self.prepare(state, transitions, tasks)
        importance = self.sampler.weights(state.progress, batch.temperature)
        combine = partial(surgery.gradient, importance=importance, per_layer=self.per_layer)

        loss, data = self.critic_problem(state, batch, target_key)
        critic_step = combine(self.gradients, loss, state.critic, data, state.surgery.critic, critic_order)
        critic, critic_memory = descent.descend(
            self.optimizers.critic, critic_step.gradients, state.optimizers.critic, state.critic
        )
        critic = with_statistics(critic, critic_step.aux)
        critic_rule = surgery.adapt_rule(self.gradients, loss, critic, data, critic_step)

        improve = lambda state: self.improve(state, critic, batch, combine, actor_key, actor_order)
        if actor_turn is None:
            state, actor_metrics = improve(state)
        else:
            state, actor_metrics = when(actor_turn, improve, state)
            actor_metrics = Sometimes.over(actor_metrics, actor_turn)

        metrics = {**critic_step.aux, **actor_metrics, "temperature": batch.temperature}
        target_critic = self.update_target(critic, state.target)
        scales, (critic, target_critic) = self.scaling.renew(
            state.scales, metrics.pop("target"), (critic, target_critic)
        )
        state = state._replace(
            critic=critic,
            target=target_critic,
            optimizers=state.optimizers._replace(critic=critic_memory),
            surgery=state.surgery._replace(critic=critic_rule),
            scales=scales,
        )
        return state, metrics | {f"critic_{name}": x for name, x in critic_step.metrics.items()}

    def improve(
        self, state: SACState, critic: Params, batch: Batch, combine: Callable, key: Key, order: Key
    ) -> tuple[SACState, Metrics]:
        """Take one gradient step of the actor under a critic, and one of the temperatures."""
        seen = self.placed_representation.for_actor(critic, state.critic)
        loss, data = self.actor_problem(seen, batch, key)
        step = combine(self.gradients.for_actor, loss, state.actor, data, state.surgery.actor, order)
        actor, actor_memory = descent.descend(
            self.optimizers.actor, step.gradients, state.optimizers.actor, state.actor
        )
        actor = with_statistics(actor, step.aux)

        action_size = action_sizes(batch.action, batch.mask)
        slope = jax.grad(self.temperature_loss)(state.log_temperature, step.aux["entropy"], action_size)
        log_temperature, temperature_memory = descent.descend(
            self.optimizers.temperature, slope, state.optimizers.temperature, state.log_temperature
        )
        state = state._replace(
            actor=actor,
            log_temperature=log_temperature,
            optimizers=state.optimizers._replace(actor=actor_memory, temperature=temperature_memory),
            surgery=state.surgery._replace(actor=step.memory),
        )
        return state, {**step.aux, **{f"actor_{name}": x for name, x in step.metrics.items()}}

    def prepare(self, state: SACState, batch: Transition, tasks: Task) -> tuple[SACState, Batch]:
        """Fit the normalisers to transitions (T, B, ...), and return the batch (T, ...) for the losses."""
        state = state._replace(moments=self.fit_moments(state.moments, batch.obs))
        past, last = batch.extras if isinstance(batch.extras, Ends) else (batch.extras, batch)
        next_past = None if past is None else append(last.extras, last.obs, last.action, last.reward)
        action_size = action_sizes(batch.action, tasks.action_mask)
        bonus = jnp.exp(state.log_temperature) * abs(self.target_entropy) * action_size / 2
        gamma = self.discounts(tasks)
        return state, Batch(
            obs=self.see_batch(state.moments, batch.obs, past),
            action=batch.action,
            reward=self.scaling.rewards(state.scales, batch, gamma, bonus),
            discount=(gamma[:, None] if jnp.ndim(gamma) else gamma) * batch.discount,  # type: ignore
            next_obs=self.see_batch(state.moments, batch.next_obs, next_past),
            features=self.features_of_batch(state, batch, tasks),
            temperature=jnp.broadcast_to(jnp.exp(state.log_temperature), len(tasks.id)),
            mask=tasks.action_mask,
            followed=pictures.followed(batch),
        )

    def update_target(self, critic: Params, target: Params) -> Params:
        """Move the target critic, and its representation, a step towards the new critic."""
        rate = lambda name: self.representation.rates.get(name, self.tau)
        step = lambda new, old: {k: optax.incremental_update(new[k], old[k], rate(k)) for k in old}
        return Params(step(critic.shared, target.shared), step(critic.own, target.own))

    def critic_problem(self, state: SACState, batch: Batch, key: Key) -> tuple[Callable, Any]:
        """Return the critic's loss of one task, and the data of all tasks (T, ...), for ``surgery.gradient``."""
        slow = state.target.filled(state.critic)
        model_targets, keys = self.placed_representation.targets(state.critic, slow, batch.next_obs, key)
        bootstrap = jax.vmap(self.critic_target, (OVER_TASKS, OVER_TASKS, OVER_TASKS, 0, 0))
        target = bootstrap(state.actor, state.critic, slow, batch, keys)
        return self.above_least(self.critic_loss), (batch._replace(model_targets=model_targets), target)

    def actor_problem(self, critic: Params, batch: Batch, key: Key) -> tuple[Callable, Any]:
        """Return the actor's loss of one task under a critic, and the data of all tasks (T, ...)."""

        def loss(actor: Params, data) -> tuple[Array, Metrics]:
            batch, own_critic, key = data
            return self.actor_loss(actor, (batch, Params(critic.shared, own_critic), key))

        return loss, (batch, critic.own, jax.random.split(key, len(batch.temperature)))


def with_statistics(params: Params, aux: Metrics) -> Params:
    """Take the running statistics that a loss found, if any, out of ``aux``, and return parameters that have them."""
    return params._replace(own=params.own | aux.pop("statistics", {}))  # type: ignore


def action_sizes(action: Array, mask: Array | None) -> int | Array:
    """Count the actions that each task has: A for actions (..., A) without a mask (T, A), else (T,)."""
    return action.shape[-1] if mask is None else jnp.sum(mask, axis=-1)


def minimum(values: Array) -> Array:
    """Return the minimum (B,) of values (N, B), with a gradient that is always finite.

    The gradient of ``jnp.min`` looks for values that equal the minimum. Where XLA computes the values twice and rounds
    them differently it finds none, and the gradient is 0 / 0.
    """
    lowest = jnp.arange(len(values))[:, None] == jnp.argmin(values, axis=0)
    return jnp.sum(jnp.where(lowest, values, 0), axis=0)
