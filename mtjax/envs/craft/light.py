"""Rooms with keys and doors, after the light world of Konidaris and Barto (2007), as Andreas et al. (2017) have it."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.craft.grid import MOVES, USE
from mtjax.envs.craft.sketched import GOAL, Followed, Sketched
from mtjax.envs.looks import Look, from_above
from mtjax.envs.parameters import Parameter
from mtjax.envs.pixels import Mark
from mtjax.types import Array, Key, Task

_ROOM = 6  # cells from a wall to the next
_SIGHT = 10.0  # cells beyond which nothing shines
_WAYS = {"L": "left", "R": "right", "U": "up", "D": "down"}
_STEPS = {"L": (-1, 0), "R": (1, 0), "U": (0, 1), "D": (0, -1)}
_PATHS = ("LL", "LD", "RD", "UL", "UR", "URU", "DRU", "LLD", "RDD", "LUR")
_ON_PATH = max(map(len, _PATHS))  # doors of the path
_MOST_ROOMS = 5  # along each side: three that a path crosses, and one beyond each end
_BESIDE = _MOST_ROOMS - 1  # other doors
_LOCKED_SHARE = 0.5
_UNDER = -5.0  # [m] height of what is not there
_WALL, _FLOOR, _LOCK = (0.35, 0.3, 0.27, 1.0), (0.35, 0.45, 0.5, 1.0), (0.85, 0.2, 0.15, 1.0)
_KEY, _AIM, _SKIN = (0.95, 0.8, 0.1, 1.0), (0.2, 0.55, 0.25, 1.0), (0.95, 0.95, 0.95, 1.0)


class Rooms(NamedTuple):
    """Rooms of 5 x 5 cells, whose walls are where x or y is a multiple of 6, and D doors in them."""

    place: Array  # (2,) int32, x and y of the walker
    doors: Array  # (D, 2) int32
    exists: Array  # (D,) bool
    keys: Array  # (D, 2) int32, of each door
    locked: Array  # (D,) bool: the door needs its key, which lies there until it is taken
    goal: Array  # (2,) int32, the room


@dataclasses.dataclass(frozen=True)
class LightWorld(Sketched):
    """Light world: walk through rooms with locked doors to the room that the task names (Konidaris and Barto 2007).

    Observation (12,): the light of locked doors, of other doors and of keys, each to the left, to the right, below and
        above. Everything in the walker's room shines with 1 - d / 10 at the distance d [cells] up to 10, and counts on
        both sides if it is straight ahead. Lights of one kind add up. A walker in a door sees that door alone. With
        ``sketched`` then the symbol that is due, one-hot (16,).
    Action: 0 to 3 walk down, up, left and right; 4 takes the key of the walker's cell. With ``sketched`` 5 is STOP.
    Reward: with the walker's room after the step, and k of K symbols over,
            r = 1 if room = goal, else 0
            r = 1 if room = goal and k >= K, else 0  (sketched)
    Start: in the middle of a room, in random rooms.
    Episode: 100 steps. It terminates with the reward, or with ``sketched`` after the last symbol. Metric ``success`` is
        1 with the reward.

    Rooms have 5 x 5 cells with walls between them. They are all that the task's path crosses, and with the chance 1/2
        one more line of them at each side. The path's doors are in the middle of its walls, and further ones in as many
        random walls as the shorter side has rooms, if there are two or more. Half of the doors are locked. Their keys
        lie in the room from which they lead, near its middle.

    Parameters that can vary:
        goal: the path, LL, LD, RD, UL, UR, URU, DRU, LLD, RDD or LUR, whose letters are symbols of the sketch: left,
            right, up and down. The context is the sketch.

    Differs from the authors' code in: a second key in a cell does not replace the first; U leads up, where there it
    leads down, and the other way round. Their paths have the same names.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {GOAL: Parameter("1", 0.0, minimum=-1.0, maximum=len(_PATHS) - 1.0, names=_PATHS)}
    )
    sketches: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType(
        {path: tuple(_WAYS[way] for way in path) for path in _PATHS}
    )
    symbols: ClassVar[tuple[str, ...]] = tuple(_WAYS.values())
    num_moves: ClassVar[int] = len(MOVES) + 1
    cheap_starts: ClassVar[bool] = True
    episode_steps: ClassVar[int] = 100
    look: ClassVar[Look | None] = from_above(_ROOM * _MOST_ROOMS / 2, _ROOM * _MOST_ROOMS + 1, light=20.0)

    def facts(self) -> dict[str, np.ndarray]:
        """Return the rooms (4, 2) of each path, relative to its first one; the last is repeated."""
        paths = [np.cumsum([(0, 0), *(_STEPS[way] for way in path)], axis=0) for path in self.sketches]
        return {"path": np.array([[*path, *[path[-1]] * (_ON_PATH + 1 - len(path))] for path in paths], np.int32)}

    def sentence(self, row: int) -> str:
        """Return what a task asks for, such as "Go left, then down."."""
        return f"Go {', then '.join(_WAYS[way] for way in self.name_of(row))}."

    # Layouts.

    def begin(self, task: Task, key: Key) -> Rooms:
        grow_key, room_key, way_key, spot_key, lock_key = jax.random.split(key, 5)
        path, length = task.goal["path"], task.goal["length"]
        more = jax.random.randint(grow_key, (2, 2), 0, 2)
        first = jnp.min(path, axis=0) - more[0]
        size = jnp.max(path, axis=0) + more[1] - first + 1
        path = path - first
        rooms = jnp.floor(jax.random.uniform(room_key, (_BESIDE, 2)) * (size - 1)).astype(jnp.int32)
        ways = jax.nn.one_hot(jax.random.randint(way_key, (_BESIDE,), 0, 2), 2, dtype=jnp.int32)
        rooms, ways = jnp.concatenate([path[:-1], rooms]), jnp.concatenate([jnp.diff(path, axis=0), ways])
        middle = _ROOM * rooms + _ROOM // 2
        doors = middle + _ROOM // 2 * ways
        wanted = jnp.minimum(size[0], size[1]) * (jnp.min(size) > 1)
        exists = jnp.concatenate([jnp.arange(_ON_PATH) < length, jnp.arange(_BESIDE) < wanted])
        same = jnp.all(doors[:, None] == doors, axis=-1) & exists  # an earlier door stays in place of a later one
        exists &= ~jnp.any(jnp.tril(same, -1), axis=1)
        keys = middle + jax.random.randint(spot_key, doors.shape, -1, _ROOM // 2)
        locked = exists & (jax.random.uniform(lock_key, exists.shape) < _LOCKED_SHARE)
        return Rooms(_ROOM * path[0] + _ROOM // 2, doors, exists, keys, locked, path[-1])

    # Steps.

    def move(self, task: Task, world: Rooms, chosen: Array) -> Rooms:
        moves = np.concatenate([MOVES, np.zeros((1, 2), MOVES.dtype)])
        ahead = world.place + jnp.asarray(moves, jnp.int32)[chosen]
        door = world.exists & jnp.all(world.doors == ahead, axis=1)
        blocked = jnp.where(jnp.any(door), jnp.any(door & world.locked), jnp.any(ahead % _ROOM == 0))
        place = jnp.where(blocked, world.place, ahead)
        found = (chosen == USE) & jnp.all(world.keys == world.place, axis=1)
        return world._replace(place=place, locked=world.locked & ~found)

    def reached(self, task: Task, world: Rooms) -> Array:
        return jnp.all(world.place // _ROOM == world.goal)

    def view(self, task: Task, world: Rooms) -> Array:
        place, room = world.place, world.place // _ROOM
        inside, here = jnp.all(place % _ROOM > 0), jnp.all(world.doors == place, axis=1)
        beside = (room == (world.doors - 1) // _ROOM) | (room == (world.doors + 1) // _ROOM)
        doors = world.exists & jnp.all(beside, axis=1) & (inside | here)
        keys = world.locked & inside & jnp.all(world.keys // _ROOM == room, axis=1)
        light_of = lambda seen, places: jnp.sum(seen[:, None] * shine(place, places), axis=0)
        return jnp.concatenate(
            [
                light_of(doors & world.locked, world.doors),
                light_of(doors & ~world.locked, world.doors),
                light_of(keys, world.keys),
            ]
        )

    # What is seen.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return floor and walls of 5 x 5 rooms, doors and keys, the goal's room and the walker."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        spec.stat.extent = 2.0  # nothing is drawn within a hundredth of it
        add, half = spec.worldbody.add_geom, _ROOM * _MOST_ROOMS / 2
        add(name="floor", type=geom.mjGEOM_PLANE, pos=[half, half, 0], size=[half + 0.5, half + 0.5, 0.1])
        for i in range(_MOST_ROOMS + 1):
            line, size = _ROOM * i, half + 0.5
            add(name=f"wall x{i}", type=geom.mjGEOM_BOX, pos=[line, half, 0], size=[0.5, size, 0.3], rgba=_WALL)
            add(name=f"wall y{i}", type=geom.mjGEOM_BOX, pos=[half, line, 0], size=[size, 0.5, 0.3], rgba=_WALL)
        add(name="goal", type=geom.mjGEOM_BOX, size=[2.5, 2.5, 0.05], rgba=_AIM)
        for i in range(_ON_PATH + _BESIDE):
            for name, size, rgba in (("door", 0.5, _FLOOR), ("lock", 0.5, _LOCK), ("key", 0.3, _KEY)):
                add(name=f"{name} {i}", type=geom.mjGEOM_BOX, size=[size, size, 0.2], rgba=rgba)
        add(name="walker", type=geom.mjGEOM_CYLINDER, size=[0.4, 0.3, 0], rgba=_SKIN)
        return spec

    def marks(self, task: Task, state: Followed) -> dict[str, Mark]:
        """Return where all is. A door is a gap in the wall, or red where it is locked."""
        world: Rooms = state.world
        middle = _ROOM * world.goal + _ROOM // 2
        at = lambda place, height: Mark(jnp.append(place, jnp.float32(height)))
        marks = {"goal": at(middle, 0.0), "walker": at(world.place, 0.5)}
        for i in range(_ON_PATH + _BESIDE):
            locked = world.locked[i]
            marks[f"door {i}"] = at(world.doors[i], jnp.where(world.exists[i] & ~locked, 0.15, _UNDER))
            marks[f"lock {i}"] = at(world.doors[i], jnp.where(locked, 0.15, _UNDER))
            marks[f"key {i}"] = at(world.keys[i], jnp.where(locked, 0.2, _UNDER))
        return marks


def shine(place: Array, places: Array) -> Array:
    """Return how bright (D, 4) lights at ``places`` (D, 2) are to the left, to the right, below and above."""
    away = places - place
    bright = jnp.maximum(1 - jnp.linalg.norm(away.astype(jnp.float32), axis=1, keepdims=True) / _SIGHT, 0.0)
    sides = jnp.stack([away[:, 0] <= 0, away[:, 0] >= 0, away[:, 1] <= 0, away[:, 1] >= 0], axis=1)
    return bright * sides
