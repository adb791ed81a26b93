"""Collective operations between the devices that share a seed's environments.

The devices of a seed hold the same agent and make the same updates. Worlds and replay are split along ``E``. Programs
are written as for one device, and call these functions to reach the data of other devices. The mesh under which they
are traced says how many devices there are. Without a mesh every function returns its argument.
"""

from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array

AXIS = "envs"
SEEDS = "seeds"


def count() -> int:
    """Count the devices that share each seed's environments."""
    mesh = jax.sharding.get_abstract_mesh()
    return mesh.shape[AXIS] if AXIS in mesh.manual_axes else 1


def own(tree: Any, axis: int) -> Any:
    """Slice out this device's part of ``tree`` along ``axis``, which is E."""
    if count() == 1:
        return tree

    def part(x):
        size = x.shape[axis] // count()
        return jax.lax.dynamic_slice_in_dim(x, jax.lax.axis_index(AXIS) * size, size, axis)

    return jax.tree.map(part, tree)


def whole(tree: Any, axis: int) -> Any:
    """Join all devices' parts of ``tree`` along ``axis``, which is E."""
    return tree if count() == 1 else jax.lax.all_gather(tree, AXIS, axis=axis, tiled=True)


def of_all_seeds(tree: Any) -> Any:
    """Join leaves (S, ...) along a leading S, if devices share the seeds."""
    split = SEEDS in jax.sharding.get_abstract_mesh().manual_axes
    return jax.lax.all_gather(tree, SEEDS, axis=0, tiled=True) if split else tree


def total(tree: Any) -> Any:
    """Sum ``tree`` over devices."""
    return tree if count() == 1 else jax.lax.psum(tree, AXIS)


def mean_and_variance(x: Array, axes: int | tuple[int, ...]) -> tuple[Array, Array]:
    """Return mean and variance along axes, which keep length 1, over all devices that share the data."""
    mean_of = lambda x: total(jnp.mean(x, axis=axes, keepdims=True)) / count()
    mean = mean_of(x)
    return mean, mean_of(jnp.square(x - mean))


def pick(tree: Any, holder: Array) -> Any:
    """Take each row of leaves (*holder.shape, ...) from the device whose number is in ``holder`` (...)."""
    if count() == 1:
        return tree
    mine = holder == jax.lax.axis_index(AXIS)
    others = lambda x: jnp.where(mine.reshape(mine.shape + (1,) * (x.ndim - mine.ndim)), x, jnp.zeros_like(x))
    summed = total(jax.tree.map(lambda x: others(jnp.int8(x) if x.dtype == bool else x), tree))
    return jax.tree.map(lambda x, like: x.astype(like.dtype), summed, tree)


def agreed(tree: Any) -> Any:
    """Give all devices the first one's floats, because GPUs may add in another order and round differently."""
    first = lambda x: pick(x, jnp.int32(0)) if jnp.issubdtype(x.dtype, jnp.floating) else x
    return jax.tree.map(first, tree)
