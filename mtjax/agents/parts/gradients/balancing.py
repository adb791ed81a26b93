"""Rules of gradient surgery that balance tasks over time: weights that are parameters, learned beside the networks'.

Both look at ratios of losses, which mean something only where 0 is the least that a loss can be. Agents count their
critics' losses from there (``least_loss``), as a log-likelihood, for one, may be negative; an actor's loss has no
known least, and ``for_actor`` looks at none. A loss that is 0 or below all the same is that of a task that is absent.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from mtjax.agents import parts
from mtjax.agents.parts.gradients.rules import Mean
from mtjax.types import Array, Key

LEAST_WEIGHT = 1e-6
"""What GradNorm leaves to a task, as a step may cross zero."""
NEVER = -1e30
"""The logit of a task without a say; where none has one, a softmax of it is uniform."""


class Balance(NamedTuple):
    """What GradNorm remembers."""

    weights: Array  # (T,), which sum to T
    optimizer: Any  # theirs
    first: Array  # (T,) each task's first loss; 0 before there was one


class Logits(NamedTuple):
    """What FAMO remembers."""

    logits: Array  # (T,)
    optimizer: Any  # theirs


@dataclasses.dataclass(frozen=True)
class _Learned(Mean):
    """Weights by Adam."""

    weight_lr: float = 0.025
    """Adam's learning rate of the tasks' weights."""

    def __post_init__(self):
        parts.require_positive(self, "weight_lr")

    @property
    def optimizer(self) -> optax.GradientTransformation:
        return optax.adam(self.weight_lr)

    def step(self, values: Array, slope: Array, memory: Any, present: Array) -> tuple[Array, Any]:
        """Descend ``slope`` (T,) where tasks are present; returns the values (T,) and the optimiser's memory."""
        change, memory = self.optimizer.update(jnp.where(present, slope, 0.0), memory)
        return values + jnp.where(present, change, 0.0), memory  # type: ignore


@dataclasses.dataclass(frozen=True)
class GradNorm(_Learned):
    """Weights that let all tasks learn at one rate (Chen et al. 2018, algorithm 1).

    With the length n_i of task i's gradient and its loss L_i, relative to its first:
        r_i = (L_i / L_i(0)) / mean_j (L_j / L_j(0))                          (how far behind a task is)
        L(w) = sum_i |w_i n_i - mean_j (w_j n_j) r_i^a|                       (the second term a constant)
    Weights descend L by Adam and are scaled to sum to T; an update uses those from before. A task that is absent keeps
    its weight.

    Differs from the paper: n_i is over all shared parameters, of which the paper takes the last layer; L is in units of
    the mean length, so that Adam's step does not depend on the losses' scale; losses are counted from the least that
    they can be. An actor's losses tell nothing of its progress, so that its weights make all lengths equal (a = 0).
    """

    needs = "gradients"
    gradnorm_asymmetry: float = 1.0
    """How much more the tasks that are behind count (a); 0 makes all lengths equal. The paper: 0.12 to 1.5."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_not_negative(self, "gradnorm_asymmetry")

    def init(self, num_tasks: int) -> Balance:
        weights = jnp.ones(num_tasks)
        return Balance(weights, self.optimizer.init(weights), jnp.zeros(num_tasks))

    def weigh(self, memory: Balance, gram: Array, losses: Array, key: Key) -> tuple[Array, Balance]:
        lengths = jnp.sqrt(jnp.diagonal(gram))
        present = lengths > 0
        mean = lambda x: jnp.sum(jnp.where(present, x, 0.0)) / jnp.maximum(jnp.sum(present), 1)
        unless = lambda x, otherwise: jnp.where(x > 0, x, otherwise)

        losses = jnp.maximum(losses, 0.0)
        first = unless(memory.first, losses)
        left = jnp.where(first > 0, losses / unless(first, 1.0), 1.0)
        rate = left / unless(mean(left), 1.0)
        weighted = memory.weights * lengths
        target = mean(weighted) * rate**self.gradnorm_asymmetry
        slope = jnp.sign(weighted - target) * lengths / unless(mean(weighted), 1.0)

        weights, optimizer = self.step(memory.weights, slope, memory.optimizer, present)
        weights = jnp.maximum(weights, LEAST_WEIGHT)
        total = lambda x: jnp.sum(weights, where=x)
        scale = (len(weights) - total(~present)) / unless(total(present), 1.0)
        weights = jnp.where(present, scale * weights, weights)
        return memory.weights / len(weights), Balance(weights, optimizer, first)

    @property
    def for_actor(self) -> Mean:
        return parts.put(self, gradnorm_asymmetry=0.0)


@dataclasses.dataclass(frozen=True)
class FAMO(_Learned):
    """Weights that lower all losses' logarithms at one rate (Liu et al. 2023, algorithm 1), without tasks' gradients.

    With the losses l of a batch before the update and l' after it, and logits x:
        z = softmax(x),  w_i = (z_i / l_i) / sum_j (z_j / l_j)                     (weights of the update)
        x descends  z_i (d_i - z . d) + decay x_i,  d = log l - log l'             (the losses' part: d by z's slope)
    Losses are counted from the least that they can be, as in its authors' code. The actor's may be anything, and are
    averaged.

    Differs from the paper: x descends by Adam, as in its authors' code; algorithm 1 has a plain step of the same size,
    which at the pace of a critic's losses would leave z all but uniform. Parameters of one task are not weighted.
    """

    needs = "losses"
    famo_decay: float = 1e-3
    """How strongly FAMO's weights return to equal ones. Its authors: 1e-3 for MT10."""

    def __post_init__(self):
        super().__post_init__()
        parts.require_not_negative(self, "famo_decay")

    def init(self, num_tasks: int) -> Logits:
        logits = jnp.zeros(num_tasks)
        return Logits(logits, self.optimizer.init(logits))

    def weigh(self, memory: Logits, gram: Array, losses: Array, key: Key) -> tuple[Array, Logits]:
        return jax.nn.softmax(jnp.where(losses > 0, memory.logits - _log(losses), NEVER)), memory

    def adapt(self, memory: Logits, before: Array, after: Array) -> Logits:
        present = (before > 0) & (after > 0)
        z = jax.nn.softmax(jnp.where(present, memory.logits, NEVER))
        gain = jnp.where(present, _log(before) - _log(after), 0.0)
        slope = z * (gain - jnp.sum(z * gain)) + self.famo_decay * memory.logits
        return Logits(*self.step(memory.logits, slope, memory.optimizer, present))

    @property
    def for_actor(self) -> Mean:
        return Mean()


def _log(losses: Array) -> Array:
    return jnp.log(jnp.where(losses > 0, losses, 1.0))
