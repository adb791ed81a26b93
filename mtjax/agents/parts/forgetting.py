"""What keeps a network from forgetting while it learns tasks one after another: penalties, and weights set apart.

All are pure functions of parameters, which are any tree of arrays. A penalty holds parameters where they were after a
task, each by its importance. PackNet gives every task weights of its own, which later tasks read but do not change.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.types import Array

Outputs = Callable[[Any, Any], Array]
"""A network as a function of its parameters and of one input, which returns outputs (K,)."""


# Penalties.

GROUP = 32
"""Inputs whose slopes are in memory at a time."""


class Anchor(NamedTuple):
    """Holds where parameters should stay, and how much each of them matters."""

    params: Any
    importance: Any  # as ``params``, not negative


def anchor(params: Any, importance: Any, before: Anchor | None = None) -> Anchor:
    """Hold parameters where a task leaves them; the importances of all tasks so far add up.

    If tasks have quadratic losses whose curvatures are the importances, these penalties lose nothing: each task's
    optimum is that of all tasks so far together.
    """
    if before is None:
        return Anchor(params, importance)
    return Anchor(params, jax.tree.map(jnp.add, before.importance, importance))


def penalty(held: Anchor, params: Any, coefficient: float | Array) -> Array:
    """Return coefficient / 2 sum_i importance_i (theta_i - anchor_i)^2."""
    each = lambda weight, x, y: jnp.sum(weight * jnp.square(x - y))
    of_leaves = jax.tree.leaves(jax.tree.map(each, held.importance, params, held.params))
    return coefficient / 2 * jnp.sum(jnp.stack(of_leaves))


def l2(params: Any) -> Any:
    """Return the importance 1 of all parameters."""
    return jax.tree.map(jnp.ones_like, params)


def ewc(
    outputs: Outputs, information: Callable[[Array], Array], params: Any, inputs: Any, least: float | Array = 0.0
) -> Any:
    """Return the diagonal of the Fisher information (Kirkpatrick et al. 2017, "EWC"), averaged over inputs (N, ...):

        F_i = mean_x max(sum_k I_k (d y_k / d theta_i)^2, least),  y = outputs(theta, x)

    Args:
        information: the Fisher information (K,) of the distribution that outputs (K,) describe, if it is diagonal:
            that of each output by itself.
    """

    def of_one(x: Any) -> Any:
        weight = information(outputs(params, x))
        squared = lambda slope: jnp.maximum(jnp.tensordot(weight, jnp.square(slope), axes=1), least)
        return jax.tree.map(squared, jax.jacrev(outputs)(params, x))

    return _mean(of_one, inputs)


def mas(outputs: Outputs, params: Any, inputs: Any) -> Any:
    """Return how much the squared length of outputs changes with each parameter (Aljundi et al. 2018, "MAS"):

    Omega_i = mean_x |d |y|^2 / d theta_i|,  y = outputs(theta, x)
    """
    length = lambda params, x: jnp.sum(jnp.square(outputs(params, x)))
    return _mean(lambda x: jax.tree.map(jnp.abs, jax.grad(length)(params, x)), inputs)


def _mean(of_one: Callable[[Any], Any], inputs: Any) -> Any:
    """Return the mean of a tree over inputs (N, ...), N at most ``GROUP`` or a multiple of it."""
    mean = lambda group: jax.tree.map(partial(jnp.mean, axis=0), jax.vmap(of_one)(group))
    grouped = lambda x: x.reshape(-1, min(len(x), GROUP), *x.shape[1:])
    groups = jax.tree.map(grouped, inputs)
    count = len(jax.tree.leaves(groups)[0])
    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(mean, jax.tree.map(lambda x: x[0], groups)))
    add = lambda total, group: (jax.tree.map(lambda x, y: x + y / count, total, mean(group)), None)
    return jax.lax.scan(add, zeros, groups)[0]


# PackNet (Mallya and Lazebnik 2018).

FREE = 0
"""The owner of weights that no task has yet; tasks are numbered from 1."""


def unowned(params: Any) -> Any:
    """Return the owners of weights before the first task."""
    return jax.tree.map(lambda x: jnp.full(x.shape, FREE, jnp.int32), params)


def prune(params: Any, owners: Any, task: int | Array, share: float | Array) -> tuple[Any, Any]:
    """Give a task the largest of its free weights, and set the others to 0, once it has been learned.

    Biases and scales, which are vectors, all belong to the first task that is learned.

    Args:
        share: of the free weights of each matrix that the task keeps, at least one: 1 / k if k tasks are left.

    Returns:
        the parameters, and their owners. Then what the task owns should learn for a while, without the others.
    """
    pairs = jax.tree.map(lambda x, owner: _prune(x, owner, task, share), params, owners)
    return tuple(jax.tree.map(lambda x, pair, i=i: pair[i], params, pairs) for i in range(2))  # type: ignore


def _prune(x: Array, owner: Array, task: int | Array, share: float | Array) -> tuple[Array, Array]:
    free = owner == FREE
    if x.ndim < 2:
        return x, jnp.where(free, task, owner)
    size = jnp.where(free, jnp.abs(x), -1.0).ravel()
    rank = jnp.zeros(x.size, jnp.int32).at[jnp.argsort(-size)].set(jnp.arange(x.size)).reshape(x.shape)
    kept = free & (rank < jnp.maximum(jnp.round(share * jnp.sum(free)), 1))
    return jnp.where(free & ~kept, 0.0, x), jnp.where(kept, task, owner)


def seen_by(params: Any, owners: Any, task: int | Array) -> Any:
    """Return the parameters that a task sees once it is pruned: its own and those of earlier tasks; others are 0."""
    return jax.tree.map(lambda x, owner: jnp.where((owner > FREE) & (owner <= task), x, 0.0), params, owners)
