"""Scalings by the discounted sum of an episode's rewards, backwards: G_t = r_t + gamma G_(t-1)."""

import dataclasses
from typing import ClassVar, NamedTuple

import jax.numpy as jnp

from mtjax.agents import normalize, parts
from mtjax.agents.parts.scaling.base import NoScaling
from mtjax.types import Array, Transition


class Sums(NamedTuple):
    """Holds the sums of an episode's rewards so far."""

    discounted: Array  # backwards
    total: Array
    count: Array  # of rewards


class LargestReturns(NamedTuple):
    """Holds the largest absolute values so far."""

    discounted: Array  # (T,) largest |discounted sum of rewards|
    reward: Array  # (T,) largest |mean reward| of an episode that a time limit cut off


@dataclasses.dataclass(frozen=True)
class ReturnScaling(NoScaling):
    """Divides by the task's largest discounted sum of rewards, to fit returns to a range (BRC; Nauman et al. 2025).

    With G the largest |return| so far, horizon h = 1 / (1 - gamma), temperature a and target entropy H, the
    factor is range / (G + h a |H| / 2); the second term leaves room for the bonus of entropy.

    Differs from the authors' code, which keeps whole episodes, and takes G over the return from every step, plus h
    times the episode's mean reward beyond a time limit. Here G is the larger of two: the
    largest sum that discounts backwards, r_t + gamma r_(t-1) + ..., which needs no whole episodes and is the same for
    constant rewards; and h times the mean reward of an episode that a time limit cut off. So returns just fit where
    rewards stay or rise within an episode. Where they fall, as after a catch that is lost, the return from a step may
    exceed the range, and is less than (1 + gamma) times as large. Before there is any reward the factor is 1.
    """

    discounted: ClassVar[bool] = True
    return_range: float = 10.0
    """Largest |discounted sum of rewards so far| after scaling; with value=c51 or hl-gauss, the range of their bins."""

    def __post_init__(self):
        parts.require_positive(self, "return_range")

    def init(self, num_tasks: int) -> LargestReturns:
        return LargestReturns(jnp.zeros(num_tasks), jnp.zeros(num_tasks))

    def begin(self) -> Sums:
        return Sums(jnp.float32(0), jnp.float32(0), jnp.float32(0))

    def remember(self, episode: Sums, reward: Array, gamma: float | Array) -> Sums:
        return Sums(gamma * episode.discounted + reward, episode.total + reward, episode.count + 1)

    def observe(self, memory: LargestReturns, steps: Transition) -> LargestReturns:
        sums: Sums = steps.memory
        cut = steps.cut & (steps.discount > 0)
        mean = jnp.where(cut, sums.total / sums.count, 0.0)
        largest = lambda old, new: jnp.maximum(old, jnp.max(jnp.abs(new), axis=1))
        return LargestReturns(largest(memory.discounted, sums.discounted), largest(memory.reward, mean))

    def units(self, memory: LargestReturns, gamma: Array, bonus: Array) -> tuple[Array, Array]:
        horizon = 1 / (1 - gamma)
        largest = jnp.maximum(memory.discounted, horizon * memory.reward)
        known = largest > 0
        factor = self.return_range / jnp.where(known, largest + horizon * bonus, 1.0)
        return jnp.where(known, factor, 1.0), jnp.zeros_like(largest)


class SpreadOfReturns(NamedTuple):
    """Holds the moments of discounted returns, and the largest so far."""

    moments: normalize.Moments  # count (T,), mean (T,), deviation (T,)
    largest: Array  # (T,) largest |discounted sum of rewards|


@dataclasses.dataclass(frozen=True)
class ReturnNormalization(NoScaling):
    """Divides by the standard deviation of the task's discounted returns, and keeps these in a range (SimbaV2).

    With G_t = r_t + gamma G_(t-1) from the start of an episode, as Lee et al. (2025, "Hyperspherical normalization"):
        factor = 1 / max(std(G), max |G| / range)
    over all steps of training so far. Before there is any reward the factor is 1.

    Differs from the authors' code: every task has its own statistics; G begins at 0 in every episode and counts up to
    its last step, where there the last step's G is its reward alone, with which the next episode begins; no small
    number is added to the variance, as the range already bounds the factor. As there, the bonus of entropy has no room
    in the range.
    """

    return_range: float = 5.0
    """Largest |discounted sum of rewards so far| after scaling; with value=c51 or hl-gauss, the range of their bins."""

    def __post_init__(self):
        parts.require_positive(self, "return_range")

    def begin(self) -> Array:
        return jnp.float32(0)

    def remember(self, episode: Array, reward: Array, gamma: float | Array) -> Array:
        return gamma * episode + reward

    def init(self, num_tasks: int) -> SpreadOfReturns:
        zeros = jnp.zeros(num_tasks)
        return SpreadOfReturns(normalize.Moments(zeros, zeros, zeros), zeros)

    def observe(self, memory: SpreadOfReturns, steps: Transition) -> SpreadOfReturns:
        returns = steps.memory  # (T, N)
        largest = jnp.maximum(memory.largest, jnp.max(jnp.abs(returns), axis=1))
        return SpreadOfReturns(normalize.update(memory.moments, returns.T), largest)

    def units(self, memory: SpreadOfReturns, gamma: Array, bonus: Array) -> tuple[Array, Array]:
        variance = memory.moments.deviation / jnp.maximum(memory.moments.count, 1)
        divisor = jnp.maximum(jnp.sqrt(variance), memory.largest / self.return_range)
        return 1 / jnp.where(divisor > 0, divisor, 1.0), jnp.zeros_like(divisor)
