"""What families of other packages' JAX environments have in common."""

import abc
import dataclasses
import importlib
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.envs.choosing import Acting
from mtjax.envs.family import Family
from mtjax.envs.parameters import REWARD_SCALE, Parameter
from mtjax.frames import PICTURES, shown
from mtjax.types import Array, InputError, Key, Step, Task

_MOST_STEPS = 1_000_000
_SCALE = "reward-scale"


class AdaptedState(NamedTuple):
    """The state of a world, and what gives every step of an episode a key of its own."""

    world: Any
    key: Key  # of the episode
    steps: Array  # () int32, taken in it

    @property
    def step_key(self) -> Key:
        """Return the key of the next step. Packages that draw nothing there do not pay for it."""
        return jax.random.fold_in(self.key, self.steps)


@dataclasses.dataclass(frozen=True)
class Adapted(Acting, Family):
    """A family of an environment that another package steps in JAX. Nothing resets by itself."""

    environment: str = ""
    """The package's name of the environment."""
    time_limit: int = 0
    """Steps after which an episode is cut off. 0 takes the environment's own limit."""

    suite: ClassVar[str]  # the first part of its name in mtjax
    package: ClassVar[str]  # what is imported
    install: ClassVar[str]  # the command that installs it
    limit: ClassVar[str]  # the package's name of the parameter that is its time limit

    def __post_init__(self):
        if not 0 <= self.time_limit <= _MOST_STEPS:
            raise InputError(f"time-limit must be from 0 to {_MOST_STEPS}, not {self.time_limit}")
        super().__post_init__()

    # What a family gives.

    @abc.abstractmethod
    def made(self) -> tuple[Any, Any]:
        """Make the package's environment, and its parameters as they come."""

    @abc.abstractmethod
    def begin(self, task: Task, key: Key) -> tuple[Any, Any]:
        """Begin an episode. Return the world's state and the observation."""

    @abc.abstractmethod
    def advance(self, task: Task, world: Any, action: Array, key: Key) -> tuple[Any, Any, Array, Array, Array]:
        """Advance a world. Return its state, observation, reward, and whether it terminated, or was cut off.

        The key is that of the package's step. What resets a world by itself there is left out here.
        """

    # What every family does.

    @cached_property
    def original(self) -> tuple[Any, Any]:
        """Return the package's environment and its nominal parameters, with the time limit that was asked for."""
        found, params = self.made()
        return found, params.replace(**{self.limit: self.time_limit or int(getattr(params, self.limit))})

    @property
    def defaults(self) -> Mapping[str, Any]:
        """Return the parameters that can vary, by the package's names, with their nominal values: here all numbers."""
        params = self.original[1]
        values = {field.name: getattr(params, field.name) for field in dataclasses.fields(params)}
        return {name: x for name, x in values.items() if isinstance(x, int | float) and name != self.limit}

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        return getattr(self.original[1], self.limit)

    @classmethod
    def module(cls, part: str = "") -> Any:
        """Import the package, or a module of it.

        Raises:
            InputError: it is not installed.
        """
        try:
            return importlib.import_module(f"{cls.package}.{part}" if part else cls.package)
        except ImportError as error:
            raise InputError(f"{cls.package} cannot be imported ({error}); {cls.install}") from None

    @cached_property
    def every_parameter(self) -> Mapping[str, Parameter]:  # type: ignore[override]
        """Return the parameters that can vary: the package's own, and a factor of the reward."""
        own = {name.replace("_", "-"): Parameter("1", float(x)) for name, x in self.defaults.items()}
        return own | {_SCALE: REWARD_SCALE}

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a fresh random state."""
        start_key, key = jax.random.split(key)
        world, obs = self.begin(task, start_key)
        begun = AdaptedState(world, key, jnp.int32(0))
        return _strong_step(begun, obs, jnp.float32(0), jnp.bool_(False), jnp.bool_(False))

    def step(self, task: Task, state: AdaptedState, action: Array) -> Step:
        """Advance one step under ``action``; observation and reward are those after it."""
        world, obs, reward, *ends = self.advance(task, state.world, action, state.step_key)
        reward = reward * task.params.get(_SCALE, 1.0)
        return _strong_step(state._replace(world=world, steps=state.steps + 1), obs, reward, *ends)

    def own_params(self, task: Task) -> Any:
        """Return the package's parameters of a task, in the package's types."""
        names, nominal = {name.replace("_", "-"): name for name in self.defaults}, self.defaults
        given = {name: value for name, value in task.params.items() if name in names}
        own = {names[name]: _as_default(nominal[names[name]], value) for name, value in given.items()}
        return self.original[1].replace(**own)

    @property
    def name(self) -> str:
        """Return the name by which ``mtjax.make`` makes it."""
        return f"{self.suite}:{self.environment}"

    @property
    def engine_name(self) -> str:
        """Return the package that steps its worlds."""
        return self.package

    @property
    def instruction(self) -> str:
        """Return what all tasks ask for."""
        return f"Earn the rewards of {self.environment}."


def as_picture(obs: Array) -> dict[str, Array]:
    """Return an array (H, W, C) of numbers from 0 to 1 as a picture, in which 1 is 255."""
    return {PICTURES: jnp.uint8(jnp.round(255 * obs))}


def _as_default(default: Any, value: Array) -> Array:
    """Return a parameter's value in the type of its default."""
    if isinstance(default, bool):
        return value > 0.5
    return jnp.int32(jnp.round(value)) if isinstance(default, int) else value


def _strong_step(state: AdaptedState, obs: Any, reward: Any, terminated: Any, truncated: Any) -> Step:
    """Return a step whose leaves keep their dtypes from one to the next."""
    ends = jnp.bool_(terminated), jnp.bool_(truncated)
    return Step(jax.tree.map(_strong, state), _observed(obs), jnp.float32(reward), ends[0], truncated=ends[1])


def _observed(obs: Any) -> Any:
    """Return pictures as they are, and any other observation as a vector (O,) of floats."""
    if shown(obs):
        return obs
    return jnp.concatenate([jnp.ravel(x).astype(jnp.float32) for x in jax.tree.leaves(obs)])


def _strong(x: Any) -> Array:
    """Return the array with a dtype that is not weak, because the carry of a scan needs one."""
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else jax.lax.convert_element_type(x, x.dtype)
