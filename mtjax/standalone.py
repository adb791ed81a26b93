"""Acts by a policy that ``mtjax.export`` wrote. This file needs NumPy alone, and can be copied to where it is used.

    policy = load("policy.npz")
    action = policy(obs, size=1.05)  # (A,) in [-1, 1]; the task's parameters by name

``load_jax`` returns the same policy as a compiled JAX function of batches, which needs JAX and nothing else.
"""

import json
from collections.abc import Callable
from typing import Any

import numpy as np


class Policy:
    """A policy of one family of tasks: observation normaliser, networks and the task's context are inside."""

    def __init__(self, file: Any):
        with np.load(file, allow_pickle=False) as arrays:
            self.meta = json.loads(bytes(arrays["meta"]))
            self.program = json.loads(bytes(arrays["program"]))
            self.constants = [arrays[f"constant_{i}"] for i in range(self.program["constants"])]

    def __repr__(self) -> str:
        told = f"observation ({self.meta['obs_size']},), action ({self.meta['action_size']},)"
        return f"Policy({self.meta['agent']} on {self.meta['env']}: {told}, parameters {self.meta['parameters']})"

    def __call__(self, obs: Any, **parameters: float) -> np.ndarray:
        """Return the mean action (A,) for an observation (O,) of the task with these parameters."""
        obs = np.asarray(obs, np.float32)
        if obs.shape != (self.meta["obs_size"],):
            raise ValueError(f"an observation has shape ({self.meta['obs_size']},), not {obs.shape}")
        return self._run(obs, values_of(self.meta, parameters))

    def _run(self, *inputs: np.ndarray) -> np.ndarray:
        known: dict[int, np.ndarray] = dict(enumerate((*self.constants, *inputs)))
        for operation, arguments, results, settings in self.program["steps"]:
            found = OPERATIONS[operation](*(known[i] for i in arguments), **settings)
            found = found if isinstance(found, list) else [found]
            known.update(zip(results, found, strict=True))
        return np.array(known[self.program["result"]])


def values_of(meta: dict[str, Any], parameters: dict[str, float]) -> np.ndarray:
    """Return the values (P,) of the task's parameters in their order."""
    given = {name.replace("_", "-"): value for name, value in parameters.items()}
    if set(given) != set(meta["parameters"]):
        raise ValueError(f"give the task's parameters {meta['parameters']}, not {sorted(given)}")
    return np.array([given[name] for name in meta["parameters"]], np.float32)


def load(file: Any) -> Policy:
    """Load a policy that acts by NumPy."""
    return Policy(file)


def load_jax(file: Any) -> Callable:
    """Load a policy as a JAX function: observations (B, O), values (B, P) of the parameters -> actions (B, A)."""
    from jax import export

    with np.load(file, allow_pickle=False) as arrays:
        return export.deserialize(bytearray(arrays["exported"])).call


# The operations of a program, by their names in JAX.


def product_equation(a: int, b: int, dimension_numbers: Any) -> str:
    """Return the product of arrays with ``a`` and ``b`` axes as an equation of ``einsum``."""
    (over_a, over_b), (batch_a, batch_b) = dimension_numbers
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    of_a = [next(letters) for _ in range(a)]
    of_b = [next(letters) for _ in range(b)]
    for i, j in (*zip(over_a, over_b, strict=True), *zip(batch_a, batch_b, strict=True)):
        of_b[j] = of_a[i]
    kept = [of_a[i] for i in batch_a]
    kept += [x for i, x in enumerate(of_a) if i not in (*over_a, *batch_a)]
    kept += [x for i, x in enumerate(of_b) if i not in (*over_b, *batch_b)]
    return f"{''.join(of_a)},{''.join(of_b)}->{''.join(kept)}"


def spread_sizes(x: Any, axes: int, broadcast_dimensions: Any) -> list[int]:
    """Return the shape of an array whose axes are put among ``axes``, where the others have size 1."""
    sizes = [1] * axes
    for i, dimension in enumerate(broadcast_dimensions):
        sizes[dimension] = x.shape[i]
    return sizes


def _dot_general(a, b, dimension_numbers):
    return np.einsum(product_equation(a.ndim, b.ndim, dimension_numbers), a, b)


def _broadcast_in_dim(x, shape, broadcast_dimensions):
    return np.broadcast_to(np.reshape(x, spread_sizes(x, len(shape), broadcast_dimensions)), shape)


