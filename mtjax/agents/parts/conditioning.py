"""What the networks are told of the task, and the training task that stands for one they do not know."""

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.types import Array, InputError

BORROWED = {"one-hot": ["number"], "embedding": ["embedding"], "vectors": ["vector"]}
"""What a task that was not trained on has of its nearest training task, by what networks are told."""


def features(conditioning: str, num_tasks: int, index: Array, context: Array, vectors: Array | None) -> Array:
    """What the networks see of a task (Z,); a learned embedding is added by the network that owns it.

    Args:
        told: the agent's conditioning.
        index: () the training task that it is, or that stands for it; context: (C,) its own parameters.
        vectors: (T, V) of the training tasks, if they are told.
    """
    match conditioning:
        case "one-hot":
            return jax.nn.one_hot(index, num_tasks)
        case "parameters":
            return context
        case "vectors":
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
            vectors = np.asarray(np.load(opened, allow_pickle=False), np.float32)  # neither an archive nor words
    except (OSError, EOFError, TypeError, ValueError) as error:
        raise InputError(f"cannot read task vectors from {file!r}: {error}") from None
    if vectors.ndim != 2 or len(vectors) != num_tasks or not np.all(np.isfinite(vectors)):
        raise InputError(
            f"{file!r} must hold {num_tasks} finite rows, one a training task; its shape is {vectors.shape}"
        )
    return jnp.asarray(vectors)
