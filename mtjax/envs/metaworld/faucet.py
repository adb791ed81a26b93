"""Faucets of Meta-World: a handle that turns about an upright axis."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables
from mtjax.envs.metaworld.rewards import distance, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.07  # [m] of the target


def _place(self: Sawyer, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
    host.move("faucetBase", vec)
    return {"target": vec + self.to_target, "obj_init": vec}


def _show(self: Sawyer, at: Observables) -> tuple[Array, ...]:
    return at.position[self.handle] - jnp.array([0.0, 0.0, 0.01]), at.quat["base"]


def _turn(self: Sawyer, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
    end, target = at.obs[4:7] + jnp.array(self.to_end), began["target"]
    away = distance(end, target)
    in_place = near(away, _RADIUS, abs(distance(began["obj_init"], target) - _RADIUS))
    margin = abs(distance(began["obj_init"], began["init_tcp"]) - 0.01)
    reach = tolerance(distance(end, at.tcp), 0.0, 0.01, margin)
    success = away <= _RADIUS
    return jnp.where(success, 10.0, 4 * reach + 6 * in_place), success


@dataclasses.dataclass(frozen=True)
class FaucetOpen(Sawyer):
    """Faucet open: turn the faucet's handle from the front to the right.

    Reward: with the handle's end o, its distance d from the target, and for o_0 and d_0 the faucet's drawn place,
            r = 10  (success)
            r = 4 gauss(|o - t|, 0.01, ||o_0 - t_0| - 0.01|) + 6 near(d, 0.07, |d_0 - 0.07|)  (else)
    Success: the handle's end is within 0.07 m of the target.
    Start: the faucet at the drawn place, its handle pointing to the robot.

    The handle's end is taken 0.04 m to the left and 0.03 m above where the observation shows it.
    """

    scene_file: ClassVar[str] = "sawyer_faucet"
    hand_low: ClassVar = (-0.5, 0.4, -0.15)
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.05, 0.8, 0.0), (0.05, 0.85, 0.0))
    goal_box: ClassVar = (hand_low, Sawyer.hand_high)
    watched: ClassVar = {
        "opens": "site:handleStartOpen",
        "closes": "site:handleStartClose",
        "base": "body:faucetBase",
    }
    handle: ClassVar[str] = "opens"  # the thing watched that the hand turns
    to_target: ClassVar = (0.175, 0.0, 0.125)  # [m] from the faucet
    to_end: ClassVar = (-0.04, 0.0, 0.03)  # [m] from the handle in the observation
    arrange, objects, evaluate = _place, _show, _turn


@dataclasses.dataclass(frozen=True)
class FaucetClose(Sawyer):
    """Faucet close: turn the faucet's handle from the front to the left.

    Reward: with the handle's end o, its distance d from the target, and for o_0 and d_0 the faucet's drawn place,
            r = 10  (success)
            r = 4 gauss(|o - t|, 0.01, ||o_0 - t_0| - 0.01|) + 6 near(d, 0.07, |d_0 - 0.07|)  (else)
    Success: the handle's end, which is where the observation shows it, is within 0.07 m of the target.
    Start: the faucet at the drawn place, its handle pointing to the robot.
    """

    scene_file: ClassVar[str] = "sawyer_faucet"
    hand_low: ClassVar = FaucetOpen.hand_low
    hand_start: ClassVar = (0.0, 0.4, 0.2)
    drawn: ClassVar = ((-0.1, 0.8, 0.0), (0.1, 0.85, 0.0))
    goal_box: ClassVar = FaucetOpen.goal_box
    watched: ClassVar = FaucetOpen.watched
    handle: ClassVar[str] = "closes"
    to_target: ClassVar = (-0.175, 0.0, 0.125)
    to_end: ClassVar = (0.0, 0.0, 0.0)
    arrange, objects, evaluate = _place, _show, _turn
