"""Several processes of one run, on one host or on many, joined by ``jax.distributed``."""

import contextlib
import functools
import os
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any, ParamSpec

import jax
import numpy as np
from jax.experimental import multihost_utils

from mtjax.types import InputError

P = ParamSpec("P")
_VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
_LAUNCHERS = (
    "SLURM_JOB_ID",
    "OMPI_MCA_orte_hnp_uri",
    "TPU_WORKER_ID",
    "KUBERNETES_SERVICE_HOST",
)  # variables of launchers that JAX recognises
_LONGEST_PATH = 4096
_PATIENCE = 60  # seconds that a process waits for the others at its end before it stops them


def find_devices() -> None:
    """Let JAX find the devices of a single process in a thread. Drivers take long, and Python imports meanwhile."""

    def find() -> None:
        with contextlib.suppress(RuntimeError):  # which the first to ask for a device meets again
            jax.devices()

    Thread(target=find, name="devices").start()


def initialise() -> None:
    """Join the processes of a run. Call it before anything touches a device.

    JAX finds the other processes by itself under SLURM, Open MPI, Kubernetes and on TPUs. Elsewhere each process needs
    three variables: JAX_COORDINATOR_ADDRESS (host:port of process 0), JAX_NUM_PROCESSES, and JAX_PROCESS_ID (its own
    number, from 0).

    Raises:
        InputError: there is no known launcher and a variable is missing, or the processes do not find each other.
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
    """Return whether this is process 0, the only one that writes and prints."""
    return jax.process_index() == 0


def wait_for_all() -> None:
    """Wait until every process is here, so that none measures the compile time of another."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices("mtjax")


def gather(tree: Any) -> Any:
    """Return the whole arrays (S, ...) on every host."""
    return jax.device_get(tree) if jax.process_count() == 1 else multihost_utils.process_allgather(tree, tiled=True)


def largest(number: int) -> int:
    """Return the largest of all processes' numbers. Every process must call this."""
    return number if jax.process_count() == 1 else int(np.max(multihost_utils.process_allgather(np.asarray(number))))


def by_first(choose: Callable[P, Path]) -> Callable[P, Path]:
    """Return a function that runs in the first process alone and returns its path in every process.

    Every process must call it, with the same arguments.

    Raises:
        InputError: the first process could not choose a path. It reports the reason itself.
    """

    @functools.wraps(choose)
    def chosen(*args: P.args, **kwargs: P.kwargs) -> Path:
        if jax.process_count() == 1:
            return choose(*args, **kwargs)
        text, failed = b"", None
        if is_first():
            try:
                text = os.fsencode(choose(*args, **kwargs).absolute())
            except (OSError, InputError) as error:
                failed = error
        told = multihost_utils.broadcast_one_to_all(np.frombuffer(text.ljust(_LONGEST_PATH, b"\0"), np.uint8))
        path = bytes(told).rstrip(b"\0")
        if failed is not None:
            raise failed
        if not path:
            raise InputError("process 0 could not use the run's folder, and says why")
        return Path(os.fsdecode(path))

    return chosen
