"""A racing car on closed tracks. Every number is a track of its own."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.analytic.circle import cos_sin
from mtjax.envs.analytic.tracks import Line, line_at, make_track, outline
from mtjax.envs.family import Family
from mtjax.envs.looks import WITHOUT_CAMERA, Look
from mtjax.envs.painters.poses import Pose
from mtjax.envs.parameters import Parameter, positive
from mtjax.envs.pixels import Mark, Pictured
from mtjax.envs.scenery import Visible
from mtjax.types import Array, Key, Step, Task

# The car of f1tenth_gym (O'Kelly et al. 2020), in SI units.
_MASS, _INERTIA, _HEIGHT = 3.74, 0.04712, 0.074
_FRONT, _REAR = 0.15875, 0.17145  # from the centre of mass to the axles
_FRONT_GRIP, _REAR_GRIP = 4.718, 5.4562  # C_f, C_r [1/rad]
_LARGEST_STEER, _STEER_RATE, _PUSH, _FASTEST = 0.4189, 3.2, 9.51, 20.0
_GRAVITY, _LENGTH = 9.81, _FRONT + _REAR

_SUBSTEPS = 2
_SLOW = 0.5  # [m/s] below which slips are those of this speed
_START, _SPACING, _AHEAD = 3.0, 2.0, 8  # [m/s]; [m] between the bends that are observed, and how many
_CRASH = 20.0  # [m] that it costs to leave the track
_KERBS = 30  # segments of each side; the caster draws no more geoms
_EYE, _PITCH = (3.0, 1.4), 0.3  # [m] of the camera behind the car and above the floor; [rad] down


class CarState(NamedTuple):
    """The state of a car."""

    place: Array  # (2,) [m] of its centre of mass
    heading: Array  # () [rad]
    speed: Array  # () [m/s]
    slip: Array  # () [rad] from where it heads to where it moves, beta
    turning: Array  # () [rad/s]
    steer: Array  # () [rad] of the front wheels
    gained: Array  # () [m] along the centre line, in the last step
    turned: Array  # () [rad] around the middle of the track since the start


@dataclasses.dataclass(frozen=True)
class Racing(Pictured, Family):
    """Racing: drive a small car around a closed track as fast as its tyres hold.

    The single-track model of CommonRoad (Althoff, Koschi and Manzinger 2017) with the car of f1tenth_gym and tyres that
    saturate. With steering angle d, acceleration a, v' = a, heading' = r and the centre of mass at height h between l_f
    and l_r:
        slips   s_f = C_f (d - beta - l_f r / v),  s_r = C_r (l_r r / v - beta)
        forces  F_f = mu m (g l_r - a h) s_f / sqrt(1 + s_f^2) / (l_f + l_r)
                F_r = mu m (g l_f + a h) s_r / sqrt(1 + s_r^2) / (l_f + l_r)
        beta' = (F_f + F_r) / (m v) - r,   r' = (l_f F_f - l_r F_r) / I
    a is held within mu g, and a v within power / m. The steering angle follows the action by at most 3.2 rad/s. A step
    of 0.05 s is two of Euler's method, which is implicit in beta and r for the stiffnesses F / s before it; v is 0.5
    m/s at least in slips and in beta'.

    Observation (15,): speed ahead and to the left [10 m/s], turning [5 rad/s], steering angle over its largest, offset
        to the left from the centre line over half the width, sine and cosine of the heading from the line's; and the
        curvature of the line 2, 4, ... 16 m ahead [1/3 m].
    Action (2,): steering angle [0.4189 rad], to the left; acceleration [9.51 m/s^2].
    Reward: with the metres s along the centre line that the step gains, and the offset y from that line [m] after it,
            r = s - 20 if |y| > width / 2, else s
        The car has then left the track.
    Start: on the centre line, anywhere, along it at 3 m/s.
    Episode: 600 steps; it terminates where the centre of mass leaves the track, which is ``width`` wide. Metrics
        ``success`` is 1 once a whole lap is driven, ``laps`` is how many.

    A track is a closed line around the origin. Its radius is a sum of waves that its number draws, scaled so that the
        tightest bend has a radius of 3 m (``make_track``). Those of the numbers 0 to 9 are 87 to 97 m long. The offset
        is that of the radius times the cosine of the line's slope, which is the distance from the line to first order.

    Known best: none in closed form. A tyre holds mu g, so that no bend of radius R is taken along the line faster than
        sqrt(mu g R): 5.6 m/s in the tightest. A cautious driver of the tests laps every track within 18 s.

    Parameters that can vary:
        track: any number, each a track of its own and always the same. Held-out numbers are other tracks.
        friction: mu of tyres on the road.
        power: [W].
        width: of the track [m].

    Differs from CommonRoad in: forces that saturate; a car that is slow is not a model of its own; the action asks for
    a steering angle, and not for its rate.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "track": Parameter("1", 0.0, minimum=-math.inf),
            "friction": positive("1", 1.0489),
            "power": positive("W", 260.0),
            "width": positive("m", 3.0, maximum=5.0),
        }
    )
    asks: ClassVar[str] = "Drive a car around a closed track as fast as its tyres hold."
    cheap_starts: ClassVar[bool] = True
    episode_steps: ClassVar[int] = 600
    action_size: ClassVar[int] = 2
    step_seconds: ClassVar[float] = 0.05
    look: ClassVar[Look | None] = Look(camera=(0.0, 0.0, 1.5), tilt=75.0, fovy=65.0)
    looks: ClassVar[Mapping[str, Parameter]] = WITHOUT_CAMERA  # as the car turns it
    scenic: ClassVar[tuple[str, ...]] = ("track", "width")

    # Tasks.

    def waves(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the waves of the track of a task with these parameter values."""
        return make_track(values.get("track", self.parameters["track"].nominal))

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the leaves (R, ...) of every row of the table, with the waves of its track."""
        built = super().build()
        waves = np.stack(self.variation.for_rows(self.waves, ("track",))).astype(np.float32)
        return built | {"goal": built["goal"] | {"waves": waves}}

    # Steps.

    def reset(self, task: Task, key: Key) -> Step:
        angle = jax.random.uniform(key, (), jnp.float32, -math.pi, math.pi)
        line, zero = line_at(task.goal["waves"], angle), jnp.float32(0)
        place = line.radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        state = CarState(place, line.heading, jnp.float32(_START), zero, zero, zero, zero, zero)
        return Step(state, self.look_at(task, state), zero, jnp.bool_(False))

    def advance(self, task: Task, state: CarState, action: Array) -> CarState:
        """Return the car after two steps of Euler's method, and how far it has come."""
        steer, push = jnp.clip(action, -1.0, 1.0)
        before = jnp.arctan2(state.place[1], state.place[0])
        for _ in range(_SUBSTEPS):
            state = _move(task, state, steer * _LARGEST_STEER, push * _PUSH, self.step_seconds / _SUBSTEPS)
        turned = _wrap(jnp.arctan2(state.place[1], state.place[0]) - before)
        gained = turned * line_at(task.goal["waves"], before + turned / 2).pace
        return state._replace(heading=_wrap(state.heading), gained=gained, turned=state.turned + turned)

    def observe(self, task: Task, state: CarState) -> Array:
        """Return the motion of the car, where it is on the track, and the bends ahead."""
        waves, angle = task.goal["waves"], jnp.arctan2(state.place[1], state.place[0])
        line = line_at(waves, angle)
        (along, across), (forward, left) = cos_sin(state.heading - line.heading), cos_sin(state.slip)
        bends, ahead = [], line
        for _ in range(_AHEAD):
            angle = angle + _SPACING / ahead.pace
            ahead = line_at(waves, angle)
            bends.append(3 * ahead.curvature)
        motion = [
            state.speed * forward / 10,
            state.speed * left / 10,
            state.turning / 5,
            state.steer / _LARGEST_STEER,
            _offset(state, line) / (task.goal["width"] / 2),
            across,
            along,
        ]
        return jnp.stack([*motion, *bends])

    def reward(self, task: Task, state: CarState, action: Array) -> Array:
        """Return the metres gained along the centre line, less the cost of leaving the track, ()."""
        return state.gained - _CRASH * self.terminates(task, state)

    def terminates(self, task: Task, state: CarState) -> Array:
        """Return whether () the car is off the track."""
        line = line_at(task.goal["waves"], jnp.arctan2(state.place[1], state.place[0]))
        return jnp.abs(_offset(state, line)) > task.goal["width"] / 2

    def metrics(self, task: Task, state: CarState, action: Array) -> dict[str, Array]:
        """Return whether a lap is driven, and how many are."""
        laps = state.turned / (2 * math.pi)
        return {"success": (laps >= 1).astype(jnp.float32), "laps": laps}

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the floor, the car, and kerbs along both sides of the track, red and white by turns."""
        spec, geom, given = mujoco.MjSpec(), mujoco.mjtGeom, values or {}
        add = spec.worldbody.add_geom
        spec.stat.extent = 2.0  # nothing is drawn within a hundredth of it
        add(name="floor", type=geom.mjGEOM_PLANE, size=[40, 40, 0.1])
        spec.worldbody.add_light(
            name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, pos=[0, 0, 30], dir=[-0.4, -0.2, -1]
        )
        width = given.get("width", self.parameters["width"].nominal)
        for side in (-1, 1):
            edge = outline(self.waves(given), side * width / 2, _KERBS)
            for i, (start, end) in enumerate(zip(edge, np.roll(edge, -1, axis=0), strict=True)):
                rgba = ((0.85, 0.1, 0.1, 1.0), (0.95, 0.95, 0.95, 1.0))[i % 2]
                ends = [*start, 0.05, *end, 0.05]
                add(name=f"kerb {side} {i}", type=geom.mjGEOM_CAPSULE, fromto=ends, size=[0.08, 0, 0], rgba=rgba)
        add(name="car", type=geom.mjGEOM_CAPSULE, pos=[0, 0, 0.15], size=[0.13, 0.2, 0], rgba=(0.15, 0.3, 0.9, 1.0))
        add(name="nose", type=geom.mjGEOM_SPHERE, pos=[0, 0, 0.15], size=[0.1, 0, 0], rgba=(0.95, 0.8, 0.1, 1.0))
        return spec

    def marks(self, task: Task, state: CarState) -> dict[str, Mark]:
        """Return where the car is."""
        ahead = jnp.stack([jnp.cos(state.heading), jnp.sin(state.heading)])
        at = lambda place: jnp.append(place, 0.15)
        return {"car": Mark(at(state.place), along=jnp.append(ahead, 0.0)), "nose": Mark(at(state.place + 0.3 * ahead))}

    def visible(self, task: Task, state: CarState) -> Visible:
        """Return the car, and the camera behind it, which looks ahead and down."""
        cos, sin = jnp.cos(state.heading), jnp.sin(state.heading)
        down, level = math.sin(_PITCH), math.cos(_PITCH)
        zero = jnp.zeros_like(cos)
        behind, above = _EYE
        position = (state.place[0] - behind * cos, state.place[1] - behind * sin, zero + above)
        axes = (sin, -cos, zero), (cos * down, sin * down, zero + level), (-cos * level, -sin * level, zero + down)
        return super().visible(task, state)._replace(eye=Pose(position, axes))


def _move(task: Task, state: CarState, steer: Array, push: Array, h: float) -> CarState:
    """Take one Euler step of ``h`` seconds, implicit in slip and turning."""
    mu, limit = task.goal["friction"], _STEER_RATE * h
    steer = state.steer + jnp.clip(steer - state.steer, -limit, limit)
    strong = jnp.minimum(mu * _GRAVITY, task.goal["power"] / (_MASS * jnp.maximum(state.speed, _SLOW)))
    push = jnp.clip(push, -mu * _GRAVITY, strong)
    speed = jnp.clip(state.speed + h * push, 0.0, _FASTEST)
    v = jnp.maximum(speed, _SLOW)
    front = _stiffness(steer - state.slip - _FRONT * state.turning / v, _FRONT_GRIP)
    rear = _stiffness(_REAR * state.turning / v - state.slip, _REAR_GRIP)
    front = mu * front * (_GRAVITY * _REAR - push * _HEIGHT) / _LENGTH  # [m/s^2] for a slip of 1 rad
    rear = mu * rear * (_GRAVITY * _FRONT + push * _HEIGHT) / _LENGTH
    # (1 - h M) (slip, turning) = (slip, turning) before + h (what steering adds)
    more = h * _MASS / _INERTIA
    slip_slip = 1 + h * (front + rear) / v
    slip_turn = h * (1 - (_REAR * rear - _FRONT * front) / v**2)
    turn_slip = -more * (_REAR * rear - _FRONT * front)
    turn_turn = 1 + more * (_FRONT**2 * front + _REAR**2 * rear) / v
    to_slip = state.slip + h * front * steer / v
    to_turn = state.turning + more * _FRONT * front * steer
    whole = slip_slip * turn_turn - slip_turn * turn_slip
    slip = (turn_turn * to_slip - slip_turn * to_turn) / whole
    turning = (slip_slip * to_turn - turn_slip * to_slip) / whole
    heading = state.heading + h * turning
    moves = heading + slip
    place = state.place + h * speed * jnp.stack(cos_sin(moves))
    return state._replace(place=place, heading=heading, speed=speed, slip=slip, turning=turning, steer=steer)


def _stiffness(angle: Array, grip: float) -> Array:
    """Return the force of a tyre over its load and over its slip angle [rad]."""
    return grip * jax.lax.rsqrt(1 + jnp.square(grip * angle))


def _offset(state: CarState, line: Line) -> Array:
    """Return the distance () [m] of a car to the left of the line."""
    return (line.radius - jnp.sqrt(jnp.sum(jnp.square(state.place)))) * line.radius / line.pace


def _wrap(angle: Array) -> Array:
    return angle - 2 * math.pi * jnp.round(angle / (2 * math.pi))
