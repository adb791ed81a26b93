"""Evaluation: whole episodes under the mean action, on any tasks, with keys of its own."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.loop import over_envs
from mtjax.types import Agent, Array, Env, Task


class Evaluations(NamedTuple):
    """Every episode of every evaluation of a run."""

    steps: np.ndarray  # (V,) environment steps, summed over tasks, after which each evaluation took place
    returns: dict[str, np.ndarray]  # split -> (S, V, T, episodes)
    values: dict[str, np.ndarray]  # split -> (T,) value of the varying parameter


@partial(jax.jit, static_argnums=(0, 1, 2))
def evaluate(env: Env, agent: Agent, episodes: int, state: Any, tasks: Task, seeds: Array, number: Array) -> Array:
    """Return the undiscounted returns (S, T, episodes) of the mean action.

    Args:
        state: agent states with leading S.
        tasks: (T, ...), training tasks or not.
        seeds: (S,) the runs' seeds.
        number: () which evaluation of the run it is; each has fresh keys, whatever training drew.
    """

    def one_seed(state: Any, seed: Array) -> Array:
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 0x7E57), number)
        start = over_envs(env.reset)(tasks, jax.random.split(key, (len(tasks.id), episodes)))
        act = over_envs(lambda task, obs: agent.act(state, obs, task, None))

        def step(carry, _):
            env_state, obs, total, alive = carry
            after = over_envs(env.step)(tasks, env_state, act(tasks, obs))
            total = total + alive * after.reward
            return (after.state, after.obs, total, alive & ~after.terminated), None

        zeros = jnp.zeros(start.reward.shape)
        carry = (start.state, start.obs, zeros, zeros == 0)
        return jax.lax.scan(step, carry, length=env.episode_length)[0][2]

    return jax.vmap(one_seed)(state, seeds)


@partial(jax.jit, static_argnums=(0, 1))
def record(env: Env, agent: Agent, state: Any, tasks: Task, seed: Array) -> tuple[Array, Any]:
    """Play one episode of each task under the mean action; ``state`` has no leading axis.

    Returns:
        returns (T,), and the environments' states at each step, leaves (T, H, ...).
    """
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 0xF11), len(tasks.id))

    def one_task(task: Task, key: Array) -> tuple[Array, Any]:
        start = env.reset(task, key)

        def step(carry, _):
            after = env.step(task, carry[0], agent.act(state, carry[1], task, None))
            return (after.state, after.obs), (after.reward, after.state)

        rewards, states = jax.lax.scan(step, (start.state, start.obs), length=env.episode_length)[1]
        return jnp.sum(rewards), states

    return jax.vmap(one_task)(tasks, keys)
