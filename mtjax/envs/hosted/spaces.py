"""Spaces of Gymnasium, as agents observe and act."""

import itertools
import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import numpy as np

from mtjax.checks import shown
from mtjax.frames import PICTURES
from mtjax.types import Array, Continuous, Discrete, InputError, MultiDiscrete

_LEAST_PICTURE = 16
"""Pixels a side of the smallest picture. Smaller arrays of bytes, such as those of grid worlds, are vectors."""
_MOST_CHANNELS = 4
_ARRAYS = ("Box", "Discrete", "MultiDiscrete", "MultiBinary")
_NARROW = {"int64": "int32", "uint64": "uint32", "float16": "float32", "float64": "float32"}


class WrongShape(ValueError):
    """An observation has another shape than its space."""


def reader_of(name: str, space: Any) -> "Reader | TreeReader":
    """Return what reads the observations of a space.

    Raises:
        InputError: it has something else than arrays of numbers.
    """
    return Reader(space) if _is_box(space) and np.prod(space.shape) else TreeReader(name, space)


def form(space: Any) -> Any:
    """Return the kinds, shapes and types of a space's arrays. Their bounds may differ between tasks."""
    return jax.tree.map(lambda x: (type(x).__name__, x.shape, str(x.dtype)), _nested(space))


def _nested(space: Any) -> Any:
    """Return the spaces in a Dict or a Tuple as a tree; of another space itself."""
    kind = type(space).__name__
    if kind == "Dict":
        return {name: _nested(x) for name, x in space.spaces.items()}
    return tuple(map(_nested, space.spaces)) if kind == "Tuple" else space


def _is_box(space: Any) -> bool:
    return type(space).__name__ == "Box" and np.issubdtype(space.dtype, np.number)


class Reader:
    """Turns observations of a Box of numbers into vectors (O,) float32, or pictures (H, W, C) uint8."""

    def __init__(self, space: Any):
        shape = space.shape
        self.given, self.axes, self.shape = shape, None, (int(np.prod(shape)),)
        if space.dtype == np.uint8 and len(shape) in (2, 3):
            self._see(shape if len(shape) == 3 else (*shape, 1))
        self.dtype = np.dtype(np.float32 if len(self.shape) == 1 else np.uint8)

    def _see(self, shape: tuple[int, ...]) -> None:
        """Note where the channels of a picture are. Arrays that are none stay vectors."""
        for axes in ((0, 1, 2), (1, 2, 0)):
            high, wide, channels = (shape[i] for i in axes)
            if self.axes is None and channels <= _MOST_CHANNELS and min(high, wide) >= _LEAST_PICTURE:
                self.axes, self.shape = axes, (high, wide, channels)

    def read_each(self, obs: Sequence[Any]) -> np.ndarray:
        """Return k observations as rows (k, ...)."""
        return self.read_all(np.stack(obs))

    def read_all(self, obs: np.ndarray) -> np.ndarray:
        """Return observations (k, ...) as rows (k, ...)."""
        if obs.shape[1:] != self.given:
            raise WrongShape(f"gave an observation of shape {obs.shape[1:]}; its observation_space has {self.given}")
        if self.axes is None:
            return obs.astype(np.float32).reshape(len(obs), *self.shape)
        pictures = obs if obs.ndim == 4 else obs[..., None]
        return pictures.transpose(0, *(1 + axis for axis in self.axes))

    def show(self, rows: Array) -> Any:
        """Return rows as agents observe them."""
        return rows if self.axes is None else {PICTURES: rows}


class Column:
    """Keeps the shape of one array of a tree. Its numbers of 64 bits become those of 32."""

    def __init__(self, space: Any):
        self.shape, self.dtype = space.shape, np.dtype(_NARROW.get(str(space.dtype), space.dtype))

    def read_all(self, obs: Any) -> np.ndarray:
        """Return arrays (k, ...) of this type."""
        if np.shape(obs)[1:] != self.shape:
            raise WrongShape(f"gave a part of an observation of shape {np.shape(obs)[1:]}; its space has {self.shape}")
        return np.asarray(obs, self.dtype)


