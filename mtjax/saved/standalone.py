"""Acts by a policy that ``mtjax.export`` wrote. This file needs NumPy alone, and can be copied to where it is used.

    policy = load("policy.npz")
    action = policy(obs, size=1.05)  # (A,) in [-1, 1], or choices; the task's parameters by name

A policy that sees pictures takes a stack of the last ones, which ``begin`` and ``push`` keep:

    stack = begin(picture, policy.meta["frames"])  # (H, W, N C) uint8, at the start of an episode
    action = policy({"pixels": stack}, size=1.05)
    stack = push(stack, next_picture)  # after every action

A policy that remembers its trial, of ``policy.meta["trial"]`` episodes, takes its memory, which the caller keeps:

    memory = policy.begin()  # at the start of a trial
    action = policy(obs, memory=memory, size=1.05)
    memory = policy.remember(memory, obs, action, reward, next_obs, ended, size=1.05)  # after every action

``policy.meta["about"]`` says what it observes. ``load_jax`` returns the same policy as a compiled JAX function of
batches, which needs JAX and nothing else.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from typing import Any

import numpy as np

PICTURES = "pixels"
"""The entry of an observation that holds pictures, uint8. Other arrays may be given as float32."""


class Policy:
    """A policy of one family of tasks: observation normaliser, networks and the task's context are inside."""

    def __init__(self, file: Any):
        arrays = _arrays(file)
        meta = json.loads(bytes(arrays["meta"]))
        self.meta = {"obs": {"obs": [meta.get("obs_size")]}, "memory": 0} | meta  # as files of before did not say
        self.program, self.constants = _program(arrays, "")
        self._begun = arrays.get("begun")
        self._remembers = _program(arrays, "remember_") if self.meta["memory"] else None

    def __repr__(self) -> str:
        seen = ", ".join(f"{name} {shape}" for name, shape in shapes_of(self.meta).items()).removeprefix("obs ")
        action = self.meta.get("action", f"({self.meta['action_size']},)")  # as files from before choices say
        told = f"observation {seen}, action {action}"
        return f"Policy({self.meta['agent']} on {self.meta['env']}: {told}, parameters {self.meta['parameters']})"

    def __call__(self, obs: Any, memory: Any = None, **parameters: float) -> np.ndarray:
        """Return the mean action (A,) of the task with these parameters, or (B, A) of a batch of observations.

        If actions are discrete, it is the likeliest: a number () int32, or (B,); numbers (D,) of several, or (B, D).

        Args:
            obs: an observation (O,), or the tree of arrays that the family observes; of a policy that sees pictures
                {"pixels": (H, W, N C) uint8}, beside which may be "state": (O,). All of a batch have a leading B.
            memory: of a policy that remembers its trial (M,), or (B, M); without it a trial has just begun.
            parameters: the task's parameters; in a batch each may be (B,). A policy that reads none takes them or
                leaves them out.
        """
        seen, size = observed(self.meta, obs)
        values = self._values(parameters, len(seen) in self.program["reads"], size)
        given = [*seen, values]
        if self.meta["memory"]:
            given.append(self._held(self.begin() if memory is None else memory, size))
        return _for_each(self.program, self.constants, given, size)

    def begin(self) -> np.ndarray:
        """Return the memory (M,) with which a trial begins."""
        self._remembering("begin")
        return np.array(self._begun)

    def remember(
        self,
        memory: Any,
        obs: Any,
        action: Any,
        reward: Any,
        next_obs: Any,
        ended: Any = False,
        **parameters: float,
    ) -> np.ndarray:
        """Return the memory (M,) after a step, or (B, M) of a batch of steps.

        Args:
            memory: before the step.
            ended: whether an episode ended with it. With the last one of a trial, take the memory of ``begin``.
        """
        program, constants = self._remembering("remember")
        (seen, size), (after, _) = observed(self.meta, obs), observed(self.meta, next_obs)
        chosen = np.asarray(action, np.int32 if self.meta.get("discrete") else np.float32)
        numbers = [np.broadcast_to(np.float32(x), () if size is None else (size,)) for x in (reward, ended)]
        values = self._values(parameters, len(seen) in program["reads"], size)
        given = [*seen, values, self._held(memory, size), chosen, numbers[0], *after, numbers[1]]
        return _for_each(program, constants, given, size)

    def _values(self, parameters: dict[str, Any], needed: bool, size: int | None) -> np.ndarray:
        """Return the values (P,) or (B, P) of the task's parameters."""
        given = ordered(self.meta["parameters"], parameters, needed, size)
        values = np.array(np.broadcast_arrays(*given), np.float32).T if given else np.zeros(0, np.float32)
        return values if size is None else np.broadcast_to(values, (size, len(given)))

    def _held(self, memory: Any, size: int | None) -> np.ndarray:
        """Return a memory (M,) or (B, M)."""
        shape = (self.meta["memory"],)
        return np.broadcast_to(np.asarray(memory, np.float32), shape if size is None else (size, *shape))

    def _remembering(self, name: str) -> Any:
        if self._remembers is None:
            raise ValueError(f"this policy acts by what it sees, and has no memory to {name}")
        return self._remembers


