"""Scales of rewards: tasks that pay in different coin, brought to one.

A scaling gives every task units of its own in which critics count: a value v is learned as factor (v - offset), so a
reward r before a discount d is learned from as factor (r - (1 - d) offset). Temperatures are in these units too. What
it remembers of training data is part of the agent's state, so it is checkpointed; evaluation leaves it as it is.
Replayed rewards are raw and scaled when they are learned from, all by the latest statistics; logged returns are raw.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.networks import Params
from mtjax.types import Array, Outcome, Transition


@dataclasses.dataclass(frozen=True)
class NoScaling(parts.Watcher):
    """Rewards as they are. Every scaling is a class like this one."""

    def units(self, memory: Any, gamma: float | Array, bonus: Array) -> tuple[Array, Array] | None:
        """Each task's factor and offset (T,); None for 1 and 0.

        Args:
            bonus: (T,) or (1,), half of what the target entropy is worth in a step.
        """
        return None

    def rewards(self, memory: Any, batch: Transition, gamma: float | Array, bonus: Array) -> Array:
        """The rewards (T, B) of a batch in each task's units; ``gamma`` is () or (T,)."""
        units = self.units(memory, gamma, bonus)
        if units is None:
            return batch.reward
        factor, offset = (x[:, None] for x in units)
        gamma = gamma[:, None] if jnp.ndim(gamma) else gamma  # type: ignore
        return factor * (batch.reward - (1 - gamma * batch.discount) * offset)

    def begin(self) -> Any:
        """What is remembered of an episode that begins; None for nothing."""
        return None

    def remember(self, memory: Any, reward: Array, gamma: float | Array) -> Any:
        """What is remembered of an episode after a step of it."""
        return memory

    def renew(self, memory: Any, target: Array, critics: tuple[Params, ...]) -> tuple[Any, tuple[Params, ...]]:
        """Take note of the targets (T, B) of an update that is done, and bring critics to the new units."""
        return memory, critics

    def reset(self, memory: Any) -> Any:
        """The memory with which new networks begin to learn."""
        return memory


class Moments(NamedTuple):
    """Of rewards or of targets, from 0 and 1."""

    mean: Array  # (T,)
    variance: Array  # (T,)

    @staticmethod
    def begin(num_tasks: int) -> "Moments":
        return Moments(jnp.zeros(num_tasks), jnp.ones(num_tasks))


@dataclasses.dataclass(frozen=True)
class RewardScaling(NoScaling):
    """Divide by the standard deviation of the task's rewards, a moving estimate (as in MTEnv, and garage before it).

    For each reward r, with rate a: mean = (1 - a) mean + a r, then variance = (1 - a) variance + a (r - mean)^2,
    beginning at 0 and 1. The E rewards of a step are taken in at once, at the rate 1 - (1 - a)^E of E in a row.

    Differs from MTEnv: rewards are scaled by the latest estimate when they are learned from; MTEnv stores them scaled
    by that of the time, and reports returns so.
    """

    watches = True
    variance_rate: float = 1e-3
    """Share of a new reward in the moving estimate of the rewards' variance."""

    def __post_init__(self):
        parts.require_rates(self, "variance_rate")

    def init(self, num_tasks: int) -> Moments:
        return Moments.begin(num_tasks)

    def observe(self, memory: Moments, outcome: Outcome) -> Moments:
        rate = 1 - (1 - self.variance_rate) ** outcome.reward.shape[1]
        mean = memory.mean + rate * (jnp.mean(outcome.reward, axis=1) - memory.mean)
        variance_now = jnp.mean(jnp.square(outcome.reward - mean[:, None]), axis=1)
        return Moments(mean, memory.variance + rate * (variance_now - memory.variance))

    def units(self, memory: Moments, gamma: float | Array, bonus: Array) -> tuple[Array, Array]:
        return 1 / (jnp.sqrt(memory.variance) + 1e-8), jnp.zeros_like(memory.mean)


