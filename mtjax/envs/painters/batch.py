"""Functions of one world that see all mapped worlds as one flat batch."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp


def flat_batch(function: Callable) -> Callable:
    """Turn a function of trees with one leading axis of worlds into one of a single world.

    However it is mapped, the function is called once, with all worlds along that axis.
    """

    @jax.custom_batching.custom_vmap
    def batched(tree: Any) -> Any:
        return function(tree)

    @batched.def_vmap
    def _(count: int, mapped: Any, tree: Any) -> tuple[Any, Any]:
        full = jax.tree.map(lambda x, m: x if m else jnp.broadcast_to(x, (count, *x.shape)), tree, mapped[0])
        found = batched(jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), full))
        found = jax.tree.map(lambda x: x.reshape(count, len(x) // count, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    def single(tree: Any) -> Any:
        return jax.tree.map(lambda x: x[0], batched(jax.tree.map(lambda x: x[None], tree)))

    return single


def in_chunks(function: Callable, size: int, tree: Any) -> Any:
    """Map a function of one world over leaves (W, ...), ``size`` worlds at once; 0 for all."""
    count = len(jax.tree.leaves(tree)[0])
    if not size or count <= size:
        return jax.vmap(function)(tree)
    chunks = -(-count // size)
    widen = lambda x: jnp.pad(x, [(0, chunks * size - count)] + [(0, 0)] * (x.ndim - 1), "edge")
    apart = jax.tree.map(lambda x: widen(x).reshape(chunks, size, *x.shape[1:]), tree)
    found = jax.lax.map(jax.vmap(function), apart)
    return jax.tree.map(lambda x: x.reshape(chunks * size, *x.shape[2:])[:count], found)
