"""MTEnv's tabular tasks, drawn at random: Markov decision processes of a few states, and bandits."""

import abc
import dataclasses
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.checks import require_counts
from mtjax.envs.choosing import Choosing
from mtjax.envs.family import Family
from mtjax.envs.parameters import REWARD_SCALE, Parameter
from mtjax.envs.variation import Variation
from mtjax.types import SPLITS, Array, InputError, Key, Step, Task

_MOST_HELD_OUT = 10


@dataclasses.dataclass(frozen=True)
class DrawnTasks(Choosing, Family):
    """A family whose tasks are random tables of numbers in [0, 1]. The context holds them, scaled to [-1, 1].

    Task number i of a split depends on ``task_seed`` and i alone, so that more tasks keep the first ones. The split
    "dense" holds out up to ten further draws as its interpolation tasks; "none" holds out nothing. Values of the
    parameter ``reward-scale``, the factor of a task's rewards, are those of its tasks in turn; no observation shows it.
    """

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType({"reward-scale": REWARD_SCALE})

    @property
    @abc.abstractmethod
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the names of a task's tables with their shapes."""

    @property
    def told(self) -> tuple[str, ...]:
        """Return the names of the tables that the context holds: all of them."""
        return tuple(self.shapes)

    @abc.abstractmethod
    def draw_tables(self, random: np.random.Generator) -> dict[str, np.ndarray]:
        """Draw the tables of one task."""

    def task_of(self, tables: Mapping[str, np.ndarray], row: int = 0) -> Task:
        """Return the task (no leading axis) that these tables make, under the id of a row.

        Raises:
            InputError: a table is missing or superfluous, or has another shape.
        """
        return jax.tree.map(jnp.asarray, self._host_task(tables, row))

    def _host_task(self, tables: Mapping[str, np.ndarray], row: int) -> Task:
        goal = {name: np.asarray(table, np.float32) for name, table in tables.items()}
        if {name: table.shape for name, table in goal.items()} != self.shapes:
            given = {name: table.shape for name, table in goal.items()}
            raise InputError(f"the tables of a task have the shapes {self.shapes}, not {given}")
        numbers = np.concatenate([goal[name].ravel() for name in self.told])
        leaves: dict[str, Any] = {"id": np.int32(row), "row": np.int32(row), "context": 2 * numbers - 1, "goal": goal}
        leaves["horizon"] = np.int32(self.episode_length)
        return Task(**leaves, params={}, model={})

    @cached_property
    def variation(self) -> Variation:
        """Return as many tasks as there are in every split, with the values of a varied parameter in turn.

        Raises:
            InputError: episodes would draw the values.
        """
        found = super().variation
        if found.draws is not None:
            raise InputError("drawn tasks take values of reward-scale in turn: list them, such as 0.01,1,100")
        held_out = min(self.num_tasks, _MOST_HELD_OUT) if self.split == "dense" else 0
        counts = dict(zip(SPLITS, (self.num_tasks, held_out, 0), strict=True))
        rows = {split: np.resize(found.rows["train"], (n, len(found.names))) for split, n in counts.items()}
        return dataclasses.replace(found, rows=rows)

    def paid(self, task: Task, reward: Array) -> Array:
        """Return a reward () of 0 or 1 in the task's own scale."""
        return reward * task.params["reward-scale"] if "reward-scale" in task.params else reward

    def build(self) -> dict[str, Any]:
        """Return the tables (R, ...) of every task, and the contexts, which hold them."""
        counts = self.variation.counts.values()
        seeds = [(self.task_seed, kind, i) for kind, count in enumerate(counts) for i in range(count)]
        tasks = [self._host_task(self.draw_tables(np.random.default_rng(seed)), row) for row, seed in enumerate(seeds)]
        whole = jax.tree.map(lambda *leaves: np.stack(leaves), *tasks)
        return {"model": {}, "goal": whole.goal, "context": whole.context}


class TabularState(NamedTuple):
    """The state of a tabular MDP."""

    cell: Array  # () int32
    key: Key  # of the chances to come


