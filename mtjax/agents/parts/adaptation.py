"""Learning to adapt: parameters that are good after a few gradient steps on a task (Finn et al. 2017, "MAML")."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array

Gain = Callable[[Any, Any], Array]
"""What one task gains () with parameters, as far as data of it tell."""


def adapt(gain: Gain, params: Any, data: Any, rate: float | Array, first_order: bool = False) -> Any:
    """Return parameters after gradient steps on one task, as a function of ``params`` that can be differentiated:

        theta_(k+1) = theta_k + rate grad gain(theta_k, D_k)

    Args:
        data: of each step, leaves (K, ...); of policies they are rollouts of the policy with theta_k.
        first_order: take these gradients as constants, so that nothing is differentiated twice.
    """

    def step(params: Any, data: Any) -> tuple[Any, None]:
        slope = jax.grad(gain)(params, data)
        slope = jax.lax.stop_gradient(slope) if first_order else slope
        return jax.tree.map(lambda x, y: x + rate * y, params, slope), None

    return jax.lax.scan(step, params, data)[0]


def surrogate(log_ratio: Array, advantage: Array) -> Array:
    """Return the gain () of a policy in steps (N,) that another has taken, or the same before it learned:

        mean(pi / pi_old A)

    Where both are the same, its first and second derivatives are on average those of the expected advantage (Foerster
    et al. 2018, "DiCE"), as MAML needs both. Those of mean(log pi A) are not: the second lacks the product of two
    slopes of log pi.

    Args:
        log_ratio: (N,) of the probability of each step to that under the policy that took it.
    """
    return jnp.mean(jnp.exp(log_ratio) * advantage)
