"""Multi-step returns join a transition with the steps that follow it in its environment.

For a window of n steps from t on, let m be the number of steps up to and with the first that cut sums off, or n:
    R = r_t + gamma r_(t+1) + ... + gamma^(m-1) r_(t+m-1)
    y = R + gamma^m d_(t+m-1) V(s_(t+m))
s_(t+m) is what followed the window's last step in its trial, and d = 0 if nothing could. Where sums are cut off, it is
the true observation from before any reset. So a termination ends the bootstrap, and a time limit ends the sum alone
(Sutton 1988; for off-policy critics Hessel et al. 2018, "Rainbow", and Barth-Maron et al. 2018, "D4PG").

As there, nothing corrects for actions of an older policy. Of a soft value's bonus for entropy only that after the
window counts.
"""

from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import Array, Transition


def length(cut: Array) -> Array:
    """Return m (...), how many steps of windows (..., n) count: up to and with the first that cut sums off."""
    goes_on = jnp.cumprod(~cut[..., :-1], axis=-1)
    return 1 + jnp.sum(goes_on, axis=-1)


def take_steps(tree: Any, index: Array) -> Any:
    """Take entries ``index`` (..., n) along the axis of steps of leaves (..., W, ...)."""
    lead = index.ndim - 1

    def take(x: Array) -> Array:
        places = index.reshape(index.shape + (1,) * (x.ndim - index.ndim))
        return jnp.take_along_axis(x, places, axis=lead)

    return jax.tree.map(take, tree)


def join(steps: Transition, gamma: float | Array) -> Transition:
    """Join windows of consecutive steps (..., n) to one transition (...) each, for a discount () of one task.

    Its reward is R. Its discount is gamma^(m-1) d, as agents multiply it by gamma once more. If there is a memory, the
    ``extras`` are the whole last step, so that the memory after it can be told.
    """
    count = length(steps.cut)[..., None]
    index = jnp.arange(steps.reward.shape[-1])
    powers = jnp.power(gamma, index)
    final = count - 1
    lead = steps.reward.ndim - 1
    first, last = (jax.tree.map(lambda x: x.squeeze(lead), take_steps(steps, index)) for index in (0 * final, final))
    return first._replace(
        reward=jnp.sum(jnp.where(index < count, powers * steps.reward, 0.0), axis=-1),
        discount=powers[final.squeeze(-1)] * last.discount,
        next_obs=last.next_obs,
        ended=last.ended,
        closed=last.closed,
        cut=last.cut,
        extras=last if jax.tree.leaves(steps.memory) else None,
    )
