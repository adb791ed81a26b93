"""A sailing boat and a mark. Wind, current and the sail differ between tasks."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.analytic.circle import cos_sin
from mtjax.envs.family import Family
from mtjax.envs.looks import Look
from mtjax.envs.parameters import Parameter, not_negative, positive
from mtjax.envs.pixels import Mark, Pictured
from mtjax.types import Array, Key, Step, Task

# The boat of Melin, Dahl and Waller (2015), in SI units.
_DRIFT, _DRAG, _SPIN_DRAG = 0.03, 40.0, 6000.0  # p1, p2, p3
_SAIL, _RUDDER = 200.0, 1500.0  # p4, p5
_EFFORT, _MAST, _STERN = 0.5, 0.5, 2.0  # p6, p7, p8: distances to sail's centre of effort, mast and rudder
_MASS, _INERTIA, _RUDDER_DRAG = 300.0, 400.0, 0.2  # p9, p10, p11

_SUBSTEPS = 5
_LARGEST_RUDDER, _LARGEST_SAIL = math.pi / 4, math.pi / 2
_WAY, _REACHED = 100.0, 5.0  # [m] from start to mark, and from the mark where it is reached
_FIRST_SPEED = 1.0  # [m/s]
_COST, _PRIZE = 0.05, 10.0  # of a step, and at the mark
_HULL, _BOOM, _MAST_TALL = 5.0, 4.0, 2.0  # [m] half lengths of what films show, larger than life


class BoatState(NamedTuple):
    """The state of a boat."""

    place: Array  # (2,) [m] over ground
    heading: Array  # () [rad] to the left from the way to the mark
    speed: Array  # () [m/s] through the water, ahead
    turning: Array  # () [rad/s] to the left
    sheet: Array  # () [rad] largest angle of the sail
    gained: Array  # () [m] by which the last step has come nearer to the mark


@dataclasses.dataclass(frozen=True)
class Sailing(Pictured, Family):
    """Sailing: reach a mark 100 m away under sail, whether the wind comes from behind or from the mark itself.

    The boat of Jaulin and Le Bars (2013) with the parameters p1 to p11 of Melin, Dahl and Waller (2015). W is the wind
    in the frame of the water, which the current C carries. In the boat's frame the apparent wind is (w_x, w_y) = W - v
    ahead. The sail's angle is e = -sign(w_y) e_max, and it flaps (f = 0) if w_x + |w| cos e_max < 0:
        f = p4 (w_x sin e - w_y cos e),   g = p5 v^2 sin d                       (forces of sail and rudder)
        v' = (f sin e - p11 g sin d - p2 v^2) / p9
        heading'' = (f (p6 - p7 cos e) - p8 g cos d - p3 v heading') / p10
        place' = v ahead + p1 W + C
    A step of 0.5 s is five of Euler's method, in which drags take the speed after it:
        v <- (v + h thrust) / (1 + h drag)

    Observation (10,): distance to the mark [100 m]; cosine and sine of its bearing from the bow; speed [5 m/s] and
        turning [rad/s]; apparent wind ahead and to the left [10 m/s]; speed over ground ahead and to the left [5 m/s];
        the sheet from -1 to 1.
    Action (2,): rudder d = a_0 pi / 4; sheet e_max = (1 + a_1) pi / 4.
    Reward: with the distances D before and D' after the step from the mark,
            r = (D - D') / 10 - 0.05
        and 10 more at the mark.
    Start: 100 m from the mark, facing anywhere, at 1 m/s through the water.
    Episode: 400 steps; it terminates within 5 m of the mark. Metric ``success`` is 1 there.

    The best is known. A sail at half the angle of the apparent wind from the bow pulls most. With it, the speed v at
    an angle t from a wind of W m/s is that of ``polar``, which solves
        2 p2 v^2 = p4 (sqrt(W^2 + v^2 + 2 W v cos t) - W cos t - v)
    and the best speed to windward is the largest v cos t - p1 W (``best_to_windward``). At the nominal wind it is at
    46 degrees, so that a mark to windward takes tacks.

    Parameters that can vary:
        wind-speed: [m/s].
        wind-direction: where the wind comes from, to the left from the way to the mark [rad]; 0 is from the mark.
        current-speed: [m/s].
        current-direction: where the current flows to, to the left from the way to the mark [rad].
        sail: scale of the sail's lift p4, and so of the polar.

    Differs from Jaulin and Le Bars in: the current; the rudder's force grows with v^2 and brakes by p11, as Melin et
    al. have it; forces are those in the water's frame.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "wind-speed": positive("m/s", 6.0),
            "wind-direction": Parameter("rad", 0.0, minimum=-math.inf),
            "current-speed": not_negative("m/s", 0.0),
            "current-direction": Parameter("rad", 0.0, minimum=-math.inf),
            "sail": positive("1", 1.0),
        }
    )
    asks: ClassVar[str] = "Sail to a mark 100 m away."
    cheap_starts: ClassVar[bool] = True
    episode_steps: ClassVar[int] = 400
    action_size: ClassVar[int] = 2
    step_seconds: ClassVar[float] = 0.5
    film_speed: ClassVar[float] = 10.0
    look: ClassVar[Look | None] = Look(camera=(50.0, 0.0, 175.0), tilt=0.0, light=(0, 0, 50.0), diffuse=0.6, sun=True)

    def reset(self, task: Task, key: Key) -> Step:
        heading = jax.random.uniform(key, (), jnp.float32, -math.pi, math.pi)
        zero = jnp.float32(0)
        state = BoatState(jnp.zeros(2), heading, jnp.float32(_FIRST_SPEED), zero, zero, zero)
        return Step(state, self.look_at(task, state), zero, jnp.bool_(False))

    def advance(self, task: Task, state: BoatState, action: Array) -> BoatState:
        """Return the boat after five steps of Euler's method."""
        steer, haul = jnp.clip(action, -1.0, 1.0)
        state = state._replace(sheet=(1 + haul) / 2 * _LARGEST_SAIL)
        before = _distance(state)
        for _ in range(_SUBSTEPS):
            state = _move(task, state, steer * _LARGEST_RUDDER, self.step_seconds / _SUBSTEPS)
        turns = jnp.round(state.heading / (2 * math.pi))
        return state._replace(heading=state.heading - 2 * math.pi * turns, gained=before - _distance(state))

    def observe(self, task: Task, state: BoatState) -> Array:
        """Return the mark, the boat's motion and the apparent wind, all as seen from the boat."""
        ahead = _unit(state.heading)
        mark = jnp.stack(_seen(ahead, jnp.array([_WAY, 0.0]) - state.place))
        distance = jnp.maximum(jnp.linalg.norm(mark), 1e-3)
        through = jnp.stack([state.speed, jnp.float32(0)])
        wind = _wind(task)
        apparent = jnp.stack(_seen(ahead, wind)) - through
        ground = jnp.stack(_seen(ahead, _DRIFT * wind + _current(task))) + through
        own = jnp.stack([state.speed / 5, state.turning])
        sheet = 2 * state.sheet / _LARGEST_SAIL - 1
        return jnp.concatenate(
            [distance[None] / _WAY, mark / distance, own, apparent / 10, ground / 5, sheet[None]], dtype=jnp.float32
        )

    def reward(self, task: Task, state: BoatState, action: Array) -> Array:
        """Return the metres gained, less the cost of time, and the prize at the mark, ()."""
        return state.gained / 10 - _COST + _PRIZE * self.terminates(task, state)

    def terminates(self, task: Task, state: BoatState) -> Array:
        """Return whether () the mark is reached."""
        return _distance(state) < _REACHED

    def metrics(self, task: Task, state: BoatState, action: Array) -> dict[str, Array]:
        """Return whether the mark is reached."""
        return {"success": self.terminates(task, state).astype(jnp.float32)}

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the sea, the mark, hull, bow and sail, and an arrow of the wind. MuJoCo's x is the way to the mark."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        add = spec.worldbody.add_geom
        add(name="floor", type=geom.mjGEOM_PLANE, size=[400, 400, 0.1])
        flat = [_REACHED, 0.2, 0]
        add(name="mark", type=geom.mjGEOM_CYLINDER, pos=[_WAY, 0, 0.2], size=flat, rgba=(1.0, 0.5, 0.1, 1.0))
        add(name="hull", type=geom.mjGEOM_CAPSULE, size=[1.2, _HULL, 0], rgba=(0.95, 0.95, 0.95, 1.0))
        add(name="bow", type=geom.mjGEOM_SPHERE, size=[1.5, 0, 0], rgba=(0.8, 0.1, 0.1, 1.0))
        add(name="boom", type=geom.mjGEOM_CAPSULE, size=[0.5, _BOOM, 0], rgba=(0.95, 0.8, 0.2, 1.0))
        add(name="wind", type=geom.mjGEOM_CAPSULE, size=[1.0, 8, 0], rgba=(0.3, 0.8, 1.0, 1.0))
        add(name="wind's head", type=geom.mjGEOM_SPHERE, size=[2.2, 0, 0], rgba=(0.3, 0.8, 1.0, 1.0))
        return spec

    def marks(self, task: Task, state: BoatState) -> dict[str, Mark]:
        """Return where the boat and its sail are. The wind's head shows where it blows to."""
        ahead, wind = _unit(state.heading), _wind(task)
        at = lambda place, height: jnp.append(place, height)
        level = lambda direction: jnp.append(direction, 0.0)
        wx, wy = (x - y for x, y in zip(_seen(ahead, wind), (state.speed, 0.0), strict=True))
        flaps = wx + jnp.hypot(wx, wy) * jnp.cos(state.sheet) < 0
        angle = jnp.where(flaps, jnp.arctan2(wy, wx) + math.pi, -jnp.sign(wy) * state.sheet)
        boom = _unit(state.heading + angle)
        blows = wind / jnp.maximum(jnp.linalg.norm(wind), 1e-3)
        arrow = jnp.array([_WAY / 2, 50.0])
        return {
            "hull": Mark(at(state.place, 1.0), along=level(ahead)),
            "bow": Mark(at(state.place + _HULL * ahead, 1.0)),
            "boom": Mark(at(state.place + 1.5 * ahead - _BOOM * boom, 1.0 + _MAST_TALL), along=level(boom)),
            "wind": Mark(at(arrow, 1.0), along=level(blows)),
            "wind's head": Mark(at(arrow + 8 * blows, 1.0)),
        }


