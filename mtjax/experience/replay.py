"""Replay on the device: one ring of transitions a task, sampled evenly over tasks.

A ring is a row of slots, each with one step of every environment, so that devices can share it as they share those.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.parallel import collectives as shares
from mtjax.types import Array, Key


class Replay(NamedTuple):
    """The rings of all tasks, which fill in step with each other."""

    rows: Any  # leaves (T, H, E, ...)
    position: Array  # () int32, the slot where the next step goes
    size: Array  # () int32, slots written so far


def init(item: Any, num_tasks: int, num_slots: int, num_envs: int) -> Replay:
    """Return empty rings for items like ``item`` (no leading axes)."""
    shape = (num_tasks, num_slots, num_envs)
    rows = jax.tree.map(lambda x: jnp.zeros((*shape, *jnp.shape(x)), jnp.result_type(x)), item)
    return Replay(rows, jnp.int32(0), jnp.int32(0))


def add(replay: Replay, items: Any) -> Replay:
    """Write items (T, E, ...) over those of the oldest slot."""
    num_slots = jax.tree.leaves(replay.rows)[0].shape[1]
    write = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new[:, None], replay.position, axis=1)
    return Replay(
        rows=jax.tree.map(write, replay.rows, items),
        position=(replay.position + 1) % num_slots,
        size=jnp.minimum(replay.size + 1, num_slots),
    )


def sample(replay: Replay, key: Key, batch_size: int) -> Any:
    """Draw rows (T, batch_size, ...) uniformly and with replacement from each task's ring."""
    num_tasks = jax.tree.leaves(replay.rows)[0].shape[0]
    return _draw(replay, key, (num_tasks, batch_size), jax.vmap(lambda ring, index: ring[index]))


def sample_from(replay: Replay, key: Key, ring: Array) -> Any:
    """Draw a row from each ring that ``ring`` names by the number of its task; leaves (*ring.shape, ...)."""
    return _draw(replay, key, ring.shape, lambda rings, index: rings[ring, index])


def _draw(replay: Replay, key: Key, shape: tuple[int, ...], take: Callable) -> Any:
    """Draw slots and environments of ``shape``, all alike, and ``take(rings, index)`` from rings (T, H E, ...)."""
    num_slots, held = jax.tree.leaves(replay.rows)[0].shape[1:3]
    num_envs = held * shares.count()
    index = jax.random.randint(key, shape, 0, replay.size * num_envs)
    slot, env = index // num_envs, index % num_envs
    flat = lambda x: x.reshape(len(x), num_slots * held, *x.shape[3:])
    rows = jax.tree.map(lambda x: take(flat(x), slot * held + env % held), replay.rows)
    return shares.pick(rows, env // held)
