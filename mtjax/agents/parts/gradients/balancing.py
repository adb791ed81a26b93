"""Rules of gradient surgery that balance tasks over time, by weights that are learned.

Both rules use ratios of losses, which make sense only if 0 is the lower bound of a loss. Agents therefore subtract the
lower bound of what a representation adds to their critics' losses (``least_loss``), as a log-likelihood may be
negative. An actor's loss has no known bound, so ``for_actor`` returns rules that use no losses. A loss of 0 or less
marks a task as absent.
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
"""Lower bound of GradNorm's weights, as a step of Adam may cross zero."""
NEVER = -1e30
"""Logit of an absent task; if all are absent, the softmax is uniform."""


class Balance(NamedTuple):
    """Holds the memory of GradNorm."""

    weights: Array  # (T,) of sum T
    optimizer: Any  # state of their optimiser
    first: Array  # (T,) each task's first loss; 0 before it


class Logits(NamedTuple):
    """Holds the memory of FAMO."""

    logits: Array  # (T,)
    optimizer: Any  # state of their optimiser
    losses: Array  # (T,) running means; 0 before the first


def _step(rate: float, values: Array, slope: Array, memory: Any, present: Array) -> tuple[Array, Any]:
    """Descend ``slope`` (T,) by Adam where tasks are present, and return values (T,) and the optimiser's state."""
    change, memory = optax.adam(rate).update(jnp.where(present, slope, 0.0), memory)
    return values + jnp.where(present, change, 0.0), memory  # type: ignore


@dataclasses.dataclass(frozen=True)
class GradNorm(Mean):
    """GradNorm learns weights that let all tasks learn at one rate (Chen et al. 2018, algorithm 1).

    With the length n_i of task i's gradient and its loss L_i, relative to its first:
        r_i = (L_i / L_i(0)) / mean_j (L_j / L_j(0))                          (how far behind a task is)
        L(w) = sum_i |w_i n_i - mean_j (w_j n_j) r_i^a|                       (the second term a constant)
    Weights descend L by Adam and are scaled to sum to T; an update uses the weights from before it. An absent task
    keeps its weight.

    Differs from the paper: n_i is over all shared parameters, where the paper takes the last layer; L is in units of
    the mean length, so that Adam's step does not depend on the losses' scale; losses are counted from their lower
    bound. An actor's losses do not measure its progress, so its weights make all lengths equal (a = 0).
    """

    needs = "gradients"
    weight_lr: float = 0.025
    """Adam's learning rate for the tasks' weights."""
    gradnorm_asymmetry: float = 1.0
    """How strongly tasks that are behind gain weight (a); 0 makes all lengths equal. The paper: 0.12 to 1.5."""

    def __post_init__(self):
        parts.require_positive(self, "weight_lr")
        parts.require_not_negative(self, "gradnorm_asymmetry")

    def init(self, num_tasks: int) -> Balance:
        weights = jnp.ones(num_tasks)
        return Balance(weights, optax.adam(self.weight_lr).init(weights), jnp.zeros(num_tasks))

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

        weights, optimizer = _step(self.weight_lr, memory.weights, slope, memory.optimizer, present)
        weights = jnp.maximum(weights, LEAST_WEIGHT)
        total = lambda x: jnp.sum(weights, where=x)
        scale = (len(weights) - total(~present)) / unless(total(present), 1.0)
        weights = jnp.where(present, scale * weights, weights)
        return memory.weights / len(weights), Balance(weights, optimizer, first)

    @property
    def for_actor(self) -> Mean:
        return parts.put(self, gradnorm_asymmetry=0.0)


@dataclasses.dataclass(frozen=True)
class FAMO(Mean):
    """FAMO learns weights that lower all losses' logarithms at one rate (Liu et al. 2023, algorithm 1).

    With the losses l of a batch before the update and l' after it, running means m of l, and logits x:
        m <- m + rate (l - m),  at first m = l
        z = softmax(x),  w_i = (z_i / m_i) / sum_j (z_j / m_j)                     (weights of the update)
        x descends  z_i (d_i - z . d) + decay x_i,  d = log l - log l'             (first the gradient of z . d)
    It needs no gradients of single tasks. Losses are counted from their lower bound, as in its authors' code. The
    actor's losses have no such bound, and are averaged.

    Differs from the paper: w divides by running means of the losses. Algorithm 1 divides by the losses l of all data,
    and its authors' code by those of a batch (``famo_rate`` = 1). Where rewards are rare, a batch with a reward has a
    loss hundreds of times that of others, so it would get almost no weight, and the critic would not learn of rewards.
    MINE divides by a running mean for the same reason (Belghazi et al. 2018, section 3.2): the gradient of the
    logarithm of a batch's mean is biased. x descends by Adam, as in the authors' code; algorithm 1 has a plain step of
    the same size, which would leave z nearly uniform, as a critic's losses change slowly. Parameters of one task are
    not weighted.
    """

    needs = "losses"
    weight_lr: float = 0.025
    """Adam's learning rate for the tasks' weights."""
    famo_decay: float = 1e-3
    """How strongly FAMO's weights return to equal ones. Its authors: 1e-3 for MT10."""
    famo_rate: float = 0.01
    """Step of the losses' running means towards a batch's losses; 1 weighs by the batch's alone, as its authors do."""

    def __post_init__(self):
        parts.require_positive(self, "weight_lr")
        parts.require_not_negative(self, "famo_decay")
        parts.require_rates(self, "famo_rate")

    def init(self, num_tasks: int) -> Logits:
        logits = jnp.zeros(num_tasks)
        return Logits(logits, optax.adam(self.weight_lr).init(logits), jnp.zeros(num_tasks))

    def weigh(self, memory: Logits, gram: Array, losses: Array, key: Key) -> tuple[Array, Logits]:
        present = losses > 0
        rate = jnp.where(memory.losses > 0, self.famo_rate, 1.0)
        means = jnp.where(present, (1 - rate) * memory.losses + rate * losses, memory.losses)
        weights = jax.nn.softmax(jnp.where(present, memory.logits - _log(means), NEVER))
        return weights, memory._replace(losses=means)

    def adapt(self, memory: Logits, before: Array, after: Array) -> Logits:
        present = (before > 0) & (after > 0)
        z = jax.nn.softmax(jnp.where(present, memory.logits, NEVER))
        gain = jnp.where(present, _log(before) - _log(after), 0.0)
        slope = z * (gain - jnp.sum(z * gain)) + self.famo_decay * memory.logits
        logits, optimizer = _step(self.weight_lr, memory.logits, slope, memory.optimizer, present)
        return memory._replace(logits=logits, optimizer=optimizer)

    @property
    def for_actor(self) -> Mean:
        return Mean()


def _log(losses: Array) -> Array:
    return jnp.log(jnp.where(losses > 0, losses, 1.0))
