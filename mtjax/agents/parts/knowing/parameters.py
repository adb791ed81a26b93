"""The parameters of a task."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, Task


@dataclasses.dataclass(frozen=True)
class Parameters(Nothing):
    """Shows networks the parameters of their task: its context, where training tasks lie in [-1, 1]."""

    context_limit: float = 0.0
    """Clip every parameter of the task to at most this size before networks see it, 0 for no limit. Training tasks lie
    in [-1, 1], so that 1 shows a task beyond them as the end of the range."""

    tells: ClassVar[bool] = True
    by_parameters: ClassVar[bool] = True

    def __post_init__(self):
        parts.require_not_negative(self, "context_limit")

    def task_vector(self, number: Array, task: Task, num_tasks: int, table: Array | None) -> Array:
        return self.limited(task.context)

    def limited(self, context: Array) -> Array:
        """Return contexts (..., C) as networks see them."""
        limit = parts.limit(self.context_limit)
        return context if limit is None else jnp.clip(context, -limit, limit)
