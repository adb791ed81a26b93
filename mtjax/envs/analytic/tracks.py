"""Closed tracks around the origin, made on the host from a number."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from mtjax.envs.analytic.circle import cos_sin
from mtjax.types import Array

_RADIUS = 13.0  # [m] on average
_WAVES = (2, 3, 4, 5, 6)  # around a track
_TIGHTEST = 3.0  # [m] radius of the tightest bend
_PARTS, _BITS = 10**6, 2**53  # numbers of tracks are told apart to a millionth


class Line(NamedTuple):
    """The centre line of a track at an angle around the origin, to which it turns left."""

    radius: Array  # () [m]
    pace: Array  # () [m/rad] length of the line by angle
    heading: Array  # () [rad]
    curvature: Array  # () [1/m], positive to the left


def make_track(number: float) -> np.ndarray:
    """Return the waves (K, 2) of a number, of cosine and sine: the same ones always, others for every number.

    They are scaled until the tightest bend, to the left or to the right, has its radius.
    """
    bits = np.random.PCG64([int(number < 0), abs(round(float(number) * _PARTS))])
    draw = lambda: (int(bits.random_raw()) >> 11) / _BITS  # NumPy promises these bits for good
    sizes, turns = zip(*((0.2 + draw(), 2 * math.pi * draw()) for _ in _WAVES), strict=True)
    size, turn = np.array(sizes) / np.array(_WAVES), np.array(turns)
    waves = np.stack([size * np.cos(turn), size * np.sin(turn)], axis=1)
    low, high = 0.0, 0.9 / float(np.sum(size))  # the radius stays above 0
    angles = np.linspace(0, 2 * math.pi, 2000, endpoint=False)
    for _ in range(40):
        middle = (low + high) / 2
        tight = np.max(np.abs(_line(middle * waves, angles, np).curvature)) > 1 / _TIGHTEST
        low, high = (low, middle) if tight else (middle, high)
    return low * waves


def line_at(waves: Array, angle: Array) -> Line:
    """Return the centre line of a track with these waves (K, 2) at an angle ()."""
    return _line(waves, angle, jnp)


def _line(waves: Any, angle: Any, xp: Any) -> Line:
    """Return the line, by the radius and its first two derivatives. ``xp`` is NumPy or JAX, as the waves are."""
    radius, slope, bend = xp.ones_like(angle), 0.0, 0.0
    first = (np.cos(angle), np.sin(angle)) if xp is np else cos_sin(angle)
    cos, sin = first
    for k in range(2, _WAVES[-1] + 1):
        cos, sin = cos * first[0] - sin * first[1], sin * first[0] + cos * first[1]
        along, across = (waves[k - 2, 0] * cos + waves[k - 2, 1] * sin, waves[k - 2, 1] * cos - waves[k - 2, 0] * sin)
        radius, slope, bend = radius + along, slope + k * across, bend - k * k * along
    square = radius * radius + slope * slope
    root = xp.sqrt(square)
    heading = angle + xp.arctan2(radius, slope)
    curvature = (square + slope * slope - radius * bend) / (square * root) / _RADIUS
    return Line(_RADIUS * radius, _RADIUS * root, heading, curvature)


def outline(waves: np.ndarray, offset: float, count: int) -> np.ndarray:
    """Return ``count`` places (count, 2) along a line that runs ``offset`` metres to the left of a track's."""
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    line = _line(waves, angles, np)
    turn = lambda angle: np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(line.radius)[:, None] * turn(angles) + offset * turn(line.heading + math.pi / 2)


def length(waves: np.ndarray) -> float:
    """Return the length [m] of the centre line."""
    return float(2 * math.pi * np.mean(_line(waves, np.linspace(0, 2 * math.pi, 4000, endpoint=False), np).pace))
