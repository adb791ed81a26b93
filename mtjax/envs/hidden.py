"""Tasks that nothing shows, so that an agent finds out which it plays: bandits, and walks to a goal in a grid.

Every trial draws its task. In trials of several episodes (``--trials=K``) an agent that remembers can explore in the
first ones and earn more in the others. The best that can be earned so is known exactly.
"""

import abc
import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.choosing import Choosing
from mtjax.envs.family import Family
from mtjax.envs.looks import Look, from_above
from mtjax.envs.pixels import Mark, Pictured
from mtjax.envs.task_table import Table
from mtjax.types import Array, InputError, Key, Step, Task


@dataclasses.dataclass(frozen=True)
class HiddenTasks(Choosing, Family):
    """A family of one training task, which stands for a pool of tasks: each trial draws one of them."""

    told: bool = False
    """Show the task in the context after all, for a bound of what can be earned by finding it out."""

    finite_horizon: ClassVar[bool] = True
    ends_early: ClassVar[bool] = False
    numbers_are: ClassVar[str]  # what the numbers that make a task are called

    @abc.abstractmethod
    def pool(self) -> np.ndarray:
        """Return the numbers (P, C) that make each task, from 0 to ``largest``."""

    @property
    @abc.abstractmethod
    def largest(self) -> float:
        """Return the largest number that a task may have."""

    def called(self, row: int) -> str:
        """Return what the task of a row is called, such as "goal=3,2"."""
        told = ",".join(f"{x:.2g}" for x in self.table.tasks.goal["task"][row])
        return f"{self.numbers_are}={told}"

    @cached_property
    def table(self) -> Table:
        """Return the training task, which has the first of the pool, and then the pool."""
        pool = self.pool()
        each = np.concatenate([pool[:1], pool])
        row = np.arange(len(each), dtype=np.int32)
        context = 2 * each / self.largest - 1 if self.told else np.zeros((len(each), 1))
        goal = {"task": each.astype(np.float32)}
        leaves: dict[str, Any] = {"id": row, "row": row, "context": context.astype(np.float32), "goal": goal}
        tasks = Task(**leaves, horizon=np.full_like(row, self.episode_length), params={}, model={})  # type: ignore
        return Table(tasks, self.variation.places, row[None, 1:])


class BanditState(NamedTuple):
    """The state of a bandit."""

    key: Key  # of the chance to come


@dataclasses.dataclass(frozen=True)
class HiddenBandit(HiddenTasks):
    """Hidden bandit: find out which arm pays most often while pulling; every trial has other arms.

    Observation (1,): always 0.
    Action: the number of the arm that is pulled; with ``scores`` a score for each (num_arms,).
    Reward: with the probability p_a of the arm a that is pulled,
            r ~ Bernoulli(p_a)
        that is 1 with this probability, else 0.
    Start: there is one state.
    Episode: one pull; a trial of H pulls is ``--trials=H``.

    A task is the probabilities (num_arms,) of its arms, uniform in [0, 1]. Trials draw from ``num_draws`` tasks, which
        fill the cube of all tasks evenly. The context shows nothing, or with ``told`` the probabilities p as 2 p - 1.

    With K arms the best strategy for finding out earns in H pulls: 6.0218 (K=2, H=10), 6.6600 (K=5, H=10), 14.2873
        (K=5, H=20). Pulling at random earns H / 2, and the best arm H K / (K + 1).
    """

    num_arms: int = 2
    """Number of arms of each bandit."""
    num_draws: int = 10_000
    """Number of tasks. Each trial draws one of them."""

    episode_steps: ClassVar[int] = 1
    numbers_are: ClassVar[str] = "chances"

    def __post_init__(self):
        super().__post_init__()
        if not 1 <= self.num_arms <= 100:
            raise InputError(f"num-arms must be at least 1 and at most 100, not {self.num_arms}")

    @property
    def action_size(self) -> int:  # type: ignore[override]
        """Return the number of arms."""
        return self.num_arms

    @property
    def largest(self) -> float:
        return 1.0

    def pool(self) -> np.ndarray:
        return even_points(self.num_draws, self.num_arms, self.task_seed)

    def reset(self, task: Task, key: Key) -> Step:
        return Step(BanditState(key), jnp.zeros(1), jnp.float32(0), jnp.bool_(False))

    def step(self, task: Task, state: BanditState, action: Array) -> Step:
        pull_key, key = jax.random.split(state.key)
        reward = jax.random.bernoulli(pull_key, task.goal["task"][self.chosen(action)]).astype(jnp.float32)
        return Step(BanditState(key), jnp.zeros(1), reward, jnp.bool_(False))


def even_points(count: int, size: int, seed: int) -> np.ndarray:
    """Return points (count, size) that fill the unit cube evenly: Halton's (1960), shifted at random."""
    primes = [p for p in range(2, 1000) if all(p % q for q in range(2, p))][:size]
    columns = [_radical_inverse(np.arange(count), prime) for prime in primes]
    return (np.stack(columns, axis=1) + np.random.default_rng(seed).uniform(size=size)) % 1


