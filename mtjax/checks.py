"""Checks of values that Python or a file gives. On a command line, tyro does the same."""

import dataclasses
import numbers
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

import numpy as np

from mtjax.names import InputError

OF_TRAIN = ("steps", "seed", "seeds", "eval_every", "eval_episodes", "num_envs", "chunk_steps", "stagger")
"""The settings of ``mtjax.train`` that are neither the agent's nor the environment's."""


def checked(cls: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return values for the fields of a dataclass: whole numbers as int, numbers as float, sequences as tuples.

    Raises:
        InputError: a value has another type than its field. The message names both.
    """
    types = {field.name: field.type for field in dataclasses.fields(cls)}
    return {name: _checked(name, types.get(name), value) for name, value in given.items()}


def check_fields(holder: Any) -> None:
    """Check and convert the fields of a frozen dataclass in place, for its ``__post_init__``.

    Raises:
        InputError: as ``checked``.
    """
    for name, value in checked(holder, {f.name: getattr(holder, f.name) for f in dataclasses.fields(holder)}).items():
        object.__setattr__(holder, name, value)


def _checked(name: str, kind: Any, value: Any) -> Any:
    kind = get_args(kind)[0] if get_origin(kind) is Annotated else kind
    if get_origin(kind) is tuple and isinstance(value, list | tuple | np.ndarray):
        return tuple(_checked(name, get_args(kind)[0], x) for x in value)
    wanted = _WANTED.get(tuple if get_origin(kind) is tuple else kind)
    if wanted is None:
        return value
    words, accepts, convert = wanted
    if not accepts(value):
        raise InputError(f"{name} must be {words}, not {_shown(value)}{_hint(kind, value)}")
    return convert(value)


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


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"a {type(value).__name__}"


def path(value: Any, name: str = "directory") -> Path:
    """Return a path.

    Raises:
        InputError: the value is no path.
    """
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"{name} must be a path, not {_shown(value)}")
    return Path(value)
