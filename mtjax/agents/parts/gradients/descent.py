"""Optimisers and optimiser steps for actor and critics."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from mtjax.agents import parts
from mtjax.networks import Params
from mtjax.sphere import to_unit
from mtjax.types import Array


def adam(rate: Any, weight_decay: Any, max_norm: Any, tune: str) -> optax.GradientTransformation:
    """Return Adam, or AdamW, on clipped gradients, for those parameters that ``tune`` names."""
    clip = optax.identity() if parts.is_zero(max_norm) else clip_to(max_norm)
    step = optax.adam(rate) if parts.is_zero(weight_decay) else optax.adamw(rate, weight_decay=weight_decay)
    learn = on_sphere(optax.chain(clip, step))
    if tune == "all":
        return learn
    return optax.partition({True: learn, False: optax.set_to_zero()}, lambda params: _learning(tune, params))


def _learning(tune: str, params: Params) -> Any:
    """Mark the leaves of actor or critic that learn: those of heads, or learned embeddings."""
    part = {"heads": "head", "embedding": "embedding"}[tune]

    def learns(path, _) -> bool:
        names = [getattr(step, "key", None) for step in path]
        return part in names and "body" not in names[: names.index(part)]

    return jax.tree_util.tree_map_with_path(learns, params)


def on_sphere(optimizer: optax.GradientTransformation) -> optax.GradientTransformation:
    """Return an optimiser whose steps end on the unit sphere, for every leaf called ``direction``.

    Such leaves are (..., inputs, outputs), and the weights of each output have length 1 after a step.
    """

    def stay(path: Any, update: Array, start: Array) -> Array:
        if getattr(path[-1], "key", None) != "direction":
            return update
        return to_unit(start + update, axis=-2) - start

    def step(updates: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        updates, state = optimizer.update(updates, state, params)
        return jax.tree_util.tree_map_with_path(stay, updates, params), state

    return optax.GradientTransformation(optimizer.init, step)


def clip_to(norm: Any) -> optax.GradientTransformation:
    """Return a transformation that clips gradients to a global norm; a traced norm may be 0, which does not clip."""
    return optax.clip_by_global_norm(jnp.where(norm > 0, norm, jnp.inf) if isinstance(norm, Array) else norm)


def descend(optimizer: optax.GradientTransformation, gradients: Any, memory: Any, params: Any) -> tuple[Any, Any]:
    """Apply one optimiser step, and return the parameters and the optimiser's state."""
    updates, memory = optimizer.update(gradients, memory, params)
    return optax.apply_updates(params, updates), memory
