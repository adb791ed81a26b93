"""Meta-World's box, to close with its lid."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.metaworld.funnels import above, funnel
from mtjax.envs.metaworld.host import SUBSTEPS, Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array


@dataclasses.dataclass(frozen=True)
class BoxClose(Sawyer):
    """Put the lid on an open box (Meta-World's box-close-v3).

    Reward: with the hand h, a point c 0.02 m above the lid's place, the lid's orientation q, the distance d of c from
        the goal, where z counts three times, and rho, that of h from c along x and y,
            r = 10 U  (success)
            r = (2 H((f + 1) / 2, A) + 8 p) U  (else)
            p = 0.2 u + 0.8 near(d, 0.05, 0.25),  u = 1 if c_z > 0.04, else 0
            A = H(near(max(F - h_z, 0), 0.01, F / 2), near(|h - c|, 0.02, 0.5))
            F = funnel(rho, 0.02, 0.04, 0.4),  U = max(1 - |q - (0.707, 0, 0, 0.707)| / 0.2, 0)
        p tells how well the lid is lifted to the box, A how well the hand comes to it, and U how upright it is.
    Success: the lid is within 0.08 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_box"
    drawn: ClassVar = ((-0.05, 0.5, 0.02, -0.1, 0.7, 0.133), (0.05, 0.55, 0.02, 0.1, 0.8, 0.133))
    watched: ClassVar = {"lid": "body:top_link"}
    apart: ClassVar[float] = 0.25

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        lid, target = np.append(vec[:2], 0.02), vec[3:]
        host.move("boxbody", np.append(target[:2], host.body("boxbody")[2]))
        mujoco.mj_step(host.model, host.data, SUBSTEPS)
        host.place_free(lid)
        return {"target": target}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["lid"], at.quat["lid"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        hand, lid, target = at.obs[:3], at.obs[4:7] + jnp.array([0.0, 0.0, 0.02]), began["target"]
        floor = funnel(distance(hand[:2], lid[:2]), 0.02, 0.04, 0.4)
        ready = hamacher(above(hand[2], floor, floor / 2), near(distance(hand, lid), 0.02, 0.5))
        weight = jnp.array([1.0, 1.0, 3.0])
        lifted = 0.2 * (lid[2] > 0.04) + 0.8 * near(distance(target * weight, lid * weight), 0.05, 0.25)
        success = distance(at.obs[4:7], target) < 0.08
        reward = jnp.where(success, 10.0, 2 * hamacher((at.action[3] + 1) / 2, ready) + 8 * lifted)
        upright = jnp.maximum(1 - distance(at.obs[7:11], jnp.array([0.707, 0.0, 0.0, 0.707])) / 0.2, 0.0)
        return reward * upright, success
