"""Meta-World's pushing tasks."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import caging, distance, hamacher, in_hand, near, pads_caging
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

RADIUS = 0.05  # [m] within which a thing is at its goal
PAST_WALL = 0.75  # [m] of y


def show_puck(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    """Return what fills the observation's entries for objects."""
    return at.position["puck"], scalar_last(at.quat["puck"])


def progress(at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array, Array]:
    """Return where the puck is (3,), its distance () from the goal, and how near that is in [0, 1]."""
    puck, target = at.position["puck"], began["target"]
    away = distance(puck, target)
    return puck, away, near(away, RADIUS, distance(began["obj_init"], target))


def _place(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    height = host.body("obj")[2]
    obj_init = np.append(vec[:2], height)
    host.place_free(obj_init)
    return {"target": np.append(vec[3:5], height), "obj_init": obj_init}


def _held(at: Observables, began: Mapping[str, Array]) -> Array:
    """Return the reward () of a gripper about the puck."""
    puck = at.position["puck"]
    return caging(at, began, puck, obj_radius=0.015, pad_success_thresh=0.05, xz_thresh=0.005, high_density=True)


@dataclasses.dataclass(frozen=True)
class Push(Sawyer):
    """Push: bring the puck to a goal on the table (Meta-World's push-v3).

    Reward: with the puck's distance d from the goal,
            r = 10  (d below 0.05)
            r = 4 C + 1 + 5 p  (held)
            r = 2 C  (else)
            p = near(d, 0.05, d_0)
        The puck is held with the tool centre within 0.02 m and the fingers apart. C is dense with O = 0.015, P = 0.05
        and X = 0.005.
    Success: the puck is within 0.05 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_push_v3"
    drawn: ClassVar = ((-0.1, 0.6, 0.02, -0.1, 0.8, 0.01), (0.1, 0.7, 0.02, 0.1, 0.9, 0.02))
    watched: ClassVar = {"puck": "body:obj"}
    apart: ClassVar[float] = 0.15
    arrange, objects = _place, show_puck

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        puck, away, in_place = progress(at, began)
        held = _held(at, began)
        reward = 2 * held + jnp.where(in_hand(at, puck, 0.02), 1 + 2 * held + 5 * in_place, 0.0)
        return jnp.where(away < RADIUS, 10.0, reward), away <= RADIUS


@dataclasses.dataclass(frozen=True)
class PushWall(Sawyer):
    """Push around a wall: bring the puck to a goal behind a wall (Meta-World's push-wall-v3).

    Reward: with the puck's distances d from the goal, and a from the wall's end, where x counts three times,
            r = 10  (d below 0.05)
            r = 2 C + 5 + 3 p  (held and past the wall)
            r = 2 C + 1 + 4 near(a, 0.05, a_0)  (held)
            r = 2 C  (else)
            p = near(d, 0.05, d_0)
        The puck is held with the tool centre within 0.02 m and the fingers apart, and past the wall from y = 0.75 on.
        The wall's end is (-0.05, 0.77) at the puck's height. C is dense with O = 0.015, P = 0.05 and X = 0.005.
    Success: the puck is within 0.07 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_push_wall_v3"
    drawn: ClassVar = ((-0.05, 0.6, 0.015, -0.05, 0.85, 0.01), (0.05, 0.65, 0.015, 0.05, 0.9, 0.02))
    watched: ClassVar = Push.watched
    apart: ClassVar[float] = 0.15
    arrange, objects = _place, show_puck

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        puck, away, in_place = progress(at, began)
        middle, wide = jnp.stack([jnp.float32(-0.05), jnp.float32(0.77), puck[2]]), jnp.array([3.0, 1.0, 1.0])
        begun = distance(began["obj_init"] * wide, middle * wide)
        aside = near(distance(puck * wide, middle * wide), RADIUS, begun)
        held = 2 * _held(at, began)
        reward = jnp.where(puck[1] > PAST_WALL, held + 5 + 3 * in_place, held + 1 + 4 * aside)
        reward = jnp.where(in_hand(at, puck, 0.02), reward, held)
        return jnp.where(away < RADIUS, 10.0, reward), away <= 0.07


@dataclasses.dataclass(frozen=True)
class PushBack(Sawyer):
    """Push back: pull the puck to a goal that is nearer to the robot (Meta-World's push-back-v3).

    Reward: with the puck's distance d from the goal,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 p  (held and moved)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
        The puck is held with the tool centre within 0.01 m and 0 < e < 0.55, and has moved where it is nearer to the
        goal by 0.01 m than at the start. C is pinching with O = 0.007, W = 0.003 and X = 0.01.
    Success: the puck is within 0.07 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_push_back_v3"
    drawn: ClassVar = ((-0.1, 0.8, 0.02, -0.1, 0.6, 0.0199), (0.1, 0.85, 0.02, 0.1, 0.7, 0.0201))
    watched: ClassVar = Push.watched
    apart: ClassVar[float] = 0.15
    arrange, objects = _place, show_puck

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        puck, away, in_place = progress(at, began)
        held = pads_caging(at, began, puck, obj_radius=0.007, grip_margin=0.003, xz_thresh=0.01)
        closed = (at.obs[3] > 0) & (at.obs[3] < 0.55)
        moved = distance(began["obj_init"], began["target"]) - away > 0.01
        holding = (distance(puck, at.tcp) < 0.01) & closed & moved
        reward = hamacher(held, in_place) + jnp.where(holding, 1 + 5 * in_place, 0.0)
        return jnp.where(away < RADIUS, 10.0, reward), away <= 0.07
