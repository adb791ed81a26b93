"""The coloured maze of Wilson et al. (2007): what a square costs follows from the colours in and around it."""

import dataclasses
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.checks import require_not_negative
from mtjax.envs.craft.grid import MOVES
from mtjax.envs.looks import Look, from_above
from mtjax.envs.mtenv.tabular import DrawnTasks
from mtjax.envs.parameters import Parameter
from mtjax.envs.pixels import Mark, Pictured
from mtjax.envs.scenery import Visible
from mtjax.types import Array, InputError, Key, Step, Task

_AROUND = np.array([(0, 0), *MOVES])  # the square itself, and those below, above, to the left and to the right
_LEAST, _MOST, _MOST_SEEN, _MOST_COLOURS = 3, 30, 7, 8
_PAINTS = np.array(
    [
        *((0.8, 0.2, 0.15), (0.2, 0.6, 0.25), (0.2, 0.35, 0.8), (0.9, 0.8, 0.25)),
        *((0.6, 0.25, 0.65), (0.2, 0.7, 0.75), (0.9, 0.55, 0.2), (0.55, 0.55, 0.55)),
    ]
)
_SKIN, _AIM = (0.98, 0.98, 0.98, 1.0), (0.05, 0.05, 0.05, 1.0)


class Walk(NamedTuple):
    """The state of a coloured maze."""

    place: Array  # (2,) int32, x and y
    earned: Array  # () by the last step
    seed: Array  # data of the key for the noise to come; films cannot hold keys themselves


