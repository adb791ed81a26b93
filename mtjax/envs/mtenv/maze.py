"""MTEnv's maze of two goals, in plan: a walker among walls and two boxes. The task names the box to reach."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.envs.family import Family, draw_until
from mtjax.envs.parameters import Parameter
from mtjax.types import Array, InputError, Key, Step, Task, Transition

_HALF_WIDTH = 3.0  # [m] of the room
_ALCOVE = 1.0  # [m] depth of the strips beyond its four sides
_WALKER_RADIUS = 0.4  # [m]
_BOX_RADIUS = math.hypot(0.8, 0.8) / 2  # [m] of the circle around a box 0.8 m wide
_FORWARD = 0.51  # [m]
_TURN = math.pi / 4
_REACHED = 2.0  # [m] between centres
_SIGN_SEEN = (-1.7, -1.5)  # headings [rad] under which the task's sign shows

# A quarter of the walls, each from corner to corner (4, 2, 2): the plan is its own mirror image along both axes.
_FAR = _HALF_WIDTH + _ALCOVE
_WALLS = np.array(
    [
        [[_FAR, 0], [_FAR, _HALF_WIDTH]],
        [[_FAR, _HALF_WIDTH], [_HALF_WIDTH, _HALF_WIDTH]],
        [[_HALF_WIDTH, _HALF_WIDTH], [_HALF_WIDTH, _FAR]],
        [[_HALF_WIDTH, _FAR], [0, _FAR]],
    ],
    np.float32,
)


class MazeState(NamedTuple):
    """The state of a maze, in plan: x to the east, z to the south."""

    position: Array  # (2,) [m] x and z of the walker
    turns: Array  # () int32, eighths of a turn to the left, from facing east
    boxes: Array  # (2, 2) [m] x and z of the blue and the red box


@dataclasses.dataclass(frozen=True)
class TwoGoalMaze(Family):
    """Two-goal maze: walk to the box that the task names, and keep away from the other one.

    Observation (4,): x (to the east) and z (to the south) of the walker, each as 0.7 x - 1; its heading [rad] as
        atan2(x, z), so that south is 0, east pi / 2, north pi and west -pi / 2; a sign that is -1 for blue and 1 for
        red while the walker faces west (heading in (-1.7, -1.5)), else 0, and always 0 at first. With
        ``observe_boxes`` (8,): then x and z of the blue and of the red box, scaled alike.
    Action (3,): scores in [-1, 1] of turning left by 45 degrees, turning right by 45 degrees and walking 0.51 m ahead;
        the highest is taken, of equal ones the first.
    Reward: 1 on coming within 2 m of the goal, -1 within 2 m of the other box (also if within 2 m of both), else 0.
    Start: both boxes anywhere in the room of 6 x 6 m where they fit and do not overlap; the walker anywhere in it at
        least 2 m from both, facing one of eight ways.
    Episode: 200 steps; it terminates within 2 m of a box.

    The room opens on all four sides into strips 1 m deep and as wide as the room. A step that would bring the walker,
        a circle of radius 0.4 m, nearer to a wall than that is not taken. Boxes cannot be walked into, as episodes end
        2 m from them.

    Parameters that can vary:
        goal-box: 0 for the blue box, 1 for the red one; the context is -1 or 1.

    As in MTEnv boxes cannot be seen. Both are placed alike and, while an episode lasts, nothing tells them apart; so no
    policy can do much better than 0 on average. ``observe_boxes`` makes it a task that can be learned.

    Differs from MTEnv in: the task given is the task played (its own is drawn anew by every reset); the time limit
    holds (its step ignores it); the action is a vector of scores; headings are exact eighths of a turn (its own add up
    rounding, so that due north may read as -pi or pi); the second half of its observation, the sum of rewards, is left
    out, as it is 0 until an episode ends; there are no pixels.
    """

    observe_boxes: bool = False
    """Also observe the places of both boxes. MTEnv hides them, and then no policy does much better than chance."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {"goal-box": Parameter("1", 0.0, minimum=-1.0, maximum=1.0)}
    )
    episode_steps: ClassVar[int] = 200
    action_size: ClassVar[int] = 3

    def __post_init__(self):
        super().__post_init__()
        wrong = next((x for x in self.values.get("goal-box", ()) if x not in (0, 1)), None)
        if wrong is not None:
            raise InputError(f"goal-box is 0 (blue) or 1 (red), not {wrong:g}; both together need --split=none")

    def reset(self, task: Task, key: Key) -> Step:
        blue_key, red_key, walker_key, turn_key = jax.random.split(key, 4)
        blue = _draw_place(blue_key, _BOX_RADIUS, lambda place: jnp.bool_(True))
        red = _draw_place(red_key, _BOX_RADIUS, lambda place: _distance(place, blue) >= 2 * _BOX_RADIUS)
        boxes = jnp.stack([blue, red])
        apart = lambda place: jnp.all(_distance(place, boxes) >= _REACHED)
        position = _draw_place(walker_key, _WALKER_RADIUS, apart)
        state = MazeState(position, jax.random.randint(turn_key, (), 0, 8), boxes)
        return Step(state, self._observe(state, jnp.float32(0)), jnp.float32(0), jnp.bool_(False))

    def step(self, task: Task, state: MazeState, action: Array) -> Step:
        chosen = jnp.argmax(action)
        turns = (state.turns + jnp.array([1, -1, 0])[chosen]) % 8
        ahead = state.position + _FORWARD * _facing(state.turns)
        walks = (chosen == 2) & (_wall_distance(ahead) >= _WALKER_RADIUS)
        state = MazeState(jnp.where(walks, ahead, state.position), turns, state.boxes)
        ended = jnp.any(_distance(state.position, state.boxes) < _REACHED)
        reward = _pay(task, state.position, state.boxes)
        return Step(state, self._observe(state, 2.0 * _goal(task) - 1), reward, ended)

    @property
    def relabels(self) -> tuple[str, ...]:  # type: ignore[override]
        """Return the relabelled parameters: none unless observations show the boxes."""
        return ("goal-box",) if self.observe_boxes else ()

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        places = (transition.next_obs[jnp.array([0, 1, 4, 5, 6, 7])].reshape(3, 2) + 1) / 2.1 * _HALF_WIDTH
        sign = 2.0 * _goal(task) - 1
        show = lambda obs: obs.at[3].multiply(sign * obs[3])  # 0 stays 0
        reward = _pay(task, places[0], places[1:])
        return transition._replace(obs=show(transition.obs), reward=reward, next_obs=show(transition.next_obs))

    def _observe(self, state: MazeState, sign: Array) -> Array:
        scaled = lambda places: places / _HALF_WIDTH * 2.1 - 1
        heading = jnp.arctan2(*_facing(state.turns))
        seen = (heading > _SIGN_SEEN[0]) & (heading < _SIGN_SEEN[1])
        obs = jnp.append(scaled(state.position), jnp.stack([heading, jnp.where(seen, sign, 0.0)]))
        return jnp.append(obs, scaled(state.boxes).ravel()) if self.observe_boxes else obs


