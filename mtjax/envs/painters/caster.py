"""A small ray caster in plain JAX, for CPUs and all devices without a painter of their own.

It casts one ray through the middle of each pixel, and lights the nearest geom as MuJoCo does: the headlight, the
scene's lights with their cones, highlights, a checkered floor and the sky. There are no shadows and no mirrors.
Everything is in the camera's frame, so that rays are constants. Arrays are (P,), one number for each pixel. The loop
over geoms is a scan for each shape, so that the time to compile does not depend on their number.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.painters.batch import flat_batch, in_chunks
from mtjax.envs.painters.poses import Pose, Poses, Vector
from mtjax.envs.painters.scene import SKY, Scene, Tiles
from mtjax.envs.painters.shapes import MISSED, SHAPES, Body, Rays, Shape, along, at, dot
from mtjax.types import Array, InputError

_CHUNK = 16  # pictures that a CPU draws at once: their arrays fit into its caches
_MOST = 63  # geoms, whose numbers have to fit into the last bits of a distance
_ROUND = tuple(int(getattr(mujoco.mjtGeom, f"mjGEOM_{x}")) for x in ("SPHERE", "CAPSULE", "CYLINDER"))
_PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
_HALF = 0.51  # of a pixel, and a bit
_SHINE = 6  # highlights are the 2^6th power of a cosine: MuJoCo's shininess of 0.5


class View(NamedTuple):
    """What a picture shows, in the camera's frame."""

    bodies: Body  # with numbers (G,), one for each geom that is seen
    colours: Array  # (G, 3)
    lights: tuple[tuple[Vector, Vector], ...]  # position and direction of each
    strength: Array  # (lights, 3)
    up: Vector  # the world's z axis
    sky: Array  # (degree + 1, 3) polynomials of the sine of the elevation, for the colours of the sky
    grid: Any = ()  # walls that are no bodies


class Group(NamedTuple):
    """Geoms of one shape that are computed alike."""

    shape: Shape
    places: np.ndarray  # which of the geoms that are seen
    endless: tuple[bool, bool]  # of planes: whether they have no edges along x and y
    tiles: Tiles | None  # of checkered planes


