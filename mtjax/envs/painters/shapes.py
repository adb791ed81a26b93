"""Where rays from a camera meet the shapes of geoms. All vectors are in the camera's frame, whose origin is the eye.

Rays are (u, v, -1) and not of unit length, so that they are the same for all cameras and worlds. Quotients and roots
are few, because XLA writes each one that is used twice to memory.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.painters.poses import Axes, Vector
from mtjax.types import Array

MISSED = 1e9
_TINY = 1e-9


class Rays(NamedTuple):
    """Directions of the rays of all pixels."""

    u: np.ndarray  # (P,)
    v: np.ndarray  # (P,)
    square: np.ndarray  # (P,) squared length


class Body(NamedTuple):
    """A geom in the camera's frame, or the geoms of all pixels (P,)."""

    centre: Vector
    axes: Axes
    size: Vector
    endless: tuple[bool, ...] = ()  # whether a plane has no edges along x and y


class Shape(NamedTuple):
    """How rays meet one kind of geom."""

    distance: Callable[[Rays, Body], Array]  # (P,) in ray lengths; ``MISSED`` where they do not
    normal: Callable[[Vector, Body], Vector]  # unit normals at points (P,) of the surface


def along(rays: Rays, vector: Vector) -> Any:
    """Return the dot product (P,) of rays and a vector."""
    return rays.u * vector[0] + rays.v * vector[1] - vector[2]


def at(rays: Rays, distance: Array) -> Vector:
    """Return the points (P,) at distances (P,)."""
    return distance * rays.u, distance * rays.v, -distance


def dot(one: Vector, other: Vector) -> Any:
    """Return the dot product of two vectors."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _minus(one: Vector, other: Vector) -> Vector:
    return one[0] - other[0], one[1] - other[1], one[2] - other[2]


def _root(square: Array) -> Array:
    return jnp.sqrt(jnp.maximum(square, 0.0))


def apart_from_zero(x: Array) -> Array:
    """Replace numbers near 0 by a tiny one, so that one can divide by them."""
    return jnp.where(jnp.abs(x) > _TINY, x, _TINY)


def _where(hit: Any, distance: Any) -> Array:
    return jnp.where(hit & (distance > 0), distance, MISSED)


def _plane_distance(rays: Rays, body: Body) -> Array:
    """Planes are rectangles that are seen from above only."""
    slope, depth = along(rays, body.axes[2]), dot(body.centre, body.axes[2])
    inside = slope < 0
    for i in (0, 1):
        if not body.endless[i]:
            # The place on the plane times the slope, so that nothing is divided here.
            across = depth * along(rays, body.axes[i]) - dot(body.centre, body.axes[i]) * slope
            inside &= jnp.abs(across) <= -slope * body.size[i]
    return _where(inside, depth / jnp.minimum(slope, -_TINY))


def _plane_normal(point: Vector, body: Body) -> Vector:
    return body.axes[2]


def _sphere_distance(rays: Rays, body: Body) -> Array:
    forward, radius = along(rays, body.centre), body.size[0]
    room = forward * forward - rays.square * (dot(body.centre, body.centre) - radius * radius)
    return _where(room > 0, (forward - _root(room)) * (1 / rays.square))


def _sphere_normal(point: Vector, body: Body) -> Vector:
    return tuple((p - c) * (1 / body.size[0]) for p, c in zip(point, body.centre, strict=True))


def _tube(rays: Rays, body: Body) -> tuple[Array, ...]:
    """Return how rays meet an endless tube: aim, room and across, of which (aim - root(room)) / across is the distance;
    and the heights of the eye and of a ray's unit along the axis."""
    axis, radius = body.axes[2], body.size[0]
    tall, deep = dot(body.centre, axis), dot(body.centre, body.centre)
    lift = along(rays, axis)
    across = jnp.maximum(rays.square - lift * lift, _TINY)
    aim = along(rays, body.centre) - lift * tall
    return aim, aim * aim - across * (deep - tall * tall - radius * radius), across, tall, lift


def _capsule_distance(rays: Rays, body: Body) -> Array:
    """A ray meets the side of the tube, or else the half sphere at the end where it passes the tube."""
    radius, half = body.size[0], body.size[1]
    aim, room, across, tall, lift = _tube(rays, body)
    way = aim - _root(room)
    height, limit = way * lift - tall * across, half * across  # both times ``across``
    beside = jnp.abs(height) <= limit
    end = jnp.where(height > 0, half, -half)
    aim_end = along(rays, body.centre) + end * lift
    deep = dot(body.centre, body.centre) + end * (2 * tall + end) - radius * radius
    room_end = aim_end * aim_end - rays.square * deep
    way = jnp.where(beside, way, aim_end - _root(room_end))
    hit = (room > 0) & (beside | (room_end > 0))
    return _where(hit, way / jnp.where(beside, across, rays.square))


