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
from mtjax.envs.parameters import Parameter
from mtjax.frames import shown
from mtjax.types import Array, InputError, Key, Step, Task

_MOST_STEPS = 1_000_000


class AdaptedState(NamedTuple):
    """The state of a world, and the key of the chances to come: environments draw at every step."""

    world: Any
    key: Key


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

    def __post_init__(self):
        if not 0 <= self.time_limit <= _MOST_STEPS:
            raise InputError(f"time-limit must be from 0 to {_MOST_STEPS}, not {self.time_limit}")
        super().__post_init__()

    # What a family gives.

    @property
    @abc.abstractmethod
    def defaults(self) -> Mapping[str, Any]:
        """Return the parameters that can vary, by the package's names, with their nominal values."""

    @abc.abstractmethod
    def begin(self, task: Task, key: Key) -> tuple[Any, Any]:
        """Begin an episode. Return the world's state and the observation."""

    @abc.abstractmethod
    def advance(self, task: Task, world: Any, action: Array, key: Key) -> tuple[Any, Any, Array, Array, Array]:
        """Advance a world. Return its state, observation, reward, and whether it terminated, or was cut off.

        The key is that of the package's step. What resets a world by itself there is left out here.
        """

    # What every family does.

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
        """Return the parameters that can vary."""
        return {name.replace("_", "-"): Parameter("1", float(x)) for name, x in self.defaults.items()}

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a fresh random state."""
        start_key, key = jax.random.split(key)
        world, obs = self.begin(task, start_key)
        return _strong_step(AdaptedState(world, key), obs, jnp.float32(0), jnp.bool_(False), jnp.bool_(False))

    def step(self, task: Task, state: AdaptedState, action: Array) -> Step:
        """Advance one step under ``action``; observation and reward are those after it."""
        world, obs, reward, terminated, truncated = self.advance(task, state.world, action, state.key)
        key = jax.random.split(state.key)[1]
        return _strong_step(AdaptedState(world, key), obs, reward, terminated, truncated)

    def params_of(self, task: Task) -> dict[str, Array]:
        """Return the parameters that a task has of its own, by the package's names and in its types."""
        names = {name.replace("_", "-"): name for name in self.defaults}
        return {names[name]: _as_default(self.defaults[names[name]], value) for name, value in task.params.items()}

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
