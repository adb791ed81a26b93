"""Mixtures: families with different observations, actions, horizons and physics, as one environment.

A mixture has the tasks of its families, one family after another in every split. Families whose models have the same
structure, or whose things fit into one scene, step together (``simulator_groups``). Every other family steps its own
worlds in a separate call. Observed vectors are padded with zeros to one size, and actions beyond a family's own are
masked.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import tyro

from mtjax import frames
from mtjax.envs import naming, task_table
from mtjax.envs.blocks import AnyOne, Blocks, States, blocks_of
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
        to a vector before. Either no family shows pictures, or all show pictures of one shape, with or without a state
        (O,) beside them. If they show one at a time, their channels may differ, and are padded with zeros too.
    Action: as many entries, or choices, as the widest family has. A task's ``action_mask`` (A,) says which of them are
        its own. Either all families have continuous actions, or all have discrete ones, or all have several discrete
        ones at once, of the same sizes.
    Context (C,): the family as one-hot, then one slot per family. The task's own slot holds its context in that family;
        other slots are zero. A family whose contexts are all zero, because it has a single task, has no slot. The
        nearest training task of an unseen task is in its own family; of a family that does not train it is the first.
    Metrics: those of all families. They are NaN for a family that has no such metric.
    Reward, start, termination and time limit are each family's own.

    Normaliser: each task has one of its own, as entries of observations mean something else in each family. An unseen
        task takes that of its nearest training task. If all families observe the same (``Family.observes``), and some
        of them does not train, all tasks have one together.

    A mixture of one family is that family: the same context, no mask, one normaliser.
    """

    ends_early: ClassVar[bool] = True  # as some family's episodes may
    reset_batches: ClassVar[int] = Family.reset_batches
    cheap_starts: ClassVar[bool] = False
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
        """Return whether the limit of time is part of the problem in all families. Tasks say it where they differ."""
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
        return _play(self, "reset_worlds", tasks, lambda i, of: (of(keys),))

    def renew_worlds(self, tasks: Task, keys: Key, mask: Array, states: States) -> Step:
        """Begin an episode in the worlds of ``mask`` (S, T, E), whose observations alone count."""
        return _play(self, "renew_worlds", tasks, lambda i, of: (of(keys), of(mask), states.families[i]), states)

    def step_worlds(self, tasks: Task, states: States, actions: Array) -> Step:
        """Step every world by its action (S, T, E, A)."""
        narrow = lambda i, actions: self.families[i].action.narrow(actions)
        return _play(self, "step_worlds", tasks, lambda i, of: (states.families[i], narrow(i, of(actions))), states)

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
        return _seen(self, family, family.reset(own, key))

    def step(self, task: Task, state: Any, action: Array) -> Step:
        """Advance a world of a task that is not traced."""
        family, own = _member(self, task)
        return _seen(self, family, family.step(own, state, family.action.narrow(action)))


def _own_tasks(mixture: Mixture, tasks: Task) -> dict[int, Task]:
    """Return the tasks of each family in that family's own form."""
    blocks = tasks.blocks
    if blocks is None or blocks.count != tasks.id.shape[1]:
        raise InputError("the worlds of a mixture are those of a whole split: env.tasks(split), and not some of it")
    rows = {i: blocks.take(tasks.row, i) - mixture.parts[i].first for i in dict.fromkeys(i for i, _ in blocks.runs)}
    return {i: take(mixture.families[i].table.tasks, each) for i, each in rows.items()}


def _play(mixture: Mixture, method: str, tasks: Task, given: Callable, before: States | None = None) -> Step:
    """Call a method of every family that has tasks, and join their steps.

    Args:
        given: ``given(i, of)`` returns what the method of family i takes after its tasks; ``of`` picks the family's
            part of leaves (S, T, E, ...).
        before: the states of all families, if there are any yet.
    """
    blocks = tasks.blocks
    if isinstance(blocks, AnyOne):
        return _play_one(mixture, method, tasks, given, before)
    own, steps = _own_tasks(mixture, tasks), {}
    taken = {i: given(i, partial(blocks.take, family=i)) for i in own}
    for group in mixture.groups:
        here = [i for i in group.members if i in own]  # a split may have no task of a family
        if here:
            parts = [dict(zip(here, part, strict=True)) for part in zip(*(taken[i] for i in here), strict=True)]
            steps |= getattr(group, method)({i: own[i] for i in here}, *parts)
    return _whole(mixture, blocks, steps)


