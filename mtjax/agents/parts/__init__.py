"""Parts of an agent are frozen dataclasses, chosen by name, whose fields are hyper-parameters.

An agent has one part of each kind. A part's fields are flags of the agent on the command line and arguments of
``mtjax.agent``, so no two kinds of parts may have a field of the same name.
"""

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from mtjax.checks import checked, shown
from mtjax.checks import require_counts as require_counts  # re-exported for parts of one's own, as are the next
from mtjax.checks import require_layers as require_layers
from mtjax.checks import require_not_negative as require_not_negative
from mtjax.checks import require_positive as require_positive
from mtjax.checks import require_rates as require_rates
from mtjax.checks import require_shares as require_shares
from mtjax.checks import require_widths as require_widths
from mtjax.names import frozen, nearest_error
from mtjax.types import InputError

P = TypeVar("P")

NO_SETTING = {"setting": False}
"""Marks a field that follows from the environment: it is no flag, and in no record of settings."""


def choose(kind: str, table: Mapping[str, type[P]], given: Any) -> P:
    """Return the part that is ``given``, itself or by name.

    Raises:
        InputError: no part of this kind has that name.
    """
    if isinstance(given, tuple(table.values())):
        return given
    if not isinstance(given, str):
        raise InputError(f"{kind} must be a name or a part of that kind, not {shown(given)}")
    if given not in table:
        raise nearest_error(kind, given, table)
    return table[given]()


def name_of(table: Mapping[str, type], part: Any) -> str:
    """Return the name by which a part is chosen; for a part that is not in the table, its class's name."""
    return next((name for name, cls in table.items() if type(part) is cls), type(part).__name__)


def settings(part: Any) -> dict[str, Any]:
    """Return a part's hyper-parameters."""
    return {name: getattr(part, name) for name in setting_names(part)}


def setting_names(part: Any) -> list[str]:
    """List the names of the hyper-parameters of a part, or of a class of parts."""
    return [field.name for field in dataclasses.fields(part) if field.metadata.get("setting", True)]


def take(settings: dict[str, Any], part: P) -> P:
    """Move a part's own settings out of ``settings``, and return a copy of the part that has them."""
    own = [field.name for field in dataclasses.fields(part) if field.name in settings]  # type: ignore
    return dataclasses.replace(part, **checked(part, frozen({name: settings.pop(name) for name in own})))  # type: ignore


def put(part: P, **values: Any) -> P:
    """Return a copy of a frozen dataclass with other values, unchecked, as they may be traced."""
    changed = copy.copy(part)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def is_zero(value: Any) -> bool:
    """Return whether a number is known to be zero before tracing, so that its branch need not be compiled."""
    return not isinstance(value, jax.Array) and value == 0


def limit(value: Any) -> Any:
    """Return a limit, or None if it is 0, which means that there is none. A traced one may be 0: then infinity."""
    if is_zero(value):
        return None
    return jnp.where(value > 0, value, jnp.inf) if isinstance(value, jax.Array) else value
