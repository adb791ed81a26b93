"""Policies as one file that runs without this package: for JAX and NumPy, or as an ONNX model."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax import __version__, frames
from mtjax.agents import BaseAgent, name_of
from mtjax.checks import path
from mtjax.envs import Family
from mtjax.envs import name_of as env_name_of
from mtjax.envs.contexts import ranges
from mtjax.envs.pixels import Drawable
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
            paths such as ``seen/grid``. An agent that remembers its trial goes into a file .npz, which has how its
            memory begins and changes too.

    Raises:
        InputError: the file exists, or the agent goes on with an option, or remembers and the file is .onnx, or it is
            of a mixture, or the package onnx is missing.
    """
    file = require_file(file)
    if not isinstance(policy, Policy):
        raise InputError(f"export takes a policy, from mtjax.load or result.policy(), not a {type(policy).__name__}")
    env, act, obs = policy.env, acting(policy), policy.takes
    assert isinstance(env, Family)
    memory = Flat.of(policy)
    if memory.size and file.suffix == ".onnx":
        raise InputError("an agent that remembers its trial is exported to a file that ends with .npz")
    values = jax.ShapeDtypeStruct((len(ranges(env)),), jnp.float32)
    meta = _meta(env, policy.agent, by_name(obs)) | {"memory": memory.size, "trial": policy.trial}
    new = file.with_suffix(f".new{file.suffix}")
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".onnx":
        program, constants = steps_of(jax.make_jaxpr(act)(obs, values))
        onnx.write(program, constants, by_name(obs) | {"parameters": values}, meta, new)
    else:
        arrays = _written("", act, obs, values, *memory.shapes)
        if memory.size:
            arrays |= _written("remember_", remembering(policy), obs, values, *memory.shapes, *_step_of(env, obs))
            arrays["begun"] = np.asarray(memory.begun)
        np.savez_compressed(new, meta=_text(meta), **arrays)
    os.replace(new, file)
    return file


class Flat(NamedTuple):
    """Lays out what an agent remembers of a trial as one vector (M,)."""

    begun: Array  # (M,) with which a trial begins
    unpack: Callable[[Array], Any]  # from a vector to the agent's memory

    @classmethod
    def of(cls, policy: Policy) -> "Flat":
        """Return the layout of a policy's memory, as far as acting reads it."""
        memory = policy.begin(jax.tree.map(lambda x: x[0], policy.env.tasks("all")._replace(draws=None)))
        leaves, tree = jax.tree.flatten((memory.past, memory.hidden))
        ends = np.cumsum([0, *(x.size for x in leaves)]).tolist()

        def unpack(vector: Array) -> Any:
            cut = [
                vector[low:high].reshape(x.shape).astype(x.dtype)
                for x, low, high in zip(leaves, ends[:-1], ends[1:], strict=True)
            ]
            past, hidden = tree.unflatten(cut)
            return memory._replace(past=past, hidden=hidden)

        return cls(pack(memory), unpack)

    @property
    def size(self) -> int:
        """The number M; 0 for no memory."""
        return self.begun.size

    @property
    def shapes(self) -> tuple[Any, ...]:
        """What programs take as the memory: a vector, or nothing."""
        return (jax.ShapeDtypeStruct(self.begun.shape, jnp.float32),) if self.size else ()


def pack(memory: Any) -> Array:
    """Return an agent's memory, as far as acting reads it, as one vector (M,)."""
    leaves = jax.tree.leaves((memory.past, memory.hidden))
    return jnp.concatenate([jnp.zeros(0), *(x.reshape(-1).astype(jnp.float32) for x in leaves)])


def _step_of(env: Family, obs: Any) -> tuple[Any, ...]:
    """Return the shapes of what follows an observation in a step: action, reward, next observation, and the end."""
    action = jax.eval_shape(env.spec.action.blank)
    number = jax.ShapeDtypeStruct((), jnp.float32)
    return jax.ShapeDtypeStruct(action.shape, action.dtype), number, obs, number


def _written(name: str, function: Callable, *shapes: Any) -> dict[str, Any]:
    """Return the arrays of a program in a file, whose names begin with ``name``."""
    program, constants = steps_of(jax.make_jaxpr(function)(*shapes))
    arrays: dict[str, Any] = {f"{name}constant_{i}": x for i, x in enumerate(constants)}
    return arrays | {f"{name}program": _text(program), f"{name}exported": _serialised(function, *shapes)}


def _text(x: Any) -> np.ndarray:
    return np.frombuffer(json.dumps(x).encode(), np.uint8)


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
        "seconds": env.seconds_per_step if isinstance(env, Drawable) and env.films else None,  # between two actions
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


def acting(policy: Policy) -> Callable[..., Array]:
    """Return the function from an observation, as ``policy.takes``, and the parameters' values (P,) to the action (A,).

    Of an agent that remembers it takes the memory (M,) too.

    Raises:
        InputError: as ``export``.
    """
    env, agent, state = policy.env, policy.agent, policy.state
    if not isinstance(env, Family):
        raise InputError("export takes a policy of one family, and this one is of a mixture")
    if agent.goes_on:
        raise InputError("export takes agents that act by what they see, and this one goes on with what it has chosen")
    unpack = Flat.of(policy).unpack

    def act(obs: Any, values: Array, *memory: Array) -> Array:
        task = policy.task_of(values)
        known = unpack(*memory) if memory else agent.begin(state, task)
        return agent.act(state, known, obs, task, None).action

    return act


def remembering(policy: Policy) -> Callable[..., Array]:
    """Return the function from a step of a task to the memory (M,) after it, given that before it.

    It takes the observation, the parameters' values (P,), the memory (M,), the action, the reward (), the next
    observation, and whether the episode has ended (), as a number.
    """
    unpack = Flat.of(policy).unpack

    def remember(obs: Any, values: Array, memory: Array, action: Array, reward: Array, after: Any, ended: Array):
        step = (obs, action, reward, after, ended > 0)
        return pack(policy.remember(unpack(memory), policy.task_of(values), *step))

    return remember


def _serialised(function: Callable, obs: Any, *shapes: Any) -> np.ndarray:
    """Return the program for batches of any size, as bytes. Several arrays are a dictionary by their paths."""
    (size,), named, tree = jax.export.symbolic_shape("batch"), by_name(obs), jax.tree.structure(obs)
    given = (obs, *shapes)
    seen = [jax.tree.structure(x) == tree and not jax.tree_util.treedef_is_leaf(tree) for x in given]
    whole = lambda x, is_seen: tree.unflatten([x[name] for name in named]) if is_seen else x
    call = lambda *taken: function(*map(whole, taken, seen))
    taken = tuple(by_name(x) if is_seen else x for x, is_seen in zip(given, seen, strict=True))
    batches = jax.tree.map(lambda x: jax.ShapeDtypeStruct((size, *x.shape), x.dtype), taken)
    exported = jax.export.export(jax.jit(jax.vmap(call)), platforms=_PLATFORMS)(*batches)
    return np.frombuffer(bytes(exported.serialize()), np.uint8)
