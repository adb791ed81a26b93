"""Meta-World's reaching tasks."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.push import show_puck
from mtjax.envs.metaworld.rewards import distance, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array


def _place(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    host.place_free(vec[:3])
    return {"target": vec[3:]}


def _reach(self: Sawyer, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
    away = distance(at.tcp, began["target"])
    margin = distance(jnp.array(self.hand_start), began["target"])
    return 10 * near(away, 0.05, margin), away <= 0.05


@dataclasses.dataclass(frozen=True)
class Reach(Sawyer):
    """Reach: bring the gripper to a point in the air (Meta-World's reach-v3).

    Reward: with the goal g, and h_0 where the hand begins,
            r = 10 near(|t - g|, 0.05, |h_0 - g|)
    Success: the tool centre is within 0.05 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_reach_v3"
    drawn: ClassVar = ((-0.1, 0.6, 0.02, -0.1, 0.8, 0.05), (0.1, 0.7, 0.02, 0.1, 0.9, 0.3))
    watched: ClassVar = {"puck": "body:obj"}
    apart: ClassVar[float] = 0.15
    arrange, objects, evaluate = _place, show_puck, _reach


@dataclasses.dataclass(frozen=True)
class ReachWall(Sawyer):
    """Reach over a wall: bring the gripper to a point behind a wall (Meta-World's reach-wall-v3).

    Reward: with the goal g, and h_0 where the hand begins,
            r = 10 near(|t - g|, 0.05, |h_0 - g|)
    Success: the tool centre is within 0.05 m of the goal.
    """

    scene_file: ClassVar[str] = "sawyer_reach_wall_v3"
    drawn: ClassVar = ((-0.05, 0.6, 0.015, -0.05, 0.85, 0.05), (0.05, 0.65, 0.015, 0.05, 0.9, 0.3))
    watched: ClassVar = Reach.watched
    apart: ClassVar[float] = 0.15
    arrange, objects, evaluate = _place, show_puck, _reach
