"""Gradient surgery: how the gradients of several tasks become one update of the parameters they share.

Per-task gradients J (leading T) give a Gram matrix G = J J^T (T, T); a rule turns it into weights w (T,); the update is
w^T J. Rules (``rules.py``) differ only in G -> w. A task's own parameters receive that task's gradient / T, as under
plain averaging.
"""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp

from mtjax.agents import rules
from mtjax.networks import Params
from mtjax.types import Array, Key, Metrics

RuleName = Literal["mean", "pcgrad", "cagrad", "mgda", "imtl-g", "nash-mtl", "aligned-mtl", "upgrad"]
RULES: dict[str, rules.Rule | None] = {
    "mean": None,
    "pcgrad": rules.pcgrad,
    "cagrad": rules.cagrad,
    "mgda": rules.mgda,
    "imtl-g": rules.imtl_g,
    "nash-mtl": rules.nash_mtl,
    "aligned-mtl": rules.aligned_mtl,
    "upgrad": rules.upgrad,
}


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
