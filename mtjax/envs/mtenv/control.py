"""MTEnv's classic control tasks, cart-pole and acrobot, whose physical constants differ between tasks.

Each is a few equations in float32 without a MuJoCo model, so a step of thousands of worlds costs almost nothing.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.family import Family
from mtjax.envs.looks import Look
from mtjax.envs.parameters import Parameter, positive
from mtjax.envs.pixels import Pictured
from mtjax.envs.scenery import Visible
from mtjax.types import Array, Key, Step, Task

_TRACK = 2.4  # [m] from the centre to either end
_FALLEN = math.radians(12)
_CARTPOLE_DT = 0.02  # [s]

_ACROBOT_DT = 0.2  # [s]
_ACROBOT_GRAVITY = 9.8  # [m/s^2]
_CENTRE_OF_MASS = 0.5  # [m] along each link, whatever its length
_INERTIA = 1.0  # [kg m^2] of each link about its centre of mass
_TOP_SPEEDS = (5 * math.pi, 11 * math.pi)  # [rad/s] of the joints

_SLIDE, _HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
_BOX, _CAPSULE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
_GREY, _BLUE, _ORANGE, _GREEN = (0.5, 0.5, 0.5, 1), (0.25, 0.45, 0.75, 1), (0.9, 0.6, 0.2, 1), (0.3, 0.75, 0.35, 1)


class CartPoleState(NamedTuple):
    """The state of a cart-pole."""

    position: Array  # () [m] of the cart
    velocity: Array  # () [m/s]
    angle: Array  # () [rad] of the pole from upright
    angular_velocity: Array  # () [rad/s]


class AcrobotState(NamedTuple):
    """The state of an acrobot."""

    angles: Array  # (2,) [rad] in [-pi, pi]: first link from hanging down, second link from the first
    velocities: Array  # (2,) [rad/s]


def choose(action: Array, count: int) -> Array:
    """Return which of ``count`` equal parts of [-1, 1] an action () lies in, counted from 0; edges belong above."""
    return jnp.clip(jnp.floor((action + 1) / 2 * count), 0, count - 1).astype(jnp.int32)


@dataclasses.dataclass(frozen=True)
class CartPole(Pictured, Family):
    """Cart-pole: keep a pole upright on a cart that is always pushed one way or the other.

    Observation (4,): position of the cart [m], its velocity [m/s], angle of the pole from upright [rad], its velocity
        [rad/s].
    Action (1,): which way to push: along ``force`` for 0 and above, against it below; the push is always full.
    Reward: at every step, the last one included,
            r = 1
        Returns lie in [1, 500].
    Start: all four numbers uniform in [-0.05, 0.05].
    Episode: steps of 0.02 s (explicit Euler); it terminates when the cart is more than 2.4 m from the centre or the
        pole more than 12 degrees from upright, and is cut off after 500 steps, as Gymnasium's CartPole-v1 is.

    Parameters that can vary (MTEnv draws each uniformly from the range in brackets):
        gravity: [m/s^2] ([4.8, 14.8]).
        cart-mass: [kg] ([0.5, 1.5]).
        pole-mass: [kg] ([0.01, 0.19]).
        pole-length: half the length of the pole [m] ([0.2, 0.8]).
        force: of the push [N]; where it is negative, the two pushes change places ([-10, 10]). A force near 0 is too
            weak to hold the pole up.

    Differs from MTEnv in: the action is continuous (its 0 is any action below 0, its 1 any other); episodes end after
    500 steps, where its own run until the pole falls; a force of exactly 0 stays 0, where it takes 10.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "gravity": positive("m/s^2", 9.8),
            "cart-mass": positive("kg", 1.0),
            "pole-mass": positive("kg", 0.1),
            "pole-length": positive("m", 0.5),
            "force": Parameter("N", 10.0, minimum=-math.inf),
        }
    )
    cheap_starts: ClassVar[bool] = True
    episode_steps: ClassVar[int] = 500
    action_size: ClassVar[int] = 1
    step_seconds: ClassVar[float] = _CARTPOLE_DT
    look: ClassVar[Look | None] = Look(camera=(0.0, -6.0, 0.8), tilt=90.0)
    scenic: ClassVar[tuple[str, ...]] = ("pole-length",)

    def reset(self, task: Task, key: Key) -> Step:
        state = CartPoleState(*jax.random.uniform(key, (4,), jnp.float32, -0.05, 0.05))
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: CartPoleState, action: Array) -> CartPoleState:
        """Return the cart-pole after a push."""
        force = jnp.where(choose(action[0], 2) == 1, task.goal["force"], -task.goal["force"])
        return _move_cartpole(task.goal, state, force)

    def observe(self, task: Task, state: CartPoleState) -> Array:
        """Return the four numbers of the state."""
        return jnp.stack(state)

    def reward(self, task: Task, state: CartPoleState, action: Array) -> Array:
        return jnp.float32(1)

    def terminates(self, task: Task, state: CartPoleState) -> Array:
        """Return whether () the cart has left its track or the pole has fallen."""
        return (jnp.abs(state.position) > _TRACK) | (jnp.abs(state.angle) > _FALLEN)

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the track, the cart and the pole."""
        spec, length = mujoco.MjSpec(), 2 * (values or {}).get("pole-length", self.parameters["pole-length"].nominal)
        spec.worldbody.add_geom(type=_BOX, pos=[0, 0.1, 0], size=[_TRACK, 0.02, 0.04], rgba=_GREY)
        cart = spec.worldbody.add_body()
        cart.add_joint(type=_SLIDE, axis=[1, 0, 0])
        cart.add_geom(type=_BOX, size=[0.35, 0.1, 0.18], rgba=_BLUE)
        pole = cart.add_body()
        pole.add_joint(type=_HINGE, axis=[0, 1, 0])
        pole.add_geom(type=_CAPSULE, fromto=[0, -0.2, 0, 0, -0.2, length], size=[0.08, 0, 0], rgba=_ORANGE)
        return spec

    def visible(self, task: Task, state: CartPoleState) -> Visible:
        """Return where the cart and the pole are."""
        return Visible(jnp.stack([state.position, state.angle]))


def _move_cartpole(goal: Mapping[str, Array], state: CartPoleState, force: Array) -> CartPoleState:
    """Take one Euler step of a pole on a cart without friction (Barto, Sutton and Anderson 1983)."""
    mass, length = goal["pole-mass"], goal["pole-length"]
    total = goal["cart-mass"] + mass
    sin, cos = jnp.sin(state.angle), jnp.cos(state.angle)
    push = (force + mass * length * jnp.square(state.angular_velocity) * sin) / total
    angular = (goal["gravity"] * sin - cos * push) / (length * (4 / 3 - mass * jnp.square(cos) / total))
    linear = push - mass * length * angular * cos / total
    rates = CartPoleState(state.velocity, linear, state.angular_velocity, angular)
    return jax.tree.map(lambda x, rate: x + _CARTPOLE_DT * rate, state, rates)


@dataclasses.dataclass(frozen=True)
class Acrobot(Pictured, Family):
    """Acrobot: swing the end of a two-link arm above the height of its first link, with a motor at the elbow alone.

    Observation (6,): cosine and sine of the first joint's angle from hanging down; cosine and sine of the second
        joint's angle; velocities of both [rad/s].
    Action (1,): torque of the elbow, by thirds: -1 N m below -1/3, 0 up to 1/3, 1 N m from there on.
    Reward: with the joints' angles after the step, theta_1 from hanging down and theta_2 from the first link,
            r = 0 if -cos theta_1 - cos(theta_1 + theta_2) > 1, else -1
        Returns lie in [-500, 0].
    Start: angles and velocities uniform in [-0.1, 0.1].
    Episode: steps of 0.2 s (one Runge-Kutta step of fourth order, after which speeds are held to 5 pi and 11 pi rad/s);
        it terminates once -cos(angle 1) - cos(angle 1 + angle 2) > 1, and is cut off after 500 steps, as Gymnasium's
        Acrobot-v1 is.

    Parameters that can vary (MTEnv draws each uniformly from the range in brackets):
        link-length-1: of the first link [m] ([0.5, 1.5]).
        link-length-2: of the second link [m] ([0.5, 1.5]). It changes nothing: see below.
        link-mass-1, link-mass-2: [kg] ([0.5, 1.5] each).
        torque-sign: where it is 0 or below, the torque is reversed; its size means nothing ([-1, 1]).

    Lengths move neither centres of mass (0.5 m along each link) nor inertias (1 kg m^2), and the height that counts is
    that of links of 1 m. These are MTEnv's rules; as nothing hangs from the second link, its length reaches nothing.

    Differs from MTEnv in: the action is continuous (its 0, 1 and 2 are the thirds, in this order); episodes end after
    500 steps, where its own run until the goal. Of the seven numbers that describe a task there, those at 4 and 5 are
    never read, and are no parameters here (``acrobot_parameters`` reads the others; its task space declares five). Its
    unvaried acrobot, all seven at 0, has its torque reversed; the nominal one here has not.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "link-length-1": positive("m", 1.0),
            "link-length-2": positive("m", 1.0),
            "link-mass-1": positive("kg", 1.0),
            "link-mass-2": positive("kg", 1.0),
            "torque-sign": Parameter("1", 1.0, minimum=-math.inf),
        }
    )
    cheap_starts: ClassVar[bool] = True
    episode_steps: ClassVar[int] = 500
    action_size: ClassVar[int] = 1
    step_seconds: ClassVar[float] = _ACROBOT_DT
    film_speed: ClassVar[float] = 3.0
    look: ClassVar[Look | None] = Look(camera=(0.0, -6.0, 0.0), tilt=90.0)

    def reset(self, task: Task, key: Key) -> Step:
        state = AcrobotState(*jax.random.uniform(key, (2, 2), jnp.float32, -0.1, 0.1))
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: AcrobotState, action: Array) -> AcrobotState:
        """Return the arm after a step under a torque."""
        torque = (choose(action[0], 3) - 1) * jnp.where(task.goal["torque-sign"] > 0, 1.0, -1.0)
        return _move_acrobot(task.goal, state, torque)

    def observe(self, task: Task, state: AcrobotState) -> Array:
        """Return the angles' cosines and sines, and the velocities."""
        turns = jnp.stack([jnp.cos(state.angles), jnp.sin(state.angles)], axis=1)
        return jnp.concatenate([turns.ravel(), state.velocities])

    def reward(self, task: Task, state: AcrobotState, action: Array) -> Array:
        """Return 0 above the height and -1 below it, ()."""
        return jnp.where(self.terminates(task, state), 0.0, -1.0)

    def terminates(self, task: Task, state: AcrobotState) -> Array:
        """Return whether () the end of the arm is above the height."""
        first, second = state.angles
        return -jnp.cos(first) - jnp.cos(first + second) > 1

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return links of 1 m, as the height that counts is that of such, and a bar at this height."""
        spec, whole = mujoco.MjSpec(), [0, 0, 0, 0, 0, -1]
        spec.worldbody.add_geom(type=_BOX, pos=[0, 0.2, 1], size=[2, 0.02, 0.04], rgba=_GREEN)
        upper = spec.worldbody.add_body()
        upper.add_joint(type=_HINGE, axis=[0, -1, 0])
        upper.add_geom(type=_CAPSULE, fromto=whole, size=[0.12, 0, 0], rgba=_BLUE)
        lower = upper.add_body(pos=[0, 0, -1])
        lower.add_joint(type=_HINGE, axis=[0, -1, 0])
        lower.add_geom(type=_CAPSULE, fromto=whole, size=[0.1, 0, 0], rgba=_ORANGE)
        return spec

    def visible(self, task: Task, state: AcrobotState) -> Visible:
        """Return the angles of the joints."""
        return Visible(state.angles)


def _move_acrobot(goal: Mapping[str, Array], state: AcrobotState, torque: Array) -> AcrobotState:
    """Take one Runge-Kutta step, wrap angles into [-pi, pi], and limit speeds."""

    def slope(x: AcrobotState) -> AcrobotState:
        return AcrobotState(x.velocities, _acrobot_acceleration(goal, x, torque))

    def ahead(rates: AcrobotState, time: float) -> AcrobotState:
        return jax.tree.map(lambda x, rate: x + time * rate, state, rates)

    one = slope(state)
    two = slope(ahead(one, _ACROBOT_DT / 2))
    three = slope(ahead(two, _ACROBOT_DT / 2))
    four = slope(ahead(three, _ACROBOT_DT))
    mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, one, two, three, four)
    angles, velocities = ahead(mean, _ACROBOT_DT)
    limits = jnp.array(_TOP_SPEEDS, jnp.float32)
    return AcrobotState(angles - 2 * math.pi * jnp.round(angles / (2 * math.pi)), jnp.clip(velocities, -limits, limits))


def _acrobot_acceleration(goal: Mapping[str, Array], state: AcrobotState, torque: Array) -> Array:
    """Return angular accelerations (2,) by the equations of Sutton and Barto's book (1998, section 11.3).

    Written as M a = f: the inertia matrix M has ``whole`` and ``outer`` on its diagonal and ``shared`` beside it.
    """
    mass_1, mass_2 = goal["link-mass-1"], goal["link-mass-2"]
    length, centre = goal["link-length-1"], _CENTRE_OF_MASS
    (angle_1, angle_2), (velocity_1, velocity_2) = state.angles, state.velocities
    arm = mass_2 * length * centre
    outer = mass_2 * centre**2 + _INERTIA
    shared = outer + arm * jnp.cos(angle_2)
    whole = mass_1 * centre**2 + mass_2 * jnp.square(length) + _INERTIA + 2 * shared - outer
    bend = arm * jnp.sin(angle_2)
    weight_2 = mass_2 * centre * _ACROBOT_GRAVITY * jnp.sin(angle_1 + angle_2)
    weight_1 = (mass_1 * centre + mass_2 * length) * _ACROBOT_GRAVITY * jnp.sin(angle_1) + weight_2
    load_1 = weight_1 - bend * velocity_2 * (velocity_2 + 2 * velocity_1)
    load_2 = weight_2 + bend * jnp.square(velocity_1)
    second = (torque - load_2 + shared / whole * load_1) / (outer - jnp.square(shared) / whole)
    first = -(shared * second + load_1) / whole
    return jnp.stack([first, second])


_CARTPOLE_FORM = {  # MTEnv's description of a task: value = centre + half * number
    "gravity": (9.8, 5.0),
    "cart-mass": (1.0, 0.5),
    "pole-mass": (0.1, 0.09),
    "pole-length": (0.5, 0.3),
    "force": (0.0, 10.0),
}
_ACROBOT_FORM = {
    "link-length-1": (1.0, 0.5),
    "link-length-2": (1.0, 0.5),
    "link-mass-1": (1.0, 0.5),
    "link-mass-2": (1.0, 0.5),
    "torque-sign": (0.0, 1.0),
}
_ACROBOT_SLOTS = (0, 1, 2, 3, 6)  # MTEnv reads nothing from 4 and 5


def cartpole_parameters(numbers: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Return the values of ``CartPole.parameters`` that MTEnv's five numbers in [-1, 1] stand for.

    As there, a last number of exactly 0 stands for a force of 10 N.
    """
    values = _read_form(_CARTPOLE_FORM, np.reshape(np.asarray(numbers, np.float64), 5))
    return values | {"force": values["force"] or 10.0}


