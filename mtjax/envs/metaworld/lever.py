"""The lever of Meta-World."""

import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import distance, hamacher, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_LENGTH = 0.2  # [m] of the lever
_LEVER = 9  # in qpos
_GRIP = (
    0.6625,
    0.6625,
    -0.24717,
    0.24717,
)  # orientation (w, x, y, z) in the lever of the mesh that Meta-World observes


@dataclasses.dataclass(frozen=True)
class LeverPull(Sawyer):
    """Lever pull: push the lever up from below until it stands upright.

    Reward: with the lever's end o, its distance d from the target, the hand h, and the way v = (0, 0.055, 0.07) from
        there to its shoulder,
            r = 10 H(near(|w (h + v - o)|, 0.02, |w (t_0 + v - o_0)|), near(d, 0.04, d_0))
        where w = (4, 1, 4).
    Success: the lever stands within 7.5 degrees of upright.
    Start: the lever at the drawn place, pointing to the robot.

    The observed orientation is that of a mesh of the handle, in MuJoCo's frame of it. The handle is nearly a sphere,
    so that this frame differs between MuJoCo's versions; here it is that of Meta-World's own, 3.3.0.
    """

    scene_file: ClassVar[str] = "sawyer_lever_pull"
    hand_low: ClassVar = (-0.5, 0.4, -0.15)
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.7, 0.0), (0.1, 0.8, 0.0))
    goal_box: ClassVar = (hand_low, Sawyer.hand_high)
    watched: ClassVar = {"end": "site:leverStart"}

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        host.move("lever", vec)
        end = vec + np.array([0.12, -_LENGTH, 0.25])
        return {"target": vec + np.array([0.12, 0.0, 0.25 + _LENGTH]), "lever_pos_init": end, "obj_init": vec}

    def objects(self, at: Observables) -> tuple[Array, ...]:
        cos, sin = jnp.cos(at.qpos[_LEVER] / 2), jnp.sin(at.qpos[_LEVER] / 2)
        w, x, y, z = _GRIP
        turned = jnp.stack([cos * w - sin * x, cos * x + sin * w, cos * y - sin * z, cos * z + sin * y])
        return at.position["end"], scalar_last(turned)

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        end, start, target = at.obs[4:7], began["lever_pos_init"], began["target"]
        scale, to_shoulder = jnp.array([4.0, 1.0, 4.0]), jnp.array([0.0, 0.055, 0.07])
        below = jnp.linalg.norm((at.obs[:3] + to_shoulder - end) * scale)
        ready = near(below, 0.02, jnp.linalg.norm((began["init_tcp"] + to_shoulder - start) * scale))
        in_place = near(distance(end, target), 0.04, distance(start, target))
        return 10 * hamacher(ready, in_place), abs(-at.qpos[_LEVER] - math.pi / 2) <= math.pi / 24
