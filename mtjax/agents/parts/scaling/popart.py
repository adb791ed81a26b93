"""PopArt scales by the critics' targets."""

import dataclasses
from functools import partial
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import Params
from mtjax.agents.parts.scaling.base import Moments, NoScaling
from mtjax.types import Array, Transition


class Estimates(NamedTuple):
    """Holds the moments of targets, and before there are any the mean square of rewards in their place."""

    mean: Array  # (T,)
    variance: Array  # (T,)
    square: Array  # (T,) of the rewards before learning
    count: Array  # (T,) of these rewards
    learns: Array  # (T,) bool: there have been targets


@dataclasses.dataclass(frozen=True)
class PopArt(NoScaling):
    """Scales values to mean 0 and deviation 1 of the task's targets (van Hasselt et al. 2016, "Pop-Art").

    With moving estimates m and s of targets y, critics fit (y - m) / s; when the estimates move, the heads of critics
    and of target critics are rescaled so that m + s head(x) does not change (there, algorithm 1; per task as in Hessel
    et al. 2019):
        m' = m + b (mean(y) - m),  s'^2 = (1 - b) s^2 + b var(y) + b (1 - b) (mean(y) - m)^2
        kernel' = kernel s / s',  bias' = (s bias + m - m') / s'
    The paper's moving second moment is written here as a variance, which rounding cannot make negative. As in Hessel et
    al., b = 3e-4, and s is clipped to [1e-4, 1e6]. The actor's loss uses the scaled values, so that all tasks have one
    scale; temperatures are in these units too.

    Differs from the papers: at the start m = 0, and s is the root of the mean square of the task's rewards before
    learning, or 1 without such rewards, where there it is 1. So tasks are learned alike from the first update on,
    whatever the scale of their rewards; from 1 to 0.01 estimates would take 30,000 updates. An update uses the units
    from before it, and each batch of a task's targets is one step of the estimates. Adam's moments of the heads are not
    rescaled.
    """

    rescales: ClassVar[bool] = True
    target_rate: float = 3e-4
    """Weight of a new batch in the moving estimates of targets' mean and variance."""

    def __post_init__(self):
        parts.require_rates(self, "target_rate")

    def init(self, num_tasks: int) -> Estimates:
        none = jnp.zeros(num_tasks)
        return Estimates(*Moments.begin(num_tasks), none, none, jnp.zeros(num_tasks, bool))

    def observe(self, memory: Estimates, steps: Transition) -> Estimates:
        """Set the first units by the rewards before learning; after that, targets alone move them."""
        added = steps.reward.shape[1]
        count = memory.count + added
        drift = jnp.mean(jnp.square(steps.reward), axis=1) - memory.square
        square = memory.square + drift * added / count
        new = memory._replace(square=square, count=count, variance=jnp.where(square > 0, square, memory.variance))
        return jax.tree.map(partial(jnp.where, memory.learns), memory, new)

    @staticmethod
    def std(memory: Estimates) -> Array:
        """Return the standard deviation (T,) that divides targets."""
        return jnp.clip(jnp.sqrt(memory.variance), 1e-4, 1e6)

    def units(self, memory: Estimates, gamma: Array, bonus: Array) -> tuple[Array, Array]:
        return 1 / self.std(memory), memory.mean

    def renew(self, memory: Estimates, target: Array, critics: tuple[Params, ...]):
        std = self.std(memory)
        drift = std * jnp.mean(target, axis=1)  # of the old mean, in reward
        moments = Moments(memory.mean, memory.variance)
        moments = moments.moved(self.target_rate, drift, jnp.square(std) * jnp.var(target, axis=1))
        new = memory._replace(**moments._asdict(), learns=jnp.ones_like(memory.learns))
        factor = std / self.std(new)
        offset = (memory.mean - new.mean) / self.std(new)  # by as much as the mean moved, rounding included
        return new, tuple(rescale_heads(critic, factor, offset) for critic in critics)


def rescale_heads(critic: Params, factor: Array, offset: Array) -> Params:
    """Change the outputs of every task's own heads by a factor and an offset (T,)."""
    head = critic.own["head"]  # kernel (T, ..., D, 1), bias (T, ..., 1)
    each = lambda x, like: x.reshape(-1, *[1] * (like.ndim - 1))
    kernel = each(factor, head["kernel"]) * head["kernel"]
    bias = each(factor, head["bias"]) * head["bias"] + each(offset, head["bias"])
    return Params(critic.shared, {**critic.own, "head": {"kernel": kernel, "bias": bias}})
