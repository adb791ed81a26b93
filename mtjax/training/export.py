"""Policies as one file that runs without this package: for JAX and NumPy, or as an ONNX model."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax import __version__
from mtjax.agents import name_of
from mtjax.checks import path
from mtjax.envs import Family
from mtjax.envs import name_of as env_name_of
from mtjax.names import InputError
from mtjax.standalone import OPERATIONS, SETTINGS
from mtjax.training import onnx
from mtjax.training.policy import Policy
from mtjax.types import Array, Task

_PLATFORMS = ("cpu", "cuda")
_CALLS = ("jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "custom_jvp_call", "custom_vjp_call")


def export(policy: Policy, file: str | Path) -> Path:
    """Write the mean action of a policy, with normaliser and task context, into one file.

    Args:
        file: ends with .npz, which ``mtjax.standalone`` reads by NumPy alone or by JAX alone; or with .onnx, a model of
            the inputs ``obs`` (O,) and ``parameters`` (P,), and the output ``action`` (A,).

    Raises:
        InputError: the file exists, or the agent infers its task from memory, or it is of a mixture, or the package
            onnx is missing.
    """
    file = require_file(file)
    if not isinstance(policy, Policy):
        raise InputError(f"export takes a policy, from mtjax.load or result.policy(), not a {type(policy).__name__}")
    env, act = policy.env, acting(policy)
    assert isinstance(env, Family)
    obs, values = (jax.ShapeDtypeStruct((size,), jnp.float32) for size in (env.spec.obs_size, len(env.ranges)))
    meta = {
        "env": env_name_of(env),
        "agent": name_of(policy.agent),
        "obs_size": env.spec.obs_size,
        "action_size": env.spec.action_size,
        "parameters": [name for name, _, _ in env.ranges],
        "trained_from": [low for _, low, _ in env.ranges],
        "trained_to": [high for _, _, high in env.ranges],
        "mtjax": __version__,
        "jax": jax.__version__,
    }
    program, constants = steps_of(jax.make_jaxpr(act)(obs, values))
    new = file.with_suffix(f".new{file.suffix}")
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".onnx":
        onnx.write(program, constants, meta, new)
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


def acting(policy: Policy) -> Callable[[Array, Array], Array]:
    """Return the function from an observation (O,) and the parameters' values (P,) to the mean action (A,).

    Raises:
        InputError: as ``export``.
    """
    env, agent, state = policy.env, policy.agent, policy.state
    if not isinstance(env, Family):
        raise InputError("export takes a policy of one family, and this one is of a mixture")
    if agent.history_length:
        raise InputError("export takes agents that act by what they see, and this one infers its task from memory")
    trained = env.tasks("train")
    first = jax.tree.map(lambda x: x[0], trained)._replace(draws=None)

    def act(obs: Array, values: Array) -> Array:
        task = _task(env, first, trained, values)
        return agent.act(state, agent.begin(state, task), obs, task, None).action

    return act


def _task(env: Family, first: Task, trained: Task, values: Array) -> Task:
    """Return the task with the values (P,) of its parameters. One that trained has its number, others one beyond."""
    columns = []
    for i, (name, low, high) in enumerate(env.ranges):
        if name in env.parameters and env.parameters[name].direction:
            columns += [jnp.sin(values[i]), jnp.cos(values[i])]
        else:
            columns.append((values[i] - (low + high) / 2) / ((high - low) / 2 or 1.0))
    context = jnp.stack(columns) if columns else jnp.zeros(1)
    same = jnp.all(jnp.abs(trained.context - context) < 1e-5, axis=1)
    number = jnp.where(jnp.any(same), jnp.argmax(same), len(env.tasks("all").id)).astype(jnp.int32)
    return first._replace(id=number, context=context.astype(jnp.float32))


def _serialised(act: Callable, obs: Any, values: Any) -> np.ndarray:
    """Return the program for batches of any size, as bytes."""
    (size,) = jax.export.symbolic_shape("batch")
    batch = lambda x: jax.ShapeDtypeStruct((size, *x.shape), x.dtype)
    exported = jax.export.export(jax.jit(jax.vmap(act)), platforms=_PLATFORMS)(batch(obs), batch(values))
    return np.frombuffer(bytes(exported.serialize()), np.uint8)


# Programs for NumPy.


def steps_of(closed: Any) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return a traced function of one result as a list of steps, and its constants.

    Raises:
        InputError: it uses an operation that ``standalone`` lacks.
    """
    writer = _Writer(len(closed.jaxpr.invars))
    (result,) = writer.write(closed.jaxpr, closed.consts, list(range(len(closed.jaxpr.invars))))
    count = len(writer.constants)
    number = lambda i: -i - 1 if i < 0 else i + count  # the constants come first, then the inputs
    steps = [[name, [*map(number, x)], [*map(number, y)], kept] for name, x, y, kept in writer.steps]
    return {"constants": count, "steps": steps, "result": number(result)}, writer.constants


class _Writer:
    """Collects the steps of a traced function and of those that it calls. Constants have negative numbers."""

    def __init__(self, inputs: int):
        self.count, self.steps, self.constants = inputs, [], []
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
