"""A curriculum says which of the known tasks worlds play, and for how many steps. It changes them between chunks.

An agent knows all N training tasks: its own parameters of each, its features and its memory of gradient steps. Of these
T are played at a time. The tasks of a chunk follow from the step at which it begins, so that a run resumes exactly.

Where episodes draw their tasks, it also says which of the draws follows in a world that is not reset.
"""

import abc
import contextlib
import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax.tasks import draw_at, episode_task
from mtjax.types import Array, InputError, Key, Returning, Task


@dataclasses.dataclass(frozen=True)
class Everything:
    """All tasks are played, always. Every curriculum is a class with these methods."""

    steps: ClassVar[int] = 0  # of every environment, after which tasks change; 0 for never
    in_turn: ClassVar[bool] = False  # whether one task is played after another, for so many steps each
    goes_back: ClassVar[bool] = False  # whether worlds go back to where they began, for which none may be reset

    def count(self, known: int) -> int:
        """Return the number T of tasks that are played at a time, of N that are known."""
        return known

    def rows(self, step: Array, known: int) -> Array:
        """Return the numbers (T,) int32 of the tasks that are played from a step () of every environment on."""
        return jnp.arange(known, dtype=jnp.int32)

    def heard(self, known: int) -> Array | None:
        """Return what was heard (N, 2) of tasks before any episode has ended; None if nothing is ever heeded."""
        return None

    def next_rows(self, step: Array, chunk: int, rows: Any, heard: Any, known: int) -> Array:
        """Return the tasks (T,) of a chunk of so many steps that begins at a step (), after those of ``rows``."""
        return self.rows(step, known)

    def follow(self, env: Any, listed: Task, task: Task, state: Any, key: Key) -> Task:
        """Return the task that one world plays next, of the draws of ``listed``, after ``task``, in ``state``.

        By default it is any draw, wherever the world is.
        """
        return episode_task(listed, key)


@dataclasses.dataclass(frozen=True)
class ForwardBackward(Everything):
    """In worlds that are not reset a goal that is drawn and the way back to the start take turns.

    Han, Levine and Abbeel 2015, "Learning compound multi-step controllers under unknown dynamics"; EARL's FBRL.
    """

    goes_back = True

    def follow(self, env: Returning, listed: Task, task: Task, state: Any, key: Key) -> Task:
        back = env.returning(task)
        same = jax.tree.map(lambda x, y: jnp.all(x == y), back.goal, task.goal)
        came_back = jnp.all(jnp.stack(jax.tree.leaves(same)))
        return jax.tree.map(partial(jnp.where, came_back), episode_task(listed, key), back)


@dataclasses.dataclass(frozen=True)
class Graph(Everything):
    """In worlds that are not reset the next task is one that begins where the world is, as one task's end is another's.

    After the task graph of Gupta et al. 2021, "Reset-free reinforcement learning via multi-task learning". Nodes are
    the ends of all draws and the start, with edges between any two. A world that is at a node plays towards any other
    one, and a world that is at none towards the nearest. Gupta et al. give edges by hand.
    """

    goes_back = True

    def follow(self, env: Returning, listed: Task, task: Task, state: Any, key: Key) -> Task:
        draws = jax.vmap(draw_at, (None, 0))(listed, jnp.arange(len(listed.draws.id)))
        nodes = jax.tree.map(lambda x, y: jnp.append(x, y[None], axis=0), draws, env.returning(task))
        far = jax.vmap(env.distance, (0, None))(nodes, state)
        there = far <= 1
        away = jnp.where(there, jnp.inf, jax.random.uniform(key, far.shape))
        node = jnp.argmin(jnp.where(jnp.any(there), away, far))
        return jax.tree.map(lambda x: x[node], nodes)


