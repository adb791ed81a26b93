"""Tasks of Meta-World that sweep a block over the table."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.at import At, scalar_last
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.rewards import distance, hamacher, near, pads_caging
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.05  # [m] of both targets


@dataclasses.dataclass(frozen=True)
class Sweep(Sawyer):
    """Sweep: sweep the block to the right, off the table.

    Reward: 2 for pinching the block, and 6 times the Hamacher product of that and the block at the target; 10 within
        0.05 m of the target.
    Success: the block is within 0.05 m of the target.
    Start: the block at the drawn x and y; the target is at the table's edge, x = 0.5 m, at the same y.
    """

    scene_file: ClassVar[str] = "sawyer_sweep_v3"
    drawn: ClassVar = ((-0.1, 0.6, 0.02), (0.1, 0.7, 0.02))
    goal_low: ClassVar = (0.49, 0.6, 0.0)
    goal_high: ClassVar = (0.51, 0.7, 0.02)
    watched: ClassVar = {"block": "body:obj"}
    grip: ClassVar[float] = 0.01  # [m] from the block to a pad
    xz: ClassVar[float] = 0.005  # [m] from the block to the tool centre

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        block = np.array([*vec[:2], 0.02])
        host.place_free(block)
        return {"target": np.array([0.5, vec[1], 0.01]), "obj_init": block}

    def objects(self, at: At) -> tuple[Array, ...]:
        return at.position["block"], at.quat["block"]

    def evaluate(self, at: At, began: Mapping[str, Array]) -> tuple[Array, Array]:
        block, target = at.obs[4:7], self.target_for(at.obs[4:7], began["target"])
        away = distance(block, target)
        in_place = near(away, _RADIUS, distance(began["obj_init"], target))
        pinched = pads_caging(at, began, block, obj_radius=0.02, grip_margin=self.grip, xz_thresh=self.xz)
        reward = 2 * pinched + 6 * hamacher(pinched, in_place)
        return jnp.where(away < _RADIUS, 10.0, reward), away <= _RADIUS

    def target_for(self, block: Array, target: Array) -> Array:
        """Return the target (3,) for a block (3,)."""
        return target


@dataclasses.dataclass(frozen=True)
class SweepInto(Sweep):
    """Sweep into: sweep the block forward into the hole.

    Reward and success: as Sweep, with other limits of pinching, and the target at whatever height the block is.
    Start: the block at the drawn x and y, at the height where it lay while the hand settled. The target is the hole.
    """

    scene_file: ClassVar[str] = "sawyer_table_with_hole"
    drawn: ClassVar = ((-0.1, 0.6, 0.02, -0.001, 0.8399, 0.0199), (0.1, 0.7, 0.02, 0.001, 0.8401, 0.0201))
    goal_low: ClassVar = drawn[0][3:]
    goal_high: ClassVar = drawn[1][3:]
    watched: ClassVar = {"block": "body:obj", "shape": "geom:objGeom"}
    hole: ClassVar = (0.0, 0.84, 0.02)
    grip: ClassVar[float] = 0.005
    xz: ClassVar[float] = 0.01

    def allowed(self, vec: np.ndarray) -> bool:
        return bool(np.linalg.norm(vec[:2] - self.hole[:2]) >= 0.15)

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        block = np.array([*vec[:2], host.body("obj")[2]])
        host.place_free(block)
        return {"target": np.array(self.hole), "obj_init": block}

    def objects(self, at: At) -> tuple[Array, ...]:
        return at.position["block"], scalar_last(at.quat["shape"])

    def target_for(self, block: Array, target: Array) -> Array:
        return target.at[2].set(block[2])
