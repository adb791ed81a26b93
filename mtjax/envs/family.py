"""A family: tasks of one kind, which differ in its parameters."""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Self

import jax
import numpy as np
import tyro

from mtjax.checks import require_not_negative, require_values
from mtjax.envs import naming, task_table, variation
from mtjax.envs.contexts import contexts, goals, ranges
from mtjax.envs.parameters import Parameter
from mtjax.envs.task_table import Part, Table, fields_alone
from mtjax.frames import shown
from mtjax.names import first_sentence
from mtjax.parallel import axes
from mtjax.types import Action, Array, Continuous, Discrete, InputError, Key, Spec, Step, Task, Transition

_MAX_DRAWS = 1000


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
    observes: ClassVar[str] = ""  # a name of what observations hold, that families share if every entry means the same
    finite_horizon: ClassVar[bool] = False  # how long an episode is, is part of the problem, and no mere limit of time
    fresh_goals: ClassVar[bool] = False  # every episode draws a goal of its own, whatever its task
    looks: ClassVar[Mapping[str, Parameter]] = MappingProxyType({})  # parameters that change only what is seen
    repeat: ClassVar[int] = 1  # control steps in a step
    pixels: ClassVar[int] = 0  # on each side of the pictures that agents observe; 0 if they see none
    frames: ClassVar[int] = 1  # how many of the last pictures an agent sees at once, if it observes pictures
    ends_early: ClassVar[bool] = True  # whether episodes may end before their limit; it decides how resets are computed
    reset_batches: ClassVar[int] = 16  # in how many all worlds are reset, if they end early; more where starts are dear
    cheap_starts: ClassVar[bool] = False  # whether to begin an episode costs a GPU less than to ask whether one ended
    films: ClassVar[bool] = False  # whether its worlds can be seen in films
    film_speed: ClassVar[float] = 1.0  # seconds of the world in a second of a film
    filmed: ClassVar[Callable[[], AbstractContextManager[None]]] = nullcontext  # a context to play filmed episodes in
    scenery: ClassVar[Any] = None  # what draws pictures that agents observe
    engine_name: ClassVar[str] = "jax"  # what steps its worlds: jax, or a physics engine or package
    simulator: ClassVar[Any] = None  # the engine, or what makes calls out of XLA; None: its own steps are all
    without_physics: ClassVar[Callable[..., Any]] = lambda self: self  # the same family, which takes no time to trace
    built_by: ClassVar[tuple[str, ...]] = ()  # modules beside the class's own with what makes its worlds

    def __post_init__(self):
        pairs = self.vary.items() if isinstance(self.vary, Mapping) else self.vary
        object.__setattr__(self, "vary", tuple((str(n), variation.write_values(v, str(n))) for n, v in pairs))
        if self.context_ranges is not None:
            scaled = tuple((str(name), float(low), float(high)) for name, low, high in self.context_ranges)
            object.__setattr__(self, "context_ranges", scaled)
        require_values(self, num_tasks=variation.MOST_TASKS, num_draws=variation.MOST_TASKS)
        if self.num_draws < 1 or self.num_tasks < 1:
            raise InputError("num-tasks and num-draws must be at least 1")
        require_not_negative(self, "task_seed")
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
        return {"model": {}, "goal": goals(self)}

    def sentence(self, row: int) -> str:
        """Return what a task asks for, and the parameters that are given."""
        return naming.sentence_of(self, row)

    @property
    def instruction(self) -> str:
        """Return what all tasks ask for, in a sentence."""
        return vars(type(self)).get("asks") or first_sentence(type(self).__doc__).split(" (")[0] + "."

    @property
    def every_parameter(self) -> Mapping[str, Parameter]:
        """Return all parameters that can vary."""
        return {**self.parameters, **self.looks, **self.parameters}

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
    def action(self) -> Action:
        """Return the kind and the size of actions."""
        return Discrete(self.action_size) if self.discrete else Continuous(self.action_size)

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        return self.episode_steps // self.repeat

    # What every family does.

    @cached_property
    def table(self) -> Table:
        """Return all tasks of all splits, and the draws of continuous ranges."""
        found = self.variation
        leaves: dict[str, Any] = {
            "id": np.arange(found.count, dtype=np.int32),
            "row": np.arange(found.count, dtype=np.int32),
            "context": contexts(self),
            "params": {name: np.float32(x) for name, x in found.values.items()},
            "horizon": np.full(found.count, self.episode_length, np.int32),
            "scene": None if self.scenery is None else self.scenery.leaves,
            **self.build(),
        }
        return Table(Task(**leaves), found.places, found.drawn)

    @cached_property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context, and how many pictures agents should see at once."""
        task = jax.tree.map(lambda x: x[0], self.table.tasks)
        step = jax.eval_shape(self.without_physics().reset, task, jax.eval_shape(jax.random.key, 0))
        frames = self.frames if shown(step.obs) else 1
        return Spec(step.obs, self.action, task.context.shape[0], frames=frames, sentences=self.sentences)

    @property
    def parts(self) -> tuple[Part, ...]:
        """Return the family itself as the only part."""
        found = self.variation.counts  # and not the table: names and presets ask for parts before a model is built
        places = {split: np.arange(count) for split, count in {**found, "all": sum(found.values())}.items()}
        return (Part("", self, places),)

    def scaled_as(self, other: "Family") -> Self:
        """Return these tasks with contexts of another family's parameters and ranges.

        A network that was trained on the other family can then read them. A parameter that does not vary here has its
        one value. A parameter that is unknown here has the middle of its range (0 in the context). A parameter that
        varies only here is not in the context.
        """
        return dataclasses.replace(self, context_ranges=ranges(other))

    # What families do as mixtures do.

    __getstate__, tasks, own_row = fields_alone, task_table.tasks, task_table.own_row
    counts, train_count, calls = task_table.counts, task_table.train_count, task_table.calls
    numbers, params, labels, describe = naming.numbers, naming.params, naming.labels, naming.describe
    task_values, task_axis, sentences, summary = naming.task_values, naming.task_axis, naming.sentences, naming.summary
    varied, called = naming.varied, naming.called
    reset_worlds, step_worlds, renew_worlds = axes.reset_worlds, axes.step_worlds, axes.renew_worlds  # (S, T, E, ...)
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
