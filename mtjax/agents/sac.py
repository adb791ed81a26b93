"""Soft actor-critic over many tasks at once, and the parts in which its variants differ."""

import dataclasses
from functools import partial
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

from mtjax import normalize
from mtjax.agents import surgery
from mtjax.names import nearest_error
from mtjax.networks import Network, Params, Trunk, tanh_normal
from mtjax.types import Array, InputError, Key, Metrics, Spec, Task, Transition

Conditioning = Literal["none", "one-hot", "embedding", "parameters", "vectors"]
CONDITIONINGS = ("none", "one-hot", "embedding", "parameters", "vectors")


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


@dataclasses.dataclass(frozen=True)
class SAC:
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

    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    actor_lr: float = 1e-3
    """Adam's learning rate of the actor."""
    critic_lr: float = 1e-3
    """Adam's learning rate of the critics."""
    temperature_lr: float = 1e-3
    """Adam's learning rate of the temperatures."""
    gamma: float = 0.99
    """Discount of future reward per step."""
    tau: float = 0.005
    """Share of the new critic that its slow copy takes at each update."""
    num_critics: int = 2
    """Critics, of which the least is believed."""
    initial_temperature: float = 0.1
    """Temperature at the start."""
    target_entropy: float = -0.5
    """Entropy that the temperature aims at, per action dimension."""
    shared_temperature: bool = False
    """One temperature for all tasks instead of one a task."""
    normalize_observations: bool = False
    """Scale observations by their running mean and variance, fitted on training data alone."""
    max_gradient_norm: float = 0.0
    """Clip the global norm of actor and critic gradients to this; 0 does not clip."""
    critic_layer_norm: bool = True
    """Layer normalisation in the critics."""
    actor_layer_norm: bool = False
    """Layer normalisation in the actor."""
    conditioning: Conditioning = "none"
    """What the networks are told of the task: none, one-hot, embedding (learned), parameters (the task's context) or
    vectors (rows of a file). For one-hot, embedding and vectors, an unseen task is taken for its nearest neighbour."""
    embedding_size: int = 16
    """Width of learned task embeddings."""
    vectors: str = ""
    """A .npy file of task vectors (T, V), a row for every training task, for conditioning on vectors."""
    heads: Literal["shared", "per-task"] = "shared"
    """Output layers of actor and critics: one for all tasks, or one for each."""
    gradients: surgery.RuleName = "mean"
    """How the tasks' gradients combine on the parameters that tasks share, in the actor and in the critics."""

    def __post_init__(self):
        choices = (
            ("conditioning", CONDITIONINGS),
            ("heads", ("shared", "per-task")),
            ("gradients", tuple(surgery.RULES)),
        )
        for field, allowed in choices:
            if getattr(self, field) not in allowed:
                raise nearest_error(field, getattr(self, field), allowed)
        for field in ("actor_lr", "critic_lr", "temperature_lr", "num_critics", "initial_temperature"):
            if not getattr(self, field) > 0:
                raise InputError(f"{field.replace('_', '-')} must be greater than 0, not {getattr(self, field)}")
        if not self.max_gradient_norm >= 0:
            raise InputError(f"max-gradient-norm must be at least 0 (0 does not clip), not {self.max_gradient_norm}")
        if self.conditioning == "embedding" and self.embedding_size < 1:
            raise InputError(f"embedding-size must be at least 1, not {self.embedding_size}")
        if not self.hidden or min(self.hidden) < 1:
            raise InputError(f"hidden needs at least one layer of at least one unit, not {self.hidden}")
        if not 0 <= self.gamma <= 1 or not 0 < self.tau <= 1:
            raise InputError(f"gamma must be in [0, 1] and tau in (0, 1], not {self.gamma} and {self.tau}")
        if not self.max_gradient_norm >= 0:
            raise InputError(f"max-gradient-norm must be at least 0, not {self.max_gradient_norm}")
        if self.embedding_size < 1:
            raise InputError(f"embedding-size must be at least 1, not {self.embedding_size}")
        if (self.conditioning == "vectors") != bool(self.vectors):
            raise InputError("conditioning=vectors and vectors=FILE.npy go together; give both or neither")

    # Networks.

    def body(self, layer_norm: bool) -> nn.Module:
        """The layers between the inputs and the head; what most variants replace."""
        return Trunk(self.hidden, layer_norm)

    @property
    def actor(self) -> Network:
        return Network(self.body(self.actor_layer_norm), self.heads == "per-task", self._embedding)

    @property
    def critic(self) -> Network:
        return Network(self.body(self.critic_layer_norm), self.heads == "per-task", self._embedding)

    @property
    def _embedding(self) -> int:
        return self.embedding_size if self.conditioning == "embedding" else 0

    def init(self, spec: Spec, tasks: Task, key: Key) -> SACState:
        """Initialise for the training ``tasks`` (T, ...)."""
        num_tasks = len(tasks.id)
        vectors = load_vectors(self.vectors, num_tasks) if self.vectors else None
        obs, action = jnp.zeros(spec.obs_size), jnp.zeros(spec.action_size)
        features = self._features(num_tasks, jnp.int32(0), tasks.context[0], vectors)
        actor_key, critic_key = jax.random.split(key)
        actor = self.actor.init(actor_key, num_tasks, 2 * spec.action_size, features, obs)
        init_critic = lambda k: self.critic.init(k, num_tasks, 1, features, obs, action)
        keys = jax.random.split(critic_key, self.num_critics)
        critic = jax.vmap(init_critic, out_axes=Params(shared=0, own=1))(keys)  # type: ignore
        log_temperature = jnp.full(1 if self.shared_temperature else num_tasks, np.log(self.initial_temperature))
        log_temperature = log_temperature.astype(jnp.float32)
        parameters = (actor, critic, log_temperature)
        optimizers = tuple(o.init(p) for o, p in zip(self._optimizers, parameters, strict=True))
        moments = normalize.init(spec.obs_size)
        copy = jax.tree.map(jnp.copy, critic)
        return SACState(actor, critic, copy, log_temperature, optimizers, moments, tasks.context, vectors)  # type: ignore

    @property
    def _optimizers(self) -> tuple[optax.GradientTransformation, ...]:
        clip = optax.clip_by_global_norm(self.max_gradient_norm) if self.max_gradient_norm else optax.identity()
        adam = lambda lr: optax.chain(clip, optax.adam(lr))
        return adam(self.actor_lr), adam(self.critic_lr), optax.adam(self.temperature_lr)

    # Which task it is.

    @property
    def unseen(self) -> str:
        """What stands for a task that was not trained on; empty if its own parameters, or nothing, do."""
        parts = ["head"] if self.heads == "per-task" else []
        parts += [{"one-hot": "number"}.get(self.conditioning, self.conditioning.removesuffix("s"))] * (
            self.conditioning in ("one-hot", "embedding", "vectors")
        )
        return f"each uses the {' and '.join(parts)} of the nearest training task" if parts else ""

    def known_task(self, state: SACState, task: Task) -> Array:
        """The training task () int32 whose head, embedding or number stands for ``task``: itself, or the nearest."""
        nearest = jnp.argmin(jnp.sum(jnp.square(state.contexts - task.context), axis=-1)).astype(jnp.int32)
        return jnp.where(task.id < len(state.contexts), task.id, nearest)

    def _features(self, num_tasks: int, index: Array, context: Array, vectors: Array | None) -> Array:
        """What the networks see of a task (Z,); a learned embedding is added by the network that owns it."""
        match self.conditioning:
            case "one-hot":
                return jax.nn.one_hot(index, num_tasks)
            case "parameters":
                return context
            case "vectors":
                assert vectors is not None
                return vectors[index]
        return jnp.zeros(0)

    def features(self, state: SACState, task: Task) -> Array:
        """What the networks see of one task (Z,)."""
        return self._features(len(state.contexts), self.known_task(state, task), task.context, state.vectors)

    # Acting.

    def act(self, state: SACState, obs: Array, task: Task, key: Key | None) -> Array:
        """Choose an action (A,) for one observation (O,) of one task; no key: the mean action."""
        index = self.known_task(state, task)
        actor = Params(state.actor.shared, jax.tree.map(lambda x: x[index], state.actor.own))
        outputs = self.actor.apply(actor, self.features(state, task), self._see(state.moments, obs))
        return tanh_normal(outputs, key)[0]

    def _see(self, moments: normalize.Moments, obs: Array) -> Array:
        return normalize.apply(moments, obs) if self.normalize_observations else obs

    # Losses, each on the data of one task: observations (B, O), features (Z,) or (B, Z), temperature ().

    def values(self, critic: Params, features: Array, obs: Array, action: Array) -> Array:
        """Every critic's estimate (N, B)."""
        return jax.vmap(self.critic.apply, (0, None, None, None))(critic, features, obs, action)[..., 0]

    def critic_target(self, actor, target, features, temperature, batch: Transition, key: Key) -> Array:
        """Soft Bellman target (B,)."""
        action, log_prob = tanh_normal(self.actor.apply(actor, features, batch.next_obs), key)
        next_value = jnp.min(self.values(target, features, batch.next_obs, action), axis=0) - temperature * log_prob
        return batch.reward + self.gamma * batch.discount * next_value

    def critic_loss(self, critic: Params, data) -> tuple[Array, Metrics]:
        batch, features, target = data
        values = self.values(critic, features, batch.obs, batch.action)
        loss = jnp.mean(jnp.sum(jnp.square(values - target), axis=0))
        return loss, {"critic_loss": loss, "value": jnp.mean(values)}

    def actor_loss(self, actor: Params, data) -> tuple[Array, Metrics]:
        batch, features, critic, temperature, key = data
        action, log_prob = tanh_normal(self.actor.apply(actor, features, batch.obs), key)
        value = jnp.min(self.values(critic, features, batch.obs, action), axis=0)
        loss = jnp.mean(temperature * log_prob - value)
        return loss, {"actor_loss": loss, "entropy": -jnp.mean(log_prob)}

    def temperature_loss(self, log_temperature: Array, entropy: Array, action_size: int) -> Array:
        return jnp.mean(jnp.exp(log_temperature) * (entropy - self.target_entropy * action_size))

    # Update.

    def update(self, state: SACState, batch: Transition, tasks: Task, key: Key) -> tuple[SACState, Metrics]:
        """Take one gradient step on a batch (T, B, ...) of the training tasks; metrics are (T,)."""
        target_key, actor_key, critic_order, actor_order = jax.random.split(key, 4)
        num_tasks = len(tasks.id)
        moments = normalize.update(state.moments, batch.obs) if self.normalize_observations else state.moments
        batch = batch._replace(obs=self._see(moments, batch.obs), next_obs=self._see(moments, batch.next_obs))
        features = jax.vmap(partial(self.features, state))(tasks)
        if batch.context is not None and self.conditioning == "parameters":
            features = batch.context  # (T, B, C), as every episode has parameters of its own
        temperature = jnp.broadcast_to(jnp.exp(state.log_temperature), num_tasks)

        over_tasks = Params(shared=None, own=0)  # type: ignore
        bootstrap = jax.vmap(self.critic_target, (over_tasks, over_tasks, 0, 0, 0, 0))
        keys = jax.random.split(target_key, num_tasks)
        target = bootstrap(state.actor, state.target, features, temperature, batch, keys)
        gradients, seen, critic_conflicts = surgery.gradient(
            self.gradients, self.critic_loss, state.critic, (batch, features, target), critic_order
        )
        actor_optimizer, critic_optimizer, temperature_optimizer = self._optimizers
        critic, critic_memory = descend(critic_optimizer, gradients, state.optimizers[1], state.critic)

        def actor_loss(actor: Params, data) -> tuple[Array, Metrics]:
            batch, features, own_critic, temperature, key = data
            task_critic = Params(critic.shared, own_critic)
            return self.actor_loss(actor, (batch, features, task_critic, temperature, key))

        data = (batch, features, critic.own, temperature, jax.random.split(actor_key, num_tasks))
        gradients, done, actor_conflicts = surgery.gradient(self.gradients, actor_loss, state.actor, data, actor_order)
        actor, actor_memory = descend(actor_optimizer, gradients, state.optimizers[0], state.actor)

        action_size = batch.action.shape[-1]
        slope = jax.grad(self.temperature_loss)(state.log_temperature, done["entropy"], action_size)
        log_temperature, temperature_memory = descend(
            temperature_optimizer, slope, state.optimizers[2], state.log_temperature
        )
        state = state._replace(
            actor=actor,
            critic=critic,
            target=optax.incremental_update(critic, state.target, self.tau),
            log_temperature=log_temperature,
            optimizers=(actor_memory, critic_memory, temperature_memory),
            moments=moments,
        )
        metrics = {**seen, **done, "temperature": temperature}
        named = (("critic", critic_conflicts), ("actor", actor_conflicts))
        return state, metrics | {f"{who}_{k}": v for who, found in named for k, v in found.items()}


def descend(optimizer: optax.GradientTransformation, gradients: Any, memory: Any, params: Any) -> tuple[Any, Any]:
    """Apply one optimiser step; returns parameters and the optimiser's state."""
    updates, memory = optimizer.update(gradients, memory, params)
    return optax.apply_updates(params, updates), memory


def load_vectors(file: str, num_tasks: int) -> Array:
    """Read task vectors (T, V) from a .npy file.

    Raises:
        InputError: the file cannot be read, or does not hold one finite row for every training task.
    """
    try:
        with open(file, "rb") as opened:
            vectors = np.asarray(np.load(opened, allow_pickle=False), np.float32)  # neither an archive nor words
    except (OSError, EOFError, TypeError, ValueError) as error:
        raise InputError(f"cannot read task vectors from {file!r}: {error}") from None
    if vectors.ndim != 2 or len(vectors) != num_tasks or not np.all(np.isfinite(vectors)):
        raise InputError(
            f"{file!r} must hold {num_tasks} finite rows, one a training task; its shape is {vectors.shape}"
        )
    return jnp.asarray(vectors)
