"""A gripper on a table, and an object that it brings to one of several places and leaves there."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.drawn_goals import DrawnGoals
from mtjax.envs.family import Family
from mtjax.envs.looks import Look
from mtjax.envs.parameters import Parameter, positive
from mtjax.envs.pixels import Mark, Pictured
from mtjax.types import Array, Key, Step, Task, Transition

_HALF = 2.8  # [m] half a side of the table
_HOME = (0.0, 0.0)  # where the gripper begins, and ends in every task
_PLACES = {  # [m] of the object
    "far-right": (-2.5, -1.0),
    "far-left": (-2.5, 1.0),
    "left": (0.0, 2.0),
    "right": (0.0, -2.0),
    "start": (2.5, 0.0),
}
_NAMES = tuple(_PLACES)
_START = _NAMES.index("start")
_REACHED = 0.2  # [m] within which gripper and object together are where they should be
_LEFT = 0.1  # [m] within which the object is, so that the gripper goes home
_CLOSE = 0.4  # [m] that is magnified to 1
_SCATTER = 0.1  # [m] by which starts differ along each axis
_PAINTS = ((0.9, 0.2, 0.2, 1.0), (0.2, 0.2, 0.2, 1.0), (0.2, 0.7, 0.3, 1.0), (0.2, 0.4, 0.9, 1.0), (0.9, 0.8, 0.3, 1.0))


class TableState(NamedTuple):
    """The state of a table."""

    gripper: Array  # (2,) [m]
    object: Array  # (2,) [m]
    held: Array  # () 1 if the gripper holds the object, else 0
    gained: Array  # () [m] by which the last step has shortened the way


@dataclasses.dataclass(frozen=True)
class Tabletop(DrawnGoals, Pictured, Family):
    """Tabletop: bring an object to its goal with a gripper, leave it there, and bring the gripper home.

    EARL's tabletop manipulation (Sharma et al. 2022, "Autonomous reinforcement learning: formalism and benchmarking"),
    for worlds that are not reset: the object's start is a goal too, so that there is a way back. With gripper g, object
    o and action a, all places within [-2.8, 2.8] m along both axes:
        held <- a_2 > 0 and (held or |g - o| < reach)
        g' = clip(g + pace (a_0, a_1));  o' = clip(o + g' - g) if held, else o

    Observation (13,): gripper, object and its goal [2.8 m]; 1 if the object is held, else 0; and magnified, what is
        close: the ways from gripper to object, from object to goal and from gripper to (0, 0) [0.4 m], in [-1, 1].
    Action (3,): how the gripper moves along both axes; positive to grip or to hold, else the object is let go.
    Reward: with the ways w before and w' after the step that are left [m],
            r = u + w - w'  (reward_kind dense)
            r = u  (reward_kind sparse)
            u = 1 if sqrt(|o - goal|^2 + |g|^2) <= 0.2, else 0
            w = |g| if |o - goal| <= 0.1, else |g - o| + |o - goal| + |goal|
        u is 1 where all is where it should be after the step, the object at its goal and the gripper at (0, 0).
    Start: gripper at (0, 0) and object at (2.5, 0) m, each moved by up to 0.1 m along both axes; nothing is held.
    Episode: 200 steps; nothing terminates it. Metric ``success`` is 1 where all is where it should be.

    There is one task. Its episodes draw a goal of the object from those listed in ``vary``: far-right (-2.5, -1),
        far-left (-2.5, 1), left (0, 2) and right (0, -2); start (2.5, 0) is for the way back. The observation tells it,
        and the context nothing.

    Parameters that can vary:
        goal: the number or the name of the object's goal.
        reach: from how far the gripper grips [m].
        pace: how far the gripper moves in a step at most along an axis [m].

    Differs from EARL in: there is no MuJoCo, which there only draws; starts differ by up to 0.1 m; observations are
    scaled, leave out what is the same for all goals or told twice (7 of EARL's 12 numbers remain), and magnify what is
    close; our dense reward leads the gripper home too, and the sparse one comes without demonstrations.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "goal": Parameter("1", 0.0, minimum=-1e-8, maximum=len(_NAMES) - 1, names=_NAMES),
            "reach": positive("m", 0.4),
            "pace": positive("m", 0.2),
        }
    )
    asks: ClassVar[str] = "Bring the object to its goal, and the gripper home."
    episode_steps: ClassVar[int] = 200
    action_size: ClassVar[int] = 3
    step_seconds: ClassVar[float] = 0.1
    film_speed: ClassVar[float] = 2.0
    look: ClassVar[Look | None] = Look(camera=(0.0, 0.0, 7.5), tilt=0.0, light=(0.0, 0.0, 8.0), diffuse=0.6, sun=True)

    def reset(self, task: Task, key: Key) -> Step:
        moved = jax.random.uniform(key, (2, 2), jnp.float32, -_SCATTER, _SCATTER)
        gripper, thing = jnp.array([_HOME, _PLACES["start"]]) + moved
        state = TableState(gripper, thing, jnp.float32(0), jnp.float32(0))
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: TableState, action: Array) -> TableState:
        """Return the table after the gripper has gripped or let go, and then moved."""
        action = jnp.clip(action, -1.0, 1.0)
        near = jnp.linalg.norm(state.gripper - state.object) < task.goal["reach"]
        held = (action[2] > 0) & ((state.held > 0) | near)
        gripper = jnp.clip(state.gripper + task.goal["pace"] * action[:2], -_HALF, _HALF)
        carried = jnp.clip(state.object + gripper - state.gripper, -_HALF, _HALF)
        thing = jnp.where(held, carried, state.object)
        gained = _way(task, state.gripper, state.object) - _way(task, gripper, thing)
        return TableState(gripper, thing, held.astype(jnp.float32), gained)

    def observe(self, task: Task, state: TableState) -> Array:
        """Return gripper, object and goal, whether the object is held, and the ways between them as far as 0.4 m."""
        gripper, thing, goal = state.gripper, state.object, _goal(task)
        ways = jnp.concatenate([thing - gripper, goal - thing, jnp.array(_HOME) - gripper])
        places = jnp.concatenate([gripper, thing, goal])
        return jnp.concatenate([places / _HALF, state.held[None], jnp.clip(ways / _CLOSE, -1.0, 1.0)])

    def reward(self, task: Task, state: TableState, action: Array) -> Array:
        """Return 1 where all is where it should be, and in a dense reward the metres gained, ()."""
        there = self.metrics(task, state, action)["success"]
        return there + state.gained if self.reward_kind == "dense" else there

    def metrics(self, task: Task, state: TableState, action: Array) -> dict[str, Array]:
        """Return whether all is where it should be."""
        return {"success": (self.distance(task, state) <= 1).astype(jnp.float32)}

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        before, after = _seen(transition.obs), _seen(transition.next_obs)
        gained = _way(task, before.gripper, before.object) - _way(task, after.gripper, after.object)
        after = after._replace(gained=gained)
        reward = self.reward(task, after, transition.action)
        obs, next_obs = (self.observe(task, state) for state in (before, after))
        return transition._replace(obs=obs, reward=reward, next_obs=next_obs)

    # Where worlds are not reset.

    def returning(self, task: Task) -> Task:
        """Return the task of bringing a world back to where episodes of ``task`` begin."""
        return task._replace(goal=task.goal | {"goal": jnp.full_like(task.goal["goal"], _START)})

    def distance(self, task: Task, state: TableState) -> Array:
        """Return how far () a world is from where ``task`` ends; within 1 it is there."""
        off = jnp.concatenate([state.gripper - jnp.array(_HOME), state.object - _goal(task)])
        return jnp.linalg.norm(off) / _REACHED

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the table with all places on it, the goal's ring, the object and the gripper."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        add = spec.worldbody.add_geom
        add(name="floor", type=geom.mjGEOM_PLANE, size=[20, 20, 0.1])
        add(name="table", type=geom.mjGEOM_BOX, pos=[0, 0, 0.01], size=[3.1, 3.1, 0.01], rgba=(0.75, 0.6, 0.45, 1.0))
        for (name, place), rgba in zip(_PLACES.items(), _PAINTS, strict=True):
            add(name=name, type=geom.mjGEOM_CYLINDER, pos=[*place, 0.03], size=[0.25, 0.01, 0], rgba=rgba)
        add(name="goal", type=geom.mjGEOM_CYLINDER, size=[0.4, 0.01, 0], rgba=(1.0, 1.0, 1.0, 1.0))
        add(name="object", type=geom.mjGEOM_BOX, size=[0.15, 0.15, 0.15], rgba=(0.9, 0.5, 0.1, 1.0))
        add(name="gripper", type=geom.mjGEOM_SPHERE, size=[0.14, 0, 0], rgba=(0.3, 0.8, 1.0, 1.0))
        return spec

    def marks(self, task: Task, state: TableState) -> dict[str, Mark]:
        """Return where the goal's ring, the object and the gripper are. A gripper that holds the object is lower."""
        at = lambda place, height: Mark(jnp.append(place, height))
        return {
            "goal": at(_goal(task), 0.021),
            "object": at(state.object, 0.17),
            "gripper": at(state.gripper, 0.7 - 0.3 * state.held),
        }


def _goal(task: Task) -> Array:
    """Return where (2,) [m] the object should be."""
    return jnp.array(list(_PLACES.values()))[task.goal["goal"].astype(jnp.int32)]


def _way(task: Task, gripper: Array, thing: Array) -> Array:
    """Return the way () [m] that is left: to the object, with it to its goal, and home."""
    goal, home = _goal(task), jnp.array(_HOME)
    off = jnp.linalg.norm(thing - goal)
    whole = jnp.linalg.norm(gripper - thing) + off + jnp.linalg.norm(goal - home)
    return jnp.where(off <= _LEFT, jnp.linalg.norm(gripper - home), whole)


def _seen(obs: Array) -> TableState:
    """Return the state that an observation (13,) shows."""
    return TableState(_HALF * obs[:2], _HALF * obs[2:4], obs[6], jnp.float32(0))
