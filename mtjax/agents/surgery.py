"""Gradient surgery: how the gradients of several tasks become one update of the parameters they share.

Per-task gradients J (leading T) give a Gram matrix G = J J^T (T, T); a rule turns it into weights w (T,); the update is
w^T J. Rules differ only in G -> w. A task's own parameters receive that task's gradient / T, as under plain averaging.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.networks import Params
from mtjax.types import Array, Key, Metrics

Rule = Callable[[Array, Key], Array]


def pcgrad(gram: Array, key: Key) -> Array:
    """Project away conflicts between tasks (Yu et al. 2020, algorithm 1), exactly, on T-vectors.

    Each task's gradient is c^T J with c = e_i; in a fresh random order over the other tasks j, where the two conflict,
    c_j loses (c . G[:, j]) / G[j, j]. The result is the mean over tasks.

    Args:
        gram: (T, T) inner products of the tasks' gradients.
        key: the random orders.

    Returns:
        weights (T,).
    """
    num_tasks = len(gram)
    orders = jax.vmap(lambda k: jax.random.permutation(k, num_tasks))(jax.random.split(key, num_tasks))
    norms = jnp.diagonal(gram)

    def project(task: Array, order: Array) -> Array:
        def against(c: Array, other: Array) -> tuple[Array, None]:
            conflict = jnp.minimum(jnp.sum(c * gram[:, other]), 0.0)
            share = jnp.where((other == task) | (norms[other] == 0), 0.0, conflict / norms[other])
            return c - share * jax.nn.one_hot(other, num_tasks), None

        return jax.lax.scan(against, jax.nn.one_hot(task, num_tasks), order, unroll=min(num_tasks, 10))[0]

    return jnp.mean(jax.vmap(project)(jnp.arange(num_tasks), orders), axis=0)


RULES: dict[str, Rule | None] = {"mean": None, "pcgrad": pcgrad}


def gradient(rule: str, loss: Callable, params: Params, data: Any, key: Key) -> tuple[Params, Any, Metrics]:
    """Differentiate ``loss(params of one task, data of one task) -> (loss, aux)`` for all tasks and combine.

    Args:
        rule: a name in ``RULES``.
        params: ``shared`` as is, ``own`` with leading T.
        data: leaves (T, ...).

    Returns:
        gradients like ``params``, aux with leading T, and diagnostics of the conflict between tasks.
    """
    one_task = lambda shared, own, data: loss(Params(shared, own), data)
    weigh = RULES[rule]
    if weigh is None:

        def mean_loss(params: Params) -> tuple[Array, Any]:
            losses, aux = jax.vmap(one_task, (None, 0, 0))(params.shared, params.own, data)
            return jnp.mean(losses), aux

        gradients, aux = jax.grad(mean_loss, has_aux=True)(params)
        return gradients, aux, {}
    differentiate = jax.grad(one_task, argnums=(0, 1), has_aux=True)
    (jacobian, own), aux = jax.vmap(differentiate, (None, 0, 0))(params.shared, params.own, data)
    gram = gram_matrix(jacobian)
    weights = weigh(gram, key)
    shared = jax.tree.map(lambda leaf: jnp.tensordot(weights, leaf, 1), jacobian)
    own = jax.tree.map(lambda leaf: leaf / len(weights), own)
    return Params(shared, own), aux, conflicts(gram)


def gram_matrix(jacobian: Any) -> Array:
    """Inner products (T, T) of per-task gradients, leaf by leaf; in full float32, as small signs decide."""
    flat = [leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(jacobian)]
    return sum(jnp.matmul(leaf, leaf.T, precision=jax.lax.Precision.HIGHEST) for leaf in flat)  # type: ignore


def conflicts(gram: Array) -> Metrics:
    """Mean cosine between different tasks' gradients, and the share of pairs that point apart."""
    norms = jnp.sqrt(jnp.diagonal(gram))
    cosine = gram / jnp.maximum(norms[:, None] * norms, 1e-30)
    pairs = ~jnp.eye(len(gram), dtype=bool)
    count = jnp.maximum(jnp.sum(pairs), 1)
    return {"cosine": jnp.sum(cosine * pairs) / count, "conflict": jnp.sum((cosine < 0) & pairs) / count}
