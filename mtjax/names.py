"""Settings by name: errors that say what was given, what is allowed and the nearest match; lists made hashable."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from mtjax.types import InputError

_MANY = 20


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
