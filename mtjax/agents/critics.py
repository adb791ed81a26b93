"""The critic of states of an agent that learns from rollouts: its values, and the units in which it has them."""

from functools import partial
from typing import Any

import jax.numpy as jnp

from mtjax import frames
from mtjax.agents import parts
from mtjax.agents.networks import Params
from mtjax.agents.parts.scaling.popart import rescale_heads
from mtjax.agents.rates import discounts_of_all
from mtjax.agents.state import AgentState, over_tasks
from mtjax.agents.units import MIN_STD, Units
from mtjax.parallel.axes import in_parts
from mtjax.parallel.collectives import mean_and_variance
from mtjax.types import Array, Metrics, Task, Transition


def models(agent: Any, state: AgentState, flat: Transition, tasks: Task, next_obs: Any) -> dict[str, Any]:
    """Return what a batch holds for a representation that learns."""
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
    return Units.of(state.nets["units"]).rewards(outputs(agent, state, features, obs))


def outputs(agent: Any, state: AgentState, features: Array, obs: Any) -> Array:
    """Return the critic's outputs (T, B) for observations (T, B, ...)."""
    of_tasks = partial(over_tasks, agent.output, state.nets)
    if frames.shown(obs):  # all at once they would fill the memory
        return in_parts(of_tasks, features, obs, agent.experience.minibatches)
    return of_tasks(features, obs)


def renew(agent: Any, state: AgentState, target: Array) -> AgentState:
    """Move the critic's units by targets (T, N), and with PopArt rescale its heads to them."""
    scaling, _ = agent.scaling.renew(state.nets["scaling"].own, target, ())
    state = state.with_nets(scaling=Params({}, scaling))
    if agent.value_normalization == "none":
        return state
    old = Units.of(state.nets["units"])
    new = old.moved(target, agent.value_rate)
    if agent.value_normalization == "popart":
        state = state.with_nets(critic=rescale_heads(state.nets["critic"], *old.change(new)))
    return state.with_nets(units=new.params())


def explained(state: AgentState, batch: Any) -> Metrics:
    """Return the mean value (T,) of steps, and which share of the variance of targets values explained."""
    target = Units.of(state.nets["units"]).rewards(batch.target)
    residual, whole = (mean_and_variance(x, 1)[1][:, 0] for x in (target - batch.value, target))
    share = 1 - residual / jnp.maximum(whole, MIN_STD**2)
    return {"value": mean_and_variance(batch.value, 1)[0][:, 0], "explained_variance": share}