def _move(task: Task, state: BoatState, rudder: Array, h: float) -> BoatState:
    """Take one Euler step of ``h`` seconds, with drags by the speed after it."""
    ahead, wind, speed = _unit(state.heading), _wind(task), state.speed
    wx, wy = _seen(ahead, wind)
    wx = wx - speed
    (cos, sin), (along, across) = cos_sin(state.sheet), cos_sin(rudder)
    sin = -jnp.sign(wy) * sin
    flaps = wx + jnp.sqrt(wx * wx + wy * wy) * cos < 0
    pull = jnp.where(flaps, 0.0, _SAIL * task.goal["sail"] * (wx * sin - wy * cos))
    side = _RUDDER * speed * across  # the rudder's force over the speed
    drag = (_DRAG * speed + _RUDDER_DRAG * side * across) / _MASS
    torque = pull * (_EFFORT - _MAST * cos) - _STERN * side * speed * along
    speed = (speed + h * pull * sin / _MASS) / (1 + h * drag)
    turning = (state.turning + h * torque / _INERTIA) / (1 + h * _SPIN_DRAG * state.speed / _INERTIA)
    heading = state.heading + h * turning
    place = state.place + h * (speed * _unit(heading) + _DRIFT * wind + _current(task))
    return state._replace(place=place, heading=heading, speed=speed, turning=turning)


