"""Meta-World's lock of a door, to turn down and to turn up."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.metaworld.host import SUBSTEPS, Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_HINGE = 9  # the place of the lock's joint in qpos and qvel
_LENGTH = 0.1  # [m] of the lock
_WEIGHT = (0.25, 1.0, 0.5)  # of a way to the lock in x, y and z


@dataclasses.dataclass(frozen=True)
class DoorLock(Sawyer):
    """Lock a door: turn its lock down (Meta-World's door-lock-v3).

    Reward: with the distance d of the lock from the goal along z, and a from the lock to the left pad, where x counts a
        quarter and z half,
            r = 2 H(e, near(a, 0.01, a)) + 8 near(d, 0.005, 0.1)
        The margin a is meant to be the distance at the start; it is that of now, as Meta-World keeps a view of the
        pad's place, so that only the last cm count.
    Success: along z, the lock is within 0.02 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_door_lock"
    hand_low: ClassVar = (-0.5, 0.4, -0.15)
    drawn: ClassVar = ((-0.1, 0.8, 0.15), (0.1, 0.85, 0.15))
    goal_box: ClassVar = (hand_low, Sawyer.hand_high)
    watched: ClassVar = {
        "lock": "site:lockStartLock",
        "unlock": "site:lockStartUnlock",
        "door": "body:door_link",
    }

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("door", vec)
        mujoco.mj_step(host.model, host.data, SUBSTEPS)
        return {"target": host.body("lock_link") + np.array([0.0, -0.04, -0.1])}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["lock"], at.quat["door"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        lock, weight = at.obs[4:7], jnp.array(_WEIGHT)
        away, left = distance(lock * weight, at.left_pad * weight), jnp.abs(began["target"][2] - lock[2])
        near_lock = near(away, 0.01, away)
        return 2 * hamacher(jnp.maximum(at.obs[3], 0.0), near_lock) + 8 * near(left, 0.005, _LENGTH), left <= 0.02


@dataclasses.dataclass(frozen=True)
class DoorUnlock(Sawyer):
    """Unlock a door: push its lock up and aside (Meta-World's door-unlock-v3).

    Reward: with the lock o, its distance d from the goal along x, the hand h, and the way v = (0, 0.055, 0.07) from
        there to its shoulder,
            r = 2 near(|w (h + v - o)|, 0.02, |w (t_0 + v - o_0)|) + 8 near(d, 0.005, 0.1)
        where w = (0.25, 1, 0.5).
    Success: along x, the lock is within 0.02 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_door_lock"
    hand_low: ClassVar = DoorLock.hand_low
    drawn: ClassVar = DoorLock.drawn
    goal_box: ClassVar = ((0.0, 0.64, 0.21), (0.2, 0.7, 0.2111))
    watched: ClassVar = DoorLock.watched

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("door", vec)
        host.data.qpos[_HINGE], host.data.qvel[_HINGE] = 1.5708, 0
        host.forward()
        start = host.body("lock_link")
        return {"target": start + np.array([0.1, -0.04, 0.0]), "obj_init": start}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["unlock"], at.quat["door"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        lock, weight, shoulder = at.obs[4:7], jnp.array(_WEIGHT), jnp.array([0.0, 0.055, 0.07])
        margin = distance((began["init_tcp"] + shoulder) * weight, began["obj_init"] * weight)
        ready = near(distance((at.obs[:3] + shoulder) * weight, lock * weight), 0.02, margin)
        left = jnp.abs(began["target"][0] - lock[0])
        return 2 * ready + 8 * near(left, 0.005, _LENGTH), left <= 0.02
