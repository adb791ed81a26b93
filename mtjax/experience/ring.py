"""Rings hold the latest transitions of every task on the device, and are sampled equally for all tasks.

A ring is a row of slots, each with one step of every environment. So devices share it as they share environments.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.parallel import collectives
from mtjax.types import Array, Key


class Ring(NamedTuple):
    """Holds the rings of all tasks, which are filled at the same pace."""

    rows: Any  # leaves (T, H, E, ...)
    position: Array  # () int32, the slot where the next step goes
    size: Array  # () int32, slots written so far


OVER_SEEDS = Ring(rows=0, position=None, size=None)  # type: ignore
"""The axes of rings under a map over seeds."""


def init(item: Any, num_tasks: int, num_slots: int, num_envs: int) -> Ring:
    """Return empty rings for items like ``item`` (no leading axes)."""
    shape = (num_tasks, num_slots, num_envs)
    rows = jax.tree.map(lambda x: jnp.zeros((*shape, *jnp.shape(x)), jnp.result_type(x)), item)
    return Ring(rows, jnp.int32(0), jnp.int32(0))


def add(ring: Ring, items: Any) -> Ring:
    """Write items (T, H, E, ...) to the next H slots, over the oldest items; H divides the number of slots."""
    num_slots, count = (jax.tree.leaves(tree)[0].shape[1] for tree in (ring.rows, items))
    write = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, ring.position, axis=1)
    return Ring(
        rows=jax.tree.map(write, ring.rows, items),
        position=(ring.position + count) % num_slots,
        size=jnp.minimum(ring.size + count, num_slots),
    )


def sample(ring: Ring, key: Key, batch_size: int, window: int = 0) -> Any:
    """Draw rows (T, batch_size, ...) uniformly and with replacement from each task's ring.

    Args:
        window: draw so many consecutive steps of an environment, leaves (T, batch_size, window, ...). The last of them
            is at most the latest step, as those after it are not known, or are old ones that it will overwrite.
    """
    num_tasks = jax.tree.leaves(ring.rows)[0].shape[0]
    return _draw(ring, key, (num_tasks, batch_size), window, jax.vmap(lambda ring, index: ring[index]))


def sample_from(ring: Ring, key: Key, task: Array, window: int = 0) -> Any:
    """Draw a row, or a window, from the ring of each ``task`` (...) int32; leaves (*task.shape, ...)."""
    each = task[..., None] if window else task
    return _draw(ring, key, task.shape, window, lambda rings, index: rings[each, index])


def _draw(ring: Ring, key: Key, shape: tuple[int, ...], window: int, take: Callable) -> Any:
    """Draw uniform slots and environments of ``shape``, and apply ``take(rings, index)`` to rings (T, H E, ...)."""
    num_slots, held = jax.tree.leaves(ring.rows)[0].shape[1:3]
    num_envs = held * collectives.count()
    starts = ring.size - window + 1 if window else ring.size
    index = jax.random.randint(key, shape, 0, starts * num_envs)
    slot, env = index // num_envs, index % num_envs
    holder = env // held
    if window:
        oldest = ring.position - ring.size
        slot, env = (oldest + slot[..., None] + jnp.arange(window)) % num_slots, env[..., None]
    flat = lambda x: x.reshape(len(x), num_slots * held, *x.shape[3:])
    rows = jax.tree.map(lambda x: take(flat(x), slot * held + env % held), ring.rows)
    return collectives.pick(rows, holder)