class LargestReturns(NamedTuple):
    discounted: Array  # (T,) largest size of a discounted sum of rewards
    reward: Array  # (T,) largest size of an episode's mean reward, of those cut off by a time limit


@dataclasses.dataclass(frozen=True)
class ReturnScaling(NoScaling):
    """Divide so that the task's largest discounted return just fits a range (BRC; Nauman et al. 2025).

    With G the largest size of a return so far, horizon h = 1 / (1 - gamma), temperature a and target entropy H, the
    factor is range / (G + h a |H| / 2), the second term leaving room for the bonus of entropy.

    Differs from the authors' code, which keeps whole episodes and takes G over the return from every step, adding h
    times the episode's mean reward beyond a time limit: here G is the largest of the sums that discount backwards,
    r_t + gamma r_(t-1) + ..., which need no memory of the episode (for rewards of one size it is the same), and of
    h times the mean reward of an episode that a time limit cut off. Before there is any reward the factor is 1.
    """

    watches = True
    return_range: float = 10.0
    """Largest size of a discounted return once scaled; with value=c51 or hl-gauss, the range of their bins."""

    def __post_init__(self):
        parts.require_positive(self, "return_range")

    def init(self, num_tasks: int) -> LargestReturns:
        return LargestReturns(jnp.zeros(num_tasks), jnp.zeros(num_tasks))

    def begin(self) -> Array:
        """The sum of the episode's rewards so far, each discounted once more at every later step."""
        return jnp.float32(0)

    def remember(self, memory: Array, reward: Array, gamma: float | Array) -> Array:
        return gamma * memory + reward

    def observe(self, memory: LargestReturns, outcome: Outcome) -> LargestReturns:
        cut = outcome.ended & ~outcome.terminated
        mean = jnp.where(cut, outcome.total / outcome.age, 0.0)
        largest = lambda old, new: jnp.maximum(old, jnp.max(jnp.abs(new), axis=1))
        return LargestReturns(largest(memory.discounted, outcome.memory.scaling), largest(memory.reward, mean))

    def units(self, memory: LargestReturns, gamma: float | Array, bonus: Array) -> tuple[Array, Array]:
        horizon = 1 / (1 - gamma)
        largest = jnp.maximum(memory.discounted, horizon * memory.reward)
        known = largest > 0
        factor = self.return_range / jnp.where(known, largest + horizon * bonus, 1.0)
        return jnp.where(known, factor, 1.0), jnp.zeros_like(largest)


@dataclasses.dataclass(frozen=True)
class PopArt(NoScaling):
    """Count values in standard deviations of the task's targets from their mean (van Hasselt et al. 2016, "Pop-Art").

    With moving estimates m and s of targets y, critics fit (y - m) / s; when the estimates move, the heads of critics
    and of their slow copies follow so that m + s head(x) stays as it was (there, algorithm 1; per task as in Hessel et
    al. 2019):
        m' = m + b (mean(y) - m),  s'^2 = (1 - b) s^2 + b var(y) + b (1 - b) (mean(y) - m)^2
        kernel' = kernel s / s',  bias' = (s bias + m - m') / s'
    where the second moment's moving estimate is written as the variance's, which rounding cannot make negative. As for
    Hessel et al., b = 3e-4 and s lies between 1e-4 and 1e6, from m = 0 and s = 1. The actor follows the scaled values,
    so that tasks count alike, and the temperature, being in these units, is worth s in reward.

    Differs from the papers: an update learns in the units of the one before it, and its batch of a task's targets is
    one step of the estimates. Adam's memory of the heads is not rescaled.
    """

    target_rate: float = 3e-4
    """Share of a new batch in the moving estimates of targets' mean and variance."""

    def __post_init__(self):
        parts.require_rates(self, "target_rate")

    def init(self, num_tasks: int) -> Moments:
        return Moments.begin(num_tasks)

    @staticmethod
    def std(memory: Moments) -> Array:
        """The standard deviation (T,) by which targets are divided."""
        return jnp.clip(jnp.sqrt(memory.variance), 1e-4, 1e6)

    def units(self, memory: Moments, gamma: float | Array, bonus: Array) -> tuple[Array, Array]:
        return 1 / self.std(memory), memory.mean

    def renew(self, memory: Moments, target: Array, critics: tuple[Params, ...]):
        rate, std = self.target_rate, self.std(memory)
        drift = std * jnp.mean(target, axis=1)  # of the old mean, in reward
        variance_now = jnp.square(std) * jnp.var(target, axis=1)
        variance = (1 - rate) * memory.variance + rate * variance_now + rate * (1 - rate) * jnp.square(drift)
        new = Moments(memory.mean + rate * drift, variance)
        ratio = std / self.std(new)
        shift = (new.mean - memory.mean) / self.std(new)  # by as much as the mean moved, rounding included

        def adapt(params: Params) -> Params:
            head = params.own["head"]  # kernel (T, N, D, 1), bias (T, N, 1)
            kernel = ratio[:, None, None, None] * head["kernel"]
            bias = ratio[:, None, None] * head["bias"] - shift[:, None, None]
            return Params(params.shared, {**params.own, "head": {"kernel": kernel, "bias": bias}})

        return new, tuple(adapt(params) for params in critics)


