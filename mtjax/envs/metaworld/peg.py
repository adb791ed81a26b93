"""Pegs of Meta-World: one is put into a block, one is pulled out of it."""

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

_RADIUS = 0.07  # [m] of both targets
_HOLE = np.array([0.03, 0.0, 0.13])  # [m] from the block
_BOXES = np.array(  # (2, 2, 3) [m] corners in the block's frame of two boxes before it, below and above the hole
    [[[0.1, -0.11, 0.01], [-0.1, -0.15, 0.096]], [[0.1, -0.11, 0.16], [-0.1, -0.17, 0.19]]]
)
_TURN = np.array([[np.cos(1.57), np.sin(1.57), 0], [-np.sin(1.57), np.cos(1.57), 0], [0, 0, 1]])  # of the block


def _inside_box(point: Array, corners: Array) -> Array:
    """Return how far () a point (3,) is from the first of a box's corners (2, 3) to the second; 1 outside the box.

    Returns:
        The product of the parts of the way along x, y and z.
    """
    zero, one = corners
    inside = jnp.all((jnp.minimum(zero, one) <= point) & (point <= jnp.maximum(zero, one)))
    return jnp.where(inside, jnp.prod((point - zero) / (one - zero)), 1.0)


@dataclasses.dataclass(frozen=True)
class PegInsertSide(Sawyer):
    """Peg insert side: pick up the peg and put it sideways into the block's hole.

    Reward: with the distance d from the peg's head to the hole, where y and z count twice,
            r = 10  (success)
            r = 1 + 6 p  (held and lifted)
            r = H(C, p)  (else)
            p = H(near(d, 0.07, d_0), H(U_1, U_2))
        U_1 and U_2 are 1, but where the head is in a box before the block, above or below the hole: there they are the
        product of the shares of the way through the box along x, y and z. The peg is held with the tool centre within
        0.08 m and the fingers apart, and lifted by 0.01 m. C is dense with O = 0.0075, P = 0.03 and X = 0.005.
    Success: the peg's head is within 0.07 m of the hole, y and z counted twice.
    Start: peg and block at the drawn places.

    The margin for the head is measured from where the head is before the peg is put to the drawn place.
    """

    scene_file: ClassVar[str] = "sawyer_peg_insertion_side"
    drawn: ClassVar = ((0.0, 0.5, 0.02, -0.35, 0.4, -0.001), (0.2, 0.7, 0.02, -0.25, 0.7, 0.001))
    goal_box: ClassVar = ((-0.32, 0.4, 0.129), (-0.22, 0.7, 0.131))
    watched: ClassVar = {"grasp": "site:pegGrasp", "head": "site:pegHead"}
    apart: ClassVar[float] = 0.1

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        head = host.site("pegHead")
        host.move("box", vec[3:])
        host.place_free(vec[:3])
        return {"target": vec[3:] + _HOLE, "obj_init": vec[:3], "peg_head_pos_init": head}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["grasp"], scalar_last(at.quat["grasp"])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        peg, head, target = at.obs[4:7], at.position["head"], began["target"]
        scale = jnp.array([1.0, 2.0, 2.0])
        away = jnp.linalg.norm((head - target) * scale)
        below, above = target - _HOLE + _BOXES @ _TURN
        free = hamacher(_inside_box(head, above), _inside_box(head, below))
        in_place = hamacher(near(away, _RADIUS, jnp.linalg.norm((began["peg_head_pos_init"] - target) * scale)), free)
        caged = caging(at, began, peg, obj_radius=0.0075, pad_success_thresh=0.03, xz_thresh=0.005, high_density=True)
        held = in_hand(at, peg, 0.08) & (peg[2] - 0.01 > began["obj_init"][2])
        reward = jnp.where(held, 1 + 6 * in_place, hamacher(caged, in_place))  # a product with 1 changes nothing
        success = away <= _RADIUS
        return jnp.where(success, 10.0, reward), success


@dataclasses.dataclass(frozen=True)
class PegUnplugSide(Sawyer):
    """Peg unplug side: pull the plug sideways out of the block.

    Reward: with the distance d of the plug's end from the target,
            r = 10  (d at most 0.05)
            r = 2 C + 1 + 5 p  (held and moved)
            r = 2 C  (else)
            p = near(d, 0.05, d_0)
        The plug is held with the tool centre within 0.035 m and the gripper open by more than half, and moved to the
        right by 0.015 m. C is dense with O = 0.025, P = 0.05, X = 0.005 and E = 0.8.
    Success: the plug's end is within 0.07 m of the target, 0.15 m to the right of where the plug was.
    Start: the block at the drawn place, and the plug in it. The plug turns as it did while the hand settled, when it
        fell; only its place, direction and velocity are set.
    """

    scene_file: ClassVar[str] = "sawyer_peg_unplug_side"
    drawn: ClassVar = ((-0.25, 0.6, -0.001), (-0.15, 0.8, 0.001))
    goal_box: ClassVar = ((-0.056, 0.6, 0.13), (0.044, 0.8, 0.132))
    watched: ClassVar = {"end": "site:pegEnd", "plug": "body:plug1"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        plug = vec + np.array([0.044, 0.0, 0.131])
        host.move("box", vec)
        host.data.qpos[9:16] = [*plug, 1, 0, 0, 0]
        host.data.qvel[9:12] = 0
        host.forward()
        return {"target": plug + np.array([0.15, 0.0, 0.0]), "obj_init": host.site("pegEnd")}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["end"], at.quat["plug"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        end, start, target = at.obs[4:7], began["obj_init"], began["target"]
        away = distance(end, target)
        in_place = near(away, 0.05, distance(start, target))
        caged = caging(
            at,
            began,
            end,
            obj_radius=0.025,
            pad_success_thresh=0.05,
            xz_thresh=0.005,
            desired_gripper_effort=0.8,
            high_density=True,
        )
        held = (distance(end, at.tcp) < 0.035) & (at.obs[3] > 0.5) & (end[0] - start[0] > 0.015)
        reward = 2 * caged + jnp.where(held, 1 + 5 * in_place, 0.0)
        return jnp.where(away <= 0.05, 10.0, reward), away <= _RADIUS
