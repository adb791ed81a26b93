"""Learning rates over a run, and discounts of tasks, as an agent's settings say."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from mtjax.agents.parts.gradients import descent
from mtjax.types import Array, InputError, Task


def scheduled(agent: Any, rate: Any, delay: int = 1) -> Any:
    """Return a learning rate, or its schedule, for parameters that learn at every ``delay``-th update."""
    if agent.lr_schedule == "constant" and not agent.lr_warmup:
        return rate
    updates = agent.lr_warmup / delay, agent.lr_updates / delay
    return descent.schedule(rate, agent.lr_schedule, agent.lr_final, *updates)


def planned(agent: Any, steps: int) -> Any:
    """Return an agent with its schedule spread over a run of so many steps of every environment.

    Raises:
        InputError: the run ends before the schedule's warm-up does.
    """
    if agent.lr_schedule == "constant":
        return agent
    each, warmup = agent.experience.steps, agent.experience.warmup_steps
    updates = agent.lr_updates or agent.experience.updates * max(steps // each - warmup // each, 0)
    if updates <= agent.lr_warmup:
        left = f"none of the run's {updates} updates to lr-schedule={agent.lr_schedule}"
        raise InputError(f"lr-warmup={agent.lr_warmup} leaves {left}")
    return dataclasses.replace(agent, lr_updates=updates)


def discounts(agent: Any, tasks: Task) -> Any:
    """Return the discount of each task (T,), or one for all."""
    if agent.discounting == "gamma":
        return agent.gamma
    return jnp.clip(1 - 5 / tasks.horizon, 0.95, 0.995)


def discounts_of_all(agent: Any, tasks: Task) -> Array:
    """Return the discount of each of ``tasks`` (T,)."""
    return jnp.broadcast_to(discounts(agent, tasks), len(tasks.id))