class TreeReader:
    """Turns observations of any other space into rows of bytes (N,) uint8, and rows into trees of arrays.

    So worlds on the host hold one array, whatever they observe.
    """

    def __init__(self, name: str, space: Any):
        found, self.tree = jax.tree.flatten_with_path(_nested(space))
        if not found or any(type(x).__name__ not in _ARRAYS or not np.prod(x.shape) for _, x in found):
            raise InputError(
                f"{name} observes {shown(space)}, and agents take numbers: {', '.join(_ARRAYS)}, and Dict and Tuple of "
                "these; wrap the environment in one of gymnasium.wrappers, such as FilterObservation"
            )
        self.paths = [path for path, _ in found]
        seen = lambda path, x: path == (jax.tree_util.DictKey(PICTURES),) and _is_box(x)
        self.columns = [Reader(x) if seen(path, x) else Column(x) for path, x in found]
        self.sizes = [math.prod(x.shape) * x.dtype.itemsize for x in self.columns]
        self.shape, self.dtype = (sum(self.sizes),), np.dtype(np.uint8)

    def read_each(self, obs: Sequence[Any]) -> np.ndarray:
        """Return k observations as rows (k, N)."""
        return self._pack([[_at(each, path) for each in obs] for path in self.paths])

    def read_all(self, obs: Any) -> np.ndarray:
        """Return observations, leaves (k, ...), as rows (k, N)."""
        return self._pack([_at(obs, path) for path in self.paths])

    def _pack(self, arrays: Sequence[Any]) -> np.ndarray:
        read = [column.read_all(np.asarray(x)) for column, x in zip(self.columns, arrays, strict=True)]
        return np.concatenate([np.ascontiguousarray(x).reshape(len(x), -1).view(np.uint8) for x in read], axis=1)

    def show(self, rows: Array) -> Any:
        """Return rows (..., N) as agents observe them."""
        ends = itertools.accumulate(self.sizes)
        parts = [rows[..., end - size : end] for size, end in zip(self.sizes, ends, strict=True)]
        return self.tree.unflatten(map(_from_bytes, parts, self.columns))


def _at(obs: Any, path: Any) -> Any:
    return reduce(lambda tree, key: tree[getattr(key, "key", getattr(key, "idx", None))], path, obs)


def _from_bytes(found: Array, like: Any) -> Array:
    """Return bytes (..., n) as arrays (..., *shape) of a type."""
    width = like.dtype.itemsize
    found = found.reshape(*found.shape[:-1], *like.shape, *[width] * (width > 1))
    return found != 0 if like.dtype == bool else jax.lax.bitcast_convert_type(found, like.dtype)


class Actor:
    """Turns actions of agents into those of a space."""

    def __init__(self, name: str, space: Any):
        self.space, kind = space, type(space).__name__
        if kind == "Discrete":
            self.action = Discrete(int(space.n))
        elif kind == "MultiDiscrete":
            self.action = MultiDiscrete(tuple(np.ravel(space.nvec).tolist()))
        elif kind == "MultiBinary":
            self.action = MultiDiscrete((2,) * math.prod(space.shape))
        else:
            _require_bounded(name, space)
            self.action = Continuous(math.prod(space.shape))
            self.middle, self.half = (space.high + space.low) / 2, (space.high - space.low) / 2

    def read(self, action: np.ndarray) -> Any:
        """Return the action that the space has for one of an agent."""
        return self.read_each(np.asarray(action)[None])[0]

    def read_each(self, actions: np.ndarray) -> Any:
        """Return the actions that the space has for those of agents (k, ...), one by one, in its type."""
        given = self.read_all(actions)
        return given.tolist() if isinstance(self.action, Discrete) else given.astype(self.space.dtype)

    def read_all(self, actions: np.ndarray) -> np.ndarray:
        """Return the actions (k, ...) that the space has for those of agents; choices as int32."""
        shaped = actions.reshape(len(actions), *self.space.shape)
        if not isinstance(self.action, Continuous):
            return (shaped + getattr(self.space, "start", 0)).astype(np.int32)
        return (self.middle + np.clip(shaped, -1, 1) * self.half).astype(self.space.dtype)


def _require_bounded(name: str, space: Any) -> None:
    """Refuse a space of actions that is no bounded Box of floats.

    Raises:
        InputError: it is none.
    """
    if not _is_box(space) or not np.issubdtype(space.dtype, np.floating) or not np.prod(space.shape):
        raise InputError(
            f"{name} takes {shown(space)} as actions, and agents give a Discrete, MultiDiscrete or MultiBinary, or a "
            "Box of floats"
        )
    if not np.all(np.isfinite(space.low) & np.isfinite(space.high)):
        raise InputError(
            f"{name} takes actions without bounds, which agents give in [-1, 1]; wrap the environment in "
            "gymnasium.wrappers.RescaleAction, or give its Box a low and a high"
        )
