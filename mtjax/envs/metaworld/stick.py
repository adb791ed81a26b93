"""Tasks of Meta-World with a stick and a thermos flask."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, scalar_last
from mtjax.envs.metaworld.rewards import caging, distance, hamacher, in_hand, near
from mtjax.envs.metaworld.sawyer import Sawyer
from mtjax.types import Array

_RADIUS = 0.12  # [m] of both targets for the flask


def _arrange(host: Host, vec: np.ndarray, height: float, flask_at: tuple[float, float]) -> dict[str, np.ndarray]:
    """Put the stick at its drawn place, and the flask ``flask_at`` (2,) [m] from its place in the scene.

    Args:
        height: [m] of the target.
    """
    stick = np.array([*vec[:2], 0.02])
    host.data.qpos[16:18], host.data.qvel[16:18] = flask_at, 0
    host.place_free(stick)
    return {"target": np.array([*vec[3:5], height]), "stick_init_pos": stick, "obj_init": host.body("object")}


def _show(at: Observables, flask: Array) -> tuple[Array, ...]:
    """Return the stick's place and orientation, and the place (3,) that stands for the flask."""
    return at.position["stick"], scalar_last(at.quat["stick"]), flask, jnp.zeros(4)


@dataclasses.dataclass(frozen=True)
class StickPush(Sawyer):
    """Stick push: pick up the stick and push the flask with it.

    Reward: with the distances from the target, s of the stick 0.015 m to its right, and d of the flask,
            r = 10  (held and lifted, d at most 0.12)
            r = 2 + 5 near(s, 0.12, s_0 - 0.12) + 3 near(d, 0.12, d_0 - 0.12)  (held and lifted)
            r = C  (else)
        The stick is held with the tool centre within 0.02 m and the fingers apart, and lifted by 0.01 m. C is that of
        the stick, dense with O = 0.04, P = 0.05 and X = 0.01.
    Success: the flask is within 0.12 m of the target while the stick is lifted by 0.01 m and both pads press on it.
    Start: the stick at the drawn x and y, the flask always at the same place; the target at the drawn x and y, at the
        height of the flask's handle.

    Forces on the pads are those of the last substep. Meta-World computes them once more, of the state after it.
    """

    scene_file: ClassVar[str] = "sawyer_stick_obj"
    drawn: ClassVar = ((-0.08, 0.58, 0.0, 0.399, 0.55, 0.1319), (-0.03, 0.62, 0.001, 0.401, 0.6, 0.1321))
    watched: ClassVar = {"stick": "body:stick", "handle": "site:insertion", "end": "site:stick_end"}
    pressed: ClassVar[str] = "objGeom"
    apart: ClassVar[float] = 0.1

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec, host.site("insertion")[2], (0.0, 0.0))

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return _show(at, at.position["handle"] + jnp.array([0.0, 0.09, 0.0]))

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        stick, flask, target = at.obs[4:7] + jnp.array([0.015, 0.0, 0.0]), at.obs[11:14], began["target"]
        away = distance(flask, target)
        stick_in_place = near(distance(stick, target), _RADIUS, distance(began["stick_init_pos"], target) - _RADIUS)
        flask_in_place = near(away, _RADIUS, distance(began["obj_init"], target) - _RADIUS)
        caged = caging(
            at,
            began,
            stick,
            obj_radius=0.04,
            pad_success_thresh=0.05,
            xz_thresh=0.01,
            high_density=True,
            obj_init=began["stick_init_pos"],
        )
        lifted = (at.obs[3] > 0) & (stick[2] - 0.01 > began["stick_init_pos"][2])
        reward = jnp.where(away <= _RADIUS, 10.0, 2 + 5 * stick_in_place + 3 * flask_in_place)
        reward = jnp.where(lifted & (distance(stick, at.tcp) < 0.02), reward, caged)
        pressed = True if at.press is None else jnp.all(at.press != 0)
        return reward, lifted & (away <= _RADIUS) & pressed


@dataclasses.dataclass(frozen=True)
class StickPull(Sawyer):
    """Stick pull: pick up the stick, put it through the flask's handle and pull the flask with it.

    Reward: with the flask's handle c, the flask o taken 0.05 m to the right of it, the stick s, and the target g,
            r = 10  (held, lifted and through the handle, with c within 0.12 of the target)
            r = 6 + p + 2 near(|s - g|, 0.05, |s_0 - g|) + near(|o - g|, 0.05, |o_0 - g|)  (held, lifted and through)
            r = 1 + 6 p  (held and lifted)
            r = H(C, p)  (else)
            p = near(|w (s - o)|, 0.05, |w (s_0 - o_0 - (0.05, 0, 0))|)
        where w = (1, 1, 2). The stick is held with the tool centre within 0.02 m and the fingers apart, and lifted by
        0.01 m; it is through the handle with its end to the right of it, within 0.04 m along y and 0.06 m along z. C is
        that of the stick, dense with O = 0.014, P = 0.05 and X = 0.01.
    Success: the handle is within 0.12 m of the target, and the stick through it.
    Start: the stick at the drawn x and y, the flask always at the same place; the target at the drawn x and y.

    The caging takes the flask's place at the start for that of the stick.
    """

    scene_file: ClassVar[str] = "sawyer_stick_obj"
    hand_low: ClassVar = (-0.5, 0.35, 0.05)
    drawn: ClassVar = ((-0.1, 0.55, 0.0, 0.35, 0.45, 0.0199), (0.0, 0.65, 0.001, 0.45, 0.55, 0.0201))
    watched: ClassVar = StickPush.watched
    pressed: ClassVar[str] = "objGeom"
    apart: ClassVar[float] = 0.1

    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, np.ndarray]:
        return _arrange(host, vec, 0.02, (0.0, 0.09))

    def objects(self, at: Observables) -> tuple[Array, ...]:
        return _show(at, at.position["handle"])

    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        stick, handle, target = at.obs[4:7], at.obs[11:14], began["target"]
        to_flask, scale = jnp.array([0.05, 0.0, 0.0]), jnp.array([1.0, 1.0, 2.0])
        flask, flask_init, stick_init = handle + to_flask, began["obj_init"], began["stick_init_pos"]
        margin = jnp.linalg.norm((stick_init - flask_init - to_flask) * scale)
        at_flask = near(jnp.linalg.norm((stick - flask) * scale), 0.05, margin)
        stick_in_place = near(distance(stick, target), 0.05, distance(stick_init, target))
        flask_in_place = near(distance(flask, target), 0.05, distance(flask_init, target))
        caged = caging(at, began, stick, obj_radius=0.014, pad_success_thresh=0.05, xz_thresh=0.01, high_density=True)

        gap = abs(at.position["end"] - handle)
        through = (at.position["end"][0] >= handle[0]) & (gap[1] <= 0.04) & (gap[2] <= 0.06)
        near_target = distance(handle, target) <= _RADIUS
        pulled = jnp.where(near_target, 10.0, 6 + at_flask + 2 * stick_in_place + flask_in_place)
        held = in_hand(at, stick, 0.02) & (stick[2] - 0.01 > stick_init[2])
        lifted = jnp.where(through, pulled, 1 + 6 * at_flask)  # a product with 1 changes nothing
        return jnp.where(held, lifted, hamacher(caged, at_flask)), near_target & through
