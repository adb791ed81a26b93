"""Policies that choose several actions at once."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import jax
import jax.numpy as jnp

from mtjax.agents.networks import Params
from mtjax.agents.parts.policies.base import Drawn, Policy
from mtjax.agents.parts.policies.categorical import Categorical
from mtjax.types import Array, Key, MultiDiscrete


@dataclasses.dataclass(frozen=True)
class MultiCategorical(Policy):
    """Draws several numbers, each from a ``Categorical`` of its own (as Tang and Agrawal 2020, "Discretizing continuous
    action space for on-policy optimization").

    Outputs (..., A) are the logits of all numbers one after another, and so are the entries of a mask. Then
        pi(a|s) = prod_d pi_d(a_d|s)
    so that log-probabilities, entropies and divergences are sums over the numbers.
    """

    actions: MultiDiscrete
    outputs, first, action = Categorical.outputs, Categorical.first, Categorical.action

    def blank(self, nets: Mapping[str, Params]) -> Array:
        return self.actions.blank()

    def encode(self, action: Array) -> Array:
        return self.actions.encode(action)

    def draw(self, outputs: Array, mask: Array | None, key: Key | None) -> Drawn:
        runs = self.actions.runs
        keys = [None] * len(runs) if key is None else jax.random.split(key, len(runs))
        parts = zip(self._parts(outputs, mask), keys, strict=True)
        drawn = [choice.draw(logits, there, part_key) for (choice, logits, there), part_key in parts]
        action = jnp.concatenate([part.action for part in drawn], axis=-1)
        return Drawn(action, action, _sum([part.log_prob for part in drawn]))

    def log_prob(self, outputs: Array, raw: Array, mask: Array | None = None) -> Array:
        parts = zip(self._parts(outputs, mask), self.actions.split(raw), strict=True)
        return _sum([choice.log_prob(logits, numbers, there) for (choice, logits, there), numbers in parts])

    def entropy(self, outputs: Array, mask: Array | None, key: Key) -> Array:
        """Return the exact entropy (...,)."""
        return _sum([choice.entropy(logits, there, key) for choice, logits, there in self._parts(outputs, mask)])

    def divergence(self, outputs: Array, others: Array, mask: Array | None = None) -> Array:
        parts = zip(self._parts(outputs, mask), self.actions.split_vectors(others), strict=True)
        return _sum([choice.divergence(logits, other, there) for (choice, logits, there), other in parts])

    def _parts(self, outputs: Array, mask: Array | None) -> Iterator[tuple[Categorical, Array, Array | None]]:
        """Return the policy of each run of equal sizes, its logits (..., d, size), and its mask (d, size)."""
        runs = self.actions.runs
        masks = [None] * len(runs) if mask is None else self.actions.split_vectors(mask)
        return zip([Categorical(size) for size, _ in runs], self.actions.split_vectors(outputs), masks, strict=True)


def _sum(parts: Sequence[Array]) -> Array:
    """Return the sums (...,) over all numbers, given arrays (..., d) of some each."""
    return jnp.sum(jnp.concatenate(parts, axis=-1), axis=-1)
