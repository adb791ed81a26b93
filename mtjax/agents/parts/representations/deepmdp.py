"""DeepMDP learns a latent state from which models predict the next latent state and the reward."""

import dataclasses
import math
from typing import Any, ClassVar, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.networks import Params, Trunk
from mtjax.agents.parts.representations.encoded import PROJECTION, Encoded, apply_part, encode_tasks, require_visible
from mtjax.types import Array, InputError, Key, Metrics

Transitions = Literal["deterministic", "probabilistic"]
DEVIATIONS = (0.01, 1.0)
"""Smallest and largest standard deviation of a predicted latent state, whose values lie in (-1, 1)."""


class Model(nn.Module):
    """Maps latent states and task features to outputs, by a trunk with layer normalisation and a linear layer."""

    widths: tuple[int, ...]
    out: int

    @nn.compact
    def __call__(self, latent: Array, features: Array, *action: Array) -> Array:
        return nn.Dense(self.out)(Trunk(self.widths, layer_norm=True)(latent, features, *action))


class ModelTargets(NamedTuple):
    """Holds the targets of one task's models; for all tasks, leaves are (T, ...)."""

    latent: Array  # (B, D) of the next observations, by the target encoder
    noise: Array  # (B, D) for sampling next latent states; () zero if the model is deterministic
    other_theta: Array | None = None  # (Z,) vector of another task


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """Dynamics are a model of the next latent state, as a point or as a Gaussian, and a model of the reward."""

    widths: tuple[int, ...]
    size: int  # D of latent states
    kind: Transitions

    @property
    def modules(self) -> dict[str, nn.Module]:
        """The models, by name."""
        outputs = 2 * self.size if self.kind == "probabilistic" else self.size
        return {"transition": Model(self.widths, outputs), "reward": Model(self.widths, 1)}

    def inputs(self, latent: Array, features: Array, action: Array) -> dict[str, tuple]:
        """Return the models' inputs, by name."""
        return {"transition": (latent, features, action), "reward": (latent, features)}

    def predict(self, params: Params, features: Array, latent: Array, action: Array) -> tuple[Array, Array]:
        """Predict the mean and standard deviation (..., D) of the next latent state."""
        outputs = apply_part(self.modules, params, "transition", latent, features, action)
        if self.kind == "deterministic":
            return outputs, jnp.ones_like(outputs)
        mean, deviation = jnp.split(outputs, 2, axis=-1)
        low, high = DEVIATIONS
        return mean, low + (high - low) * jax.nn.sigmoid(deviation)

    def targets(self, latent: Array, key: Key) -> tuple[ModelTargets, Key]:
        """Return the targets of all tasks' models, for next latent states (T, B, D), and a key (T,) for each task."""
        keys = jax.vmap(jax.random.split)(jax.random.split(key, len(latent)))  # (T, 2): for critics, and for models
        draw = lambda key: jax.random.normal(key, latent.shape[1:])
        drawn = self.kind == "probabilistic"
        return ModelTargets(latent, jax.vmap(draw)(keys[:, 1]) if drawn else jnp.zeros(len(latent))), keys[:, 0]

    def losses(self, params: Params, features: Array, latent: Array, batch: Any) -> tuple[Array, Metrics]:
        """Return the sum of the losses of both models for one task's batch, and each of them by name."""
        mean, deviation = self.predict(params, features, latent, batch.action)
        error = (mean - jax.lax.stop_gradient(batch.model_targets.latent)) / deviation
        transition_loss = mean_of_rows(0.5 * jnp.square(error) + jnp.log(deviation), batch.followed)
        following = mean + deviation * batch.model_targets.noise
        reward = apply_part(self.modules, params, "reward", following, features)[..., 0]
        reward_loss = jnp.mean(jnp.square(reward - batch.reward))
        return transition_loss + reward_loss, {"transition_loss": transition_loss, "reward_loss": reward_loss}

    @property
    def least_loss(self) -> float:
        """The losses of an exact reward, and of an exact latent state with the smallest standard deviation."""
        return math.log(DEVIATIONS[0]) if self.kind == "probabilistic" else 0.0


