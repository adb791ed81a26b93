"""Families whose worlds live on the host."""

import abc
import dataclasses
import io
import json
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import jax
import numpy as np
from PIL import Image, ImageOps

from mtjax.envs.choosing import Acting
from mtjax.envs.family import Family
from mtjax.envs.hosted import stepping
from mtjax.envs.hosted.spaces import Actor, Reader, TreeReader, reader_of
from mtjax.envs.hosted.worlds import Pool
from mtjax.envs.parameters import Parameter
from mtjax.frames import PICTURES, shown
from mtjax.types import Action, InputError, Spec

_MOST_FRAMES = 16
_MOST_STEPS = 1_000_000


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

    engine_name: ClassVar[str]  # the package that steps its worlds, and the first part of its name in mtjax
    forgets: ClassVar[bool] = True
    seconds_per_step: ClassVar[float] = 1 / 30  # of a film

    def __post_init__(self):
        _ = read_arguments(self.arguments)
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

    @property
    @abc.abstractmethod
    def defaults(self) -> Mapping[str, Any]:
        """Return the environment's arguments that can vary, with their defaults."""

    @abc.abstractmethod
    def pool(self, count: int, filmed: bool) -> Pool:
        """Return as many worlds."""

    # What every family does.

    def arguments_of(self, row: int) -> dict[str, Any]:
        """Return the environment's arguments in a row of the table."""
        varied = {name.replace("-", "_"): values[row] for name, values in self.variation.values.items()}
        read = lambda name, value: typed(self.environment, name, self.defaults.get(name), value)
        return read_arguments(self.arguments) | {name: read(name, value) for name, value in varied.items()}

    @cached_property
    def reader(self) -> Reader | TreeReader:
        """Return what reads observations."""
        return reader_of(self.environment, self.spaces[0])

    @cached_property
    def actor(self) -> Actor:
        """Return what reads actions."""
        return Actor(self.environment, self.spaces[1])

    @property
    def action(self) -> Action:
        return self.actor.action

    @property
    def name(self) -> str:
        """Return the name by which ``mtjax.make`` makes it."""
        return f"{self.engine_name}:{self.environment}"

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        limit = self.time_limit or self.own_limit
        if limit is None:
            raise InputError(f"{self.environment} has no time limit; give one, such as --env.time-limit=1000")
        return limit

    @property
    def instruction(self) -> str:
        """Return what all tasks ask for."""
        return f"Earn the rewards of {self.environment}."

    @property
    def pixels(self) -> int:
        """Return the width of pictures, or 0 where observations have none."""
        observed = jax.eval_shape(self.reader.show, jax.ShapeDtypeStruct(self.reader.shape, self.reader.dtype))
        picture = observed[PICTURES].shape if shown(observed) else ()
        return picture[1] if len(picture) == 3 else 0

    @cached_property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context, and how many pictures agents should see at once."""
        return super().spec._replace(frames=self.frames if self.pixels else 1)

    # What steps and shows its worlds.

    @cached_property
    def simulator(self) -> stepping.Calls:  # type: ignore[override]
        """Return the calls out of XLA."""
        return stepping.Calls(self.environment, self.pool, self.reader, repr(self))

    reset_worlds, renew_worlds, step_worlds = stepping.reset_worlds, stepping.renew_worlds, stepping.step_worlds
    reset, step = stepping.reset, stepping.step  # type: ignore
    filmed, pictures = stepping.filmed, stepping.pictures  # type: ignore


def read_arguments(text: str) -> dict[str, Any]:
    """Return arguments of an environment that are written as JSON.

    Raises:
        InputError: they are not.
    """
    try:
        found = json.loads(text or "{}")
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise InputError(f'arguments are JSON, such as \'{{"map_name": "8x8"}}\', not {text!r}')
    return found


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
            flag = name.replace("_", "-")
            raise InputError(
                f"{flag} of {environment} is a whole number, not {value:g}; --split=none holds no values out"
            )
        return float(value)
    return bool(value) if isinstance(default, bool) else int(value)
