"""What a parameter changes of a task, and whether anything reads that."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from operator import attrgetter
from typing import Any

import jax
import numpy as np
from jax.interpreters.partial_eval import dce_jaxpr

from mtjax.envs.brax import Brax
from mtjax.envs.domain import Domain
from mtjax.envs.family import Family
from mtjax.envs.fields import FIXED, VARIABLE
from mtjax.envs.painters.scene import LEAVES, field
from mtjax.envs.pixels import compile_scene
from mtjax.types import InputError, Key, Task

Parts = Mapping[str, Any]  # what a value of a parameter gives, by name
_HINT = " (where geoms give a body's mass, edit theirs; an edit of what only pictures show has looks=True)"


def require_effects(family: Family) -> None:
    """Refuse a parameter that changes nothing: neither the physics, nor what is observed, rewarded or measured.

    Some of its values are compared, but for those that cannot be built.

    Raises:
        InputError: a parameter changes nothing.
    """
    inherited = Brax.parameters if isinstance(family, Brax) else ()  # Brax applies its own
    of_tasks = cache(lambda: _tasks(family))
    for name, parameter in family.parameters.items():
        if name in inherited:
            continue
        if parameter.edit is None or not isinstance(family, Domain):
            view, found = lambda values: of_tasks()(values), f"reset and step do not read task.goal[{name!r}]"
        elif parameter.looks:
            view, found = partial(_scene, family), "pictures are the same"
        else:
            view, found = partial(_physics, family), "the compiled model has the same physics" + _HINT
        if _all_alike(_views(family, name, view)):
            raise InputError(f"{type(family).__name__}.parameters[{name!r}] changes nothing: {found}")


def _all_alike(views: Iterator[Parts]) -> bool:
    """Return whether there are several views, and all are equal."""
    first, count = next(views, {}), 1
    for count, view in enumerate(views, start=2):  # noqa: B007
        if any(not np.array_equal(first[name], part) for name, part in view.items()):
            return False
    return count > 1


def _views(family: Family, name: str, view: Callable[[Mapping[str, float]], Parts]) -> Iterator[Parts]:
    for value in _values(family, name):
        try:
            yield view({name: value})
        except Exception:  # an edit or MuJoCo refuses the value
            continue


def _values(family: Family, name: str) -> list[float]:
    """Return values that a parameter may have: the ends of those that it varies over, and some about its nominal."""
    parameter, found = family.parameters[name], family.variation
    varied = found.rows["train"][:, found.names.index(name)].tolist() if name in found.names else []
    nominal = parameter.nominal
    about = [nominal, 1.1 * nominal, 0.9 * nominal, nominal + 0.1, nominal + 1, nominal - 1, parameter.maximum]
    if parameter.names:
        about = list(range(len(parameter.names)))
    allowed = lambda x: math.isfinite(x) and parameter.minimum < x <= parameter.maximum
    return [x for x in dict.fromkeys([*varied[:1], *varied[-1:], *about]) if allowed(x)]


def _physics(family: Domain, values: Mapping[str, float]) -> Parts:
    """Return all fields of a compiled model that an engine reads."""
    model = family.compile_spec(values).compile()
    return {name: attrgetter(name)(model) for name in (*FIXED, *VARIABLE)}


def _scene(family: Domain, values: Mapping[str, float]) -> Parts:
    """Return all fields of a compiled scene that a painter reads."""
    model = compile_scene(family, values).compile()
    return {name: field(model, name) for name in LEAVES}


def _tasks(family: Family) -> Callable[[Mapping[str, float]], Parts]:
    """Return a function from values of parameters to the leaves of their task that ``reset`` and ``step`` read."""
    edited = lambda name: isinstance(family, Domain) and family.parameters[name].edit is not None
    nominal = {name: _values(family, name)[0] for name in family.parameters if not edited(name)}
    nominal |= {name: _values(family, name)[0] for name in family.variation.names if name in family.parameters}
    make = lambda values: dataclasses.replace(
        family, vary={**dict(family.vary), **nominal, **values}, combine="grid", split="none", num_tasks=1
    )
    read = _leaves_read(make({}))

    def view(values: Mapping[str, float]) -> Parts:
        leaves = jax.tree_util.tree_leaves_with_path(jax.tree.map(lambda x: x[0], make(values).table.tasks))
        return {key: x for path, x in leaves if (key := jax.tree_util.keystr(path)) in read}

    return view


def _leaves_read(family: Family) -> set[str]:
    """Return the names of a task's leaves on which the results of a reset and a step depend, and controls."""
    task = jax.tree.map(lambda x: x[0], family.table.tasks)
    family = family.without_physics()

    def play(task: Task, key: Key) -> Any:
        begun, action = family.reset(task, key), family.spec.action.blank()
        # A world that stands still reads no controls.
        controls = family.control(task, begun.state, action) if isinstance(family, Domain) else ()
        return begun, family.step(task, begun.state, action), controls

    closed = jax.make_jaxpr(play)(task, jax.random.key(0))
    _, used = dce_jaxpr(closed.jaxpr, [True] * len(closed.out_avals))
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(task)]
    return {path for path, is_used in zip(paths, used, strict=False) if is_used}