@dataclasses.dataclass(frozen=True, eq=False)
class Caster:
    """Draws the scene of a family by casting rays.

    Raises:
        InputError: the scene has a shape that the caster does not know.
    """

    scene: Scene
    size: int

    def __post_init__(self):
        kinds = [int(self.scene.model.geom_type[geom]) for geom in self.shown]
        odd = next((kind for kind in kinds if kind not in SHAPES), None)
        if odd is not None:
            shape = mujoco.mjtGeom(odd).name.removeprefix("mjGEOM_").lower()
            raise InputError(f"painter 'caster' knows no {shape}; use --env.painter=warp on an NVIDIA GPU")
        if len(kinds) > _MOST:
            raise InputError(
                f"painter 'caster' draws at most {_MOST} geoms, and this scene has {len(kinds)}; "
                "use --env.painter=auto in a maze, elsewhere --env.painter=warp on an NVIDIA GPU"
            )

    def paint(self, leaf: Callable[[str], Array], poses: Poses) -> Array:
        """Return the picture (H, W, 3) uint8 of one world.

        Args:
            leaf: a field of the task's scene, by its name.
            poses: of the world's geoms, camera and lights.
        """
        packed = self._draw(jax.tree.map(jnp.float32, self._view(leaf, poses)))
        picture = packed.reshape(self.size, self.size)
        return jnp.stack([(picture >> shift).astype(jnp.uint8) for shift in (0, 8, 16)], axis=-1)

    @cached_property
    def shown(self) -> tuple[int, ...]:
        """Return the geoms that are drawn."""
        return self.scene.shown

    @cached_property
    def _draw(self) -> Callable:
        """Return the function that draws all worlds, first what is nearest in each pixel and then its colour.

        Between the two, XLA would repeat the former for every use of its result in the latter.
        """

        def draw(views: View) -> Array:
            chunk = _CHUNK if jax.default_backend() == "cpu" else 0
            nearest = in_chunks(self._nearest, chunk, views)
            return in_chunks(lambda both: self._colour(*both), chunk, (views, nearest))

        return flat_batch(draw)

    @cached_property
    def _groups(self) -> tuple[Group, ...]:
        model, scene, found = self.scene.model, self.scene, {}
        for place, geom in enumerate(self.shown):
            kind = int(model.geom_type[geom])
            endless = (bool(model.geom_size[geom, 0] <= 0), bool(model.geom_size[geom, 1] <= 0))
            alone = geom if geom in scene.tiles else -1
            found.setdefault((kind, endless if kind == _PLANE else (), alone), []).append(place)
        return tuple(
            Group(SHAPES[kind], np.array(places), endless, scene.tiles.get(alone))
            for (kind, endless, alone), places in found.items()
        )

    def _view(self, leaf: Callable[[str], Array], poses: Poses) -> View:
        eye, shown, model = poses.camera, np.array(self.shown), self.scene.model
        chosen = jax.tree.map(lambda x: x[shown], poses.geoms)
        geoms, sizes = _seen_from(eye, chosen), leaf("geom_size")[shown].T
        round_ones = np.isin(model.geom_type[shown], _ROUND)
        least = jnp.where(round_ones, _HALF * self._pixel * -geoms.position[2], 0.0)  # a pixel wide: no ray misses it
        size = (jnp.maximum(sizes[0], least), sizes[1], sizes[2])
        lights = []
        for position, direction in poses.lights:
            place = _seen_from(eye, Pose(position, (direction,) * 3))
            lights.append((place.position, place.axes[2]))
        up: Any = tuple(axis[2] for axis in eye.axes)
        bodies = Body(geoms.position, geoms.axes, size)
        return View(bodies, leaf("geom_rgba")[shown, :3], tuple(lights), leaf("light_diffuse"), up, leaf(SKY))

    @property
    def _pixel(self) -> float:
        """Return the width of a pixel at a distance of 1."""
        return 2 * math.tan(math.radians(float(self.scene.model.cam_fovy[0])) / 2) / self.size

    @cached_property
    def _rays(self) -> Rays:
        line = (np.arange(self.size) + 0.5 - self.size / 2) * self._pixel
        u, v = (x.ravel().astype(np.float32) for x in np.meshgrid(line, -line))
        return Rays(u, v, u * u + v * v + 1)

    def _nearest(self, view: View) -> Array:
        """Return the distance (P,) of the nearest geom as an integer whose last bits are the geom's number.

        Positive floating-point numbers are in the order of their bits.
        """
        sky = jnp.full(self._rays.u.shape, MISSED / 2, jnp.float32)  # nearer than geoms that a ray misses
        nearest = tag(sky, _MOST)
        for group in self._groups:

            def nearer(nearest: Array, geom: tuple[Body, Array], group: Group = group) -> tuple[Array, None]:
                distance = group.shape.distance(self._rays, geom[0]._replace(endless=group.endless))
                return jnp.minimum(nearest, tag(distance, geom[1])), None

            bodies = jax.tree.map(lambda x, group=group: x[group.places], view.bodies)
            nearest, _ = jax.lax.scan(nearer, nearest, (bodies, jnp.int32(group.places)))
        return nearest

    def _colour(self, view: View, nearest: Array) -> Array:
        """Return the colours (P,) of pixels, packed as one number so that one kernel computes all channels."""
        number = nearest & _MOST
        distance = jax.lax.bitcast_convert_type(nearest & ~_MOST, jnp.float32)
        point, normal, colour, gloss = at(self._rays, distance), (0.0, 0.0, 1.0), self._sky(view), 0.0
        for group in self._groups:
            body, rgb, shine = self._chosen(view, group, number)
            here = functools.reduce(jnp.logical_or, [number == place for place in group.places])
            normal = _pick(here, group.shape.normal(point, body), normal)
            colour = _pick(here, self._paint(rgb, group, body, distance), colour)
            gloss = jnp.where(here, shine, gloss)
        shaded = self._light(view, point, normal, colour, gloss, number != _MOST)
        red, green, blue = (jnp.uint32(jnp.clip(c, 0.0, 1.0) * 255 + 0.5) for c in shaded)
        return red | (green << 8) | (blue << 16)

    def _chosen(self, view: View, group: Group, number: Array) -> tuple[Body, Vector, Array]:
        """Return body, colour and gloss of the geom in each pixel, if it is of this group."""
        gloss = jnp.float32(self.scene.gloss[list(self.shown)])
        numbers = (view.bodies, tuple(view.colours.T), gloss)
        first, *rest = group.places
        chosen = jax.tree.map(lambda x: x[first], numbers)
        for place in rest:
            here = number == place
            chosen = jax.tree.map(
                lambda x, old, here=here, place=place: jnp.where(here, x[place], old), numbers, chosen
            )
        return chosen

    def _sky(self, view: View) -> Vector:
        """Return the colour of the sky."""
        height = along(self._rays, view.up) * (1 / np.sqrt(self._rays.square))
        colour = [jnp.float32(0)] * 3
        for i in range(len(view.sky)):
            colour = [colour[c] * height + view.sky[i, c] for c in range(3)]
        return tuple(colour)

    def _paint(self, rgb: Vector, group: Group, body: Body, distance: Array) -> Vector:
        """Return the colour of geoms where rays meet them; planes may be checkered."""
        if group.tiles is None:
            return rgb
        blend, (one, other) = self._checker(group.tiles, body, distance), group.tiles.colours
        return tuple(rgb[i] * (one[i] + blend * (other[i] - one[i])) for i in range(3))

    def _checker(self, tiles: Tiles, body: Body, distance: Array) -> Array:
        """Return 0 on tiles of one colour and 1 on those of the other, and between them across edges."""
        waves = []
        slope = jnp.maximum(-along(self._rays, body.axes[2]), 1e-3)
        pixel = self._pixel * distance
        for i in (0, 1):
            across = distance * along(self._rays, body.axes[i]) - dot(body.centre, body.axes[i])
            begun = body.size[i] if tiles.from_edge[i] else 0.0
            phase = tiles.repeat[i] * (begun - across if i else begun + across) + 0.25
            blur = tiles.repeat[i] * pixel * (1 + jnp.abs(body.axes[i][2]) / slope)  # of one pixel
            wave = jnp.abs(phase - jnp.floor(phase) - 0.5) - 0.25  # crosses 0 at edges of tiles
            waves.append(jnp.clip(wave * 2 / jnp.maximum(blur, 1e-6), -1.0, 1.0) / jnp.maximum(2 * blur, 1.0))
        return 0.5 - 0.5 * waves[0] * waves[1]

    def _light(self, view: View, point: Vector, normal: Vector, colour: Vector, gloss, solid: Array) -> Vector:
        """Return the colours of pixels in the light of the headlight and of the scene's lights. The sky is not lit."""
        model, rays = self.scene.model, self._rays
        short = 1 / np.sqrt(rays.square)
        eye = (-rays.u * short, -rays.v * short, short)
        head = model.vis.headlight
        facing = jnp.maximum(normal[2], 0.0)
        shine = _shine(normal, _unit_half(eye), facing)
        diffuse = [jnp.where(solid, head.ambient[i] + head.diffuse[i] * facing, 1.0) for i in range(3)]
        bright = [head.specular[i] * shine for i in range(3)]
        for i, (position, direction) in enumerate(view.lights):
            if model.light_type[i] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL:
                to_light, reach = tuple(-x for x in direction), 1.0
            else:
                away = tuple(q - p for p, q in zip(point, position, strict=True))
                short = 1 / jnp.sqrt(dot(away, away))
                to_light = tuple(short * x for x in away)
                reach = _cone(model, i, -dot(to_light, direction))
            facing = jnp.maximum(dot(normal, to_light), 0.0) * reach
            half = tuple(a + b for a, b in zip(to_light, eye, strict=True))
            shine = _shine(normal, half, facing) * reach
            for c in range(3):
                diffuse[c] += jnp.where(solid, model.light_ambient[i][c] + view.strength[i, c] * facing, 0.0)
                bright[c] += model.light_specular[i][c] * shine
        return tuple(c * d + gloss * b for c, d, b in zip(colour, diffuse, bright, strict=True))


