"""Mixtures: families with different observations, actions, horizons and physics, as one environment.

A mixture has the tasks of its families, one family after another in every split. Families whose models have the same
structure, or whose things fit into one scene, step together (``simulator_groups``). Every other family steps its own
worlds in a separate call. Observed vectors are padded with zeros to one size, and actions beyond a family's own are
masked.
"""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import tyro

from mtjax import frames
from mtjax.envs import naming, task_table
from mtjax.envs.blocks import Blocks, States, blocks_of
from mtjax.envs.family import Family
from mtjax.envs.mixed_table import mixed_spec, mixed_table
from mtjax.envs.shared_simulator import take
from mtjax.envs.simulator_groups import SCENES, Group, grouped
from mtjax.envs.task_table import Part, Table, fields_alone, owner
from mtjax.names import nearest_error
from mtjax.types import Array, InputError, Key, Spec, Step, Task


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

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Return the families, and the places of their tasks in each split."""
        blocks = blocks_of([family.counts for family in self.families])
        return tuple(
            Part(name, family, {split: found.places(i) for split, found in blocks.items()}, self.families[:i])
            for i, (name, family) in enumerate(zip(self.names, self.families, strict=True))
        )

    @cached_property
    def table(self) -> Table:
        """Return the families' tables one after another. Tasks are numbered in the order of the splits."""
        return mixed_table(self.families, self.spec.action_size)

    @cached_property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context, those of the widest family."""
        return mixed_spec(dict(zip(self.names, self.families, strict=True)), self.sentences)

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

    @property
    def engine_name(self) -> str:
        """Return the engines of all families."""
        return ", ".join(dict.fromkeys(family.engine_name for family in self.families))

    # What mixtures do as families do.

    __getstate__, tasks, own_row, sentence = fields_alone, task_table.tasks, task_table.own_row, naming.sentence
    counts, train_count, calls = task_table.counts, task_table.train_count, task_table.calls
    numbers, params, labels, describe = naming.numbers, naming.params, naming.labels, naming.describe
    task_values, task_axis, sentences, summary = naming.task_values, naming.task_axis, naming.sentences, naming.summary

    # Worlds, leaves (S, T, E, ...).

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Return the families by what steps them: one simulator for several, or each its own."""
        return grouped(self.families, self.scenes)

    def reset_worlds(self, tasks: Task, keys: Key) -> Step:
        """Begin an episode in every world."""
        own = _own_tasks(self, tasks)
        given = {i: tasks.blocks.take(keys, i) for i in own}
        steps = _by_group(self.groups, own, lambda group, of: group.reset_worlds(of(own), of(given)))
        return _whole(self, tasks.blocks, steps)

    def renew_worlds(self, tasks: Task, keys: Key, mask: Array, states: States) -> Step:
        """Begin an episode in the worlds of ``mask`` (S, T, E), whose observations alone count."""
        own = _own_tasks(self, tasks)
        given, masks = ({i: tasks.blocks.take(x, i) for i in own} for x in (keys, mask))
        renew = lambda group, of: group.renew_worlds(of(own), of(given), of(masks), of(states.families))
        return _whole(self, tasks.blocks, _by_group(self.groups, own, renew))

    def step_worlds(self, tasks: Task, states: States, actions: Array) -> Step:
        """Step every world by its action (S, T, E, A)."""
        own = _own_tasks(self, tasks)
        given = {i: self.families[i].action.narrow(tasks.blocks.take(actions, i)) for i in own}
        move = lambda group, of: group.step_worlds(of(own), of(states.families), of(given))
        return _whole(self, tasks.blocks, _by_group(self.groups, own, move))

    def where_worlds(self, mask: Array, new: States, old: States) -> States:
        """Choose states by ``mask`` (S, T, E)."""
        chosen = [
            None if ours is None else self.families[i].where_worlds(new.blocks.take(mask, i), ours, theirs)
            for i, (ours, theirs) in enumerate(zip(new.families, old.families, strict=True))
        ]
        return new._replace(families=tuple(chosen))

    # A single world, outside of compiled programs.

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of a task that is not traced. The state is the family's own."""
        family, own = _member(self, task)
        return _padded(self, family, family.reset(own, key))

    def step(self, task: Task, state: Any, action: Array) -> Step:
        """Advance a world of a task that is not traced."""
        family, own = _member(self, task)
        return _padded(self, family, family.step(own, state, family.action.narrow(action)))


