"""A store keeps more steps in the host's memory than the device has room for.

Between chunks the latest steps go from the device to the store, and segments of older ones come back. A segment is a
run of steps of one environment, so that stacks of pictures and multi-step returns can be rebuilt inside it. Its
environment and its first step are drawn uniformly from the last M steps that the device's ring has overwritten.

The device draws from the ring in a share A / M of all draws, A being the steps in the ring, and from segments in the
others (``ring.weigh``). So every one of the last M steps is drawn alike, but for two things. A segment stays on the
device for up to Q rounds of C steps each, and grows older meanwhile, by up to Q C / 2 on average. And its L steps reach
the ends of their range less often than the middle. Of all draws at most a share ((Q C + L) / 2 + W) / M falls on other
steps than if they were uniform, W being the length of a window. With M of 100 C and a ring of M / 10 that is 2%. The
draws of one round share their segments, so it takes many rounds until all steps have been drawn.

Why not JAX's memory kinds: on NVIDIA GPUs all arrays in ``pinned_host`` share a pool of 64 GB by default, and XLA
gathers and scatters there by slow host computing or not at all. A draw of single steps by the device would also wait
for many small reads over the bus. Here NumPy collects whole segments beside the chunk that is running.
"""

from typing import Any

import jax
import numpy as np

_RECALLS = 4
"""Recalled steps for each new one, in every round. So an average step comes back four times while it is stored."""
_WINDOWS = 8
"""Length of a segment in windows. All but the last window of a segment can begin a transition."""
_SHORTEST = 16
"""Least length of a segment in steps. Longer ones are collected faster."""


def segments(num_slots: int, window: int, grain: int) -> tuple[int, int]:
    """Return rows K and length L of the segments that take half of ``num_slots``; L is a multiple of ``grain``.

    K is 0 if there is no room for a single one.
    """
    half = num_slots // 2
    longest = half // grain * grain
    length = min(-(-max(_WINDOWS * window, _SHORTEST) // grain) * grain, longest)
    return (half // length, length) if length >= max(window, 1) else (0, grain)


def recalled_rows(chunk: int, count: int, length: int) -> int:
    """Return how many of ``count`` rows of segments come back after a chunk of so many steps."""
    return min(count, -(-_RECALLS * chunk // length))


class Store:
    """Keeps the last M steps of every environment, rows (S, T, M, E, ...) in NumPy."""

    def __init__(self, like: Any, num_slots: int, count: int = 0):
        """Make an empty store for rows ``like`` (S, T, H, E, ...), to which ``count`` steps were added before."""
        self.rows = jax.tree.map(lambda x: np.zeros((*x.shape[:2], num_slots, *x.shape[3:]), x.dtype), like)
        self.num_slots, self.count, self.begun = num_slots, count, count

    @property
    def first(self) -> int:
        """Return the number of the oldest step that is stored."""
        return max(self.begun, self.count - self.num_slots)

    def add(self, items: Any) -> None:
        """Store the next steps of every environment, leaves (S, T, H, E, ...), over the oldest."""
        self.count += jax.tree.leaves(items)[0].shape[2]
        self._write(items, self.count)

    def add_before(self, items: Any) -> None:
        """Store the steps before the first that is stored; those that there is no room for are left out."""
        given = jax.tree.leaves(items)[0].shape[2]
        kept = min(given, self.num_slots - (self.count - self.begun))
        self._write(jax.tree.map(lambda x: x[:, :, given - kept :], items), self.begun)
        self.begun -= kept

    def _write(self, items: Any, end: int) -> None:
        """Write steps (S, T, H, E, ...). The last one has the number ``end`` - 1."""
        given = jax.tree.leaves(items)[0].shape[2]
        place = (end - given) % self.num_slots
        head = min(given, self.num_slots - place)

        def write(rows: np.ndarray, new: np.ndarray) -> None:
            rows[:, :, place : place + head] = new[:, :, :head]
            rows[:, :, : given - head] = new[:, :, head:]

        jax.tree.map(write, self.rows, items)

    def draw(self, keys: np.ndarray, chunk: int, latest: int, number: int, length: int) -> Any:
        """Draw ``number`` rows of segments of ``length`` steps, leaves (S, T, number * length, E, ...).

        Args:
            keys: (S, n) of every seed; what is drawn depends on them and on the number of steps added so far.
            chunk: steps of every environment until the segments are on the device.
            latest: how many steps the device's ring will hold by then; they are not drawn.

        Returns:
            the segments, or None if there are too few steps.
        """
        end = self.count + chunk
        first, last = max(end - self.num_slots, self.first), end - latest
        if last - first < length:
            return None
        num_tasks, _, num_envs = jax.tree.leaves(self.rows)[0].shape[1:4]
        shape = (num_tasks, number, 1, num_envs)

        def places(key: np.ndarray) -> np.ndarray:
            random = np.random.default_rng([*key.tolist(), self.count])
            column, start = (random.integers(*ends, shape) for ends in ((0, num_envs), (first, last - length + 1)))
            slots = (start + np.arange(length)[:, None]) % self.num_slots
            task = np.arange(num_tasks)[:, None, None, None]
            return ((task * self.num_slots + slots) * num_envs + column).reshape(num_tasks, -1, num_envs)

        index = [places(key) for key in keys]

        def take(rows: np.ndarray) -> np.ndarray:
            item = rows.shape[4:]
            found = np.empty((len(rows), *index[0].shape, *item), rows.dtype)
            for one, out, where in zip(rows, found, index, strict=True):
                np.take(one.reshape(-1, *item), where, axis=0, out=out, mode="clip")  # other modes copy once more
            return found

        return jax.tree.map(take, self.rows)