def _capsule_normal(point: Vector, body: Body) -> Vector:
    axis, away = body.axes[2], _minus(point, body.centre)
    height = jnp.clip(dot(away, axis), -body.size[1], body.size[1])
    return tuple((x - height * a) * (1 / body.size[0]) for x, a in zip(away, axis, strict=True))


def _cylinder_distance(rays: Rays, body: Body) -> Array:
    """A ray meets the lid on the eye's side, or else the side of the tube."""
    radius, half = body.size[0], body.size[1]
    aim, room, across, tall, lift = _tube(rays, body)
    way = aim - _root(room)
    beside = jnp.abs(way * lift - tall * across) <= half * across
    rise = jnp.where(tall < 0, half, -half) + tall  # from the eye to the lid
    wide = dot(body.centre, body.centre) - tall * tall - radius * radius
    # Where the ray passes the lid's height, its distance from the axis times the square of ``lift``.
    outside = across * rise * rise - 2 * aim * rise * lift + wide * lift * lift
    above = (jnp.abs(tall) > half) & (outside <= 0)
    hit = above | (beside & (room > 0))
    return _where(hit, jnp.where(above, rise, way) / jnp.where(above, apart_from_zero(lift), across))


def _cylinder_normal(point: Vector, body: Body) -> Vector:
    radius, half, axis, away = body.size[0], body.size[1], body.axes[2], _minus(point, body.centre)
    height = dot(away, axis)
    wide = dot(away, away) - height * height
    # The lid is where the point is nearer to its height than to the side.
    lid = radius * radius - wide > 2 * radius * (half - jnp.abs(height))
    up = jnp.where(height > 0, 1.0, -1.0)
    side = ((x - height * a) * (1 / radius) for x, a in zip(away, axis, strict=True))
    return tuple(jnp.where(lid, up * a, s) for s, a in zip(side, axis, strict=True))


def _ellipsoid_distance(rays: Rays, body: Body) -> Array:
    """A sphere of radius 1 in a frame that is scaled by the three radii."""
    ray = tuple(along(rays, axis) * (1 / body.size[i]) for i, axis in enumerate(body.axes))
    eye = tuple(dot(body.centre, axis) / body.size[i] for i, axis in enumerate(body.axes))
    square, forward = dot(ray, ray), dot(ray, eye)
    room = forward * forward - square * (dot(eye, eye) - 1)
    return _where(room > 0, (forward - _root(room)) / square)


def _ellipsoid_normal(point: Vector, body: Body) -> Vector:
    away = _minus(point, body.centre)
    slope = [dot(away, axis) / (body.size[i] * body.size[i]) for i, axis in enumerate(body.axes)]
    scale = 1 / jnp.sqrt(jnp.maximum(sum(x * x for x in slope), _TINY))
    return _out_of(body.axes, [x * scale for x in slope])


def _box_distance(rays: Rays, body: Body) -> Array:
    """A ray passes three faces on the eye's side. It meets the last one, if it has not passed a far face before."""
    near, far = -MISSED, MISSED
    for i, axis in enumerate(body.axes):
        inverse = 1 / apart_from_zero(along(rays, axis))
        middle, reach = dot(body.centre, axis) * inverse, jnp.abs(inverse) * body.size[i]
        near, far = jnp.maximum(near, middle - reach), jnp.minimum(far, middle + reach)
    return _where(near <= far, near)


def _box_normal(point: Vector, body: Body) -> Vector:
    """The face is that whose distance from the middle is largest, in its own half lengths."""
    away = _minus(point, body.centre)
    local = [dot(away, axis) * (1 / body.size[i]) for i, axis in enumerate(body.axes)]
    farthest = jnp.maximum(jnp.maximum(jnp.abs(local[0]), jnp.abs(local[1])), jnp.abs(local[2]))
    return _out_of(body.axes, [jnp.where(jnp.abs(x) == farthest, jnp.where(x > 0, 1.0, -1.0), 0.0) for x in local])


def _out_of(axes: Axes, vector) -> Vector:
    """Return a vector of a geom's frame in the camera's frame."""
    return tuple(sum(axis[i] * x for axis, x in zip(axes, vector, strict=True)) for i in range(3))


_GEOM = mujoco.mjtGeom
SHAPES: dict[int, Shape] = {
    int(_GEOM.mjGEOM_PLANE): Shape(_plane_distance, _plane_normal),
    int(_GEOM.mjGEOM_SPHERE): Shape(_sphere_distance, _sphere_normal),
    int(_GEOM.mjGEOM_CAPSULE): Shape(_capsule_distance, _capsule_normal),
    int(_GEOM.mjGEOM_ELLIPSOID): Shape(_ellipsoid_distance, _ellipsoid_normal),
    int(_GEOM.mjGEOM_CYLINDER): Shape(_cylinder_distance, _cylinder_normal),
    int(_GEOM.mjGEOM_BOX): Shape(_box_distance, _box_normal),
}
