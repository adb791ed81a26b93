"""Vision: networks that encode stacks of pictures, networks that draw them, and random shifts.

Pictures are uint8, (..., H, W, K) for K channels of all stacked pictures. Networks see values in [-0.5, 0.5], of grids
in [0, 1].
"""

from functools import partial
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.agents.networks import orthogonal
from mtjax.agents.parts.convolution import Transposed, convolve, multiply_patches
from mtjax.types import Array, InputError, Key, Transition

Vision = Literal["drq", "impala", "grid"]
_FILTERS = 32
_SECTIONS = (16, 32, 32)  # IMPALA's channels
_OF_CELLS = 16  # filters for grids
_Conv = partial(nn.Conv, conv_general_dilated=convolve)
_ORTHOGONAL = orthogonal(2**0.5)


def as_numbers(pictures: Array) -> Array:
    """Return uint8 pictures as numbers in [-0.5, 0.5]."""
    return pictures.astype(jnp.float32) / 255.0 - 0.5


class Convolutions(nn.Module):
    """Four convolutions of 3 x 3 with 32 filters, the first with stride 2 (Yarats et al. 2021, SAC-AE, DrQ, DrQ-v2)."""

    @nn.compact
    def __call__(self, pictures: Array) -> Array:
        """Map pictures (..., H, W, K) to features (..., F)."""
        x = as_numbers(pictures)
        for stride in (2, 1, 1, 1):
            x = nn.relu(_Conv(_FILTERS, (3, 3), (stride, stride), "VALID", kernel_init=_ORTHOGONAL)(x))
        return x.reshape(*x.shape[:-3], -1)


class Residual(nn.Module):
    """Three sections of a convolution, pooling and two residual blocks (Espeholt et al. 2018, "IMPALA", figure 3)."""

    @nn.compact
    def __call__(self, pictures: Array) -> Array:
        """Map pictures (..., H, W, K) to features (..., F)."""
        x = as_numbers(pictures)
        lead = x.shape[:-3]
        x = x.reshape(-1, *x.shape[-3:])  # pooling takes one leading axis
        for filters in _SECTIONS:
            x = nn.max_pool(_Conv(filters, (3, 3))(x), (3, 3), (2, 2), "SAME")
            for _ in range(2):
                inner = _Conv(filters, (3, 3))(nn.relu(x))
                x = x + _Conv(filters, (3, 3))(nn.relu(inner))
        return nn.relu(x).reshape(*lead, -1)


class Cells(nn.Module):
    """A convolution of 3 x 3 with 16 filters, and layer normalisation, for grids of few cells (Gallici et al. 2025).

    Normalisation is over the filters of each place. Cells have values in [0, 1], so that nothing is 0.
    """

    @nn.compact
    def __call__(self, pictures: Array) -> Array:
        """Map pictures (..., H, W, K) to features (..., F)."""
        x = pictures.astype(jnp.float32) / 255
        x = nn.Conv(_OF_CELLS, (3, 3), padding="VALID", conv_general_dilated=multiply_patches)(x)
        return nn.relu(nn.LayerNorm()(x)).reshape(*x.shape[:-3], -1)


NETWORKS: dict[str, type[nn.Module]] = {"drq": Convolutions, "impala": Residual, "grid": Cells}
LEAST: dict[str, int] = {"drq": 15, "impala": 1, "grid": 3}
"""Height and width of the smallest pictures that each network takes."""


def require_large(vision: Vision, obs: Any) -> None:
    """Check that pictures, if an observation of these shapes has some, are as large as a network needs.

    Raises:
        InputError: they are smaller.
    """
    if not frames.shown(obs):
        return
    picture, least = obs[frames.PICTURES].shape, LEAST[vision]
    if min(picture[:2]) < least:
        told = f"vision={vision} takes pictures of at least {least} x {least}, not {picture}"
        raise InputError(f"{told}; for grids of few cells use --agent.vision=grid")


def project(features: Array, size: int) -> Array:
    """Map features (..., F) to latent states (..., D) in (-1, 1), by new layers of the module that calls this."""
    return jnp.tanh(nn.LayerNorm()(nn.Dense(size)(features)))


class Projection(nn.Module):
    """Maps features of pictures to latent states (..., D), to which a state that is seen beside them is appended.

    Without a size, latent states are the features.
    """

    size: int | None = None

    @nn.compact
    def __call__(self, obs: Any) -> Array:
        """Map an observation with features (..., F) in place of pictures."""
        features, state = obs[frames.PICTURES], frames.state(obs)
        latent = features if self.size is None else project(features, self.size)
        return latent if state is None else jnp.concatenate([latent, state], axis=-1)


class Sight(nn.Module):
    """Maps pictures to latent states (..., D): convolutions and a projection of their own."""

    size: int
    vision: Vision

    @nn.compact
    def __call__(self, obs: Any) -> Array:
        """Map an observation; a state beside the pictures is not seen."""
        return project(NETWORKS[self.vision]()(obs[frames.PICTURES]), self.size)


class Decoder(nn.Module):
    """Draws pictures from latent states, by the convolutions of ``Convolutions`` the other way round (SAC-AE)."""

    side: int  # of the square pictures, even
    channels: int

    @nn.compact
    def __call__(self, latent: Array) -> Array:
        """Map latent states (..., D) to pictures (..., H, W, K) of numbers in about [-0.5, 0.5]."""
        side = self.side // 2 - 1 - 6
        x = nn.relu(nn.Dense(side * side * _FILTERS)(latent)).reshape(*latent.shape[:-1], side, side, _FILTERS)
        for larger in (side + 2, side + 4, side + 6):
            x = nn.relu(Transposed((larger, larger, _FILTERS))(x))
        return Transposed((self.side, self.side, self.channels), stride=2)(x)


def coarse(pictures: Array, key: Key) -> Array:
    """Return what a decoder is fitted to: pictures of 32 brightnesses with uniform noise (SAC-AE, after Glow)."""
    steps = jnp.floor(pictures.astype(jnp.float32) / 8.0)
    return (steps + jax.random.uniform(key, pictures.shape)) / 32.0 - 0.5


def shifted(pictures: Array, key: Key, most: int) -> Array:
    """Return pictures (..., H, W, K), each shifted by up to ``most`` pixels along both axes, with repeated edges."""
    height, width, channels = pictures.shape[-3:]
    flat = pictures.reshape(-1, height, width, channels)
    padded = jnp.pad(flat, ((0, 0), (most, most), (most, most), (0, 0)), mode="edge")
    offsets = jax.random.randint(key, (len(flat), 2), 0, 2 * most + 1)
    crop = lambda picture, offset: jax.lax.dynamic_slice(picture, (*offset, 0), (height, width, channels))
    return jax.vmap(crop)(padded, offsets).reshape(pictures.shape)


def shift_pictures(batch: Transition, key: Key, most: int) -> Transition:
    """Shift the pictures of a batch by up to ``most`` pixels, those before and after its steps on their own."""
    if not most or not frames.shown(batch.obs):
        return batch
    keys = jax.random.split(key)
    move = lambda obs, key: obs | {frames.PICTURES: shifted(obs[frames.PICTURES], key, most)}
    return batch._replace(obs=move(batch.obs, keys[0]), next_obs=move(batch.next_obs, keys[1]))
