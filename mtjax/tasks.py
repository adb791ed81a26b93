"""Functions on tables of tasks choose tasks inside a program, like MTEnv's wrappers of environments.

``mtjax.gym`` has the same as wrappers of Gymnasium environments.
"""

import jax
import jax.numpy as jnp

from mtjax.types import Array, Env, InputError, Key, Task

SAME_CONTEXT = 1e-5
"""Contexts that are no farther apart are those of one task, which rounding may bring apart."""


def n_tasks(env: Env, n: int, key: Key, split: str = "train") -> Task:
    """Draw a fixed bag of ``n`` tasks of a split, with leading axis ``n``.

    They are different rows of the table; where parameters are continuous, they are ``n`` fresh draws.

    Raises:
        InputError: the split has fewer than ``n`` tasks, or none.
    """
    table = env.tasks(split)
    count, endless = len(table.id), table.draws is not None
    if n < 1 or not count or (n > count and not endless):
        raise InputError(f"cannot draw {n} different tasks from the {count} of split {split!r}")
    row_key, draw_key = jax.random.split(key)
    rows = jax.random.choice(row_key, count, (n,), replace=endless)
    bag = jax.tree.map(lambda x: x[rows], table)
    return jax.vmap(episode_task)(bag, jax.random.split(draw_key, n))


def with_ids(tasks: Task) -> Task:
    """Number the tasks of a bag (n,) from 0, for agents that see the number; their physics is unchanged."""
    return tasks._replace(id=jnp.arange(len(tasks.id), dtype=jnp.int32))


def sample_random_task(tasks: Task, key: Key) -> Task:
    """Draw one task from a table (T,); where parameters are continuous, with fresh values."""
    row_key, draw_key = jax.random.split(key)
    row = jax.random.randint(row_key, (), 0, len(tasks.id))
    return episode_task(jax.tree.map(lambda x: x[row], tasks), draw_key)


def episode_task(task: Task, key: Key) -> Task:
    """Return the task of one episode: ``task`` itself, or a fresh draw where its parameters are continuous.

    A draw has the id of the task for which it is drawn, and its own parameters and context.
    """
    if task.draws is None:
        return task
    return draw_at(task, jax.random.randint(key, (), 0, len(task.draws.id)))


def draw_at(task: Task, choice: Array) -> Task:
    """Return the draw of ``task`` with this number () int32."""
    drawn = jax.tree.map(lambda x: x[choice], task.draws)._replace(id=task.id)
    return drawn if contexts_vary(task) else drawn._replace(context=task.context)


def contexts_vary(tasks: Task) -> bool:
    """Return whether episodes of one task have different contexts."""
    return tasks.draws is not None and tasks.draws.context is not None
