"""The hammer of Meta-World."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import caging, distance, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_NAIL = 16  # in qpos, after the free hammer


@dataclasses.dataclass(frozen=True)
class Hammer(Sawyer):
    """Hammer: pick up the hammer and drive the nail into the block.

    Reward: with the place c of the hammer's head, its distance d from the nail's final place, and the hammer's
        orientation q,
            r = 10  (success, and the next line above 5)
            r = (2 C + 6 p) max(1 - |q - (1, 0, 0, 0)| / 0.4, 0)  (else)
            p = 0.1 u + 0.9 near(d, 0.02, 0.2),  u = 1 if c_z > 0.02, else 0
        The last factor is 1 for a hammer that lies level. C is that of the handle, dense with O = 0.015, P = 0.02 and X
        = 0.01.
    Success: the nail is in by more than 0.09 m.
    Start: the hammer at the drawn place, the block always at the same one.

    The handle is caged at the hand's x wherever the hand is within 0.07 m of its middle.
    """

    scene_file: ClassVar[str] = "sawyer_hammer"
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.4, 0.0), (0.1, 0.5, 0.0))
    goal_box: ClassVar = ((0.2399, 0.7399, 0.109), (0.2401, 0.7401, 0.111))
    watched: ClassVar = {"hammer": "body:hammer", "nail": "body:nail_link"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.place_free(vec)
        return {"target": host.site("goal"), "obj_init": vec}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["hammer"], at.quat["hammer"], at.position["nail"], at.quat["nail"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        hand, hammer = at.obs[:3], at.obs[4:7]
        level = jnp.maximum(1 - jnp.linalg.norm(at.obs[7:11] - jnp.array([1.0, 0.0, 0.0, 0.0])) / 0.4, 0.0)
        handle = hammer.at[0].set(jnp.where(abs(hammer[0] - hand[0]) < 0.07, hand[0], hammer[0]))
        caged = caging(at, began, handle, obj_radius=0.015, pad_success_thresh=0.02, xz_thresh=0.01, high_density=True)
        head = hammer + jnp.array([0.16, 0.06, 0.0])
        in_place = 0.1 * (head[2] > 0.02) + 0.9 * near(distance(began["target"], head), 0.02, 0.2)
        reward = (2 * caged + 6 * in_place) * level
        success = at.qpos[_NAIL] > 0.09
        return jnp.where(success & (reward > 5), 10.0, reward), success
