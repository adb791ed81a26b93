"""Many devices: each runs seeds of its own, on one host or, by ``jax.distributed``, on several.

Seeds share nothing, so ``jax.shard_map`` splits every program along their axis ``S`` and no device waits for another.
Devices that are left over share the environments of a seed, along ``E``: there ``shares`` brings together what a batch
is made of. Within a device all is as on one: its programs see a training state with fewer seeds and environments. With
a single device to use there is no mesh and nothing is wrapped.
"""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from mtjax import shares
from mtjax.evaluation import evaluate
from mtjax.loop import TrainState, init, run_chunk
from mtjax.replay import Replay
from mtjax.types import InputError

_SAME, _SEEDS = PartitionSpec(), PartitionSpec("seeds")  # what every device has whole; leaves with a leading S
_WORLDS = PartitionSpec("seeds", None, shares.AXIS)  # leaves (S, T, E, ...)
_STATE = TrainState(*[_WORLDS] * len(TrainState._fields))._replace(  # type: ignore
    agent=_SEEDS,
    replay=Replay(PartitionSpec("seeds", None, None, shares.AXIS), _SAME, _SAME),  # type: ignore
    iteration=_SAME,  # type: ignore
    key=_SEEDS,  # type: ignore
    warmup_key=_SEEDS,  # type: ignore
)
LEAST_WORLDS = 2048
"""Worlds that a device keeps, at the least, when a seed's environments are shared out: fewer do not fill a GPU."""

_VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_LAUNCHERS = ("SLURM_JOB_ID", "OMPI_MCA_orte_hnp_uri", "TPU_WORKER_ID", "KUBERNETES_SERVICE_HOST")  # that JAX reads
_LONGEST_PATH = 4096
_PATIENCE = 60  # seconds for which a process that ends, or fails, waits for the others before it ends them as well


class Programs(NamedTuple):
    """The jitted programs of a run, with the arguments of ``loop.init``, ``loop.run_chunk`` and ``evaluate``."""

    init: Any
    chunk: Any
    evaluate: Any


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
    return Mesh(used.reshape(-1, each), ("seeds", shares.AXIS))


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


def programs(mesh: Mesh | None) -> Programs:
    """The programs of a run, each split over the mesh if there is one."""
    if mesh is None:
        return Programs(init, run_chunk, evaluate)
    return Programs(
        _split(mesh, init, (_SAME, _SEEDS, _SEEDS), _STATE),
        _split(mesh, run_chunk, (_SAME, _STATE), (_STATE, _SEEDS), donated=(4,)),
        _split(mesh, evaluate, (_SEEDS, _SAME, _SEEDS, _SAME), _SEEDS),
    )


def _split(mesh: Mesh, program: Callable, inputs: tuple, outputs: Any, donated: tuple[int, ...] = ()) -> Any:
    """A program of three static arguments and ``inputs``, of which each device computes its own part."""

    def split(env, agent, setting, *arguments):
        own = partial(program, env, agent, setting)
        return jax.shard_map(own, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)(*arguments)

    places = [jax.tree.map(partial(NamedSharding, mesh), specs) for specs in (inputs, outputs)]
    return jax.jit(
        split, static_argnums=(0, 1, 2), in_shardings=places[0], out_shardings=places[1], donate_argnums=donated
    )


def everywhere(mesh: Mesh | None, tree: Any) -> Any:
    """Put arrays that all processes hold alike whole onto every device."""
    return tree if mesh is None else _place(NamedSharding(mesh, _SAME), tree)


def by_seed(mesh: Mesh | None, tree: Any) -> Any:
    """Put arrays (S, ...) that all processes hold alike onto the devices of their seeds."""
    return tree if mesh is None else _place(NamedSharding(mesh, _SEEDS), tree)


def _place(sharding: NamedSharding, tree: Any) -> Any:
    def place(x):
        whole = np.asarray(x)
        return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])

    return jax.tree.map(place, tree)


def sharded(mesh: Mesh | None, shapes: TrainState) -> TrainState:
    """Shapes of a training state that also say which devices its leaves are on."""
    if mesh is None:
        return shapes
    put = lambda spec, part: jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=NamedSharding(mesh, spec)), part
    )
    return jax.tree.map(put, _STATE, shapes)


# Several processes.


def initialise() -> None:
    """Join the processes of a run on several hosts; before anything touches a device.

    JAX finds the others by itself under SLURM, Open MPI, Kubernetes and on TPUs. Other launchers say in each process
    where process 0 listens (JAX_COORDINATOR_ADDRESS, host:port), how many processes there are (JAX_NUM_PROCESSES), and
    which of them this is (JAX_PROCESS_ID, from 0).

    Raises:
        InputError: nothing says so, or the processes do not find each other.
    """
    given = {name: os.environ[name] for name in _VARIABLES if os.environ.get(name)}
    launched = any(name in os.environ for name in _LAUNCHERS)
    if len(given) < len(_VARIABLES) and not launched:
        missing = ", ".join(name for name in _VARIABLES if name not in given)
        raise InputError(
            f"--distributed needs a launcher that JAX knows (SLURM's srun, Open MPI, Kubernetes, TPUs), or {missing} "
            "in the environment"
        )
    address, count, index = (given.get(name) for name in _VARIABLES)
    try:
        number = lambda text: None if text is None else int(text)
        jax.distributed.initialize(address, number(count), number(index), shutdown_timeout_seconds=_PATIENCE)
    except (ValueError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0][:150]
        raise InputError(f"--distributed cannot join the other processes: {reason}") from None


def is_first() -> bool:
    """Whether this is the process that writes and prints: the only one, or number 0."""
    return jax.process_index() == 0


def wait() -> None:
    """Go on once every process is here, so that none times how long another compiles."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("mtjax")


def gather(tree: Any) -> Any:
    """Arrays (S, ...) whole, on every host."""
    return jax.device_get(tree) if jax.process_count() == 1 else multihost_utils.process_allgather(tree, tiled=True)


def anywhere(flag: bool) -> bool:
    """Whether a flag is up in any process; all must ask."""
    return flag if jax.process_count() == 1 else bool(np.any(multihost_utils.process_allgather(np.asarray(flag))))


def agreed(choose: Callable[[], Path]) -> Path:
    """The path that the first process chooses, in every process; all must ask.

    Raises:
        InputError: the first process could not choose, and says why itself.
    """
    if jax.process_count() == 1:
        return choose()
    chosen, failed = b"", None
    if is_first():
        try:
            chosen = os.fsencode(choose().absolute())
        except (OSError, InputError) as error:
            failed = error
    told = multihost_utils.broadcast_one_to_all(np.frombuffer(chosen.ljust(_LONGEST_PATH, b"\0"), np.uint8))
    path = bytes(told).rstrip(b"\0")
    if failed is not None:
        raise failed
    if not path:
        raise InputError("process 0 could not make the run's folder")
    return Path(os.fsdecode(path))
