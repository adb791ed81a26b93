"""Checks of a family that is registered: its methods are called with abstract arrays, and wrong ones are named."""

import copy
import dataclasses
import itertools
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.brax import Brax
from mtjax.envs.compiled import read_model
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World, at_rest
from mtjax.envs.family import Family
from mtjax.envs.parameters import Parameter
from mtjax.names import InputError, nearest_error
from mtjax.types import Action, Continuous, Step, Task

_LOOKUPS = {"body": "bodies", "mesh": "meshes", **{kind: f"{kind}s" for kind in ("geom", "joint", "site", "actuator")}}
_LOOKUPS |= {kind: f"{kind}s" for kind in ("sensor", "tendon", "material", "camera", "light")}
_NUMBERS = {Domain: ("num_substeps", "default_iterations", "episode_steps"), Family: ("episode_length",)}


def check(family: Any) -> None:
    """Check what a family declares, and the shapes that its methods return.

    Raises:
        InputError: something is missing or wrong. The message names the class, and the method or parameter.
    """
    if not isinstance(family, Family):  # a mixture, of families that are checked
        return
    _check_declarations(family)
    if isinstance(family, Domain):
        _check_edits(family)
    small = _of_one_task(family)
    task = _call(family, "build", lambda: jax.tree.map(lambda x: x[0], small.table.tasks))
    key = jax.eval_shape(jax.random.key, 0)
    if isinstance(small, Brax):
        _check_brax(small, task, key)
    check_methods = _check_domain if isinstance(small, Domain) else _check_steps
    check_methods(small, task, key)  # type: ignore


def _check_declarations(family: Family) -> None:
    cls = type(family).__name__
    if not isinstance(family.parameters, Mapping) or not all(
        isinstance(p, Parameter) for p in family.parameters.values()
    ):
        raise InputError(f"{cls}.parameters maps names to mtjax.envs.Parameter(unit, nominal, edit)")
    for name, parameter in family.parameters.items():
        if not parameter.minimum < parameter.maximum or not parameter.minimum <= parameter.nominal <= parameter.maximum:
            bounds = f"minimum {parameter.minimum:g}, nominal {parameter.nominal:g}, maximum {parameter.maximum:g}"
            raise InputError(f"{cls}.parameters: the bounds of {name!r} are out of order: {bounds}")
    for name in _NUMBERS[Domain if isinstance(family, Domain) else Family]:
        value = _call(family, name, lambda name=name: getattr(family, name))
        if not isinstance(value, int) or value < 1:
            raise InputError(f"{cls}.{name} must be a whole number of at least 1, not {value!r}")


def _of_one_task(family: Family) -> Family:
    """Return the family with its first task alone, as each task of a physical parameter has a model to compile."""
    found = family.variation
    first = dict(zip(found.names, found.rows["train"][0].tolist(), strict=True))
    return dataclasses.replace(family, vary=first, combine="grid", split="none", num_tasks=1)


# Models.


def _check_edits(family: Domain) -> None:
    """Edit the model by every parameter, each alone, and compile it."""
    given = getattr(family, "model_file", None)
    if not isinstance(given, str) and not callable(given):
        raise InputError(
            f"{type(family).__name__}.model_file is a file beside the class's own, a path, or the MJCF itself"
        )
    _call(family, "model_file", partial(read_model, family))
    _call(family, "prepare", lambda: family.prepare(read_model(family)), family.prepare, family)
    _call(family, "model_file", read_model(family).compile)
    for name, (_, nominal, edit, *_) in family.parameters.items():
        if edit is not None:
            apply = lambda spec, edit=edit, nominal=nominal: edit(spec, float(nominal))
            place = f"parameters[{name!r}] ({getattr(edit, '__name__', 'edit')})"
            compiled = lambda name=name, nominal=nominal: family.compile_spec({name: nominal}).compile()
            _call(family, place, compiled, apply, family)


class _Named:
    """A model whose look-ups by name fail with the names that there are, where MuJoCo returns None."""

    def __init__(self, spec: mujoco.MjSpec):
        object.__setattr__(self, "spec", spec)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self.spec, name, value)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.spec, name)
        return self._lookup(name, found) if name in _LOOKUPS else found

    def _lookup(self, kind: str, find: Callable) -> Callable:
        def lookup(name: str) -> Any:
            found = find(name)
            if found is None:
                raise nearest_error(f"{kind} of the model", name, [x.name for x in getattr(self.spec, _LOOKUPS[kind])])
            return found

        return lookup


