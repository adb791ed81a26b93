"""Rollouts from before and after a policy adapts, which agents need that learn to adapt."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.experience.rollouts import Rollouts, windows
from mtjax.types import Array, Env, InputError, Key, Task, Transition


@dataclasses.dataclass(frozen=True)
class AdaptingRollouts(Rollouts):
    """Gives the agent its latest rollouts, one from before each of its inner steps and one from after the last.

    A rollout is ``unroll`` steps of every environment. Each update sees all steps of all rollouts, in their order.
    """

    unroll: int = 100
    """Steps of every environment in each rollout: before each inner step, and after the last."""
    epochs: int = 5
    """Updates after the rollouts, each with all of their steps."""
    minibatches: int = 1
    """Always 1, as each task adapts by its whole rollouts."""
    inner_steps: int = 1
    """Gradient steps with which the policy adapts to each task, each after a rollout of its own."""

    def __post_init__(self):
        super().__post_init__()
        if self.minibatches != 1:
            raise InputError(f"each task adapts by its whole rollouts, so minibatches is 1, not {self.minibatches}")
        if not 1 <= self.inner_steps <= 100:
            raise InputError(f"inner-steps must be at least 1 and at most 100, not {self.inner_steps}")

    @property
    def steps(self) -> int:
        """Steps of every environment in all rollouts."""
        return self.unroll * (self.inner_steps + 1)

    @property
    def adaptations(self) -> int:
        """How often the agent adapts between rollouts."""
        return self.inner_steps

    def batches(self, env: Env, agent: Any, tasks: Task, data: Transition, key: Key, state: Any = None) -> Array:
        """Return the numbers (U,) of the updates, which all see the same."""
        return jnp.arange(self.updates)

    def window(self, data: Transition, batch: Array) -> Transition:
        """Return all steps as windows (T, B, 1, ...) of one step, rollout after rollout."""
        return windows(data, 0)

    def apart(self, steps: Any) -> Any:
        """Split steps (T, H, E, ...) of one rollout or more into these: (T, rollouts, unroll, E, ...)."""
        return jax.tree.map(lambda x: x.reshape(len(x), -1, self.unroll, *x.shape[2:]), steps)
