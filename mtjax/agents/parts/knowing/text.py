"""What a task asks for, in a sentence whose vector is made on the host before a run."""

import dataclasses
from collections.abc import Sequence
from functools import lru_cache
from typing import ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, InputError, Spec, Task

HASHING = "hashing"
_SIZE = 256  # entries of hashed sentences, enough for some hundred words to fall apart
_WORD = r"(?:(?<!\w)-)?\w+(?:\.\w+)*"  # keeps the numbers 0.95 and -2


@dataclasses.dataclass(frozen=True)
class Text(Nothing):
    """Shows networks the vector of a sentence that says what their task asks for.

    Tasks of all of the run's splits have their own sentences.
    """

    text: str = HASHING
    """Encoder of sentences: hashing (256 numbers from words and pairs of words, by scikit-learn), or a model of
    sentence-transformers, by its name or the folder that it is in."""

    tells: ClassVar[bool] = True

    def table(self, spec: Spec, num_tasks: int) -> Array:
        return jnp.asarray(encode(self.text, spec.sentences))

    def task_vector(self, number: Array, task: Task, num_tasks: int, table: Array | None) -> Array:
        assert table is not None
        return table[jnp.where(task.id < len(table), task.id, number)]


@lru_cache
def encode(encoder: str, sentences: tuple[str, ...]) -> np.ndarray:
    """Return vectors (N, V) float32 of sentences, each of length 1.

    Args:
        encoder: "hashing" counts words and pairs of neighbouring words in random entries with random signs, by
            scikit-learn. It knows no meaning: two sentences are alike as far as they share words. Anything else is a
            model of sentence-transformers, by name or folder.

    Raises:
        InputError: there are no sentences, a library is missing, or the model cannot be loaded.
    """
    if not sentences:
        raise InputError("conditioning=text needs tasks that say what they ask for, as all families of mtjax do")
    vectors = np.asarray((_hash if encoder == HASHING else _embed)(encoder, sentences), np.float32)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)


def _hash(encoder: str, sentences: Sequence[str]) -> np.ndarray:
    try:
        from sklearn.feature_extraction.text import HashingVectorizer  # type: ignore
    except ImportError:
        raise InputError("text=hashing needs scikit-learn: pip install 'mtjax[text]'") from None
    return HashingVectorizer(n_features=_SIZE, ngram_range=(1, 2), token_pattern=_WORD).transform(sentences).toarray()


def _embed(encoder: str, sentences: Sequence[str]) -> np.ndarray:
    try:
        from sentence_transformers import SentenceTransformer  # type: ignore
    except ImportError:
        raise InputError(f"text={encoder} needs sentence-transformers: pip install 'mtjax[sentences]'") from None
    try:
        model = SentenceTransformer(encoder, device="cpu")
    except Exception as error:  # of the library, of a download or of a file
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(f"cannot load the encoder of sentences {encoder!r}: {reason[0][:150]}") from None
    return np.asarray(model.encode(list(sentences), show_progress_bar=False))
