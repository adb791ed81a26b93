"""Traced functions as lists of steps, which ``standalone`` runs by NumPy and ``onnx`` writes as models."""

from typing import Any

import numpy as np

from mtjax.names import InputError
from mtjax.saved.standalone import OPERATIONS, SETTINGS

_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "custom_jvp_call", "custom_vjp_call")
_FIXED = {  # settings that must be 1, as programs do not keep them
    "conv_general_dilated": ("lhs_dilation", "feature_group_count", "batch_group_count"),
    "reduce_window_max": ("base_dilation",),
}
_Step = tuple[str, list[int], list[int], dict[str, Any]]  # operation, numbers of its inputs and results, settings


def steps_of(closed: Any) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return a traced function of one result as a list of steps, and its constants.

    Steps and constants on which the result does not depend are left out. ``reads`` has the numbers, from 0, of those
    inputs on which it depends.

    Raises:
        InputError: it uses an operation that ``standalone`` lacks.
    """
    writer, inputs = _Writer(len(closed.jaxpr.invars)), range(len(closed.jaxpr.invars))
    (result,) = writer.write(closed.jaxpr, closed.consts, list(inputs))
    steps, read = _needed(writer.steps, result)
    kept = [i for i in range(-1, -len(writer.constants) - 1, -1) if i in read]
    places = {i: place for place, i in enumerate(kept)}  # the constants come first, then the inputs
    number = lambda i: places[i] if i < 0 else i + len(kept)
    program = {
        "constants": len(kept),
        "reads": [i for i in inputs if i in read],
        "steps": [[name, [*map(number, x)], [*map(number, y)], settings] for name, x, y, settings in steps],
        "result": number(result),
    }
    return program, [writer.constants[-i - 1] for i in kept]


def _needed(steps: list[_Step], result: int) -> tuple[list[_Step], set[int]]:
    """Return the steps on which a result depends, and the numbers of all values that they read or that it is."""
    read, kept = {result}, []
    for step in reversed(steps):
        if read.intersection(step[2]):
            read.update(step[1])
            kept.append(step)
    return kept[::-1], read


class _Writer:
    """Collects the steps of a traced function and of those that it calls. Constants have negative numbers."""

    def __init__(self, inputs: int):
        self.count, self.constants = inputs, []
        self.steps: list[_Step] = []
        self.known: dict[int, int] = {}

    def write(self, jaxpr: Any, consts: Any, arguments: list[int]) -> list[int]:
        """Write the steps of a function of these arguments, and return the numbers of its results."""
        numbers = dict(zip(jaxpr.constvars, map(self._constant, consts), strict=True))
        numbers |= dict(zip(jaxpr.invars, arguments, strict=True))
        read = lambda atom: self._constant(atom.val) if hasattr(atom, "val") else numbers[atom]
        for equation in jaxpr.eqns:
            inputs, called = list(map(read, equation.invars)), _called(equation)
            if called is None:
                outputs = self._step(equation, inputs)
            else:
                outputs = self.write(getattr(called, "jaxpr", called), getattr(called, "consts", ()), inputs)
            numbers.update(zip(equation.outvars, outputs, strict=True))
        return list(map(read, jaxpr.outvars))

    def _step(self, equation: Any, inputs: list[int]) -> list[int]:
        name = equation.primitive.name
        if name not in OPERATIONS:
            raise InputError(f"export to NumPy knows no operation {name!r}")
        for setting in _FIXED.get(name, ()):
            if np.any(np.not_equal(equation.params[setting], 1)):
                raise InputError(f"export to NumPy knows no {name!r} with {setting}={equation.params[setting]}")
        outputs = list(range(self.count, self.count + len(equation.outvars)))
        self.count += len(outputs)
        kept = {key: _plain(equation.params[key]) for key in SETTINGS.get(name, ())}
        self.steps.append((name, inputs, outputs, kept))
        return outputs

    def _constant(self, value: Any) -> int:
        if id(value) not in self.known:
            self.constants.append(np.asarray(value))
            self.known[id(value)] = -len(self.constants)
        return self.known[id(value)]


def _called(equation: Any) -> Any:
    """Return the function that an operation calls, or None."""
    if equation.primitive.name not in _CALLS:
        return None
    return next(equation.params[name] for name in ("jaxpr", "call_jaxpr", "fun_jaxpr") if name in equation.params)


def _plain(value: Any) -> Any:
    """Return a setting as JSON has it."""
    if isinstance(value, tuple | list):
        return [_plain(x) for x in value]
    if isinstance(value, np.dtype) or isinstance(value, type):
        return np.dtype(value).name
    return int(value) if isinstance(value, np.integer) else value
