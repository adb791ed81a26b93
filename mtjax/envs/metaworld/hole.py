"""Tasks of Meta-World on a table with a hole."""

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

_RADIUS = 0.05  # [m] of both targets


def _place(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    host.place_free(vec[:3])
    return {"target": vec[3:], "obj_init": vec[:3]}


def _show(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position["block"], at.quat["block"]


@dataclasses.dataclass(frozen=True)
class HandInsert(Sawyer):
    """Hand insert: take the block and put it into the hole with the hand.

    Reward: with the block's distance d from the target,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 7 p  (held)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
        The block is held with the tool centre within 0.02 m and the fingers apart. C is dense with O = 0.015, P = 0.05
        and X = 0.005.
    Success: the block is within 0.05 m of the target.
    Start: the block at the drawn place, dropped from 0.05 m.
    """

    scene_file: ClassVar[str] = "sawyer_table_with_hole"
    hand_low: ClassVar = (-0.5, 0.4, -0.15)
    drawn: ClassVar = ((-0.1, 0.6, 0.05, -0.04, 0.8, -0.0201), (0.1, 0.7, 0.05, 0.04, 0.88, -0.0199))
    watched: ClassVar = {"block": "body:obj", "shape": "geom:objGeom"}
    apart: ClassVar[float] = 0.15
    arrange, objects = _place, _show

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        block, target = at.obs[4:7], began["target"]
        away = distance(block, target)
        in_place = near(away, _RADIUS, distance(began["obj_init"], target))
        caged = caging(at, began, block, obj_radius=0.015, pad_success_thresh=0.05, xz_thresh=0.005, high_density=True)
        held = in_hand(at, block, 0.02)
        reward = hamacher(caged, in_place) + jnp.where(held, 1 + 7 * in_place, 0.0)
        return jnp.where(away < _RADIUS, 10.0, reward), away <= _RADIUS


@dataclasses.dataclass(frozen=True)
class PickOutOfHole(Sawyer):
    """Pick out of hole: take the puck out of the hole and lift it to the target.

    Reward: with the puck's distance d from the target, and rho, that of the tool centre from the puck's start along x
        and y,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 H(p, A)  (held and lifted)
            r = H(C, p)  (else)
            p = near(d, 0.02, d_0)
            A = near(max(funnel(rho, 0.03, 0.015, 0.15) - t_z, 0), 0.01, 0.02)
        The puck is held with the tool centre within 0.04 m and the gripper open by 0.33 at least, and lifted by 0.02 m.
        C is dense with O = 0.015, P = 0.02, X = 0.03 and E = 0.1.
    Success: the puck is within 0.07 m of the target.
    Start: the puck in the hole, always at the same place.

    The gripper closes with full effort already at an action of 0.1.
    """

    scene_file: ClassVar[str] = "sawyer_pick_out_of_hole"
    watched: ClassVar = {"block": "body:obj"}
    hand_low: ClassVar = (-0.5, 0.4, -0.05)
    drawn: ClassVar = ((0.0, 0.75, 0.02, -0.1, 0.5, 0.15), (0.0, 0.75, 0.02, 0.1, 0.6, 0.3))
    apart: ClassVar[float] = 0.15
    arrange, objects = _place, _show

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        puck, start, target = at.obs[4:7], began["obj_init"], began["target"]
        away = distance(puck, target)
        in_place = near(away, 0.02, distance(start, target))
        outside = distance(at.tcp[:2], start[:2]) - 0.03
        floor = jnp.where(outside > 0, 0.015 * jnp.log(jnp.where(outside > 0, outside, 1.0)) + 0.15, 0.0)
        above = near(jnp.maximum(floor - at.tcp[2], 0.0), 0.01, 0.02)
        caged = caging(
            at,
            began,
            puck,
            obj_radius=0.015,
            pad_success_thresh=0.02,
            xz_thresh=0.03,
            desired_gripper_effort=0.1,
            high_density=True,
        )
        held = (distance(puck, at.tcp) < 0.04) & (at.obs[3] >= 0.33) & (puck[2] - 0.02 > start[2])
        reward = hamacher(caged, in_place) + jnp.where(held, 1 + 5 * hamacher(in_place, above), 0.0)
        return jnp.where(away < _RADIUS, 10.0, reward), away <= 0.07
