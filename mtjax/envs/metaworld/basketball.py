"""Meta-World's basketball, to drop into a basket."""

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


@dataclasses.dataclass(frozen=True)
class Basketball(Sawyer):
    """Bring a ball to just above a hoop (Meta-World's basketball-v3).

    Reward: with the distance d of the ball from a point above the hoop at a height of 0.3 m, where z counts twice,
            r = 10  (d below 0.08)
            r = 1 + 6 p  (held and lifted)
            r = H(C, p)  (else)
            p = near(d, 0.08, d_0)
        It is held with the tool centre within 0.035 m and the fingers apart, and lifted by 0.01 m. C is dense with O =
        0.025, P = 0.06 and X = 0.005.
    Success: the ball is within 0.08 m of that point, where z counts twice.
    """

    scene_file: ClassVar[str] = "sawyer_basketball"
    drawn: ClassVar = ((-0.1, 0.6, 0.0299, -0.1, 0.85, 0.0), (0.1, 0.7, 0.0301, 0.1, 0.9 + 1e-7, 0.0))
    goal_box: ClassVar = ((-0.1, 0.85 - 0.083, 0.2499), (0.1, 0.9 + 1e-7 - 0.083, 0.2501))
    watched: ClassVar = {"ball": "body:bsktball"}
    apart: ClassVar[float] = 0.15

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        ball = np.append(vec[:2], 0.03)
        host.move("basket_goal", vec[3:])
        host.place_free(ball)
        return {"target": host.site("goal"), "obj_init": ball}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["ball"], at.quat["ball"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        ball, start, weight = at.obs[4:7], began["obj_init"], jnp.array([1.0, 1.0, 2.0])
        target = began["target"].at[2].set(0.3)
        left = distance(ball * weight, target * weight)
        in_place = near(left, 0.08, distance(start * weight, target * weight))
        caged = caging(at, began, ball, obj_radius=0.025, pad_success_thresh=0.06, xz_thresh=0.005, high_density=True)
        held = in_hand(at, ball, 0.035) & (ball[2] - 0.01 > start[2])
        reward = hamacher(jnp.where(held, 1.0, caged), in_place) + jnp.where(held, 1 + 5 * in_place, 0.0)
        return jnp.where(left < 0.08, 10.0, reward), left <= 0.08
