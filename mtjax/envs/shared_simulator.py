"""A simulator that several families of a mixture share.

Domains whose models have the same structure differ in numbers only, as the tasks of one domain do. So one engine can
hold the models of all their tasks, and step all their worlds in one call.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any, ClassVar, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.envs.compiled import stack_differing
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import Engine, World, at_rest
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.family import Family
from mtjax.envs.pixels import outcome
from mtjax.envs.task_table import outside
from mtjax.parallel.axes import over_worlds
from mtjax.types import Array, Key, Step, Task

T = TypeVar("T")
Of = dict[int, T]  # of families by their numbers in a mixture


@dataclasses.dataclass(frozen=True, eq=False)
class Alone:
    """A family that steps its own worlds."""

    members: Mapping[int, Family]  # the only one, by its number in the mixture
    outside: ClassVar[None] = None  # what it calls outside XLA is the family's

    def reset_worlds(self, tasks: Of[Task], keys: Of[Key]) -> Of[Step]:
        """Begin an episode in every world (S, T, E)."""
        return reset_apart(self.members, tasks, keys)

    def renew_worlds(self, tasks: Of[Task], keys: Of[Key], masks: Of[Array], states: Of[Any]) -> Of[Step]:
        """Begin an episode in the worlds of ``masks`` (S, T, E)."""
        return {i: self.members[i].renew_worlds(task, keys[i], masks[i], states[i]) for i, task in tasks.items()}

    def step_worlds(self, tasks: Of[Task], states: Of[Any], actions: Of[Array]) -> Of[Step]:
        """Return the next step of all worlds, leaves (S, T, E, ...)."""
        return {i: self.members[i].step_worlds(task, states[i], actions[i]) for i, task in tasks.items()}


@dataclasses.dataclass(frozen=True, eq=False)
class Joined:
    """Domains whose worlds one simulator begins and steps. Each sets its start or controls before, and observes after.

    Raises:
        InputError: the models differ in a field that must be the same for the engine.
    """

    members: Mapping[int, Domain]  # by their numbers in the mixture

    def __post_init__(self):
        self.simulator.require_variable(self._leaves)

    @cached_property
    def _models(self) -> list[Any]:
        return [model for domain in self.members.values() for model in domain.models]

    @cached_property
    def _leaves(self) -> dict[str, np.ndarray]:
        """Return the fields (R, ...) in which models differ: the rows of all members' tables, one after another."""
        return {name: np.asarray(leaf, np.float32) for name, leaf in stack_differing(self._models).items()}

    @cached_property
    def _first(self) -> dict[int, int]:
        """Return the row at which each member's models begin."""
        counts = [len(domain.models) for domain in self.members.values()]
        return dict(zip(self.members, np.cumsum([0, *counts[:-1]]).tolist(), strict=True))

    @cached_property
    def simulator(self) -> Engine:
        """Return the engine of all models. MJX and Warp receive the fields in which they differ with every step."""
        first = next(iter(self.members.values()))
        return MujocoC(self._models, first.num_substeps) if first.engine_name == "c" else first.simulator

    @property
    def outside(self) -> Any:
        """Return the engine if it runs outside XLA, as all but MJX do."""
        return outside(self.simulator)

    @cached_property
    def _begin_alike(self) -> bool:
        """Return whether all members begin episodes as ``Domain.reset`` does, and with the same sensors solved for."""
        plain = all(type(domain).reset is Domain.reset for domain in self.members.values())
        return plain and len({domain.starts_untouched for domain in self.members.values()}) == 1

    def reset_worlds(self, tasks: Of[Task], keys: Of[Key]) -> Of[Step]:
        """Begin an episode in every world (S, T, E). Members without tasks are left out.

        The simulator puts all worlds into their states at once, so that XLA compiles this once and not for each member.
        """
        if not self._begin_alike:
            return reset_apart(self.members, tasks, keys)
        started = {i: over_worlds(partial(_start, self.members[i]))(task, keys[i]) for i, task in tasks.items()}
        rows = _join([task.row + self._first[i] for i, task in tasks.items()])
        given = _join([world._replace(extra=None) for world in started.values()])
        untouched = next(iter(self.members.values())).starts_untouched
        begun = over_worlds(partial(_put, self.simulator, untouched))(rows, take(self._leaves, rows), given)
        steps = {}
        for i, world in self._apart(tasks, begun).items():
            world = world._replace(extra=started[i].extra)
            steps[i] = over_worlds(partial(_first_step, self.members[i]))(tasks[i], world, keys[i])
        return steps

    def renew_worlds(self, tasks: Of[Task], keys: Of[Key], masks: Of[Array], states: Of[World]) -> Of[Step]:
        """Begin an episode in the worlds of ``masks`` (S, T, E). The simulator resets all, and the others stay."""
        choose = lambda i, state: self.members[i].where_worlds(masks[i], state, states[i])
        begun = self.reset_worlds(tasks, keys)
        return {i: step._replace(state=choose(i, step.state)) for i, step in begun.items()}

    def step_worlds(self, tasks: Of[Task], states: Of[World], actions: Of[Array]) -> Of[Step]:
        """Return the next step of all worlds, leaves (S, T, E, ...). Members without tasks are left out."""
        controlled = {
            i: over_worlds(partial(_control, self.members[i]))(tasks[i], states[i], actions[i]) for i in tasks
        }
        rows = _join([task.row + self._first[i] for i, task in tasks.items()])
        given = _join([(self.enter(i, world)._replace(extra=None), ctrl) for i, (world, ctrl) in controlled.items()])
        moved = over_worlds(partial(_advance, self.simulator))(rows, take(self._leaves, rows), *given)
        steps = {}
        for i, world in self._apart(tasks, moved).items():
            world = self.leave(i, world)._replace(extra=controlled[i][0].extra)
            steps[i] = over_worlds(partial(_outcome, self.members[i]))(tasks[i], world, actions[i])
        return steps

    def _apart(self, tasks: Of[Task], worlds: World) -> Of[World]:
        """Return each member's worlds out of all, leaves (S, T, E, ...)."""
        ends = np.cumsum([0, *(task.row.shape[1] for task in tasks.values())]).tolist()
        places = dict(zip(tasks, map(slice, ends, ends[1:]), strict=False))
        return {i: jax.tree.map(lambda x, place=place: x[:, place], worlds) for i, place in places.items()}

    def enter(self, i: int, world: World) -> World:
        """Return the simulator's worlds (S, T, E, ...) for those of a member."""
        return world

    def leave(self, i: int, world: World) -> World:
        """Return a member's worlds (S, T, E, ...) for those of the simulator."""
        return world


