"""Steps of worlds that live on the host, as programs make them: one call takes all worlds of a family."""

import dataclasses
import functools
import hashlib
import io
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from mtjax.envs.engines import host
from mtjax.envs.hosted.spaces import Reader, TreeReader
from mtjax.envs.hosted.worlds import GONE, TERMINATED, TRUNCATED, Pool, Worlds
from mtjax.parallel.axes import over_worlds
from mtjax.types import Array, Key, Step, Task

_known: dict[str, Worlds] = {}  # by a hash of the family


class HostedState(NamedTuple):
    """What programs hold of a world."""

    number: Array  # () int32, that of its set
    place: Array  # () int32, in the set
    clock: Array  # () int32, of the set
    obs: Array  # the last observation as the host has it, for worlds that are gone


@dataclasses.dataclass(frozen=True, eq=False)
class Calls:
    """The calls that programs make to the host for a family."""

    environment: str
    pool: Callable[[int, bool], Pool]
    reader: Reader | TreeReader
    about: str  # all that makes the family what it is
    names: dict[str, str] = dataclasses.field(default_factory=dict)

    def call(self, act: str, kinds: str, *values: Array) -> list[Array]:
        """Call the host with leaves (S, T, E, ...); i and f are results of int32 and float32, o is observations."""
        axes, seen = values[0].shape, self.reader
        count, shapes = math.prod(axes), {"i": ((), jnp.int32), "f": ((), jnp.float32), "o": (seen.shape, seen.dtype)}
        results = [jax.ShapeDtypeStruct((count, *shapes[kind][0]), shapes[kind][1]) for kind in kinds]
        flat = [x.reshape(count, *x.shape[3:]) for x in values]
        found = host.call_once(self.provide(act), results, *flat)
        return [x.reshape(*axes, *x.shape[1:]) for x in found]

    def targets(self) -> dict[str, list[str]]:
        """Return the arguments of ``provide`` for every call until now, by the call's name in programs."""
        return {name: [act] for act, name in list(self.names.items())}

    def provide(self, act: str) -> str:
        """Give the host's function for ``act`` a name in programs, and return it. It is the same in every process."""
        name = f"hosted_{act}_{self.digest}"
        worlds = self.worlds
        if name not in host.names():
            host.register(name, functools.partial(_run, self.digest, act))
        assert worlds is _known[self.digest]
        self.names[act] = name
        return name

    def load_kernels(self) -> bool:
        """Do nothing. Return False, as programs record nothing."""
        return False

    @property
    def worlds(self) -> Worlds:
        """Return the worlds of all equal families."""
        return _known.setdefault(self.digest, Worlds(self.environment, self.pool))

    @cached_property
    def digest(self) -> str:
        """Return a short hash of the family."""
        return hashlib.sha256(self.about.encode()).hexdigest()[:16]


def _run(digest: str, act: str, *arrays: np.ndarray) -> None:
    _known[digest].acts[act](*arrays)


class Stepped(Protocol):
    """A family whose worlds the host steps."""

    @property
    def simulator(self) -> Calls: ...


# Worlds, leaves (S, T, E, ...).


def reset_worlds(family: Stepped, tasks: Task, keys: Key) -> Step:
    """Begin an episode in every world of a new set."""
    nothing = jnp.zeros(keys.shape, jnp.int32)
    return _begin(family, tasks, keys, jnp.ones(keys.shape, bool), nothing, nothing)


def renew_worlds(family: Stepped, tasks: Task, keys: Key, mask: Array, states: HostedState) -> Step:
    """Begin an episode in the worlds of ``mask`` (S, T, E), and in no others."""
    return _begin(family, tasks, keys, mask, states.number, states.clock)


def _begin(family: Stepped, tasks: Task, keys: Key, mask: Array, numbers: Array, clocks: Array) -> Step:
    calls = family.simulator
    seeds = over_worlds(lambda key: jax.random.randint(key, (), 0, 2**31 - 1))(keys)
    number, clock, obs = calls.call("begin", "iio", numbers, clocks, jnp.int32(mask), tasks.row, seeds)
    place = jnp.arange(math.prod(keys.shape), dtype=jnp.int32).reshape(keys.shape)
    never = jnp.zeros(keys.shape, bool)
    state = HostedState(number, place, clock, obs)
    return Step(state, calls.reader.show(obs), jnp.zeros(keys.shape), never, truncated=never)


def step_worlds(family: Stepped, tasks: Task, states: HostedState, actions: Array) -> Step:
    """Step every world by its action (S, T, E, ...)."""
    calls = family.simulator
    clock, reward, flags, obs = calls.call("step", "ifio", states.number, states.clock, actions)
    gone = (flags & GONE) > 0
    obs = jnp.where(gone.reshape(*gone.shape, *[1] * (obs.ndim - 3)), states.obs, obs)
    truncated = (flags & (TRUNCATED | GONE)) > 0
    new = states._replace(clock=clock, obs=obs)
    return Step(new, calls.reader.show(obs), reward, (flags & TERMINATED) > 0, truncated=truncated)


# A single world.


def reset(family: Stepped, task: Task, key: Key) -> Step:
    """Begin an episode of ``task`` in a set of one world."""
    return _of_one(reset_worlds(family, _one(task), key.reshape(1, 1, 1)))


def step(family: Stepped, task: Task, state: HostedState, action: Array) -> Step:
    """Advance one step. The state must be the world's last."""
    return _of_one(step_worlds(family, *map(_one, (task, state, action))))


def _one(tree: Any) -> Any:
    return jax.tree.map(lambda x: jnp.asarray(x)[None, None, None], tree)


def _of_one(tree: Any) -> Any:
    return jax.tree.map(lambda x: x[0, 0, 0], tree)


# Films.


def filmed(family: Stepped) -> AbstractContextManager[None]:
    """Return a context in which pictures of all worlds are kept that begin in it."""
    return family.simulator.worlds.filmed()


def pictures(family: Stepped, states: HostedState, width: int, height: int) -> np.ndarray:
    """Return pictures (H, height, width, 3) of a world in its states, leaves (H, ...), that were filmed."""
    number, place = int(states.number[0]), int(states.place[0])
    found = family.simulator.worlds.pictures(number, np.asarray(states.clock), place)
    return np.stack([np.asarray(Image.open(io.BytesIO(each)).resize((width, height))) for each in found])
