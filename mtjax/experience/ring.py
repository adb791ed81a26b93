"""Rings hold the latest transitions of every task on the device, and are sampled equally for all tasks.

A ring is a row of slots, each with one step of every environment. So devices share it as they share environments.

Slots behind those of the ring may hold recalled segments: each is a run of steps of one environment that the ring has
already overwritten, and that ``store`` has brought back from the host. A drawn window lies in the ring or in a segment,
and never crosses from one to the other.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.parallel import collectives
from mtjax.types import Array, Key


class Recalled(NamedTuple):
    """Says where recalled segments are, and how often to draw from them."""

    slots: Array  # (K, L) int32, those of K rows of segments of L steps; each row has one segment of every column E
    next: Array  # () int32, the row of segments to overwrite next
    filled: Array  # () int32, rows of segments that hold steps
    share: Array  # () float32, share of draws that come from segments


class Ring(NamedTuple):
    """Holds the rings of all tasks, which are filled at the same pace."""

    rows: Any  # leaves (T, H, E, ...); with recalled segments (T, H + K L, E, ...)
    position: Array  # () int32, the slot where the next step goes
    size: Array  # () int32, slots written so far
    recalled: Recalled | None = None  # None where the ring is all there is


OVER_SEEDS = Ring(rows=0, position=None, size=None, recalled=None)  # type: ignore
"""The axes of rings under a map over seeds."""


def init(item: Any, num_tasks: int, num_slots: int, num_envs: int, segments: tuple[int, int] = (0, 0)) -> Ring:
    """Return empty rings for items like ``item`` (no leading axes), and room for ``segments`` (K, L) if K > 0."""
    count, length = segments
    shape = (num_tasks, num_slots + count * length, num_envs)
    rows = jax.tree.map(lambda x: jnp.zeros((*shape, *jnp.shape(x)), jnp.result_type(x)), item)
    slots = num_slots + jnp.arange(count * length, dtype=jnp.int32).reshape(segments)
    none = jnp.int32(0)
    return Ring(rows, none, none, Recalled(slots, none, none, jnp.float32(0)) if count else None)


def num_slots(ring: Ring) -> int:
    """Return the number of slots H of a ring, without those of recalled segments."""
    behind = 0 if ring.recalled is None else ring.recalled.slots.size
    return jax.tree.leaves(ring.rows)[0].shape[1] - behind


def add(ring: Ring, items: Any) -> Ring:
    """Write items (T, H, E, ...) to the next H slots, over the oldest items; H divides the number of slots."""
    slots, count = num_slots(ring), jax.tree.leaves(items)[0].shape[1]
    write = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, ring.position, axis=1)
    return ring._replace(
        rows=jax.tree.map(write, ring.rows, items),
        position=(ring.position + count) % slots,
        size=jnp.minimum(ring.size + count, slots),
    )


def newest(ring: Ring, count: int) -> Any:
    """Return the latest ``count`` steps of every environment in the order of time, leaves (T, count, E, ...)."""
    slots = (ring.position - count + jnp.arange(count)) % num_slots(ring)
    return jax.tree.map(lambda rows: rows[:, slots], ring.rows)


def recall(ring: Ring, segments: Any) -> Ring:
    """Write segments (T, F L, E, ...) over the F rows of segments that are there for longest; F is at most K."""
    assert ring.recalled is not None
    count, length = ring.recalled.slots.shape
    new = jax.tree.leaves(segments)[0].shape[1] // length
    places = ring.recalled.slots[(ring.recalled.next + jnp.arange(new)) % count, 0]

    def write(i: Array, rows: Any) -> Any:  # which writes in place, as a scatter may not
        one = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, i * length, length, axis=1), segments)
        put = lambda rows, new: jax.lax.dynamic_update_slice_in_dim(rows, new, places[i], axis=1)
        return jax.tree.map(put, rows, one)

    recalled = ring.recalled._replace(
        next=(ring.recalled.next + new) % count, filled=jnp.minimum(ring.recalled.filled + new, count)
    )
    return ring._replace(rows=jax.lax.fori_loop(0, new, write, ring.rows), recalled=recalled)


def weigh(ring: Ring, stored: Array) -> Ring:
    """Set the share of draws from segments, so that all of the last ``stored`` () steps are drawn alike."""
    assert ring.recalled is not None
    share = jnp.where(ring.recalled.filled > 0, 1 - ring.size / jnp.maximum(stored, ring.size), 0)
    return ring._replace(recalled=ring.recalled._replace(share=share.astype(jnp.float32)))


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
    slots, held = jax.tree.leaves(ring.rows)[0].shape[1:3]
    num_envs = held * collectives.count()
    starts = ring.size - window + 1 if window else ring.size
    index = jax.random.randint(key, shape, 0, starts * num_envs)
    slot, env = index // num_envs, index % num_envs
    if window:
        oldest = ring.position - ring.size
        slot = (oldest + slot[..., None] + jnp.arange(window)) % num_slots(ring)
    if ring.recalled is not None:
        slot, env = _or_recalled(ring.recalled, key, slot, env, window, num_envs)
    holder = env // held
    env = env[..., None] if window else env
    flat = lambda x: x.reshape(len(x), slots * held, *x.shape[3:])
    rows = jax.tree.map(lambda x: take(flat(x), slot * held + env % held), ring.rows)
    return collectives.pick(rows, holder)


def _or_recalled(
    recalled: Recalled, key: Key, slot: Array, env: Array, window: int, num_envs: int
) -> tuple[Array, Array]:
    """Replace slots (...), or of windows (..., W), and columns (...) by those of segments, in a share of the draws."""
    choice_key, index_key = jax.random.split(jax.random.fold_in(key, 1))
    starts = recalled.slots.shape[1] - max(window, 1) + 1
    index = jax.random.randint(index_key, env.shape, 0, jnp.maximum(recalled.filled, 1) * num_envs * starts)
    row, column, start = index // (num_envs * starts), index // starts % num_envs, index % starts
    chosen = jax.random.uniform(choice_key, env.shape) < recalled.share
    if not window:
        return jnp.where(chosen, recalled.slots[row, start], slot), jnp.where(chosen, column, env)
    found = recalled.slots[row[..., None], start[..., None] + jnp.arange(window)]
    return jnp.where(chosen[..., None], found, slot), jnp.where(chosen, column, env)
