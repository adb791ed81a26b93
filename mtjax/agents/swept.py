"""Several settings of an agent in one program: some numbers are leaves of its state instead of constants.

A point is one setting, values by name: ``{"actor_lr": 3e-4, "gamma": 0.98}``. The S axis of a run
holds all points with all seeds, point by point: entry ``k`` is seed ``k % seeds`` of point ``k // seeds``.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mtjax.agents import BaseAgent, parts
from mtjax.agents.hyperparameters import flag_names, kinds_of, settings
from mtjax.agents.state import AgentState
from mtjax.checks import shown
from mtjax.names import nearest_error
from mtjax.types import Array, InputError

Point = Mapping[str, float]
Sweep = Mapping[str, Sequence[float]] | Sequence[Point]
_STATIC = ("encoder", "experience")  # their numbers are shapes, or constants in the networks' modules


def sweepable(agent: BaseAgent) -> dict[str, float]:
    """Return the settings of an agent and its parts that can vary inside one program: floats, by name."""
    holders = [agent, *(getattr(agent, kind) for kind in kinds_of(agent) if kind not in _STATIC)]
    return {f.name: getattr(x, f.name) for x in holders for f in dataclasses.fields(x) if f.type is float}


def agent_at(agent: BaseAgent, point: Point) -> BaseAgent:
    """Return the agent with the values of a point, checked by its constructor.

    Raises:
        InputError: no number has that name, or a value is not allowed.
    """
    known = sweepable(agent)
    unknown = next((name for name in point if name not in known), None)
    if unknown in settings(agent):
        raise InputError(f"{unknown} cannot vary inside one program; train once for each value, as --sweep does")
    if unknown is not None:
        raise nearest_error("number of this agent", unknown, known)
    if "gamma" in point and agent.discounting == "horizon":  # where a preset's gamma has no effect either
        raise InputError("discounting=horizon takes discounts from horizons, and gamma changes nothing; leave it out")
    return _replace_values(agent, point, dataclasses.replace)


def agents_at(agent: BaseAgent, points: Sequence[Point]) -> list[BaseAgent]:
    """Return the agent at every point, or the agent itself if there are no points."""
    return [agent_at(agent, point) for point in points] or [agent]


def allows(agent: BaseAgent, point: Point) -> bool:
    """Return whether the agent's constructor takes the values of a point."""
    try:
        agent_at(agent, point)
    except InputError:
        return False
    return True


def shares(agent: BaseAgent, names: Iterable[str]) -> frozenset[str]:
    """Return the names of those numbers that may not exceed 1, such as discounts."""
    return frozenset(name for name in names if allows(agent, {name: 1 - 1e-6}) and not allows(agent, {name: 1.5}))


def with_numbers(agent: Any, numbers: Mapping[str, Array]) -> Any:
    """Return the agent with traced numbers, which its constructor cannot check; ``agent_at`` checks them beforehand."""
    return _replace_values(agent, numbers, parts.put) if numbers else agent


def at_point(agent: Any, state: Any) -> Any:
    """Return the agent with the numbers that its state holds: those of its point, if it is one of a sweep."""
    return with_numbers(agent, numbers_of(state))


def numbers_of(state: Any) -> dict[str, Array]:
    """Return the numbers that an agent's state holds, by name: none outside a sweep, as in states of other kinds."""
    return state.numbers if isinstance(state, AgentState) else {}


def _replace_values(agent: BaseAgent, values: Mapping[str, Any], replace: Callable) -> BaseAgent:
    mine = lambda part: {f.name: values[f.name] for f in dataclasses.fields(part) if f.name in values}
    held = {kind: getattr(agent, kind) for kind in kinds_of(agent)}
    changed = {kind: replace(part, **own) for kind, part in held.items() if (own := mine(part))}
    return replace(agent, **changed, **mine(agent))


def grid(sweep: Sweep) -> tuple[dict[str, float], ...]:
    """Return all points of a sweep.

    A mapping gives every combination of its values; the last name changes fastest. A list gives the points themselves.

    Raises:
        InputError: a name has no values, or the points have different names.
    """
    listed_all = isinstance(sweep, Mapping) and all(isinstance(x, Iterable) for x in sweep.values())
    points = isinstance(sweep, Sequence) and all(isinstance(point, Mapping) for point in sweep)
    if not (listed_all or points):
        raise InputError(f"sweep gives each number a list of values, {{'actor_lr': [1e-4, 1e-3]}}; not {shown(sweep)}")
    if isinstance(sweep, Mapping):
        sweep = {name: list(values) for name, values in sweep.items()}
        empty = next((name for name, values in sweep.items() if not len(values)), None)
        if empty is not None:
            raise InputError(f"the sweep gives no values to {empty}")
        rows = itertools.product(*sweep.values()) if sweep else ()
        return tuple({name: _number(name, value) for name, value in zip(sweep, row, strict=True)} for row in rows)
    listed = ({name: _number(name, value) for name, value in point.items()} for point in sweep)  # type: ignore
    found = tuple(listed)
    if any(point.keys() != found[0].keys() for point in found):
        raise InputError("every point of a sweep must give a value to the same names")
    return found


def words(agent: BaseAgent, points: Sequence[Point]) -> tuple[str, ...]:
    """Return points as ``--sweep`` writes them: each number's flag with its values."""
    flags = flag_names(agent) if points else {}
    values = {name: dict.fromkeys(f"{point[name]:.12g}" for point in points) for name in (points[0] if points else ())}
    return tuple(f"{flags.get(name, name)}={','.join(each)}" for name, each in values.items())


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"a sweep gives numbers to {name}, and {shown(value)} is none") from None


def seed_axis(points: Sequence[Point], seeds: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return seeds (S,) and swept values (S,) by name for all points; without points, the seeds and no values."""
    if not points:
        return seeds, {}
    column = lambda name: np.repeat(np.asarray([point[name] for point in points], np.float32), len(seeds))
    return np.tile(seeds, len(points)), {name: column(name) for name in points[0]}