def _program(arrays: dict[str, np.ndarray], name: str) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return a program and its constants, whose names begin with ``name``."""
    program = {"reads": [0, 1]} | json.loads(bytes(arrays[f"{name}program"]))  # which files of before did not say
    return program, [arrays[f"{name}constant_{i}"] for i in range(program["constants"])]


def _for_each(
    program: dict[str, Any], constants: list[np.ndarray], inputs: list[np.ndarray], size: int | None
) -> np.ndarray:
    """Run a program, for each of a batch of inputs with a leading B if there is a size."""
    if size is None:
        return _run(program, constants, inputs)
    return np.stack([_run(program, constants, [x[i] for x in inputs]) for i in range(size)])


def _run(program: dict[str, Any], constants: list[np.ndarray], inputs: list[np.ndarray]) -> np.ndarray:
    known: dict[int, np.ndarray] = dict(enumerate((*constants, *inputs)))
    for operation, arguments, results, settings in program["steps"]:
        found = OPERATIONS[operation](*(known[i] for i in arguments), **settings)
        found = found if isinstance(found, list) else [found]
        known.update(zip(results, found, strict=True))
    return np.array(known[program["result"]])


def shapes_of(meta: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of what a policy observes, by name. An array alone is called obs.

    Of nested observations a name is a path: ``seen/0`` is the first array of the tuple ``seen``.
    """
    return {name: tuple(shape) for name, shape in meta["obs"].items()}


def observed(meta: dict[str, Any], obs: Any) -> tuple[list[np.ndarray], int | None]:
    """Return the arrays that a policy takes of an observation, in their order, and the size B if it is a batch."""
    shapes = shapes_of(meta)
    given = entries(obs, shapes)
    require_numbers(given)
    arrays = {name: np.asarray(x, None if name == PICTURES else np.float32) for name, x in given.items()}
    size = batch_size(shapes, {name: x.shape for name, x in arrays.items()})
    require_bytes(arrays)
    return [arrays[name] for name in shapes], size


