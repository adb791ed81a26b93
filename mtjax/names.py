"""Things by name: errors that say what was given and the nearest match, and imports that wait until they are needed."""

import difflib
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import Any

_MANY = 20


class InputError(ValueError):
    """Something the user gave cannot be used; the message says what was given and what is allowed."""


def nearest_error(kind: str, given: str, allowed: Iterable[str]) -> InputError:
    """Return an error for a name that is not among the allowed ones; of very many it shows those that are near."""
    allowed = list(allowed)
    near = difflib.get_close_matches(given, allowed, n=6, cutoff=0.5)
    hint = f"did you mean {near[0]!r}? " if near else ""
    few = len(allowed) <= _MANY
    shown = ", ".join(allowed if few else near or allowed[:6]) + ("" if few else f", ... ({len(allowed)} in all)")
    return InputError(f"unknown {kind} {given!r}; {hint}choose from: {shown}")


def frozen(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings whose lists are tuples, as what is static under ``jit`` must be hashable."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}


def load(place: Any) -> Any:
    """Import what "module:name" names; anything but a string is returned as it is."""
    if not isinstance(place, str):
        return place
    module, name = place.split(":")
    return getattr(import_module(module), name)


def lazily(module: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a module, which imports a name from its home when it is first used.

    Args:
        homes: name -> the module that has it, or "module:other" where it is called otherwise.
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home = homes[name]
        found = load(home if ":" in home else f"{home}:{name}")
        setattr(sys.modules[module], name, found)
        return found

    return find
