"""The shelf of Meta-World."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import caging, distance, hamacher, in_hand, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.05  # [m] of the target in the reward
_BOARD = 0.24  # [m] height of the shelf's board
_DEPTH = 0.15  # [m] before the target, from where the block counts as below the board


@dataclasses.dataclass(frozen=True)
class ShelfPlace(Sawyer):
    """Shelf place: pick up the block and put it on the shelf's board.

    Reward: with the block (x, y, z), its distance d from the target g,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 clip(p - b, 0, 1)  (held and lifted)
            r = H(C, p)  (else)
            p = near(d, 0.05, d_0)
            b = H(1 - (g_y - y) / 0.15, 1 - z / 0.24)  (before the board and below it)
            b = 1  (beneath the board)
            b = 0  (else)
        The block is low with 0 < z < 0.24 and |x - g_x| < 0.15; it is then beneath the board where y exceeds g_y, and
        before it where y is less by up to 0.15 m. It is held with the tool centre within 0.025 m and the fingers apart,
        and lifted by 0.01 m. C is plain with O = 0.02, P = 0.05 and X = 0.01.
    Success: the block is within 0.07 m of the target.
    Start: the block at the drawn x and y, at the height where it lay while the hand settled; the shelf 0.3 m below the
        drawn target.
    """

    scene_file: ClassVar[str] = "sawyer_shelf_placing"
    drawn: ClassVar = ((-0.1, 0.5, 0.019, -0.1, 0.8, 0.299), (0.1, 0.6, 0.021, 0.1, 0.9, 0.301))
    watched: ClassVar = {"block": "body:obj", "shape": "geom:objGeom"}
    apart: ClassVar[float] = 0.1

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        block = np.array([*vec[:2], host.body("obj")[2]])
        host.move("shelf", vec[3:] - np.array([0.0, 0.0, 0.3]))
        host.place_free(block)
        return {"target": host.site("goal"), "obj_init": block}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["block"], scalar_last(at.quat["shape"])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        block, start, target = at.obs[4:7], began["obj_init"], began["target"]
        away = distance(block, target)
        in_place = near(away, _RADIUS, distance(start, target))
        caged = caging(at, began, block, obj_radius=0.02, pad_success_thresh=0.05, xz_thresh=0.01)
        reward = hamacher(caged, in_place)

        low = (0 < block[2]) & (block[2] < _BOARD) & (abs(block[0] - target[0]) < 0.15)
        before = low & (target[1] - _DEPTH < block[1]) & (block[1] < target[1])
        way, below = (block[1] - target[1] + _DEPTH) / _DEPTH, (_BOARD - block[2]) / _BOARD
        lost = jnp.where(before, hamacher(jnp.clip(way, 0, 1), jnp.clip(below, 0, 1)), 0.0)
        in_place = jnp.where(low & (block[1] > target[1]), 0.0, jnp.clip(in_place - lost, 0.0, 1.0))

        held = in_hand(at, block, 0.025) & (block[2] - 0.01 > start[2])
        reward += jnp.where(held, 1 + 5 * in_place, 0.0)
        return jnp.where(away < _RADIUS, 10.0, reward), away <= 0.07
