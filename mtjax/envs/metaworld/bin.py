"""Meta-World's two bins, with a cube in one of them."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.metaworld.funnels import above, funnel
from mtjax.envs.metaworld.host import SUBSTEPS, Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import caging, distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array


@dataclasses.dataclass(frozen=True)
class BinPicking(Sawyer):
    """Carry a cube from one bin into another (Meta-World's bin-picking-v3).

    Reward: with the cube's distance d from the goal, which is m after the first step of an episode, the hand h, and its
        distances rho_1 and rho_2 along x and y from the cube's start and from the goal,
            r = 10  (d below 0.05)
            r = H(C, p) + 1 + 5 H(A, p)  (held and lifted)
            r = H(C, p)  (else)
            p = near(d, 0.05, m),  A = near(max(min(F_1, F_2) - h_z, 0), 0.01, 0.05)
            F_i = funnel(rho_i, 0.03, 0.02, 0.2)
        The cube is held with the hand within 0.04 m and the gripper open by 0.43 at least, and lifted by 0.02 m. C is
        dense with O = 0.015, P = 0.05, X = 0.01 and E = 0.7.
    Success: the cube is within 0.05 m of the goal.

    The goal never moves. The tail's margin is the cube's way after the first step of an episode.
    """

    scene_file: ClassVar[str] = "sawyer_bin_picking"
    hand_low: ClassVar = (-0.5, 0.4, 0.07)
    drawn: ClassVar = ((-0.21, 0.65, 0.02, 0.1199, 0.699, -0.001), (-0.03, 0.75, 0.02, 0.1201, 0.701, 0.001))
    watched: ClassVar = {"cube": "body:obj"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, Any]:
        cube, target = np.append(vec[:2], host.body("obj")[2]), host.body("bin_goal")
        host.place_free(cube)
        later = host.copy()
        mujoco.mj_step(later.model, later.data, SUBSTEPS)
        later.forward()
        way = np.linalg.norm(later.body("obj") - target)
        return {"target": target, "obj_init": cube, "target_to_obj_init": way}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return at.position["cube"], at.quat["cube"]

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        hand, cube, start, target = at.obs[:3], at.obs[4:7], began["obj_init"], began["target"]
        left = distance(cube, target)
        in_place = near(left, 0.05, began["target_to_obj_init"])
        floors = [funnel(distance(hand[:2], place[:2]), 0.03, 0.02, 0.2) for place in (start, target)]
        grasped = caging(
            at,
            began,
            cube,
            obj_radius=0.015,
            pad_success_thresh=0.05,
            xz_thresh=0.01,
            desired_gripper_effort=0.7,
            high_density=True,
        )
        held = (distance(cube, hand) < 0.04) & (cube[2] - 0.02 > start[2]) & (at.obs[3] >= 0.43)
        carried = 1 + 5 * hamacher(above(hand[2], jnp.minimum(*floors), 0.05), in_place)
        reward = hamacher(grasped, in_place) + jnp.where(held, carried, 0.0)
        return jnp.where(left < 0.05, 10.0, reward), left <= 0.05
