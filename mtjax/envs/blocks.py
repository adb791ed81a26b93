"""The worlds of a mixture in blocks: which of its tasks, and so which slice of its worlds, belong to which family."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.types import SPLITS, Array, InputError


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Blocks:
    """The order of families along the tasks of a table. It is static, so worlds are sliced and never gathered."""

    runs: tuple[tuple[int, int], ...]  # (family, how many of its tasks follow each other), in the table's order
    marks: int  # leading numbers of a context that say which family it is of

    @property
    def count(self) -> int:
        """Return the number of tasks."""
        return sum(count for _, count in self.runs)

    def slices(self) -> Iterator[tuple[int, slice]]:
        """Return the family and the slice of tasks of each block."""
        begin = 0
        for family, count in self.runs:
            yield family, slice(begin, begin + count)
            begin += count

    def places(self, family: int) -> np.ndarray:
        """Return the places of the tasks of one family."""
        found = [np.arange(place.start, place.stop) for owner, place in self.slices() if owner == family]
        return np.concatenate([np.zeros(0, int), *found])

    def take(self, tree: Any, family: int) -> Any:
        """Return the part (S, T', ...) of leaves (S, T, ...) that belongs to one family."""
        places = [place for owner, place in self.slices() if owner == family]
        return jax.tree.map(lambda x: _joined([x[:, place] for place in places]), tree)

    def join(self, parts: Mapping[int, Array]) -> Array:
        """Join arrays (S, T', ...) of the families into one (S, T, ...)."""
        taken, found = dict.fromkeys(parts, 0), []
        for family, count in self.runs:
            found.append(parts[family][:, taken[family] : taken[family] + count])
            taken[family] += count
        return _joined(found)

    def some(self, count: int) -> "Blocks | AnyOne":
        """Return the order of ``count`` tasks of the table that are known only when a program runs.

        Raises:
            InputError: they are several, of several families.
        """
        families = tuple(sorted({family for family, _ in self.runs}))
        if len(families) == 1:
            return Blocks(((families[0], count),), self.marks)
        if count > 1:
            raise InputError(f"of a mixture of families one task is played at a time, or all are; not {count}")
        return AnyOne(families, self.marks)

    def related(self, contexts: Array, context: Array) -> Array:
        """Return which contexts (T, C) are of the same family as ``context`` (C,)."""
        return jnp.all(contexts[:, : self.marks] == context[: self.marks], axis=-1)


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class AnyOne:
    """Stands for ``Blocks`` where worlds have one task, whose family is known only when the program runs."""

    families: tuple[int, ...]  # those whose task it may be, in order
    marks: int  # as in ``Blocks``

    related = Blocks.related

    def take(self, tree: Any, family: int) -> Any:
        """Return leaves (S, 1, E, ...) as they are: all worlds are of the family whose turn it is."""
        return tree


class States(NamedTuple):
    """The states of a mixture's worlds, by family."""

    blocks: Blocks | AnyOne
    families: tuple[Any, ...]  # each family's own states, leaves (S, T', E, ...); None where a split has no task of it


def blocks_of(counts: Sequence[Mapping[str, int]]) -> dict[str, Blocks]:
    """Return the blocks of every split, and of "all", from the numbers of tasks of each family by split."""
    runs = {split: [(i, count[split]) for i, count in enumerate(counts)] for split in SPLITS}
    runs["all"] = [run for split in SPLITS for run in runs[split]]
    marks = len(counts) if len(counts) > 1 else 0
    return {split: Blocks(_merged(found), marks) for split, found in runs.items()}


def _merged(runs: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Return the blocks without empty ones, with neighbouring blocks of one family joined."""
    found: list[tuple[int, int]] = []
    for family, count in runs:
        if found and found[-1][0] == family:
            found[-1] = (family, found[-1][1] + count)
        elif count:
            found.append((family, count))
    return tuple(found)


def _joined(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)
