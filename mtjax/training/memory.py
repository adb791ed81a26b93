"""Memory: how much a program needs, and how to split it into rounds that fit."""

import contextlib
import dataclasses
import math
import os
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from mtjax.config import RunConfig
from mtjax.experience.replay import segments_of
from mtjax.experience.store import recalled_rows
from mtjax.frames import PICTURES, shown
from mtjax.learning.loop import Settings, TrainState
from mtjax.saved import checkpoint
from mtjax.saved.policy import state_shapes
from mtjax.types import Agent, InputError, Spec

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
    return sum(known) or host_bytes()


def host_bytes() -> float:
    """Return the machine's memory in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


class Needs(NamedTuple):
    """Holds the bytes that a run needs with all its seeds."""

    agent: int  # networks and optimisers
    data: int  # worlds and replay on the devices
    rollout: int  # steps that are learned from and not kept; 0 for a replay
    moved: int  # steps that a round of the exchange with the host holds on either side; 0 for no exchange
    host: int  # the replay's store in the host's memory, with ``moved``

    @staticmethod
    def of(state: TrainState, spec: Spec, agent: Agent, settings: Settings) -> "Needs":
        """Return what a training state, or its shapes, needs."""
        experience: Any = agent.experience
        networks, slots = checkpoint.size_of(state.agent), experience.host_slots(settings.num_envs)
        data = checkpoint.size_of(state) - networks
        seeds, tasks = state.worlds.age.shape[:2]
        rollout = seeds * tasks * experience.rollout_bytes(spec, settings.num_envs)
        if not slots:
            return Needs(networks, data, rollout, 0, 0)
        rows = state.data.ring.rows
        each = checkpoint.size_of(rows) // jax.tree.leaves(rows)[0].shape[2]
        count, length = segments_of(experience, spec, settings.num_envs)
        moved = settings.chunk_steps + recalled_rows(settings.chunk_steps, count, length) * length
        return Needs(networks, data, rollout, moved * each, (slots + moved) * each)

    @property
    def state(self) -> int:
        """Bytes of the training state."""
        return self.agent + self.data

    @property
    def device(self) -> int:
        """Bytes on the devices; of a CPU, where the store lies in the same memory, all."""
        return self.state + self.rollout + self.moved + (self.host if jax.default_backend() == "cpu" else 0)


def _needs(config: RunConfig) -> Needs:
    """Return what one point of a run needs."""
    state = state_shapes(dataclasses.replace(config, points=config.points[:1]))
    return Needs.of(state, config.family.spec, config.learner, config.training)


def required_bytes(config: RunConfig) -> int:
    """Return roughly the bytes on devices that one point takes with all its seeds: state, rollouts, an update's copies.

    On a CPU the state that is being saved lies in the same memory.
    """
    return _with_copies(_needs(config))


def _with_copies(needs: Needs) -> int:
    saved = needs.state if jax.default_backend() == "cpu" else 0
    return needs.device + saved + _AGENT_COPIES * needs.agent


def require_room(needs: Needs, spec: Spec) -> None:
    """Check that a run fits into memory at all.

    Raises:
        InputError: it is larger than the memory of all devices, or its store than that of the host.
    """
    limit, gigabytes = physical_bytes() * jax.process_count(), lambda x: f"{x / 1e9:,.1f} GB"
    if needs.device > limit:
        parts = [
            (needs.agent, "networks"),
            (needs.data + needs.moved, "worlds and data"),
            (needs.rollout, "rollouts"),
            (needs.device - needs.state - needs.rollout - needs.moved, "the host's replay"),
        ]
        told = ", ".join(f"{gigabytes(size)} of {name}" for size, name in parts if size)
        raise InputError(
            f"the run needs {gigabytes(needs.device)} ({told}) and there are {gigabytes(limit)}; lower "
            + _smaller(needs, spec)
        )
    if needs.host > host_bytes():
        raise InputError(
            f"the replay on the host needs {gigabytes(needs.host)} and the machine has {gigabytes(host_bytes())}; "
            f"lower --host-replay-size, --seeds or --chunk-steps{_grey(spec)}"
        )


def _smaller(needs: Needs, spec: Spec) -> str:
    """Return the settings that make most of a run smaller."""
    if 2 * needs.agent > needs.device:
        return "--agent.hidden or --seeds"
    if needs.rollout:
        return "--agent.unroll, --num-envs or --seeds" + _grey(spec)
    return "--replay-size, --num-envs or --seeds" + _further(needs, spec)


def _further(needs: Needs, spec: Spec) -> str:
    """Return clauses on what else makes room for a replay."""
    apart = not needs.host and jax.default_backend() != "cpu"
    moved = "; with --host-replay-size=N the host keeps N transitions beside a smaller replay" if apart else ""
    shorter = ", or --chunk-steps and --host-replay-size" if needs.host else ""
    return shorter + _grey(spec) + moved


def _grey(spec: Spec) -> str:
    """Return a clause on smaller pictures, if a family has coloured ones."""
    coloured = shown(spec.obs) and spec.obs[PICTURES].shape[-1] == 3
    return "; with --env.grey pictures take a third" if coloured else ""


def tell(data: Any, needs: Needs, kind: str, seeds: int) -> list[str]:
    """Return lines on the memory that a run takes, and each of several seeds. Its ``data`` are of a ``kind``."""
    megabytes = lambda size: f"{size / 1e6:,.0f} MB"
    each = lambda size: f"; {megabytes(size / seeds)} a seed" if seeds > 1 else ""
    state = (
        f"{megabytes(needs.state)} of state, of which {megabytes(checkpoint.size_of(data))} {kind}{each(needs.state)}"
    )
    host = f"{megabytes(needs.host)} of replay{each(needs.host)}; a round moves {megabytes(needs.moved)}"
    return [f"memory: {state}"] + [f"memory of the host: {host}"] * (needs.host > 0)


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
    seeds = config.plan.seeds
    return seeds > 1 and not config.distributed and _fitting(config, available_bytes()) < seeds


def _fitting(config: RunConfig, limit: float) -> int:
    """Return how many seeds of any points fit at once into ``limit`` bytes, and their stores into the host's memory."""
    needs = _needs(config)
    shares = [limit / _with_copies(needs)]
    if needs.host and jax.default_backend() != "cpu":
        shares.append(host_bytes() / needs.host)
    return math.floor(min(shares) * _USABLE_SHARE * config.plan.seeds)


def split_to_fit(config: RunConfig, limit: float) -> list[RunConfig]:
    """Split a program into parts that fit into ``limit`` bytes: fewer points each, or fewer seeds of one point."""
    points, seeds = config.points or ({},), config.plan.seeds
    fitting = max(_fitting(config, limit), 1)
    if fitting < seeds:
        alone = [dataclasses.replace(config, points=config.points and (point,)) for point in points]
        return [part for one in alone for part in _split_seeds(one, fitting)]
    parts = _even_parts(range(len(points)), fitting // seeds)
    return [dataclasses.replace(config, points=config.points and tuple(points[i] for i in part)) for part in parts]


def _split_seeds(config: RunConfig, fitting: int) -> list[RunConfig]:
    plan = config.plan
    parts = _even_parts(plan.all_seeds, fitting)
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