class MeanRewards(NamedTuple):
    count: Array  # (T,) rewards seen
    mean: Array  # (T,) of all rewards
    factor: Array  # (T,) with which the present networks learn; 0 until they begin to


@dataclasses.dataclass(frozen=True)
class AdaptiveScaling(NoScaling):
    """Bring all tasks to the mean reward of the best paid, and stay until networks are reset (Cho et al. 2025, "ARS").

    With r_i the task's mean reward so far, factor_i = max_j r_j / r_i, r being 0.01 at least. Factors are set when
    learning begins and whenever the networks begin anew, as critics cannot follow rewards whose scale moves. So it
    wants ``--reset-every``: its authors reset 4 times in a run on MT10 and 6 times on MT50, that is after every fifth
    or seventh of the run.

    Differs from the authors' code: means are over all rewards so far, of which theirs forgets those that the replay
    has dropped; no extra updates follow a reset (there, 1000); where no task has a mean reward of 0.01, factors are 1.
    """

    watches = True
    least_mean_reward: float = 0.01
    """Mean rewards below this are taken for it, which bounds how much a task's rewards are scaled up."""

    def __post_init__(self):
        parts.require_positive(self, "least_mean_reward")

    def init(self, num_tasks: int) -> MeanRewards:
        return MeanRewards(jnp.zeros(num_tasks), jnp.zeros(num_tasks), jnp.zeros(num_tasks))

    def observe(self, memory: MeanRewards, outcome: Outcome) -> MeanRewards:
        added = outcome.reward.shape[1]
        count = memory.count + added
        drift = jnp.mean(outcome.reward, axis=1) - memory.mean
        return memory._replace(count=count, mean=memory.mean + drift * added / count)

    def factors(self, memory: MeanRewards) -> Array:
        """The factors (T,) of the present networks; of ones that are about to learn, those by the means so far."""
        means = jnp.maximum(memory.mean, self.least_mean_reward)
        return jnp.where(memory.factor > 0, memory.factor, jnp.max(means) / means)

    def units(self, memory: MeanRewards, gamma: float | Array, bonus: Array) -> tuple[Array, Array]:
        return self.factors(memory), jnp.zeros_like(memory.mean)

    def renew(self, memory: MeanRewards, target: Array, critics: tuple[Params, ...]):
        return memory._replace(factor=self.factors(memory)), critics

    def reset(self, memory: MeanRewards) -> MeanRewards:
        return memory._replace(factor=jnp.zeros_like(memory.factor))


Scaling = NoScaling
SCALINGS: dict[str, type[Scaling]] = {
    "none": NoScaling,
    "reward": RewardScaling,
    "return": ReturnScaling,
    "popart": PopArt,
    "ars": AdaptiveScaling,
}