def reset_apart(members: Mapping[int, Family], tasks: Of[Task], keys: Of[Key]) -> Of[Step]:
    """Begin an episode in every world (S, T, E), each family by itself."""
    return {i: members[i].reset_worlds(task, keys[i]) for i, task in tasks.items()}


def take(table: Any, rows: Array) -> Any:
    """Return those rows (S, T, E) of a table, leaves (R, ...)."""
    # A compiler that sees constants divides by them otherwise than by numbers that it does not know.
    hidden = jax.tree.map(lambda x: jax.lax.optimization_barrier(jnp.asarray(x)), table)
    return jax.tree.map(lambda x: jnp.take(x, rows, axis=0, mode="clip"), hidden)


def _join(trees: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *trees)


@partial(jax.jit, static_argnums=0)  # traced once for all programs, as families' own steps are
def _start(domain: Domain, task: Task, key: Key) -> World:
    return at_rest(domain.models[0], *domain.start(task, key))


@partial(jax.jit, static_argnums=(0, 1))
def _put(simulator: Engine, untouched: bool, row: Array, model: dict[str, Array], world: World) -> World:
    put = simulator.place if untouched else simulator.forward
    return put(_task_of(row, model), world.qpos, world.qvel, None, world.mocap)


@partial(jax.jit, static_argnums=0)
def _first_step(domain: Domain, task: Task, world: World, key: Key) -> Step:
    return domain.first_step(task, world, key)


@partial(jax.jit, static_argnums=0)
def _control(domain: Domain, task: Task, world: World, action: Array) -> tuple[World, Array]:
    return domain.control(task, world, action)


@partial(jax.jit, static_argnums=0)
def _advance(simulator: Engine, row: Array, model: dict[str, Array], world: World, ctrl: Array) -> World:
    return simulator.step(_task_of(row, model), world, ctrl)


@partial(jax.jit, static_argnums=0)
def _outcome(domain: Domain, task: Task, world: World, action: Array) -> Step:
    return outcome(domain, task, world, action)


def _task_of(row: Array, model: dict[str, Array]) -> Task:
    """Return all that an engine reads of a task."""
    return Task(id=row, row=row, context=row, params={}, model=model, goal={}, horizon=row)
