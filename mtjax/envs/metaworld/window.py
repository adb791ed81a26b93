"""Windows of Meta-World: a frame that slides sideways."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.05  # [m] of the target, along x


def _show(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position[self.handle], jnp.zeros(4)


def _slide(self: Sawyer, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
    handle = at.position[self.handle]
    away = abs(handle[0] - began["target"][0])
    way = abs(began[self.way_from][0] - began["target"][0])
    in_place = near(away, _RADIUS, abs(way - _RADIUS))
    margin = abs(distance(began["window_handle_pos_init"], began["init_tcp"]) - 0.02)
    reach = tolerance(distance(handle, at.tcp), 0.0, 0.02, margin, self.reach_shape)
    return 10 * hamacher(reach, in_place), away <= _RADIUS


@dataclasses.dataclass(frozen=True)
class WindowOpen(Sawyer):
    """Window open: slide the window to the right by its handle.

    Reward: with the handle o, and its distance d from the target along x,
            r = 10 H(near(|o - t|, 0.02, ||o_0 - t_0| - 0.02|), near(d, 0.05, |d_0 - 0.05|))
    Success: the handle is within 0.05 m of the target along x.
    Start: the window at the drawn place, closed. The target is 0.2 m to the right of the window's centre.

    The handle's way is measured from the window's centre and not from the handle itself.
    """

    scene_file: ClassVar[str] = "sawyer_window_horizontal"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.7, 0.16), (0.1, 0.9, 0.16))
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"opens": "site:handleOpenStart", "closes": "site:handleCloseStart"}
    handle: ClassVar[str] = "opens"  # the thing watched that the hand pushes
    way_from: ClassVar[str] = "obj_init"  # from where the handle's way to the target is measured
    reach_shape: ClassVar[str] = "long_tail"
    objects, evaluate = _show, _slide

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("window", vec)
        handle = host.site("handleOpenStart")
        host.data.qpos[9] = 0.0
        return {"target": vec + np.array([0.2, 0.0, 0.0]), "obj_init": vec, "window_handle_pos_init": handle}


@dataclasses.dataclass(frozen=True)
class WindowClose(Sawyer):
    """Window close: slide the window to the left by its handle.

    Reward: with the handle o, and its distance d from the target along x,
            r = 10 H(gauss(|o - t|, 0.02, ||o_0 - t_0| - 0.02|), near(d, 0.05, |d_0 - 0.05|))
    Success: the handle is within 0.05 m of the target along x.
    Start: the window at the drawn place, open by 0.2 m. The target is the window's centre.
    """

    scene_file: ClassVar[str] = "sawyer_window_horizontal"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((0.0, 0.75, 0.2), (0.0, 0.9, 0.2))
    goal_box: ClassVar = WindowOpen.goal_box
    watched: ClassVar = WindowOpen.watched
    handle: ClassVar[str] = "closes"
    way_from: ClassVar[str] = "window_handle_pos_init"
    reach_shape: ClassVar[str] = "gaussian"
    objects, evaluate = _show, _slide

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("window", vec)
        handle = host.site("handleCloseStart") + np.array([0.2, 0.0, 0.0])
        host.data.qpos[9] = 0.2
        return {"target": vec, "obj_init": vec, "window_handle_pos_init": handle}
