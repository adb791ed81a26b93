"""A claw of three fingers turns a valve to one of several angles, and back to where it began."""

import dataclasses
import math
from types import MappingProxyType
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.domain import Domain
from mtjax.envs.drawn_goals import DrawnGoals
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, MASS, STRENGTH, Parameter, not_negative
from mtjax.envs.pixels import Mark
from mtjax.types import Array, Key, Task, Transition

_REACHED = 0.1  # [rad] within which the valve is where it should be
_SCATTER = 0.1  # [rad] by which starts differ
_RING = 0.15  # [m] from the axis to the mark of the goal
_HEIGHT = 0.03  # [m] of the valve


def _set_valve_friction(spec: mujoco.MjSpec, value: float) -> None:
    spec.joint("valve").frictionloss = value


@dataclasses.dataclass(frozen=True)
class Claw(DrawnGoals, Domain):
    """Claw: turn a valve of three prongs to an angle with three fingers, and hold it there.

    After the claw of ROBEL (Ahn et al. 2019), with a smaller body of our own. One push turns the valve by some half a
    radian. To turn it further, fingers let go and take hold again. The angle of the start is a goal too, so that there
    is a way back for worlds that are not reset.

    Observation (23,), after the step: angles of the joints, swing, upper and lower of each finger [rad]; their
        velocities [rad/s]; cosine and sine of the valve's angle, and its velocity [rad/s]; cosine and sine of e, the
        angle from the goal to the valve in [-pi, pi].
    Action (9,): where the joints should be, from one end of their range to the other; torques are at most 0.6 N m.
    Reward: with the angle e after the step,
            r = (u + 1 - |e| / pi) / 2  (reward_kind dense)
            r = u  (reward_kind sparse)
            u = 1 if |e| <= 0.1 rad, else 0
        Returns lie in [0, 100].
    Start: every joint and the valve uniform within 0.1 rad of 0, at rest: fingers hang down, between the prongs.
    Episode: 100 steps of 0.04 s; it never terminates. Metric ``success`` is u.

    There is one task. Its episodes draw a goal from those listed in ``vary``. The observation tells it, and the context
        nothing.

    Parameters that can vary:
        goal: the angle of the valve's marked prong [rad].
        valve-friction: dry friction of the valve [N m].
        friction: scale of the sliding friction of all contacts.
        mass: scale of all masses and inertias.
        damping: scale of the damping of all joints.
        strength: scale of the motors' torques.
    """

    asks: ClassVar[str] = "Turn the valve until its marked prong is at the goal."
    parameters: ClassVar = MappingProxyType(
        {
            "goal": Parameter("rad", 0.0, minimum=-math.pi, maximum=math.pi),
            "valve-friction": not_negative("N m", 0.02, _set_valve_friction),
            "friction": FRICTION,
            "mass": MASS,
            "damping": DAMPING,
            "strength": STRENGTH,
        }
    )
    model_file: ClassVar[str] = "claw.xml"
    num_substeps: ClassVar[int] = 8
    episode_steps: ClassVar[int] = 100
    starts_untouched: ClassVar[bool] = True
    look: ClassVar = Look((0.0, -0.42, 0.5), 40.0, light=(0, 0, 1.5))

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        qpos = jax.random.uniform(key, (self.models[0].nq,), jnp.float32, -_SCATTER, _SCATTER)
        return qpos, jnp.zeros(self.models[0].nv)

    def marks(self, task: Task, world: World) -> dict[str, Mark]:
        goal = task.goal["goal"]
        return {"goal": Mark(jnp.stack([_RING * jnp.cos(goal), _RING * jnp.sin(goal), jnp.float32(_HEIGHT)]))}

    def observe(self, task: Task, world: World) -> Array:
        valve, off = world.qpos[0], _off(task, world.qpos[0])
        turned = jnp.stack([jnp.cos(valve), jnp.sin(valve), world.qvel[0], jnp.cos(off), jnp.sin(off)])
        return jnp.concatenate([world.qpos[1:], world.qvel[1:], turned])

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return self._worth(_off(task, world.qpos[0]))

    def metrics(self, task: Task, world: World, action: Array) -> dict[str, Array]:
        """Return whether the valve is where it should be."""
        return {"success": _is_there(_off(task, world.qpos[0]))}

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        before, after = (_off(task, _valve(obs)) for obs in (transition.obs, transition.next_obs))
        shown = lambda obs, off: obs.at[-2:].set(jnp.stack([jnp.cos(off), jnp.sin(off)]))
        obs, next_obs = shown(transition.obs, before), shown(transition.next_obs, after)
        return transition._replace(obs=obs, reward=self._worth(after), next_obs=next_obs)

    def _worth(self, off: Array) -> Array:
        """Return the reward () of an angle from the goal."""
        there = _is_there(off)
        return (there + 1 - jnp.abs(off) / jnp.pi) / 2 if self.reward_kind == "dense" else there

    # Where worlds are not reset.

    def returning(self, task: Task) -> Task:
        """Return the task of turning the valve back to where episodes of ``task`` begin."""
        return task._replace(goal=task.goal | {"goal": jnp.zeros_like(task.goal["goal"])})

    def distance(self, task: Task, state: World) -> Array:
        """Return how far () a world is from where ``task`` ends; within 1 it is there."""
        return jnp.abs(_off(task, state.qpos[0])) / _REACHED


def _off(task: Task, valve: Array) -> Array:
    """Return the angle () from the goal to the valve, in [-pi, pi] [rad]."""
    return jnp.mod(valve - task.goal["goal"] + jnp.pi, 2 * jnp.pi) - jnp.pi


def _is_there(off: Array) -> Array:
    return (jnp.abs(off) <= _REACHED).astype(jnp.float32)


def _valve(obs: Array) -> Array:
    """Return the angle () of the valve that an observation (23,) shows."""
    return jnp.arctan2(obs[-4], obs[-5])
