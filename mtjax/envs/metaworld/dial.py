"""Meta-World's dial, to turn."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import distance, effort, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_HINGE = 9  # the place of the dial's joint in qpos
_RADIUS = 0.05  # [m] of the dial
_PUSH = (0.05, 0.02, 0.09)  # from the dial's mark to where it should be pushed


@dataclasses.dataclass(frozen=True)
class DialTurn(Sawyer):
    """Turn a dial until its mark points away from the robot (Meta-World's dial-turn-v3).

    Reward: with the distance d of the dial's mark from the goal, the place a where it should be pushed, which moves
        with the mark, and g the goal,
            r = 10 H(H(A, clip(f, 0, 1)), p)
            A = gauss(|a - t|, 0.005, ||a_0 - t_0| - 0.005|)
            p = near(d, 0.07, ||a_0 - g| - 0.07|)
    Success: the mark is within 0.07 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_dial"
    drawn: ClassVar = ((-0.1, 0.7, 0.0), (0.1, 0.8, 0.0))
    goal_box: ClassVar = ((-0.1, 0.73, 0.0299), (0.1, 0.83, 0.0301))
    watched: ClassVar = {"dial": "body:dial"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("dial", vec)
        angle = host.data.qpos[_HINGE]
        mark = host.body("dial") + _RADIUS * np.array([np.sin(angle), -np.cos(angle), 0.0])
        return {"target": vec + np.array([0.0, 0.03, 0.03]), "dial_push_position": mark + _PUSH}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        angle = at.qpos[_HINGE]
        mark = _RADIUS * jnp.stack([jnp.sin(angle), -jnp.cos(angle), jnp.float32(0)])
        return at.position["dial"] + mark, at.quat["dial"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        mark, target, push = at.obs[4:7], began["target"], began["dial_push_position"]
        left = distance(mark, target)
        in_place = near(left, 0.07, jnp.abs(distance(push, target) - 0.07))
        margin = jnp.abs(distance(push, began["init_tcp"]) - 0.005)
        there = tolerance(distance(mark + jnp.array(_PUSH), at.tcp), 0.0, 0.005, margin)
        return 10 * hamacher(hamacher(there, effort(at)), in_place), left <= 0.07
