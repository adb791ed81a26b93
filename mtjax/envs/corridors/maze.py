"""A maze of corridors with coloured balls. One of them is the goal."""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.corridors.layouts import Layout, find_ways, make_layout
from mtjax.envs.family import Family
from mtjax.envs.looks import WITHOUT_CAMERA, Look
from mtjax.envs.painters.caster import Caster
from mtjax.envs.painters.grid import GridCaster
from mtjax.envs.painters.poses import Pose
from mtjax.envs.parameters import Parameter
from mtjax.envs.pixels import Mark, Pictured
from mtjax.envs.scenery import Visible
from mtjax.types import Array, InputError, Key, Step, Task

_RADIUS, _BALL = 0.2, 0.2  # [m] of the walker and of balls
_REACHED = _RADIUS + _BALL  # [m] between centres
_SPEED, _TURN = 2.0, 3.0  # [m/s] and [rad/s]; a step is no longer than the radius, see ``_walk``
_MARGIN = 0.3  # [m] from a start to the sides of its cell
_EYE, _HEIGHT, _THICK = 0.5, 1.0, 0.02  # [m] heights of eye and walls, half the thickness of walls in films
_COLOURS = ("red", "green", "blue")
_PAINTS = ((0.85, 0.15, 0.1, 1.0), (0.1, 0.7, 0.15, 1.0), (0.15, 0.25, 0.95, 1.0))
_WALL = (0.5, 0.45, 0.38, 1.0)
_LEAST, _MOST = 2, 20  # cells


class WalkerState(NamedTuple):
    """The state of a walker in a maze, and what its last step has brought."""

    place: Array  # (2,) [m]
    heading: Array  # () [rad] to the left from the x axis
    gained: Array  # () [m] by which the way to the goal became shorter


