"""Families whose worlds live on the host."""

import abc
import dataclasses
import functools
import hashlib
import io
import json
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageOps

from mtjax.envs.choosing import Acting
from mtjax.envs.engines import host
from mtjax.envs.family import Family
from mtjax.envs.hosted.spaces import Actor, Reader, TreeReader, reader_of
from mtjax.envs.hosted.worlds import GONE, TERMINATED, TRUNCATED, Pool, Worlds
from mtjax.envs.parameters import Parameter
from mtjax.frames import PICTURES, shown
from mtjax.parallel.axes import over_worlds
from mtjax.types import Action, Array, InputError, Key, Spec, Step, Task

_MOST_FRAMES = 16
_MOST_STEPS = 1_000_000
_known: dict[str, Worlds] = {}  # by a hash of the family


class HostedState(NamedTuple):
    """What programs hold of a world."""

    number: Array  # () int32, that of its set
    place: Array  # () int32, in the set
    clock: Array  # () int32, of the set
    obs: Array  # the last observation as the host has it, for worlds that are gone


@dataclasses.dataclass(frozen=True)
class Hosted(Acting, Family):
    """A family whose worlds live outside JAX. All of them are stepped by one call on the host.

    A resumed run begins new episodes, as these worlds cannot be saved. Checkpoints are written after every chunk, as
    what steps on the host may end the process. One device alone can train on them.
    """

    environment: str = ""
    """Its name of the environment."""
    arguments: str = ""
    """Arguments of the environment that do not vary, as JSON: '{"map_name": "8x8"}'."""
    time_limit: int = 0
    """Steps after which an episode is cut off. 0 takes the environment's own limit."""
    frames: int = 4
    """How many of the last pictures an agent sees at once, if it observes pictures."""

    suite: ClassVar[str]  # the first part of its name in mtjax
    forgets: ClassVar[bool] = True

    def __post_init__(self):
        _ = self.fixed
        if not 0 <= self.time_limit <= _MOST_STEPS:
            raise InputError(f"time-limit must be from 0 to {_MOST_STEPS}, not {self.time_limit}")
        if not 1 <= self.frames <= _MOST_FRAMES:
            raise InputError(f"frames must be from 1 to {_MOST_FRAMES}, not {self.frames}")
        super().__post_init__()

    # What a family gives.

    @property
    @abc.abstractmethod
    def spaces(self) -> tuple[Any, Any]:
        """Return Gymnasium's spaces of observations and actions."""

    @property
    @abc.abstractmethod
    def own_limit(self) -> int | None:
        """Return the environment's own limit of an episode's steps, if it has one."""

    @abc.abstractmethod
    def pool(self, count: int, filmed: bool) -> Pool:
        """Return as many worlds."""

    # What every family does.

    @cached_property
    def fixed(self) -> dict[str, Any]:
        """Return the arguments that do not vary."""
        try:
            found = json.loads(self.arguments or "{}")
        except ValueError:
            found = None
        if not isinstance(found, dict):
            raise InputError(f'arguments are JSON, such as \'{{"map_name": "8x8"}}\', not {self.arguments!r}')
        return found

    def arguments_of(self, row: int) -> dict[str, Any]:
        """Return the environment's arguments in a row of the table."""
        varied = {name: self.read_value(name, values[row]) for name, values in self.variation.values.items()}
        return {**self.fixed, **{name.replace("-", "_"): value for name, value in varied.items()}}

    def read_value(self, name: str, value: float) -> Any:
        """Return a parameter's value as the environment takes it."""
        return float(value)

    @cached_property
    def reader(self) -> Reader | TreeReader:
        """Return what reads observations."""
        return reader_of(self.environment, self.spaces[0])

    @cached_property
    def actor(self) -> Actor:
        """Return what reads actions."""
        return Actor(self.environment, self.spaces[1])

    @cached_property
    def observed(self) -> Any:
        """Return the shapes of an observation."""
        return jax.eval_shape(self.reader.show, jax.ShapeDtypeStruct(self.reader.shape, self.reader.dtype))

    @property
    def action(self) -> Action:
        return self.actor.action

    @property
    def name(self) -> str:
        """Return the name by which ``mtjax.make`` makes it."""
        return f"{self.suite}:{self.environment}"

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        limit = self.time_limit or self.own_limit
        if limit is None:
            raise InputError(f"{self.environment} has no time limit; give one, such as --env.time-limit=1000")
        return limit

    @property
    def engine_name(self) -> str:
        """Return what steps its worlds."""
        return self.suite

    @property
    def instruction(self) -> str:
        """Return what all tasks ask for."""
        return f"Earn the rewards of {self.environment}."

    @property
    def pixels(self) -> int:
        """Return the width of pictures, or 0 where observations have none."""
        picture = self.observed[PICTURES].shape if shown(self.observed) else ()
        return picture[1] if len(picture) == 3 else 0

    @cached_property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context, and how many pictures agents should see at once."""
        return super().spec._replace(frames=self.frames if self.pixels else 1)

    # Worlds, leaves (S, T, E, ...).

    def reset_worlds(self, tasks: Task, keys: Key) -> Step:
        """Begin an episode in every world of a new set."""
        nothing = jnp.zeros(keys.shape, jnp.int32)
        return self._begin(tasks, keys, jnp.ones(keys.shape, bool), nothing, nothing)

    def renew_worlds(self, tasks: Task, keys: Key, mask: Array, states: HostedState) -> Step:
        """Begin an episode in the worlds of ``mask`` (S, T, E), and in no others."""
        return self._begin(tasks, keys, mask, states.number, states.clock)

    def _begin(self, tasks: Task, keys: Key, mask: Array, numbers: Array, clocks: Array) -> Step:
        seeds = over_worlds(lambda key: jax.random.randint(key, (), 0, 2**31 - 1))(keys)
        number, clock, obs = self._call("begin", "iio", numbers, clocks, jnp.int32(mask), tasks.row, seeds)
        place = jnp.arange(math.prod(keys.shape), dtype=jnp.int32).reshape(keys.shape)
        never = jnp.zeros(keys.shape, bool)
        state = HostedState(number, place, clock, obs)
        return Step(state, self.reader.show(obs), jnp.zeros(keys.shape), never, truncated=never)

    def step_worlds(self, tasks: Task, states: HostedState, actions: Array) -> Step:
        """Step every world by its action (S, T, E, ...)."""
        clock, reward, flags, obs = self._call("step", "ifio", states.number, states.clock, actions)
        gone = (flags & GONE) > 0
        obs = jnp.where(gone.reshape(*gone.shape, *[1] * (obs.ndim - 3)), states.obs, obs)
        truncated = (flags & (TRUNCATED | GONE)) > 0
        new = states._replace(clock=clock, obs=obs)
        return Step(new, self.reader.show(obs), reward, (flags & TERMINATED) > 0, truncated=truncated)

    def _call(self, act: str, kinds: str, *values: Array) -> list[Array]:
        """Call the host with leaves (S, T, E, ...); i and f are results of int32 and float32, o is observations."""
        axes, seen = values[0].shape, self.reader
        count, shapes = math.prod(axes), {"i": ((), jnp.int32), "f": ((), jnp.float32), "o": (seen.shape, seen.dtype)}
        results = [jax.ShapeDtypeStruct((count, *shapes[kind][0]), shapes[kind][1]) for kind in kinds]
        flat = [x.reshape(count, *x.shape[3:]) for x in values]
        found = host.call_once(self.simulator.provide(act), results, *flat)
        return [x.reshape(*axes, *x.shape[1:]) for x in found]

    # A single world.

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a set of one world."""
        return self._of_one(self.reset_worlds(self._one(task), key.reshape(1, 1, 1)))

    def step(self, task: Task, state: HostedState, action: Array) -> Step:
        """Advance one step. The state must be the world's last."""
        return self._of_one(self.step_worlds(*map(self._one, (task, state, action))))

    def _one(self, tree: Any) -> Any:
        return jax.tree.map(lambda x: jnp.asarray(x)[None, None, None], tree)

    def _of_one(self, tree: Any) -> Any:
        return jax.tree.map(lambda x: x[0, 0, 0], tree)

    # Calls of programs.

    @cached_property
    def simulator(self) -> "Calls":  # type: ignore[override]
        """Return the calls out of XLA."""
        return Calls(self)

    # Films.

    @property
    def seconds_per_step(self) -> float:
        """Return the length of a step in films [s]."""
        return 1 / 30

    def filmed(self) -> AbstractContextManager[None]:
        """Return a context in which pictures of all worlds are kept that begin in it."""
        return self.simulator.worlds.filmed()

    def pictures(self, states: HostedState, width: int, height: int) -> np.ndarray:
        """Return pictures (H, height, width, 3) of a world in its states, leaves (H, ...), that were filmed."""
        number, place = int(states.number[0]), int(states.place[0])
        found = self.simulator.worlds.pictures(number, np.asarray(states.clock), place)
        return np.stack([np.asarray(Image.open(io.BytesIO(each)).resize((width, height))) for each in found])


