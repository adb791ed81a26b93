"""Several settings of an agent in one program: numbers that are data, one a seed, instead of constants.

A point is one setting: values by name, ``{"actor_lr": 3e-4, "gamma": 0.98}``. The S axis of a run holds all points with
all seeds, point by point: number ``k`` of S is seed ``k % seeds`` of point ``k // seeds``.
"""

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mtjax.agents import BaseAgent, parts
from mtjax.agents.base import kinds_of
from mtjax.names import nearest_error
from mtjax.types import Acted, Array, Env, Experience, InputError, Key, Metrics, Outcome, Spec, Task, Transition

Point = Mapping[str, float]
Sweep = Mapping[str, Sequence[float]] | Sequence[Point]
_STATIC = ("encoder", "experience")  # parts whose numbers are shapes, or written into the networks' modules


class Swept(NamedTuple):
    """The state of an agent at one point."""

    learner: Any  # the agent's own
    knobs: dict[str, Array]  # () each


@dataclasses.dataclass(frozen=True)
class Varied:
    """An agent of which some numbers are in its state; it is static under ``jit``, and they are not.

    In every method the agent is a copy that holds the state's numbers, traced and unchecked, in place of its own:
    ``at`` checks them beforehand.
    """

    agent: BaseAgent

    @property
    def watches(self) -> bool:
        return self.agent.watches

    @property
    def experience(self) -> Experience:
        return self.agent.experience

    def init(self, spec: Spec, tasks: Task, key: Key, knobs: dict[str, Array] | None = None) -> Swept:
        knobs = knobs or {}
        return Swept(vary(self.agent, knobs).init(spec, tasks, key), knobs)

    def begin(self, state: Swept, task: Task) -> Any:
        return vary(self.agent, state.knobs).begin(state.learner, task)

    def act(self, state: Swept, memory: Any, obs: Any, task: Task, key: Key | None) -> Acted:
        acted = vary(self.agent, state.knobs).act(state.learner, memory, obs, task, key)
        whole = jnp.isfinite(acted.action)  # one that diverged goes on beside the others
        return acted._replace(action=jnp.where(whole, acted.action, 0.0))

    def remember(self, state: Swept, memory: Any, transition: Transition, task: Task) -> Any:
        return vary(self.agent, state.knobs).remember(state.learner, memory, transition, task)

    def relabel(self, env: Env, task: Task, transition: Transition, key: Key) -> Transition:
        return self.agent.relabel(env, task, transition, key)

    def learn(self, env: Env, states: Swept, data: Any, tasks: Task, keys: Key) -> tuple[Swept, Metrics]:
        return self.experience.learn(env, self, states, data, tasks, keys)  # type: ignore

    def update(self, state: Swept, batch: Transition, tasks: Task, key: Key) -> tuple[Swept, Metrics]:
        learner, metrics = vary(self.agent, state.knobs).update(state.learner, batch, tasks, key)
        return state._replace(learner=learner), metrics

    def observe(self, state: Swept, outcome: Outcome) -> Swept:
        return state._replace(learner=vary(self.agent, state.knobs).observe(state.learner, outcome))

    def reset_networks(self, state: Swept, spec: Spec, tasks: Task, key: Key) -> Swept:
        return state._replace(learner=vary(self.agent, state.knobs).reset_networks(state.learner, spec, tasks, key))


def numbers(agent: BaseAgent) -> dict[str, float]:
    """The settings of an agent and of its parts that may vary within a program: numbers that are no counts."""
    holders = [agent, *(getattr(agent, kind) for kind in kinds_of(agent) if kind not in _STATIC)]
    return {f.name: getattr(x, f.name) for x in holders for f in dataclasses.fields(x) if f.type is float}


def at(agent: BaseAgent, point: Point) -> BaseAgent:
    """Return the agent at a point, as if its values had been given plainly.

    Raises:
        InputError: a name is not that of a number, or a value is not allowed.
    """
    known = numbers(agent)
    unknown = next((name for name in point if name not in known), None)
    if unknown is not None:
        raise nearest_error("number of this agent", unknown, known)
    return _place(agent, point, dataclasses.replace)


def every(agent: Any, found: Sequence[Point]) -> list[Any]:
    """The agent at every point, or as it is if there are none."""
    return [at(agent, point) for point in found] or [agent]


def vary(agent: BaseAgent, knobs: Mapping[str, Array]) -> BaseAgent:
    """Return the agent with traced values, which its constructors could not check."""
    return _place(agent, knobs, parts.put)


def _place(agent: BaseAgent, values: Mapping[str, Any], replace: Callable) -> BaseAgent:
    mine = lambda part: {f.name: values[f.name] for f in dataclasses.fields(part) if f.name in values}
    held = {kind: getattr(agent, kind) for kind in kinds_of(agent)}
    changed = {kind: replace(part, **own) for kind, part in held.items() if (own := mine(part))}
    return replace(agent, **changed, **mine(agent))


def grid(sweep: Sweep) -> tuple[dict[str, float], ...]:
    """All points of a sweep: every combination of values, the last name's changing fastest; or the points themselves.

    Raises:
        InputError: there are no values, or points do not all give the same names.
    """
    if isinstance(sweep, Mapping):
        empty = next((name for name, values in sweep.items() if not len(values)), None)
        if empty is not None:
            raise InputError(f"the sweep gives no values to {empty}")
        rows = itertools.product(*sweep.values()) if sweep else ()
        return tuple({name: float(value) for name, value in zip(sweep, row, strict=True)} for row in rows)
    listed = ({name: float(value) for name, value in point.items()} for point in sweep)  # type: ignore
    found = tuple(listed)
    if any(point.keys() != found[0].keys() for point in found):
        raise InputError("every point of a sweep must give a value to the same names")
    return found


def spread(points: Sequence[Point], seeds: Array) -> tuple[Array, dict[str, Array] | None]:
    """The seed of each number of S, and the values (S,) by name; without points, the seeds (S,) alone."""
    if not points:
        return seeds, None
    column = lambda name: np.repeat(np.asarray([point[name] for point in points], np.float32), len(seeds))
    return jnp.tile(seeds, len(points)), {name: jnp.asarray(column(name)) for name in points[0]}
