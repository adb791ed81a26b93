"""Conditioning gives networks features of the task as inputs."""

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.types import Array, InputError

BORROWED = {"one-hot": ["number"], "embedding": ["embedding"], "vectors": ["vector"]}
"""What an unseen task uses of its nearest training task, by conditioning."""


def features(conditioning: str, num_tasks: int, index: Array, context: Array, vectors: Array | None) -> Array:
    """Return the features (Z,) of a task; learned embeddings are not among them, as networks hold these themselves.

    Args:
        conditioning: the agent's.
        index: () number of the task if it is a training task, else of the nearest one. Of sentences all have one.
        context: (C,) the task's own parameters.
        vectors: (T, V) of the training tasks, or of all splits' sentences.
    """
    match conditioning:
        case "one-hot":
            return jax.nn.one_hot(index, num_tasks)
        case "parameters":
            return context
        case "vectors" | "text":
            assert vectors is not None
            return vectors[index]
    return jnp.zeros(0)


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
