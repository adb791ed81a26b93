"""A given vector for every task."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, InputError, Spec, Task


@dataclasses.dataclass(frozen=True)
class Vectors(Nothing):
    """Shows networks the row of a file that belongs to their task."""

    vectors: str = ""
    """A .npy file of task vectors (T, V), one row for each training task."""

    borrowed: ClassVar[tuple[str, ...]] = ("vector",)
    tells: ClassVar[bool] = True

    def refuses(self) -> str:
        return "" if self.vectors else "conditioning=vectors and vectors=FILE.npy go together; give both or neither"

    def table(self, spec: Spec, num_tasks: int) -> Array:
        return load_vectors(self.vectors, num_tasks)

    def task_vector(self, number: Array, task: Task, num_tasks: int, table: Array | None) -> Array:
        assert table is not None
        return table[number]


def load_vectors(file: str, num_tasks: int) -> Array:
    """Read task vectors (T, V) from a .npy file.

    Raises:
        InputError: the file cannot be read, or does not hold one finite row for every training task.
    """
    try:
        with open(file, "rb") as opened:
            vectors = np.asarray(np.load(opened, allow_pickle=False), np.float32)  # fails for archives and strings
    except OSError as error:
        raise InputError(f"cannot read task vectors from {file!r}: {error.strerror or error}") from None
    except Exception:  # a damaged file may raise anything
        raise InputError(f"cannot read task vectors from {file!r}: it is no .npy file of numbers") from None
    if vectors.ndim != 2 or len(vectors) != num_tasks or not np.all(np.isfinite(vectors)):
        raise InputError(
            f"{file!r} must hold {num_tasks} finite rows, one a training task; its shape is {vectors.shape}"
        )
    return jnp.asarray(vectors)
