"""Learning rates over a run, and discounts of tasks, as an agent's settings say."""

import dataclasses
from typing import Any, TypeVar

import jax.numpy as jnp

from mtjax.agents.parts.gradients import descent
from mtjax.types import Array, InputError, Task

A = TypeVar("A")


def scheduled(agent: Any, rate: Any, delay: int = 1) -> Any:
    """Return a learning rate, or its schedule, for parameters that learn at every ``delay``-th update."""
    if agent.lr_schedule == "constant" and not agent.lr_warmup:
        return rate
    updates = agent.lr_warmup / delay, agent.lr_updates / delay
    return descent.schedule(rate, agent.lr_schedule, agent.lr_final, *updates)


def planned(agent: A, steps: int) -> A:
    """Return an agent with its schedule spread over a run of so many steps of every environment.

    Raises:
        InputError: the run ends before the schedule's warm-up does.
    """
    own: Any = agent
    if getattr(own, "lr_schedule", "constant") == "constant":  # agents of other kinds have none
        return agent
    each, warmup = own.experience.steps, own.experience.warmup_steps
    updates = own.lr_updates or own.experience.updates * max(steps // each - warmup // each, 0)
    if updates <= own.lr_warmup:
        left = f"none of the run's {updates} updates to lr-schedule={own.lr_schedule}"
        raise InputError(f"lr-warmup={own.lr_warmup} leaves {left}")
    return dataclasses.replace(own, lr_updates=updates)


def discounts(agent: Any, tasks: Task) -> Any:
    """Return the discount of each task (T,), or one for all."""
    if agent.discounting == "gamma":
        return agent.gamma
    return jnp.clip(1 - 5 / tasks.horizon, 0.95, 0.995)


def discounts_of_all(agent: Any, tasks: Task) -> Array:
    """Return the discount of each of ``tasks`` (T,)."""
    return jnp.broadcast_to(discounts(agent, tasks), len(tasks.id))
