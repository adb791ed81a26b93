"""Plates of Meta-World: a plate is slid over the table, into a goal or out of it."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.05  # [m] of the target in the reward


def _arrange(host: Host, vec: np.ndarray, x: float = 0.0, y: float = 0.0) -> dict[str, np.ndarray]:
    """Put the plate ``x`` and ``y`` [m] away from its place in the scene."""
    host.data.qpos[9:11] = x, y
    host.forward()
    return {"target": vec[3:], "obj_init": vec[:3]}


def _show(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position["plate"], scalar_last(at.quat["plate"])


def _pull(self: Sawyer, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
    """Return reward and success for a plate that the hand moves from above."""
    plate, start, target = at.obs[4:7], began["obj_init"], began["target"]
    away, reached = distance(plate, target), distance(plate, at.tcp)
    in_place = near(away, _RADIUS, distance(start, target) - _RADIUS)
    reach = near(reached, _RADIUS, distance(start, began["init_tcp"]) - _RADIUS)
    reward = jnp.where((at.tcp[2] <= 0.03) & (reached < 0.07), 2 + 7 * in_place, 1.5 * reach)
    return jnp.where(away < _RADIUS, 10.0, reward), away <= 0.07


@dataclasses.dataclass(frozen=True)
class PlateSlide(Sawyer):
    """Plate slide: slide the plate forward into the goal.

    Reward: with the plate o, and its distance d from the target,
            r = 10  (d below 0.05)
            r = 8 H(near(|o - t|, 0.05, |o_0 - t_0|), near(d, 0.05, d_0))  (else)
    Success: the plate is within 0.07 m of the target.
    Start: the plate at its place, the goal at the drawn one.
    """

    scene_file: ClassVar[str] = "sawyer_plate_slide"
    drawn: ClassVar = ((0.0, 0.6, 0.0, -0.1, 0.85, 0.0), (0.0, 0.6, 0.0, 0.1, 0.9, 0.0))
    watched: ClassVar = {"plate": "geom:puck"}
    objects = _show

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("puck_goal", vec[3:])
        return _arrange(host, vec)

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        plate, start, target = at.obs[4:7], began["obj_init"], began["target"]
        away = distance(plate, target)
        in_place = near(away, _RADIUS, distance(start, target))
        reach = near(distance(plate, at.tcp), _RADIUS, distance(start, began["init_tcp"]))
        return jnp.where(away < _RADIUS, 10.0, 8 * hamacher(reach, in_place)), away <= 0.07


@dataclasses.dataclass(frozen=True)
class PlateSlideBack(Sawyer):
    """Plate slide back: slide the plate back out of the goal, towards the robot.

    Reward: with the plate o, and its distance d from the target,
            r = 10  (d below 0.05)
            r = 2 + 7 near(d, 0.05, d_0 - 0.05)  (t_z at most 0.03, and |o - t| below 0.07)
            r = 1.5 near(|o - t|, 0.05, |o_0 - t_0| - 0.05)  (else)
    Success: the plate is within 0.07 m of the target.
    Start: the plate 0.15 m forward. The goal's net stays where the scene has it.
    """

    scene_file: ClassVar[str] = "sawyer_plate_slide"
    drawn: ClassVar = ((0.0, 0.85, 0.0, -0.1, 0.6, 0.015), (0.0, 0.85, 0.0, 0.1, 0.6, 0.015))
    watched: ClassVar = PlateSlide.watched
    objects, evaluate = _show, _pull

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec, y=0.15)


@dataclasses.dataclass(frozen=True)
class PlateSlideSide(Sawyer):
    """Plate slide side: slide the plate to the left into the goal.

    Reward: with the plate o, and its distance d from the target,
            r = 10  (d below 0.05)
            r = 2 + 7 near(d, 0.05, d_0 - 0.05)  (t_z at most 0.03, and |o - t| below 0.07)
            r = 1.5 near(|o - t|, 0.05, |o_0 - t_0| - 0.05)  (else)
    Success: the plate is within 0.07 m of the target.
    Start: the plate at its place. The goal's net stays where the scene has it, wherever the target is.
    """

    scene_file: ClassVar[str] = "sawyer_plate_slide_sideway"
    drawn: ClassVar = ((0.0, 0.6, 0.0, -0.3, 0.54, 0.0), (0.0, 0.6, 0.0, -0.25, 0.66, 0.0))
    watched: ClassVar = PlateSlide.watched
    objects, evaluate = _show, _pull

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec)


@dataclasses.dataclass(frozen=True)
class PlateSlideBackSide(Sawyer):
    """Plate slide back side: slide the plate to the right out of the goal.

    Reward: with the plate o, and its distance d from the target,
            r = 10  (d below 0.05)
            r = 2 + 7 near(d, 0.05, d_0 - 0.05)  (t_z at most 0.03, and |o - t| below 0.07)
            r = 1.5 near(|o - t|, 0.05, |o_0 - t_0| - 0.05)  (else)
    Success: the plate is within 0.07 m of the target.
    Start: the goal's net at the drawn place of the plate, and the plate 0.1 m to the right of it.
    """

    scene_file: ClassVar[str] = "sawyer_plate_slide_sideway"
    drawn: ClassVar = ((-0.25, 0.6, 0.0, -0.05, 0.6, 0.015), (-0.25, 0.6, 0.0, 0.15, 0.6, 0.015))
    watched: ClassVar = PlateSlide.watched
    objects, evaluate = _show, _pull

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("puck_goal", vec[:3])
        return _arrange(host, vec, x=-0.15)
