"""Normalise observations by their running mean and variance (Welford; parallel form by Chan et al. 1979)."""

from typing import NamedTuple

import jax.numpy as jnp

from mtjax.types import Array

_MIN_STD = 1e-3
LARGEST = 10.0
"""Clip normalised observations to this size, so that rare ones do not drive networks out of range."""
_FAR = 100.0


class Moments(NamedTuple):
    """Holds the moments of all observations so far."""

    count: Array  # ()
    mean: Array  # (O,)
    deviation: Array  # (O,) sum of squared deviations from the mean


def init(size: int) -> Moments:
    """Return moments of no observations; ``apply`` then only clips."""
    return Moments(jnp.float32(0), jnp.zeros(size), jnp.zeros(size))


def update(moments: Moments, batch: Array) -> Moments:
    """Add a batch (..., O) to the moments."""
    batch = batch.reshape(-1, batch.shape[-1])
    mean = jnp.mean(batch, axis=0)
    return merge(moments, Moments(jnp.float32(len(batch)), mean, jnp.sum(jnp.square(batch - mean), axis=0)))


def merge(moments: Moments, others: Moments) -> Moments:
    """Combine the moments of two sets of observations. The second set must not be empty."""
    count, shift = moments.count + others.count, others.mean - moments.mean
    share = others.count / count
    deviation = moments.deviation + others.deviation + jnp.square(shift) * moments.count * share
    return Moments(count, moments.mean + shift * share, deviation)


def bounded(moments: Moments, x: Array) -> Array:
    """Bring x (..., O) to within 100 standard deviations of the mean, as it is to be counted; all x at first.

    A world that is about to blow up shows numbers of any size. Counted as they are, those of a few steps would make all
    others look alike for the rest of a run.
    """
    far = jnp.where(moments.count > 0, _FAR * _std(moments), jnp.inf)
    return jnp.clip(x, moments.mean - far, moments.mean + far)


def apply(moments: Moments, x: Array) -> Array:
    """Scale x (..., O) to mean 0 and variance 1, and clip it to +-``LARGEST``."""
    return jnp.clip((x - moments.mean) / _std(moments), -LARGEST, LARGEST)


def _std(moments: Moments) -> Array:
    variance = jnp.where(moments.count > 0, moments.deviation / jnp.maximum(moments.count, 1), 1.0)
    return jnp.maximum(jnp.sqrt(variance), _MIN_STD)
