"""Checks of values that Python or a file gives. On a command line, tyro does the same."""

import dataclasses
import importlib
import numbers
import os
import socket
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from mtjax.names import InputError, nearest_error

OF_TRAIN = (
    *("steps", "seed", "seeds", "eval_every", "eval_episodes", "eval_sampled", "num_envs", "chunk_steps", "stagger"),
    *("trials", "reset_free", "curriculum", "keep_replay", "population"),
)
"""The settings of ``mtjax.train`` that are neither the agent's nor the environment's."""
_LARGEST, _LARGEST_FLOAT = 2**31 - 1, 3.4e38  # of 32 bits
MOST_EPISODES = 100_000
"""Episodes of a task in one evaluation."""
HOME = "127.0.0.1"
"""The address of pages, which other machines cannot reach."""
_LARGEST_SEED = 2_000_000_000


def checked(cls: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return values for the fields of a dataclass: whole numbers as int, numbers as float, sequences as tuples.

    Raises:
        InputError: a value has another type than its field. The message names both.
    """
    types = {field.name: field.type for field in dataclasses.fields(cls)}
    return {name: _checked(name, types.get(name), value) for name, value in given.items()}


def check_fields(holder: Any, **largest: int) -> None:
    """Check and convert the fields of a frozen dataclass in place, for its ``__post_init__``.

    Raises:
        InputError: as ``checked`` and ``require_values``.
    """
    for name, value in checked(holder, {f.name: getattr(holder, f.name) for f in dataclasses.fields(holder)}).items():
        object.__setattr__(holder, name, value)
    require_values(holder, **largest)


def require_values(holder: Any, **largest: int) -> None:
    """Check that the fields of a dataclass hold values of their types.

    Whole numbers must fit into 32 bits, and real numbers must be finite as 32-bit numbers.

    Args:
        largest: other largest values of whole numbers, by name.

    Raises:
        InputError: one does not. The message names the field's flag.
    """
    for name, kind in _types(type(holder)).items():
        value, items = getattr(holder, name), kind == tuple[int, ...]
        rule = "must be whole numbers" if items and not isinstance(value, tuple) else ""
        for each in value if items and not rule else [value]:
            rule = rule or _broken_rule(int if items else kind, each, largest.get(name, _LARGEST))
        if rule:
            told = str(value)[:40] if isinstance(value, str) or len(shown(value)) > 40 else shown(value)
            raise InputError(f"{name.replace('_', '-')} {rule}, not {told}")


def _broken_rule(kind: Any, value: Any, largest: int) -> str:
    """Return the rule for values of a type that a value breaks, or an empty string."""
    plain = not isinstance(value, bool)
    if kind is int:
        whole = isinstance(value, numbers.Integral) and plain
        at_most = "" if whole and abs(value) <= largest else f"must be at most {largest}"  # type: ignore
        return at_most if whole else "must be a whole number"
    if kind is float:
        finite = isinstance(value, numbers.Real) and plain and abs(value) <= _LARGEST_FLOAT  # type: ignore
        return "" if finite else "must be a finite number"
    if kind in (bool, str):
        return "" if isinstance(value, kind) else f"must be {'true or false' if kind is bool else 'text'}"
    return ""


@lru_cache
def _types(cls: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields by name, without annotations for the command line."""
    hints = get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _checked(name: str, kind: Any, value: Any) -> Any:
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(kind) is tuple and isinstance(value, list | tuple | np.ndarray) and getattr(value, "ndim", 1):
        return tuple(_checked(name, get_args(kind)[0], x) for x in value)
    wanted = _WANTED.get(tuple if get_origin(kind) is tuple else kind)
    if wanted is None:
        return value
    words, accepts, convert = wanted
    if not accepts(value):
        raise InputError(f"{name} must be {words}, not {shown(value)}{_hint(kind, value)}")
    try:
        return convert(value)
    except OverflowError:
        raise InputError(f"{name} must be at most {_LARGEST_FLOAT:g}, not {shown(value)}") from None


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real | np.number) and not isinstance(value, bool | np.bool_)


def _is_whole(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool | np.bool_)


_WANTED = {  # type of a field -> what it is called, which values it takes, and how they are stored
    int: ("a whole number", _is_whole, int),
    float: ("a number", _is_number, float),
    bool: ("True or False", lambda x: isinstance(x, bool | np.bool_), bool),
    str: ("a text", lambda x: isinstance(x, str), str),
    tuple: ("a list of whole numbers, such as (64, 64)", lambda x: False, tuple),
}


def _hint(kind: Any, value: Any) -> str:
    """Return what to write instead, if that is plain."""
    if kind is int and isinstance(value, float) and value.is_integer():
        return f"; write {int(value)}"
    if kind in (int, float) and isinstance(value, str) and value.replace(".", "", 1).isdigit():
        return "; leave out the quotes"
    return ""


