"""A device's share of a seed's environments, where there are more devices than seeds.

The devices of a seed hold the same agent and make the same updates of it; worlds and replay are split along ``E``.
Programs are written as for one device and ask here for what another device holds. Whether there is one, the mesh says
under which they are traced; without it, all of these return what they are given.
"""

from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array

AXIS = "envs"


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
    """Put all devices' parts of ``tree`` side by side along ``axis``, which is E."""
    return tree if count() == 1 else jax.lax.all_gather(tree, AXIS, axis=axis, tiled=True)


def total(tree: Any) -> Any:
    """Sum ``tree`` over devices."""
    return tree if count() == 1 else jax.lax.psum(tree, AXIS)


def pick(tree: Any, holder: Array) -> Any:
    """Take each row from the device that ``holder`` (...) names by its number; leaves (*holder.shape, ...)."""
    if count() == 1:
        return tree
    mine = holder == jax.lax.axis_index(AXIS)
    others = lambda x: jnp.where(mine.reshape(mine.shape + (1,) * (x.ndim - mine.ndim)), x, jnp.zeros_like(x))
    summed = total(jax.tree.map(lambda x: others(jnp.int8(x) if x.dtype == bool else x), tree))
    return jax.tree.map(lambda x, like: x.astype(like.dtype), summed, tree)


def agreed(tree: Any) -> Any:
    """Give all devices the first one's numbers: GPUs may add in any order, and then round differently."""
    first = lambda x: pick(x, jnp.int32(0)) if jnp.issubdtype(x.dtype, jnp.floating) else x
    return jax.tree.map(first, tree)
