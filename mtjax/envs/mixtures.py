"""Mixtures: families with different observations, actions, horizons and physics, as one environment.

A mixture has the tasks of its families, one family after another in every split. Families whose models have the same
structure, or whose things fit into one scene, step together (``simulator_groups``). Every other family steps its own
worlds in a separate call. Observed vectors are padded with zeros to one size, and actions beyond a family's own are
masked.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from mtjax import frames
from mtjax.envs.blocks import AnyOne, Blocks, merged
from mtjax.envs.family import Family
from mtjax.envs.shared_simulator import take
from mtjax.envs.simulator_groups import SCENES, Group, grouped
from mtjax.envs.task_table import Outside, Part, Table, fields_alone, numbers, params
from mtjax.names import nearest_error
from mtjax.types import SPLITS, Array, InputError, Key, Spec, Step, Task


def _look(spec: Spec) -> str:
    """Return what an observation shows, as text."""
    if not frames.shown(spec.obs):
        return "no pictures"
    beside = "" if frames.state(frames.joined(spec.obs)) is None else " beside a state"
    return f"{spec.frames} pictures {spec.obs[frames.PICTURES].shape}{beside}"


def _metrics_of(steps: Mapping[int, Any]) -> list[str]:
    """Return the names of all metrics that families have."""
    return sorted({name for step in steps.values() for name in step.metrics})


class States(NamedTuple):
    """The states of a mixture's worlds, by family."""

    blocks: Blocks | AnyOne
    families: tuple[Any, ...]  # each family's own states, leaves (S, T', E, ...); None where a split has no task of it


