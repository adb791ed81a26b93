"""Stacks of the last pictures of an episode, newest last: arrays (..., H, W, N C) for N pictures of C channels.

An observation of an environment holds one picture. Rollouts keep the stack that an agent sees, and a replay stores the
newest picture of every stack. An episode's first picture is repeated where the episode is younger than the stack.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array, Spec

PICTURES = "pixels"
"""The entry of an observation that holds pictures, uint8."""
STATE = "state"
"""The entry that holds a vector beside them."""


def shown(obs: Any) -> bool:
    """Return whether an observation, or its shapes, holds pictures."""
    return isinstance(obs, Mapping) and PICTURES in obs


def begin(obs: Any, frames: int) -> Any:
    """Return what an agent sees first: an observation whose picture (..., H, W, C) is repeated ``frames`` times."""
    if frames == 1 or not shown(obs):
        return obs
    return obs | {PICTURES: jnp.concatenate([obs[PICTURES]] * frames, axis=-1)}


def push(seen: Any, obs: Any) -> Any:
    """Return what an agent sees after a step: the next observation, with its picture at the end of the stack."""
    if not shown(obs):
        return obs
    picture = obs[PICTURES]
    return obs | {PICTURES: jnp.concatenate([seen[PICTURES][..., picture.shape[-1] :], picture], axis=-1)}


def seen(spec: Spec) -> Any:
    """Return the shapes of what an agent sees: those of observations, with stacks in place of pictures."""
    return jax.eval_shape(lambda obs: begin(obs, spec.frames), spec.obs)


# What networks take of an observation: one vector, pictures, or both.


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Layout:
    """Joins the arrays of an observation to one vector (..., O) float32, in the order of the tree.

    Pictures stay beside the vector. As a part of a tree it is static, and no leaf.
    """

    ranks: tuple[int, ...]  # of the arrays in a single observation, without pictures

    def __call__(self, obs: Any) -> Any:
        """Return observations, leaves (..., *shape), as networks take them; pictures alone as they are."""
        arrays = [jnp.asarray(x) for x in jax.tree.leaves(_beside_pictures(obs))]
        if not arrays:
            return obs
        flat = [_flatten(x, rank).astype(jnp.float32) for x, rank in zip(arrays, self.ranks, strict=True)]
        vector = jnp.concatenate(flat, axis=-1)
        return {PICTURES: obs[PICTURES], STATE: vector} if shown(obs) else vector


def layout(obs: Any) -> Layout | None:
    """Return how networks take observations of these shapes; None if it is as they are."""
    rest, as_it_is = _beside_pictures(obs), ({}, {STATE: 0}) if shown(obs) else (0,)
    arrays = jax.tree.leaves(rest)
    vectors = all(x.ndim == 1 and jnp.issubdtype(x.dtype, jnp.floating) for x in arrays)
    if vectors and jax.tree.structure(rest) in map(jax.tree.structure, as_it_is):
        return None
    return Layout(tuple(x.ndim for x in arrays))


def joined(obs: Any) -> Any:
    """Return the shapes of observations of these shapes as networks take them."""
    found = layout(obs)
    return obs if found is None else jax.eval_shape(found, obs)


def numeric(obs: Any) -> bool:
    """Return whether observations of these shapes hold numbers or bools, and pictures (H, W, C) uint8 if any."""
    kinds = jnp.integer, jnp.floating, jnp.bool_
    arrays = jax.tree.leaves(obs)
    known = all(hasattr(x, "dtype") and any(jnp.issubdtype(x.dtype, kind) for kind in kinds) for x in arrays)
    picture = getattr(obs[PICTURES], "dtype", None) == jnp.uint8 and obs[PICTURES].ndim == 3 if shown(obs) else True
    return bool(arrays) and known and picture


def _beside_pictures(obs: Any) -> Any:
    return {name: x for name, x in obs.items() if name != PICTURES} if shown(obs) else obs


def _flatten(x: Array, rank: int) -> Array:
    lead, shape = x.shape[: x.ndim - rank], x.shape[x.ndim - rank :]
    return x.reshape(*lead, math.prod(shape))


def state(obs: Any) -> Array | None:
    """Return the vector (..., O) in an observation as networks take it, or None."""
    return obs.get(STATE) if shown(obs) else obs


def with_state(change: Callable[[Array], Array], obs: Any) -> Any:
    """Return an observation as networks take it, whose vector is changed."""
    if not shown(obs):
        return change(obs)
    return obs | {STATE: change(obs[STATE])} if STATE in obs else obs


def state_size(spec: Spec) -> int:
    """Return the size O of the vector that networks take of observations, 0 if there is none."""
    found = state(joined(spec.obs))
    return 0 if found is None else found.shape[0]
