"""Learning from a rollout's advantages by a clipped ratio of policies: what PPO and agents like it do alike."""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import critics
from mtjax.agents.critics import MIN_STD, Units
from mtjax.agents.on_policy import OnPolicy
from mtjax.agents.parts import targets
from mtjax.agents.rates import discounts_of_all
from mtjax.agents.state import AgentState
from mtjax.experience.rollouts import played, windows
from mtjax.parallel.collectives import mean_and_variance
from mtjax.types import Array, Metrics, Task, Transition

Normalization = Literal["none", "all", "task"]


class Assessed(NamedTuple):
    """Holds what is stored with an action once the rollout is over."""

    raw: Array  # the action as ``policy.log_prob`` takes it: before the tanh (A,), or () int32
    log_prob: Array  # () its log-probability under the policy that took it
    advantage: Array  # (), normalised
    value: Array  # () of the state before the action, in units of reward
    output: Array  # () the critic's output before the update, in the new units
    target: Array  # () what the critic's output should be


def assess(
    agent: OnPolicy, state: AgentState, steps: Transition, tasks: Task, apart: Callable[[Any], Any] | None = None
) -> tuple[AgentState, Transition]:
    """Add advantages and targets to a rollout (T, H, E, ...), and fit the critic's units to it.

    Args:
        apart: splits the steps where they are several rollouts, each with advantages of its own: leaves (T, R, H, E).
    """
    flat, features, obs, next_obs = agent.view.steps(state, windows(steps, agent.unroll), tasks)
    old, output = Units.of(state), critics.outputs(agent, state, features, obs)
    following, reward = critics.values(agent, state, features, next_obs), critics.rewards(agent, state, flat, tasks)
    found = old.rewards(output), following, output, reward
    in_order = partial(played, shape=steps.reward.shape, length=agent.unroll)
    value, next_value, output, reward = map(in_order, found)
    advantage, scaled = advantages(agent, steps._replace(reward=reward), tasks, value, next_value, apart)
    target = value + advantage
    state, units = critics.renew(agent, state, target)
    if agent.value_normalization == "popart":
        factor, offset = (x[:, None, None] for x in old.change(units))
        output = factor * output + offset
    new = {"advantage": scaled, "value": value, "output": output, "target": units.outputs(target)}
    return state, steps._replace(extras=Assessed(**steps.extras._asdict(), **new))


def advantages(
    agent: Any, steps: Transition, tasks: Task, value: Array, next_value: Array, apart: Callable[[Any], Any] | None
) -> tuple[Array, Array]:
    """Compute the advantages (T, H, E) of a rollout, or of several as ``apart`` splits them; and these normalised."""
    of_rollout = partial(gae, agent, tasks)
    normalize = partial(normalized, agent.advantage_normalization)
    if apart is None:
        advantage = of_rollout(steps, value, next_value)
        return advantage, normalize(advantage)
    advantage = jax.vmap(of_rollout, 1, 1)(*apart((steps, value, next_value)))
    return advantage.reshape(value.shape), jax.vmap(normalize, 1, 1)(advantage).reshape(value.shape)


def gae(agent: OnPolicy, tasks: Task, steps: Transition, value: Array, next_value: Array) -> Array:
    """Compute the generalised advantages (T, H, E) of a rollout."""
    of_task = jax.vmap(partial(targets.gae, lambda_=agent.gae_lambda))
    return of_task(steps, value, next_value, discounts_of_all(agent, tasks))


def normalized(how: Normalization, advantage: Array) -> Array:
    """Scale advantages (T, H, E) to mean 0 and standard deviation 1: over all tasks, in each task, or not at all."""
    mean, spread = moments(how, advantage)
    return (advantage - mean) / spread


def moments(how: Normalization, advantage: Array) -> tuple[Array, Array]:
    """Return the mean and the standard deviation by which advantages (T, H, E) are scaled: 0 and 1 for never."""
    if how == "none":
        return jnp.zeros(1), jnp.ones(1)
    mean, variance = mean_and_variance(advantage, (1, 2) if how == "task" else (0, 1, 2))
    return mean, jnp.maximum(jnp.sqrt(variance), MIN_STD)


def gain(self: Any, log_ratio: Array, batch: Any) -> tuple[Array, Metrics]:
    """Return an agent's gain of steps (B,), min(ratio A, clip(ratio, 1 - epsilon, 1 + epsilon) A), with metrics."""
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1 - self.clip_range, 1 + self.clip_range)
    gained = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    return gained, {"clip_fraction": jnp.mean(ratio != clipped)}
