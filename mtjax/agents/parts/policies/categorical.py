"""Policies that choose one of some actions."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp

from mtjax.agents.networks import Params
from mtjax.agents.parts.policies.base import Drawn, Policy
from mtjax.types import Array, Discrete, Key

_NEVER = -1e30
"""The logit of an action that a task does not have. It is finite, as 0 x infinity is no number: p log p is 0."""


@dataclasses.dataclass(frozen=True)
class Categorical(Policy):
    """Draws action a with the probability softmax(outputs)_a, over those actions that the task has.

    The probability of other actions, and the gradient of their outputs, is exactly 0.
    """

    size: int  # A

    def outputs(self, size: int) -> int:
        return size

    def first(self, size: int, std: float | Array) -> Array:
        return jnp.zeros(size)

    def blank(self, nets: Mapping[str, Params]) -> Array:
        return Discrete(self.size).blank()

    def encode(self, action: Array) -> Array:
        return Discrete(self.size).encode(action)

    def draw(self, outputs: Array, mask: Array | None, key: Key | None) -> Drawn:
        logits = allowed(outputs, mask)
        action = jnp.argmax(logits, axis=-1) if key is None else jax.random.categorical(key, logits)
        action = action.astype(jnp.int32)
        return Drawn(action, action, self.log_prob(outputs, action, mask))

    def action(self, raw: Array, mask: Array | None) -> Array:
        return raw

    def log_prob(self, outputs: Array, raw: Array, mask: Array | None = None) -> Array:
        return jnp.sum(self.encode(raw) * _log_probs(outputs, mask), axis=-1)  # gathers have no place in exports

    def entropy(self, outputs: Array, mask: Array | None, key: Key) -> Array:
        """Return the exact entropy (...,)."""
        logs = _log_probs(outputs, mask)
        return -jnp.sum(jnp.exp(logs) * logs, axis=-1)

    def divergence(self, outputs: Array, others: Array, mask: Array | None = None) -> Array:
        logs = _log_probs(outputs, mask)
        return jnp.sum(jnp.exp(logs) * (logs - _log_probs(others, mask)), axis=-1)


def allowed(outputs: Array, mask: Array | None) -> Array:
    """Return the logits (..., A) of actions, with those that a task does not have out of reach."""
    return outputs if mask is None else jnp.where(mask > 0, outputs, _NEVER)


def _log_probs(outputs: Array, mask: Array | None) -> Array:
    """Return the log-probability (..., A) of every action."""
    return jax.nn.log_softmax(allowed(outputs, mask), axis=-1)