@dataclasses.dataclass(frozen=True)
class ColouredMaze(Pictured, DrawnTasks):
    """Coloured maze: cross squares whose costs follow from colours, by weights that differ between tasks (Wilson 2007).

    Observation (5 num_colours + 2,): the colours of the walker's square and of those below, above, to the left and to
        the right, each one-hot, and 0 off the maze; x and y from -1 to 1 across the maze.
    Action: 0 to 3 for a square down, up, left and right. A move off the maze stays.
    Reward: with the colours c_0 to c_4 of these five squares where the step has led to, the task's weights w of each
        colour in each of the five places, and normal noise epsilon of deviation 1,
            r = noise epsilon - sum_i w(i, c_i)
        Places off the maze cost nothing.
    Start: in the corner at the lower left.
    Episode: 100 steps; it terminates in the opposite corner. Metric ``success`` is 1 there.

    A task is two tables. ``weights`` (5, num_colours) are near the mean weights of one of ``num_classes`` classes: with
        standard deviation ``spread`` from them, within [0, 1]. Mean weights are uniform in [0, 1], and a task's class
        is any, all as likely. ``squares`` (cells, cells) are uniform in [0, 1]: a square x has the colour number
        num_colours x, rounded down. The context is the weights w as 2 w - 1.

    Differs from the paper in: numbers of squares, colours and classes, and the spread, are our own choices; weights are
    costs within bounds, so that the shortest way by cost is the best there is.
    """

    cells: int = 7
    """Squares along each side of the maze."""
    num_colours: int = 8
    """Number of colours, from 2 to 8."""
    num_classes: int = 4
    """Number of classes of tasks."""
    spread: float = 0.05
    """Standard deviation of a task's weights from the means of its class."""
    noise: float = 0.1
    """Standard deviation of rewards."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType({})
    looks: ClassVar[Mapping[str, Parameter]] = MappingProxyType({})
    action_size: ClassVar[int] = len(MOVES)
    episode_steps: ClassVar[int] = 100
    step_seconds: ClassVar[float] = 0.2

    def __post_init__(self):
        super().__post_init__()
        limits = {"cells": (_LEAST, _MOST), "num_colours": (2, _MOST_COLOURS), "num_classes": (1, 1000)}
        for name, (least, most) in limits.items():
            if not least <= getattr(self, name) <= most:
                flag = name.replace("_", "-")
                raise InputError(f"{flag} must be from {least} to {most}, not {getattr(self, name)}")
        if self.pixels and self.cells > _MOST_SEEN:
            raise InputError(f"pictures show at most {_MOST_SEEN} x {_MOST_SEEN} squares, not cells={self.cells}")
        require_not_negative(self, "spread", "noise")

    # Tasks.

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"weights": (len(_AROUND), self.num_colours), "squares": (self.cells, self.cells)}

    @property
    def told(self) -> tuple[str, ...]:
        """Return the weights alone, as the walker sees colours."""
        return ("weights",)

    @cached_property
    def means(self) -> np.ndarray:
        """Return the mean weights (num_classes, 5, num_colours) of each class."""
        random = np.random.default_rng((self.task_seed, 3))  # 0, 1 and 2 are the tasks' seeds, by split
        return random.uniform(size=(self.num_classes, *self.shapes["weights"]))

    def draw_tables(self, random: np.random.Generator) -> dict[str, np.ndarray]:
        mean = self.means[random.integers(self.num_classes)]
        weights = np.clip(mean + self.spread * random.standard_normal(mean.shape), 0, 1)
        return {"weights": weights, "squares": random.uniform(size=self.shapes["squares"])}

    # Steps.

    def reset(self, task: Task, key: Key) -> Step:
        state = Walk(jnp.zeros(2, jnp.int32), jnp.float32(0), jax.random.key_data(key))
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: Walk, action: Array) -> Walk:
        """Return the state after a move, with what it has earned."""
        noise_key, key = jax.random.split(jax.random.wrap_key_data(state.seed))
        moved = state.place + jnp.asarray(MOVES, jnp.int32)[self.chosen(action)]
        place = jnp.clip(moved, 0, self.cells - 1)
        cost = jnp.sum(self.colours(task, place) * task.goal["weights"])
        return Walk(place, self.noise * jax.random.normal(noise_key) - cost, jax.random.key_data(key))

    def colours(self, task: Task, place: Array) -> Array:
        """Return the colours (5, num_colours) in and around a square, one-hot; 0 off the maze."""
        squares = jnp.pad(numbers_of(task, self.num_colours), 1, constant_values=-1)
        x, y = (place + 1 + jnp.asarray(_AROUND)).T
        return jax.nn.one_hot(squares[x, y], self.num_colours)

    def observe(self, task: Task, state: Walk) -> Array:
        """Return the colours around the walker, and its place, (5 num_colours + 2,)."""
        return jnp.append(self.colours(task, state.place), 2 * state.place / (self.cells - 1) - 1)

    def reward(self, task: Task, state: Walk, action: Array) -> Array:
        """Return what the last step has earned, ()."""
        return state.earned

    def terminates(self, task: Task, state: Walk) -> Array:
        """Return whether () the opposite corner is reached."""
        return jnp.all(state.place == self.cells - 1)

    def metrics(self, task: Task, state: Walk, action: Array) -> dict[str, Array]:
        """Return whether the opposite corner is reached."""
        return {"success": self.terminates(task, state).astype(jnp.float32)}

    # What is seen.

    @property
    def look(self) -> Look:  # type: ignore[override]
        """Return the view from above."""
        return from_above((self.cells - 1) / 2, self.cells)

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return a box for each square, without its colour, the mark of the last one, and the walker."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        spec.stat.extent = 2.0  # nothing is drawn within a hundredth of it
        add, end = spec.worldbody.add_geom, self.cells - 1
        for x, y in np.ndindex(self.cells, self.cells):
            add(name=f"square {x}.{y}", type=geom.mjGEOM_BOX, pos=[x, y, 0], size=[0.48, 0.48, 0.05])
        add(name="end", type=geom.mjGEOM_CYLINDER, pos=[end, end, 0.06], size=[0.4, 0.05, 0], rgba=_AIM)
        add(name="walker", type=geom.mjGEOM_CYLINDER, size=[0.3, 0.3, 0], rgba=_SKIN)
        return spec

    def visible(self, task: Task, state: Walk) -> Visible:
        """Return the walker, and the colours of all geoms: of squares, of the last one's mark, of the walker."""
        rgb = jnp.asarray(_PAINTS, jnp.float32)[numbers_of(task, self.num_colours).ravel()]
        rgba = jnp.concatenate([rgb, jnp.ones((len(rgb), 1))], axis=1)
        colours = jnp.concatenate([rgba, jnp.array([_AIM, _SKIN])])
        walker = Mark(jnp.append(state.place, 0.3))
        return Visible(jnp.zeros(0), {"walker": walker}, fields={"geom_rgba": colours})


def numbers_of(task: Task, colours: int) -> Array:
    """Return the numbers (cells, cells) int32 of a maze's colours."""
    return jnp.minimum(jnp.floor(colours * jnp.asarray(task.goal["squares"])), colours - 1).astype(jnp.int32)
