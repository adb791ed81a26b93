"""What happens to an agent where one task of a sequence ends and another begins."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.agents import replay_batches
from mtjax.agents.base import BaseAgent
from mtjax.agents.fit import learned
from mtjax.agents.parts.policies import Policy
from mtjax.agents.state import AgentState, of_task
from mtjax.types import Agent, Array, Key, Task, Transition

Draw = Callable[[Key, int], Transition]
"""Draws so many windows (T, count, L, ...) of the replay, or of a last rollout."""


def consolidates(agent: Agent) -> bool:
    """Return whether anything happens to an agent where a task of a sequence ends."""
    way = agent.continual
    return way.keeps or way.reset_optimizer or way.restarts or agent.plasticity.changes


def consolidate(agent: BaseAgent, state: AgentState, draw: Draw, tasks: Task, key: Key) -> AgentState:
    """Return the state with which a task ends, of an agent that played it alone.

    Its way to remember renews what it keeps, and learns on if it does; then optimisers begin anew if they should.
    """
    way, (draw_key, learn_key) = agent.continual, jax.random.split(key)
    if way.keeps:
        nets = way.consolidate(state.nets, *_policy(agent, state, draw, tasks, draw_key))
        state = _retrain(agent, state._replace(nets=nets), draw, tasks, learn_key)
    if way.reset_optimizer:
        state = state._replace(fits={name: fit.init(state.nets, 1) for name, fit in agent.fits.items()})
    return state


def _policy(agent: BaseAgent, state: AgentState, draw: Draw, tasks: Task, key: Key) -> tuple[Any, Any, Any]:
    """Return the actor's outputs as a function of shared parameters and an input, their information, and inputs."""
    count, nets = agent.continual.samples, of_task(state.nets, jnp.int32(0))
    if not count:
        return None, None, None
    features, obs = jax.tree.map(lambda x: x[0], _seen(agent, state, draw(key, count), tasks))
    mask = None if tasks.action_mask is None else tasks.action_mask[0]
    features, obs = agent.view.actor_inputs(nets, features, obs)
    each = jnp.broadcast_to(features, (len(jax.tree.leaves(obs)[0]), features.shape[-1]))
    inputs = jax.tree.map(lambda x: x[:count], (each, obs))  # windows of several steps have more
    outputs = lambda shared, given: agent.actor.apply(nets["actor"]._replace(shared=shared), *given)
    return outputs, partial(information, agent.policy, mask), inputs


def _seen(agent: BaseAgent, state: AgentState, window: Transition, tasks: Task) -> tuple[Array, Any]:
    """Return features (T, ...) and observations (T, N, ...) of windows, as ``agent.view.actor_inputs`` takes them."""
    if agent.experience.storage.kept:
        batch = replay_batches.prepare(agent, state, window, tasks)
        return batch.features, batch.obs
    _, features, obs, _ = agent.view.steps(state, window, tasks)
    return features, obs


def information(policy: Policy, mask: Array | None, outputs: Array) -> Array:
    """Return the diagonal (P,) of the Fisher information of a policy with outputs (P,).

    It is the second derivative of the divergence of another policy, where both are the same.
    """
    return jnp.diagonal(jax.hessian(lambda others: policy.divergence(outputs, others, mask))(outputs))


def _retrain(agent: BaseAgent, state: AgentState, draw: Draw, tasks: Task, key: Key) -> AgentState:
    """Take the updates that follow a consolidation."""
    way = agent.continual

    def update(state: AgentState, given: tuple[Key, Array]) -> tuple[AgentState, None]:
        draw_key, update_key = jax.random.split(given[0])
        window = draw(draw_key, agent.experience.batch_size)
        return agent.update(state, window, tasks, update_key, given[1])[0], None

    if way.retrains:
        keys = jax.random.split(key, way.retrains)
        state, _ = jax.lax.scan(update, state, (keys, jnp.arange(way.retrains)))
    return state._replace(nets=way.retrained(state.nets))


def change(agent: Any, state: AgentState, fresh: AgentState) -> AgentState:
    """Return a state whose shared weights the agent's plasticity has changed, given a freshly drawn state."""
    of_net = lambda name: agent.plasticity.change(state.nets[name].shared, fresh.nets[name].shared)
    names = learned(agent.fits.values())
    return state.with_nets(**{name: state.nets[name]._replace(shared=of_net(name)) for name in names})
