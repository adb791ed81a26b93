"""MTEnv's maze of two goals, in plan: a walker among walls and two boxes. The task names the box to reach."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax import frames
from mtjax.envs.choosing import Choosing
from mtjax.envs.family import Family, draw_until
from mtjax.envs.looks import Look
from mtjax.envs.parameters import Parameter
from mtjax.envs.pixels import Mark, Pictured
from mtjax.types import Array, Key, Step, Task, Transition

_HALF_WIDTH = 3.0  # [m] of the room
_ALCOVE = 1.0  # [m] depth of the strips beyond its four sides
_WALKER_RADIUS = 0.4  # [m]
_BOX_HALF = 0.4  # [m] half the width of a box
_BOX_RADIUS = math.hypot(_BOX_HALF, _BOX_HALF)  # [m] of the circle around it
_FORWARD = 0.51  # [m]
_TURN = math.pi / 4
_REACHED = 2.0  # [m] between centres
_SIGN_SEEN = (-1.7, -1.5)  # headings [rad] under which the task's sign shows
_COLOURS, _PAINTS = ("blue", "red"), ((0.2, 0.3, 0.9, 1.0), (0.9, 0.2, 0.2, 1.0))
_WALL, _SKIN, _NOSE = (0.35, 0.3, 0.27, 1.0), (0.9, 0.8, 0.2, 1.0), (0.1, 0.1, 0.1, 1.0)
_TALL, _THICK = 0.3, 0.1  # [m] half the height of walls and walker, half the thickness of walls

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
class TwoGoalMaze(Pictured, Choosing, Family):
    """Two-goal maze: walk to the box that the task names, and keep away from the other one.

    Observation (4,): x (to the east) and z (to the south) of the walker, each as 0.7 x - 1; its heading [rad] as
        atan2(x, z), so that south is 0, east pi / 2, north pi and west -pi / 2; a sign that is -1 for blue and 1 for
        red while the walker faces west (heading in (-1.7, -1.5)), else 0, and always 0 at first. With
        ``observe_boxes`` (8,): then x and z of the blue and of the red box, scaled alike.
    Action: 0 turns left by 45 degrees, 1 turns right by 45 degrees, and 2 walks 0.51 m ahead.
    Reward: with the distances d from the goal and e from the other box after the step [m],
            r = -1 if e < 2, else 1 if d < 2, else 0
    Start: both boxes anywhere in the room of 6 x 6 m where they fit and do not overlap; the walker anywhere in it at
        least 2 m from both, facing one of eight ways.
    Episode: 200 steps; it terminates within 2 m of a box.

    The room opens on all four sides into strips 1 m deep and as wide as the room. A step that would bring the walker,
        a circle of radius 0.4 m, nearer to a wall than that is not taken. Boxes cannot be walked into, as episodes end
        2 m from them.

    Parameters that can vary:
        goal-box: blue (0) or red (1); the context is -1 or 1.

    Pictures show the maze from above, north up: the walker with its nose ahead, both boxes, and the sign, a mat of the
        goal's colour before the west wall while the walker faces it.

    As in MTEnv the state tells nothing of the boxes. Both are placed alike and, while an episode lasts, nothing tells
    them apart; so no policy of the state can do much better than 0 on average. ``observe_boxes`` and pictures make it
    a task that can be learned.

    Differs from MTEnv in: the task given is the task played (its own is drawn anew by every reset); the time limit
    holds (its step ignores it); headings are exact eighths of a turn (its own add up
    rounding, so that due north may read as -pi or pi); the second half of its observation, the sum of rewards, is left
    out, as it is 0 until an episode ends; its pictures are what the walker itself sees, and its boxes are turned at
    random.
    """

    observe_boxes: bool = False
    """Also observe the places of both boxes. MTEnv hides them, and then no policy does much better than chance."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {"goal-box": Parameter("1", 0.0, minimum=-1.0, maximum=1.0, names=_COLOURS)}
    )
    episode_steps: ClassVar[int] = 200
    action_size: ClassVar[int] = 3
    step_seconds: ClassVar[float] = 0.2
    look: ClassVar[Look | None] = Look(camera=(0.0, 0.0, 11.0), tilt=0.0, light=(0.0, 0.0, 8.0), diffuse=0.6, sun=True)

    def reset(self, task: Task, key: Key) -> Step:
        blue_key, red_key, walker_key, turn_key = jax.random.split(key, 4)
        blue = _draw_place(blue_key, _BOX_RADIUS, lambda place: jnp.bool_(True))
        red = _draw_place(red_key, _BOX_RADIUS, lambda place: _distance(place, blue) >= 2 * _BOX_RADIUS)
        boxes = jnp.stack([blue, red])
        apart = lambda place: jnp.all(_distance(place, boxes) >= _REACHED)
        position = _draw_place(walker_key, _WALKER_RADIUS, apart)
        state = MazeState(position, jax.random.randint(turn_key, (), 0, 8), boxes)
        unsigned = lambda obs: obs.at[3].set(0.0)
        obs = frames.with_state(unsigned, self.look_at(task, state))
        return Step(state, obs, jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: MazeState, action: Array) -> MazeState:
        """Return the state after a turn or a step ahead."""
        chosen = self.chosen(action)
        turns = (state.turns + jnp.array([1, -1, 0])[chosen]) % 8
        ahead = state.position + _FORWARD * _facing(state.turns)
        walks = (chosen == 2) & (_wall_distance(ahead) >= _WALKER_RADIUS)
        return MazeState(jnp.where(walks, ahead, state.position), turns, state.boxes)

    def reward(self, task: Task, state: MazeState, action: Array) -> Array:
        """Return 1 near the goal, -1 near the other box and 0 elsewhere, ()."""
        return _pay(task, state.position, state.boxes)

    def terminates(self, task: Task, state: MazeState) -> Array:
        """Return whether () a box is reached."""
        return jnp.any(_distance(state.position, state.boxes) < _REACHED)

    def observe(self, task: Task, state: MazeState) -> Array:
        """Return place, heading and sign (4,), and with ``observe_boxes`` the places of both boxes (8,)."""
        scaled = lambda places: places / _HALF_WIDTH * 2.1 - 1
        sign = jnp.where(_sees_sign(state), 2.0 * _goal(task) - 1, 0.0)
        obs = jnp.append(scaled(state.position), jnp.stack([_heading(state), sign]))
        return jnp.append(obs, scaled(state.boxes).ravel()) if self.observe_boxes else obs

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

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the room with its strips, the walker, both boxes and a sign of each colour. MuJoCo's y is north."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        add = spec.worldbody.add_geom
        add(name="floor", type=geom.mjGEOM_PLANE, size=[_FAR, _FAR, 0.1])
        for i, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
            beyond, between = _FAR + _THICK, _HALF_WIDTH + _ALCOVE / 2
            size = [_THICK if x else _FAR + 2 * _THICK, _THICK if y else _FAR + 2 * _THICK, _TALL]
            add(name=f"wall {i}", type=geom.mjGEOM_BOX, pos=[beyond * x, beyond * y, _TALL], size=size, rgba=_WALL)
            place, half = [between * (x - y), between * (x + y), _TALL], [_ALCOVE / 2, _ALCOVE / 2, _TALL]
            add(name=f"corner {i}", type=geom.mjGEOM_BOX, pos=place, size=half, rgba=_WALL)
        for name, rgba in zip(_COLOURS, _PAINTS, strict=True):
            add(name=f"{name} box", type=geom.mjGEOM_BOX, size=[_BOX_HALF] * 3, rgba=rgba)
            add(name=f"{name} sign", type=geom.mjGEOM_BOX, size=[_ALCOVE / 2, 1.5, 0.01], rgba=rgba)
        add(name="walker", type=geom.mjGEOM_CYLINDER, size=[_WALKER_RADIUS, _TALL, 0], rgba=_SKIN)
        add(name="nose", type=geom.mjGEOM_SPHERE, size=[_WALKER_RADIUS / 2, 0, 0], rgba=_NOSE)
        return spec

    def marks(self, task: Task, state: MazeState) -> dict[str, Mark]:
        """Return where walker, boxes and signs are. The sign that is not seen is under the floor."""
        at = lambda place, height: Mark(jnp.stack([place[0], -place[1], jnp.float32(height)]))
        nose = state.position + _WALKER_RADIUS * _facing(state.turns)
        marks = {"walker": at(state.position, _TALL), "nose": at(nose, 2 * _TALL)}
        for i, name in enumerate(_COLOURS):
            shown = _sees_sign(state) & (_goal(task) == i)
            sign = jnp.array([-_HALF_WIDTH - _ALCOVE / 2, 0.0])
            marks |= {f"{name} box": at(state.boxes[i], _BOX_HALF), f"{name} sign": at(sign, jnp.where(shown, 0, -1))}
        return marks


def _heading(state: MazeState) -> Array:
    """Return the walker's heading () [rad] as it is observed."""
    return jnp.arctan2(*_facing(state.turns))


def _sees_sign(state: MazeState) -> Array:
    """Return whether () the walker faces the sign."""
    return (_heading(state) > _SIGN_SEEN[0]) & (_heading(state) < _SIGN_SEEN[1])


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