def _play_one(mixture: Mixture, method: str, tasks: Task, given: Callable, before: States | None) -> Step:
    """Call a method of the one family whose task all worlds (S, 1, E) have, in that family's own simulator.

    The task is data: a branch of the program plays its family, and the others' worlds stay as they are.
    """
    members = tasks.blocks.families
    firsts = [mixture.parts[i].first for i in members]

    def play(i: int) -> Step:
        own = take(mixture.families[i].table.tasks, tasks.row - mixture.parts[i].first)
        return getattr(mixture.families[i], method)(own, *given(i, lambda tree: tree))

    shapes = {i: jax.eval_shape(partial(play, i)) for i in members}
    names, cut_off = _metrics_of(shapes), _are_cut_off(shapes)
    zeros = lambda i: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes[i].state) if i in shapes else None
    states = tuple(map(zeros, range(len(mixture.families)))) if before is None else before.families

    def branch(i: int) -> Step:
        step = play(i)
        whole = _padded(mixture, i, step, names, cut_off)
        return whole._replace(state=States(tasks.blocks, (*states[:i], step.state, *states[i + 1 :])))

    turn = jnp.sum(tasks.row[0, 0, 0] >= jnp.asarray(firsts)) - 1
    return jax.lax.switch(turn, [partial(branch, i) for i in members])


def _whole(mixture: Mixture, blocks: Blocks, steps: dict[int, Step]) -> Step:
    """Join the steps of the families."""
    names, cut_off = _metrics_of(steps), _are_cut_off(steps)
    padded = [_padded(mixture, i, step, names, cut_off)._replace(state=None) for i, step in steps.items()]
    joined = jax.tree.map(lambda *x: blocks.join(dict(zip(steps, x, strict=True))), *padded)
    states = tuple(steps[i].state if i in steps else None for i in range(len(mixture.families)))
    return joined._replace(state=States(blocks, states))


def _metrics_of(steps: Mapping[int, Any]) -> list[str]:
    """Return the names of all metrics that families have."""
    return sorted({name for step in steps.values() for name in step.metrics})


def _are_cut_off(steps: Mapping[int, Any]) -> bool:
    """Return whether some family cuts episodes off."""
    return any(step.truncated is not None for step in steps.values())


def _padded(mixture: Mixture, i: int, step: Step, metrics: list[str], cut_off: bool) -> Step:
    """Return a family's step as the mixture has them: with wide observations, and with NaN for other metrics."""
    unknown, never = jnp.full(step.reward.shape, jnp.nan), jnp.zeros(step.reward.shape, bool)
    cut = never if step.truncated is None else step.truncated
    seen = _seen(mixture, mixture.families[i], step)
    return seen._replace(
        metrics={name: step.metrics.get(name, unknown) for name in metrics}, truncated=cut if cut_off else None
    )


def _seen(mixture: Mixture, family: Family, step: Step) -> Step:
    """Return a step with what networks take of it: vectors (..., O') and channels, padded with zeros to a mixture's."""
    join, obs = frames.layout(family.spec.obs), step.obs
    obs = frames.with_state(partial(_wide, frames.state_size(mixture.spec)), obs if join is None else join(obs))
    if frames.shown(obs):
        obs |= {frames.PICTURES: _wide(mixture.spec.obs[frames.PICTURES].shape[-1], obs[frames.PICTURES])}
    return step._replace(obs=obs)


def _wide(size: int, x: Array) -> Array:
    """Return an array (..., N) with zeros at the end of its last axis, up to ``size``."""
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, size - x.shape[-1])]) if x.shape[-1] < size else x


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


FamilyOrMixture = Family | Mixture
"""Environments with a table of tasks. Configurations, reports and films use them."""


def require_family(env: Any, reason: str) -> None:
    """Raise InputError with the reason if ``env`` is a mixture.

    Raises:
        InputError: ``env`` is a mixture.
    """
    if isinstance(env, Mixture):
        raise InputError(f"{reason}, and {'+'.join(env.names)} is a mixture; take one family")
