"""Tables of tasks, with a row for every task, and what families and mixtures do alike with theirs.

Tables are built on the host. Compiled programs never loop over tasks.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from mtjax.checks import require_text
from mtjax.types import SPLITS, InputError, Task


class Table(NamedTuple):
    """All tasks of a family: training, interpolation and extrapolation tasks, then the draws of continuous ranges."""

    tasks: Task  # leading axis: all rows; on the host
    rows: Mapping[str, np.ndarray]  # split -> row numbers
    draws: np.ndarray | None  # (rows of all splits, P) row numbers of the tasks that episodes draw
    blocks: Mapping[str, Any] | None = None  # split -> ``Task.blocks``; None: of a single family

    def of(self, split: str) -> Task:
        """Return the tasks of a split: "train", "interpolation", "extrapolation", or "all" in this order."""
        require_text(split, "split")
        splits = {**self.rows, "all": np.concatenate(list(self.rows.values()))}
        if split not in splits:
            raise InputError(f"unknown split {split!r}; choose from {', '.join(splits)}")
        take = lambda rows: jax.device_put(jax.tree.map(lambda x: x[rows], self.tasks))  # jnp.asarray would compile
        tasks = take(splits[split])._replace(blocks=self.blocks and self.blocks[split])
        if self.draws is None:
            return tasks
        rows, contexts = self.draws[splits[split]], self.tasks.context
        alike = np.all(contexts[rows] == contexts[splits[split], None])  # as of hidden goals, so nothing stores them
        draws = take(rows)
        return tasks._replace(draws=draws._replace(context=None) if alike else draws)


class Part(NamedTuple):
    """A family, and the places of its tasks among those of an environment."""

    name: str  # empty for a single family
    family: Any  # a Family
    places: Mapping[str, np.ndarray]  # split, or "all" -> which of that split's tasks are the family's
    before: tuple[Any, ...] = ()  # the families whose tables lie before its own in the environment's table

    @property
    def first(self) -> int:
        """Return the row of the environment's table at which the family's own begins."""
        return sum(len(family.table.tasks.id) for family in self.before)


class Outside(NamedTuple):
    """What makes the calls out of XLA in programs of an environment: engines and painters of another library."""

    makers: tuple[Any, ...]  # None in the place of one that makes no calls

    def targets(self) -> dict[str, Any]:
        """Return what ``provide`` needs for every call, by its name in programs."""
        found = [(i, each) for i, maker in enumerate(self.makers) if maker for each in maker.targets().items()]
        return {name: [i, *about] for i, (name, about) in found}

    def provide(self, maker: int, *about: Any) -> str:
        """Make a call for a program that was traced in another process, and return its name."""
        return self.makers[maker].provide(*about)

    def load_kernels(self) -> bool:
        """Compile or load what runs outside XLA. Return whether XLA must compile nothing while programs first run."""
        return any([maker.load_kernels() for maker in self.makers if maker])


def makers(family: Any) -> tuple[Any, ...]:
    """Return what makes the calls out of XLA of a family: its engine, and what draws its observations."""
    return outside(family.simulator), None if family.scenery is None else outside(family.scenery.painter)


def outside(maker: Any) -> Any:
    """Return an engine or a painter if it runs outside XLA, else None."""
    return maker if hasattr(maker, "targets") else None


def forgetful(env: Any) -> str:
    """Return the names of families whose worlds are lost with the process; empty if there are none."""
    return ", ".join(part.family.name for part in getattr(env, "parts", ()) if part.family.forgets)


# Methods of families and of mixtures.


def fields_alone(self: Any) -> dict[str, Any]:
    """Return the fields alone: tables, engines and programs are made again where a copy is unpickled."""
    return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}


def tasks(self: Any, split: str = "train") -> Task:
    """Return the tasks of a split: "train", "interpolation", "extrapolation", or "all" in this order."""
    return self.table.of(split)


@property
def counts(env: Any) -> dict[str, int]:
    """Return the number of tasks of each split."""
    return {split: sum(len(part.places[split]) for part in env.parts) for split in SPLITS}


@property
def train_count(env: Any) -> int:
    """Return the number of training tasks."""
    return env.counts["train"]


def owner(env: Any, row: int) -> tuple[Part, int]:
    """Return the part of an environment that a row of its table belongs to, and the row in its family's own table."""
    part = [part for part in env.parts if part.first <= row][-1]
    return part, row - part.first


def own_row(env: Any, row: int) -> int:
    """Return the row of the family's own table for a row of an environment's."""
    return owner(env, row)[1]


@property
def calls(env: Any) -> Outside:
    """Return what makes calls out of XLA in programs of an environment: engines, painters, and groups' own engines."""
    own = [maker for part in env.parts for maker in makers(part.family)]
    return Outside((*own, *(group.outside for group in getattr(env, "groups", ()) if group.outside not in own)))
