"""Meta-World's door, to pull open and to push shut by its handle."""

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.metaworld.funnels import above, funnel
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_HINGE = 9  # the place of the door's joint in qpos and qvel
_NECK = 0.12  # [m] of the funnel about the handle
_WIDE_OPEN = math.pi / 2 + math.pi / 6


def _arrange(host: Host, vec: np.ndarray, angle: float, goal: tuple[float, ...]) -> dict[str, np.ndarray]:
    """Put the door at ``vec``, open by ``angle`` [rad], with the goal for its handle ``goal`` from there."""
    host.move("door", vec)
    host.data.qpos[_HINGE], host.data.qvel[_HINGE] = angle, 0
    host.forward()
    return {"target": vec + goal, "obj_init": vec}


@dataclasses.dataclass(frozen=True)
class DoorOpen(Sawyer):
    """Open a door: pull it by its handle (Meta-World's door-open-v3).

    Reward: with the door's angle phi, which is 0 closed and negative open, the handle o, the hand h, and rho, the
        distance along x and y of h from a point 0.05 m to the left of the handle,
            r = 10  (success)
            r = 2 H(A, (f + 1) / 2) + 8 p  (else)
            p = 0.2 u + 0.8 near(phi + 2 pi / 3, 0.5, pi / 3),  u = 1 if phi < -pi / 90, else 0
            A = H(near(max(F - h_z, 0), 0.01, F / 2), near(|h - o - (0, 0.03, -0.01)|, 0.06, 0.5))
            F = funnel(rho, 0.12, 0.04, 0.4)
        p tells how far the door is open, and A how well the hand comes to the handle.
    Success: along x, the handle is within 0.08 m of the goal.

    The observation has the handle's orientation as x, y, z, w.
    """

    scene_file: ClassVar[str] = "sawyer_door_pull"
    drawn: ClassVar = ((0.0, 0.85, 0.15), (0.1, 0.95, 0.15))
    goal_box: ClassVar = ((-0.3, 0.4, 0.1499), (-0.2, 0.5, 0.1501))
    watched: ClassVar = {"handle": "geom:handle"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec, 0.0, (-0.3, -0.45, 0.0))

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["handle"], scalar_last(at.quat["handle"])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        hand, door, angle = at.obs[:3], at.obs[4:7] + jnp.array([-0.05, 0.0, 0.0]), at.qpos[_HINGE]
        floor = funnel(distance(hand[:2], door[:2]), _NECK, 0.04, 0.4)
        behind_handle = near(distance(hand, door + jnp.array([0.05, 0.03, -0.01])), _NECK / 2, 0.5)
        ready = hamacher(above(hand[2], floor, floor / 2), behind_handle)
        opened = 0.2 * (angle < -math.pi / 90) + 0.8 * near(_WIDE_OPEN + angle, 0.5, math.pi / 3)
        success = jnp.abs(at.obs[4] - began["target"][0]) <= 0.08
        return jnp.where(success, 10.0, 2 * hamacher(ready, (at.action[3] + 1) / 2) + 8 * opened), success


@dataclasses.dataclass(frozen=True)
class DoorClose(Sawyer):
    """Close a door that is wide open (Meta-World's door-close-v3).

    Reward: with the handle o, the goal g, o_0 the door's drawn place, and h_0 where the hand begins,
            r = 10  (|o - g| below 0.05)
            r = 3 gauss(|t - g|, 0.0125, |h_0 - o| + 0.1) + 6 gauss(|o - g|, 0.05, |o_0 - g|)  (else)
    Success: the handle is within 0.08 m of the goal.

    The observation has the handle's orientation as x, y, z, w.
    """

    scene_file: ClassVar[str] = "sawyer_door_pull"
    hand_start: ClassVar = (-0.5, 0.6, 0.2)
    drawn: ClassVar = DoorOpen.drawn
    goal_box: ClassVar = ((0.2, 0.65, 0.1499), (0.3, 0.75, 0.1501))
    watched: ClassVar = DoorOpen.watched

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec, -1.5708, (0.2, -0.2, 0.0))

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["handle"], scalar_last(at.quat["handle"])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        handle, target = at.obs[4:7], began["target"]
        left = distance(handle, target)
        in_place = tolerance(left, 0.0, 0.05, distance(began["obj_init"], target))
        margin = distance(jnp.array(self.hand_start), handle) + 0.1
        hand_in_place = tolerance(distance(at.tcp, target), 0.0, 0.05 / 4, margin)
        return jnp.where(left < 0.05, 10.0, 3 * hand_in_place + 6 * in_place), left <= 0.08