def _own_tasks(mixture: Mixture, tasks: Task) -> dict[int, Task]:
    """Return the tasks of each family in that family's own form."""
    blocks = tasks.blocks
    if blocks is None or blocks.count != tasks.id.shape[1]:
        raise InputError("the worlds of a mixture are those of a whole split: env.tasks(split), and not some of it")
    rows = {i: blocks.take(tasks.row, i) - mixture.parts[i].first for i in dict.fromkeys(i for i, _ in blocks.runs)}
    return {i: take(mixture.families[i].table.tasks, each) for i, each in rows.items()}


def _by_group(groups: tuple[Group, ...], own: dict[int, Task], play: Callable) -> dict[int, Step]:
    """Return the steps of all families, by ``play(group, of)``. ``of`` picks the parts of the group's families."""
    steps = {}
    for group in groups:
        here = [i for i in group.members if i in own]  # a split may have no task of a family
        steps |= play(group, lambda parts, here=here: {i: parts[i] for i in here}) if here else {}
    return steps


def _whole(mixture: Mixture, blocks: Blocks, steps: dict[int, Step]) -> Step:
    """Join the steps of the families."""
    steps = {i: _padded(mixture, mixture.families[i], step) for i, step in steps.items()}
    states = tuple(steps[i].state if i in steps else None for i in range(len(mixture.families)))
    join = lambda of: blocks.join({i: of(step) for i, step in steps.items()})
    names = sorted({name for step in steps.values() for name in step.metrics})
    unknown = lambda step: jnp.full(step.reward.shape, jnp.nan)
    never = lambda step: jnp.zeros(step.reward.shape, bool)
    cut_off = any(step.truncated is not None for step in steps.values())
    return Step(
        state=States(blocks, states),
        obs=jax.tree.map(lambda *x: blocks.join(dict(zip(steps, x, strict=True))), *(s.obs for s in steps.values())),
        reward=join(lambda step: step.reward),
        terminated=join(lambda step: step.terminated),
        metrics={name: join(lambda step, name=name: step.metrics.get(name, unknown(step))) for name in names},
        truncated=join(lambda s: never(s) if s.truncated is None else s.truncated) if cut_off else None,
    )


def _padded(mixture: Mixture, family: Family, step: Step) -> Step:
    """Return a step with the vector (..., O') that networks take of it, padded with zeros to the mixture's."""
    join, obs = frames.layout(family.spec.obs), step.obs
    size = frames.state_size(mixture.spec)
    wide = lambda x: jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, size - x.shape[-1])]) if x.shape[-1] < size else x
    return step._replace(obs=frames.with_state(wide, obs if join is None else join(obs)))


def _member(mixture: Mixture, task: Task) -> tuple[Family, Task]:
    """Return the family of a task that is not traced, and the task in that family's own form.

    Raises:
        InputError: the task is traced, so its family is unknown at compile time.
    """
    if isinstance(task.row, jax.core.Tracer):
        raise InputError(
            "in a compiled program the families of a mixture step whole splits, by reset_worlds and step_worlds; "
            "for single worlds take one of env.families"
        )
    part, row = owner(mixture, int(task.row))
    return part.family, jax.tree.map(lambda x: jnp.asarray(x[row]), part.family.table.tasks)


def apart(states: Any) -> tuple[Any, ...]:
    """Return the states of each part of an environment."""
    return states.families if isinstance(states, States) else (states,)


Tabled = Family | Mixture
"""Environments with a table of tasks. Configurations, reports and films use them."""


def require_family(env: Any, reason: str) -> None:
    """Raise InputError with the reason if ``env`` is a mixture.

    Raises:
        InputError: ``env`` is a mixture.
    """
    if isinstance(env, Mixture):
        raise InputError(f"{reason}, and {'+'.join(env.names)} is a mixture; take one family")
