"""Spaces of Gymnasium, as agents observe and act."""

from typing import Any

import numpy as np

from mtjax.checks import shown
from mtjax.types import Continuous, Discrete, InputError

_LEAST_PICTURE = 16
"""Pixels a side of the smallest picture. Smaller arrays of bytes, such as those of grid worlds, are vectors."""
_MOST_CHANNELS = 4
_FIXES = "wrap the environment in one of gymnasium.wrappers, such as FlattenObservation"


class Reader:
    """Turns observations of a space into a vector (O,) float32, or a picture (H, W, C) uint8."""

    def __init__(self, name: str, space: Any):
        kind, shape = type(space).__name__, space.shape
        if kind != "Box" or not np.issubdtype(space.dtype, np.number) or not np.prod(shape):
            raise InputError(f"{name} observes {shown(space)}, and agents take a Box: a vector or a picture; {_FIXES}")
        self.name, self.given, self.axes, self.shape = name, shape, None, (int(np.prod(shape)),)
        if space.dtype == np.uint8 and len(shape) in (2, 3):
            self._see(shape if len(shape) == 3 else (*shape, 1))
        self.dtype = np.float32 if len(self.shape) == 1 else np.uint8

    def _see(self, shape: tuple[int, ...]) -> None:
        """Note where the channels of a picture are. Arrays that are none stay vectors."""
        for axes in ((0, 1, 2), (1, 2, 0)):
            high, wide, channels = (shape[i] for i in axes)
            if self.axes is None and channels <= _MOST_CHANNELS and min(high, wide) >= _LEAST_PICTURE:
                self.axes, self.shape = axes, (high, wide, channels)

    def read(self, obs: Any) -> np.ndarray:
        """Return an observation as agents take it."""
        return self.read_all(np.asarray(obs)[None])[0]

    def read_all(self, obs: np.ndarray) -> np.ndarray:
        """Return observations (k, ...) as agents take them."""
        if obs.shape[1:] != self.given:
            raise ValueError(f"an observation has the shape {obs.shape[1:]}, and its space {self.given}")
        if self.axes is None:
            return obs.astype(np.float32).reshape(len(obs), *self.shape)
        pictures = obs if obs.ndim == 4 else obs[..., None]
        return pictures.transpose(0, *(1 + axis for axis in self.axes))


class Actor:
    """Turns actions of agents into those of a space."""

    def __init__(self, name: str, space: Any):
        kind, self.space = type(space).__name__, space
        self.discrete = kind == "Discrete"
        if self.discrete:
            self.action, self.start = Discrete(int(space.n)), int(space.start)
            return
        if kind != "Box" or not np.issubdtype(space.dtype, np.floating) or not np.prod(space.shape):
            raise InputError(f"{name} takes {shown(space)} as actions, and agents give one of n, or a Box of floats")
        if not np.all(np.isfinite(space.low) & np.isfinite(space.high)):
            raise InputError(
                f"{name} takes actions without bounds, which agents give in [-1, 1]; wrap the environment in "
                "gymnasium.wrappers.RescaleAction, or give its Box a low and a high"
            )
        self.action = Continuous(int(np.prod(space.shape)))
        self.middle, self.half = (space.high + space.low) / 2, (space.high - space.low) / 2

    def read(self, action: np.ndarray) -> Any:
        """Return the action that the space has for one of an agent, (A,) in [-1, 1] or ()."""
        return self.start + int(action) if self.discrete else self.read_all(np.asarray(action)[None])[0]

    def read_all(self, actions: np.ndarray) -> np.ndarray:
        """Return the actions (k, ...) that the space has for those of agents."""
        if self.discrete:
            return self.start + actions
        scaled = self.middle + np.clip(actions, -1, 1).reshape(len(actions), *self.space.shape) * self.half
        return scaled.astype(self.space.dtype)