@dataclasses.dataclass(frozen=True)
class CorridorMaze(Pictured, Family):
    """Corridor maze: find the ball of the goal's colour among three, seeing only what is ahead.

    Observation (4,): x and y of the walker, from -1 to 1 across the maze; cosine and sine of its heading. With
        ``observe_goal`` (7,): then 1 for the goal's colour and 0 for the others. With ``pixels`` the picture that the
        walker sees, from a height of 0.5 m between walls of 1 m, 75 degrees wide.
    Action (2,): speed [-1, 1] x 2 m/s, ahead or back; turn [-1, 1] x 3 rad/s, to the left.
    Reward: with the distance d [m] from the middle of the goal's ball after the step, and the ways w before and w'
        after it that are left [m],
            r = u,  u = 1 if d < 0.4, else 0
            r = u + w - w'  (dense)
        u is 1 on touching the ball.
    Start: anywhere but in the goal's cell, near the middle of a cell, facing anywhere.
    Episode: 500 steps of 0.1 s; it terminates at the goal. Metric ``success`` is 1 there.

    The maze has 5 x 5 cells of 1 m, or ``cells``, and walls between some of them: a depth-first search with random
    turns has carved one way from each cell to any other. The balls are in cells of their own, and can be walked
    through. The walker is a circle of radius 0.2 m, which slides along walls and around their ends.

    Parameters that can vary:
        layout: any number; each has a maze of its own, walls and places of the balls, and always the same. A number
            between two others or beyond them is just another maze, so that both splits of held-out layouts measure
            what an agent does in a maze that it has never seen. ``0:1000`` gives every episode a maze of its own.
        goal-colour: red (0), green (1) or blue (2). Observations do not tell it; the context does.

    The reward is sparse as in the mazes of DeepMind Lab (Beattie et al. 2016) and MiniWorld (Chevalier-Boisvert et al.
    2023); colours name goals as in the Memory Maze (Pasukonis et al. 2023). ``dense`` rewards progress as PointGoal
    navigation in Habitat does (Savva et al. 2019); the way is measured along both axes, from cell to cell.

    ``painter=auto`` is a ray caster in plain JAX that knows the grid, on all devices. The general ones, ``caster`` and
    ``warp``, draw the same walls as boxes; ``caster`` does so up to 5 x 5 cells.
    """

    cells: int = 5
    """Cells along each side of the maze."""
    dense: bool = False
    """Also reward the metres by which a step shortens the way to the goal."""
    observe_goal: bool = False
    """Also observe the goal's colour in the state. Otherwise only the context tells it."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {
            "layout": Parameter("1", 0.0, minimum=-math.inf),
            "goal-colour": Parameter("1", 0.0, minimum=-1.0, maximum=2.0, names=_COLOURS),
        }
    )
    asks: ClassVar[str] = "Find the ball of the goal's colour in a maze of corridors."
    episode_steps: ClassVar[int] = 500
    action_size: ClassVar[int] = 2
    step_seconds: ClassVar[float] = 0.1
    look: ClassVar[Look | None] = Look(camera=(0.0, 0.0, _EYE), tilt=90.0, fovy=75.0)
    looks: ClassVar[Mapping[str, Parameter]] = WITHOUT_CAMERA  # as the walker turns it
    caster: ClassVar[type[Caster]] = GridCaster

    def __post_init__(self):
        if not isinstance(self.cells, int) or not _LEAST <= self.cells <= _MOST:
            raise InputError(f"cells must be a whole number from {_LEAST} to {_MOST}, not {self.cells}")
        super().__post_init__()

    # Tasks.

    def layout(self, values: Mapping[str, float]) -> Layout:
        """Return the layout of a task with these parameter values."""
        nominal = self.parameters["layout"].nominal
        return make_layout(values.get("layout", nominal), self.cells, len(_COLOURS))

    def build(self) -> dict[str, dict[str, Any]]:
        """Return walls, balls and, if they are rewarded, ways to the goal (R, ...) of every row of the table."""
        layouts = self.variation.for_rows(self.layout, ("layout",))
        built = super().build()
        goal = built["goal"] | {"balls": np.stack([layout.balls for layout in layouts]).astype(np.float32)}
        if self.dense:
            ways = self.variation.for_rows(self._ways, ("layout", "goal-colour"))
            goal |= {"ahead": np.stack([way.ahead for way in ways]), "rest": np.stack([way.rest for way in ways])}
        return built | {"model": {"walls": np.stack([layout.walls for layout in layouts])}, "goal": goal}

    def _ways(self, values: Mapping[str, float]) -> Any:
        layout, colour = self.layout(values), self.parameters["goal-colour"].nominal
        return find_ways(layout.walls, layout.balls[int(values.get("goal-colour", colour))])

    # Steps.

    def reset(self, task: Task, key: Key) -> Step:
        cell_key, place_key, turn_key = jax.random.split(key, 3)
        goal = jnp.floor(_goal(task)).astype(jnp.int32)
        drawn = jax.random.randint(cell_key, (), 0, self.cells**2 - 1)
        number = drawn + (drawn >= goal[0] * self.cells + goal[1])  # of any cell but the goal's
        cell = jnp.stack(jnp.divmod(number, self.cells))
        place = cell + jax.random.uniform(place_key, (2,), jnp.float32, _MARGIN, 1 - _MARGIN)
        heading = jax.random.uniform(turn_key, (), jnp.float32, -math.pi, math.pi)
        state = WalkerState(place, heading, jnp.float32(0))
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: WalkerState, action: Array) -> WalkerState:
        """Return the state after a turn and then a step."""
        speed, turn = jnp.clip(action, -1.0, 1.0)
        heading = jnp.remainder(state.heading + turn * _TURN * self.step_seconds + math.pi, 2 * math.pi) - math.pi
        move = speed * _SPEED * self.step_seconds * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
        place = _walk(task.model["walls"], state.place, move)
        gained = metres_left(task, state.place) - metres_left(task, place) if self.dense else jnp.float32(0)
        return WalkerState(place, heading, gained)

    def reward(self, task: Task, state: WalkerState, action: Array) -> Array:
        """Return 1 at the goal, and with ``dense`` the metres gained, ()."""
        return self.terminates(task, state) + state.gained

    def terminates(self, task: Task, state: WalkerState) -> Array:
        """Return whether () the walker touches the ball of the goal's colour."""
        return jnp.linalg.norm(state.place - _goal(task)) < _REACHED

    def metrics(self, task: Task, state: WalkerState, action: Array) -> dict[str, Array]:
        """Return whether the goal is reached."""
        return {"success": self.terminates(task, state).astype(jnp.float32)}

    def observe(self, task: Task, state: WalkerState) -> Array:
        """Return place and heading (4,), and with ``observe_goal`` the goal's colour (7,)."""
        obs = jnp.append(2 * state.place / self.cells - 1, jnp.stack([jnp.cos(state.heading), jnp.sin(state.heading)]))
        colour = jax.nn.one_hot(task.goal["goal-colour"], len(_COLOURS))
        return jnp.append(obs, colour) if self.observe_goal else obs

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return floor, light, balls, and a box for every possible wall. Boxes of missing walls lie below the floor."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        spec.stat.extent = 2.0  # nothing is drawn within a hundredth of it
        n, add = self.cells, spec.worldbody.add_geom
        sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        spec.worldbody.add_light(name="sun", type=sun, pos=[0, 0, 3], dir=[-0.5, -0.25, -1], diffuse=[0.5] * 3)
        add(name="floor", type=geom.mjGEOM_PLANE, pos=[n / 2, n / 2, 0], size=[n / 2, n / 2, 0.1])
        walls, half = self.layout(values or {}).walls, _HEIGHT / 2
        for axis, line in np.ndindex(2, n + 1):
            outer = line in (0, n)
            for number in range(1 if outer else n):
                across, along = line, n / 2 if outer else number + 0.5
                length = n / 2 if outer else 0.5
                place = (across, along) if axis == 0 else (along, across)
                size = (_THICK, length + _THICK) if axis == 0 else (length + _THICK, _THICK)
                height = half if walls[axis, line, number] else -2 * half
                name = f"wall {'xy'[axis]}{line}.{number}"
                add(name=name, type=geom.mjGEOM_BOX, pos=[*place, height], size=[*size, half], rgba=_WALL)
        for name, rgba in zip(_COLOURS, _PAINTS, strict=True):
            add(name=name, type=geom.mjGEOM_SPHERE, pos=[0, 0, _BALL], size=[_BALL, 0, 0], rgba=rgba)
        return spec

    @property
    def scenic(self) -> tuple[str, ...]:  # type: ignore[override]
        """Return the parameters in which scenes of tasks differ. The grid's caster reads walls from tasks."""
        return () if self.painter == "auto" else ("layout",)

    def marks(self, task: Task, state: WalkerState) -> dict[str, Mark]:
        """Return where the balls are."""
        balls = task.goal["balls"]
        return {name: Mark(jnp.append(balls[i], _BALL)) for i, name in enumerate(_COLOURS)}

    def visible(self, task: Task, state: WalkerState) -> Visible:
        """Return the balls, the walls of the grid, and the walker's eye, which looks ahead."""
        cos, sin = jnp.cos(state.heading), jnp.sin(state.heading)
        zero = jnp.zeros_like(cos)
        position = (state.place[0], state.place[1], zero + _EYE)
        eye = Pose(position, ((sin, -cos, zero), (zero, zero, zero + 1), (-cos, -sin, zero)))
        return super().visible(task, state)._replace(eye=eye, fields={"walls": task.model["walls"]})