def _dynamic_slice(x, *starts, slice_sizes):
    place = [min(max(int(s), 0), n - size) for s, n, size in zip(starts, x.shape, slice_sizes, strict=True)]
    return x[tuple(slice(s, s + size) for s, size in zip(place, slice_sizes, strict=True))]


def _slice(x, start_indices, limit_indices, strides):
    steps = strides or [1] * x.ndim
    return x[tuple(slice(*each) for each in zip(start_indices, limit_indices, steps, strict=True))]


def _select(which, *cases):
    return np.where(which, cases[1], cases[0]) if len(cases) == 2 else np.choose(which, cases)


def _top_k(x, k, axis):
    order = np.take(np.argsort(-x, axis=axis, kind="stable"), np.arange(k), axis=axis)
    return [np.take_along_axis(x, order, axis=axis), order.astype(np.int32)]


def _iota(dtype, shape, dimension):
    sizes = [n if i == dimension else 1 for i, n in enumerate(shape)]
    return np.broadcast_to(np.arange(shape[dimension], dtype=dtype).reshape(sizes), shape)


OPERATIONS: dict[str, Callable] = {
    **{name: getattr(np, name) for name in ("sign", "floor", "sqrt", "exp", "log", "log1p", "sin", "cos", "tanh")},
    **{name: getattr(np, name) for name in ("abs", "square")},
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": lambda x, y: np.divide(x, y).astype(x.dtype),
    "max": np.maximum,
    "min": np.minimum,
    "pow": np.power,
    "neg": np.negative,
    "rsqrt": lambda x: np.float32(1) / np.sqrt(x),
    "logistic": lambda x: np.float32(1) / (1 + np.exp(-x)),
    "integer_pow": lambda x, y: x**y,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.invert,
    "select_n": _select,
    "stop_gradient": lambda x: x,
    "copy": lambda x: x,
    "optimization_barrier": lambda *xs: list(xs),
    "convert_element_type": lambda x, new_dtype: np.asarray(x).astype(new_dtype),
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": lambda x, new_sizes: np.reshape(x, new_sizes),
    "squeeze": lambda x, dimensions: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, dimensions: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, permutation: np.transpose(x, permutation),
    "reduce_sum": lambda x, axes: np.sum(x, axis=tuple(axes), dtype=x.dtype),
    "reduce_max": lambda x, axes: np.max(x, axis=tuple(axes)),
    "reduce_min": lambda x, axes: np.min(x, axis=tuple(axes)),
    "reduce_prod": lambda x, axes: np.prod(x, axis=tuple(axes), dtype=x.dtype),
    "reduce_and": lambda x, axes: np.all(x, axis=tuple(axes)),
    "reduce_or": lambda x, axes: np.any(x, axis=tuple(axes)),
    "argmax": lambda x, axes, index_dtype: np.argmax(x, axis=axes[0]).astype(index_dtype),
    "argmin": lambda x, axes, index_dtype: np.argmin(x, axis=axes[0]).astype(index_dtype),
    "concatenate": lambda *xs, dimension: np.concatenate(xs, axis=dimension),
    "stack": lambda *xs, axis: np.stack(xs, axis=axis),
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis=axis),
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "dot_general": _dot_general,
    "iota": _iota,
    "top_k": _top_k,
    "clamp": lambda low, x, high: np.clip(x, low, high),
}
SETTINGS = {  # of operations, that programs keep; others only say how a device computes
    "dot_general": ("dimension_numbers",),
    "broadcast_in_dim": ("shape", "broadcast_dimensions"),
    "convert_element_type": ("new_dtype",),
    "integer_pow": ("y",),
    "reshape": ("new_sizes",),
    "squeeze": ("dimensions",),
    "expand_dims": ("dimensions",),
    "transpose": ("permutation",),
    **{f"reduce_{name}": ("axes",) for name in ("sum", "max", "min", "prod", "and", "or")},
    **{name: ("axes", "index_dtype") for name in ("argmax", "argmin")},
    "concatenate": ("dimension",),
    "stack": ("axis",),
    "split": ("sizes", "axis"),
    "slice": ("start_indices", "limit_indices", "strides"),
    "dynamic_slice": ("slice_sizes",),
    "iota": ("dtype", "shape", "dimension"),
    "top_k": ("k", "axis"),
}
