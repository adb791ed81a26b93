"""Targets of values: pure functions of consecutive steps, leaves (L, ...) of one task.

Everywhere s' is the true observation after a step, d = 0 where nothing can follow, and gamma the task's discount.
Sums over later steps end where steps are ``cut``, as by a time limit, and after the last step.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.policies import Drawn, Taken
from mtjax.types import Array, Transition


def td(steps: Transition, next_value: Array, gamma: float | Array) -> Array:
    """Return r + gamma d V(s')."""
    return steps.reward + gamma * steps.discount * next_value


def gae(steps: Transition, value: Array, next_value: Array, gamma: float | Array, lambda_: float | Array) -> Array:
    """Return generalised advantages (Schulman et al. 2016).

    A_t = r_t + gamma d_t V(s'_t) - V(s_t) + gamma lambda A_(t+1)
    """
    return _summed(td(steps, next_value, gamma) - value, gamma * lambda_ * ~steps.cut)


def lambda_returns(steps: Transition, next_value: Array, gamma: float | Array, lambda_: float | Array) -> Array:
    """Return the lambda-returns of values after each step (Sutton 1988), as in PQN.

    G_t = r_t + gamma d_t ((1 - lambda) V(s'_t) + lambda G_(t+1)); where the sum is cut, G_t = r_t + gamma d_t V(s'_t)
    """
    goes_on = jnp.where(_last(steps), 0.0, lambda_ * ~steps.cut)
    return _summed(td(steps, (1 - goes_on) * next_value, gamma), gamma * steps.discount * goes_on)


class VTrace(NamedTuple):
    """Holds the targets of values, and the advantages of the actions that were taken; both (L, ...)."""

    target: Array
    advantage: Array


def vtrace(
    steps: Transition,
    value: Array,
    next_value: Array,
    log_ratio: Array,
    gamma: float | Array,
    lambda_: float | Array = 1.0,
    largest: float = 1.0,
) -> VTrace:
    """Return V-trace for a policy pi, from steps of a policy mu (Espeholt et al. 2018, equations 1 and 4).

    With rho_t = min(``largest``, pi / mu) and c_t = lambda min(1, pi / mu):
        v_t = V(s_t) + rho_t (r_t + gamma d_t V(s'_t) - V(s_t)) + gamma c_t (v_(t+1) - V(s_(t+1)))
        A_t = rho_t (r_t + gamma d_t ((1 - lambda) V(s'_t) + lambda v_(t+1)) - V(s_t))
    With pi = mu these are generalised advantages A_t, and v_t = V(s_t) + A_t.

    Args:
        log_ratio: (L, ...) log pi(a|s) - log mu(a|s).
    """
    ratio = jnp.exp(log_ratio)
    rho, going = jnp.minimum(largest, ratio), lambda_ * ~(steps.cut | _last(steps))
    later = _summed(rho * (td(steps, next_value, gamma) - value), gamma * going * jnp.minimum(1.0, ratio))
    target = value + later
    ahead = (1 - going) * next_value + going * jnp.roll(target, -1, axis=0)
    return VTrace(target, rho * (td(steps, ahead, gamma) - value))


def corrections(
    steps: Transition, q: Array, next_value: Array, log_ratio: Array, gamma: float | Array, lambda_: float | Array
) -> Array:
    """Return what later steps add to next values, for a policy pi from steps of a policy mu (Munos et al. 2016).

    With them the targets y of Q(s_t, a_t) are those of Retrace (equation 4). They are 0 where the sum is cut, and with
    lambda = 0.
        y_t = r_t + gamma d_t (V(s'_t) + x_t)
        x_t = c_(t+1) (y_(t+1) - Q(s_(t+1), a_(t+1))),  c_t = lambda min(1, pi / mu)

    Args:
        q: (L, ...) of the actions that were taken.
        next_value: (L, ...) V(s') = E_pi Q(s', a).
        log_ratio: (L, ...) log pi(a|s) - log mu(a|s).
    """
    trace = jnp.roll(lambda_ * jnp.exp(jnp.minimum(log_ratio, 0.0)), -1, axis=0) * ~(steps.cut | _last(steps))
    beyond = _summed(td(steps, next_value, gamma) - q, gamma * steps.discount * trace)
    return trace * jnp.roll(beyond, -1, axis=0)


def _last(steps: Transition) -> Array:
    """Return which steps (L, ...) are the last of all."""
    return jnp.broadcast_to(jnp.arange(len(steps.reward)) == len(steps.reward) - 1, steps.reward.shape[::-1]).T


def _summed(errors: Array, decay: Array) -> Array:
    """Return x_t = errors_t + decay_t x_(t+1) for all t of (L, ...); after the last step x is 0."""

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, decay = step
        summed = error + decay * later
        return summed, summed

    return jax.lax.scan(back, jnp.zeros_like(errors[0]), (errors, decay), reverse=True)[1]


# The targets of critics of actions, from a replay, as parts of an agent.


@dataclasses.dataclass(frozen=True)
class TD:
    """The target is the reward and the value after it; with ``n_step``, after so many rewards, whoever acted.

    Every target is a class with these methods.
    """

    @property
    def window(self) -> int:
        """Consecutive steps that a replay draws at once, and over which targets sum; 0 for transitions alone."""
        return 0

    def keep(self, drawn: Drawn) -> Any:
        """Return what a replay keeps of the policy that has drawn an action; None for nothing."""
        return None

    def beyond(self, steps: Transition, q: Array, next_value: Array, log_ratio: Array) -> Array:
        """Return what later steps add to next values, of windows whose ``discount`` counts gamma; all are (L, B)."""
        return jnp.zeros_like(q)


@dataclasses.dataclass(frozen=True)
class Retrace(TD):
    """The target sums later rewards as far as the present policy would have acted as the older one (Munos et al. 2016).

    In windows of L steps that a policy mu has played, with delta the error of a step (their equation 4):
        y_t = Q(s_t, a_t) + sum_(k >= t) gamma^(k-t) c_(t+1) ... c_k delta_k
        delta_k = r_k + gamma d_k V(s_(k+1)) - Q(s_k, a_k),  V(s) = Q(s, a') - a_i log pi(a'|s),  a' ~ pi(s)
        c_k = lambda min(1, pi(a_k|s_k) / mu(a_k|s_k))
    V is soft: for one policy, SAC's entropy is part of the reward of the step before (Haarnoja et al. 2018, lemma 1),
    so that a' counts it and the action that was taken does not, and Retrace stays as it is. Every Q is the target
    critics', by their minimum or mean. All steps of a window are learned from, so that ``batch_size`` counts windows. A
    termination ends the bootstrap, a time limit the sum alone. A replay keeps each action before its tanh, and its
    log-probability. With lambda = 0 it is TD.

    Differs from the paper: V is estimated by one action. A random action of the warm-up is held for some steps, so that
    the past decides it and mu has no density: c is 0. A distribution of returns is shifted as a whole.
    """

    retrace_steps: int = 8
    """Steps L of a window, to whose end later rewards count; a recurrent memory has recurrent-steps instead."""
    retrace_lambda: float = 1.0
    """Lambda of targets: 0 relies on the critics alone, 1 on rewards as far as the policy would have acted so."""

    def __post_init__(self):
        parts.require_counts(self, "retrace_steps")
        parts.require_shares(self, "retrace_lambda")

    @property
    def window(self) -> int:
        return self.retrace_steps

    def keep(self, drawn: Drawn) -> Taken:
        return Taken(drawn.raw, drawn.log_prob)

    def beyond(self, steps: Transition, q: Array, next_value: Array, log_ratio: Array) -> Array:
        return corrections(steps, q, next_value, log_ratio, 1.0, self.retrace_lambda)


Target = TD
TARGETS: dict[str, type[Target]] = {"td": TD, "retrace": Retrace}