def require_one_sense(obs: Any) -> None:
    """Check that observations are vectors, or pictures alone.

    Raises:
        InputError: a state lies beside pictures.
    """
    if frames.shown(obs) and frames.state(obs) is not None:
        raise InputError("this representation predicts latent states of pictures alone; leave out --env.state=also")


@dataclasses.dataclass(frozen=True)
class DeepMDP(Encoded):
    """DeepMDP gives actor and critics a latent state (Gelada et al. 2019, as in Zhang et al. 2021 and MTRL).

    It has an encoder h = phi(s), a transition model T(h, a, z) = (mu, sigma) and a reward model R(h', z), where z are
    the features of the task. For a transition (s, a, r, s'), these losses are added to that of the critics, Q_n(h, z,
    a) in SAC and V(h, z) in PPO:
        L_T = mean_d ((mu - sg(phibar(s')))^2 / (2 sigma^2) + log sigma)             (transition loss)
        L_R = (R(h~, z) - r)^2,  h~ = mu + sigma noise                               (reward loss)
    All of them train phi. The actor's input is sg(phi(s)), so its loss does not train phi; from pictures the actor has
    a projection of its own, as in ``Encoded``. With
    transition=deterministic, sigma is 1 and h~ is mu. phi ends in layer normalisation and tanh, as in SAC-AE (Yarats et
    al. 2021), because L_T alone would shrink latent states to a point. phibar is the target encoder, which SAC's target
    critics use; it moves by ``encoder_tau``. In PPO, which has no target networks, it is phi from before the update.

    Differs from the papers: targets come from the target encoder, which is more stable than the sg(phi(s')) of Zhang et
    al. and MTRL; R takes the predicted state, as theirs does (Gelada et al.: R(h, a)), and also z; L_T is their
    likelihood and not a Wasserstein distance; sigma is in [0.01, 1] where MTRL's is in [1e-4, 10], as the gradient of
    L_T grows with 1 / sigma^2. From pictures there is no decoder, and L_T leaves out steps with which an episode
    terminated, as the replay keeps no picture after these.
    """

    model_widths: tuple[int, ...] = (512,)
    """Widths of the hidden layers in transition and reward model."""
    transition: Transitions = "deterministic"
    """Predict the next latent state as a point or as a Gaussian."""
    model_coefficient: float = 1.0
    """Weight of transition and reward loss relative to the critics' loss."""

    slow: ClassVar[tuple[str, ...]] = (*Encoded.slow, PROJECTION)
    models: ClassVar[tuple[str, ...]] = ("transition", "reward")
    predicts: ClassVar[bool] = True

    def __post_init__(self):
        super().__post_init__()
        parts.require_layers(self, "model_widths")
        parts.require_positive(self, "model_coefficient")

    @property
    def dynamics(self) -> Dynamics:
        """The models of latent states and rewards."""
        return Dynamics(self.model_widths, self.latent_widths[-1], self.transition)

    @property
    def modules(self) -> dict[str, nn.Module]:
        return super().modules | self.dynamics.modules

    def model_inputs(self, latent: Array, features: Array, action: Array) -> dict[str, tuple]:
        return self.dynamics.inputs(latent, features, action)

    def require(self, obs: Any) -> None:
        require_one_sense(obs)
        require_visible(self, obs)  # by name, as other classes have this method too

    def targets(self, params: Params, target_params: Params, next_obs: Any, key: Key) -> tuple[ModelTargets, Key]:
        return self.dynamics.targets(encode_tasks(self, target_params, next_obs), key)

    def join(self, loss: Array, metrics: Metrics, params: Params, batch: Any) -> tuple[Array, Metrics]:
        known = self.perceive(params, batch.features, batch.obs)
        models_loss, losses = self.dynamics.losses(params, *known, batch)
        return loss + self.model_coefficient * models_loss, metrics | losses

    @property
    def least_loss(self) -> float | Array:  # type: ignore[override]
        return self.model_coefficient * self.dynamics.least_loss


def mean_of_rows(x: Array, mask: Array | None) -> Array:
    """Return the mean of those rows of x (B, D) that a mask (B,) names, 0 if it names none; without a mask, of all."""
    if mask is None:
        return jnp.mean(x)
    return jnp.sum(jnp.where(mask[:, None], x, 0.0)) / jnp.maximum(jnp.sum(mask) * x.shape[1], 1)
