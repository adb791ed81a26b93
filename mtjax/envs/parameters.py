"""Parameters that may differ between tasks, and those that every MuJoCo model has."""

from __future__ import annotations  # annotations name MuJoCo, but listing the families must not import it

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    import mujoco


class Parameter(NamedTuple):
    """A parameter that may differ between tasks. It edits the physics or what is seen of it, or it is a goal."""

    unit: str
    nominal: float  # the value in the unedited model, or of a goal that does not vary
    edit: Callable[[mujoco.MjSpec, float], None] | None = None  # writes the value into a spec; None: ``Task.goal``
    minimum: float = -math.inf  # values must be greater than this, and not equal
    maximum: float = math.inf  # and not greater than this
    looks: bool = False  # whether it edits what is seen, and not the physics
    names: tuple[str, ...] = ()  # what its values 0, 1, ... are called; nothing lies between two of them

    @property
    def direction(self) -> bool:
        """Whether it is an angle of a goal, which networks see as a point on the circle."""
        return self.unit == "rad" and self.edit is None

    def tell(self, value: float, digits: int) -> str:
        """Return a value as text: its name, or so many digits."""
        return self.names[round(value)] if self.names else f"{value:.{digits}g}"


def positive(unit: str, nominal: float, edit: Any = None, **about: Any) -> Parameter:
    """Return a parameter whose values are greater than 0, such as a mass or a size."""
    return Parameter(unit, nominal, edit, minimum=0.0, **about)


def not_negative(unit: str, nominal: float, edit: Any = None, **about: Any) -> Parameter:
    """Return a parameter whose values are 0 or greater, such as a share that is lost."""
    return Parameter(unit, nominal, edit, minimum=-1e-8, **about)


def _scale_geom(geom: mujoco.MjsGeom, scale: float) -> None:
    """Scale mass and inertia together, however the model gives them."""
    if math.isnan(geom.mass):
        geom.density *= scale
    else:
        geom.mass *= scale


def _given_mass(spec: mujoco.MjSpec) -> float:
    """Return the mass of all bodies before MuJoCo scales them to ``settotalmass``."""
    plain = spec.copy()
    plain.compiler.settotalmass = -1
    return float(plain.compile().body_mass.sum())


def _scale_bodies(spec: mujoco.MjSpec, bodies: Sequence[mujoco.MjsBody], scale: float) -> None:
    pinned = spec.compiler.settotalmass > 0  # MuJoCo then scales all masses to one sum, which has to change as they do
    before = _given_mass(spec) if pinned else 0.0
    for body in bodies:
        for geom in body.geoms:
            _scale_geom(geom, scale)
        if body.explicitinertial:
            body.mass *= scale
            body.inertia = body.inertia * scale
            body.fullinertia = body.fullinertia * scale
    if pinned:
        spec.compiler.settotalmass *= _given_mass(spec) / before


def _scale_mass(spec: mujoco.MjSpec, scale: float) -> None:
    _scale_bodies(spec, spec.bodies, scale)


def _set_gravity(spec: mujoco.MjSpec, value: float) -> None:
    spec.option.gravity = [0, 0, -value]


def _scale_friction(spec: mujoco.MjSpec, scale: float) -> None:
    for geom in spec.geoms:
        geom.friction = [geom.friction[0] * scale, *geom.friction[1:]]
    for pair in spec.pairs:  # geoms that touch with a friction of their own
        pair.friction = [*(pair.friction[:2] * scale), *pair.friction[2:]]


def _scale_damping(spec: mujoco.MjSpec, scale: float) -> None:
    for joint in spec.joints:
        joint.damping = joint.damping * scale


def _scale_gear(spec: mujoco.MjSpec, scale: float) -> None:
    for actuator in spec.actuators:
        actuator.gear = actuator.gear * scale


def _scale_strength(spec: mujoco.MjSpec, scale: float) -> None:
    """Scale gain and bias together, so that servos pull to the same positions."""
    for actuator in spec.actuators:
        actuator.gainprm, actuator.biasprm = actuator.gainprm * scale, actuator.biasprm * scale


def _set_density(spec: mujoco.MjSpec, value: float) -> None:
    spec.option.density = value


def body_mass(name: str) -> Parameter:
    """Return a parameter that scales mass and inertia of one body."""
    return positive("1", 1.0, lambda spec, scale: _scale_bodies(spec, [spec.body(name)], scale))


MASS = positive("1", 1.0, _scale_mass)  # scale of all masses and inertias
GRAVITY = positive("m/s^2", 9.81, _set_gravity)
FRICTION = positive("1", 1.0, _scale_friction)  # scale of the sliding friction of all contacts
DAMPING = positive("1", 1.0, _scale_damping)  # scale of the damping of all joints
GEAR = positive("1", 1.0, _scale_gear)  # scale of the strength of all actuators
STRENGTH = positive("1", 1.0, _scale_strength)  # scale of the force of all actuators, servos among them
REWARD_SCALE = positive("1", 1.0)  # a goal, by which a family that has it multiplies its reward
WATER = positive("kg/m^3", 0.0, _set_density)  # density of what bodies move in
