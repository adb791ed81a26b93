"""DeepMDP: soft actor-critic on a latent state that foretells the next latent state and the reward."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax

from mtjax.agents import parts
from mtjax.agents.parts.trajectory import Seen, TrajectoryEncoder
from mtjax.agents.sac import SAC, Batch, SACState
from mtjax.networks import MLP, Network, Params, Trunk, join
from mtjax.types import Array, InputError, Key, Metrics, Spec, Task

DEVIATIONS = (0.01, 1.0)
"""Least and largest standard deviation of a predicted latent state, whose values lie in (-1, 1)."""
CRITIC = ("body", "head")
SIGHT = ("latent", "trajectory", "embedding")


class Latent(nn.Module):
    """Encode observations (..., O) as latent states (..., D) in (-1, 1)."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: Array) -> Array:
        *inner, size = self.widths
        return jnp.tanh(nn.LayerNorm()(nn.Dense(size)(MLP(tuple(inner))(obs))))


class Model(nn.Module):
    """A layer-normalised trunk with a linear output, on latent states and what is known of the task."""

    widths: tuple[int, ...]
    out: int

    @nn.compact
    def __call__(self, latent: Array, told: Array, *action: Array) -> Array:
        return nn.Dense(self.out)(Trunk(self.widths, layer_norm=True)(latent, told, *action))


class Targets(NamedTuple):
    """What the critic's loss fits, for one task."""

    value: Any  # as ``value.loss`` takes it
    latent: Array  # (B, D) of the next observations, by the slow encoder
    noise: Array  # (B, D) that draws next latent states; () zero where they are points
    rival: Array | None = None  # (Z,) the vector of another task


