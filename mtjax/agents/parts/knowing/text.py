"""What a task asks for, in a sentence whose vector is made on the host before a run."""

import dataclasses
import re
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, InputError, Spec, Task

HASHING = "hashing"
_SIZE = 256  # entries of hashed sentences, enough for some hundred words to fall apart
_APART = 2**20  # entries in which all words fall apart, a multiple of these
_WORD = re.compile(r"(?:(?<!\w)-)?\w+(?:\.\w+)*")  # keeps the numbers 0.95 and -2


@dataclasses.dataclass(frozen=True)
class Text(Nothing):
    """Shows networks the vector of a sentence that says what their task asks for.

    Tasks of all of the run's splits have their own sentences. With hashing, words that no training sentence has are
    left out of the others: no network has learned what they mean.
    """

    text: str = HASHING
    """Encoder of sentences: hashing (256 numbers from words, pairs of words and their places, by scikit-learn), or a
    model of sentence-transformers, by its name or the folder that it is in."""

    tells: ClassVar[bool] = True

    def table(self, spec: Spec, num_tasks: int) -> Array:
        return jnp.asarray(encode(self.text, spec.sentences, num_tasks))

    def task_vector(self, number: Array, task: Task, num_tasks: int, table: Array | None) -> Array:
        assert table is not None
        return table[jnp.where(task.id < len(table), task.id, number)]


@lru_cache
def encode(encoder: str, sentences: tuple[str, ...], learned: int) -> np.ndarray:
    """Return vectors (N, V) float32 of sentences, each of length 1.

    Args:
        learned: how many of the sentences, the first ones, are of training tasks. Hashing leaves out what none of
            these has.
        encoder: "hashing" counts words, pairs of neighbouring words and words at their places in random entries with
            random signs, by scikit-learn. It knows no meaning: two sentences are alike as far as they share words.
            Anything else is a model of sentence-transformers, by name or folder.

    Raises:
        InputError: there are no sentences, a library is missing, or the model cannot be loaded.
    """
    if not sentences:
        raise InputError("conditioning=text needs tasks that say what they ask for, as all families of mtjax do")
    vectors = _hash(sentences, learned) if encoder == HASHING else _embed(encoder, sentences)
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-6)


def _hash(sentences: Sequence[str], learned: int) -> np.ndarray:
    try:
        from sklearn.feature_extraction.text import HashingVectorizer  # type: ignore
    except ImportError:
        raise InputError("text=hashing needs scikit-learn: pip install 'mtjax[text]'") from None
    # New words are left out before words share entries, where they would seem to be others.
    counts: Any = HashingVectorizer(n_features=_APART, analyzer=_counted).transform(sentences)  # type: ignore
    known = np.unique(counts[:learned].indices)  # columns
    vectors = np.zeros((len(sentences), _SIZE), np.float32)
    np.add.at(vectors.T, known % _SIZE, counts[:, known].toarray().T)
    return vectors


def _counted(sentence: str) -> list[str]:
    """Return what is counted in a sentence. Places tell the order of words also beside a new one, without its pairs."""
    words = _WORD.findall(sentence.lower())
    pairs = [f"{first} {second}" for first, second in pairwise(words)]
    return [*words, *pairs, *(f"{place}: {word}" for place, word in enumerate(words))]


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
    return np.asarray(model.encode(list(sentences), show_progress_bar=False), np.float32)