@dataclasses.dataclass(frozen=True)
class Mixture:
    """An environment with the tasks of several families, from ``mtjax.mixture`` or ``mtjax.make("NAME+NAME")``.

    Observation (O,): the family's own, padded with zeros to that of the widest family. One of several arrays is joined
        to a vector before. Pictures are not padded: either
        no family shows any, or all show pictures of one shape, with or without a state (O,) beside them.
    Action: as many entries, or choices, as the widest family has. A task's ``action_mask`` (A,) says which of them are
        its own. Either all families have continuous actions, or all have discrete ones.
    Context (C,): the family as one-hot, then one slot per family. The task's own slot holds its context in that family;
        other slots are zero. A family whose contexts are all zero, because it has a single task, has no slot. The
        nearest training task of an unseen task is in its own family; of a family that does not train it is the first.
    Metrics: those of all families. They are NaN for a family that has no such metric.
    Reward, start, termination and time limit are each family's own.

    A mixture of one family is that family: the same context, no mask, one normaliser.
    """

    families: Annotated[tuple[Family, ...], tyro.conf.Suppress]
    names: Annotated[tuple[str, ...], tyro.conf.Suppress]
    scenes: str = "auto"
    """How many simulators step families of different scenes, such as Meta-World's: union (one scene holds the things of
    several families), joined (one simulator for each scene) or apart (one for each family). auto is union on engine
    warp, where a step costs nearly the same for any number of worlds, and joined elsewhere. Families that cannot be
    united are joined, or apart."""

    def __post_init__(self):
        if not self.families or len(self.names) != len(self.families):
            raise InputError("a mixture needs at least one family, and a name for each")
        if self.scenes not in SCENES:
            raise nearest_error("scenes", self.scenes, SCENES)
        for i, (name, family) in enumerate(zip(self.names, self.families, strict=True)):
            if not isinstance(family, Family):
                raise InputError(f"a mixture is of families, and {family!r} is none")
            if family in self.families[:i]:
                raise InputError(f"{name} is in the mixture twice, with the same tasks; vary something in one of them")

    # Tasks.

    __getstate__, numbers, params = fields_alone, numbers, params

    @property
    def counts(self) -> dict[str, int]:
        """Return the number of tasks of each split."""
        return {split: sum(family.counts[split] for family in self.families) for split in SPLITS}

    @property
    def train_count(self) -> int:
        """Return the number of training tasks."""
        return self.counts["train"]

    @cached_property
    def table(self) -> Table:
        """Return the families' tables one after another. Tasks are numbered in the order of the splits."""
        tables = [family.table for family in self.families]
        rows = {
            split: np.concatenate([first + table.rows[split] for first, table in zip(self._first, tables, strict=True)])
            for split in SPLITS
        }
        listed = np.concatenate(list(rows.values()))
        count = sum(len(table.tasks.id) for table in tables)
        numbers = np.zeros(count, np.int32)
        numbers[listed] = np.arange(len(listed))
        leaves: dict[str, Any] = {
            "id": numbers,
            "row": np.arange(count, dtype=np.int32),
            "context": self._context(),
            "params": {},
            "model": {},
            "goal": {},
            "horizon": np.concatenate([table.tasks.horizon for table in tables]),
            "action_mask": self._mask(),
        }
        return Table(Task(**leaves), rows, self._draws(count))

    @cached_property
    def _first(self) -> np.ndarray:
        """Return the row at which each family's table begins."""
        counts = [len(family.table.tasks.id) for family in self.families]
        return np.cumsum([0, *counts[:-1]])

    def _context(self) -> np.ndarray:
        """Return the contexts (R, C) of all rows."""
        contexts = [np.asarray(family.table.tasks.context) for family in self.families]
        if len(contexts) == 1:
            return contexts[0]
        slots = [context if np.any(context) else context[:, :0] for context in contexts]
        ends = len(slots) + np.cumsum([slot.shape[1] for slot in slots])
        rows = []
        for i, (slot, end) in enumerate(zip(slots, ends, strict=True)):
            row = np.zeros((len(slot), ends[-1]), np.float32)
            row[:, i] = 1
            row[:, end - slot.shape[1] : end] = slot
            rows.append(row)
        return np.concatenate(rows)

    def _mask(self) -> np.ndarray | None:
        """Return which actions (R, A) each task has; None if all tasks have all actions."""
        masks = []
        for family in self.families:
            own = family.table.tasks.action_mask
            shape = (len(family.table.tasks.id), family.spec.action_size)
            masks.append(np.ones(shape, np.float32) if own is None else np.float32(own))
        whole = np.concatenate([np.pad(x, ((0, 0), (0, self.spec.action_size - x.shape[1]))) for x in masks])
        return None if np.all(whole == 1) else whole

    def _draws(self, count: int) -> np.ndarray | None:
        """Return the rows (R, P) from which the episodes of each row draw. A family without draws has its own row."""
        drawn = [family.table.draws for family in self.families]
        widths = {draws.shape[1] for draws in drawn if draws is not None}
        if not widths:
            return None
        if len(widths) > 1:
            raise InputError(
                f"families of a mixture must draw alike; give all the same num-draws, not {sorted(widths)}"
            )
        rows = np.repeat(np.arange(count)[:, None], widths.pop(), axis=1)
        for first, draws in zip(self._first, drawn, strict=True):
            if draws is not None:
                rows[first : first + len(draws)] = first + draws
        return rows

    def tasks(self, split: str = "train") -> Task:
        """Return the tasks of a split: "train", "interpolation", "extrapolation", or "all" in this order."""
        return self.table.of(split)._replace(blocks=self._blocks[split])

    @cached_property
    def _blocks(self) -> dict[str, Blocks]:
        runs = {split: [(i, len(f.table.rows[split])) for i, f in enumerate(self.families)] for split in SPLITS}
        runs["all"] = [run for split in SPLITS for run in runs[split]]
        marks = len(self.families) if len(self.families) > 1 else 0
        return {split: Blocks(merged(found), marks) for split, found in runs.items()}

    @property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context, those of the widest family."""
        return self._spec

    @cached_property
    def _spec(self) -> Spec:
        specs = [family.spec for family in self.families]
        self._require_one_look(specs)
        self._require_one_kind(specs)
        widest: Any = jax.ShapeDtypeStruct((max(map(frames.state_size, specs)),), jnp.float32)
        return Spec(
            obs=frames.with_state(lambda _: widest, frames.joined(specs[0].obs)),
            action=max((spec.action for spec in specs), key=lambda action: action.size),
            context_size=self._context().shape[1],
            mixed=len(self.families) > 1,
            frames=specs[0].frames,
            sentences=self.sentences,
        )

    def _require_one_look(self, specs: list[Spec]) -> None:
        """Refuse to mix families with and without pictures, or with pictures of several shapes."""
        looks = {name: _look(spec) for name, spec in zip(self.names, specs, strict=True)}
        (first, look), *rest = looks.items()
        other = next((name for name, found in rest if found != look), None)
        if other is not None:
            raise InputError(
                f"families of a mixture are seen alike: {first} shows {look} and {other} {looks[other]}; "
                "give all the same pixels, frames, grey and state"
            )

    def _require_one_kind(self, specs: list[Spec]) -> None:
        """Refuse to mix families with continuous actions and with discrete ones."""
        kinds = {name: spec.action.kind for name, spec in zip(self.names, specs, strict=True)}
        (first, kind), *rest = kinds.items()
        other = next((name for name, found in rest if found != kind), None)
        if other is not None:
            told = f"{first} has {kind} actions and {other} {kinds[other]} ones"
            scored = any(hasattr(family, "scores") for family in self.families)
            fix = "; scores=True (--env.scores) makes discrete ones continuous" if scored else ""
            raise InputError(f"families of a mixture act alike, as one policy draws for all: {told}{fix}")

    @property
    def discrete(self) -> bool:
        """Whether some family has discrete actions; then all must have."""
        return any(family.discrete for family in self.families)

    @property
    def finite_horizon(self) -> bool:
        """Return whether how long an episode is, is part of the problem in all families."""
        return all(family.finite_horizon for family in self.families)

    @property
    def episode_length(self) -> int:
        """Return the steps of the longest family's episodes."""
        return max(family.episode_length for family in self.families)

    # Worlds, leaves (S, T, E, ...).

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Return the families by what steps them: one simulator for several, or each its own."""
        return grouped(self.families, self.scenes)

    def reset_worlds(self, tasks: Task, keys: Key) -> Step:
        """Begin an episode in every world."""
        return self._play("reset_worlds", tasks, lambda i, of: (of(keys),))

    def renew_worlds(self, tasks: Task, keys: Key, mask: Array, states: States) -> Step:
        """Begin an episode in the worlds of ``mask`` (S, T, E), whose observations alone count."""
        return self._play("renew_worlds", tasks, lambda i, of: (of(keys), of(mask), states.families[i]), states)

    def step_worlds(self, tasks: Task, states: States, actions: Array) -> Step:
        """Step every world by its action (S, T, E, A)."""
        narrow = lambda i, actions: self.families[i].spec.action.narrow(actions)
        return self._play("step_worlds", tasks, lambda i, of: (states.families[i], narrow(i, of(actions))), states)

    def _play(self, method: str, tasks: Task, given: Callable, before: States | None = None) -> Step:
        """Call a method of every family that has tasks, and join their steps.

        Args:
            given: ``given(i, of)`` returns what the method of family i takes after its tasks; ``of`` picks the family's
                part of leaves (S, T, E, ...).
            before: the states of all families, if there are any yet.
        """
        blocks = tasks.blocks
        if isinstance(blocks, AnyOne):
            return self._play_one(method, tasks, given, before)
        own, steps = self._apart(tasks), {}
        taken = {i: given(i, partial(blocks.take, family=i)) for i in own}
        for group in self.groups:
            here = [i for i in group.members if i in own]  # a split may have no task of a family
            if here:
                parts = [dict(zip(here, part, strict=True)) for part in zip(*(taken[i] for i in here), strict=True)]
                steps |= getattr(group, method)({i: own[i] for i in here}, *parts)
        return self._whole(blocks, steps)

    def _play_one(self, method: str, tasks: Task, given: Callable, before: States | None) -> Step:
        """Call a method of the one family whose task all worlds (S, 1, E) have, in that family's own simulator.

        The task is data: a branch of the program plays its family, and the others' worlds stay as they are.
        """
        members, firsts = tasks.blocks.families, jnp.asarray(self._first[list(tasks.blocks.families)])

        def play(i: int) -> Step:
            own = take(self.families[i].table.tasks, tasks.row - int(self._first[i]))
            return getattr(self.families[i], method)(own, *given(i, lambda tree: tree))

        shapes = {i: jax.eval_shape(partial(play, i)) for i in members}
        names = _metrics_of(shapes)
        cut_off = any(step.truncated is not None for step in shapes.values())
        zeros = lambda i: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes[i].state) if i in shapes else None
        states = tuple(map(zeros, range(len(self.families)))) if before is None else before.families

        def branch(i: int) -> Step:
            step = play(i)
            whole = self._padded(i, step, names, cut_off)
            return whole._replace(state=States(tasks.blocks, (*states[:i], step.state, *states[i + 1 :])))

        turn = jnp.sum(tasks.row[0, 0, 0] >= firsts) - 1
        return jax.lax.switch(turn, [partial(branch, i) for i in members])

    def where_worlds(self, mask: Array, new: States, old: States) -> States:
        """Choose states by ``mask`` (S, T, E)."""
        chosen = [
            None if ours is None else self.families[i].where_worlds(new.blocks.take(mask, i), ours, theirs)
            for i, (ours, theirs) in enumerate(zip(new.families, old.families, strict=True))
        ]
        return new._replace(families=tuple(chosen))

    def _apart(self, tasks: Task) -> dict[int, Task]:
        """Return the tasks of each family in that family's own form."""
        blocks = tasks.blocks
        if blocks is None or blocks.count != tasks.id.shape[1]:
            raise InputError("the worlds of a mixture are those of a whole split: env.tasks(split), and not some of it")
        rows = {i: blocks.take(tasks.row, i) - int(self._first[i]) for i in dict.fromkeys(i for i, _ in blocks.runs)}
        return {i: take(self.families[i].table.tasks, each) for i, each in rows.items()}

    def _whole(self, blocks: Blocks, steps: dict[int, Step]) -> Step:
        """Join the steps of the families."""
        names, cut_off = _metrics_of(steps), any(step.truncated is not None for step in steps.values())
        padded = [self._padded(i, step, names, cut_off)._replace(state=None) for i, step in steps.items()]
        joined = jax.tree.map(lambda *x: blocks.join(dict(zip(steps, x, strict=True))), *padded)
        states = tuple(steps[i].state if i in steps else None for i in range(len(self.families)))
        return joined._replace(state=States(blocks, states))

    def _padded(self, i: int, step: Step, metrics: list[str], cut_off: bool) -> Step:
        """Return a family's step as the mixture has them: with wide observations, and with NaN for other metrics."""
        unknown, never = jnp.full(step.reward.shape, jnp.nan), jnp.zeros(step.reward.shape, bool)
        cut = never if step.truncated is None else step.truncated
        return step._replace(
            obs=self.pad(self.families[i], step.obs),
            metrics={name: step.metrics.get(name, unknown) for name in metrics},
            truncated=cut if cut_off else None,
        )

    def pad(self, family: Family, obs: Any) -> Any:
        """Pad the vectors (..., O') that networks take of a family's observations with zeros to the mixture's."""
        join = frames.layout(family.spec.obs)
        obs = obs if join is None else join(obs)
        size = frames.state_size(self.spec)
        wide = lambda x: jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, size - x.shape[-1])]) if x.shape[-1] < size else x
        return frames.with_state(wide, obs)

    # A single world, outside of compiled programs.

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of a task that is not traced. The state is the family's own."""
        family, own = self.member(task)
        step = family.reset(own, key)
        return step._replace(obs=self.pad(family, step.obs))

    def step(self, task: Task, state: Any, action: Array) -> Step:
        """Advance a world of a task that is not traced."""
        family, own = self.member(task)
        step = family.step(own, state, family.spec.action.narrow(action))
        return step._replace(obs=self.pad(family, step.obs))

    def member(self, task: Task) -> tuple[Family, Task]:
        """Return the family of a task that is not traced, and the task in that family's own form.

        Raises:
            InputError: the task is traced, so its family is unknown at compile time.
        """
        if isinstance(task.row, jax.core.Tracer):
            raise InputError(
                "in a compiled program the families of a mixture step whole splits, by reset_worlds and step_worlds; "
                "for single worlds take one of env.families"
            )
        i, row = self._place(int(task.row))
        return self.families[i], jax.tree.map(lambda x: jnp.asarray(x[row]), self.families[i].table.tasks)

    # Names.

    def _place(self, row: int) -> tuple[int, int]:
        """Return the family of a row of the table, and the row in its own table."""
        i = int(np.searchsorted(self._first, row, side="right")) - 1
        return i, row - int(self._first[i])

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Return the families, and the places of their tasks in each split."""
        found = []
        for i, (name, family) in enumerate(zip(self.names, self.families, strict=True)):
            places = {
                split: np.concatenate([np.arange(place.start, place.stop) for j, place in blocks.slices() if j == i])
                if any(j == i for j, _ in blocks.runs)
                else np.zeros(0, int)
                for split, blocks in self._blocks.items()
            }
            found.append(Part(name, family, places))
        return tuple(found)

    @property
    def calls(self) -> Outside:
        """Return what makes calls out of XLA in its programs: the engines, the painters, and groups' own engines."""
        own = [f.outside for f in self.families] + [f.outside_painter for f in self.families]
        return Outside((*own, *(group.outside for group in self.groups if group.outside not in own)))

    def apart(self, states: States) -> tuple[Any, ...]:
        """Return the states of each part."""
        return states.families

    def sentence(self, row: int) -> str:
        """Return what a task asks for."""
        i, own = self._place(row)
        return self.families[i].sentence(own)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return what the tasks of all splits ask for. It needs no table, for which the sizes have to be known."""
        rows = [(f, row) for split in SPLITS for f in self.families for row in f.table.rows[split].tolist()]
        return tuple(family.sentence(row) for family, row in rows)

    def own_row(self, row: int) -> int:
        """Return the row of the family's own table for a row of this table."""
        return self._place(row)[1]

    def task_values(self, split: str) -> np.ndarray:
        """Return the numbers (T,) of a split's tasks."""
        return self.numbers(split)

    @property
    def task_axis(self) -> tuple[str, str]:
        """Return name and unit of ``task_values``."""
        return "task", "number"

    def labels(self, split: str) -> list[str]:
        """Return a short name for every task of a split, such as "walker-walk friction=0.7"."""
        found = [""] * len(self.table.rows[split])
        for part in self.parts:
            own, axis = part.family.labels(split), part.family.task_axis[0]
            for place, label in zip(part.places[split], own, strict=True):
                found[place] = part.name if _has_one_task(part.family) else f"{part.name} {axis}={label}"
        return found

    def describe(self, row: int) -> str:
        """Return the task of a row as text: its family and its varied parameters."""
        i, own = self._place(row)
        alone = _has_one_task(self.families[i])
        return self.names[i] if alone else f"{self.names[i]} {self.families[i].describe(own)}"

    @property
    def engine_name(self) -> str:
        """Return the engines of all families."""
        return ", ".join(dict.fromkeys(family.engine_name for family in self.families))

    @property
    def summary(self) -> str:
        """Return a line on its tasks."""
        count, many = self.train_count, len(self.families)
        kinds = ", ".join(
            name + (f" ({family.train_count}{': ' * bool(family.ends)}{family.ends})" * (family.train_count > 1))
            for name, family in zip(self.names, self.families, strict=True)
        )
        splits = "/".join(dict.fromkeys(family.split for family in self.families))
        return (
            f"{count} training task{'s' * (count > 1)} of {many} famil{'ies' if many > 1 else 'y'}: {kinds}; "
            f"split {splits}, engine {self.engine_name}"
        )


Tabled = Family | Mixture
"""Environments with a table of tasks. Configurations, reports and films use them."""


def require_family(env: Any, reason: str) -> None:
    """Raise InputError with the reason if ``env`` is a mixture.

    Raises:
        InputError: ``env`` is a mixture.
    """
    if isinstance(env, Mixture):
        raise InputError(f"{reason}, and {'+'.join(env.names)} is a mixture; take one family")


def _has_one_task(family: Family) -> bool:
    """Return whether a family's name says which of its tasks is meant. Goals that episodes draw are no tasks."""
    return not family.varied and sum(map(len, family.table.rows.values())) == 1
