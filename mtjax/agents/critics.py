"""The critic of states of an agent that learns from rollouts: its values, and the units in which it has them."""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.networks import Params
from mtjax.agents.parts.scaling.base import Moments
from mtjax.agents.parts.scaling.popart import rescale_heads
from mtjax.agents.rates import discounts_of_all
from mtjax.agents.state import AgentState, over_tasks
from mtjax.parallel.axes import in_parts
from mtjax.parallel.collectives import mean_and_variance
from mtjax.types import Array, Metrics, Task, Transition

MIN_STD = 1e-4
"""Lower bound of standard deviations that divide."""


class Units(NamedTuple):
    """Holds the units of the critic's outputs, by task: a value is mean + std times an output."""

    count: Array  # (T,) how often they have moved; () where that is the same for all
    moments: Moments  # of targets, (T,)

    @staticmethod
    def begin(num_tasks: int) -> "Units":
        """Return units in which outputs are values."""
        return Units(jnp.zeros(num_tasks), Moments.begin(num_tasks))

    @staticmethod
    def of(state: AgentState) -> "Units":
        """Return the units that a state holds.

        Where a curriculum plays some of the tasks, each has a count of its own, so that it begins with its first
        targets. All tasks have one: with a rate for each XLA would round otherwise.
        """
        units: Units = state.nets["units"].own
        some = len(units.count) < state.num_tasks
        return units if some else units._replace(count=jnp.min(units.count))

    def params(self) -> Params:
        """Return the units as a network of the agent's."""
        return Params({}, self._replace(count=jnp.broadcast_to(self.count, self.moments.mean.shape)))

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
            rate: weight of these targets; the first ones of a task have equal weights.
        """
        rate = jnp.maximum(rate, 1 / (self.count + 1))
        mean, variance = (x[:, 0] for x in mean_and_variance(target, 1))
        return Units(self.count + 1, self.moments.moved(rate, mean - self.moments.mean, variance))

    def change(self, new: "Units") -> tuple[Array, Array]:
        """Return by which factor and offset (T,) outputs change in new units, if values do not.

        A task's first units change nothing: before them, its outputs stand for no values.
        """
        known = self.count > 0
        offset = (self.moments.mean - new.moments.mean) / new.std
        return jnp.where(known, self.std / new.std, 1.0), jnp.where(known, offset, 0.0)


def models(agent: Any, state: AgentState, flat: Transition, tasks: Task, next_obs: Any) -> dict[str, Any]:
    """Return what a representation that learns needs in a batch: actions, rewards and next observations, by name."""
    if not agent.representation.learns:
        return {}
    return {
        "action": agent.policy.encode(flat.action),
        "reward": rewards(agent, state, flat, tasks),
        "next_obs": next_obs,
    }


def rewards(agent: Any, state: AgentState, flat: Transition, tasks: Task) -> Array:
    """Return the rewards (T, N) of steps in the task's units."""
    most = parts.limit(agent.reward_clip)
    flat = flat if most is None else flat._replace(reward=jnp.clip(flat.reward, -most, most))
    gamma = discounts_of_all(agent, tasks)
    return agent.reward_scale * agent.scaling.rewards(state.nets["scaling"].own, flat, gamma, jnp.zeros(len(gamma)))


def values(agent: Any, state: AgentState, features: Array, obs: Any) -> Array:
    """Return the critic's values (T, B) of observations (T, B, ...), in units of reward."""
    return Units.of(state).rewards(outputs(agent, state, features, obs))


def outputs(agent: Any, state: AgentState, features: Array, obs: Any) -> Array:
    """Return the critic's outputs (T, B) for observations (T, B, ...)."""
    return over_rollout(agent.output, agent, state, features, obs)


def over_rollout(function: Any, agent: Any, state: AgentState, features: Array, obs: Any) -> Array:
    """Map a function of one task's networks over the observations (T, B, ...) of a rollout; pictures in parts of B."""
    of_tasks = partial(over_tasks, function, state.nets)
    if frames.shown(obs):  # all at once they would fill the memory
        return in_parts(of_tasks, features, obs, agent.experience.minibatches)
    return of_tasks(features, obs)


def renew(agent: Any, state: AgentState, target: Array) -> tuple[AgentState, Units]:
    """Move the critic's units by targets (T, ...), and with PopArt rescale its heads to them."""
    target, old = target.reshape(len(target), -1), Units.of(state)
    if agent.value_normalization == "none":
        return state, old
    new = old.moved(target, agent.value_rate)
    if agent.value_normalization == "popart":
        state = state.with_nets(critic=rescale_heads(state.nets["critic"], *old.change(new)))
    return state.with_nets(units=new.params()), new


def explained(state: AgentState, batch: Any) -> Metrics:
    """Return the mean value (T,) of steps, and which share of the variance of targets values explained."""
    target = Units.of(state).rewards(batch.target)
    residual, whole = (mean_and_variance(x, 1)[1][:, 0] for x in (target - batch.value, target))
    share = 1 - residual / jnp.maximum(whole, MIN_STD**2)
    return {"value": mean_and_variance(batch.value, 1)[0][:, 0], "explained_variance": share}