def _radical_inverse(numbers: np.ndarray, base: int) -> np.ndarray:
    """Return the digits of numbers (N,) to a base in reverse order, behind the point."""
    total, place = np.zeros(len(numbers)), 1.0
    while np.any(numbers):
        place /= base
        total += place * (numbers % base)
        numbers = numbers // base
    return total


_MOVES = np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])


@dataclasses.dataclass(frozen=True)
class GridNavi(Pictured, HiddenTasks):
    """GridNavi: walk through a grid to a hidden goal cell, which every trial draws (Zintgraf et al. 2020, "VariBAD").

    Observation (size^2,): 1 for the cell (x, y) at place ``size x + y``, else 0.
    Action: 0 to 4 for staying, x + 1, x - 1, y + 1 and y - 1; with ``scores`` a score for each (5,). A move off the
        grid stays.
    Reward: for the cell (x, y) after the step,
            r = 1 if (x, y) = goal, else -0.1
    Start: the cell (0, 0).
    Episode: ``steps`` steps; nothing terminates it.

    A task is its goal, all cells as likely but for the 2 x 2 ones at the start. The context shows nothing, or with
        ``told`` the goal's x and y, scaled to [-1, 1].

    The best strategy for finding out earns in the episodes of a trial: 4.0000, and then 11.0714 in each (5 x 5 cells,
        15 steps, three episodes or more); 2.7 and 4.02 (3 x 3 cells, 6 steps). Told, it is 11.0714 and 4.02 in all.

    Differs from VariBAD in: the cell is one-hot, and not its two coordinates.
    """

    size: int = 5
    """Number of cells along each side."""
    steps: int = 15
    """Steps of an episode."""

    action_size: ClassVar[int] = len(_MOVES)
    numbers_are: ClassVar[str] = "goal"
    step_seconds: ClassVar[float] = 0.25  # of a film
    hides: ClassVar[tuple[str, ...]] = ("goal",)

    def __post_init__(self):
        super().__post_init__()
        if not 3 <= self.size <= 50:
            raise InputError(f"size must be at least 3, so that there are goals, and at most 50, not {self.size}")
        if not 1 <= self.steps <= 10_000:
            raise InputError(f"steps must be at least 1 and at most 10000, not {self.steps}")

    @property
    def episode_steps(self) -> int:  # type: ignore[override]
        """Return the number of steps of an episode."""
        return self.steps

    @property
    def largest(self) -> float:
        return self.size - 1.0

    def pool(self) -> np.ndarray:
        cells = np.stack(np.meshgrid(*[np.arange(self.size)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        return cells[cells.max(axis=1) > 1]

    def reset(self, task: Task, key: Key) -> Step:
        cell = jnp.zeros(2, jnp.int32)
        return Step(cell, self.look_at(task, cell), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: Array, action: Array) -> Array:
        """Return the cell (2,) int32 after a move."""
        return jnp.clip(state + jnp.asarray(_MOVES)[self.chosen(action)], 0, self.size - 1)

    def observe(self, task: Task, state: Array) -> Array:
        """Return the cell, one-hot."""
        return jax.nn.one_hot(self.size * state[0] + state[1], self.size**2)

    def reward(self, task: Task, state: Array, action: Array) -> Array:
        """Return 1 in the goal and -0.1 elsewhere, ()."""
        return jnp.where(jnp.all(state == task.goal["task"]), 1.0, -0.1)

    # What is seen.

    @property
    def look(self) -> Look:  # type: ignore[override]
        """Return the view from above."""
        return from_above((self.size - 1) / 2, self.size)

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the cells, the walker, and the goal, which pictures that agents observe do not show."""
        spec, geom = mujoco.MjSpec(), mujoco.mjtGeom
        spec.stat.extent = 2.0  # nothing is drawn within a hundredth of it
        add = spec.worldbody.add_geom
        for x, y in np.ndindex(self.size, self.size):
            add(type=geom.mjGEOM_BOX, pos=[x, y, 0], size=[0.48, 0.48, 0.05], rgba=(0.45, 0.5, 0.55, 1.0))
        add(name="goal", type=geom.mjGEOM_CYLINDER, size=[0.4, 0.05, 0], rgba=(0.2, 0.8, 0.3, 1.0))
        add(name="walker", type=geom.mjGEOM_CYLINDER, size=[0.3, 0.3, 0], rgba=(0.95, 0.6, 0.2, 1.0))
        return spec

    def marks(self, task: Task, state: Array) -> dict[str, Mark]:
        """Return where the walker and the goal are."""
        return {"goal": Mark(jnp.append(task.goal["task"], 0.06)), "walker": Mark(jnp.append(state, 0.3))}
