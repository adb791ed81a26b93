"""What draws the worlds of a family: a scene that all tasks share, what differs in it, and a painter."""

import dataclasses
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.painters.base import Painter
from mtjax.envs.painters.poses import Pose, Poses, locate
from mtjax.envs.painters.scene import Scene
from mtjax.types import Array, Task

GREY = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the brightness of grey pictures."""


class Mark(NamedTuple):
    """A geom of the scene whose place an episode decides, such as a target. A light of its name stays above it."""

    position: Array  # (3,) [m]
    size: Array | None = None  # (3,) None: the model's
    along: Array | None = None  # (3,) direction of its z axis, of unit length; None: as the model has it


class Visible(NamedTuple):
    """What a picture shows of one world, in the scene of its family."""

    joints: Any  # (nq,) positions of the scene's joints
    marks: Mapping[str, Mark] = {}  # by the names of their geoms
    eye: Pose | None = None  # where the camera is, if the world decides that; None: where the scene has it
    fields: Mapping[str, Array] = {}  # of the scene that the task decides, by their names in MuJoCo


@dataclasses.dataclass(frozen=True, eq=False)
class Scenery:
    """Draws the worlds of one family."""

    scene: Scene  # what no task changes
    leaves: Mapping[str, np.ndarray]  # (R, ...) the fields that differ between the rows of the family's table
    painter: Painter
    grey: bool  # whether pictures have brightness alone

    def field(self, task: Task, visible: Visible, name: str) -> Array:
        """Return a field of the scene of one world, by its name in MuJoCo or as the world tells it."""
        own = {**(task.scene or {}), **visible.fields}
        return own[name] if name in own else jnp.asarray(self.scene.field(name))

    def poses(self, task: Task, visible: Visible) -> Poses:
        """Return the poses of all that a picture of the world shows."""
        poses = locate(self.scene.model, partial(self.field, task, visible), visible.joints)
        geoms, lights = poses.geoms, dict(enumerate(poses.lights))
        for name, mark in visible.marks.items():
            i = self.scene.model.geom(name).id
            put = lambda numbers, number, i=i: numbers.at[i].set(number)
            axes = geoms.axes if mark.along is None else jax.tree.map(put, geoms.axes, _frame(mark.along))
            geoms = Pose(jax.tree.map(put, geoms.position, tuple(mark.position)), axes)
            lamp = mujoco.mj_name2id(self.scene.model, mujoco.mjtObj.mjOBJ_LIGHT, name)
            if lamp >= 0:
                (_, _, height), direction = lights[lamp]
                lights[lamp] = (*mark.position[:2], height), direction
        return Poses(geoms, poses.camera if visible.eye is None else visible.eye, tuple(lights.values()))

    def draw(self, task: Task, visible: Visible) -> Array:
        """Return a picture (H, W, 3), or grey (H, W, 1), uint8 of one world."""
        sizes = self.field(task, visible, "geom_size")
        for name, mark in visible.marks.items():
            if mark.size is not None:
                sizes = sizes.at[self.scene.model.geom(name).id].set(mark.size)
        leaf = lambda name: sizes if name == "geom_size" else self.field(task, visible, name)
        picture = self.painter.paint(leaf, self.poses(task, visible))
        if not self.grey:
            return picture
        return jnp.round(picture @ jnp.float32(GREY))[..., None].astype(jnp.uint8)


def _frame(z: Array) -> Any:
    """Return axes with a given z axis, for shapes that are round about it."""
    aside = jnp.where(jnp.abs(z[0]) < 0.9, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    x = jnp.cross(aside, z)
    x = x / jnp.linalg.norm(x)
    return tuple(x), tuple(jnp.cross(z, x)), tuple(z)
