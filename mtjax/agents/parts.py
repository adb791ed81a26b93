"""Parts of an agent: frozen dataclasses that are chosen by name and whose fields are hyper-parameters of their own.

An agent has one part of each kind. Their fields lie beside the agent's on the command line and in ``mtjax.agent``, so
no two kinds may use a field's name.
"""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import jax

from mtjax.names import frozen, nearest_error

P = TypeVar("P")


def choose(kind: str, table: Mapping[str, type[P]], given: Any) -> P:
    """Return the part that is ``given`` itself or by name.

    Raises:
        InputError: no part of this kind has that name.
    """
    if isinstance(given, tuple(table.values())):
        return given
    if given not in table:
        raise nearest_error(kind, given, table)
    return table[given]()


def name_of(table: Mapping[str, type], part: Any) -> str:
    """Return the name under which a part is chosen; a part of the user's own has that of its class."""
    return next((name for name, cls in table.items() if type(part) is cls), type(part).__name__)


def settings(part: Any) -> dict[str, Any]:
    """Return a part's hyper-parameters."""
    return {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}


def take(settings: dict[str, Any], part: P) -> P:
    """Return the part with those of the settings that are its own, which leave ``settings``."""
    own = {field.name for field in dataclasses.fields(part)} & set(settings)  # type: ignore
    return dataclasses.replace(part, **frozen({name: settings.pop(name) for name in own}))  # type: ignore


def put(part: P, **values: Any) -> P:
    """Return a copy of a frozen dataclass with other values, which may be traced and are not checked."""
    changed = copy.copy(part)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def is_zero(value: Any) -> bool:
    """Whether a number is zero for good, and what it switches on needs no program; a traced one may be anything."""
    return not isinstance(value, jax.Array) and value == 0
