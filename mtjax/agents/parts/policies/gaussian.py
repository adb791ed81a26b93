"""Policies that draw vectors in (-1, 1)^A."""

import dataclasses
import math
from collections.abc import Mapping

import jax
import jax.numpy as jnp

from mtjax.agents.networks import Params
from mtjax.agents.parts.policies.base import Drawn, Policy
from mtjax.types import Array, Continuous, Key

_LOG_STD_RANGE = (-5.0, 2.0)
STD_RANGE = tuple(math.exp(bound) for bound in _LOG_STD_RANGE)
"""Range of a tanh-squashed Gaussian's standard deviation before the tanh."""


@dataclasses.dataclass(frozen=True)
class Gaussian(Policy):
    """Draws the tanh of a Gaussian vector (Haarnoja et al. 2018, appendix C).

    Outputs (..., 2A) are its means and unbounded log standard deviations. A tanh brings the latter into [-5, 2].
    Entries that a task does not have are 0 in actions, and do not count in probabilities.
    """

    def outputs(self, size: int) -> int:
        return 2 * size

    def first(self, size: int, std: float | Array) -> Array:
        return jnp.repeat(jnp.array([0.0, _output_for(std)]), size)

    def blank(self, nets: Mapping[str, Params]) -> Array:
        return Continuous(nets["actor"].parts["head"]["bias"].shape[-1] // 2).blank()

    def encode(self, action: Array) -> Array:
        return action

    def draw(self, outputs: Array, mask: Array | None, key: Key | None) -> Drawn:
        """Draw actions; without a key, take the mean before the tanh, with 0 as its log-probability."""
        if key is None:
            mean, _ = jnp.split(outputs, 2, axis=-1)
            return Drawn(self.action(mean, mask), mean, jnp.zeros(mean.shape[:-1]))
        mean, log_std = _moments(outputs)
        noise = jax.random.normal(key, mean.shape)
        raw = mean + jnp.exp(log_std) * noise
        log_prob = _log_density(noise, log_std, raw, mask)
        return Drawn(self.action(raw, mask), raw, log_prob)

    def action(self, raw: Array, mask: Array | None) -> Array:
        return _masked(jnp.tanh(raw), mask)

    def log_prob(self, outputs: Array, raw: Array, mask: Array | None = None) -> Array:
        """Return the log-probability (...,) of actions tanh(raw).

        It takes actions before the tanh, as rounding may bring those after it to 1.
        """
        mean, log_std = _moments(outputs)
        return _log_density((raw - mean) * jnp.exp(-log_std), log_std, raw, mask)

    def entropy(self, outputs: Array, mask: Array | None, key: Key) -> Array:
        """Estimate the entropy (...,) by one sample, as it has no closed form."""
        return -self.draw(outputs, mask, key).log_prob

    def divergence(self, outputs: Array, others: Array, mask: Array | None = None) -> Array:
        """Compute the Kullback-Leibler divergence KL(p | q) (...,) of two such policies.

        It equals that of the Gaussians before the tanh, as the same invertible map of both does not change it:
            sum_a (s^2 / s'^2 - 1) / 2 - log(s / s') + ((m - m') / s')^2 / 2
        A mean of log p - log q over sampled actions estimates it too, but is noisy, and lost to rounding if p is near
        q.
        """
        (mean, log_std), (other_mean, other_log_std) = _moments(outputs), _moments(others)
        wider = 2 * (log_std - other_log_std)
        apart = jnp.square((mean - other_mean) * jnp.exp(-other_log_std))
        return jnp.sum(_masked(jnp.expm1(wider) - wider + apart, mask), axis=-1) / 2


def _moments(outputs: Array) -> tuple[Array, Array]:
    """Split outputs into means (..., A) and bounded log standard deviations (..., A)."""
    mean, log_std = jnp.split(outputs, 2, axis=-1)
    low, high = _LOG_STD_RANGE
    return mean, low + 0.5 * (high - low) * (jnp.tanh(log_std) + 1)


def _output_for(std: float | Array) -> Array:
    """Return the output () for which the standard deviation before the tanh is ``std``."""
    low, high = _LOG_STD_RANGE
    return jnp.arctanh(2 * (jnp.log(std) - low) / (high - low) - 1)


def _log_density(noise: Array, log_std: Array, raw: Array, mask: Array | None) -> Array:
    log_normal = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2 * jnp.pi)
    log_slope = 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))
    return jnp.sum(_masked(log_normal - log_slope, mask), axis=-1)


def _masked(x: Array, mask: Array | None) -> Array:
    return x if mask is None else x * mask
