"""``NoScaling`` is the interface of scalings, and the one that changes nothing."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp

from mtjax.agents.networks import Params
from mtjax.agents.parts.watching import Watcher
from mtjax.types import Array, Transition


@dataclasses.dataclass(frozen=True)
class NoScaling:
    """Leaves rewards as they are. Every scaling is a class with these methods."""

    follows_resets: ClassVar[bool] = False  # whether its units are renewed by resets of networks alone
    discounted: ClassVar[bool] = False  # whether its units follow from a bound of discounted returns
    return_range: ClassVar[float | None] = None  # the largest |return| after scaling, if it keeps them in a range
    rescales: ClassVar[bool] = False  # whether it rescales the heads of critics, each task's own, as values move
    init, begin, remember, observe = Watcher.init, Watcher.begin, Watcher.remember, Watcher.observe

    def units(self, memory: Any, gamma: Array, bonus: Array) -> tuple[Array, Array] | None:
        """Return each task's factor and offset (T,); None for 1 and 0.

        Args:
            bonus: (T,) or (1,), a |H| / 2: half of what the target entropy adds to the reward of a step.
        """
        return None

    def rewards(self, memory: Any, batch: Transition, gamma: Array, bonus: Array) -> Array:
        """Return the rewards (T, B) of a batch in each task's units, given each task's discount (T,)."""
        units = self.units(memory, gamma, bonus)
        if units is None:
            return batch.reward
        factor, offset = (x[:, None] for x in units)
        return factor * (batch.reward - (1 - gamma[:, None] * batch.discount) * offset)

    def renew(self, memory: Any, target: Array, critics: tuple[Params, ...]) -> tuple[Any, tuple[Params, ...]]:
        """Update the memory by the targets (T, B) of an update from a replay, and rescale critics to the new units."""
        return memory, critics

    def reset(self, memory: Any) -> Any:
        """Return the memory for networks that begin anew."""
        return memory


class Moments(NamedTuple):
    """Holds the mean and variance of rewards or of targets; they begin at 0 and 1."""

    mean: Array  # (T,)
    variance: Array  # (T,)

    @staticmethod
    def begin(num_tasks: int) -> "Moments":
        return Moments(jnp.zeros(num_tasks), jnp.ones(num_tasks))

    def moved(self, rate: float | Array, drift: Array, variance: Array) -> "Moments":
        """Move by new numbers of weight ``rate``, with their variance (T,) and distance (T,) from the old mean."""
        spread = (1 - rate) * self.variance + rate * variance + rate * (1 - rate) * jnp.square(drift)
        return Moments(self.mean + rate * drift, spread)
