"""Gradient surgery combines the gradients of several tasks into one update of the parameters that they share.

Per-task gradients J (leading T) give a Gram matrix G = J J^T (T, T); a rule maps it to weights w (T,); the update is
w^T J. Rules (``rules.py``, ``balancing.py``) differ only in G -> w. A few have a memory, and FAMO uses losses instead
of G. A task's own parameters receive that task's gradient / T, as under plain averaging.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.agents.networks import Params
from mtjax.agents.parts.gradients import balancing, rules
from mtjax.parallel import collectives
from mtjax.types import Array, Key, Metrics

Rule = rules.Mean
RULES: dict[str, type[Rule]] = {
    "mean": rules.Mean,
    "pcgrad": rules.PCGrad,
    "cagrad": rules.CAGrad,
    "mgda": rules.MGDA,
    "imtl-g": rules.IMTLG,
    "nash-mtl": rules.NashMTL,
    "aligned-mtl": rules.AlignedMTL,
    "upgrad": rules.UPGrad,
    "gradnorm": balancing.GradNorm,
    "famo": balancing.FAMO,
}

SMALL = 2**14
"""Leaves with fewer numbers per task are concatenated, as a kernel launch for each costs more than its product."""


class Combined(NamedTuple):
    """Holds what ``gradient`` returns."""

    gradients: Params  # like the parameters
    memory: Any  # the rule's
    losses: Array  # (T,)
    aux: Any  # the losses' auxiliary outputs, leading T
    metrics: Metrics  # of the conflict between tasks


def init(rule: Rule, params: Params, num_tasks: int, per_layer: bool = False) -> Any:
    """Return a rule's initial memory; leaves have a leading axis of layers if the rule needs gradients."""
    memory = rule.init(num_tasks)
    if rule.needs != "gradients":
        return memory
    num_layers = len(layers_of(params.shared, per_layer))
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_layers, *jnp.shape(x))), memory)


def gradient(
    rule: Rule,
    loss: Callable,
    params: Params,
    data: Any,
    memory: Any,
    key: Key,
    importance: Array | None = None,
    per_layer: bool = False,
) -> Combined:
    """Differentiate ``loss(params of one task, data of one task) -> (loss, aux)`` for all tasks, and combine.

    Args:
        rule: combines the tasks' gradients.
        loss: of one task.
        params: ``shared`` as is, ``own`` with leading T.
        data: leaves (T, ...).
        memory: the rule's.
        key: for rules that draw.
        importance: (T,) factors of the tasks' losses; None for 1.
        per_layer: weigh the tasks for each layer by its own gradients, instead of once for all shared parameters.
    """

    def one_task(shared, own, data, factor) -> tuple[Array, Any]:
        value, aux = loss(Params(shared, own), data)
        weighted = value if factor is None else factor * value
        return weighted, (weighted, value, aux)

    combine = partial(_of_gradients, per_layer=per_layer) if rule.needs == "gradients" else _of_losses
    return combine(rule, one_task, params, data, memory, key, importance)


def over_devices(loss: Callable) -> Callable:
    """Average a loss, its gradient and its auxiliary outputs over the devices that share the data.

    Where all devices have the same data, as with replay, this is not needed.
    """
    if collectives.count() == 1:
        return loss
    mean = lambda tree: jax.tree.map(lambda x: x / collectives.count(), collectives.total(tree))
    same = jax.custom_vjp(lambda params: params)
    same.defvjp(lambda params: (params, None), lambda _, gradient: (mean(gradient),))

    def averaged(params: Params, data: Any) -> tuple[Array, Any]:
        value, aux = loss(same(params), data)
        others = jax.lax.stop_gradient(mean(value) - value)  # the gradient is summed where it reaches the parameters
        return value + others, mean(jax.lax.stop_gradient(aux))

    return averaged


def adapt_rule(rule: Rule, loss: Callable, params: Params, data: Any, before: Combined) -> Any:
    """Return a rule's memory after the update; rules that need losses see the new ones on the same data."""
    if rule.needs != "losses":
        return before.memory
    of_task = lambda own, data: loss(Params(params.shared, own), data)[0]
    return rule.adapt(before.memory, before.losses, jax.vmap(of_task)(params.own, data))


