"""The ray caster for mazes on a grid, whose walls are not tested one by one.

The eye is level, so that all pixels of a column look along one line of the plan. Each column meets the lines of the
grid, and a table says where on a line there is a wall. So the cost hardly depends on how many walls there are.
"""

import dataclasses
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.painters.caster import Caster, Group, View, tag
from mtjax.envs.painters.poses import Poses, Vector
from mtjax.envs.painters.shapes import MISSED, Body, Rays, Shape, apart_from_zero, dot
from mtjax.types import Array

_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


class Grid(NamedTuple):
    """The walls of a maze on squares of 1 m, and where the eye is in the plan."""

    walls: Array  # (2, N + 1, N) 1 for a wall: [0, i, j] is on the line x = i, [1, j, i] on y = j, both beside (i, j)
    place: Vector  # [m] x and y of the eye
    ahead: Vector  # x and y of the direction of the middle column
    aside: Vector  # x and y of the direction to the right
    room: Array  # [m] from the eye's height up to that of the walls


@dataclasses.dataclass(frozen=True, eq=False)
class GridCaster(Caster):
    """Draws the scene of a maze. All its boxes are thin walls of one height.

    It draws walls without thickness, where the field "walls" of a task's scene says. The scene's first box is the wall
    along x = 0, and the eye is lower than the walls.
    """

    @cached_property
    def shown(self) -> tuple[int, ...]:
        """Return the geoms that are drawn: the first wall stands for all."""
        kinds, shown = self.scene.model.geom_type, self.scene.shown
        wall = next(geom for geom in shown if kinds[geom] == _BOX)
        return tuple(geom for geom in shown if kinds[geom] != _BOX or geom == wall)

    @cached_property
    def _wall(self) -> int:
        """Return the number of the wall among the geoms that are drawn."""
        return next(i for i, geom in enumerate(self.shown) if self.scene.model.geom_type[geom] == _BOX)

    @cached_property
    def _groups(self) -> tuple[Group, ...]:
        wall = Shape(_nowhere, self._normal)
        return tuple(g._replace(shape=wall) if self._wall in g.places else g for g in super()._groups)

    def _view(self, leaf, poses: Poses) -> View:
        model, wall, eye = self.scene.model, self.shown[self._wall], poses.camera
        top = model.geom_pos[wall, 2] + model.geom_size[wall, 2]
        right, _, back = eye.axes
        ahead = (-back[0], -back[1])
        grid = Grid(leaf("walls"), eye.position[:2], ahead, right[:2], top - eye.position[2])
        return super()._view(leaf, poses)._replace(grid=grid)

    def _nearest(self, view: View) -> Array:
        """Return the distance (P,) of the nearest geom or wall as an integer with its number in the last bits."""
        far = jnp.tile(self._to_walls(view.grid), self.size)
        far = jnp.where(self._rays.v * far < view.grid.room, far, MISSED)
        return jnp.minimum(super()._nearest(view), tag(far, self._wall))

    def _to_walls(self, grid: Grid) -> Array:
        """Return the distance (W,) in ray lengths of the nearest wall of each column."""
        u, cells = self._rays.u[: self.size], grid.walls.shape[2]
        nearest = jnp.full(self.size, MISSED, jnp.float32)
        for axis in (0, 1):
            across, along = (grid.ahead[i] + u * grid.aside[i] for i in (axis, 1 - axis))
            distance = (np.arange(cells + 1.0)[:, None] - grid.place[axis]) / apart_from_zero(across)  # (N + 1, W)
            cell = jnp.clip(jnp.floor(grid.place[1 - axis] + distance * along), 0, cells - 1).astype(jnp.int32)
            wall = jnp.take_along_axis(grid.walls[axis], cell, axis=1) > 0
            nearest = jnp.minimum(nearest, jnp.min(jnp.where(wall & (distance > 0), distance, MISSED), axis=0))
        return nearest

    def _normal(self, point: Vector, body: Body) -> Vector:
        """Return the unit normals at points (P,) of walls: a point is on the line of the grid that it is nearest to."""
        first = self.scene.model.geom_pos[self.shown[self._wall]]
        gaps, normals = [], []
        for i in (0, 1):
            x = dot(tuple(p - c for p, c in zip(point, body.centre, strict=True)), body.axes[i]) + first[i]
            gaps.append(jnp.abs(x - jnp.round(x)))
            facing = jnp.where(dot(point, body.axes[i]) > 0, -1.0, 1.0)
            normals.append(tuple(facing * a for a in body.axes[i]))
        return tuple(jnp.where(gaps[0] < gaps[1], a, b) for a, b in zip(*normals, strict=True))


def _nowhere(rays: Rays, body: Body) -> Array:
    return jnp.full(rays.u.shape, MISSED, jnp.float32)
