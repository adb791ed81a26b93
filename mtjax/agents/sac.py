"""Soft actor-critic over many tasks at once, and the parts in which its variants differ."""

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
from mtjax.agents.base import FLAT, BaseAgent, Memory, Pair
from mtjax.agents.parts.gradients import descent, surgery
from mtjax.agents.parts.scaling import SCALINGS
from mtjax.agents.parts.trajectory import append
from mtjax.agents.parts.values import VALUES, Value
from mtjax.experience import Replay
from mtjax.networks import OVER_TASKS, Params, tanh_normal
from mtjax.types import Acted, Array, InputError, Key, Metrics, Spec, Task, Transition


class Optimizers(NamedTuple):
    """What the optimisers remember."""

    actor: Any
    critic: Any
    temperature: Any


class SACState(NamedTuple):
    """Everything SAC learns, and what it remembers of the training tasks."""

    actor: Params
    critic: Params  # shared leaves (N, ...), own leaves (T, N, ...); beside them the representation, without N
    target: Params  # slow copy of the critic
    log_temperature: Array  # (T,), or (1,) if shared
    optimizers: Optimizers
    moments: normalize.Moments
    contexts: Array  # (T, C) of the training tasks, among which an unseen task finds its nearest
    vectors: Array | None  # (T, V) given task vectors, if conditioned on them
    surgery: Pair
    scales: Any  # what the scaling of rewards remembers
    progress: Any  # what the sampler of tasks remembers


class Batch(NamedTuple):
    """What the losses of one task see; of all tasks, leaves (T, ...)."""

    obs: Any  # (B, O) as the networks take them
    action: Array  # (B, A)
    reward: Array  # (B,) in the task's units
    discount: Array  # (B,) gamma, or 0 where the episode terminated
    next_obs: Any  # (B, O)
    told: Array  # (Z,) or (B, Z), what the networks are told of the task
    temperature: Array  # ()
    mask: Array | None  # (A,) 1 for actions that the task has; None: it has all
    ahead: Any = None  # what the models of the representation fit


class Sample(NamedTuple):
    """What a policy does."""

    action: Array  # (B, A)
    log_prob: Array  # (B,)
    cost: Array  # (B,) what the temperature makes the policy pay for


