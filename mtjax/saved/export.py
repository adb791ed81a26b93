"""Policies as one file that runs without this package: for JAX and NumPy, or as an ONNX model."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax import __version__, frames
from mtjax.agents import BaseAgent, name_of
from mtjax.checks import path
from mtjax.envs import Family
from mtjax.envs import name_of as env_name_of
from mtjax.envs.contexts import ranges
from mtjax.envs.pixels import Pictured
from mtjax.envs.scenery import GREY
from mtjax.names import InputError, public
from mtjax.saved import onnx
from mtjax.saved.operations import steps_of
from mtjax.saved.policy import Policy, by_name
from mtjax.types import Array

_PLATFORMS = ("cpu", "cuda")
_BRIGHTNESS = " + ".join(f"{weight:g} {colour}" for weight, colour in zip(GREY, ("red", "green", "blue"), strict=True))


@public
def export(policy: Policy, file: str | Path) -> Path:
    """Write the mean action of a policy, or the likeliest choice, with normaliser and task context, into one file.

    Args:
        file: ends with .npz, which ``mtjax.standalone`` reads by NumPy alone or by JAX alone; or with .onnx, a model of
            the inputs ``obs`` (O,) and ``parameters`` (P,), and the output ``action``: (A,), or the number () int32 of
            a choice, or the numbers (D,) of several. Of a policy that sees pictures the inputs are ``pixels``
            (H, W, N C), a stack of pictures, and ``state`` (O,) if it sees that too; of other trees of arrays, their
            paths such as ``seen/grid``.

    Raises:
        InputError: the file exists, or the agent acts by what it remembers of the episode, or it is of a mixture,
            or the package onnx is missing.
    """
    file = require_file(file)
    if not isinstance(policy, Policy):
        raise InputError(f"export takes a policy, from mtjax.load or result.policy(), not a {type(policy).__name__}")
    env, act, obs = policy.env, acting(policy), policy.takes
    assert isinstance(env, Family)
    values = jax.ShapeDtypeStruct((len(ranges(env)),), jnp.float32)
    program, constants = steps_of(jax.make_jaxpr(act)(obs, values))
    meta = _meta(env, policy.agent, by_name(obs))
    new = file.with_suffix(f".new{file.suffix}")
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".onnx":
        onnx.write(program, constants, by_name(obs) | {"parameters": values}, meta, new)
    else:
        text = lambda x: np.frombuffer(json.dumps(x).encode(), np.uint8)
        arrays: dict[str, Any] = {f"constant_{i}": x for i, x in enumerate(constants)}
        exported = _serialised(act, obs, values)
        np.savez_compressed(new, meta=text(meta), program=text(program), exported=exported, **arrays)
    os.replace(new, file)
    return file


def require_file(file: str | Path) -> Path:
    """Return the path of a file to export to.

    Raises:
        InputError: it exists, or ends with something else than .npz or .onnx.
    """
    file = path(file, "file")
    if file.suffix not in (".npz", ".onnx"):
        raise InputError(f"a policy is exported to a file that ends with .npz or .onnx, not to {str(file)!r}")
    if file.suffix == ".onnx":
        onnx.require_onnx()
    if file.exists():
        raise InputError(f"{str(file)!r} exists already; give another name or remove it")
    return file


def _meta(env: Family, agent: BaseAgent, obs: dict[str, Any]) -> dict[str, Any]:
    """Return what a file tells of its policy, which takes ``obs`` of these shapes."""
    return {
        "env": env_name_of(env),
        "agent": name_of(agent),
        "obs": {name: x.shape for name, x in obs.items()},
        "frames": env.spec.frames,
        "seconds": env.seconds_per_step if isinstance(env, Pictured) else None,  # between two actions
        "about": " ".join(_about(env, name, x) for name, x in obs.items()),
        "action_size": env.spec.action_size,
        "action": str(env.spec.action),
        "parameters": [name for name, _, _ in ranges(env)],
        "trained_from": [low for _, low, _ in ranges(env)],
        "trained_to": [high for _, _, high in ranges(env)],
        "mtjax": __version__,
        "jax": jax.__version__,
    }


def _about(env: Family, name: str, array: Any) -> str:
    """Return sentences on an array of the observation, for whoever makes it elsewhere."""
    shape = array.shape
    if name != frames.PICTURES:
        kind = "a vector" if len(shape) == 1 else "an array"
        return f"{name} {shape} {array.dtype}: {kind} as the family observes it. It is normalised inside."
    picture, count = env.spec.obs[name].shape, env.spec.frames
    known = {1: f"1 channel, the rounded brightness {_BRIGHTNESS}", 3: "the channels red, green and blue"}
    channels = known.get(picture[-1], f"{picture[-1]} channels")
    each = f"Row 0 of a picture is its top, and it has {channels}, from 0 to 255."
    if count == 1:
        return f"{name} {shape} uint8: the newest picture. {each}"
    return (
        f"{name} {shape} uint8: the last {count} pictures {picture}, joined along the last axis, oldest first. An "
        f"episode begins with its first picture {count} times. After every action the oldest goes and the newest "
        f"comes. {each}"
    )


def acting(policy: Policy) -> Callable[[Any, Array], Array]:
    """Return the function from an observation, as ``policy.takes``, and the parameters' values (P,) to the action (A,).

    Raises:
        InputError: as ``export``.
    """
    env, agent, state = policy.env, policy.agent, policy.state
    if not isinstance(env, Family):
        raise InputError("export takes a policy of one family, and this one is of a mixture")
    if agent.view.history or agent.conditioning.recurs:
        raise InputError("export takes agents that act by what they see, and this one infers its task from memory")
    if agent.goes_on:
        raise InputError("export takes agents that act by what they see, and this one goes on with what it has chosen")

    def act(obs: Any, values: Array) -> Array:
        task = policy.task_of(values)
        return agent.act(state, agent.begin(state, task), obs, task, None).action

    return act


def _serialised(act: Callable, obs: Any, values: Any) -> np.ndarray:
    """Return the program for batches of any size, as bytes. Several arrays are a dictionary by their paths."""
    (size,), named, tree = jax.export.symbolic_shape("batch"), by_name(obs), jax.tree.structure(obs)
    taken = obs if jax.tree_util.treedef_is_leaf(tree) else named

    def call(taken: Any, values: Array) -> Array:
        return act(tree.unflatten([taken[name] for name in named] if isinstance(taken, dict) else [taken]), values)

    batches = jax.tree.map(lambda x: jax.ShapeDtypeStruct((size, *x.shape), x.dtype), (taken, values))
    exported = jax.export.export(jax.jit(jax.vmap(call)), platforms=_PLATFORMS)(*batches)
    return np.frombuffer(bytes(exported.serialize()), np.uint8)
