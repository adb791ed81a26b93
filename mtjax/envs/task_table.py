"""Environments with a table of tasks, which has a row for every task.

Tables are built on the host. Compiled programs never loop over tasks.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from mtjax.checks import require_text
from mtjax.types import SPLITS, Array, InputError, Key, Spec, Step, Task


class Table(NamedTuple):
    """All tasks of a family: training, interpolation and extrapolation tasks, then the draws of continuous ranges."""

    tasks: Task  # leading axis: all rows; on the host
    rows: Mapping[str, np.ndarray]  # split -> row numbers
    draws: np.ndarray | None  # (rows of all splits, P) row numbers of the tasks that episodes draw


class Part(NamedTuple):
    """A family, and the places of its tasks among those of an environment."""

    name: str  # empty for a single family
    family: Any  # a Family
    places: Mapping[str, np.ndarray]  # split, or "all" -> which of that split's tasks are the family's


class Tabled(abc.ABC):
    """An environment with a table of tasks: a family or a mixture. Configurations, reports and films use it."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields alone: tables, engines and programs are made again where a copy is unpickled."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}  # type: ignore

    @property
    @abc.abstractmethod
    def table(self) -> Table:
        """Return all tasks of all splits, and the draws of continuous ranges."""

    @property
    @abc.abstractmethod
    def counts(self) -> dict[str, int]:
        """Return the number of tasks of each split."""

    @property
    def train_count(self) -> int:
        """Return the number of training tasks."""
        return self.counts["train"]

    def numbers(self, split: str) -> np.ndarray:
        """Return the numbers (T,) of a split's tasks, which are counted through the splits."""
        first = sum(self.counts[before] for before in SPLITS[: SPLITS.index(split)])
        return np.arange(first, first + self.counts[split], dtype=np.int32)

    @property
    @abc.abstractmethod
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context."""

    @property
    @abc.abstractmethod
    def discrete(self) -> bool:
        """Whether an action is a number of a choice, as ``spec.action`` says too; this needs no compiled model."""

    @property
    @abc.abstractmethod
    def episode_length(self) -> int:
        """Return the steps after which the longest episode is cut off."""

    @property
    @abc.abstractmethod
    def engine_name(self) -> str:
        """Return what steps its worlds: "jax" or the name of a physics engine."""

    @property
    def forgetful(self) -> str:
        """Return the names of families whose worlds are lost with the process; empty if there are none."""
        return ", ".join(part.family.name for part in self.parts if part.family.forgets)

    @property
    @abc.abstractmethod
    def summary(self) -> str:
        """Return a line on its tasks."""

    @property
    @abc.abstractmethod
    def parts(self) -> tuple[Part, ...]:
        """Return its families."""

    @abc.abstractmethod
    def apart(self, states: Any) -> tuple[Any, ...]:
        """Return the states of each part."""

    @abc.abstractmethod
    def own_row(self, row: int) -> int:
        """Return the row of the family's own table for a row of this table."""

    @abc.abstractmethod
    def describe(self, row: int) -> str:
        """Return a task's varied parameters as text, such as "size=0.95"."""

    @abc.abstractmethod
    def labels(self, split: str) -> list[str]:
        """Return a short name for every task of a split."""

    @abc.abstractmethod
    def task_values(self, split: str) -> np.ndarray:
        """Return the values (T,) that tell the tasks of a split apart."""

    @property
    @abc.abstractmethod
    def task_axis(self) -> tuple[str, str]:
        """Return name and unit of ``task_values``."""

    @abc.abstractmethod
    def reset(self, task: Task, key: Key) -> Step: ...
    @abc.abstractmethod
    def step(self, task: Task, state: Any, action: Array) -> Step: ...
    @abc.abstractmethod
    def reset_worlds(self, tasks: Task, keys: Key) -> Step: ...
    @abc.abstractmethod
    def step_worlds(self, tasks: Task, states: Any, actions: Array) -> Step: ...
    @abc.abstractmethod
    def renew_worlds(self, tasks: Task, keys: Key, mask: Array, states: Any) -> Step: ...
    @abc.abstractmethod
    def where_worlds(self, mask: Array, new: Any, old: Any) -> Any: ...

    @abc.abstractmethod
    def sentence(self, row: int) -> str:
        """Return what a task asks for, such as "Spin the body with the finger, with size 0.95."."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return what the tasks of all splits ask for, in the order of their numbers."""
        return tuple(self.sentence(row) for split in SPLITS for row in self.table.rows[split].tolist())

    def params(self, split: str) -> dict[str, Any]:
        """Return the values (T,) of the parameters of a split's tasks; of a mixture their names as ``task_name``."""
        params = self.tasks(split).params
        return {name: np.asarray(x) for name, x in params.items()} or {"task_name": self.labels(split)}

    def targets(self) -> dict[str, Any]:
        """Return what ``provide`` needs for every call out of XLA in programs of this environment, by its name there.

        Only physics that another library computes makes such calls.
        """
        found = [(i, each) for i, maker in enumerate(self._outside) if maker for each in maker.targets().items()]
        return {name: [i, *about] for i, (name, about) in found}

    def provide(self, maker: int, *about: Any) -> str:
        """Make a call out of XLA for a program that was traced in another process, and return its name."""
        return self._outside[maker].provide(*about)

    def load_kernels(self) -> bool:
        """Compile or load what runs outside XLA. Return whether XLA must compile nothing while programs first run."""
        return any([maker.load_kernels() for maker in self._outside if maker])

    @property
    def _outside(self) -> list[Any]:
        """Return what makes calls out of XLA: the engine of each part, then the painter of each part."""
        families = [part.family for part in self.parts]
        return [family.outside for family in families] + [family.outside_painter for family in families]

    def tasks(self, split: str = "train") -> Task:
        """Return the tasks of a split: "train", "interpolation", "extrapolation", or "all" in this order."""
        require_text(split, "split")
        table = self.table
        splits = {**table.rows, "all": np.concatenate(list(table.rows.values()))}
        if split not in splits:
            raise InputError(f"unknown split {split!r}; choose from {', '.join(splits)}")
        take = lambda rows: jax.device_put(jax.tree.map(lambda x: x[rows], table.tasks))  # jnp.asarray would compile
        tasks = take(splits[split])
        if table.draws is None:
            return tasks
        rows, contexts = table.draws[splits[split]], table.tasks.context
        alike = np.all(contexts[rows] == contexts[splits[split], None])  # as of hidden goals, so nothing stores them
        draws = take(rows)
        return tasks._replace(draws=draws._replace(context=None) if alike else draws)