def _of_gradients(rule: Rule, one_task, params: Params, data, memory, key, importance, per_layer) -> Combined:
    """Combine by the gradients of every task."""
    differentiate = jax.vmap(jax.grad(one_task, argnums=(0, 1), has_aux=True), (None, 0, 0, 0))
    (jacobian, own), (weighted, losses, aux) = differentiate(params.shared, params.own, data, importance)
    leaves, structure = jax.tree.flatten(jacobian)
    layers = layers_of(jacobian, per_layer)
    grams = jnp.stack([gram_matrix([leaves[i] for i in layer]) for layer in layers])
    weigh = jax.vmap(lambda memory, gram, key: rule.weigh(memory, gram, weighted, key))
    weights, memory = weigh(memory, grams, jax.random.split(key, len(layers)))
    shared: list[Any] = [None] * len(leaves)
    for layer, of_layer in zip(layers, weights, strict=True):
        for i, total in zip(layer, weighted_sums(of_layer, [leaves[i] for i in layer]), strict=True):
            shared[i] = total
    own = jax.tree.map(lambda leaf: leaf / len(losses), own)
    gradients = Params(jax.tree.unflatten(structure, shared), own)
    return Combined(gradients, memory, losses, aux, conflicts(jnp.sum(grams, axis=0)))


def _of_losses(rule: Rule, one_task, params: Params, data, memory, key, importance) -> Combined:
    """Combine by the losses alone, with one backward pass of their weighted sum."""
    all_tasks = lambda shared, own: jax.vmap(one_task, (None, 0, 0, 0))(shared, own, data, importance)
    weighted, pull, (_, losses, aux) = jax.vjp(all_tasks, params.shared, params.own, has_aux=True)
    weights, memory = rule.weigh(memory, None, weighted, key)  # type: ignore
    shared, own = pull(weights)
    even = jnp.where(weights > 0, 1 / len(weights) / weights, 0.0)
    own = jax.vmap(lambda factor, leaves: jax.tree.map(lambda leaf: factor * leaf, leaves))(even, own)
    return Combined(Params(shared, own), memory, losses, aux, {})


def layers_of(tree: Any, per_layer: bool) -> list[list[int]]:
    """Group the indices of leaves that are weighed together: all, or the kernel and bias of each layer."""
    layers: dict[Any, list[int]] = {}
    for i, (path, _) in enumerate(jax.tree_util.tree_leaves_with_path(tree)):
        layers.setdefault(path[:-1] if per_layer else (), []).append(i)
    return list(layers.values())


def _is_small(leaf: Array) -> bool:
    return leaf[0].size < SMALL


def gram_matrix(jacobian: Any) -> Array:
    """Compute inner products (T, T) of per-task gradients, leaves (T, ...), in full float32, as signs matter."""
    flat = [leaf.reshape(len(leaf), -1) for leaf in jax.tree.leaves(jacobian)]
    small = [leaf for leaf in flat if _is_small(leaf)]
    parts = [leaf for leaf in flat if not _is_small(leaf)] + ([jnp.concatenate(small, axis=1)] if small else [])
    return sum(jnp.matmul(part, part.T, precision="highest") for part in parts)  # type: ignore


def weighted_sums(weights: Array, leaves: list[Array]) -> list[Array]:
    """Sum per-task gradients (T, ...) over tasks by weights (T,)."""
    small = [leaf.reshape(len(leaf), -1) for leaf in leaves if _is_small(leaf)]
    sums: Any = []
    if small:
        ends = np.cumsum([leaf.shape[1] for leaf in small])
        sums = jnp.split(jnp.dot(weights, jnp.concatenate(small, axis=1), precision="highest"), ends[:-1])
    small_sums = iter(sums)
    whole = lambda leaf: jnp.tensordot(weights, leaf, 1, precision="highest")
    return [next(small_sums).reshape(leaf.shape[1:]) if _is_small(leaf) else whole(leaf) for leaf in leaves]


def cosines(gram: Array) -> tuple[Array, Array]:
    """Return cosines (T, T) between the tasks' gradients, 0 for zero gradients, and lengths (T,)."""
    norms = jnp.sqrt(jnp.diagonal(gram))
    return gram / jnp.maximum(norms[:, None] * norms, 1e-30), norms


def conflicts(gram: Array) -> Metrics:
    """Return the mean cosine of pairs of tasks, the share of pairs with negative cosine, and lengths (T,)."""
    cosine, norms = cosines(gram)
    pairs = ~jnp.eye(len(gram), dtype=bool)
    count = jnp.maximum(jnp.sum(pairs), 1)
    found = {"cosine": jnp.sum(cosine * pairs) / count, "conflict": jnp.sum((cosine < 0) & pairs) / count}
    return found | {"gradient_norm": norms}
