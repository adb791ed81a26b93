"""A learned vector for every task."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import Params
from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, Key


@dataclasses.dataclass(frozen=True)
class Embedding(Nothing):
    """Shows networks a vector that is learned for every training task; actor and critics see the same.

    Vectors begin as samples of a normal distribution, so that their length is about the square root of their size.
    """

    embedding_size: int = 16
    """Size of the features that are learned or inferred."""
    unit_embedding: bool = False
    """Scale learned task embeddings to length 1."""

    borrowed: ClassVar[tuple[str, ...]] = ("embedding",)
    tells: ClassVar[bool] = True
    embeds: ClassVar[bool] = True

    def __post_init__(self):
        parts.require_counts(self, "embedding_size")

    def init(self, num_tasks: int, seen: Any, action: Array, own: bool, key: Key) -> Params:
        return Params({}, {"embedding": jax.random.normal(key, (num_tasks, self.embedding_size))})

    def features(self, params: dict[str, Any], task_vector: Array, seen: Any) -> Array:
        vector = params["embedding"]
        return unit(vector) if self.unit_embedding else vector


def unit(vector: Array) -> Array:
    """Return a vector (Z,) scaled to length 1."""
    return vector / jnp.maximum(jnp.linalg.norm(vector), 1e-6)