@dataclasses.dataclass(frozen=True)
class DeepMDP(SAC):
    """SAC whose networks stand on a latent model of the task (Gelada et al. 2019, as in Zhang et al. 2021 and MTRL).

    There are one encoder h = phi(s), one transition model T(h, a, z) = (mu, sigma) and one reward model R(h', z), where
    z is what is known of the task. For a transition (s, a, r, s'), the loss of the critics Q_n(h, z, a) is joined by
        L_T = mean_d ((mu - sg(phibar(s')))^2 / (2 sigma^2) + log sigma)             (transition loss)
        L_R = (R(h~, z) - r)^2,  h~ = mu + sigma noise                               (reward loss)
    and all of them train phi. The actor sees sg(phi(s)), so that its loss does not. With transition=deterministic,
    sigma is 1 and h~ is mu. phi ends in layer normalisation and tanh, as in SAC-AE (Yarats et al. 2021): L_T alone
    would shrink latent states to a point. phibar is the slow copy of phi, on which the slow critics stand; it takes
    steps of ``encoder_tau``.

    Vectors of conditioning=embedding, and the trajectory encoder of conditioning=inferred, are part of this
    representation: one for all networks, trained by critics and models, and seen by the actor as they are.

    Differs from the papers: h' is the slow encoder's, as an encoder that chases itself is less stable (Zhang et al. and
    MTRL take sg(phi(s'))); R works on the predicted state, as theirs does, where Gelada et al. have R(h, a), but is
    told the task; L_T is their likelihood and not a Wasserstein distance; sigma is in [0.01, 1] where MTRL's is in
    [1e-4, 10], as the slope of L_T grows with 1 / sigma^2. Observations are vectors, so that nothing is decoded.
    """

    latent_widths: tuple[int, ...] = (256, 50)
    """Widths of the encoder's layers; the last is the size of the latent state."""
    model_widths: tuple[int, ...] = (512,)
    """Widths of the hidden layers of transition and reward model."""
    transition: Literal["deterministic", "probabilistic"] = "deterministic"
    """Foretell the next latent state as a point or as a Gaussian."""
    model_coefficient: float = 1.0
    """Weight of transition and reward loss beside the critics'."""
    encoder_tau: float = 0.05
    """Share of the new encoder that its slow copy takes at each update."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_layers(self, "latent_widths", "model_widths")
        parts.require_rates(self, "encoder_tau")
        parts.require_positive(self, "model_coefficient")
        if self.encoder.front() is not None:
            raise InputError(
                "encoder=input-map maps observations, and here networks see a latent state; choose another"
            )

    # Networks: beside the body and head of N critics lies one each of all that they stand on, and of the models.

    @property
    def has_theta(self) -> bool:
        """Whether every task has a learned vector."""
        return self.conditioning == "embedding"

    def network(self, layer_norm: bool) -> Network:
        return dataclasses.replace(super().network(layer_norm), embedding_size=0, trajectory=None)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Encoders and models."""
        size = self.latent_widths[-1]
        found: dict[str, nn.Module] = {
            "latent": Latent(self.latent_widths),
            "transition": Model(self.model_widths, 2 * size if self.transition == "probabilistic" else size),
            "reward": Model(self.model_widths, 1),
        }
        return found | ({"trajectory": self.trajectory} if self.conditioning == "inferred" else {})

    @property
    def trajectory(self) -> TrajectoryEncoder:
        return TrajectoryEncoder(self.embedding_size, layer_norm=self.critic_layer_norm)

    def apply(self, params: Params, name: str, *inputs: Any) -> Array:
        """Map one task's inputs by an encoder or a model."""
        return self.modules[name].apply({**params.shared, **params.own}[name], *inputs)  # type: ignore

    def init(self, spec: Spec, tasks: Task, key: Key) -> SACState:
        state = super().init(spec, tasks, key)
        return state._replace(target=only(state.target, (*CRITIC, *SIGHT)))  # models do not bootstrap

    def init_networks(self, num_tasks: int, told: Array, obs: Any, action: Array, key: Key) -> tuple[Params, Params]:
        key, theta_key, *keys = jax.random.split(key, 2 + len(self.modules))
        width = len(told) + self.embedding_size * (self.has_theta + (self.conditioning == "inferred"))
        latent, told = jnp.zeros(self.latent_widths[-1]), jnp.zeros(width)
        actor, critic = super().init_networks(num_tasks, told, latent, action, key)
        inputs = {"latent": (plain(obs),), "transition": (latent, told, action), "reward": (latent, told)}
        for (name, module), part_key in zip(self.modules.items(), keys, strict=True):
            data = inputs.get(name, (obs,))
            if self.heads == "disjoint":
                critic.own[name] = self.critic.for_each_task(module.init, part_key, num_tasks, *data)
            else:
                critic.shared[name] = module.init(part_key, *data)
        if self.has_theta:
            critic.own["embedding"] = jax.random.normal(theta_key, (num_tasks, self.embedding_size))
        return actor, critic

    def update_target(self, critic: Params, target: Params) -> Params:
        rate = lambda name: self.tau if name in CRITIC else self.encoder_tau
        step = lambda new, old: {k: optax.incremental_update(new[k], old[k], rate(k)) for k in old}
        return Params(step(critic.shared, target.shared), step(critic.own, target.own))

    # What networks see, of one task: observations (..., O), features (Z,) or (B, Z).

    def perceive(self, critic: Params, features: Array, obs: Any) -> tuple[Array, Array]:
        """Latent states (..., D), and what is known of the task (Z,) or (..., Z)."""
        if self.conditioning == "inferred":
            features = self.apply(critic, "trajectory", obs)
        told = join(features, task=self.theta(critic)) if self.has_theta else features
        return self.apply(critic, "latent", plain(obs)), told

    def theta(self, critic: Params) -> Array:
        """A task's learned vector (Z,)."""
        theta = critic.own["embedding"]
        return theta / jnp.maximum(jnp.linalg.norm(theta), 1e-6) if self.unit_embedding else theta

    def foretell(self, critic: Params, latent: Array, told: Array, action: Array) -> tuple[Array, Array]:
        """Mean and standard deviation (..., D) of the next latent state."""
        outputs = self.apply(critic, "transition", latent, told, action)
        if self.transition == "deterministic":
            return outputs, jnp.ones_like(outputs)
        mean, deviation = jnp.split(outputs, 2, axis=-1)
        low, high = DEVIATIONS
        return mean, low + (high - low) * jax.nn.sigmoid(deviation)

    def policy(self, actor: Params, critic: Params, features: Array, obs: Any) -> Array:
        latent, told = jax.lax.stop_gradient(self.perceive(critic, features, obs))
        return super().policy(actor, critic, told, latent)

    def of_critics(self, apply: Callable, critic: Params, features: Array, obs: Any, action: Array) -> Any:
        latent, told = self.perceive(critic, features, obs)
        return super().of_critics(apply, only(critic, CRITIC), told, latent, action)

    # Losses.

    def target(self, actor: Params, critic: Params, slow: Params, batch: Batch, key: Key) -> Targets:
        value_key, noise_key = jax.random.split(key)
        value = super().target(actor, critic, slow, batch, value_key)
        latent = self.apply(slow, "latent", plain(batch.next_obs))
        drawn = self.transition == "probabilistic"
        return Targets(value, latent, jax.random.normal(noise_key, latent.shape) if drawn else jnp.float32(0))

    def critic_loss(self, critic: Params, data) -> tuple[Array, Metrics]:
        batch, targets = data
        loss, metrics = super().critic_loss(critic, (batch, targets.value))
        latent, told = self.perceive(critic, batch.told, batch.obs)
        mean, deviation = self.foretell(critic, latent, told, batch.action)
        error = (mean - jax.lax.stop_gradient(targets.latent)) / deviation
        transition_loss = jnp.mean(0.5 * jnp.square(error) + jnp.log(deviation))
        reward = self.apply(critic, "reward", mean + deviation * targets.noise, told)[..., 0]
        reward_loss = jnp.mean(jnp.square(reward - batch.reward))
        metrics |= {"transition_loss": transition_loss, "reward_loss": reward_loss}
        return loss + self.model_coefficient * (transition_loss + reward_loss), metrics


def plain(obs: Any) -> Array:
    """The observation alone, where the past is seen too."""
    return obs.obs if isinstance(obs, Seen) else obs


def only(params: Params, names: tuple[str, ...]) -> Params:
    """The parts of a network that have one of the names."""
    return Params(*({name: part for name, part in parts.items() if name in names} for parts in params))
