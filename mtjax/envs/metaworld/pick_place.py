"""Meta-World's picking and placing in the air."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.push import PAST_WALL, RADIUS, Push, progress, show_puck
from mtjax.envs.metaworld.rewards import caging, distance, hamacher, in_hand, near, pads_caging
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array


def _place(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    host.place_free(vec[:3])
    return {"target": vec[3:], "obj_init": vec[:3]}


def _lifted(at: Observables, began: Mapping[str, Array], height: float) -> Array:
    """Return whether () the gripper has the puck and it is higher than at the start."""
    puck = at.position["puck"]
    return in_hand(at, puck, 0.02) & (puck[2] - height > began["obj_init"][2])


@dataclasses.dataclass(frozen=True)
class PickPlace(Sawyer):
    """Pick and place: lift the puck to a goal in the air (Meta-World's pick-place-v3).

    Reward: with the puck's distance d from the goal,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 p  (held and lifted)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
        The puck is held with the tool centre within 0.02 m and the fingers apart, and lifted by 0.01 m. C is dense with
        O = 0.015 and X = 0.005, where pads count as in tasks that pinch.
    Success: the puck is within 0.07 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_pick_place_v3"
    drawn: ClassVar = ((-0.1, 0.6, 0.02, -0.1, 0.8, 0.05), (0.1, 0.7, 0.02, 0.1, 0.9, 0.3))
    watched: ClassVar = Push.watched
    apart: ClassVar[float] = 0.15
    arrange, objects = _place, show_puck

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        puck, away, in_place = progress(at, began)
        held = pads_caging(at, began, puck, obj_radius=0.015, xz_thresh=0.005)
        reward = hamacher(held, in_place) + jnp.where(_lifted(at, began, 0.01), 1 + 5 * in_place, 0.0)
        return jnp.where(away < RADIUS, 10.0, reward), away <= 0.07


@dataclasses.dataclass(frozen=True)
class PickPlaceWall(Sawyer):
    """Pick and place over a wall: lift the puck to a goal behind a wall (Meta-World's pick-place-wall-v3).

    Reward: with the puck's distances d from the goal, and a from a point over the wall, where z counts three times,
            r = 10  (d below 0.05)
            r = H(C, s) + 5 + 3 p  (held, lifted and past the wall)
            r = H(C, s) + 1 + 4 s  (held and lifted)
            r = H(C, s)  (else)
            p = near(d, 0.05, d_0),  s = near(a, 0.05, a_0)
        The puck is held with the tool centre within 0.02 m and the fingers apart, and lifted by 0.015 m; it is past the
        wall from y = 0.75 on. The point is (g_x, 0.77, 0.25), with the goal's x. C is plain with O = 0.015, P = 0.05
        and X = 0.005.
    Success: the puck is within 0.07 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_pick_place_wall_v3"
    drawn: ClassVar = ((-0.05, 0.6, 0.015, -0.05, 0.85, 0.05), (0.05, 0.65, 0.015, 0.05, 0.9, 0.3))
    watched: ClassVar = Push.watched
    apart: ClassVar[float] = 0.15
    arrange, objects = _place, show_puck

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        puck, away, in_place = progress(at, began)
        middle = jnp.stack([began["target"][0], jnp.float32(0.77), jnp.float32(0.25)])
        tall = jnp.array([1.0, 1.0, 3.0])
        above = near(distance(puck * tall, middle * tall), RADIUS, distance(began["obj_init"] * tall, middle * tall))
        held = caging(at, began, puck, obj_radius=0.015, pad_success_thresh=0.05, xz_thresh=0.005)
        begun = hamacher(held, above)
        carried = jnp.where(puck[1] > PAST_WALL, begun + 5 + 3 * in_place, begun + 1 + 4 * above)
        reward = jnp.where(_lifted(at, began, 0.015), carried, begun)
        return jnp.where(away < RADIUS, 10.0, reward), away <= 0.07
