"""The autoencoder rebuilds what it observes from its latent states."""

import dataclasses
from typing import Any, ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.networks import MLP, Params
from mtjax.agents.parts import vision
from mtjax.agents.parts.knowing.last_steps import without_past
from mtjax.agents.parts.representations.encoded import PROJECTION, Encoded, init_part
from mtjax.types import Array, Key, Metrics


@dataclasses.dataclass(frozen=True)
class Autoencoder(Encoded):
    """Autoencoder is an encoder phi with a decoder g (Yarats et al. 2021, "SAC-AE").

    Beside the critics' loss, this one trains phi and g; s are stacked pictures of 32 brightnesses with noise:
        L_AE = mean (g(h) - s)^2 + lambda |h|^2 / 2 + decay |theta_g|^2 / 2,  h = phi(s)       (reconstruction loss)
    where the mean is over pixels, lambda is ``latent_decay`` and theta_g are the decoder's parameters. Of vectors, s is
    the observation, and g has the encoder's widths the other way round; in a mixture the mean is over padding too, so
    that a task that observes few numbers counts less.

    phibar, with its projection, moves by ``encoder_tau``.

    As in the paper, temperatures of the agent sac-ae begin at 0.1 and are tuned to an entropy of -A, by an Adam whose
    first decay rate is 0.5.

    Differs from the paper: the encoder takes pictures as numbers from -0.5 to 0.5, there from 0 to 1; one optimiser
    steps encoder, decoder and critics together, at every update, and actor and targets move at every update, there at
    every second; the decay of the decoder is a part of the loss; batches and rates are those of all agents here, where
    the paper has batches of 128.
    """

    shift: int = 0
    """Shift pictures of a batch by up to so many pixels at random; 0 for none."""
    reconstruction: float = 1.0
    """Weight of the reconstruction loss relative to the critics' loss."""
    latent_decay: float = 1e-6
    """Weight of the latent state's squared length."""
    decoder_decay: float = 1e-7
    """Weight of the squared length of the decoder's parameters."""

    slow: ClassVar[tuple[str, ...]] = (*Encoded.slow, PROJECTION)
    models: ClassVar[tuple[str, ...]] = ("decoder",)

    def __post_init__(self):
        super().__post_init__()
        parts.require_positive(self, "reconstruction")
        parts.require_not_negative(self, "latent_decay", "decoder_decay")

    def init(
        self, num_tasks: int, features: Array, obs: Any, seen: Any, action: Array, own: bool, key: Key
    ) -> tuple[Params, Key]:
        params, key = super().init(num_tasks, features, obs, seen, action, own, key)
        key, decoder_key = jax.random.split(key)
        init_part(params, "decoder", self.decoder(obs), own, decoder_key, num_tasks, jnp.zeros(self.latent_widths[-1]))
        return params, key

    def decoder(self, obs: Any) -> nn.Module:
        """Return the decoder for observations like ``obs``."""
        if frames.shown(obs):
            return vision.Decoder(*obs[frames.PICTURES].shape[-2:])
        return nn.Sequential([MLP(self.latent_widths[-2::-1]), nn.Dense(obs.shape[-1])])

    def targets(self, params: Params, target_params: Params, next_obs: Any, key: Key) -> tuple[Key, Key]:
        """Return keys (T,) for noise in pictures, and others for each task's critics."""
        keys = jax.vmap(jax.random.split)(super().targets(params, target_params, next_obs, key)[1])
        return keys[:, 1], keys[:, 0]

    def join(self, loss: Array, metrics: Metrics, params: Params, batch: Any) -> tuple[Array, Metrics]:
        obs = without_past(batch.obs)
        latent = self.encode(params, obs)[..., : self.latent_widths[-1]]
        weights = params.parts["decoder"]
        rebuilt: Any = self.decoder(obs).apply(weights, latent)
        wanted = vision.coarse(obs[frames.PICTURES], batch.model_targets) if frames.shown(obs) else obs
        error = jnp.mean(jnp.square(rebuilt - wanted))
        length = jnp.mean(jnp.sum(jnp.square(latent), axis=-1))
        size = sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(weights))
        total = error + self.latent_decay * length / 2 + self.decoder_decay * size / 2
        return loss + self.reconstruction * total, {**metrics, "reconstruction_loss": error}
