"""Samplers of tasks weigh the tasks' losses in an update.

Every task has the same number of transitions in a batch, as shapes are fixed. To sample a task twice as often is to
weigh its losses by two: the same in expectation, and less noisy.
"""

import dataclasses
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.watching import Watcher
from mtjax.types import Array, InputError, Transition


@dataclasses.dataclass(frozen=True)
class Uniform:
    """Weighs all tasks equally. Every sampler is a class with these methods."""

    by_temperature: ClassVar[bool] = False  # whether it weighs tasks by the temperatures that SAC has
    init, begin, remember, observe = Watcher.init, Watcher.begin, Watcher.remember, Watcher.observe

    def weights(self, memory: Any, temperature: Array) -> Array | None:
        """Return the weights (T,) of the tasks' losses, of mean 1; None for all 1. ``temperature`` (T,) is SAC's."""
        return None


def share_out(shares: Array, least_weight: float) -> Array:
    """Return weights (T,) of mean 1, at least ``least_weight`` each, from shares (T,) that sum to one."""
    return least_weight + (1 - least_weight) * len(shares) * shares


class Returns(NamedTuple):
    """Holds moving means (T,) of episodes' returns; they are valid for tasks that have ended an episode."""

    known: Array  # (T,) bool: the task has ended an episode
    fast: Array
    slow: Array


# Methods of the samplers that weigh tasks by returns. Of an episode they keep the sum of rewards so far.


def _no_returns(self: Uniform, num_tasks: int) -> Returns:
    return Returns(jnp.zeros(num_tasks, bool), jnp.zeros(num_tasks), jnp.zeros(num_tasks))


def _no_reward(self: Uniform) -> Array:
    return jnp.float32(0)


def _add_reward(self: Uniform, episode: Array, reward: Array, gamma: float | Array) -> Array:
    return episode + reward


def _follow(memory: Returns, steps: Transition, fast: float, slow: float) -> Returns:
    """Move the means towards the returns of ended episodes, at rates per episode; a task's first ones set them."""
    count = jnp.sum(steps.closed, axis=1)
    mean = jnp.sum(jnp.where(steps.closed, steps.memory, 0.0), axis=1) / jnp.maximum(count, 1)

    def moved(old: Array, rate: float) -> Array:
        return jnp.where(memory.known, old + (1 - (1 - rate) ** count) * (mean - old), mean)

    return Returns(memory.known | (count > 0), moved(memory.fast, fast), moved(memory.slow, slow))


@dataclasses.dataclass(frozen=True)
class Progress(Uniform):
    """Gives more weight to tasks whose return changes, up or down (learning progress; Matiisen et al. 2017).

    Progress is |fast - slow| / max(|fast|, |slow|), for two moving means of the task's returns at different rates, and
    the shares are proportional to it. A task that has ended no episode has the mean progress of the others.

    Differs from the paper, where the slope of returns decides which single task is trained next. (T3S, Yu et al. 2023,
    does the opposite: its scheduler favours tasks that progress slowly.)
    """

    least_weight: float = 0.1
    """Weight that every task has at least; the rest is divided by the sampler. 1 weighs all tasks equally."""
    progress_fast: float = 0.1
    """Weight of a new episode in the fast mean of returns."""
    progress_slow: float = 0.01
    """Weight of a new episode in the slow mean of returns."""

    def __post_init__(self):
        parts.require_shares(self, "least_weight")
        if not 0 < self.progress_slow < self.progress_fast <= 1:
            raise InputError(
                "progress-slow must be below progress-fast, both in (0, 1], "
                f"not {self.progress_slow} and {self.progress_fast}"
            )

    init, begin, remember = _no_returns, _no_reward, _add_reward

    def observe(self, memory: Returns, steps: Transition) -> Returns:
        return _follow(memory, steps, self.progress_fast, self.progress_slow)

    def weights(self, memory: Returns, temperature: Array) -> Array:
        size = jnp.maximum(jnp.abs(memory.fast), jnp.abs(memory.slow))
        progress = jnp.abs(memory.fast - memory.slow) / jnp.where(size > 0, size, 1.0)
        average = jnp.sum(progress * memory.known) / jnp.maximum(jnp.sum(memory.known), 1)
        progress = jnp.where(memory.known, progress, average)
        total = jnp.sum(progress)
        shares = jnp.where(total > 0, progress / jnp.where(total > 0, total, 1.0), 1 / len(progress))
        return share_out(shares, self.least_weight)


