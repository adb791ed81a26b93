"""Targets of values: pure functions of consecutive steps, leaves (L, ...) of one task.

Everywhere s' is the true observation after a step, d = 0 where nothing can follow, and gamma the task's discount.
Sums over later steps end where steps are ``cut``, as by a time limit, and after the last step.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

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
    ratio = jnp.exp(jnp.minimum(log_ratio, 20.0))
    rho, going = jnp.minimum(largest, ratio), lambda_ * ~(steps.cut | _last(steps))
    later = _summed(rho * (td(steps, next_value, gamma) - value), gamma * going * jnp.minimum(1.0, ratio))
    target = value + later
    ahead = (1 - going) * next_value + going * jnp.roll(target, -1, axis=0)
    return VTrace(target, rho * (td(steps, ahead, gamma) - value))


def retrace(
    steps: Transition, q: Array, next_value: Array, log_ratio: Array, gamma: float | Array, lambda_: float | Array
) -> Array:
    """Return the targets of Q(s_t, a_t) for a policy pi, from steps of a policy mu (Munos et al. 2016, equation 4).

    y_t = r_t + gamma d_t V(s'_t) + gamma c_(t+1) (y_(t+1) - Q(s_(t+1), a_(t+1))),  c_t = lambda min(1, pi / mu)

    Args:
        q: (L, ...) of the actions that were taken.
        next_value: (L, ...) V(s') = E_pi Q(s', a).
        log_ratio: (L, ...) log pi(a|s) - log mu(a|s).
    """
    trace = jnp.roll(lambda_ * jnp.exp(jnp.minimum(log_ratio, 0.0)), -1, axis=0) * ~(steps.cut | _last(steps))
    return q + _summed(td(steps, next_value, gamma) - q, gamma * trace)


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
