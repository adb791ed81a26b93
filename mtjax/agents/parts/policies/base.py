"""The interface of policies."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

from mtjax.agents.networks import Params
from mtjax.types import Array, Key


class Drawn(NamedTuple):
    """Holds what a policy has drawn."""

    action: Array  # as the world takes it: (..., A); of discrete actions (...,) int32, or (..., D) int32 of several
    raw: Array  # what ``log_prob`` takes: of a tanh-squashed Gaussian the action before the tanh
    log_prob: Array  # (...,) its log-probability; 0 for the mode of a Gaussian


class Taken(NamedTuple):
    """Holds what is stored with an action when it is taken."""

    raw: Array  # as ``log_prob`` takes it
    log_prob: Array  # () its log-probability under the policy that took it


@dataclasses.dataclass(frozen=True)
class Policy(abc.ABC):
    """Reads the outputs (..., P) of an actor as a distribution over actions.

    A ``mask`` (A,) is 1 for actions, or entries of an action, that a task has, else 0; None: it has all.
    """

    @abc.abstractmethod
    def outputs(self, size: int) -> int:
        """Return the number P of outputs for actions of size A."""

    @abc.abstractmethod
    def first(self, size: int, std: float | Array) -> Array:
        """Return the bias (P,) with which an actor's head begins.

        Args:
            std: standard deviation of a continuous action before the tanh.
        """

    @abc.abstractmethod
    def blank(self, nets: Mapping[str, Params]) -> Array:
        """Return an action that is all zero, of an agent with these networks."""

    @abc.abstractmethod
    def encode(self, action: Array) -> Array:
        """Return actions as the vectors (..., A) that networks take."""

    @abc.abstractmethod
    def draw(self, outputs: Array, mask: Array | None, key: Key | None) -> Drawn:
        """Draw actions; without a key, take the mode: the mean of a Gaussian before the tanh, the likeliest choices."""

    @abc.abstractmethod
    def action(self, raw: Array, mask: Array | None) -> Array:
        """Return the action that a drawn ``raw`` stands for."""

    @abc.abstractmethod
    def log_prob(self, outputs: Array, raw: Array, mask: Array | None = None) -> Array:
        """Return the log-probability (...,) of drawn actions."""

    @abc.abstractmethod
    def entropy(self, outputs: Array, mask: Array | None, key: Key) -> Array:
        """Return the entropy (...,), or an estimate of it by a sample."""

    @abc.abstractmethod
    def divergence(self, outputs: Array, others: Array, mask: Array | None = None) -> Array:
        """Return the Kullback-Leibler divergence KL(p | q) (...,) of p by ``outputs`` from q by ``others``."""
