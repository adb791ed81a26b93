"""Charts of bars and balls, by which families that have no place in space are seen. A height of 1 is the tallest."""

import jax.numpy as jnp
import mujoco

from mtjax.envs.looks import Look
from mtjax.envs.pixels import Mark
from mtjax.types import Array

LOOK = Look(camera=(0.0, -2.4, 0.75), tilt=86.0, light=(0.0, -2.0, 4.0), diffuse=0.6, sun=True)
BLUE, RED, GREEN, GREY = (0.2, 0.4, 0.9, 1.0), (0.9, 0.25, 0.2, 1.0), (0.2, 0.7, 0.3, 1.0), (0.5, 0.5, 0.5, 1.0)
_DEEP, _RADIUS, _FLAT = 0.08, 0.05, 0.002
_GEOM = mujoco.mjtGeom


def chart() -> mujoco.MjSpec:
    """Return a scene of a floor alone."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[3, 3, 0.1])
    return spec


def add_bar(spec: mujoco.MjSpec, name: str, x: float, half_width: float, rgba: tuple, behind: float = 0.0) -> None:
    """Add a bar that stands on the floor around ``x``."""
    size = [half_width, _DEEP, _FLAT]
    spec.worldbody.add_geom(name=name, type=_GEOM.mjGEOM_BOX, pos=[x, behind, _FLAT], size=size, rgba=rgba)


def add_ball(spec: mujoco.MjSpec, name: str, rgba: tuple) -> None:
    """Add a ball."""
    spec.worldbody.add_geom(name=name, type=_GEOM.mjGEOM_SPHERE, size=[_RADIUS, 0, 0], rgba=rgba)


def bar(x: float, height: Array, half_width: float, behind: float = 0.0) -> Mark:
    """Return a bar of that height (), at least a thin line."""
    half = jnp.maximum(height / 2, _FLAT)
    return Mark(jnp.stack([jnp.float32(x), jnp.float32(behind), half]), jnp.stack([half_width, _DEEP, half]))


def ball(x: Array, height: Array) -> Mark:
    """Return a ball at a height () over ``x`` (), before the bars."""
    return Mark(jnp.stack([jnp.float32(x), jnp.float32(-2 * _DEEP), jnp.float32(height)]))