def entries(obs: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return those arrays of an observation that there are, by names of ``shapes_of``."""
    found = {}
    for name in names:
        if name == "obs" and not isinstance(obs, Mapping):
            return {name: obs}
        try:
            found[name] = reduce(_entry, name.split("/"), obs)
        except (AttributeError, IndexError, KeyError):
            pass  # which whoever compares the names reports
    return found


def _entry(tree: Any, name: str) -> Any:
    if isinstance(tree, Mapping):
        return tree[name]
    return tree[int(name)] if isinstance(tree, list | tuple) and name.isdigit() else getattr(tree, name)


def require_numbers(given: Mapping[str, Any]) -> None:
    """Raise ValueError if a value is neither a real number nor an array of such."""
    told = {"U": "text", "S": "text", "c": "complex ones", "lists": "lists of different lengths"}
    for name, x in given.items():
        kind = _kind(x)
        if kind not in "biufV":  # V: bfloat16
            raise ValueError(f"{name} takes numbers, not {told.get(kind, 'other objects')}")


def _kind(x: Any) -> str:
    """Return the letter of NumPy for what an array, or what becomes one, holds."""
    dtype: Any = getattr(x, "dtype", None)
    try:
        return dtype.kind if hasattr(dtype, "kind") else np.asarray(x).dtype.kind
    except TypeError:  # a key of random numbers
        return "O"
    except ValueError:
        return "lists"


def require_bytes(obs: dict[str, Any]) -> None:
    """Raise ValueError if an observation has pictures that are not of bytes."""
    if PICTURES in obs and obs[PICTURES].dtype != np.uint8:
        raise ValueError(f"pictures are uint8, from 0 to 255, not {obs[PICTURES].dtype}")


def batch_size(shapes: dict[str, tuple[int, ...]], given: dict[str, tuple[int, ...]]) -> int | None:
    """Return the size B of a batch by the shapes of observations that were given, or None if it is a single one.

    Raises:
        ValueError: they are neither of the shapes of an observation nor of a batch.
    """
    if not shapes.keys() <= given.keys():
        raise ValueError(f"an observation is a dict of {shapes}")
    before = {name: given[name][: len(given[name]) - len(shape)] for name, shape in shapes.items()}
    for name, shape in shapes.items():
        if given[name] != before[name] + shape or before[name] != next(iter(before.values())) or len(before[name]) > 1:
            fix = "begin and push make stacks of pictures" if name == PICTURES else "a batch has one axis before it"
            raise ValueError(f"{name} has shape {shape}, not {given[name]}; {fix}")
    return next((leading[0] for leading in before.values() if leading), None)


def ordered(names: list[str], parameters: dict[str, Any], needed: bool, size: int | None) -> list[Any]:
    """Return the values of the task's parameters in their order; zeros if they are not needed and not given.

    Raises:
        ValueError: there are other names, or a value is neither a number nor, in a batch of a size B, (B,).
    """
    given = {name.replace("_", "-"): value for name, value in parameters.items()}
    if not needed and not given:
        given = dict.fromkeys(names, 0.0)
    if set(given) != set(names):
        raise ValueError(f"give the task's parameters {names}, not {sorted(given)}")
    require_numbers(given)
    for name, value in given.items():
        if np.shape(value) not in ((), (size,)):
            of_batch = "" if size is None else f", or an array ({size},) as there are {size} observations"
            raise ValueError(f"{name} is a number{of_batch}, not of shape {np.shape(value)}")
    return [given[name] for name in names]


def _arrays(file: Any) -> dict[str, np.ndarray]:
    """Return the arrays of a path or of an open file."""
    if not hasattr(file, "read"):
        with open(file, "rb") as opened:  # as NumPy leaves a damaged archive open
            return _arrays(opened)
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in {"meta", "program", *arrays.files}}
    except Exception as error:  # a damaged archive may raise anything
        name = getattr(file, "name", "the file")
        raise ValueError(f"{name} is no .npz file of mtjax.export, or damaged ({type(error).__name__})") from None


def load(file: Any) -> Policy:
    """Load a policy that acts by NumPy.

    Raises:
        ValueError: the file is damaged, or another one.
    """
    return Policy(file)


def load_jax(file: Any, of: str = "act") -> Callable:
    """Load a policy as a JAX function: observations (B, O), values (B, P) of the parameters -> actions (B, A).

    A policy of several arrays takes a dict of exactly ``shapes_of(policy.meta)``, with a leading B, of the types that
    ``policy.meta["about"]`` tells. One that remembers its trial takes memories (B, M) too. With "remember" it is the
    function from observations, values, memories, actions, rewards (B,), next observations and ends (B,) of 0 or 1,
    float32, to the next memories (B, M).
    """
    from jax import export

    name = {"act": "exported", "remember": "remember_exported"}[of]
    return export.deserialize(bytearray(_arrays(file)[name])).call


# The last pictures of an episode, (..., H, W, N C) for N pictures of C channels, oldest first.


def begin(picture: np.ndarray, frames: int) -> np.ndarray:
    """Return the stack at the start of an episode: its first picture (..., H, W, C), repeated ``frames`` times."""
    return np.concatenate([picture] * frames, axis=-1)


def push(stack: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Return the stack after a step: without its oldest picture, and with the next one at the end."""
    return np.concatenate([stack[..., np.shape(picture)[-1] :], picture], axis=-1)


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


def _windows(x, sizes, strides, padding, dilation, fill):
    """Return windows of an array: the axes of their places, then those of their entries."""
    padded = np.pad(x, padding, constant_values=fill)
    spans = [(size - 1) * apart + 1 for size, apart in zip(sizes, dilation, strict=True)]
    windows = np.lib.stride_tricks.sliding_window_view(padded, spans)
    return windows[tuple(slice(None, None, step) for step in (*strides, *dilation))]


def _conv_general_dilated(x, kernel, window_strides, padding, rhs_dilation, dimension_numbers):
    """Convolve by a product of windows, a row each, with kernels (window, output)."""
    of_x, of_kernel, of_result = ((first, *space, second) for first, second, *space in dimension_numbers)
    x = np.transpose(x, of_x)
    kernel = np.transpose(kernel, (*of_kernel[1:], of_kernel[0]))
    sizes, strides = (1, *kernel.shape[:-1]), (1, *window_strides, 1)
    windows = _windows(x, sizes, strides, [(0, 0), *padding, (0, 0)], (1, *rhs_dilation, 1), 0)
    rows = windows.reshape(-1, kernel[..., 0].size)
    result = (rows @ kernel.reshape(rows.shape[1], -1)).reshape(*windows.shape[: x.ndim - 1], -1)
    return np.transpose(result, np.argsort(of_result))


def _reduce_window_max(x, window_dimensions, window_strides, padding, window_dilation):
    windows = _windows(x, window_dimensions, window_strides, padding, window_dilation, -np.inf)
    return windows.max(axis=tuple(range(x.ndim, 2 * x.ndim)))


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
    "unstack": lambda x, axis: list(np.moveaxis(x, axis, 0)),
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis=axis),
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "dot_general": _dot_general,
    "conv_general_dilated": _conv_general_dilated,
    "reduce_window_max": _reduce_window_max,
    "iota": _iota,
    "top_k": _top_k,
    "clamp": lambda low, x, high: np.clip(x, low, high),
}
SETTINGS = {  # of operations, that programs keep; others only say how a device computes
    "dot_general": ("dimension_numbers",),
    "conv_general_dilated": ("window_strides", "padding", "rhs_dilation", "dimension_numbers"),
    "reduce_window_max": ("window_dimensions", "window_strides", "padding", "window_dilation"),
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
    **dict.fromkeys(("stack", "unstack"), ("axis",)),
    "split": ("sizes", "axis"),
    "slice": ("start_indices", "limit_indices", "strides"),
    "dynamic_slice": ("slice_sizes",),
    "iota": ("dtype", "shape", "dimension"),
    "top_k": ("k", "axis"),
}
