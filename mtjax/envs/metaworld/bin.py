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

    Reward: 10 on success; else the product of the caging reward and a long tail of the cube's way to the goal; once the
        cube is lifted in the gripper, 1 and 5 times the product of that tail and of how well the hand stays above two
        funnels, about the cube's start and about the goal.
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
