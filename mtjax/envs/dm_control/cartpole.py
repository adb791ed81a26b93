"""The cartpole domain of dm_control: a pole on a cart is balanced, or swung up and balanced."""

import dataclasses
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, GEAR, GRAVITY, positive
from mtjax.types import Array, Key, Task


def _set_cart_mass(spec: mujoco.MjSpec, mass: float) -> None:
    spec.geom("cart").mass = mass


def _set_pole_mass(spec: mujoco.MjSpec, mass: float) -> None:
    spec.geom("pole").mass = mass


def _set_pole_length(spec: mujoco.MjSpec, length: float) -> None:
    spec.geom("pole").fromto = [0, 0, 0, 0, 0, length]


@dataclasses.dataclass(frozen=True)
class CartpoleBalance(Domain):
    """Balance: keep the pole upright near the middle of the rail; it starts almost there.

    Observation (5,), all after the step: position of the cart [m]; cosine and sine of the pole's angle from upright;
        velocities of cart [m/s] and pole [rad/s].
    Action (1,): force on the cart in [-1, 1]; a gear of 10 N.
    Reward: with the pole's angle theta and velocity omega, and the cart's position x,
            r = (1 + cos theta) / 2 * (4 + q) / 5 * (1 + g_omega) / 2 * (1 + g_x) / 2
            r = 1 if |x| <= 0.25 and cos theta >= 0.995, else 0  (sparse)
        where q falls quadratically from 1 without force to 0 at full force, and g_omega and g_x are Gaussians, 0.1 at 5
        rad/s and at 2 m. Returns lie in [0, 1000].
    Start: cart uniform in [-0.1, 0.1] m, pole in [-0.034, 0.034] rad, both velocities normal with deviation 0.01.
    Episode: 1000 steps of 0.01 s (one Runge-Kutta step of fourth order); it never terminates.

    Parameters that can vary:
        cart-mass: [kg].
        pole-mass: [kg]; its inertia grows with it.
        pole-length: [m], without the rounded ends; its mass stays.
        gravity: [m/s^2].
        damping: scale of the damping of slider and hinge.
        gear: scale of the motor's force.

    Differs from dm_control in: nothing but the constraint solver under MJX, which stops after ``solver_iterations``;
    it acts only where the cart meets the end of the rail.
    """

    sparse: bool = False
    """Give a reward of 1 at the goal and 0 elsewhere."""

    asks: ClassVar[str] = "Balance the pole on the cart."
    parameters: ClassVar = MappingProxyType(
        {
            "cart-mass": positive("kg", 1.0, _set_cart_mass),
            "pole-mass": positive("kg", 0.1, _set_pole_mass),
            "pole-length": positive("m", 1.0, _set_pole_length),
            "gravity": GRAVITY,
            "damping": DAMPING,
            "gear": GEAR,
        }
    )
    model_file: ClassVar[str] = "cartpole.xml"
    num_substeps: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 2
    starts_untouched: ClassVar[bool] = True
    look: ClassVar = Look((0, -4, 1), 90, light=(0, 0, 6))

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        position_key, velocity_key = jax.random.split(key)
        reach = jnp.array([0.1, 0.034])
        return reach * jax.random.uniform(position_key, (2,), minval=-1.0), 0.01 * jax.random.normal(velocity_key, (2,))

    def observe(self, task: Task, world: World) -> Array:
        cart, pole = world.qpos
        return jnp.concatenate([jnp.stack([cart, jnp.cos(pole), jnp.sin(pole)]), world.qvel])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        cart, cosine = world.qpos[0], jnp.cos(world.qpos[1])
        if self.sparse:
            return tolerance(cart, -0.25, 0.25) * tolerance(cosine, 0.995, jnp.inf)
        upright = (1 + cosine) / 2
        gentle = (4 + tolerance(action[0], 0.0, 0.0, 1.0, "quadratic", 0.0)) / 5
        slow = (1 + tolerance(world.qvel[1], 0.0, 0.0, 5.0)) / 2
        centred = (1 + tolerance(cart, 0.0, 0.0, 2.0)) / 2
        return upright * gentle * slow * centred


@dataclasses.dataclass(frozen=True)
class CartpoleSwingup(CartpoleBalance):
    """Swing up the pole, which starts hanging, and balance it. All else is as in ``CartpoleBalance``.

    Start: cart normal about the middle and pole normal about straight down, with deviations of 0.01 m and 0.01 rad;
        both velocities normal with deviation 0.01.
    """

    asks: ClassVar[str] = "Swing the pole on the cart up and balance it."

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        position, velocity = 0.01 * jax.random.normal(key, (2, 2))
        return jnp.array([0.0, jnp.pi]) + position, velocity
