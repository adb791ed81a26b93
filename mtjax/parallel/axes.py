"""Map functions over seeds, worlds and agents, or apply them to parts of a batch or when it is their turn."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array, Env, Key, Step, Task


def over_seeds(function: Callable, *axes: Any) -> Callable:
    """Map a function over seeds; a single seed is not mapped, as a CPU runs a batch of one at half the speed or less.

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
    """Map a function of one world over arguments with leaves (S, T, E, ...), as one flat batch."""

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


def in_parts(function: Callable, features: Array, obs: Any, parts: int) -> Array:
    """Apply a function of features and observations (T, B, ...) to ``parts`` of B, one after another.

    The result (T, B, ...) is as of one call; less memory is in use at once.

    Args:
        features: (T, Z), or (T, B, Z) where each step has its own.
    """
    count = jax.tree.leaves(obs)[0].shape[1]
    size = -(-count // parts)
    starts = jnp.minimum(jnp.arange(parts) * size, count - size)  # the last part may overlap the one before it

    def one(start: Array) -> Array:
        take = lambda x: jax.lax.dynamic_slice_in_dim(x, start, size, axis=1)
        return function(take(features) if features.ndim == 3 else features, jax.tree.map(take, obs))

    found = jax.lax.map(one, starts)  # (parts, T, size, ...)
    place = jnp.arange(count)
    part = place // size
    return jnp.swapaxes(found[part, :, place - starts[part]], 0, 1)


def when(due: Array, function: Callable, state: Any) -> tuple[Any, Any]:
    """Apply ``function(state) -> (state, results)`` if ``due``; if not, the state stays and results are zeros.

    Args:
        due: () bool. Under a map over seeds it must be the same for all, and not mapped: then it stays a branch.
    """
    shapes = jax.eval_shape(function, state)[1]
    rest = lambda state: (state, jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes))
    return jax.lax.cond(due, function, rest, state)


def where_worlds(mask: Array, new: Any, old: Any) -> Any:
    """Select leaves (S, T, E, ...) of ``new`` where ``mask`` (S, T, E), else of ``old``."""
    choose = lambda new, old: jnp.where(mask.reshape(mask.shape + (1,) * (new.ndim - 3)), new, old)
    return jax.tree.map(choose, new, old)


# Methods of all worlds (S, T, E, ...), for environments with ``reset`` and ``step`` of one world.


def reset_worlds(self: Any, tasks: Task, keys: Key) -> Step:
    """Begin an episode in every world."""
    return over_worlds(partial(_reset, self))(tasks, keys)


def renew_worlds(self: Any, tasks: Task, keys: Key, mask: Array, states: Any) -> Step:
    """Begin an episode in the worlds of ``mask`` (S, T, E); only their observations count.

    Returns:
        the step that begins their episodes, with the states of all worlds.
    """
    begun = self.reset_worlds(tasks, keys)
    return begun._replace(state=where_worlds(mask, begun.state, states))


def step_worlds(self: Any, tasks: Task, states: Any, actions: Array) -> Step:
    """Step every world with its action (S, T, E, A)."""
    return over_worlds(partial(_step, self))(tasks, states, actions)


def observe_worlds(self: Any, tasks: Task, states: Any) -> Any:
    """Return what agents observe of every world, for families with ``observe(task, state)`` of one world."""
    return over_worlds(self.observe)(tasks, states)


@partial(jax.jit, static_argnums=0)  # tracing physics takes seconds: do it once for all programs
def _reset(env: Env, task: Task, key: Key) -> Step:
    return env.reset(task, key)


@partial(jax.jit, static_argnums=0)
def _step(env: Env, task: Task, state: Any, action: Array) -> Step:
    return env.step(task, state, action)
