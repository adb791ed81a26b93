"""Replay on the device: one ring of transitions a task, sampled evenly over tasks."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.types import Array, Key


class Replay(NamedTuple):
    """The rings of all tasks, which fill in step with each other."""

    rows: Any  # leaves (T, capacity, ...)
    position: Array  # () int32, where the next rows go
    size: Array  # () int32, rows written so far


def init(item: Any, num_tasks: int, capacity: int) -> Replay:
    """Return empty rings for items like ``item`` (no leading axes)."""
    rows = jax.tree.map(lambda x: jnp.zeros((num_tasks, capacity, *jnp.shape(x)), jnp.result_type(x)), item)
    return Replay(rows, jnp.int32(0), jnp.int32(0))


def add(replay: Replay, items: Any) -> Replay:
    """Write items (T, E, ...) over the oldest rows; the capacity must be a multiple of ``E``."""
    capacity, num_new = capacity_of(replay), jax.tree.leaves(items)[0].shape[1]
    assert capacity % num_new == 0, f"capacity {capacity} is not a multiple of {num_new} environments"
    write = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, replay.position, axis=1)
    return Replay(
        rows=jax.tree.map(write, replay.rows, items),
        position=(replay.position + num_new) % capacity,
        size=jnp.minimum(replay.size + num_new, capacity),
    )


def sample(replay: Replay, key: Key, batch_size: int) -> Any:
    """Draw rows (T, batch_size, ...) uniformly and with replacement from each task's ring."""
    num_tasks = jax.tree.leaves(replay.rows)[0].shape[0]
    index = jax.random.randint(key, (num_tasks, batch_size), 0, replay.size)
    return jax.tree.map(lambda rows: jax.vmap(lambda ring, i: ring[i])(rows, index), replay.rows)


def sample_from(replay: Replay, key: Key, ring: Array) -> Any:
    """Draw a row from each ring that ``ring`` names by the number of its task; leaves (*ring.shape, ...)."""
    index = jax.random.randint(key, ring.shape, 0, replay.size)
    return jax.tree.map(lambda rows: rows[ring, index], replay.rows)


def capacity_of(replay: Replay) -> int:
    """Return how many rows each ring holds when full."""
    return jax.tree.leaves(replay.rows)[0].shape[1]
