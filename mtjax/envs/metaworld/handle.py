"""Handles of Meta-World: a lever on a box that is pressed down or pulled up."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import caging, distance, hamacher, in_hand, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_PRESSED = 0.02  # [m] within which a pressed handle is at its target
_PULLED = 0.05  # [m] the same of a pulled one


def _slide(host: Host, height: float) -> None:
    """Put the handle at a height [m] below its upper end, at rest."""
    host.data.qpos[9], host.data.qvel[9] = height, 0
    host.forward()


def _press(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    host.move("box", vec)
    _slide(host, -0.001)
    return {"target": host.site("goalPress"), "handle_init_pos": host.site("handleStart"), "obj_init": vec}


def _show(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position[self.handle], jnp.zeros(4)


def _pressed(self: Sawyer, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
    """Return reward and success for a handle that is to go down."""
    handle, start, target = at.position[self.handle], began["handle_init_pos"], began["target"]
    away = abs(handle[2] - target[2])
    in_place = near(away, _PRESSED, abs(abs(start[2] - target[2]) - _PRESSED))
    reach = near(distance(handle, at.tcp), 0.02, abs(distance(start, began["init_tcp"]) - 0.02))
    success = away <= _PRESSED
    return 10 * jnp.where(success, 1.0, hamacher(reach, in_place)), success


@dataclasses.dataclass(frozen=True)
class HandlePress(Sawyer):
    """Handle press: press the handle down.

    Reward: with the handle o, and its distance d from the target's height,
            r = 10  (success)
            r = 10 H(near(|o - t|, 0.02, ||o_0 - t_0| - 0.02|), near(d, 0.02, |d_0 - 0.02|))  (else)
    Success: the handle is within 0.02 m of the target's height.
    Start: the box at the drawn place, its handle up.
    """

    scene_file: ClassVar[str] = "sawyer_handle_press"
    drawn: ClassVar = ((-0.1, 0.8, -0.001), (0.1, 0.9, 0.001))
    goal_box: ClassVar = ((-0.1, 0.55, 0.04), (0.1, 0.7, 0.08))
    watched: ClassVar = {"start": "site:handleStart", "right": "site:handleRight"}
    handle: ClassVar[str] = "start"  # the thing watched that is the handle's place
    arrange, objects, evaluate = _press, _show, _pressed


@dataclasses.dataclass(frozen=True)
class HandlePressSide(Sawyer):
    """Handle press side: press down a handle that stands to the left and points to the right.

    Reward: with the handle o, and its distance d from the target's height,
            r = 10  (success)
            r = 10 H(near(|o - t|, 0.02, ||o_0 - t_0| - 0.02|), near(d, 0.02, |d_0 - 0.02|))  (else)
    Success: the handle is within 0.02 m of the target's height.
    Start: the box at the drawn place, its handle up.
    """

    scene_file: ClassVar[str] = "sawyer_handle_press_sideways"
    drawn: ClassVar = ((-0.35, 0.65, -0.001), (-0.25, 0.75, 0.001))
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"start": "site:handleStart", "centre": "site:handleCenter"}
    handle: ClassVar[str] = "start"
    arrange, objects, evaluate = _press, _show, _pressed


@dataclasses.dataclass(frozen=True)
class HandlePull(Sawyer):
    """Handle pull: pull the handle up.

    Reward: with the handle's distance d from the target's height,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 p  (held)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
        The handle is held with the tool centre within 0.035 m and the fingers apart. C is dense with O = 0.022, P =
        0.05 and X = 0.01.
    Success: the handle is within 0.05 m of the target's height.
    Start: the box at the drawn place, its handle down.

    Meta-World asks here whether the handle's y exceeds the height of the box by 0.01 m, which it always does. It also
    takes the handle's start in the caging and in the margin to be the box's place.
    """

    scene_file: ClassVar[str] = "sawyer_handle_press"
    drawn: ClassVar = HandlePress.drawn
    goal_box: ClassVar = ((-0.1, 0.55, 0.04), (0.1, 0.7, 0.18))
    watched: ClassVar = HandlePress.watched
    handle: ClassVar[str] = "right"
    objects = _show

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("box", vec)
        _slide(host, -0.1)
        return {"target": host.site("goalPull"), "obj_init": vec}

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        handle, start, target = at.obs[4:7], began["obj_init"], began["target"]
        away = abs(handle[2] - target[2])
        in_place = near(away, _PULLED, abs(start[2] - target[2]))
        caged = caging(at, began, handle, obj_radius=0.022, pad_success_thresh=0.05, xz_thresh=0.01, high_density=True)
        held = in_hand(at, handle, 0.035) & (handle[1] - 0.01 > start[2])
        reward = hamacher(caged, in_place) + jnp.where(held, 1 + 5 * in_place, 0.0)
        return jnp.where(away < _PULLED, 10.0, reward), away <= _PULLED


@dataclasses.dataclass(frozen=True)
class HandlePullSide(Sawyer):
    """Handle pull side: pull up a handle that stands to the left and points to the right.

    Reward: with the handle's distance d from the target,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 p  (held and risen)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
        The handle is held with the tool centre within 0.035 m and the fingers apart, and has risen by 0.01 m. C is
        dense with O = 0.032, P = 0.06 and X = 0.01.
    Success: the handle is within 0.08 m of the target.
    Start: the box at the drawn place, its handle down.
    """

    scene_file: ClassVar[str] = "sawyer_handle_press_sideways"
    drawn: ClassVar = ((-0.35, 0.65, 0.0), (-0.25, 0.75, 0.0))
    goal_box: ClassVar = HandlePressSide.goal_box
    watched: ClassVar = HandlePressSide.watched
    handle: ClassVar[str] = "centre"
    objects = _show

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("box", vec)
        _slide(host, -0.1)
        return {"target": host.site("goalPull"), "obj_init": host.site("handleCenter")}

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        handle, start, target = at.obs[4:7], began["obj_init"], began["target"]
        away = distance(handle, target)
        in_place = near(away, _PULLED, distance(start, target))
        caged = caging(at, began, handle, obj_radius=0.032, pad_success_thresh=0.06, xz_thresh=0.01, high_density=True)
        held = in_hand(at, handle, 0.035) & (handle[2] - 0.01 > start[2])
        reward = hamacher(caged, in_place) + jnp.where(held, 1 + 5 * in_place, 0.0)
        return jnp.where(away < _PULLED, 10.0, reward), away <= 0.08