@dataclasses.dataclass(frozen=True, eq=False)
class Calls:
    """The calls that programs make to the host for a family."""

    family: Hosted
    names: dict[str, str] = dataclasses.field(default_factory=dict)

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
        return _known.setdefault(self.digest, Worlds(self.family.environment, self.family.pool))

    @cached_property
    def digest(self) -> str:
        """Return a short hash of the family."""
        return hashlib.sha256(repr(self.family).encode()).hexdigest()[:16]


def _run(digest: str, act: str, *arrays: np.ndarray) -> None:
    _known[digest].acts[act](*arrays)


def as_picture(array: np.ndarray, width: int = 320, height: int = 240) -> bytes:
    """Return a picture (H, W, 3) uint8 as PNG, made to fit into a size; what is beside it is black."""
    whole = ImageOps.pad(Image.fromarray(np.ascontiguousarray(array)), (width, height))
    file = io.BytesIO()
    whole.save(file, "PNG", compress_level=1)
    return file.getvalue()


def parameters_of(names: Mapping[str, Any]) -> dict[str, Parameter]:
    """Return a parameter for every argument of an environment, by its name with dashes, given the defaults."""
    number = lambda x: float(x) if isinstance(x, int | float) else 0.0
    return {name.replace("_", "-"): Parameter("1", number(default)) for name, default in names.items()}


def typed(environment: str, name: str, default: Any, value: float) -> Any:
    """Return a parameter's value, of the type that its default has.

    Raises:
        InputError: it is not whole, and the default is.
    """
    if isinstance(default, float) or not float(value).is_integer():
        if isinstance(default, int):
            raise InputError(
                f"{name} of {environment} is a whole number, not {value:g}; --split=none holds no values out"
            )
        return float(value)
    return bool(value) if isinstance(default, bool) else int(value)
