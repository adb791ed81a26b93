"""A curriculum says which of the known tasks worlds play, and for how many steps. It changes them between chunks.

An agent knows all N training tasks: its own parameters of each, its features and its memory of gradient steps. Of these
T are played at a time. The tasks of a chunk follow from the step at which it begins, so that a run resumes exactly.
"""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp

from mtjax.types import Array, InputError, Key


@dataclasses.dataclass(frozen=True)
class Everything:
    """All tasks are played, always."""

    steps: ClassVar[int] = 0  # of every environment, after which tasks change; 0 for never

    def count(self, known: int) -> int:
        """Return the number T of tasks that are played at a time, of N that are known."""
        return known

    def rows(self, step: Array, known: int) -> Array:
        """Return the numbers (T,) int32 of the tasks that are played from a step () of every environment on."""
        return jnp.arange(known, dtype=jnp.int32)


@dataclasses.dataclass(frozen=True)
class Random:
    """Some tasks are played, and others drawn after so many steps of every environment, without repeating one."""

    played: int
    steps: int

    def count(self, known: int) -> int:
        if not 1 <= self.played <= known:
            raise InputError(
                f"the curriculum random:{self.played}:{self.steps} plays 1 to {known} of the {known} training tasks"
            )
        return self.played

    def rows(self, step: Array, known: int) -> Array:
        key = _key(step // self.steps)
        return jax.random.permutation(key, known)[: self.played].astype(jnp.int32)


@dataclasses.dataclass(frozen=True)
class Sequence:
    """One task is played after another, in the order of the table, for so many steps of every environment each.

    After the last one the first follows again.
    """

    steps: int

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


Curriculum = Everything | Random | Sequence
_KINDS = {"random": (Random, 2), "sequence": (Sequence, 1), "shuffled": (Shuffled, 1)}  # with how many numbers each has


def read(text: str) -> Curriculum:
    """Return the curriculum that ``text`` names: "all", "random:T:STEPS", "sequence:STEPS" or "shuffled:STEPS".

    Raises:
        InputError: it names none.
    """
    if text == "all":
        return Everything()
    kind, *words = text.split(":")
    made, count = _KINDS.get(kind, (Random, -1))
    numbers = [int(word) for word in words if word.isdecimal() and int(word)]
    if not len(numbers) == len(words) == count:
        raise InputError(
            "curriculum is all, random:T:STEPS (T tasks at a time), sequence:STEPS (one after another) or "
            "shuffled:STEPS (the same in random order), with steps of every environment until tasks change, such as "
            f"random:10:5000 or sequence:100000; not {text!r}"
        )
    return made(*numbers)
