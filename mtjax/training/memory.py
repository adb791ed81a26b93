"""Memory: how much a program needs, and how to split it into rounds that fit."""

import contextlib
import dataclasses
import math
import os
import re
from collections.abc import Iterator, Sequence

import jax
import numpy as np

from mtjax.config import RunConfig
from mtjax.loop import TrainState
from mtjax.training import checkpoint
from mtjax.training.policy import state_shapes
from mtjax.types import InputError

_USABLE_SHARE = 0.9  # of the available memory, for one program
_EXHAUSTED = re.compile("RESOURCE_EXHAUSTED|[Oo]ut of memory|allocate memory")
_AGENT_COPIES = 3  # of the agent beside its state: gradients, steps, and the new state


def available_bytes() -> float:
    """Return the memory in bytes: $MTJAX_MEMORY (in GB), else the devices', else the machine's.

    Raises:
        InputError: $MTJAX_MEMORY is not a number.
    """
    given = os.environ.get("MTJAX_MEMORY", "")
    try:
        if given:
            return float(given) * 1e9
    except ValueError:
        raise InputError(f"MTJAX_MEMORY is a number of GB, not {given!r}") from None
    return physical_bytes()


def physical_bytes() -> float:
    """Return the memory of this process's devices in bytes, on a CPU the machine's."""
    known = [(device.memory_stats() or {}).get("bytes_limit", 0) for device in jax.local_devices()]
    return sum(known) or os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def required_bytes(config: RunConfig) -> int:
    """Return roughly the bytes that one point takes with all its seeds: its state and an update's copies.

    On a CPU the state that is being saved lies in the same memory.
    """
    state = state_shapes(dataclasses.replace(config, points=config.points[:1]))
    saved = checkpoint.size_of(state) if jax.default_backend() == "cpu" else 0
    return checkpoint.size_of(state) + saved + _AGENT_COPIES * checkpoint.size_of(state.agent)


def require_room(state: TrainState) -> None:
    """Check that a training state fits into memory at all.

    Raises:
        InputError: it is larger than the memory of all devices.
    """
    held, agent = checkpoint.size_of(state), checkpoint.size_of(state.agent)
    limit = physical_bytes() * jax.process_count()
    if held <= limit:
        return
    fix = "--agent.hidden or --seeds" if 2 * agent > held else "--replay-size, --num-envs or --seeds"
    raise InputError(
        f"the run needs {held / 1e9:,.1f} GB ({agent / 1e9:,.1f} GB of networks, {(held - agent) / 1e9:,.1f} GB of "
        f"worlds and data) and there are {limit / 1e9:,.1f} GB; lower {fix}"
    )


@contextlib.contextmanager
def explaining() -> Iterator[None]:
    """Say what to do where a program runs out of memory.

    Raises:
        InputError: it does.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        line = str(error).strip().splitlines()[0][:150]
        if not _EXHAUSTED.search(line):
            raise
        fix = "lower --num-envs, --batch-size, --eval-episodes, --replay-size or --seeds"
        raise InputError(f"out of memory ({line}); {fix}") from None


def seeds_exceed_memory(config: RunConfig) -> bool:
    """Return whether several seeds do not fit into memory together. A single seed is always tried."""
    return (
        config.plan.seeds > 1 and not config.distributed and required_bytes(config) > available_bytes() * _USABLE_SHARE
    )


def split_to_fit(config: RunConfig, limit: float) -> list[RunConfig]:
    """Split a program into parts that fit into ``limit`` bytes: fewer points each, or fewer seeds of one point."""
    points, seeds = config.points or ({},), config.plan.seeds
    fitting = max(math.floor(limit * _USABLE_SHARE * seeds / required_bytes(config)), 1)  # seeds of any points at once
    if fitting < seeds:
        alone = [dataclasses.replace(config, points=config.points and (point,)) for point in points]
        return [part for one in alone for part in _split_seeds(one, fitting)]
    parts = _even_parts(range(len(points)), fitting // seeds)
    return [dataclasses.replace(config, points=config.points and tuple(points[i] for i in part)) for part in parts]


def _split_seeds(config: RunConfig, fitting: int) -> list[RunConfig]:
    plan = config.plan
    parts = _even_parts(range(plan.seed, plan.seed + plan.seeds), fitting)
    plans = [dataclasses.replace(plan, seed=int(part[0]), seeds=len(part)) for part in parts]
    return [dataclasses.replace(config, plan=each) for each in plans]


def _even_parts(numbers: Sequence[int], most: int) -> list[np.ndarray]:
    """Split numbers into even parts of at most ``most``."""
    return np.array_split(np.asarray(numbers), math.ceil(len(numbers) / most))


def describe(config: RunConfig, count: int, limit: float) -> str:
    """Return a line on a program's settings, its memory and its rounds."""
    settings, seeds = max(len(config.points), 1), config.plan.seeds
    name = " ".join(config.sweep) or f"{config.agent} on {config.env}"
    return (
        f"{name}: {settings} setting{'s' * (settings > 1)} of {seeds} seed{'s' * (seeds > 1)}; "
        f"each setting needs about {required_bytes(config) / 1e6:,.0f} MB of {limit * _USABLE_SHARE / 1e6:,.0f} MB, "
        f"so all run in {count} round{'s' * (count > 1)}"
    )
