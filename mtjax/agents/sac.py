"""Soft actor-critic over many tasks at once, and the parts in which its variants differ."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mtjax import normalize
from mtjax.agents.hyperparameters import Hyperparameters
from mtjax.agents.parts import conditioning
from mtjax.agents.parts.gradients import descent, surgery
from mtjax.agents.parts.trajectory import TrajectoryEncoder
from mtjax.history import Seen, plain_obs_size, unpack
from mtjax.networks import Network, Params, tanh_normal
from mtjax.types import Array, InputError, Key, Metrics, Outcome, Spec, Task, Transition


class SACState(NamedTuple):
    """Everything SAC learns, and what it remembers of the training tasks."""

    actor: Params
    critic: Params  # shared leaves (N, ...), own leaves (T, N, ...)
    target: Params  # slow copy of the critic
    log_temperature: Array  # (T,), or (1,) if shared
    optimizers: tuple[Any, Any, Any]  # of actor, critic, temperature
    moments: normalize.Moments
    contexts: Array  # (T, C) of the training tasks, among which an unseen task finds its nearest
    vectors: Array | None  # (T, V) given task vectors, if conditioned on them
    surgery: tuple[Any, Any]  # what the rules of gradient surgery remember: critic's, actor's
    scales: Any  # what the scaling of rewards remembers
    progress: Any  # what the sampler of tasks remembers


@dataclasses.dataclass(frozen=True)
class SAC(Hyperparameters):
    """Multi-task soft actor-critic that is not told which task it is in (Haarnoja et al. 2018; "MT-SAC").

    Per transition of task i, with temperature a_i, N critics and their slow copies:
        y = r + discount gamma (min_n Qbar_n(s', a') - a_i log pi(a'|s')),  a' ~ pi(s')     (critic target)
        L_Q = sum_n (Q_n(s, a) - y)^2                                                        (critic loss)
        L_pi = a_i log pi(a|s) - min_n Q_n(s, a),  a ~ pi(s)                                 (actor loss)
        L_a = a_i (-log pi(a|s) - H)                                                         (temperature loss)
    averaged over the batch of a task, then over tasks. ``discount`` is 0 only where an episode terminated, so that a
    time limit bootstraps. The actor follows the new critic, and so does the target.

    Differs from the paper: layer-normalised critics; by default a target entropy H of -A/2 and one temperature a task.
    """

    # Networks.

    @property
    def actor(self) -> Network:
        return self._network(self.actor_layer_norm)

    @property
    def critic(self) -> Network:
        return self._network(self.critic_layer_norm)

    def _network(self, layer_norm: bool) -> Network:
        own = {"shared": (), "per-task": ("head",), "disjoint": ("trajectory", "body", "head")}[self.heads]
        embedding = self.embedding_size if self.conditioning == "embedding" else 0
        body = self.encoder.body(self.hidden, layer_norm)
        trajectory = TrajectoryEncoder(self.embedding_size, layer_norm=layer_norm) if self.history else None
        return Network(body, own, embedding, self.unit_embedding, self.encoder.front(), trajectory)

    def init(self, spec: Spec, tasks: Task, key: Key) -> SACState:
        """Initialise for the training ``tasks`` (T, ...)."""
        num_tasks = len(tasks.id)
        vectors = conditioning.load_vectors(self.vectors, num_tasks) if self.vectors else None
        if self.history not in (0, spec.history):
            raise InputError(
                f"conditioning=inferred needs observations that show the last {self.history} steps, and these show "
                f"{spec.history}; give the family as mtjax.history.remember(env, agent.history)"
            )
        moments = normalize.init(plain_obs_size(spec) if self.history else spec.obs_size)
        obs, action = self._see(moments, jnp.zeros(spec.obs_size)), jnp.zeros(spec.action_size)
        features = conditioning.features(self.conditioning, num_tasks, jnp.int32(0), tasks.context[0], vectors)
        actor, critic = self.networks(num_tasks, features, obs, action, key)
        log = jnp.log if isinstance(self.initial_temperature, Array) else np.log
        log_temperature = jnp.full(1 if self.shared_temperature else num_tasks, log(self.initial_temperature))
        log_temperature = log_temperature.astype(jnp.float32)
        parameters = (actor, critic, log_temperature)
        memory = lambda rule, params: surgery.init(rule, params, num_tasks, self.gradient_scope == "per-layer")
        return SACState(
            actor=actor,
            critic=critic,
            target=jax.tree.map(jnp.copy, critic),
            log_temperature=log_temperature,
            optimizers=tuple(o.init(p) for o, p in zip(self._optimizers, parameters, strict=True)),  # type: ignore
            moments=moments,
            contexts=tasks.context,
            vectors=vectors,
            surgery=(memory(self.gradients, critic), memory(self.gradients.for_actor, actor)),
            scales=self.scaling.init(num_tasks),
            progress=self.sampler.init(num_tasks),
        )

    def networks(self, num_tasks: int, features: Array, obs: Any, action: Array, key: Key) -> tuple[Params, Params]:
        """Initialise actor and critics for inputs of the given shapes, (Z,), (O,) and (A,)."""
        actor_key, critic_key = jax.random.split(key)
        actor = self.actor.init(actor_key, num_tasks, 2 * len(action), features, obs)
        init_critic = lambda k: self.critic.init(k, num_tasks, self.value.outputs, features, obs, action)
        keys = jax.random.split(critic_key, self.num_critics)
        return actor, jax.vmap(init_critic, out_axes=Params(shared=0, own=1))(keys)  # type: ignore

    @property
    def _optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        chosen = partial(descent.adam, weight_decay=self.weight_decay, max_norm=self.max_gradient_norm, tune=self.tune)
        return chosen(self.actor_lr), chosen(self.critic_lr), optax.adam(self.temperature_lr)

    # Which task it is.

    @property
    def borrowed(self) -> list[str]:
        """What a task that was not trained on has of its nearest training task."""
        parts = {"shared": [], "per-task": ["head"], "disjoint": ["networks"]}[self.heads]
        parts += ["input layer"] * (self.encoder.front() is not None)
        return parts + conditioning.BORROWED.get(self.conditioning, [])

    @property
    def unseen(self) -> str:
        """What stands for a task that was not trained on; empty if its own parameters, or nothing, do."""
        parts = self.borrowed
        return f"each uses the {' and '.join(parts)} of the nearest training task" if parts else ""

    def known_task(self, state: SACState, task: Task) -> Array:
        """The training task () int32 whose head, embedding or number stands for ``task``: itself, or the nearest."""
        nearest = jnp.argmin(jnp.sum(jnp.square(state.contexts - task.context), axis=-1)).astype(jnp.int32)
        return jnp.where(task.id < len(state.contexts), task.id, nearest)

    def nearest_tasks(self, state: SACState, tasks: Task) -> Array:
        """The training tasks (T,) that are nearest to ``tasks`` (T, ...), whoever these are."""
        strangers = tasks._replace(id=jnp.full_like(tasks.id, len(state.contexts)))
        return jax.vmap(partial(self.known_task, state))(strangers)

    def features(self, state: SACState, task: Task) -> Array:
        """What the networks see of one task (Z,)."""
        known = self.known_task(state, task)
        return conditioning.features(self.conditioning, len(state.contexts), known, task.context, state.vectors)

    # Acting.

    def act(self, state: SACState, obs: Array, task: Task, key: Key | None) -> Array:
        """Choose an action (A,) for one observation (O,) of one task; no key: the mean action."""
        actor, critic = self.parameters(state, task)
        trained = task.id < len(state.contexts)
        obs = self._see(state.moments, obs)
        return tanh_normal(self.behaviour(trained, actor, critic, self.features(state, task), obs), key)[0]

    def parameters(self, state: SACState, task: Task) -> tuple[Params, Params]:
        """Actor and critics as one task uses them."""
        index = self.known_task(state, task)
        of_task = lambda params: Params(params.shared, jax.tree.map(lambda x: x[index], params.own))
        return of_task(state.actor), of_task(state.critic)

    def behaviour(self, trained: Array, actor: Params, critic: Params, features: Array, obs: Array) -> Array:
        """Outputs of the policy that acts, in a task that was ``trained`` on () or in another."""
        return self.policy(actor, critic, features, obs)

    def _see(self, moments: normalize.Moments, obs: Array) -> Any:
        """Observations (..., O) as the networks take them: normalised, and apart from the past if they show it."""
        scaled = partial(normalize.apply, moments) if self.normalize_observations else lambda obs: obs
        if not self.history:
            return scaled(obs)
        seen = unpack(obs, len(moments.mean), self.history)
        return Seen(scaled(seen.obs), seen.past._replace(obs=scaled(seen.past.obs)))

    # Losses, each on the data of one task: observations (B, O), features (Z,) or (B, Z), temperature ().

    def policy(self, actor: Params, critic: Params, features: Array, obs: Array) -> Array:
        """The policy's outputs (..., 2A); agents whose actor stands on the critic's representation use ``critic``."""
        return self.actor.apply(actor, features, obs)

    def sample(self, actor, critic, features, obs, key: Key) -> tuple[Array, Array, Array]:
        """Actions (B, A), their log-probabilities (B,), and what the temperature makes the policy pay for (B,)."""
        action, log_prob = tanh_normal(self.policy(actor, critic, features, obs), key)
        return action, log_prob, log_prob

    def outputs(self, critic: Params, features: Array, obs: Array, action: Array) -> Array:
        """Every critic's outputs (N, B, outputs)."""
        return self.of_critics(self.critic.apply, critic, features, obs, action)

    def of_critics(self, apply: Callable, critic: Params, features: Array, obs: Array, action: Array) -> Any:
        """What ``apply``, as ``Network.apply`` takes its inputs, makes of every critic (N, ...)."""
        return jax.vmap(apply, (0, None, None, None))(critic, features, obs, action)

    def values(self, critic: Params, features: Array, obs: Array, action: Array) -> Array:
        """Every critic's estimate (N, B)."""
        return self.value.mean(self.outputs(critic, features, obs, action))

    def critic_target(self, actor, critic, target, features, temperature, batch: Transition, key: Key) -> Array:
        """Soft Bellman target (B, ...), in the form that ``value.loss`` takes."""
        action, _, cost = self.sample(actor, critic, features, batch.next_obs, key)
        outputs = self.outputs(target, features, batch.next_obs, action)
        discount, bonus = self.gamma * batch.discount, -temperature * cost
        return self.value.target(outputs, self.believe == "least", batch.reward, discount, bonus)

    def critic_loss(self, critic: Params, data) -> tuple[Array, Metrics]:
        batch, features, target = data
        outputs = self.outputs(critic, features, batch.obs, batch.action)
        loss = jnp.mean(jnp.sum(self.value.loss(outputs, target), axis=0))
        values, expected = self.value.mean(outputs), self.value.expected(target)
        td_error = jnp.mean(jnp.abs(values - expected))
        seen = {"critic_loss": loss, "value": jnp.mean(values), "td_error": td_error}
        return loss, seen | {"target": expected}  # which ``update`` takes for the scaling

    def actor_loss(self, actor: Params, data) -> tuple[Array, Metrics]:
        batch, features, critic, temperature, key = data
        action, log_prob, cost = self.sample(actor, critic, features, batch.obs, key)
        values = self.values(critic, features, batch.obs, action)
        value = least(values) if self.believe == "least" else jnp.mean(values, axis=0)
        loss = jnp.mean(temperature * cost - value)
        return loss, {"actor_loss": loss, "entropy": -jnp.mean(log_prob)}

    def temperature_loss(self, log_temperature: Array, entropy: Array, action_size: int) -> Array:
        return jnp.mean(jnp.exp(log_temperature) * (entropy - self.target_entropy * action_size))

    # Watching.

    @property
    def watches(self) -> bool:
        """Whether the agent wants to see the stream of outcomes."""
        return self.scaling.watches or self.sampler.watches

    def observe(self, state: SACState, outcome: Outcome) -> SACState:
        """Take note of what one step of every environment brought, leaves (T, E)."""
        scales = self.scaling.observe(state.scales, outcome)
        return state._replace(scales=scales, progress=self.sampler.observe(state.progress, outcome))

    def reset(self, state: SACState, spec: Spec, tasks: Task, key: Key) -> SACState:
        """Begin anew with networks, optimisers, temperatures and surgery; what was learned of the data stays."""
        return self.init(spec, tasks, key)._replace(
            moments=state.moments,
            contexts=state.contexts,
            vectors=state.vectors,
            scales=self.scaling.reset(state.scales),
            progress=state.progress,
        )

    # Update.

    def update(self, state: SACState, batch: Transition, tasks: Task, key: Key) -> tuple[SACState, Metrics]:
        """Take one gradient step on a batch (T, B, ...) of the training tasks; metrics are (T,)."""
        target_key, actor_key, critic_order, actor_order = jax.random.split(key, 4)
        state, batch, features, temperature = self.prepare(state, batch, tasks)
        importance = self.sampler.weights(state.progress, temperature)
        combine = partial(surgery.gradient, importance=importance, per_layer=self.gradient_scope == "per-layer")
        actor_optimizer, critic_optimizer, temperature_optimizer = self._optimizers

        loss, data = self.critic_problem(state, batch, features, temperature, target_key)
        seen = combine(self.gradients, loss, state.critic, data, state.surgery[0], critic_order)
        critic, critic_memory = descent.descend(critic_optimizer, seen.gradients, state.optimizers[1], state.critic)
        critic_weighing = surgery.look_again(self.gradients, loss, critic, data, seen)

        loss, data = self.actor_problem(critic, batch, features, temperature, actor_key)
        done = combine(self.gradients.for_actor, loss, state.actor, data, state.surgery[1], actor_order)
        actor, actor_memory = descent.descend(actor_optimizer, done.gradients, state.optimizers[0], state.actor)

        action_size = batch.action.shape[-1]
        slope = jax.grad(self.temperature_loss)(state.log_temperature, done.aux["entropy"], action_size)
        log_temperature, temperature_memory = descent.descend(
            temperature_optimizer, slope, state.optimizers[2], state.log_temperature
        )
        metrics = {**seen.aux, **done.aux, "temperature": temperature}
        slow = self.follow(critic, state.target)
        scales, (critic, slow) = self.scaling.renew(state.scales, metrics.pop("target"), (critic, slow))
        state = state._replace(
            actor=actor,
            critic=critic,
            target=slow,
            log_temperature=log_temperature,
            optimizers=(actor_memory, critic_memory, temperature_memory),
            surgery=(critic_weighing, done.memory),
            scales=scales,
        )
        named = (("critic", seen.metrics), ("actor", done.metrics))
        return state, metrics | {f"{who}_{k}": v for who, found in named for k, v in found.items()}

    def prepare(self, state: SACState, batch: Transition, tasks: Task) -> tuple[SACState, Transition, Array, Array]:
        """Fit the normalisers to a batch (T, B, ...) and apply them to it.

        Returns:
            the new state, the batch, what the networks see of the tasks (T, Z) or (T, B, Z), and temperatures (T,).
        """
        if self.normalize_observations:
            state = state._replace(moments=normalize.update(state.moments, batch.obs[..., : len(state.moments.mean)]))
        features = jax.vmap(partial(self.features, state))(tasks)
        if batch.context is not None and self.conditioning == "parameters":
            features = batch.context  # (T, B, C), as every episode has parameters of its own
        bonus = jnp.exp(state.log_temperature) * abs(self.target_entropy) * batch.action.shape[-1] / 2
        batch = batch._replace(
            obs=self._see(state.moments, batch.obs),
            next_obs=self._see(state.moments, batch.next_obs),
            reward=self.scaling.rewards(state.scales, batch, self.gamma, bonus),
        )
        return state, batch, features, jnp.broadcast_to(jnp.exp(state.log_temperature), len(tasks.id))

    def follow(self, critic: Params, target: Params) -> Params:
        """The slow critic's step towards the new critic."""
        return optax.incremental_update(critic, target, self.tau)  # type: ignore

    def critic_problem(self, state: SACState, batch, features, temperature, key: Key) -> tuple[Callable, Any]:
        """The critic's loss for one task, and the data of all (T, ...): what ``surgery.gradient`` differentiates."""
        over_tasks = Params(shared=None, own=0)  # type: ignore
        bootstrap = jax.vmap(self.critic_target, (over_tasks, over_tasks, over_tasks, 0, 0, 0, 0))
        keys = jax.random.split(key, len(temperature))
        target = bootstrap(state.actor, state.critic, state.target, features, temperature, batch, keys)
        return self.critic_loss, (batch, features, target)

    def actor_problem(self, critic: Params, batch, features, temperature, key: Key) -> tuple[Callable, Any]:
        """The actor's loss for one task under a critic, and the data of all tasks (T, ...)."""

        def loss(actor: Params, data) -> tuple[Array, Metrics]:
            batch, features, own_critic, temperature, key = data
            return self.actor_loss(actor, (batch, features, Params(critic.shared, own_critic), temperature, key))

        return loss, (batch, features, critic.own, temperature, jax.random.split(key, len(temperature)))


def least(values: Array) -> Array:
    """The least of values (N, B), differentiably.

    The slope of ``jnp.min`` looks for values that equal the least, finds none where XLA computes them twice and rounds
    them otherwise, and is then 0 / 0.
    """
    return jnp.take_along_axis(values, jnp.argmin(values, axis=0, keepdims=True), axis=0)[0]