# Methods.


def _call(family: Any, place: str, function: Callable, edit: Callable | None = None, domain: Any = None) -> Any:
    """Return what a function returns. Its error becomes one that names the class and the place.

    Args:
        edit: the function of a model behind it, which is tried again to find a name that the model lacks.
    """
    try:
        return function()
    except Exception as error:
        reason = _reason(error)
        if edit is not None:
            reason = _missing_name(edit, domain) or reason
        raise InputError(f"{type(family).__name__}.{place}: {reason}") from None


def _missing_name(edit: Callable, family: Domain) -> str:
    try:
        edit(_Named(read_model(family)))
    except InputError as error:
        return str(error)
    except Exception:
        return ""
    return ""


def _reason(error: Exception) -> str:
    """Return the first line of an error, with its type unless it says enough by itself."""
    line = next(iter(str(error).strip().splitlines()), "")
    plain = isinstance(error, InputError | mujoco.FatalError)
    return line if plain else f"{type(error).__name__}: {line}"


def _abstract(family: Family, method: str, task: Task, *arguments: Any) -> Any:
    """Return the shapes of what a method returns.

    Raises:
        InputError: the method fails, or reads a goal that there is not.
    """
    task = task._replace(goal=_Told("goal of the task", task.goal), params=_Told("parameter of the task", task.params))
    called = lambda: jax.eval_shape(lambda *xs: getattr(family, method)(*xs), task, *arguments)
    return _call(family, method, called)


@jax.tree_util.register_pytree_node_class
class _Told(dict):
    """What a method is told by name, such as goals. A name that there is not raises an error with those there are."""

    def __init__(self, kind: str, told: Mapping[str, Any]):
        super().__init__(told)
        self.kind = kind

    def __missing__(self, name: Any):
        raise nearest_error(self.kind, str(name), self) if self else InputError(f"there is no {self.kind} {name!r}")

    def tree_flatten(self):
        return tuple(self.values()), (self.kind, tuple(self))

    @classmethod
    def tree_unflatten(cls, about, values):
        kind, names = about
        return cls(kind, dict(zip(names, values, strict=True)))


def _require(
    family: Family, method: str, what: str, found: Any, shape: tuple[int, ...], kind: Any = jnp.floating
) -> None:
    word = {jnp.floating: "float", jnp.bool_: "bool"}[kind]
    place = f"{type(family).__name__}.{method} must return {what}"
    if not hasattr(found, "shape") or not jnp.issubdtype(found.dtype, kind):
        raise InputError(f"{place} as an array of {word}, not {getattr(found, 'dtype', repr(found))}")
    if found.shape != shape:
        raise InputError(f"{place} of shape {shape}, not {found.shape}")


def _check_domain(family: Domain, task: Task, key: Any) -> None:
    model, name = family.models[0], type(family).__name__
    if not model.nu:
        raise InputError(f"{name}.model_file has no actuators, so that an agent has nothing to do")
    started = _abstract(family, "start", task, key)
    if not isinstance(started, tuple) or len(started) not in (2, 3, 4):
        raise InputError(f"{name}.start must return positions and velocities, and what else worlds carry")
    for what, found, size in zip(("positions", "velocities"), started, (model.nq, model.nv), strict=False):
        _require(family, "start", what, found, (size,))
    vector: Any = lambda size: jax.ShapeDtypeStruct((size,), jnp.float32)
    world = jax.eval_shape(partial(at_rest, model), *started)
    action = vector(family.action_size)
    controlled = _abstract(family, "control", task, world, action)
    if not isinstance(controlled, tuple) or len(controlled) != 2 or not isinstance(controlled[0], World):
        raise InputError(f"{name}.control must return the world, and the controls of the step")
    _require(family, "control", "controls", controlled[1], (model.nu,))
    obs = _abstract(family, "observe", task, world)
    _require_observation(family, "observe", obs)
    _require(family, "reward", "a number", _abstract(family, "reward", task, world, action), ())
    _require(family, "terminates", "a bool", _abstract(family, "terminates", task, world), (), jnp.bool_)
    metrics = _abstract(family, "metrics", task, world, action)
    if not isinstance(metrics, Mapping):
        raise InputError(f"{name}.metrics must return numbers by their names, not {metrics!r}")
    for named, found in metrics.items():
        _require(family, "metrics", f"{named!r}", found, ())


