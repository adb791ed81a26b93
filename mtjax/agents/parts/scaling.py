"""Scalings bring the rewards of all tasks to one scale.

A scaling gives every task units of its own: critics learn a value v as factor (v - offset), and so a reward r with the
discount d as factor (r - (1 - d) offset). Temperatures are in these units too. A scaling's memory is part of the
agent's state, so it is checkpointed; evaluation does not change it. Stored rewards are raw, and are scaled by the
latest statistics when an update uses them; logged returns are raw.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.networks import Params
from mtjax.types import Array, Outcome, Transition


@dataclasses.dataclass(frozen=True)
class NoScaling(parts.Watcher):
    """Leaves rewards as they are. Every scaling is a class with these methods."""

    def units(self, memory: Any, gamma: float | Array, bonus: Array) -> tuple[Array, Array] | None:
        """Return each task's factor and offset (T,); None for 1 and 0.

        Args:
            bonus: (T,) or (1,), a |H| / 2: half of what the target entropy adds to the reward of a step.
        """
        return None

    def rewards(self, memory: Any, batch: Transition, gamma: float | Array, bonus: Array) -> Array:
        """Return the rewards (T, B) of a batch in each task's units; ``gamma`` is () or (T,)."""
        units = self.units(memory, gamma, bonus)
        if units is None:
            return batch.reward
        factor, offset = (x[:, None] for x in units)
        gamma = gamma[:, None] if jnp.ndim(gamma) else gamma  # type: ignore
        return factor * (batch.reward - (1 - gamma * batch.discount) * offset)

    def begin(self) -> Any:
        """Return the memory with which an episode begins; None for none."""
        return None

    def remember(self, memory: Any, reward: Array, gamma: float | Array) -> Any:
        """Return the memory of an episode after a step."""
        return memory

    def renew(self, memory: Any, target: Array, critics: tuple[Params, ...]) -> tuple[Any, tuple[Params, ...]]:
        """Update the memory by the targets (T, B) of an update, and rescale the critics to the new units."""
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


@dataclasses.dataclass(frozen=True)
class RewardScaling(NoScaling):
    """Divides by a moving estimate of the standard deviation of the task's rewards (as in MTEnv and garage).

    For each reward r, with rate a: mean = (1 - a) mean + a r, then variance = (1 - a) variance + a (r - mean)^2,
    beginning at 0 and 1. The E rewards of a step are one update, at the rate 1 - (1 - a)^E of E updates in sequence.

    Differs from MTEnv: an update scales rewards by the latest estimate; MTEnv stores, and reports, rewards scaled by
    the estimate of the time.
    """

    watches = True
    variance_rate: float = 1e-3
    """Weight of a new reward in the moving estimate of the rewards' variance."""

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
    """Holds the largest absolute values so far."""

    discounted: Array  # (T,) largest |discounted sum of rewards|
    reward: Array  # (T,) largest |mean reward| of an episode that a time limit cut off


@dataclasses.dataclass(frozen=True)
class ReturnScaling(NoScaling):
    """Divides so that the task's largest discounted return just fits a range (BRC; Nauman et al. 2025).

    With G the largest |return| so far, horizon h = 1 / (1 - gamma), temperature a and target entropy H, the
    factor is range / (G + h a |H| / 2); the second term leaves room for the bonus of entropy.

    Differs from the authors' code, which keeps whole episodes, and takes G over the return from every step, plus h
    times the episode's mean reward beyond a time limit. Here G is the larger of two: the
    largest sum that discounts backwards, r_t + gamma r_(t-1) + ..., which needs no whole episodes and is the same for
    constant rewards; and h times the mean reward of an episode that a time limit cut off. Before there is any reward
    the factor is 1.
    """

    watches = True
    return_range: float = 10.0
    """Largest |discounted return| after scaling; with value=c51 or hl-gauss, the range of their bins."""

    def __post_init__(self):
        parts.require_positive(self, "return_range")

    def init(self, num_tasks: int) -> LargestReturns:
        return LargestReturns(jnp.zeros(num_tasks), jnp.zeros(num_tasks))

    def begin(self) -> Array:
        """Return 0, the backwards discounted sum r_t + gamma r_(t-1) + ... before the first reward."""
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
    """Scales values to mean 0 and deviation 1 of the task's targets (van Hasselt et al. 2016, "Pop-Art").

    With moving estimates m and s of targets y, critics fit (y - m) / s; when the estimates move, the heads of critics
    and of target critics are rescaled so that m + s head(x) does not change (there, algorithm 1; per task as in Hessel
    et al. 2019):
        m' = m + b (mean(y) - m),  s'^2 = (1 - b) s^2 + b var(y) + b (1 - b) (mean(y) - m)^2
        kernel' = kernel s / s',  bias' = (s bias + m - m') / s'
    The paper's moving second moment is written here as a variance, which rounding cannot make negative. As in Hessel et
    al., b = 3e-4, s is clipped to [1e-4, 1e6], and m = 0 and s = 1 at the start. The actor's loss uses the scaled
    values, so that all tasks have one scale; temperatures are in these units too.

    Differs from the papers: an update uses the units from before it, and each batch of a task's targets is one step of
    the estimates. Adam's moments of the heads are not rescaled.
    """

    target_rate: float = 3e-4
    """Weight of a new batch in the moving estimates of targets' mean and variance."""

    def __post_init__(self):
        parts.require_rates(self, "target_rate")

    def init(self, num_tasks: int) -> Moments:
        return Moments.begin(num_tasks)

    @staticmethod
    def std(memory: Moments) -> Array:
        """Return the standard deviation (T,) that divides targets."""
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
    """Holds mean rewards so far, and the factors in use."""

    count: Array  # (T,) number of rewards
    mean: Array  # (T,) of all rewards
    factor: Array  # (T,) that the present networks learn with; 0 before they begin to learn


@dataclasses.dataclass(frozen=True)
class AdaptiveScaling(NoScaling):
    """Scales all tasks' mean rewards to the largest one, anew at each reset of networks (Cho et al. 2025, "ARS").

    With r_i the task's mean reward so far, and at least 0.01, factor_i = max_j r_j / r_i. Factors are set when learning
    begins and whenever networks are reset, as critics cannot follow rewards whose scale changes. So use it with
    ``--reset-every``: its authors reset 4 times in a run on MT10 and 6 times on MT50.

    Differs from the authors' code: means are over all rewards so far, where theirs are over the replay; no extra
    updates follow a reset (there, 1000); where no task has a mean reward of 0.01, factors are 1.
    """

    watches = True
    least_mean_reward: float = 0.01
    """Lower bound of mean rewards, which limits how much a task's rewards are scaled up."""

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
        """Return the factors (T,) in use; before learning begins, those of the means so far."""
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
