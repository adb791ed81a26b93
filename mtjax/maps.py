"""Maps over seeds, worlds and learners."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array, Key, Step, Task


def over_seeds(function: Callable, *axes: Any) -> Callable:
    """Map a function over seeds. A single seed is not mapped: a CPU runs a batch of one at half the speed or less.

    Args:
        axes: for each argument, 0 (leaves have a leading S), None, or a tree of these.
    """

    def mapped(*arguments):
        if len(jax.tree.leaves(arguments[0])[0]) > 1:
            return jax.vmap(function, axes)(*arguments)
        drop = lambda tree: jax.tree.map(lambda x: x.reshape(x.shape[1:]), tree)
        choose = lambda axis, tree: tree if axis is None else drop(tree)
        is_axis = lambda x: x is None or isinstance(x, int)
        one = [jax.tree.map(choose, axis, tree, is_leaf=is_axis) for axis, tree in zip(axes, arguments, strict=True)]
        return jax.tree.map(lambda x: x[None], function(*one))

    return mapped


def over_worlds(function: Callable) -> Callable:
    """Map a function of single worlds over arguments with leaves (S, T, E, ...), as one flat batch."""

    def mapped(*arguments):
        shape = jax.tree.leaves(arguments)[0].shape[:3]
        flat = jax.tree.map(lambda x: x.reshape(math.prod(shape), *x.shape[3:]), arguments)
        return jax.tree.map(lambda x: x.reshape(*shape, *x.shape[1:]), jax.vmap(function)(*flat))

    return mapped


def over_learners(function: Callable) -> Callable:
    """Map ``function(agent state, task, per-world arguments...)`` over seeds, tasks and environments."""

    def mapped(states: Any, tasks: Task, *arguments):
        world = [0] * len(arguments)
        of_task = jax.vmap(function, (None, None, *world))
        of_seed = jax.vmap(of_task, (None, 0, *world))
        return over_seeds(of_seed, 0, None, *world)(states, tasks, *arguments)

    return mapped


def where_worlds(mask: Array, new: Any, old: Any) -> Any:
    """Choose trees with leaves (S, T, E, ...) by ``mask`` (S, T, E)."""
    choose = lambda new, old: jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 3)), new, old)
    return jax.tree.map(choose, new, old)


class Flat:
    """Methods of all worlds (S, T, E, ...) for an environment with ``reset`` and ``step`` of one."""

    def reset_worlds(self, tasks: Task, keys: Key) -> Step:
        """Begin an episode in every world."""
        return over_worlds(partial(_reset, self))(tasks, keys)

    def step_worlds(self, tasks: Task, states: Any, actions: Array) -> Step:
        """Step every world by its action (S, T, E, A)."""
        return over_worlds(partial(_step, self))(tasks, states, actions)

    def where_worlds(self, mask: Array, new: Any, old: Any) -> Any:
        """Choose states by ``mask`` (S, T, E)."""
        return where_worlds(mask, new, old)


@partial(jax.jit, static_argnums=0)  # physics takes seconds to trace: once for all programs, whatever their batches
def _reset(env: Any, task: Task, key: Key) -> Step:
    return env.reset(task, key)


@partial(jax.jit, static_argnums=0)
def _step(env: Any, task: Task, state: Any, action: Array) -> Step:
    return env.step(task, state, action)