def _unit(angle: Array) -> Array:
    return jnp.stack(cos_sin(angle))


def _seen(ahead: Array, vector: Array) -> tuple[Array, Array]:
    """Return a vector (2,) in the boat's frame: ahead and to the left."""
    return ahead[0] * vector[0] + ahead[1] * vector[1], ahead[0] * vector[1] - ahead[1] * vector[0]


def _current(task: Task) -> Array:
    return task.goal["current-speed"] * _unit(task.goal["current-direction"])


def _wind(task: Task) -> Array:
    """Return the wind (2,) [m/s] in the frame of the water."""
    return -task.goal["wind-speed"] * _unit(task.goal["wind-direction"]) - _current(task)


def _distance(state: BoatState) -> Array:
    """Return the distance () to the mark."""
    return jnp.sqrt(jnp.square(state.place[0] - _WAY) + jnp.square(state.place[1]))


# What is known, for NumPy.


def polar(angle: float | np.ndarray, wind_speed: float, sail: float = 1.0) -> np.ndarray:
    """Return the steady speed [m/s] under the best sail, by angles [rad] of the heading from the wind's direction.

    Args:
        wind_speed: in the frame of the water.
    """
    cos, low = np.cos(np.asarray(angle, np.float64)), np.zeros(np.shape(angle))
    high = low + 10 * wind_speed * max(sail, 1.0)
    for _ in range(80):  # the pull falls and the drag grows with speed
        v = (low + high) / 2
        pull = _SAIL * sail * (np.sqrt(wind_speed**2 + v**2 + 2 * wind_speed * v * cos) - wind_speed * cos - v)
        low, high = np.where(pull > 2 * _DRAG * v**2, (v, high), (low, v))
    return (low + high) / 2


def best_to_windward(wind_speed: float, sail: float = 1.0) -> tuple[float, float]:
    """Return the best speed to windward [m/s], drift subtracted, and the angle from the wind [rad] that has it."""
    angles = np.linspace(0, math.pi / 2, 9001)
    speeds = polar(angles, wind_speed, sail) * np.cos(angles) - _DRIFT * wind_speed
    best = int(np.argmax(speeds))
    return float(speeds[best]), float(angles[best])