def cartpole_numbers(parameters: Mapping[str, float]) -> np.ndarray:
    """Return MTEnv's five numbers (5,) for values of ``CartPole.parameters``, as ``cartpole_parameters`` reads them."""
    return _write_form(_CARTPOLE_FORM, parameters)


def acrobot_parameters(numbers: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Return the values of ``Acrobot.parameters`` that MTEnv's seven numbers in [-1, 1] stand for."""
    return _read_form(_ACROBOT_FORM, np.reshape(np.asarray(numbers, np.float64), 7)[list(_ACROBOT_SLOTS)])


def acrobot_numbers(parameters: Mapping[str, float]) -> np.ndarray:
    """Return MTEnv's seven numbers (7,) for values of ``Acrobot.parameters``; the two it never reads are 0."""
    numbers = np.zeros(7)
    numbers[list(_ACROBOT_SLOTS)] = _write_form(_ACROBOT_FORM, parameters)
    return numbers


def _read_form(form: Mapping[str, tuple[float, float]], numbers: np.ndarray) -> dict[str, float]:
    pairs = zip(form.items(), numbers, strict=True)
    return {name: float(centre + half * number) for (name, (centre, half)), number in pairs}


def _write_form(form: Mapping[str, tuple[float, float]], parameters: Mapping[str, float]) -> np.ndarray:
    return np.array([(parameters[name] - centre) / half for name, (centre, half) in form.items()])