def _goal(task: Task) -> Array:
    """Return the box to reach, () int32: 0 for blue, 1 for red."""
    return (task.goal["goal-box"] > 0.5).astype(jnp.int32)


def _pay(task: Task, position: Array, boxes: Array) -> Array:
    """Return the reward () at ``position`` (2,)."""
    near, goal = _distance(position, boxes) < _REACHED, _goal(task)
    return jnp.where(near[1 - goal], -1.0, jnp.where(near[goal], 1.0, 0.0))


def _facing(turns: Array) -> Array:
    """Return the unit vector (2,) of a walker's heading, exact along the axes."""
    way = np.arange(8) * _TURN
    table = np.round(np.stack([np.cos(way), -np.sin(way)], axis=1), 12) + 0.0  # + 0.0: no negative zeros
    return jnp.asarray(table, jnp.float32)[turns]


def _distance(place: Array, others: Array) -> Array:
    return jnp.linalg.norm(others - place, axis=-1)


def _wall_distance(place: Array) -> Array:
    """Return the distance () from a place (2,) to the nearest wall."""
    start, side = _WALLS[:, 0], _WALLS[:, 1] - _WALLS[:, 0]
    offset = jnp.abs(place) - start
    along = jnp.clip(jnp.sum(offset * side, axis=1) / np.sum(side * side, axis=1), 0, 1)
    return jnp.min(jnp.linalg.norm(offset - along[:, None] * side, axis=1))


def _draw_place(key: Key, radius: float, accepted: Callable[[Array], Array]) -> Array:
    """Draw a place (2,) in the room for a circle of that radius, again and again until it is accepted."""
    end = _HALF_WIDTH - radius
    return draw_until(accepted, lambda key: jax.random.uniform(key, (2,), jnp.float32, -end, end), key)
