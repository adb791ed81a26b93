"""The football of Meta-World."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import distance, near, pads_caging
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.07  # [m] of the target


@dataclasses.dataclass(frozen=True)
class Soccer(Sawyer):
    """Soccer: push the ball into the goal.

    Reward: with the ball o = (x, y, z), its distance d from the target g, and a from its own start, where x counts
        three times in both,
            r = 10  (d below 0.07)
            r = 3 C + 6.5 clip(p - 2 (y - l) / (1 - l), 0, 1)  (y above l, |x - g_x| above 0.1: it passes beside)
            r = 3 C + 6.5 p  (else)
            p = near(d, 0.07, a),  l = g_y - 0.1
        C is pinching with O = 0.013, W = 0.01 and X = 0.005.
    Success: the ball is within 0.07 m of the target, all axes counted once.
    Start: the ball at the drawn x and y, the goal at the drawn target.

    The margin for the ball is how far the ball is from its start now, so that it grows as the ball rolls.
    """

    scene_file: ClassVar[str] = "sawyer_soccer"
    drawn: ClassVar = ((-0.1, 0.6, 0.03, -0.1, 0.8, 0.0), (0.1, 0.7, 0.03, 0.1, 0.9, 0.0))
    watched: ClassVar = {"ball": "body:soccer_ball"}
    apart: ClassVar[float] = 0.15

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        ball = np.array([*vec[:2], 0.03])
        host.move("goal_whole", vec[3:])
        host.place_free(ball)
        return {"target": vec[3:], "obj_init": ball}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["ball"], scalar_last(at.quat["ball"])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        ball, target = at.obs[4:7], began["target"]
        scale = jnp.array([3.0, 1.0, 1.0])
        away = jnp.linalg.norm((ball - target) * scale)
        in_place = near(away, _RADIUS, jnp.linalg.norm((ball - began["obj_init"]) * scale))
        line = target[1] - 0.1
        beside = (ball[1] > line) & (abs(ball[0] - target[0]) > 0.1)
        missed = jnp.clip(in_place - 2 * (ball[1] - line) / (1 - line), 0.0, 1.0)
        in_place = jnp.where(beside, missed, in_place)
        reward = 3 * pads_caging(at, began, ball, obj_radius=0.013, grip_margin=0.01, xz_thresh=0.005) + 6.5 * in_place
        return jnp.where(away < _RADIUS, 10.0, reward), distance(ball, target) <= 0.07