def tag(distance: Array, number: Any) -> Array:
    """Return a distance as an integer with a geom's number in the last bits."""
    return (jax.lax.bitcast_convert_type(distance, jnp.int32) & ~_MOST) | number


def _pick(mask: Array, one: Vector, other: Vector) -> Vector:
    return tuple(jnp.where(mask, a, b) for a, b in zip(one, other, strict=True))


def _unit_half(eye: Vector) -> Vector:
    """Return the direction half way between the eye and the headlight, which is in the eye."""
    scale = 1 / np.sqrt(eye[0] ** 2 + eye[1] ** 2 + (eye[2] + 1) ** 2)
    return eye[0] * scale, eye[1] * scale, (eye[2] + 1) * scale


def _shine(normal: Vector, half: Vector, facing: Array) -> Array:
    """Return the highlight (P,) in [0, 1] of a surface where it faces the light."""
    cosine = jnp.maximum(dot(normal, half), 0.0)
    square = cosine * cosine / dot(half, half)
    for _ in range(_SHINE - 1):
        square = square * square
    return jnp.where(facing > 0, square, 0.0)


def _cone(model: mujoco.MjModel, light: int, cosine: Array) -> Array:
    """Return how much of a light reaches a direction whose angle to the light's own has this cosine."""
    if model.light_type[light] != mujoco.mjtLightType.mjLIGHT_SPOT:
        return jnp.float32(1)
    edge = math.cos(math.radians(float(model.light_cutoff[light])))
    return jnp.where(cosine > edge, jnp.maximum(cosine, edge) ** float(model.light_exponent[light]), 0.0)


def _seen_from(eye: Pose, thing: Pose) -> Pose:
    """Return a pose in the camera's frame."""
    inside = lambda vector: tuple(dot(axis, vector) for axis in eye.axes)
    apart = tuple(a - b for a, b in zip(thing.position, eye.position, strict=True))
    return Pose(inside(apart), tuple(inside(axis) for axis in thing.axes))
