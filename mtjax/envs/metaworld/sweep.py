"""Tasks of Meta-World that sweep a block over the table."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import distance, hamacher, near, pads_caging
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.05  # [m] of both targets


def _sweep(at: Observables, began: Mapping[str, Array], target: Array, grip: float, xz: float) -> tuple[Array, Array]:
    """Return reward and success for a block swept to ``target`` (3,).

    Args:
        grip: [m] from the block to a pad.
        xz: [m] from the block to the tool centre.
    """
    block = at.obs[4:7]
    away = distance(block, target)
    in_place = near(away, _RADIUS, distance(began["obj_init"], target))
    pinched = pads_caging(at, began, block, obj_radius=0.02, grip_margin=grip, xz_thresh=xz)
    reward = 2 * pinched + 6 * hamacher(pinched, in_place)
    return jnp.where(away < _RADIUS, 10.0, reward), away <= _RADIUS


@dataclasses.dataclass(frozen=True)
class Sweep(Sawyer):
    """Sweep: sweep the block to the right, off the table.

    Reward: with the block's distance d from the target,
            r = 10  (d below 0.05)
            r = 2 C + 6 H(C, near(d, 0.05, d_0))  (else)
        C is pinching with O = 0.02, W = 0.01 and X = 0.005.
    Success: the block is within 0.05 m of the target.
    Start: the block at the drawn x and y; the target is at the table's edge, x = 0.5 m, at the same y.
    """

    scene_file: ClassVar[str] = "sawyer_sweep_v3"
    drawn: ClassVar = ((-0.1, 0.6, 0.02), (0.1, 0.7, 0.02))
    goal_box: ClassVar = ((0.49, 0.6, 0.0), (0.51, 0.7, 0.02))
    watched: ClassVar = {"block": "body:obj"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        block = np.array([*vec[:2], 0.02])
        host.place_free(block)
        return {"target": np.array([0.5, vec[1], 0.01]), "obj_init": block}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["block"], at.quat["block"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        return _sweep(at, began, began["target"], grip=0.01, xz=0.005)


@dataclasses.dataclass(frozen=True)
class SweepInto(Sawyer):
    """Sweep into: sweep the block forward into the hole.

    Reward: with the block's distance d from the target, which is at whatever height the block is,
            r = 10  (d below 0.05)
            r = 2 C + 6 H(C, near(d, 0.05, d_0))  (else)
        C is pinching with O = 0.02, W = 0.005 and X = 0.01.
    Success: the block is within 0.05 m of the target.
    Start: the block at the drawn x and y, at the height where it lay while the hand settled. The target is the hole.
    """

    scene_file: ClassVar[str] = "sawyer_table_with_hole"
    drawn: ClassVar = ((-0.1, 0.6, 0.02, -0.001, 0.8399, 0.0199), (0.1, 0.7, 0.02, 0.001, 0.8401, 0.0201))
    watched: ClassVar = {"block": "body:obj", "shape": "geom:objGeom"}
    hole: ClassVar = (0.0, 0.84, 0.02)

    def allowed(self, vec: np.ndarray) -> bool:
        return bool(np.linalg.norm(vec[:2] - self.hole[:2]) >= 0.15)

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        block = np.array([*vec[:2], host.body("obj")[2]])
        host.place_free(block)
        return {"target": np.array(self.hole), "obj_init": block}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["block"], scalar_last(at.quat["shape"])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        return _sweep(at, began, began["target"].at[2].set(at.obs[6]), grip=0.005, xz=0.01)
