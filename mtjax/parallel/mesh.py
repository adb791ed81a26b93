"""The mesh of devices that share a run's seeds and environments, and the placement of arrays on it."""

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mtjax.parallel import collectives
from mtjax.types import InputError

REPLICATED = PartitionSpec()  # whole on every device
BY_SEED = PartitionSpec(collectives.SEEDS)  # split along a leading S
BY_WORLD = PartitionSpec(collectives.SEEDS, None, collectives.AXIS)  # leaves (S, T, E, ...)
LEAST_WORLDS = 2048
"""Least number of worlds per device when devices share a seed's environments. Fewer do not fill a GPU."""


def mesh_for(seeds: int, num_tasks: int, num_envs: int, most: int | None = None) -> Mesh | None:
    """Return the mesh of devices that share ``seeds`` evenly, or None if that is one device.

    Devices that are left over share the environments of each seed, if their number divides a task's environments and
    leaves each device ``LEAST_WORLDS`` worlds. At most ``most`` devices of each process are used.

    Raises:
        InputError: the number of processes does not divide the seeds.
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
    return Mesh(used.reshape(-1, each), (collectives.SEEDS, collectives.AXIS))


def describe(mesh: Mesh | None, seeds: int, num_envs: int) -> str:
    """Return a line on how devices share seeds and environments; an empty string for one device."""
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
    """Copy arrays that are equal in all processes to every device."""
    return tree if mesh is None else _place(NamedSharding(mesh, REPLICATED), tree)


def shard_by_seed(mesh: Mesh | None, tree: Any) -> Any:
    """Split arrays (S, ...) that are equal in all processes over the devices of their seeds."""
    return tree if mesh is None else _place(NamedSharding(mesh, BY_SEED), tree)


def _place(sharding: NamedSharding, tree: Any) -> Any:
    def place(x):
        whole = np.asarray(x)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(place, tree)