@dataclasses.dataclass(frozen=True)
class SAC(BaseAgent):
    """Multi-task soft actor-critic that is not told which task it is in (Haarnoja et al. 2018; "MT-SAC").

    Per transition of task i, with temperature a_i, N critics and their slow copies:
        y = r + discount gamma (min_n Qbar_n(s', a') - a_i log pi(a'|s')),  a' ~ pi(s')     (critic target)
        L_Q = sum_n (Q_n(s, a) - y)^2                                                        (critic loss)
        L_pi = a_i log pi(a|s) - min_n Q_n(s, a),  a ~ pi(s)                                 (actor loss)
        L_a = a_i (-log pi(a|s) - H)                                                         (temperature loss)
    averaged over the batch of a task, then over tasks. ``discount`` is 0 only where an episode terminated, so that a
    time limit bootstraps. The actor follows the new critic, and so does the target.

    Differs from the paper: layer-normalised critics; a learning rate of 1e-3, a target entropy H of -A/2 and one
    temperature a task by default; log standard deviations are brought into [-5, 2] by a tanh.
    """

    adjustable: ClassVar[tuple[str, ...]] = (*BaseAgent.adjustable, "temperature_lr", "tau", "target_entropy")
    temperature_lr: float = 1e-3
    """Adam's learning rate of the temperatures."""
    tau: float = 0.005
    """Share of the new critic that its slow copy takes at each update."""
    num_critics: int = 2
    """Critics."""
    believe: Literal["least", "mean"] = "least"
    """Which critic bootstraps and guides the actor: the least of them, or the mean of all."""
    initial_temperature: float = 0.1
    """Temperature at the start."""
    target_entropy: float = -0.5
    """Entropy that the temperature aims at, per action dimension."""
    shared_temperature: bool = False
    """One temperature for all tasks instead of one a task."""
    value: Annotated[Value, FLAT] = dataclasses.field(default_factory=Value)
    experience: Annotated[Replay, FLAT] = dataclasses.field(default_factory=Replay)

    def _check_numbers(self) -> None:
        if not 0 <= self.gamma <= 1 or not 0 < self.tau <= 1:
            raise InputError(f"gamma must be in [0, 1] and tau in (0, 1], not {self.gamma} and {self.tau}")
        super()._check_numbers()
        parts.require_positive(self, "temperature_lr", "num_critics", "initial_temperature")

    def _check_combination(self) -> None:
        super()._check_combination()
        value, scaling = parts.name_of(VALUES, self.value), parts.name_of(SCALINGS, self.scaling)
        if scaling == "popart" and (self.heads == "shared" or value != "scalar"):
            raise InputError(
                "scaling=popart rescales a scalar head of every task's own; use value=scalar and heads=per-task or "
                f"disjoint, not {value} and {self.heads}"
            )

    # Networks.

    def init(self, spec: Spec, tasks: Task, key: Key) -> SACState:
        """Initialise for the training ``tasks`` (T, ...)."""
        common = self.init_common(spec, tasks, key)
        log = jnp.log if isinstance(self.initial_temperature, Array) else np.log
        log_temperature = jnp.full(1 if self.shared_temperature else len(tasks.id), log(self.initial_temperature))
        log_temperature = log_temperature.astype(jnp.float32)
        parameters = (common["actor"], common["critic"], log_temperature)
        return SACState(
            **common,
            target=jax.tree.map(jnp.copy, common["critic"].without(self.representation.models)),
            log_temperature=log_temperature,
            optimizers=Optimizers(*(o.init(p) for o, p in zip(self.optimizers, parameters, strict=True))),
        )

    def init_networks(self, num_tasks: int, told: Array, obs: Any, action: Array, key: Key) -> Pair:
        actor_key, critic_key = jax.random.split(key)
        actor = self.actor.init(actor_key, num_tasks, 2 * len(action), told, obs)
        init_critic = lambda k: self.critic.init(k, num_tasks, self.value.outputs, told, obs, action)
        keys = jax.random.split(critic_key, self.num_critics)
        return Pair(actor, jax.vmap(init_critic, out_axes=Params(shared=0, own=1))(keys))  # type: ignore

    def reset(self, state: SACState, spec: Spec, tasks: Task, key: Key) -> SACState:
        """Begin anew with networks, optimisers, temperatures and surgery; what was learned of the data stays."""
        return self.init(spec, tasks, key)._replace(
            moments=state.moments,
            contexts=state.contexts,
            vectors=state.vectors,
            scales=self.scaling.reset(state.scales),
            progress=state.progress,
        )

    @property
    def optimizers(self) -> Optimizers:
        return Optimizers(*self.network_optimizers, optax.adam(self.temperature_lr))

    # Acting.

    def act(self, state: SACState, memory: Memory, obs: Any, task: Task, key: Key | None) -> Acted:
        """Choose an action (A,) for one observation (O,) of one task; no key: the mean action."""
        trained = task.id < len(state.contexts)
        outputs = self.behaviour(trained, *self.situation(state, memory, obs, task))
        return Acted(tanh_normal(outputs, key, task.action_mask)[0], memory.past, memory)

    def behaviour(self, trained: Array, actor: Params, critic: Params, told: Array, obs: Any) -> Array:
        """Outputs of the policy that acts, in a task that was ``trained`` on () or in another."""
        return self.policy(actor, critic, told, obs)

    # Losses of one task.

    def policy(self, actor: Params, critic: Params, told: Array, obs: Any) -> Array:
        """The policy's outputs (..., 2A); the actor stands on the representation that lies beside the critics."""
        return self.actor.apply(actor, *self.look(critic, told, obs))

    def sample(self, actor: Params, critic: Params, batch: Batch, obs: Any, key: Key) -> Sample:
        """Let the policy act at observations (B, O) of a batch."""
        action, log_prob = tanh_normal(self.policy(actor, critic, batch.told, obs), key, batch.mask)
        return Sample(action, log_prob, log_prob)

    def q(self, critic: Params, told: Array, obs: Any, action: Array) -> Array:
        """Every critic's outputs (N, B, outputs)."""
        return self.of_critics(self.critic.apply, critic, told, obs, action)

    def values(self, critic: Params, told: Array, obs: Any, action: Array) -> Array:
        """Every critic's estimate (N, B)."""
        return self.value.mean(self.q(critic, told, obs, action))

    def of_critics(self, apply: Callable, critic: Params, told: Array, obs: Any, action: Array) -> Any:
        """What ``apply``, as ``Network.apply`` takes its inputs, makes of every critic (N, ...)."""
        told, seen = self.sight.perceive(critic, told, obs)
        return jax.vmap(apply, (0, None, None, None))(critic.without(self.sight.names), told, seen, action)

    def target(self, actor: Params, critic: Params, slow: Params, batch: Batch, key: Key) -> Any:
        """y (B, ...), in the form that ``value.loss`` takes."""
        action, _, cost = self.sample(actor, critic, batch, batch.next_obs, key)
        outputs = self.q(slow, batch.told, batch.next_obs, action)
        bonus = -batch.temperature * cost
        return self.value.target(outputs, self.believe == "least", batch.reward, batch.discount, bonus)

    def critic_loss(self, critic: Params, data: tuple[Batch, Any]) -> tuple[Array, Metrics]:
        batch, target = data
        outputs = self.q(critic, batch.told, batch.obs, batch.action)
        loss = jnp.mean(jnp.sum(self.value.loss(outputs, target), axis=0))
        values, expected = self.value.mean(outputs), self.value.expected(target)
        td_error = jnp.mean(jnp.abs(values - expected))
        seen = {"critic_loss": loss, "value": jnp.mean(values), "td_error": td_error}
        seen |= {"target": expected}  # which ``update`` takes for the scaling
        return self.sight.join(loss, seen, critic, batch)

    def actor_loss(self, actor: Params, data: tuple[Batch, Params, Key]) -> tuple[Array, Metrics]:
        batch, critic, key = data
        action, log_prob, cost = self.sample(actor, critic, batch, batch.obs, key)
        values = self.values(critic, batch.told, batch.obs, action)
        value = least(values) if self.believe == "least" else jnp.mean(values, axis=0)
        loss = jnp.mean(batch.temperature * cost - value)
        return loss, {"actor_loss": loss, "entropy": -jnp.mean(log_prob)}

    def temperature_loss(self, log_temperature: Array, entropy: Array, action_size: int | Array) -> Array:
        return jnp.mean(jnp.exp(log_temperature) * (entropy - self.target_entropy * action_size))

    # Update of all tasks.

    def update(self, state: SACState, transitions: Transition, tasks: Task, key: Key) -> tuple[SACState, Metrics]:
        """Take one gradient step on a batch (T, B, ...) of the training tasks; metrics are (T,)."""
        target_key, actor_key, critic_order, actor_order = jax.random.split(key, 4)
        state, batch = self.prepare(state, transitions, tasks)
        importance = self.sampler.weights(state.progress, batch.temperature)
        combine = partial(surgery.gradient, importance=importance, per_layer=self.per_layer)

        loss, data = self.critic_problem(state, batch, target_key)
        seen = combine(self.gradients, loss, state.critic, data, state.surgery.critic, critic_order)
        critic, critic_memory = descent.descend(
            self.optimizers.critic, seen.gradients, state.optimizers.critic, state.critic
        )
        critic_weighing = surgery.look_again(self.gradients, loss, critic, data, seen)

        loss, data = self.actor_problem(critic, batch, actor_key)
        done = combine(self.gradients.for_actor, loss, state.actor, data, state.surgery.actor, actor_order)
        actor, actor_memory = descent.descend(
            self.optimizers.actor, done.gradients, state.optimizers.actor, state.actor
        )

        action_size = action_sizes(batch.action, batch.mask)
        slope = jax.grad(self.temperature_loss)(state.log_temperature, done.aux["entropy"], action_size)
        log_temperature, temperature_memory = descent.descend(
            self.optimizers.temperature, slope, state.optimizers.temperature, state.log_temperature
        )
        metrics = {**seen.aux, **done.aux, "temperature": batch.temperature}
        slow = self.update_target(critic, state.target)
        scales, (critic, slow) = self.scaling.renew(state.scales, metrics.pop("target"), (critic, slow))
        state = state._replace(
            actor=actor,
            critic=critic,
            target=slow,
            log_temperature=log_temperature,
            optimizers=Optimizers(actor_memory, critic_memory, temperature_memory),
            surgery=Pair(done.memory, critic_weighing),
            scales=scales,
        )
        named = (("critic", seen.metrics), ("actor", done.metrics))
        return state, metrics | {f"{who}_{k}": v for who, found in named for k, v in found.items()}

    def prepare(self, state: SACState, batch: Transition, tasks: Task) -> tuple[SACState, Batch]:
        """Fit the normalisers to transitions (T, B, ...), and make of them what the losses see (T, ...)."""
        state = state._replace(moments=self.fit_moments(state.moments, batch.obs))
        past, next_past = batch.extras, None
        if past is not None:
            next_past = append(past, batch.obs, batch.action, batch.reward)
        action_size = action_sizes(batch.action, tasks.action_mask)
        bonus = jnp.exp(state.log_temperature) * abs(self.target_entropy) * action_size / 2
        gamma = self.discounts(tasks)
        return state, Batch(
            obs=self.see_batch(state.moments, batch.obs, past),
            action=batch.action,
            reward=self.scaling.rewards(state.scales, batch, gamma, bonus),
            discount=(gamma[:, None] if jnp.ndim(gamma) else gamma) * batch.discount,  # type: ignore
            next_obs=self.see_batch(state.moments, batch.next_obs, next_past),
            told=self.features_of_batch(state, batch, tasks),
            temperature=jnp.broadcast_to(jnp.exp(state.log_temperature), len(tasks.id)),
            mask=tasks.action_mask,
        )

    def update_target(self, critic: Params, target: Params) -> Params:
        """Move the slow critic, and the slow representation, towards the new one."""
        rate = lambda name: self.representation.rates.get(name, self.tau)
        step = lambda new, old: {k: optax.incremental_update(new[k], old[k], rate(k)) for k in old}
        return Params(step(critic.shared, target.shared), step(critic.own, target.own))

    def critic_problem(self, state: SACState, batch: Batch, key: Key) -> tuple[Callable, Any]:
        """The critic's loss for one task, and the data of all (T, ...): what ``surgery.gradient`` differentiates."""
        ahead, keys = self.sight.targets(state.critic, state.target, batch.next_obs, key)
        bootstrap = jax.vmap(self.target, (OVER_TASKS, OVER_TASKS, OVER_TASKS, 0, 0))
        target = bootstrap(state.actor, state.critic, state.target, batch, keys)
        return self.above_least(self.critic_loss), (batch._replace(ahead=ahead), target)

    def actor_problem(self, critic: Params, batch: Batch, key: Key) -> tuple[Callable, Any]:
        """The actor's loss for one task under a critic, and the data of all tasks (T, ...)."""

        def loss(actor: Params, data) -> tuple[Array, Metrics]:
            batch, own_critic, key = data
            return self.actor_loss(actor, (batch, Params(critic.shared, own_critic), key))

        return loss, (batch, critic.own, jax.random.split(key, len(batch.temperature)))


def action_sizes(action: Array, mask: Array | None) -> int | Array:
    """Count the actions that each task has: A for actions (..., A) without a mask (T, A), else (T,)."""
    return action.shape[-1] if mask is None else jnp.sum(mask, axis=-1)


def least(values: Array) -> Array:
    """The least of values (N, B), differentiably.

    The slope of ``jnp.min`` looks for values that equal the least, finds none where XLA computes them twice and rounds
    them otherwise, and is then 0 / 0.
    """
    return jnp.take_along_axis(values, jnp.argmin(values, axis=0, keepdims=True), axis=0)[0]