def _require_observation(family: Family, method: str, obs: Any) -> None:
    """Require a tree of arrays of numbers, such as a vector, a picture, or a dictionary of both."""
    numbers = lambda leaf: any(jnp.issubdtype(leaf.dtype, kind) for kind in (jnp.number, jnp.bool_))
    if not jax.tree.leaves(obs) or not all(map(numbers, jax.tree.leaves(obs))):
        raise InputError(f"{type(family).__name__}.{method} must return an observation of numbers, not {obs}")


class _Links(list):
    """Names of Brax's links. The place of one that there is not raises an error with those there are."""

    def index(self, name: str, *ends: Any) -> int:
        if name not in self:
            raise nearest_error("link of the model", name, self)
        return super().index(name, *ends)


def _check_brax(family: Brax, task: Task, key: Any) -> None:
    """Check what a family adds to an environment of Brax. ``_check_steps`` does the rest."""
    edited = next((name for name, parameter in family.parameters.items() if parameter.edit is not None), None)
    if edited is not None:
        raise InputError(
            f"{type(family).__name__}.parameters[{edited!r}]: Brax takes no edits of its models; leave the edit out, "
            f"and read task.goal[{edited!r}] in reward"
        )
    original = _call(family, "original", lambda: copy.copy(family.original))
    if hasattr(original, "sys"):  # as all have but "fast"
        original.sys = original.sys.replace(link_names=_Links(original.sys.link_names))
    object.__setattr__(family, "original", original)  # of this copy alone, which nobody keeps
    if family.action_size != original.action_size:
        told = f"{original.action_size}, as Brax's {family.environment} has, not {family.action_size}"
        raise InputError(f"{type(family).__name__}.action_size must be {told}")
    metrics = _Told(f"metric of Brax's {family.environment}", jax.eval_shape(original.reset, key).metrics)
    number, action = jax.ShapeDtypeStruct((), jnp.float32), jax.ShapeDtypeStruct((family.action_size,), jnp.float32)
    _require(family, "reward", "a number", _abstract(family, "reward", task, metrics, number, action), ())


def _action(family: Family) -> Action:
    """Return a family's kind of actions, which its ``action_size`` and ``discrete`` must tell too."""
    given = _call(family, "action", lambda: family.action)
    cls, told = type(family).__name__, (getattr(family, "action_size", None), family.discrete)
    if not isinstance(given, Action):
        raise InputError(f"{cls}.action must be Continuous, Discrete or MultiDiscrete of mtjax.types, not {given!r}")
    if told != (given.size, not isinstance(given, Continuous)):
        raise InputError(f"{cls} gives its action itself: derive it from mtjax.envs.choosing.Acting before Family")
    return given


def _check_steps(family: Family, task: Task, key: Any) -> None:
    """Check ``reset`` and ``step`` of a family that steps itself."""
    begun = _abstract(family, "reset", task, key)
    given = _action(family)
    action = jax.ShapeDtypeStruct(given.shape, given.dtype)
    for method, step in (("reset", begun), ("step", None)):
        step = _abstract(family, "step", task, begun.state, action) if step is None else step
        if not isinstance(step, Step):
            raise InputError(f"{type(family).__name__}.{method} must return a mtjax.Step, not {type(step).__name__}")
        _require_observation(family, method, step.obs)
        _require(family, method, "a reward", step.reward, ())
        _require(family, method, "terminated", step.terminated, (), jnp.bool_)
        if step.truncated is not None:
            _require(family, method, "truncated", step.truncated, (), jnp.bool_)
        for what, ours, theirs in (("obs", step.obs, begun.obs), ("state", step.state, begun.state)):
            if _shapes(ours) != _shapes(theirs):
                told = " and ".join(", ".join(itertools.islice(_shapes(x), 4)) for x in (theirs, ours))
                raise InputError(f"{type(family).__name__}: reset and step return a different {what}: {told}")


def _shapes(tree: Any) -> list[str]:
    return [f"{jax.tree_util.keystr(path)} {x.shape} {x.dtype}" for path, x in jax.tree.leaves_with_path(tree)]
