"""Meta-World's coffee machine and its mug: press the button, pull the mug away, push it under the machine."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.button import press
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import caging, distance, hamacher, in_hand, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_DEPTH = 0.03  # [m] of the button
_BEHIND = np.array([0.0, 0.22, 0.0])  # from a mug under the machine to the machine


def _place_mug(host: Host, pos: np.ndarray) -> None:
    """Put the mug at a position (3,). Its joint is the first, but Meta-World stops the arm's velocities as it does so.

    The velocities are those that belong to an object after the arm: here the last joints of arm and fingers.
    """
    host.data.qpos[:3], host.data.qvel[9:15] = pos, 0
    host.forward()


@dataclasses.dataclass(frozen=True)
class CoffeeButton(Sawyer):
    """Press the button of a coffee machine (Meta-World's coffee-button-v3).

    Reward: with the button b, and the distance d along y that it has to go,
            r = 2 A + 8 near(d, 0.005, 0.03) if |b - t| <= 0.05, else 2 A
            A = H(e, near(|b - t|, 0.05, |b - t_0|))
        A tells how well an open gripper comes to the button.
    Success: along y, the button is within 0.02 m of the goal.

    The observation has the orientation 1, 0, 0, 0 for the button.
    """

    scene_file: ClassVar[str] = "sawyer_coffee"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.8, -0.001), (0.1, 0.9, 0.001))
    goal_box: ClassVar = ((-0.101, 0.61, 0.298), (0.101, 0.71, 0.302))
    watched: ClassVar = {"button": "site:buttonStart", "mug": "body:obj", "shape": "geom:mug"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("coffee_machine", vec)
        _place_mug(host, vec - _BEHIND)
        return {"target": vec - _BEHIND + np.array([0.0, _DEPTH, 0.3])}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["button"], jnp.array([1.0, 0.0, 0.0, 0.0])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        reward, left = press(at, began, _DEPTH)
        return reward, left <= 0.02


def _arrange(host: Host, vec: np.ndarray, machine: np.ndarray) -> dict[str, np.ndarray]:
    """Put the machine at ``machine`` (3,), and the mug at its drawn place."""
    mug, target = np.split(vec, 2)
    host.move("coffee_machine", machine)
    _place_mug(host, mug)
    return {"target": target, "obj_init": mug}


def _show_mug(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position["mug"], scalar_last(at.quat["shape"])


def _move_mug(self: Sawyer, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
    mug, target, weight = at.obs[4:7], began["target"], jnp.array([2.0, 2.0, 1.0])
    left = distance(mug * weight, target * weight)
    in_place = near(left, 0.05, distance(began["obj_init"] * weight, target * weight))
    grasped = caging(
        at,
        began,
        mug,
        obj_radius=0.02,
        pad_success_thresh=0.05,
        xz_thresh=0.05,
        object_reach_radius=0.04,
        desired_gripper_effort=0.7,
        medium_density=True,
    )
    held = in_hand(at, mug, 0.04)
    reward = hamacher(grasped, in_place) + jnp.where(held, 1 + 5 * in_place, 0.0)
    return jnp.where(left < 0.05, 10.0, reward), distance(mug, target) <= 0.07


@dataclasses.dataclass(frozen=True)
class CoffeePull(Sawyer):
    """Pull a mug away from under a coffee machine (Meta-World's coffee-pull-v3).

    Reward: with the mug's distance d from the goal, where x and y count twice,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 p  (held)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
        The mug is held with the tool centre within 0.04 m and the fingers apart. C is medium with O = 0.02, P = 0.05, X
        = 0.05, D = 0.04 and E = 0.7.
    Success: the mug is within 0.07 m of the goal.

    The observation has the mug's orientation as x, y, z, w.
    """

    scene_file: ClassVar[str] = "sawyer_coffee"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.05, 0.7, -0.001, -0.1, 0.55, -0.001), (0.05, 0.75, 0.001, 0.1, 0.65, 0.001))
    watched: ClassVar = CoffeeButton.watched
    apart: ClassVar[float] = 0.15
    objects, evaluate = _show_mug, _move_mug

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec, vec[:3] + _BEHIND)


@dataclasses.dataclass(frozen=True)
class CoffeePush(Sawyer):
    """Push a mug under a coffee machine (Meta-World's coffee-push-v3).

    Reward: with the mug's distance d from the goal, where x and y count twice,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 p  (held)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
        The mug is held with the tool centre within 0.04 m and the fingers apart. C is medium with O = 0.02, P = 0.05, X
        = 0.05, D = 0.04 and E = 0.7.
    Success: the mug is within 0.07 m of the goal.

    The observation has the mug's orientation as x, y, z, w.
    """

    scene_file: ClassVar[str] = "sawyer_coffee"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.55, -0.001, -0.05, 0.7, -0.001), (0.1, 0.65, 0.001, 0.05, 0.75, 0.001))
    watched: ClassVar = CoffeeButton.watched
    apart: ClassVar[float] = 0.15
    objects, evaluate = _show_mug, _move_mug

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec, vec[3:] + _BEHIND)
