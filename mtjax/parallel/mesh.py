"""Which devices share a run's seeds, and each seed's environments, and how arrays are put onto them."""

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mtjax.parallel import collectives
from mtjax.types import InputError

REPLICATED, BY_SEED = PartitionSpec(), PartitionSpec("seeds")  # what every device has whole; leaves with a leading S
BY_WORLD = PartitionSpec("seeds", None, collectives.AXIS)  # leaves (S, T, E, ...)
LEAST_WORLDS = 2048
"""Worlds that a device keeps, at the least, when a seed's environments are shared out: fewer do not fill a GPU."""


def mesh_for(seeds: int, num_tasks: int, num_envs: int, most: int | None = None) -> Mesh | None:
    """The devices that share ``seeds`` evenly, and each seed's environments where devices are left over.

    Of each process these are as many as divide its seeds, times as many as divide the environments of a task and leave
    each device ``LEAST_WORLDS``; ``most`` of them at most. None if it is one device.

    Raises:
        InputError: there are several processes, and their number does not divide the seeds.
    """
    processes = jax.process_count()
    if seeds % processes:
        raise InputError(f"{processes} processes cannot share {seeds} seeds evenly; --seeds must be a multiple")
    owned = [[device for device in jax.devices() if device.process_index == i] for i in range(processes)]
    share, fewest = seeds // processes, min(map(len, owned))
    usable = fewest if most is None else min(most, fewest)
    groups = max(n for n in range(1, usable + 1) if share % n == 0)
    worlds = share // groups * num_tasks * num_envs
    fits = lambda n: n == 1 or (num_envs % n == 0 and worlds // n >= LEAST_WORLDS)
    each = max(n for n in range(1, usable // groups + 1) if fits(n))
    if processes * groups * each == 1:
        return None
    used = np.array([device for devices in owned for device in devices[: groups * each]])
    return Mesh(used.reshape(-1, each), ("seeds", collectives.AXIS))


def describe(mesh: Mesh | None, seeds: int, num_envs: int) -> str:
    """A line on how many devices share the seeds, and their environments; empty if there is but one."""
    groups, each = (1, 1) if mesh is None else mesh.devices.shape
    used, found, own = groups * each, jax.device_count(), seeds // groups
    if found == 1:
        return ""
    hosts = f" in {jax.process_count()} processes" if jax.process_count() > 1 else ""
    split = "each" if each == 1 else f"every {each}, {num_envs // each} of each task's {num_envs} environments on each"
    needed = "; the others would need more seeds or environments, or a number of them that divides evenly"
    rest = "" if used == found else needed
    return f"devices: {used} of {found}{hosts}, {own} seed{'s' * (own > 1)} on {split}{rest}"


def replicate(mesh: Mesh | None, tree: Any) -> Any:
    """Put arrays that all processes hold alike whole onto every device."""
    return tree if mesh is None else _place(NamedSharding(mesh, REPLICATED), tree)


def shard_by_seed(mesh: Mesh | None, tree: Any) -> Any:
    """Put arrays (S, ...) that all processes hold alike onto the devices of their seeds."""
    return tree if mesh is None else _place(NamedSharding(mesh, BY_SEED), tree)


def _place(sharding: NamedSharding, tree: Any) -> Any:
    def place(x):
        whole = np.asarray(x)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(place, tree)
