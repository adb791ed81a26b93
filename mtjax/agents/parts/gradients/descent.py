"""Optimisers and optimiser steps for actor and critics, and schedules of their learning rates."""

from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax

from mtjax.agents import parts
from mtjax.agents.networks import Params, to_unit
from mtjax.types import Array, InputError

Shape = Literal["constant", "linear", "cosine"]


def adam(rate: Any, weight_decay: Any, max_norm: Any, tune: str) -> optax.GradientTransformation:
    """Return Adam, or AdamW, on clipped gradients, for those parameters that ``tune`` names."""
    limit = parts.limit(max_norm)
    clip = optax.identity() if limit is None else optax.clip_by_global_norm(limit)
    step = optax.adam(rate) if parts.is_zero(weight_decay) else optax.adamw(rate, weight_decay=weight_decay)
    learn = on_sphere(optax.chain(clip, step))
    if tune == "all":
        return learn
    return optax.partition({True: learn, False: optax.set_to_zero()}, lambda params: _learning(tune, params))


def schedule(rate: Any, shape: Shape, final: Any, warmup: float, updates: float) -> Callable[[Array], Array]:
    """Return a learning rate as a function of the number n of updates so far.

    With N updates in all, W of them for the warm-up, a final share f and p = (n - W) / (N - W), clipped to [0, 1]:
        n < W       rate (n + 1) / W
        constant    rate
        linear      rate (1 - (1 - f) p)
        cosine      rate (f + (1 - f) (1 + cos(pi p)) / 2)      (Loshchilov & Hutter 2017, "SGDR", without restarts)
    """

    def rate_at(count: Array) -> Array:
        rising = jnp.minimum((count + 1) / max(warmup, 1), 1)
        if shape == "constant":
            return rate * rising
        if not updates:
            raise InputError(
                f"lr-schedule={shape} must know when the run ends: mtjax.train takes that from the run's steps; "
                "elsewhere give lr-updates"
            )
        progress = jnp.clip((count - warmup) / max(updates - warmup, 1), 0, 1)
        left = 1 - progress if shape == "linear" else (1 + jnp.cos(jnp.pi * progress)) / 2
        return rate * rising * (final + (1 - final) * left)

    return rate_at


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


def step(optimizer: optax.GradientTransformation, gradients: Any, memory: Any, params: Any) -> tuple[Any, Any]:
    """Apply one optimiser step, and return the parameters and the optimiser's state."""
    # XLA would move the transpose of a batched product's gradient into Adam, and copy parameters and moments on a GPU.
    apart = lambda x: jax.lax.optimization_barrier(x) if x.ndim > 2 else x
    gradients = jax.tree.map(apart, gradients)
    updates, memory = optimizer.update(gradients, memory, params)
    return optax.apply_updates(params, updates), memory
