"""Which tasks of a table, and so which worlds, are of which family of a mixture."""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array, InputError


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


def _joined(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)


def merged(runs: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Return the blocks without empty ones, with neighbouring blocks of one family joined."""
    found: list[tuple[int, int]] = []
    for family, count in runs:
        if found and found[-1][0] == family:
            found[-1] = (family, found[-1][1] + count)
        elif count:
            found.append((family, count))
    return tuple(found)