def amount(value: Any) -> str:
    """Return a return as text: a whole number if it is large, else with three digits."""
    return f"{value:.0f}" if abs(value) >= 20 else f"{value:.3g}"


def shown(value: Any) -> str:
    """Return a value as text for a message, or the name of its type if that is long."""
    try:
        text = repr(value)
    except ValueError:  # Python writes no whole number of more than 4,300 digits
        return "a number of thousands of digits"
    return text if len(text) <= 60 else f"a {type(value).__name__}"


def require_episodes(episodes: Any, seed: Any, task_seed: Any, checkpoint: Any) -> None:
    """Check the numbers of an evaluation; ``episodes`` and ``task_seed`` may be None.

    Raises:
        InputError: one is no whole number, or out of its bounds.
    """
    require_whole("episodes", 1 if episodes is None else episodes, 1, MOST_EPISODES)
    require_whole("seed", seed, 0, _LARGEST_SEED)
    require_whole("task-seed", 0 if task_seed is None else task_seed, 0, _LARGEST_SEED)
    require_whole("checkpoint", checkpoint, 0)


def require_whole(name: str, value: Any, least: int, most: int = _LARGEST) -> None:
    """Check that a value is a whole number in a range.

    Raises:
        InputError: it is not.
    """
    if not _is_whole(value):
        raise InputError(f"{name} must be a whole number, not {shown(value)}{_hint(int, value)}")
    if not least <= value <= most:
        raise InputError(f"{name} must be at least {least} and at most {most}, not {shown(value)}")


def require_text(value: Any, name: str) -> None:
    """Check that a value is text, such as a name, before it is looked up.

    Raises:
        InputError: it is not.
    """
    if not isinstance(value, str):
        raise InputError(f"{name} must be a text, not {shown(value)}")


def path(value: Any, name: str = "directory") -> Path:
    """Return a path.

    Raises:
        InputError: the value is no path.
    """
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else ""
    if not isinstance(text, str) or not text or "\0" in text:  # Path("") would be the working directory
        raise InputError(f"{name} must be a path, not {shown(value)}")
    return Path(value)


def require_run(folder: Path) -> None:
    """Raise InputError unless a folder holds a run. The message names the newest of the runs inside it, if any."""
    if (folder / "config.json").is_file():
        return
    if not folder.is_dir():
        raise InputError(f"{str(folder)!r} is not a run: there is no such folder")
    inside = max(folder.glob("*/config.json"), key=lambda file: file.stat().st_mtime, default=None)
    hint = "" if inside is None else f"; it holds runs, the newest is {str(inside.parent)!r}"
    raise InputError(f"{str(folder)!r} is not a run: it has no config.json{hint}")


def require_port(port: int) -> None:
    """Check that a page of this machine can be served at a port.

    Raises:
        InputError: the port is none, or another program has it.
    """
    require_whole("view", port, 1, 65535)
    try:
        socket.create_server((HOME, port)).close()
    except OSError as error:
        raise InputError(f"port {port} cannot be used ({error.strerror}); give another one: --view=PORT") from None


_EXTRAS = {"tensorboardX": "tensorboard", "optuna": "search", "huggingface_hub": "hub"}  # library -> its extra


def require_library(module: str, what: str = "") -> Any:
    """Import and return a library.

    Args:
        what: what needs it; by default the flag of its name.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        extra = _EXTRAS.get(module, module)
        raise InputError(f"{what or f'--{extra}'} needs {module}: pip install 'mtjax[{extra}]'") from None


# Checks of settings. Each raises an InputError that names the setting, its value and what is allowed.


def require_choices(holder: Any) -> None:
    """Require every setting of ``Literal`` type to be one of its choices."""
    for name, kind in _types(type(holder)).items():
        if get_origin(kind) is Literal:
            value, allowed = getattr(holder, name), get_args(kind)
            require_text(value, name)
            if value not in allowed:
                raise nearest_error(name.replace("_", "-"), value, allowed)


def _require(rule: str, holds: Callable[[Any], Any]) -> Callable[..., None]:
    """Return a check that a rule holds for those fields of a dataclass that are named."""

    def require(holder: Any, *names: str) -> None:
        for name in names:
            if not holds(getattr(holder, name)):
                raise InputError(f"{name.replace('_', '-')} {rule}, not {getattr(holder, name)}")

    return require


require_positive = _require("must be greater than 0", lambda x: x > 0)
require_not_negative = _require("must be at least 0", lambda x: x >= 0)
require_rates = _require("must be in (0, 1]", lambda x: 0 < x <= 1)
require_shares = _require("must be in [0, 1]", lambda x: 0 <= x <= 1)
require_counts = _require("must be at least 1", lambda x: x >= 1)
require_layers = _require("needs at least one layer of at least one unit", lambda x: x and min(x) >= 1)
require_widths = _require("must be of at least one unit each", lambda x: all(width >= 1 for width in x))