@dataclasses.dataclass(frozen=True)
class TabularMDP(DrawnTasks):
    """Tabular MDP: collect rewards in a process of a few states, whose chances differ between tasks.

    Observation (num_states + 1,): the state as one-hot; the last reward, 0 at first.
    Action: one of ``num_actions`` numbers, from 0.
    Reward: with the task's table of probabilities, for the state s before the step and the action a,
            r ~ Bernoulli(rewards(s, a))
        that is 1 with this probability, else 0.
    Start: any state, all as likely.
    Episode: 100 steps; it never terminates.

    A task is two tables. ``rewards`` (num_states, num_actions) holds the probabilities of a reward, uniform in [0, 1];
        ``transitions`` (num_states, num_actions, num_states) those of the next state, the softmax of standard normal
        numbers over its last axis. The context is both tables, flattened one after the other, as 2 x - 1.

    Differs from MTEnv in: episodes are cut off after 100 steps, where its own have no
    end; there are ``num_tasks`` tasks, where every reset of its task state draws a new one.
    """

    num_states: int = 4
    """Number of states of each process."""
    num_actions: int = 5
    """Number of actions in every state."""

    episode_steps: ClassVar[int] = 100

    def __post_init__(self):
        super().__post_init__()
        if self.num_states < 1 or self.num_actions < 1:
            raise InputError("num-states and num-actions must be at least 1")

    @property
    def action_size(self) -> int:  # type: ignore[override]
        """Return the number of actions."""
        return self.num_actions

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        states, actions = self.num_states, self.num_actions
        return {"rewards": (states, actions), "transitions": (states, actions, states)}

    def draw_tables(self, random: np.random.Generator) -> dict[str, np.ndarray]:
        weights = np.exp(random.standard_normal(self.shapes["transitions"]))
        rewards = random.uniform(size=self.shapes["rewards"])
        return {"rewards": rewards, "transitions": weights / weights.sum(axis=-1, keepdims=True)}

    def reset(self, task: Task, key: Key) -> Step:
        start_key, key = jax.random.split(key)
        cell = jax.random.randint(start_key, (), 0, self.num_states)
        return self._step(TabularState(cell, key), jnp.float32(0))

    def step(self, task: Task, state: TabularState, action: Array) -> Step:
        reward_key, move_key, key = jax.random.split(state.key, 3)
        chosen = self.chosen(action)
        reward = jax.random.bernoulli(reward_key, task.goal["rewards"][state.cell, chosen]).astype(jnp.float32)
        chances = task.goal["transitions"][state.cell, chosen]
        cell = jax.random.categorical(move_key, jnp.log(chances))
        step = self._step(TabularState(cell.astype(jnp.int32), key), reward)
        return step._replace(reward=self.paid(task, reward))

    def _step(self, state: TabularState, reward: Array) -> Step:
        obs = jnp.append(jax.nn.one_hot(state.cell, self.num_states), reward)
        return Step(state, obs, reward, jnp.bool_(False))


class BanditState(NamedTuple):
    """The state of a bandit."""

    key: Key  # of the chances to come


@dataclasses.dataclass(frozen=True)
class Bandit(DrawnTasks):
    """Bandit: pull the arm that pays most often; which one that is differs between tasks.

    Observation (1,): always 0.
    Action: one of ``num_arms`` numbers, from 0: the arm that is pulled.
    Reward: with the task's probability of the arm a that is pulled,
            r ~ Bernoulli(rewards(a))
        that is 1 with this probability, else 0.
    Start: there is one state.
    Episode: 100 pulls; it never terminates.

    A task is one table: ``rewards`` (num_arms,) holds the probabilities of a reward, uniform in [0, 1]. The context is
        that table, as 2 x - 1.

    Differs from the multi-task bandits of MTEnv's examples in: episodes are cut off after 100 pulls, where theirs have
    no end. As in its finite one, there are ``num_tasks`` tasks.
    """

    num_arms: int = 5
    """Number of arms of each bandit."""

    episode_steps: ClassVar[int] = 100

    def __post_init__(self):
        super().__post_init__()
        require_counts(self, "num_arms")

    @property
    def action_size(self) -> int:  # type: ignore[override]
        """Return the number of arms."""
        return self.num_arms

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"rewards": (self.num_arms,)}

    def draw_tables(self, random: np.random.Generator) -> dict[str, np.ndarray]:
        return {"rewards": random.uniform(size=self.num_arms)}

    def reset(self, task: Task, key: Key) -> Step:
        return Step(BanditState(key), jnp.zeros(1), jnp.float32(0), jnp.bool_(False))

    def step(self, task: Task, state: BanditState, action: Array) -> Step:
        pull_key, key = jax.random.split(state.key)
        reward = jax.random.bernoulli(pull_key, task.goal["rewards"][self.chosen(action)]).astype(jnp.float32)
        return Step(BanditState(key), jnp.zeros(1), self.paid(task, reward), jnp.bool_(False))
