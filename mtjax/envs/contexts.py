"""Contexts and goals of a family's tasks, from the values of its parameters in every row of the table."""

from typing import Any

import numpy as np

from mtjax.envs.variation import scale


def goals(family: Any) -> dict[str, np.ndarray]:
    """Return the goal parameters (R,) of every row: varied, or nominal."""
    found = family.variation
    nominal = {name: parameter.nominal for name, parameter in family.parameters.items() if parameter.edit is None}
    full = lambda x: np.array(np.broadcast_to(x, found.count), np.float32)
    return {name: full(found.values.get(name, x)) for name, x in nominal.items()}


def ranges(family: Any) -> tuple[tuple[str, float, float], ...]:
    """Return the parameters of a family's contexts, and the ranges that are scaled to [-1, 1]."""
    return family.variation.ranges if family.context_ranges is None else family.context_ranges


def contexts(family: Any) -> np.ndarray:
    """Return the contexts (R, C): scaled parameters, and for an angle its sine and cosine.

    A single task has one constant number.
    """
    told = ranges(family)
    if not told:
        return np.zeros((family.variation.count, 1), np.float32)
    return np.concatenate([_columns(family, *of_one) for of_one in told], axis=1).astype(np.float32)


def _columns(family: Any, name: str, low: float, high: float) -> np.ndarray:
    """Return what contexts tell of a parameter that may be constant or unknown here: (R, 1), of an angle (R, 2)."""
    found, known = family.variation, family.every_parameter
    nominal = known[name].nominal if name in known else (low + high) / 2
    values = found.values.get(name, np.full(found.count, nominal))
    if name in family.parameters and family.parameters[name].direction:
        return np.stack([np.sin(values), np.cos(values)], axis=1)
    return scale(values[:, None], np.array([low]), np.array([high]))
