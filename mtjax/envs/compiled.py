"""Compiled models of a domain: from its MJCF and parameters to the leaves in which its tasks differ."""

import sys
from collections.abc import Mapping, Sequence
from importlib import resources
from operator import attrgetter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mtjax.envs.fields import FIXED, VARIABLE
from mtjax.types import InputError

_RESISTANCES = ("damping", "frictionloss", "armature")
_UNSIGNED = ("body_mass", "geom_friction", "pair_friction", "jnt_stiffness", "tendon_stiffness", "opt.density")
_UNSIGNED += ("opt.viscosity", *(f"{part}_{x}" for part in ("dof", "tendon") for x in _RESISTANCES))
"""Fields in which MuJoCo takes negative numbers, and physics does not."""


def read_model(domain: Any) -> mujoco.MjSpec:
    """Return the editable model of a domain, as its class gives it: a function, the MJCF itself, or a file.

    Raises:
        InputError: there is no such file.
    """
    given = domain.model_file
    if callable(given):
        return given()
    if given.lstrip().startswith("<"):
        return mujoco.MjSpec.from_string(given)
    folders = [_folder_of(type(domain)), Path(str(resources.files("mtjax.envs") / "models"))]
    paths = [folder / given for folder in folders]  # an absolute path stands alone
    found = next((path for path in paths if path.is_file()), None)
    if found is None:
        raise InputError(f"there is no model file {str(paths[0])!r}")
    return mujoco.MjSpec.from_file(str(found))


def _folder_of(family: type) -> Path:
    """Return the folder of the file in which a class gives its model; in a notebook the working directory."""
    cls = next(cls for cls in family.__mro__ if "model_file" in vars(cls))
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    return Path(file).parent if file else Path.cwd()


def compile_model(domain: Any, values: Mapping[str, float]) -> mujoco.MjModel:
    """Return the compiled model of a domain with these parameter values.

    Raises:
        InputError: MuJoCo refuses them, or the model has numbers beyond 32 bits or ones that nature does not have.
    """
    given = ", ".join(f"{name}={value:g}" for name, value in values.items()) or "its own values"
    try:
        model = domain.compile_spec(values).compile()
    except InputError:  # the model itself says what it lacks, such as a package
        raise
    except ValueError as error:
        reason = str(error).strip().splitlines()[0][:150] if str(error).strip() else "no reason given"
        raise InputError(f"MuJoCo cannot build {type(domain).__name__} with {given}: {reason}") from None
    for name in VARIABLE:
        field = np.asarray(attrgetter(name)(model))
        if np.any(np.isfinite(field) & (np.abs(field) > np.finfo(np.float32).max)) or np.any(np.isnan(field)):
            raise InputError(f"{type(domain).__name__} with {given} has a {name} beyond 32-bit numbers")
    negative = next((name for name in _UNSIGNED if np.any(np.asarray(attrgetter(name)(model)) < 0)), None)
    if negative is not None:
        told = "give the parameter minimum=0.0, or leave such values out (of held-out tasks by --split=none)"
        raise InputError(f"{type(domain).__name__} with {given} has a {negative} below 0; {told}")
    return model


def stack_differing(models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
    """Stack the fields that differ between compiled models into arrays (R, ...), by MJX name ("opt.gravity").

    Raises:
        InputError: a field differs that must be the same in all tasks. The message names field and task.
    """
    first = {}  # model -> the first task that has it; many tasks may share one
    for task, model in enumerate(models):
        first.setdefault(id(model), task)
    unique = [models[task] for task in first.values()]
    place = {identity: i for i, identity in enumerate(first)}
    places = [place[id(model)] for model in models]
    differing = {}
    for name in (*FIXED, *VARIABLE):
        column = [attrgetter(name)(model) for model in unique]
        odd = _first_unlike(column)
        if odd is None:
            continue
        if name in FIXED:
            task = first[id(unique[odd])]
            raise InputError(f"task {task} changes {name}, which must be the same in every task")
        differing[name] = np.stack(column)[places]
    for name in {"dof_frictionloss", "tendon_frictionloss"} & set(differing):
        loss = differing[name]  # MJX solves a friction row of exactly 0 as a rigid joint
        differing[name] = np.where(np.any(loss > 0, axis=0), np.maximum(loss, 1e-8), loss)
    return differing


def _first_unlike(column: Sequence[Any]) -> int | None:
    """Return the index of the first value or array that differs from the first one."""
    if not isinstance(column[0], np.ndarray):
        return next((i for i, x in enumerate(column) if x != column[0]), None)
    reshaped = next((i for i, x in enumerate(column) if x.shape != column[0].shape), None)
    if reshaped is not None:
        return reshaped
    unlike = np.any((np.stack(column) != column[0]).reshape(len(column), -1), axis=1)
    return int(np.argmax(unlike)) if np.any(unlike) else None
