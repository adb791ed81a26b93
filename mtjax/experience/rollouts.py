"""Rollouts hold the latest steps, from which on-policy agents learn and then drop them."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.checks import require_counts
from mtjax.types import Array, Env, InputError, Key, Spec, Storage, Task, Transition

_LONGEST = 100_000


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """Gives the agent the latest ``unroll`` steps of every environment in minibatches, and then drops them.

    In each epoch the rollout's windows are shuffled and split into minibatches, with the same number of every task. A
    window is a single step, or for agents with a memory that learns, all of an environment's steps.
    """

    unroll: int = 32
    """Steps of every environment between two times of updates."""
    epochs: int = 4
    """Passes over the rollout."""
    minibatches: int = 8
    """Minibatches in each pass; steps that do not divide evenly are left out, other ones in each pass. An agent with a
    memory divides worlds, as it learns from whole rollouts of these."""

    storage: ClassVar[Storage] = Storage(axes=0, sharding=(), kept=False, flags=("num-envs",))
    policy_delay: ClassVar[int] = 1  # the actor learns in every update
    reset_every: ClassVar[int] = 0  # networks are never reset
    warmup_steps: ClassVar[int] = 0  # no action is random before learning
    adaptations: ClassVar[int] = 0  # the policy stays as it is while it plays
    hindsight: ClassVar[float] = 0.0  # no step is relabelled

    def __post_init__(self):
        if not 1 <= self.unroll <= _LONGEST:
            raise InputError(f"unroll must be at least 1 and at most {_LONGEST}, not {self.unroll}")
        require_counts(self, "epochs", "minibatches")

    @property
    def steps(self) -> int:
        """Steps of every environment before the agent learns again."""
        return self.unroll

    @property
    def updates(self) -> int:
        """The number U of updates each time that the agent learns."""
        return self.epochs * self.minibatches

    def check(self, env: Env, num_envs: int, chunk_steps: int = 0, unroll: int = 0) -> None:
        """Accept every environment."""

    def host_slots(self, num_envs: int) -> int:
        """Return 0, as the host keeps no steps."""
        return 0

    def rollout_bytes(self, spec: Spec, num_envs: int) -> int:
        """Return the bytes of a task's observations, before and after every step, while they are learned from."""
        seen = jax.tree.leaves(frames.seen(spec))
        return 2 * self.steps * num_envs * sum(math.prod(x.shape) * x.dtype.itemsize for x in seen)

    def describe(self, spec: Spec, num_envs: int) -> str:
        """Return a description of its size, with the memory that stacks of pictures take while it is learned from."""
        told = f"; while in use {self.rollout_bytes(spec, num_envs) / 1e6:,.0f} MB of pictures a task and seed"
        told *= frames.shown(spec.obs)
        return f"rollouts ({self.steps * num_envs:,} transitions a task, not kept{told})"

    def init(self, item: Transition, spec: Spec, num_tasks: int, num_envs: int, keys: Key) -> tuple[()]:
        """Return (), as no data is kept between iterations."""
        return ()

    def explore(self, data: tuple[()], action: Array, step: Array) -> Array:
        """Return the policy's own actions."""
        return action

    def add(self, data: tuple[()], steps: Transition) -> Transition:
        """Return the latest steps, leaves (S, T, H, E, ...)."""
        return steps

    def num_windows(self, num_envs: int, length: int) -> int:
        """Return how many windows a task's rollout has of so many steps; 0 is for single steps."""
        return self.unroll // (length or 1) * num_envs

    # Learning.

    def batches(self, env: Env, agent: Any, tasks: Task, data: Transition, key: Key, state: Any = None) -> Array:
        """Split one seed's windows at random into the minibatches of all epochs: indices (U, B, L) of steps.

        Raises:
            InputError: there are fewer windows than minibatches.
        """
        num_envs, length = data.reward.shape[2], agent.unroll or 1  # then the first steps are the first num_envs
        first = self.shuffled(self.num_windows(num_envs, agent.unroll), key)
        return first[..., None] + num_envs * jnp.arange(length)

    def shuffled(self, count: int, key: Key) -> Array:
        """Split ``count`` windows at random into minibatches: (U, B)."""
        size = count // self.minibatches
        if not size:
            raise InputError(f"minibatches ({self.minibatches}) must not be more than a rollout's {count} a task")
        order = jax.vmap(lambda key: jax.random.permutation(key, count))(jax.random.split(key, self.epochs))
        return order[:, : size * self.minibatches].reshape(-1, size)

    def draw(self, spec: Spec, agent: Any, steps: Transition, key: Key, count: int) -> Transition:
        """Draw ``count`` windows (T, count, L, ...) of every task, as long as the agent needs, of (T, H, E, ...)."""
        flat = windows(steps, agent.unroll)
        return jax.tree.map(lambda x: x[:, jax.random.randint(key, (count,), 0, x.shape[1])], flat)

    def window(self, data: Transition, batch: Array) -> Transition:
        """Take the windows (T, B, L, ...) of one minibatch, by the indices (B, L) of their steps.

        Of what is known of first steps alone (T, 1, E, ...), windows have one step too.
        """
        return jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:])[:, batch[:, : x.shape[1]]], data)


def windows(steps: Transition, length: int) -> Transition:
    """Return a rollout (T, H, E, ...) as windows (T, N, L, ...): single steps, or for L = H all of a world's."""
    if not length:
        return jax.tree.map(lambda x: x.reshape(len(x), -1, 1, *x.shape[3:]), steps)
    return jax.tree.map(lambda x: jnp.swapaxes(x, 1, 2), steps)


def played(x: Array, shape: Sequence[int], length: int) -> Array:
    """Return numbers (T, N L) of all windows in the order (T, H, E) in which they were played."""
    if not length:
        return x.reshape(shape)
    return jnp.swapaxes(x.reshape(shape[0], shape[2], shape[1]), 1, 2)
