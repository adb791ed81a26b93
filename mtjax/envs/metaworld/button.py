"""Meta-World's button on a box, to press from the front or from above, with a wall in the way or without."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_JOINT = 9  # the place of the button's joint in qpos and qvel


def _arrange(host: Host, vec: np.ndarray, axis: int) -> dict[str, np.ndarray]:
    """Put the box at ``vec``; the button is to be pressed along ``axis`` until it is in its hole."""
    host.move("box", vec)
    host.forward()
    target = host.site("hole")
    return {"target": target, "obj_to_target_init": np.abs(target[axis] - host.site("buttonStart")[axis])}


def _arrange_front(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    host.data.qpos[_JOINT] = host.data.qvel[_JOINT] = 0
    return _arrange(host, vec, axis=1)


def _arrange_top(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    return _arrange(host, vec, axis=2)


def _show_front(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position["button"] + jnp.array([0.0, -0.193, 0.0]), at.quat["button"]


def _show_top(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position["button"] + jnp.array([0.0, 0.0, 0.193]), at.quat["button"]


def _press_down(at: Observables, began: Mapping[str, Array], hand: Array) -> tuple[Array, Array]:
    """Return reward and success for a button that is pressed along z; ``hand`` () says how well the gripper is set."""
    button = at.obs[4:7]
    away, left = distance(button, at.tcp), jnp.abs(began["target"][2] - button[2])
    ready = hamacher(hand, near(away, 0.01, distance(button, began["init_tcp"])))
    pressed = near(left, 0.005, began["obj_to_target_init"])
    return 5 * ready + jnp.where(away <= 0.03, 5 * pressed, 0.0), left <= 0.024


def press(at: Observables, began: Mapping[str, Array], depth: Array | float) -> tuple[Array, Array]:
    """Return the reward () for pressing a button along y with an open gripper, and how far () [m] it has to go."""
    button = at.obs[4:7]
    away, left = distance(button, at.tcp), jnp.abs(began["target"][1] - button[1])
    ready = hamacher(jnp.maximum(at.obs[3], 0.0), near(away, 0.05, distance(button, began["init_tcp"])))
    return 2 * ready + jnp.where(away <= 0.05, 8 * near(left, 0.005, depth), 0.0), left


@dataclasses.dataclass(frozen=True)
class ButtonPress(Sawyer):
    """Press a button from the front (Meta-World's button-press-v3).

    Reward: with the button b, and the distance d along y that it has to go,
            r = 2 A + 8 near(d, 0.005, d_0) if |b - t| <= 0.05, else 2 A
            A = H(e, near(|b - t|, 0.05, |b - t_0|))
        A tells how well an open gripper comes to the button.
    Success: along y, the button is within 0.02 m of its hole.
    """

    scene_file: ClassVar[str] = "sawyer_button_press"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.85, 0.115), (0.1, 0.9, 0.115))
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"button": "body:button"}
    arrange, objects = _arrange_front, _show_front

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        reward, left = press(at, began, began["obj_to_target_init"])
        return reward, left <= 0.02


@dataclasses.dataclass(frozen=True)
class ButtonPressWall(Sawyer):
    """Press a button over a wall (Meta-World's button-press-wall-v3).

    Reward: with the button b, and the distance d along y that it has to go,
            r = 2 H((1 - e) / 2, near(|b - t|, 0.01, |b - t_0|))  (|b - t| above 0.07)
            r = 2 + 2 (1 + e) + 4 near(d, 0.005, d_0)^2  (else)
    Success: along y, the button is within 0.03 m of its hole.
    """

    scene_file: ClassVar[str] = "sawyer_button_press_wall"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.05, 0.85, 0.1149), (0.05, 0.9, 0.1151))
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"button": "body:button"}
    arrange, objects = _arrange_front, _show_front

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        button, opened = at.obs[4:7], at.obs[3]
        away, left = distance(button, at.tcp), jnp.abs(began["target"][1] - button[1])
        ready = hamacher((1 - opened) / 2, near(away, 0.01, distance(button, began["init_tcp"])))
        pressed = near(left, 0.005, began["obj_to_target_init"])
        return jnp.where(away > 0.07, 2 * ready, 2 + 2 * (1 + opened) + 4 * pressed**2), left <= 0.03


@dataclasses.dataclass(frozen=True)
class ButtonPressTopdown(Sawyer):
    """Press a button from above (Meta-World's button-press-topdown-v3).

    Reward: with the button b, and the distance d along z that it has to go,
            r = 5 A + 5 near(d, 0.005, d_0) if |b - t| <= 0.03, else 5 A
            A = H(1 - e, near(|b - t|, 0.01, |b - t_0|))
        A tells how well a closed gripper comes to the button.
    Success: along z, the button is within 0.024 m of its hole.
    """

    scene_file: ClassVar[str] = "sawyer_button_press_topdown"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.8, 0.115), (0.1, 0.9, 0.115))
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"button": "body:button"}
    arrange, objects = _arrange_top, _show_top

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        return _press_down(at, began, 1 - at.obs[3])


@dataclasses.dataclass(frozen=True)
class ButtonPressTopdownWall(Sawyer):
    """Press a button from above, over a wall (Meta-World's button-press-topdown-wall-v3).

    Reward: with the button b, and the distance d along z that it has to go,
            r = 5 A + 5 near(d, 0.005, d_0) if |b - t| <= 0.03, else 5 A
            A = H(e, near(|b - t|, 0.01, |b - t_0|))
        A tells how well an open gripper comes to the button.
    Success: along z, the button is within 0.024 m of its hole.
    """

    scene_file: ClassVar[str] = "sawyer_button_press_topdown_wall"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ButtonPressTopdown.drawn
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"button": "body:button"}
    arrange, objects = _arrange_top, _show_top

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        return _press_down(at, began, at.obs[3])
