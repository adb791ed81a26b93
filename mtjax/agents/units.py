"""Units of a critic's output: every task's values in standard deviations of its targets from their mean."""

from typing import NamedTuple

import jax.numpy as jnp

from mtjax.agents.networks import Params
from mtjax.agents.parts.scaling.base import Moments
from mtjax.parallel.collectives import mean_and_variance
from mtjax.types import Array

MIN_STD = 1e-4
"""Lower bound of standard deviations that divide."""


class Units(NamedTuple):
    """Holds the units of the critic: a value is mean + std times its output."""

    count: Array  # () how often they have moved
    moments: Moments  # of targets, (T,)

    @staticmethod
    def begin(num_tasks: int) -> "Units":
        """Return units in which outputs are values."""
        return Units(jnp.float32(0), Moments.begin(num_tasks))

    @staticmethod
    def of(params: Params) -> "Units":
        """Return the units that a network of the agent's holds."""
        return Units(params.shared["count"], params.own)

    def params(self) -> Params:
        """Return the units as a network of the agent's."""
        return Params({"count": self.count}, self.moments)

    @property
    def std(self) -> Array:
        return jnp.maximum(jnp.sqrt(self.moments.variance), MIN_STD)

    def rewards(self, outputs: Array) -> Array:
        """Return the values in units of reward for which the critic's outputs (T, ...) stand."""
        mean, std = self._like(outputs)
        return mean + std * outputs

    def outputs(self, values: Array) -> Array:
        """Return the critic's outputs that stand for values (T, ...) in units of reward."""
        mean, std = self._like(values)
        return (values - mean) / std

    def _like(self, x: Array) -> tuple[Array, ...]:
        return tuple(jnp.expand_dims(each, range(1, x.ndim)) for each in (self.moments.mean, self.std))

    def moved(self, target: Array, rate: float | Array) -> "Units":
        """Return units that have moved towards targets (T, N) of this and other devices.

        Args:
            rate: weight of these targets; the first ones have equal weights.
        """
        rate = jnp.maximum(rate, 1 / (self.count + 1))
        mean, variance = (x[:, 0] for x in mean_and_variance(target, 1))
        return Units(self.count + 1, self.moments.moved(rate, mean - self.moments.mean, variance))

    def change(self, new: "Units") -> tuple[Array, Array]:
        """Return by which factor and offset (T,) outputs change in new units, if values do not.

        The first units change nothing: before them, outputs stand for no values.
        """
        known = self.count > 0
        offset = (self.moments.mean - new.moments.mean) / new.std
        return jnp.where(known, self.std / new.std, 1.0), jnp.where(known, offset, 0.0)
