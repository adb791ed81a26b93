"""A family: tasks of one kind, which differ in its parameters."""

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Self

import jax
import numpy as np
import tyro

from mtjax.checks import require_values
from mtjax.envs import variation
from mtjax.envs.parameters import Parameter
from mtjax.envs.task_table import Outside, Part, Table, fields_alone, makers, numbers, params
from mtjax.frames import shown
from mtjax.names import first_sentence
from mtjax.parallel import axes
from mtjax.types import SPLITS, Array, Continuous, Discrete, InputError, Key, Spec, Step, Task, Transition

_MAX_DRAWS = 1000
Values = Mapping[str, np.ndarray]  # parameter -> (R,) its value in every row


@dataclasses.dataclass(frozen=True)
class Family(abc.ABC):
    """A family of tasks that differ in named parameters. Subclasses give parameters, ``reset`` and ``step``."""

    vary: Annotated[Any, tyro.conf.Suppress] = ()
    """Values of the parameters that differ between tasks: {"name": "lo:hi:n", "lo:hi", "a,b,c" or numbers}. A range
    "lo:hi" is continuous: each episode draws its own value. On a command line: ``--env.vary.NAME=...``."""
    combine: str = "grid"
    """How several --env.vary.NAME=VALUES combine: grid (all combinations), paired (first with first and so on) or
    random (num-tasks draws between the least and greatest value of each). VALUES are lo:hi:n, a list a,b,c, or lo:hi,
    from which every episode draws its own value."""
    num_tasks: int = 10
    """Number of training tasks with combine=random, and in families whose tasks are drawn."""
    num_draws: int = 256
    """Number of values drawn from the continuous ranges of each task, from which episodes take theirs."""
    task_seed: int = 0
    """Seed of random tasks and of values from continuous ranges. The run's seeds do not change them."""
    split: Annotated[str, tyro.conf.arg(name="split", prefix_name=False)] = "dense"
    """Which tasks train and which are held out: dense (train on all values; test between and beyond them), hip-bmdp
    (of ten values train on numbers 3, 4, 7 and 8 counted from 0; interpolation 5, 6; extrapolation 2, 9) or none."""

    context_ranges: Annotated[Any, tyro.conf.Suppress] = None
    """Parameters of the context, and the ranges that are scaled to [-1, 1]: ((name, low, high), ...). ``scaled_as``
    sets them to another family's. None takes the parameters that vary in training."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType({})
    action_size: ClassVar[int]
    discrete: ClassVar[bool] = False  # whether an action is the number of one of action_size choices, not a vector
    episode_steps: ClassVar[int]
    relabels: ClassVar[tuple[str, ...]] = ()  # the parameters, goals all of them, that ``relabel`` can exchange
    forgets: ClassVar[bool] = False  # whether its worlds are lost with the process, and cannot be saved
    asks: ClassVar[str] = ""  # what its tasks ask for, in a sentence; empty: the documentation's first one
    finite_horizon: ClassVar[bool] = False  # how long an episode is, is part of the problem, and no mere limit of time
    fresh_goals: ClassVar[bool] = False  # every episode draws a goal of its own, whatever its task
    looks: ClassVar[Mapping[str, Parameter]] = MappingProxyType({})  # parameters that change only what is seen
    repeat: ClassVar[int] = 1  # control steps in a step
    frames: ClassVar[int] = 1  # how many of the last pictures an agent sees at once, if it observes pictures
    films: ClassVar[bool] = False  # whether its worlds can be seen in films
    scenery: ClassVar[Any] = None  # what draws pictures that agents observe

    def __post_init__(self):
        pairs = self.vary.items() if isinstance(self.vary, Mapping) else self.vary
        object.__setattr__(self, "vary", tuple((str(n), variation.write_values(v, str(n))) for n, v in pairs))
        if self.context_ranges is not None:
            ranges = tuple((str(name), float(low), float(high)) for name, low, high in self.context_ranges)
            object.__setattr__(self, "context_ranges", ranges)
        require_values(self, num_tasks=variation.MOST_TASKS, num_draws=variation.MOST_TASKS)
        if self.num_draws < 1 or self.num_tasks < 1:
            raise InputError("num-tasks and num-draws must be at least 1")
        if self.task_seed < 0:
            raise InputError(f"task-seed must be at least 0, not {self.task_seed}")
        variation.require_known(self.combine, self.split)  # also where a family has tasks of its own making
        _ = self.variation

    # What a family gives.

    @abc.abstractmethod
    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a fresh random state."""

    @abc.abstractmethod
    def step(self, task: Task, state: Any, action: Array) -> Step:
        """Advance one step under ``action`` (A,) in [-1, 1]; observation and reward are those after it."""

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        """Return another task's transition as ``task`` would have had it. They may differ in ``relabels`` alone.

        Reward and observed goal are those of a step of ``task`` from the same state. The key draws the goal if every
        episode has its own.
        """
        raise NotImplementedError(f"{type(self).__name__} declares no parameters that it relabels")

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the "model" and "goal" leaves (R, ...) of every row of the table."""
        return {"model": {}, "goal": self.goals()}

    # What every family does.

    @cached_property
    def variation(self) -> variation.Variation:
        """Return the values of every task of every split."""
        return variation.vary(
            dict(self.vary),
            self.every_parameter,
            self.combine,
            self.num_tasks,
            self.split,
            self.num_draws,
            self.task_seed,
        )

    @property
    def every_parameter(self) -> Mapping[str, Parameter]:
        """Return all parameters that can vary."""
        return {**self.parameters, **self.looks, **self.parameters}

    def goals(self) -> dict[str, np.ndarray]:
        """Return the goal parameters (R,) of every row: varied, or nominal."""
        goals = {name: p.nominal for name, p in self.parameters.items() if p.edit is None}
        full = lambda x: np.array(np.broadcast_to(x, self.count), np.float32)
        return {name: full(self.values.get(name, nominal)) for name, nominal in goals.items()}

    @cached_property
    def values(self) -> Values:
        """Return the values (R,) of each varied parameter in every row of the table, in float64."""
        found = self.variation
        parts = [found.rows[split] for split in SPLITS]
        if found.draws is not None:
            parts.append(np.concatenate(list(found.draws)))
        return dict(zip(found.names, np.concatenate(parts).T, strict=True))

    __getstate__, numbers, params = fields_alone, numbers, params

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of tasks of each split."""
        return {split: len(rows) for split, rows in self.variation.rows.items()}

    @property
    def train_count(self) -> int:
        """Return the number of training tasks."""
        return self.counts["train"]

    def tasks(self, split: str = "train") -> Task:
        """Return the tasks of a split: "train", "interpolation", "extrapolation", or "all" in this order."""
        return self.table.of(split)

    @cached_property
    def count(self) -> int:
        """Return the number of rows of the table."""
        listed = sum(len(rows) for rows in self.variation.rows.values())
        return listed if self.variation.draws is None else listed + math.prod(self.variation.draws.shape[:2])

    @cached_property
    def table(self) -> Table:
        """Return all tasks of all splits, and the draws of continuous ranges."""
        sizes = [len(self.variation.rows[split]) for split in SPLITS]
        listed, draws = sum(sizes), None
        if self.count > listed:  # the first tasks draw; others, such as held-out ones, stay what they are
            draws = np.repeat(np.arange(listed)[:, None], self.num_draws, axis=1)
            drawn = np.arange(listed, self.count).reshape(-1, self.num_draws)
            draws[: len(drawn)] = drawn
        leaves: dict[str, Any] = {
            "id": np.arange(self.count, dtype=np.int32),
            "row": np.arange(self.count, dtype=np.int32),
            "context": self._context(),
            "params": {name: np.float32(x) for name, x in self.values.items()},
            "horizon": np.full(self.count, self.episode_length, np.int32),
            **self.build(),
        }
        if self.scenery is not None:
            leaves["scene"] = self.scenery.leaves
        rows: dict[str, np.ndarray] = dict(zip(SPLITS, np.split(np.arange(listed), np.cumsum(sizes)[:-1]), strict=True))
        return Table(Task(**leaves), rows, draws)

    def _context(self) -> np.ndarray:
        """Return the contexts (R, C): scaled parameters, and for an angle its sine and cosine.

        A single task has one constant number.
        """
        if not self.ranges:
            return np.zeros((self.count, 1), np.float32)
        return np.concatenate([self._columns(*of_one) for of_one in self.ranges], axis=1).astype(np.float32)

    def _columns(self, name: str, low: float, high: float) -> np.ndarray:
        """Return what contexts tell of a parameter that may be constant or unknown here: (R, 1), of an angle (R, 2)."""
        known = self.every_parameter[name].nominal if name in self.every_parameter else (low + high) / 2
        values = self.values.get(name, np.full(self.count, known))
        if name in self.parameters and self.parameters[name].direction:
            return np.stack([np.sin(values), np.cos(values)], axis=1)
        return variation.scale(values[:, None], np.array([low]), np.array([high]))

    @property
    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """Return the parameters of the context, and the ranges that are scaled to [-1, 1]."""
        if self.context_ranges is not None:
            return self.context_ranges
        found = self.variation
        ends = zip(found.names, found.low.tolist(), found.high.tolist(), strict=True)
        return tuple((name, low, high) for name, low, high in ends if low < high)

    def scaled_as(self, other: "Family") -> Self:
        """Return these tasks with contexts of another family's parameters and ranges.

        A network that was trained on the other family can then read them. A parameter that does not vary here has its
        one value. A parameter that is unknown here has the middle of its range (0 in the context). A parameter that
        varies only here is not in the context.
        """
        return dataclasses.replace(self, context_ranges=other.ranges)

    @property
    def varied(self) -> tuple[str, ...]:
        """Return the parameters that differ between training tasks or episodes."""
        return self.variation.varied

    def task_values(self, split: str) -> np.ndarray:
        """Return the values (T,) that tell the tasks of a split apart: the only varied parameter, or task numbers.

        No task is built for them.
        """
        rows = self.variation.rows[split]
        return rows[:, 0].astype(np.float32) if len(self.varied) == 1 else self.numbers(split)

    @property
    def task_axis(self) -> tuple[str, str]:
        """Return name and unit of ``task_values``."""
        return (
            (self.varied[0], self.every_parameter[self.varied[0]].unit) if len(self.varied) == 1 else ("task", "number")
        )

    def describe(self, row: int) -> str:
        """Return a task's varied parameters as text, such as "size=0.95"."""
        params = self.table.tasks.params
        tell = lambda name: self.every_parameter[name].tell(float(params[name][row]), 4)
        return ",".join(f"{name}={tell(name)}" for name in self.varied) or f"task={row}"

    @property
    def instruction(self) -> str:
        """Return what all tasks ask for, in a sentence."""
        return vars(type(self)).get("asks") or first_sentence(type(self).__doc__).split(" (")[0] + "."

    def sentence(self, row: int) -> str:
        """Return what a task asks for, and the parameters that are given."""
        found = self.variation
        if not found.names:
            return self.instruction
        drawn = found.draws is not None and row < self.train_count
        told = []
        for i, name in enumerate(found.names):
            parameter = self.every_parameter[name]
            ranged = drawn and np.ptp(found.draws[row, :, i]) > 0  # type: ignore
            value = parameter.tell(float(self.values[name][row]), 3)
            number = f"from {found.low[i]:.3g} to {found.high[i]:.3g}" if ranged else value
            told.append(f"{name.replace('-', ' ')} {number}" + f" {parameter.unit}" * (parameter.unit != "1"))
        return f"{self.instruction.removesuffix('.')}, with {' and '.join(told)}."

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return what the tasks of all splits ask for, in the order of their numbers."""
        return tuple(self.sentence(row) for split in SPLITS for row in self.table.rows[split].tolist())

    def labels(self, split: str) -> list[str]:
        """Return a short name for every task of a split: its ``task_values``."""
        tell = self.every_parameter[self.varied[0]].tell if len(self.varied) == 1 else Parameter("", 0.0).tell
        return [tell(float(value), 4) for value in self.task_values(split)]

    @property
    def parts(self) -> tuple[Part, ...]:
        """Return the family itself as the only part."""
        counts = self.counts  # without the table, as names and presets ask for the parts before a model is built
        counts["all"] = sum(counts.values())
        return (Part("", self, {split: np.arange(count) for split, count in counts.items()}),)

    def apart(self, states: Any) -> tuple[Any, ...]:
        """Return the states of each part."""
        return (states,)

    def own_row(self, row: int) -> int:
        """Return the row itself."""
        return row

    @property
    def ends(self) -> str:
        """Return the parameters that vary in training, with their least and greatest values."""
        found = self.variation
        ends = zip(found.names, found.low, found.high, strict=True)
        return ", ".join(f"{name} {low:g} to {high:g}" for name, low, high in ends if low < high)

    @property
    def summary(self) -> str:
        """Return a line on its tasks."""
        count, ends = self.train_count, self.ends
        tasks = f"{count} training task{'s' * (count > 1)}{', ' * bool(ends)}{ends}"
        return f"{tasks}, split {self.split}, engine {self.engine_name}"

    @property
    def engine_name(self) -> str:
        """Return what steps its worlds: "jax" or the name of a physics engine."""
        return "jax"

    @property
    def outside(self) -> Any:
        """Return the engine if it runs outside XLA, else None."""
        return None

    @property
    def modules(self) -> tuple[str, ...]:
        """Return the modules with the classes that make it."""
        return (type(self).__module__,)

    def filmed(self) -> AbstractContextManager[None]:
        """Return a context in which episodes that films show are played."""
        return nullcontext()

    @property
    def structure(self) -> Any:
        """Return what families must have in common to share a simulator in a mixture; None for one that stays alone."""
        return None

    @property
    def calls(self) -> Outside:
        """Return what makes calls out of XLA in its programs."""
        return Outside(makers(self))

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        return self.episode_steps // self.repeat

    @property
    def ends_early(self) -> bool:
        """Return whether episodes may end before their time limits. It decides how resets are computed, not what."""
        return True

    @property
    def action(self) -> Continuous | Discrete:
        """Return the kind and the size of actions."""
        return Discrete(self.action_size) if self.discrete else Continuous(self.action_size)

    @property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context."""
        return self._spec

    @cached_property
    def _spec(self) -> Spec:
        task = jax.tree.map(lambda x: x[0], self.table.tasks)
        step = jax.eval_shape(self.reset, task, jax.eval_shape(jax.random.key, 0))
        frames = self.frames if shown(step.obs) else 1
        return Spec(step.obs, self.action, task.context.shape[0], frames=frames, sentences=self.sentences)

    # All worlds, leaves (S, T, E, ...).

    reset_worlds, step_worlds, renew_worlds = axes.reset_worlds, axes.step_worlds, axes.renew_worlds
    observe_worlds, where_worlds = axes.observe_worlds, staticmethod(axes.where_worlds)


def draw_until(accepted: Callable[[Any], Array], draw: Callable[[Key], Any], key: Key) -> Any:
    """Draw until a draw is accepted, at most as often as dm_control does."""

    def again(carry):
        key, _, draws = carry
        key, draw_key = jax.random.split(key)
        return key, draw(draw_key), draws + 1

    def rejected(carry):
        _, drawn, draws = carry
        return ~accepted(drawn) & (draws < _MAX_DRAWS)

    return jax.lax.while_loop(rejected, again, again((key, None, 0)))[1]