def _goal(task: Task) -> Array:
    """Return the place (2,) of the goal."""
    return task.goal["balls"][task.goal["goal-colour"].astype(jnp.int32)]


def metres_left(task: Task, place: Array) -> Array:
    """Return the way () to the goal, along both axes from cell to cell."""
    i, j = jnp.floor(place).astype(jnp.int32)
    return jnp.sum(jnp.abs(place - task.goal["ahead"][i, j])) + task.goal["rest"][i, j]


def _walk(walls: Array, place: Array, move: Array) -> Array:
    """Return the place (2,) after a move (2,) no longer than the walker's radius, which walls may cut short.

    The walls of the cell hold the walker off, then those of the cell that it has entered, and last the end of a wall:
    there is one at every corner of the grid, as a maze without it would have a way around that corner. So no move
    crosses a corner, and what is held off a wall is held off its ends.
    """
    moved = _between_walls(walls, jnp.floor(place), place + move)
    moved = _between_walls(walls, jnp.floor(moved), moved)
    corner = jnp.round(moved)
    away = moved - corner
    gap = jnp.maximum(jnp.linalg.norm(away), 1e-6)
    return jnp.where(gap < _RADIUS, corner + away * (_RADIUS / gap), moved)


def _between_walls(walls: Array, cell: Array, place: Array) -> Array:
    """Return a place (2,) that is held off the walls of a cell (2,)."""
    i, j = cell.astype(jnp.int32)
    low = jnp.stack([walls[0, i, j], walls[1, j, i]])
    high = jnp.stack([walls[0, i + 1, j], walls[1, j + 1, i]])
    place = jnp.where(low, jnp.maximum(place, cell + _RADIUS), place)
    return jnp.where(high, jnp.minimum(place, cell + 1 - _RADIUS), place)
