"""Families whose tasks have sketches: the names of their parts, one after another."""

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.checks import require_counts
from mtjax.envs.choosing import Choosing
from mtjax.envs.contexts import goals
from mtjax.envs.family import Family
from mtjax.envs.pixels import Pictured
from mtjax.envs.variation import Variation
from mtjax.types import Array, InputError, Key, Spec, Step, Task

GOAL = "goal"
"""The parameter in which the tasks differ. Its values are the names of tasks."""


class Followed(NamedTuple):
    """The state of a world, and how far its sketch has come."""

    world: Any
    place: Array  # () int32, symbols of the sketch that are over
    waited: Array  # () int32, steps under the present symbol


@dataclasses.dataclass(frozen=True)
class Sketched(Pictured, Choosing, Family):
    """A family whose tasks have sketches (Andreas et al. 2017).

    A sketch is a sequence of symbols, such as get-wood and make-at-0 for a plank. It tells what the parts of a task are
    called, and not what they mean. A task holds its sketch as data: ``sketch`` (L,), the numbers of its symbols, with
    -1 after the last of them, and ``length`` (). The context is the sketch too: a one-hot symbol for each of L places,
    and 0 after the last.

    With ``sketched`` an episode follows the sketch. Then observations end with the symbol that is due, one-hot, and the
    last action is STOP. It leaves the world as it is, and the next symbol is due. After the last symbol the episode
    terminates, and pays 1 if the goal is reached.
    """

    sketched: bool = False
    """Follow the task's sketch: observe the symbol that is due, and have one more action, STOP, which goes on to the
    next. The episode ends after the last symbol."""
    symbol_steps: int = 15
    """Steps after which the next symbol is due without STOP, with sketched."""
    held_out: tuple[str, ...] = ()
    """Names of the tasks that split=dense holds out, as its interpolation tasks."""

    symbols: ClassVar[tuple[str, ...]]
    sketches: ClassVar[Mapping[str, tuple[str, ...]]]  # by the tasks' names
    num_moves: ClassVar[int]  # actions beside STOP
    step_seconds: ClassVar[float] = 0.2

    def __post_init__(self):
        super().__post_init__()
        unknown = [name for name in self.held_out if name not in self.sketches]
        if unknown:
            raise InputError(f"held-out names tasks, such as {next(iter(self.sketches))}; there is no {unknown[0]}")
        if self.split == "dense" and not self.variation.counts["train"]:
            raise InputError("held-out leaves no task to train on; name fewer, or use --split=none")
        require_counts(self, "symbol_steps")
        if self.sketched and self.pixels:
            raise InputError("pictures do not show the symbol that is due; leave out --env.sketched or --env.pixels")

    # What a family gives.

    @abc.abstractmethod
    def begin(self, task: Task, key: Key) -> Any:
        """Return a fresh random world."""

    @abc.abstractmethod
    def move(self, task: Task, world: Any, chosen: Array) -> Any:
        """Return the world after the action with the number ``chosen`` (), from 0 to ``num_moves`` - 1."""

    @abc.abstractmethod
    def view(self, task: Task, world: Any) -> Array:
        """Return what is observed (O,) of a world."""

    @abc.abstractmethod
    def reached(self, task: Task, world: Any) -> Array:
        """Return whether () the goal is reached."""

    # What a family may give.

    def facts(self) -> dict[str, np.ndarray]:
        """Return what a task holds, as tables (N, ...) over all N names of tasks."""
        return {}

    def split_of(self, name: str) -> str:
        """Return the split to which split=dense gives a task."""
        return "interpolation" if name in self.held_out else "train"

    # Tasks.

    @property
    def longest(self) -> int:
        """Return the length L of the longest sketch."""
        return max(map(len, self.sketches.values()))

    @property
    def codes(self) -> np.ndarray:
        """Return the sketches (N, L) int32 as numbers of symbols, with -1 after the last."""
        rest = lambda sketch: [-1] * (self.longest - len(sketch))
        rows = [[self.symbols.index(s) for s in sketch] + rest(sketch) for sketch in self.sketches.values()]
        return np.array(rows, np.int32)

    @cached_property
    def variation(self) -> Variation:
        """Return the values of every task of every split."""
        found = super().variation
        if self.split != "dense" or GOAL not in found.names:
            return found
        names = list(self.sketches)
        splits = np.array([self.split_of(names[round(row[found.names.index(GOAL)])]) for row in found.rows["train"]])
        return dataclasses.replace(found, rows={split: found.rows["train"][splits == split] for split in found.rows})

    @property
    def numbers_of_goals(self) -> np.ndarray:
        """Return the number (R,) int of each row's name of a task."""
        return np.round(goals(self)[GOAL]).astype(np.int32)

    def build(self) -> dict[str, Any]:
        """Return the "goal" leaves (R, ...) of every row, and contexts that tell the sketch."""
        tables = {"sketch": self.codes, "length": np.sum(self.codes >= 0, axis=1, dtype=np.int32), **self.facts()}
        goal = {name: table[self.numbers_of_goals] for name, table in tables.items()}
        context = self.told()[self.numbers_of_goals].astype(np.float32)
        return {"model": {}, "goal": goals(self) | goal, "context": context}

    def told(self) -> np.ndarray:
        """Return the contexts (N, C) of all N names of tasks: their sketches, one-hot."""
        return np.eye(len(self.symbols) + 1)[self.codes][..., :-1].reshape(len(self.codes), -1)  # the last is -1's

    def name_of(self, row: int) -> str:
        """Return the name of the task in a row of the table."""
        return list(self.sketches)[self.numbers_of_goals[row]]

    # Steps.

    @property
    def action_size(self) -> int:  # type: ignore[override]
        """Return the number of actions, with STOP if the sketch is followed."""
        return self.num_moves + self.sketched

    @cached_property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context, and how many symbols there are if one is observed."""
        return super().spec._replace(symbols=len(self.symbols) * self.sketched)

    def reset(self, task: Task, key: Key) -> Step:
        state = Followed(self.begin(task, key), jnp.int32(0), jnp.int32(0))
        return Step(state, self.look_at(task, state), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: Followed, action: Array) -> Followed:
        """Return the state after an action; STOP changes only which symbol is due."""
        chosen = self.chosen(action)
        if not self.sketched:
            return state._replace(world=self.move(task, state.world, chosen))
        stops = chosen == self.num_moves
        moved = self.move(task, state.world, jnp.minimum(chosen, self.num_moves - 1))
        world = jax.tree.map(lambda new, old: jnp.where(stops, old, new), moved, state.world)
        over = stops | (state.waited + 1 >= self.symbol_steps)
        return Followed(world, state.place + over, jnp.where(over, 0, state.waited + 1))

    def observe(self, task: Task, state: Followed) -> Array:
        """Return what is observed of a world, and with ``sketched`` the symbol that is due."""
        seen = self.view(task, state.world)
        if not self.sketched:
            return seen
        return jnp.append(seen, jax.nn.one_hot(due(task, state.place), len(self.symbols)))

    def reward(self, task: Task, state: Followed, action: Array) -> Array:
        """Return 1 at the goal, with ``sketched`` after the last symbol, else 0, ()."""
        return (self.terminates(task, state) & self.reached(task, state.world)).astype(jnp.float32)

    def terminates(self, task: Task, state: Followed) -> Array:
        """Return whether () the goal is reached, or with ``sketched`` the sketch is over."""
        return state.place >= task.goal["length"] if self.sketched else self.reached(task, state.world)

    def metrics(self, task: Task, state: Followed, action: Array) -> dict[str, Array]:
        """Return whether the episode has earned its reward."""
        return {"success": (self.terminates(task, state) & self.reached(task, state.world)).astype(jnp.float32)}


def due(task: Task, place: Array) -> Array:
    """Return the number () of the symbol at a place of a task's sketch; -1 after the last one."""
    sketch = task.goal["sketch"]
    return jnp.where(place < task.goal["length"], sketch[jnp.minimum(place, len(sketch) - 1)], -1)


def due_in(family: Sketched, rows: Sequence[int], places: np.ndarray) -> np.ndarray:
    """Return the numbers (N, H) of the symbols that were due in steps, -1 after the last, of episodes (N,).

    Args:
        rows: (N,) of the tasks in the family's table.
        places: (N, H) places in their sketches after each step.
    """
    codes = family.codes[family.numbers_of_goals[np.asarray(rows)]]
    codes = np.pad(codes, ((0, 0), (0, 1)), constant_values=-1)
    before = np.pad(places[:, :-1], ((0, 0), (1, 0)))
    return np.take_along_axis(codes, np.minimum(before, family.longest), axis=1)
