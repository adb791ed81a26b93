"""The number of a task."""

import dataclasses
from typing import ClassVar

import jax

from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, Task


@dataclasses.dataclass(frozen=True)
class OneHot(Nothing):
    """Shows networks the number of their task, as a vector that is 1 there and else 0."""

    borrowed: ClassVar[tuple[str, ...]] = ("number",)
    tells: ClassVar[bool] = True
    by_number: ClassVar[bool] = True

    def task_vector(self, number: Array, task: Task, num_tasks: int, table: Array | None) -> Array:
        return jax.nn.one_hot(number, num_tasks)