@dataclasses.dataclass(frozen=True)
class Hardest(Uniform):
    """Gives more weight to tasks of low return: shares are softmax(-hardness z), z the standardised returns.

    z is a moving mean of each task's returns minus the tasks' mean, over their standard deviation; 0 for a task that
    has ended no episode. It compares returns between tasks, so rewards of all tasks should have one scale.
    """

    least_weight: float = 0.1
    """Weight that every task has at least; the rest is divided by the sampler. 1 weighs all tasks equally."""
    hardness: float = 1.0
    """How strongly low returns raise a task's weight; 0 weighs all tasks equally."""
    return_rate: float = 0.1
    """Weight of a new episode in the moving mean of returns."""

    def __post_init__(self):
        parts.require_shares(self, "least_weight")
        if not self.hardness >= 0 or not 0 < self.return_rate <= 1:
            raise InputError(
                f"hardness must be at least 0 and return-rate in (0, 1], not {self.hardness} and {self.return_rate}"
            )

    init, begin, remember = _no_returns, _no_reward, _add_reward

    def observe(self, memory: Returns, steps: Transition) -> Returns:
        return _follow(memory, steps, self.return_rate, self.return_rate)

    def weights(self, memory: Returns, temperature: Array) -> Array:
        count = jnp.maximum(jnp.sum(memory.known), 1)
        from_mean = jnp.where(memory.known, memory.slow - jnp.sum(memory.slow * memory.known) / count, 0.0)
        std = jnp.sqrt(jnp.sum(jnp.square(from_mean)) / count)
        shares = jax.nn.softmax(-self.hardness * from_mean / jnp.where(std > 0, std, 1.0))
        return share_out(shares, self.least_weight)


class Curriculum(NamedTuple):
    """Holds how far a curriculum has come."""

    returns: Returns
    length: Array  # (T,) int32 of the tasks' sketches; 0 if they have none
    longest: Array  # (T,) int32, the same for all: of the sketches that take part


@dataclasses.dataclass(frozen=True)
class ByLength(Uniform):
    """Trains the tasks with short sketches first (the curriculum of Andreas et al. 2017).

    Tasks take part whose sketches have at most l symbols, at first as many as the shortest. Once the mean return r of
    each of them is above ``mastered``, l grows by 1. Shares are proportional to 1 - r + 0.01 for the tasks that take
    part, and 0 for others. Returns are those of success: from 0 to 1.

    Differs from the paper: r is a moving mean, where there it is the mean since l or the shares have changed; with a
    ``least_weight`` above 0, tasks learn a little before they take part. Agents without sketches have no others.
    """

    least_weight: float = 0.1
    """Weight that every task has at least; the rest is divided by the sampler. 1 weighs all tasks equally."""
    mastered: float = 0.8
    """Mean return of all tasks that take part above which longer sketches follow."""
    return_rate: float = 0.02
    """Weight of a new episode in the moving mean of returns."""

    def __post_init__(self):
        parts.require_shares(self, "least_weight", "mastered")
        parts.require_rates(self, "return_rate")

    begin, remember = _no_reward, _add_reward

    def init(self, num_tasks: int) -> Curriculum:
        none = jnp.zeros(num_tasks, jnp.int32)
        return Curriculum(_no_returns(self, num_tasks), none, none)

    def observe(self, memory: Curriculum, steps: Transition) -> Curriculum:
        returns = _follow(memory.returns, steps, self.return_rate, self.return_rate)
        longest = _present(memory)
        behind = (memory.length <= longest) & ~(returns.known & (returns.slow > self.mastered))
        return Curriculum(returns, memory.length, jnp.full_like(memory.longest, longest + ~jnp.any(behind)))

    def weights(self, memory: Curriculum, temperature: Array) -> Array:
        missing = 1 - jnp.where(memory.returns.known, jnp.clip(memory.returns.slow, 0.0, 1.0), 0.0) + 0.01
        shares = jnp.where(memory.length <= _present(memory), missing, 0.0)
        return share_out(shares / jnp.sum(shares), self.least_weight)


def _present(memory: Curriculum) -> Array:
    """Return the length () up to which sketches take part: some task always does.

    A task that a curriculum did not play for a while remembers an earlier one, so that the longest counts.
    """
    return jnp.clip(jnp.max(memory.longest), jnp.min(memory.length), jnp.max(memory.length))


@dataclasses.dataclass(frozen=True)
class ByTemperature(Uniform):
    """Gives more weight to tasks of low temperature, whose policies are certain (Yang et al. 2020).

    With a_i the tasks' temperatures, shares are softmax(-log a), that is (1 / a_i) / sum_j (1 / a_j), as in the
    authors' code and in MTRL. The paper writes softmax(-a), which is nearly uniform for temperatures below 1;
    ``certainty="temperature"`` computes that.

    Differs from the paper: every task has a least weight, as temperatures differ by orders of magnitude;
    ``least_weight=0`` removes it.
    """

    by_temperature: ClassVar[bool] = True
    least_weight: float = 0.1
    """Weight that every task has at least; the rest is divided by the sampler. 1 weighs all tasks equally."""
    certainty: Literal["log-temperature", "temperature"] = "log-temperature"
    """Take the softmax of the negative log temperatures (the authors' code) or negative temperatures (the paper)."""

    def __post_init__(self):
        parts.require_shares(self, "least_weight")

    def weights(self, memory: Any, temperature: Array) -> Array:
        score = temperature if self.certainty == "temperature" else jnp.log(temperature)
        return share_out(jax.nn.softmax(-score), self.least_weight)


Sampler = Uniform
SAMPLERS: dict[str, type[Sampler]] = {
    "uniform": Uniform,
    "progress": Progress,
    "hardest": Hardest,
    "by-length": ByLength,
    "temperature": ByTemperature,
}
