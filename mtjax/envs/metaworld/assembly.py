"""Meta-World's round nut with a handle, to put on a peg and to take off one."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.funnels import funnel
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import caging, distance, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_FLAT = (0.707, 0.0, 0.0, 0.707)  # the nut's orientation as it lies on the table
_HALF_HANDLE = 0.01  # [m]


def _grasp(at: Observables, began: Mapping[str, Array], high_density: bool) -> Array:
    """Return the caging reward () for the handle: held anywhere along its length, it counts as held in its middle."""
    hand, handle = at.obs[0], at.obs[4:7]
    along = jnp.where(jnp.abs(handle[0] - hand) < _HALF_HANDLE, hand, handle[0])
    return caging(
        at,
        began,
        handle.at[0].set(along),
        obj_radius=0.015,
        pad_success_thresh=0.02,
        xz_thresh=0.01,
        object_reach_radius=0.01,
        high_density=high_density,
        medium_density=not high_density,
    )


def _flat(at: Observables) -> Array:
    """Return 1 for a nut that lies flat, falling to 0 as it tilts."""
    return jnp.maximum(1 - distance(at.obs[7:11], jnp.array(_FLAT)) / 0.4, 0.0)


@dataclasses.dataclass(frozen=True)
class Assembly(Sawyer):
    """Put a round nut on a peg (Meta-World's assembly-v3).

    Reward: with the nut's centre c, its distance rho from the goal g along x and y, the nut's orientation q, and the
        distance d of c from the point (g_x, g_y, F), where z counts three times,
            r = 10  (success)
            r = (2 C + 6 p) max(1 - |q - (0.707, 0, 0, 0.707)| / 0.4, 0)  (else)
            p = 0.1 u + 0.9 near(d, 0.02, 0.4),  F = funnel(rho, 0.01, 0.02, 0.2)
            u = 1 if c_z > 0.02 or rho < 0.01, else 0
        The last factor is 1 for a nut that lies flat. C is that of the handle, medium with O = 0.015, P = 0.02, X =
        0.01 and D = 0.01, where o_0 is the nut's; within 0.01 m along x the handle is taken to be where the hand is.
    Success: in x and y, nut and peg are within 0.02 m, and the nut is below the peg's top.
    """

    scene_file: ClassVar[str] = "sawyer_assembly_peg"
    drawn: ClassVar = ((0.0, 0.6, 0.02, -0.1, 0.75, 0.1), (0.0, 0.6, 0.02, 0.1, 0.85, 0.1))
    watched: ClassVar = {"handle": "site:RoundNut-8", "centre": "site:RoundNut", "nut": "body:RoundNut"}
    apart: ClassVar[float] = 0.1

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        nut, target = np.split(vec, 2)
        host.place_free(nut)
        host.move("peg", target - np.array([0.0, 0.0, 0.05]))
        return {"target": target, "obj_init": nut}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["handle"], at.quat["nut"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        centre, target = at.position["centre"], began["target"]
        radius = distance(target[:2], centre[:2])
        success = (radius < 0.02) & (target[2] > centre[2])
        neck = jnp.where(success, 0.02, 0.01)
        over_peg = target.at[2].set(funnel(radius, neck, 0.02, 0.2))
        weight = jnp.array([1.0, 1.0, 3.0])
        lifted = (centre[2] > 0.02) | (radius < neck)
        in_place = 0.1 * lifted + 0.9 * near(distance(over_peg * weight, centre * weight), 0.02, 0.4)
        reward = (2 * _grasp(at, began, high_density=False) + 6 * in_place) * _flat(at)
        return jnp.where(success, 10.0, reward), success


@dataclasses.dataclass(frozen=True)
class Disassemble(Sawyer):
    """Take a round nut off a peg (Meta-World's disassemble-v3).

    Reward: with the nut's centre c, its distance d from the point 0.1 m above the goal, and its orientation q,
            r = 10  (success)
            r = (2 C + 6 p) max(1 - |q - (0.707, 0, 0, 0.707)| / 0.4, 0)  (else)
            p = 0.1 u + 0.9 near(d, 0.02, 0.2),  u = 1 if c_z > 0.02, else 0
        The last factor is 1 for a nut that lies flat. C is that of the handle, dense with O = 0.015, P = 0.02 and X =
        0.01, where o_0 is the nut's; within 0.01 m along x the handle is taken to be where the hand is.
    Success: the handle is higher than the goal.

    The goal is 0.15 m above the nut's start; the place that is drawn for it is not used.
    """

    scene_file: ClassVar[str] = "sawyer_assembly_peg"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((0.0, 0.6, 0.025, -0.1, 0.6, 0.1699), (0.1, 0.75, 0.02501, 0.1, 0.75, 0.1701))
    goal_box: ClassVar = ((-0.1, 0.6, 0.1749), (0.1, 0.75, 0.1751))
    watched: ClassVar = Assembly.watched
    apart: ClassVar[float] = 0.1

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        nut = vec[:3]
        host.move("peg", nut + np.array([0.0, 0.0, 0.03]))
        host.place_free(nut)
        return {"target": nut + np.array([0.0, 0.0, 0.15]), "obj_init": nut}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["handle"], at.quat["nut"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        centre, target = at.position["centre"], began["target"]
        left = distance(target + jnp.array([0.0, 0.0, 0.1]), centre)
        in_place = 0.1 * (centre[2] > 0.02) + 0.9 * near(left, 0.02, 0.2)
        success = at.obs[6] > target[2]
        reward = (2 * _grasp(at, began, high_density=True) + 6 * in_place) * _flat(at)
        return jnp.where(success, 10.0, reward), success
