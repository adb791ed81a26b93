"""Rollouts hold the latest steps, from which on-policy agents learn once."""

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax import frames
from mtjax.maps import over_seeds
from mtjax.types import Array, Env, InputError, Key, Metrics, Spec, Task, Transition

_LONGEST = 100_000


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """Gives the agent the latest ``unroll`` steps of every environment, and then drops them."""

    unroll: int = 32
    """Steps of every environment between two updates."""

    sharding: ClassVar[Any] = ()
    policy_delay: ClassVar[int] = 1  # the actor learns in every update
    reset_every: ClassVar[int] = 0  # networks are never reset
    warmup_steps: ClassVar[int] = 0  # no action is random before learning

    def __post_init__(self):
        if not 1 <= self.unroll <= _LONGEST:
            raise InputError(f"unroll must be at least 1 and at most {_LONGEST}, not {self.unroll}")

    @property
    def steps(self) -> int:
        """Steps of every environment between two calls of ``learn``."""
        return self.unroll

    def updates_in(self, steps: int) -> int:
        """Count the calls of ``learn`` in a run of so many steps of every environment."""
        return steps // self.unroll

    def check(self, env: Env, num_envs: int, chunk_steps: int = 0) -> None:
        """Accept every environment."""

    def host_slots(self, num_envs: int) -> int:
        """Return 0, as the host keeps no steps."""
        return 0

    def rollout_bytes(self, spec: Spec, num_envs: int) -> int:
        """Return the bytes of a task's observations, before and after every step, while they are learned from."""
        seen = jax.tree.leaves(frames.seen(spec))
        return 2 * self.unroll * num_envs * sum(math.prod(x.shape) * x.dtype.itemsize for x in seen)

    def describe(self, spec: Spec, num_envs: int) -> str:
        """Return a description of its size, with the memory that stacks of pictures take while it is learned from."""
        told = f"; while in use {self.rollout_bytes(spec, num_envs) / 1e6:,.0f} MB of pictures a task and seed"
        told *= frames.shown(spec.obs)
        return f"rollouts ({self.unroll * num_envs:,} transitions a task, not kept{told})"

    def init(self, item: Transition, spec: Spec, num_tasks: int, num_envs: int, keys: Key) -> tuple[()]:
        """Return (), as no data is kept between iterations."""
        return ()

    def explore(self, data: tuple[()], action: Array, step: Array) -> Array:
        """Return the policy's own actions."""
        return action

    def add(self, data: tuple[()], steps: Transition) -> Transition:
        """Return the latest steps, leaves (S, T, H, E, ...)."""
        return steps

    def keep(self, data: Transition) -> tuple[()]:
        """Return (), as learning is over."""
        return ()

    # Learning.

    def learn(self, env: Env, agent: Any, states: Any, data: Transition, tasks: Task, keys: Key) -> tuple[Any, Metrics]:
        """Update the agents of all seeds, leaves (S, ...), by their steps, leaves (S, T, H, E, ...).

        Returns:
            their new states, and their metrics, with ``learning`` () = 1.
        """
        update = lambda state, steps, key: agent.update(state, steps, tasks, key)
        states, metrics = over_seeds(update, 0, 0, 0)(states, data, keys)
        return states, metrics | {"learning": jnp.float32(1)}
