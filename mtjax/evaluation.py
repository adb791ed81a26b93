"""Evaluation: whole episodes under the mean action, on any tasks, with keys of its own."""

import os
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.loop import actions, begin, play
from mtjax.tasks import episode_task
from mtjax.types import SPLITS, Agent, Array, Env, InputError, Task


class Evaluations(NamedTuple):
    """Every episode of every evaluation of a run."""

    steps: np.ndarray  # (V,) environment steps, summed over tasks, after which each evaluation took place
    returns: dict[str, np.ndarray]  # split -> (S, V, T, episodes)
    values: dict[str, np.ndarray]  # split -> (T,) value of the varying parameter


def save_evaluations(path: Path, evaluations: Evaluations) -> None:
    """Write every episode's return: ``steps`` (V,), and per split returns (S, V, T, episodes) and values (T,)."""
    values = {f"{split}_values": x for split, x in evaluations.values.items()}
    new = path.with_suffix(".new.npz")
    np.savez(new, steps=evaluations.steps, **evaluations.returns, **values)  # type: ignore
    os.replace(new, path)


def load_evaluations(path: Path) -> Evaluations:
    """Read what ``save_evaluations`` wrote."""
    try:
        with np.load(path, allow_pickle=False) as file:
            returns = {split: file[split] for split in SPLITS}
            return Evaluations(file["steps"], returns, {s: file[f"{s}_values"] for s in SPLITS})
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"cannot read evaluations from {str(path)!r}: {error}") from None


@partial(jax.jit, static_argnums=(0, 1, 2))
def evaluate(env: Env, agent: Agent, episodes: int, state: Any, tasks: Task, seeds: Array, number: Array) -> Array:
    """Return the undiscounted returns (S, T, episodes) of the mean action.

    Args:
        state: agent states with leading S.
        tasks: (T, ...), training tasks or not.
        seeds: (S,) the runs' seeds.
        number: () which evaluation of the run it is; each has fresh keys, whatever training drew.
    """

    shape = (len(seeds), len(tasks.id), episodes)
    fresh = lambda seed: jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 0x7E57), number)
    keys = jax.vmap(lambda seed: jax.random.split(fresh(seed), shape[1:]))(seeds)
    worlds, start = begin(env, tasks, keys)

    def step(carry, _):
        env_state, obs, total, alive = carry
        after = play(env, worlds, env_state, actions(agent, state, tasks, worlds, obs, None))
        total = total + jnp.where(alive, after.reward, 0.0)  # what follows an episode's end may not be finite
        return (after.state, after.obs, total, alive & ~after.terminated), None

    carry = (start.state, start.obs, jnp.zeros(shape), jnp.ones(shape, bool))
    return jax.lax.scan(step, carry, length=env.episode_length)[0][2]


@partial(jax.jit, static_argnums=(0, 1))
def record(env: Env, agent: Agent, state: Any, tasks: Task, seed: Array) -> tuple[Array, Array, Any]:
    """Play one episode of each task under the mean action; ``state`` has no leading axis.

    Returns:
        returns (T,), the rows (T,) of the tasks that were played, and the environments' states at each step, leaves
        (T, H, ...).
    """
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 0xF11), len(tasks.id))

    def one_task(task: Task, key: Array) -> tuple[Array, Array, Any]:
        task_key, key = jax.random.split(key)
        task = episode_task(task, task_key)
        start = env.reset(task, key)

        def step(carry, _):
            after = env.step(task, carry[0], agent.act(state, carry[1], task, None))
            return (after.state, after.obs), (after.reward, after.state)

        rewards, states = jax.lax.scan(step, (start.state, start.obs), length=env.episode_length)[1]
        return jnp.sum(rewards), task.row, states

    return jax.vmap(one_task)(tasks, keys)
