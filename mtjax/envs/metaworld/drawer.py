"""Meta-World's drawer, to pull open and to push closed."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import distance, effort, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_SLIDE = 9  # the place of the drawer's joint in qpos
_HANDLE = (0.0, -0.16, 0.05)  # [m] from the drawer's frame to where its handle is pushed
_OPEN = 0.2  # [m] that the drawer is to be pulled


@dataclasses.dataclass(frozen=True)
class DrawerOpen(Sawyer):
    """Open a drawer: pull its handle by 0.2 m (Meta-World's drawer-open-v3).

    Reward: with the handle o, its distance d from the goal, the hand h, and o_0 the place 0.2 m behind the goal,
            r = 5 near(|w (o - h)|, 0.01, |w (o_0 - t_0)|) + 5 near(d, 0.02, 0.2)
        where w = (3, 3, 1), so that the hand comes to the handle from above.
    Success: the handle is within 0.03 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_drawer"
    drawn: ClassVar = ((-0.1, 0.9, 0.0), (0.1, 0.9, 0.0))
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"drawer": "body:drawer_link"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("drawer", vec)
        return {"target": vec + np.array([0.0, -0.16 - _OPEN, 0.09])}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["drawer"] + jnp.array([0.0, -0.16, 0.0]), at.quat["drawer"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        hand, handle, target = at.obs[:3], at.obs[4:7], began["target"]
        left, weight = distance(handle, target), jnp.array([3.0, 3.0, 1.0])
        closed = target + jnp.array([0.0, _OPEN, 0.0])
        margin = distance(closed * weight, began["init_tcp"] * weight)
        gripped = near(distance(handle * weight, hand * weight), 0.01, margin)
        return 5 * (gripped + near(left, 0.02, _OPEN)), left <= 0.03


@dataclasses.dataclass(frozen=True)
class DrawerClose(Sawyer):
    """Close a drawer: push its handle by 0.15 m (Meta-World's drawer-close-v3).

    Reward: with the handle o, and its distance d from the goal,
            r = 10  (success)
            r = 10 H(H(A, clip(f, 0, 1)), near(d, 0.05, |d_0 - 0.05|))  (else)
            A = gauss(|o - t|, 0.005, ||o_0 - t_0| - 0.005|)
    Success: the handle is within 0.065 m of the goal.

    The observation has zeros for the drawer's orientation. The handle of the closed drawer is 0.051 m from the goal.
    """

    scene_file: ClassVar[str] = "sawyer_drawer"
    drawn: ClassVar = DrawerOpen.drawn
    goal_box: ClassVar = (Sawyer.hand_low, Sawyer.hand_high)
    watched: ClassVar = {"drawer": "body:drawer_link"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("drawer", vec)
        host.data.qpos[_SLIDE] = -0.15
        host.forward()
        return {
            "target": vec + np.array([0.0, -0.16, 0.09]),
            "obj_init": host.body("drawer_link") + np.array([0.0, -0.16, 0.05]),
        }

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["drawer"] + jnp.array(_HANDLE), jnp.zeros(4)

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        handle, target, start = at.obs[4:7], began["target"], began["obj_init"]
        left, reach = distance(handle, target), distance(start, began["init_tcp"])
        in_place = near(left, 0.05, jnp.abs(distance(start, target) - 0.05))
        there = tolerance(distance(handle, at.tcp), 0.0, 0.005, jnp.abs(reach - 0.005))
        closed = left <= 0.05 + 0.015
        return 10 * jnp.where(closed, 1.0, hamacher(hamacher(there, effort(at)), in_place)), closed