@dataclasses.dataclass(frozen=True)
class Random:
    """Some tasks are played, and others drawn after so many steps of every environment, without repeating one.

    Every choice of several tasks names them in the order of the table: one that stays the same changes nothing.
    """

    played: int
    steps: int
    in_turn, goes_back = False, False
    heard, next_rows, follow = Everything.heard, Everything.next_rows, Everything.follow

    def count(self, known: int) -> int:
        if not 1 <= self.played <= known:
            raise InputError(
                f"the curriculum plays 1 to {known} of the {known} training tasks at a time, not {self.played}"
            )
        return self.played

    def rows(self, step: Array, known: int) -> Array:
        key = _key(step // self.steps)
        return jnp.sort(jax.random.permutation(key, known)[: self.played].astype(jnp.int32))


@dataclasses.dataclass(frozen=True)
class Sequence:
    """One task is played after another, in the order of the table, for so many steps of every environment each.

    After the last one the first follows again.
    """

    steps: int
    in_turn, goes_back = True, False
    heard, next_rows, follow = Everything.heard, Everything.next_rows, Everything.follow

    def count(self, known: int) -> int:
        return 1

    def rows(self, step: Array, known: int) -> Array:
        return (step // self.steps % known).astype(jnp.int32)[None]


@dataclasses.dataclass(frozen=True)
class Shuffled(Sequence):
    """A sequence in an order that is drawn anew for every round of all tasks."""

    def rows(self, step: Array, known: int) -> Array:
        part = step // self.steps
        key = _key(part // known)
        return jax.random.permutation(key, known)[part % known].astype(jnp.int32)[None]


def _key(number: Array) -> Key:
    """Return the key of the choice with this number (), which is the same in every run."""
    return jax.random.fold_in(jax.random.key(0x5E1EC7), number)


@dataclasses.dataclass(frozen=True)
class Heeding:
    """Some tasks are chosen by what was heard of all: the returns of the policy that learns, as means over seeds.

    Of each task (N, 2) a fast and a slow mean over the chunks that played it are kept, NaN before its first episode has
    ended.
    """

    played: int
    steps: int

    in_turn, goes_back = False, False
    count, follow = Random.count, Everything.follow

    def rows(self, step: Array, known: int) -> Array:
        return self.choose(step, self.heard(known))

    def heard(self, known: int) -> Array:
        return jnp.full((known, 2), jnp.nan)

    def next_rows(self, step: Array, chunk: int, rows: Array, heard: Array, known: int) -> Array:
        due = step % self.steps < chunk  # also if a resumed run begins its chunks elsewhere
        return jnp.where(due, self.choose(step, heard), rows)

    @abc.abstractmethod
    def choose(self, step: Array, heard: Array) -> Array:
        """Return the numbers (T,) int32 of the tasks that are played from a step () on, given what was heard (N, 2)."""


def _most_urgent(urgency: Callable[[Array], Array]) -> Callable[..., Array]:
    """Return the ``choose`` of tasks (N,) by how much each should be played; the greatest are.

    A task that was never heard of comes first, and a share of the choices is random, so that none is forgotten.
    """

    def choose(self: Heeding, step: Array, heard: Array) -> Array:
        order_key, random_key = jax.random.split(_key(step // self.steps))
        known, order = len(heard), jax.random.uniform(order_key, heard.shape[:1])
        anyway = jax.random.uniform(random_key, heard.shape[:1]) < _RANDOM * self.played / known
        urgent = jnp.where(anyway | jnp.isnan(heard[:, 0]), jnp.inf, urgency(heard))
        return _first(self.played, (order, -urgent))

    return choose


@dataclasses.dataclass(frozen=True)
class Progress(Heeding):
    """Tasks are played whose returns change most, up or down: |fast - slow| (Matiisen et al. 2017)."""

    choose = _most_urgent(lambda heard: jnp.abs(heard[:, 0] - heard[:, 1]))


@dataclasses.dataclass(frozen=True)
class Hardest(Heeding):
    """Tasks are played whose returns are least. They must be of one scale in all tasks."""

    choose = _most_urgent(lambda heard: -heard[:, 0])


@dataclasses.dataclass(frozen=True)
class Growing(Heeding):
    """A range of tasks, in the order of the table, grows at its ends (Akkaya et al. 2019, "ADR").

    It begins with the middle ones. Where the task at an end returns enough, the next one is played too. The tasks at
    both ends are always played, and others between them at random.
    """

    enough: float

    def count(self, known: int) -> int:
        if self.played < 2:
            raise InputError(f"the curriculum growing:{self.played}:{self.steps} plays both ends of a range: 2 or more")
        return super().count(known)

    def choose(self, step: Array, heard: Array) -> Array:
        known, places = len(heard), jnp.arange(len(heard))
        first = (known - self.played) // 2
        inside = ~jnp.isnan(heard[:, 0]) | (first <= places) & (places < first + self.played)
        low, high = jnp.min(places, where=inside, initial=known), jnp.max(places, where=inside, initial=0)
        low = jnp.maximum(low - (heard[low, 0] >= self.enough), 0)
        high = jnp.minimum(high + (heard[high, 0] >= self.enough), known - 1)
        ends, inside = (places == low) | (places == high), (low <= places) & (places <= high)
        order = jax.random.uniform(_key(step // self.steps), (known,))
        return _first(self.played, (order, ~ends, ~inside))


def _first(count: int, keys: tuple[Array, ...]) -> Array:
    """Sort tasks by keys (N,), the last key first as in ``lexsort``, and return the first ones (count,) by number.

    In another order the same tasks would be taken for others, for which worlds and experience begin anew.
    """
    return jnp.sort(jnp.lexsort(keys)[:count].astype(jnp.int32))


_RANDOM = 0.1  # share of the choices
_RATES = (0.5, 0.1)  # of the fast and of the slow mean


def hear(heard: Array, rows: Array, returns: Array) -> Array:
    """Return what was heard (N, 2) after a chunk with returns (S, T) of the tasks (T,) that were played.

    Of a task without an episode that ended, the return is NaN, and what was heard stays.
    """
    old, new = heard[rows], jnp.nanmean(returns, axis=0)[:, None]
    mean = jnp.where(jnp.isnan(old), new, old + jnp.array(_RATES) * (new - old))
    return heard.at[rows].set(jnp.where(jnp.isnan(new), old, mean))


EVERYTHING = Everything()
Curriculum = Everything | Random | Heeding | Sequence
_OF_ALL = {"all": EVERYTHING, "forward-backward": ForwardBackward(), "graph": Graph()}
_KINDS = {  # with how many numbers each has
    "random": (Random, 2),
    "progress": (Progress, 2),
    "hardest": (Hardest, 2),
    "growing": (Growing, 3),
    "sequence": (Sequence, 1),
    "shuffled": (Shuffled, 1),
}


def read(text: str) -> Curriculum:
    """Return the curriculum that ``text`` names, such as "all", "random:T:STEPS" or "growing:T:STEPS:RETURN".

    Raises:
        InputError: it names none.
    """
    if text in _OF_ALL:
        return _OF_ALL[text]
    kind, *words = text.split(":")
    made, count = _KINDS.get(kind, (Random, -1))
    whole, rest = words[:2], words[2:]
    numbers: list[Any] = [int(word) for word in whole if word.isdecimal() and int(word)]
    with contextlib.suppress(ValueError):
        numbers += [float(word) for word in rest if math.isfinite(float(word))]
    if not len(numbers) == len(words) == count:
        raise InputError(
            "curriculum is all, random:T:STEPS (T tasks at a time), progress:T:STEPS (whose returns change most), "
            "hardest:T:STEPS (whose returns are least), growing:T:STEPS:RETURN (a range that grows where its ends "
            "return enough), sequence:STEPS (one after another) or shuffled:STEPS (the same in random order), with "
            "steps of every environment until tasks change, such as random:10:5000 or sequence:100000; with "
            "--reset-free also forward-backward or graph; "
            f"not {text!r}"
        )
    return made(*numbers)
