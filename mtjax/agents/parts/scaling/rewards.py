"""Scalings by the rewards of single steps."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import Params
from mtjax.agents.parts.scaling.base import Moments, NoScaling
from mtjax.types import Array, Transition


@dataclasses.dataclass(frozen=True)
class RewardScaling(NoScaling):
    """Divides by a moving estimate of the standard deviation of the task's rewards (as in MTEnv and garage).

    For each reward r, with rate a: mean = (1 - a) mean + a r, then variance = (1 - a) variance + a (r - mean)^2,
    beginning at 0 and 1. The E rewards of a step are one update, at the rate 1 - (1 - a)^E of E updates in sequence.

    Differs from MTEnv: an update scales rewards by the latest estimate; MTEnv stores, and reports, rewards scaled by
    the estimate of the time.
    """

    variance_rate: float = 1e-3
    """Weight of a new reward in the moving estimate of the rewards' variance."""

    def __post_init__(self):
        parts.require_rates(self, "variance_rate")

    def init(self, num_tasks: int) -> Moments:
        return Moments.begin(num_tasks)

    def observe(self, memory: Moments, steps: Transition) -> Moments:
        rate = 1 - (1 - self.variance_rate) ** steps.reward.shape[1]
        mean = memory.mean + rate * (jnp.mean(steps.reward, axis=1) - memory.mean)
        variance_now = jnp.mean(jnp.square(steps.reward - mean[:, None]), axis=1)
        return Moments(mean, memory.variance + rate * (variance_now - memory.variance))

    def units(self, memory: Moments, gamma: Array, bonus: Array) -> tuple[Array, Array]:
        return 1 / (jnp.sqrt(memory.variance) + 1e-8), jnp.zeros_like(memory.mean)


class MeanRewards(NamedTuple):
    """Holds mean rewards so far, and the factors in use."""

    count: Array  # (T,) number of rewards
    mean: Array  # (T,) of all rewards
    factor: Array  # (T,) that the present networks learn with; 0 before they begin to learn


@dataclasses.dataclass(frozen=True)
class AdaptiveScaling(NoScaling):
    """Scales all tasks' mean rewards to the largest one, anew at each reset of networks (Cho et al. 2025, "ARS").

    With r_i the task's mean reward so far, and at least 0.01, factor_i = max_j r_j / r_i. Factors are set when learning
    begins and whenever networks are reset, as critics cannot follow rewards whose scale changes. So it needs
    ``--reset-every``: its authors reset 4 times in a run on MT10 and 6 times on MT50.

    Differs from the authors' code: means are over all rewards so far, where theirs are over the replay; no extra
    updates follow a reset (there, 1000); where no task has a mean reward of 0.01, factors are 1.
    """

    follows_resets = True
    least_mean_reward: float = 0.01
    """Lower bound of mean rewards, which limits how much a task's rewards are scaled up."""

    def __post_init__(self):
        parts.require_positive(self, "least_mean_reward")

    def init(self, num_tasks: int) -> MeanRewards:
        return MeanRewards(jnp.zeros(num_tasks), jnp.zeros(num_tasks), jnp.zeros(num_tasks))

    def observe(self, memory: MeanRewards, steps: Transition) -> MeanRewards:
        added = steps.reward.shape[1]
        count = memory.count + added
        drift = jnp.mean(steps.reward, axis=1) - memory.mean
        return memory._replace(count=count, mean=memory.mean + drift * added / count)

    def factors(self, memory: MeanRewards) -> Array:
        """Return the factors (T,) in use; before learning begins, those of the means so far."""
        means = jnp.maximum(memory.mean, self.least_mean_reward)
        return jnp.where(memory.factor > 0, memory.factor, jnp.max(means) / means)

    def units(self, memory: MeanRewards, gamma: Array, bonus: Array) -> tuple[Array, Array]:
        return self.factors(memory), jnp.zeros_like(memory.mean)

    def renew(self, memory: MeanRewards, target: Array, critics: tuple[Params, ...]):
        return memory._replace(factor=self.factors(memory)), critics

    def reset(self, memory: MeanRewards) -> MeanRewards:
        return memory._replace(factor=jnp.zeros_like(memory.factor))
