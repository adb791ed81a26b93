"""Families whose steps follow from how a world moves, and from what is observed and rewarded of it."""

import abc
import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax.envs.family import Family
from mtjax.types import Array, InputError, Step, Task


@dataclasses.dataclass(frozen=True)
class Stepped(Family):
    """A family that says how a world moves, and what of it is observed and rewarded. An action may be repeated."""

    repeat: int = 1
    """Take every action for so many control steps and sum their rewards. Episodes last as long as before. Agents
    discount once for all of these steps, and success is that after the last."""

    step_seconds: ClassVar[float]  # length of a control step [s]

    def __post_init__(self):
        super().__post_init__()
        if self.repeat != 1 and (self.repeat < 1 or self.episode_steps % self.repeat):
            near = [n for n in range(1, self.episode_steps + 1) if self.episode_steps % n == 0]
            few = sorted(sorted(near, key=lambda n: abs(n - self.repeat))[:4])
            raise InputError(
                f"repeat must divide the {self.episode_steps} steps of an episode, such as "
                f"{', '.join(map(str, few))}; not {self.repeat}"
            )

    # What a family gives.

    @abc.abstractmethod
    def advance(self, task: Task, state: Any, action: Array) -> Any:
        """Return the state of a world after one control step under ``action`` (A,)."""

    @abc.abstractmethod
    def observe(self, task: Task, state: Any) -> Array:
        """Return the observation (O,) of a world."""

    @abc.abstractmethod
    def reward(self, task: Task, state: Any, action: Array) -> Array:
        """Return the reward () of a world after the step."""

    # What a family may give.

    def terminates(self, task: Task, state: Any) -> Array:
        """Return whether () an episode ends in this world, with no rewards after it. By default only time ends one."""
        return jnp.bool_(False)

    def metrics(self, task: Task, state: Any, action: Array) -> dict[str, Array]:
        """Return further numbers () of a world after the step, such as success. Evaluations report them."""
        return {}

    def judge(self, task: Task, state: Any, action: Array) -> tuple[Array, dict[str, Array]]:
        """Return reward and metrics. A family that computes them together gives both here."""
        return self.reward(task, state, action), self.metrics(task, state, action)

    # What every family does.

    def step(self, task: Task, state: Any, action: Array) -> Step:
        """Advance ``repeat`` control steps under ``action`` (A,) in [-1, 1]; observation and reward are those after it.

        Rewards of repeated steps are summed, up to one that terminates the episode. There the world stands still, so
        that observation and metrics are those of its end.
        """

        def once(_, carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
            before, total, over = carry
            moved = self.advance(task, before, action)
            state = jax.tree.map(lambda new, old: jnp.where(over, old, new), moved, before)
            total += jnp.where(over, 0.0, self.reward(task, state, action))
            return state, total, over | self.terminates(task, state)

        if self.repeat == 1:
            return self.outcome(task, self.advance(task, state, action), action)
        state, reward, over = jax.lax.fori_loop(0, self.repeat, once, (state, jnp.float32(0), jnp.bool_(False)))
        return Step(state, self.look_at(task, state), reward, over, self.judge(task, state, action)[1])

    def outcome(self, task: Task, state: Any, action: Array) -> Step:
        """Return what a control step has led to."""
        reward, metrics = self.judge(task, state, action)
        return Step(state, self.look_at(task, state), reward, self.terminates(task, state), metrics)

    def look_at(self, task: Task, state: Any) -> Any:
        """Return what the agent observes of a world."""
        return self.observe(task, state)

    @property
    def ends_early(self) -> bool:
        """Return whether the family says where episodes end."""
        return type(self).terminates is not Stepped.terminates

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        return self.episode_steps // self.repeat

    @property
    def seconds_per_step(self) -> float:
        """Return the length of a step of the environment [s]."""
        return self.step_seconds * self.repeat
