"""Any environment of Gymnasium as a family. Gymnasium is imported only when one is made."""

import dataclasses
import inspect
import json
from collections.abc import Callable, Mapping
from functools import cached_property
from importlib import import_module
from typing import Any, ClassVar

import numpy as np

from mtjax.checks import shown
from mtjax.envs.hosted.family import Hosted, as_picture, parameters_of, read_arguments
from mtjax.envs.hosted.spaces import form
from mtjax.envs.hosted.worlds import Outcome
from mtjax.envs.parameters import Parameter
from mtjax.names import nearest_error, public
from mtjax.types import InputError

_MOST_IDLE = 256


@dataclasses.dataclass(frozen=True)
class Gymnasium(Hosted):
    """Gymnasium: an environment of Gymnasium as it is, stepped on the host.

    Observation: the environment's own: of a Box a vector (O,), or a picture (H, W, C) of bytes; of a Discrete,
        MultiDiscrete or MultiBinary an array of whole numbers; of a Dict or Tuple the tree of arrays of its spaces.
    Action: one of n numbers, several such, or a vector (A,) in [-1, 1], scaled to the environment's Box.
    Reward, start and termination are the environment's own; where it truncates, or at its time limit, an episode is
        cut off. The seed of each episode is drawn from the run's seed.

    Parameters that can vary: all arguments of the environment's constructor that are numbers. Each task has worlds of
        its own, made with its values.
    """

    environment: str = "CartPole-v1"
    """Name of the environment in Gymnasium's registry, or module:NAME for a module that registers it."""

    engine_name: ClassVar[str] = "gymnasium"

    @cached_property
    def registered(self) -> Any:
        """Return Gymnasium's specification of the environment."""
        gymnasium = gymnasium_module()
        module, _, name = self.environment.rpartition(":")
        try:
            if module:
                import_module(module)
            return gymnasium.spec(name)
        except ImportError as error:
            raise InputError(f"{self.environment}: {error}") from None
        except gymnasium.error.Error:
            raise nearest_error("environment of Gymnasium", name, gymnasium.registry) from None

    @cached_property
    def every_parameter(self) -> Mapping[str, Parameter]:  # type: ignore[override]
        """Return the arguments of the environment's constructor."""
        known, any_other = arguments(self.registered.entry_point)
        known |= self.registered.kwargs
        known.pop("render_mode", None)
        given = {name: 0.0 for name, _ in self.vary if name.replace("-", "_") not in known} if any_other else {}
        return parameters_of(known | given)

    @cached_property
    def defaults(self) -> Mapping[str, Any]:
        return arguments(self.registered.entry_point)[0] | self.registered.kwargs

    def make(self, row: int | None, filmed: bool = False) -> Any:
        """Return an environment with the arguments of a row of the table, or with those that do not vary.

        Raises:
            InputError: it cannot be made.
        """
        gymnasium, given = gymnasium_module(), read_arguments(self.arguments) if row is None else self.arguments_of(row)
        shows = {"render_mode": "rgb_array"} if filmed and self.films else {}
        try:
            return gymnasium.make(
                self.environment, max_episode_steps=-1, disable_env_checker=True, **{**given, **shows}
            )
        except Exception as error:
            told = ", ".join(f"{name}={value!r}" for name, value in given.items())
            line = next(iter(str(error).strip().splitlines()), "")
            text = f"{self.environment} cannot be made{' with ' * bool(told)}{told}: {type(error).__name__}: {line}"
            held = "; --split=none holds no values out" * (row is not None and row >= self.variation.counts["train"])
            raise InputError(text + held) from error

    def build(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the leaves of the table. The environment of every listed row is made, so that it is known to exist.

        Raises:
            InputError: one cannot be made, or has other spaces than the first.
        """
        listed = sum(self.variation.counts.values())
        for row in range(listed):
            made = self.idle.take(row, False)
            self.idle.give(row, False, made)
            found = made.observation_space, made.action_space
            if (form(found[0]), found[1]) != (form(self.spaces[0]), self.spaces[1]):
                raise InputError(
                    f"tasks have one space of observations and one of actions, and {self.environment} has "
                    f"{shown(found)} with {self.arguments_of(row)}, but else {shown(self.spaces)}"
                )
        return {"model": {}, "goal": {}}

    @cached_property
    def spaces(self) -> tuple[Any, Any]:
        """Return the spaces of observations and actions."""
        made = self.make(None if not self.vary else 0)
        made.close()
        return made.observation_space, made.action_space

    @property
    def own_limit(self) -> int | None:
        return self.registered.max_episode_steps

    @cached_property
    def _metadata(self) -> Mapping[str, Any]:
        return getattr(creator(self.registered.entry_point), "metadata", {})

    @property
    def films(self) -> bool:
        """Return whether it draws pictures of its worlds."""
        return "rgb_array" in (self._metadata.get("render_modes") or ())

    @property
    def seconds_per_step(self) -> float:
        return 1 / (self._metadata.get("render_fps") or 30)

    @property
    def built_by(self) -> tuple[str, ...]:  # type: ignore[override]
        """Return the module of a class or a function of the user's own that makes it."""
        made = self.registered.entry_point
        return () if isinstance(made, str) else (made.__module__,)

    @property
    def idle(self) -> "Idle":
        """Return the environments of all equal families that are in no set."""
        found = _idle.setdefault(self.simulator.digest, Idle(self))
        if found.family.registered.entry_point is not self.registered.entry_point:  # as of a cell that ran again
            found = _idle[self.simulator.digest] = Idle(self)
        return found

    def pool(self, count: int, filmed: bool) -> "Separate":
        """Return as many worlds, each an environment of its own."""
        return Separate(self, count, filmed)


_idle: "dict[str, Idle]" = {}  # by a hash of the family


class Idle:
    """Environments that were made, and are in no set of worlds now. They serve the next set."""

    def __init__(self, family: Gymnasium):
        self.family = family
        self.made: dict[tuple[int, bool], list[Any]] = {}

    def take(self, row: int, filmed: bool) -> Any:
        """Return an environment of a row of the table, made if there is none."""
        found = self.made.get((row, filmed))
        return found.pop() if found else self.family.make(row, filmed)

    def give(self, row: int, filmed: bool, environment: Any) -> None:
        """Keep an environment, or close it if there are many."""
        if sum(map(len, self.made.values())) < _MOST_IDLE:
            self.made.setdefault((row, filmed), []).append(environment)
        else:
            environment.close()


class Separate:
    """Worlds that are an environment each, stepped one after another. Nothing resets by itself."""

    def __init__(self, family: Gymnasium, count: int, filmed: bool):
        self.family, self.filmed = family, filmed
        self.rows, self.made = np.full(count, -1), [None] * count

    def begin(self, places: np.ndarray, rows: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Begin an episode in worlds (k,), in environments of rows (k,) of the table."""
        found = []
        for place, row, seed in zip(places.tolist(), rows.tolist(), seeds.tolist(), strict=True):
            if self.rows[place] != row:
                self._give(place)
                self.rows[place], self.made[place] = row, self.family.idle.take(row, self.filmed)
            found.append(self.made[place].reset(seed=seed)[0])  # type: ignore
        return self.family.reader.read_each(found)

    def step(self, places: np.ndarray, actions: np.ndarray) -> Outcome:
        """Step worlds (k,)."""
        given = self.family.actor.read_each(actions)
        steps = [self.made[i].step(x) for i, x in zip(places.tolist(), given, strict=True)]  # type: ignore
        obs, reward, terminated, truncated, _ = zip(*steps, strict=True)
        read = self.family.reader.read_each(obs)
        return Outcome(read, *map(np.array, (reward, terminated, truncated)))

    def picture(self, place: int) -> bytes:
        """Return a picture of a world, as PNG."""
        return as_picture(self.made[place].render())  # type: ignore

    def release(self) -> None:
        """Give all environments back."""
        for place in range(len(self.made)):
            self._give(place)

    def _give(self, place: int) -> None:
        if self.made[place] is not None:
            self.family.idle.give(int(self.rows[place]), self.filmed, self.made[place])
            self.made[place] = None


@public
def hosted(environment: "str | Callable[..., Any]", vary: Mapping[str, Any] | tuple = (), **settings: Any) -> Gymnasium:
    """Return any environment of Gymnasium as a family of tasks. Its steps are taken on the host.

    Args:
        environment: its name in Gymnasium's registry; or a class, or a function that returns an environment, which is
            registered there under its own name.
        vary: values of arguments of the environment's constructor, such as {"gravity": "-11:-5:4"}.
        settings: fields of the family, such as ``time_limit``, and other arguments of the environment.

    Raises:
        InputError: Gymnasium is not installed, has no such environment, or cannot make it; or its spaces are not those
            of arrays of numbers, and of a vector or of choices.
    """
    if not isinstance(environment, str):
        environment = _registered(environment)
    own = {field.name for field in dataclasses.fields(Gymnasium)}
    fixed = {name: value for name, value in settings.items() if name not in own}
    given = {name: value for name, value in settings.items() if name in own}
    if fixed:
        given["arguments"] = _as_json(fixed)
    values = {str(name).replace("_", "-"): x for name, x in dict(vary).items()}
    made = Gymnasium(environment=environment, vary=values, **given)
    _ = made.episode_length, made.spec
    return made


def _as_json(arguments: Mapping[str, Any]) -> str:
    try:
        return json.dumps(arguments)
    except TypeError:
        raise InputError(f"arguments of an environment are numbers, texts or lists, not {shown(arguments)}") from None


def _registered(make: Callable[..., Any]) -> str:
    """Register a class or a function under its own name, and return the name."""
    if not callable(make):
        raise InputError(
            f"hosted takes a name of Gymnasium's, or a class or a function that makes an environment; not {shown(make)}"
        )
    gymnasium, name = gymnasium_module(), make.__name__
    gymnasium.registry.pop(name, None)  # of before, such as that of an earlier cell of a notebook
    gymnasium.register(name, make)
    return name


def creator(entry_point: Any) -> Any:
    """Return the class or the function that makes an environment."""
    if not isinstance(entry_point, str):
        return entry_point
    module, _, name = entry_point.partition(":")
    try:
        return getattr(import_module(module), name)
    except ImportError as error:
        raise InputError(f"{name}: {error}") from None


def arguments(entry_point: Any) -> tuple[dict[str, Any], bool]:
    """Return the arguments of what makes an environment with their defaults, and whether it takes any others."""
    try:
        found = inspect.signature(creator(entry_point)).parameters.values()
    except (TypeError, ValueError):
        return {}, True
    plain = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    known = {each.name: each.default for each in found if each.kind in plain and each.name != "render_mode"}
    return known, any(each.kind is inspect.Parameter.VAR_KEYWORD for each in found)


def gymnasium_module() -> Any:
    """Import Gymnasium.

    Raises:
        InputError: it is not installed.
    """
    try:
        import gymnasium
    except ImportError:
        raise InputError("Gymnasium is not installed; pip install 'mtjax[gym]'") from None
    return gymnasium
