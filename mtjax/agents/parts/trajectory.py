"""The trajectory encoder infers features of a hidden task from the last steps."""

from collections.abc import Callable
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.networks import MLP
from mtjax.types import Array, Transition


class Past(NamedTuple):
    """Holds the last H steps of an episode, the latest one last; entries from before the episode are zero."""

    obs: Array  # (..., H, O) before the action
    action: Array  # (..., H, A)
    reward: Array  # (..., H)
    known: Array  # (..., H) 1 for a step that was taken, 0 from before the episode


class Seen(NamedTuple):
    """Holds an observation and the steps before it."""

    obs: Array  # (..., O)
    past: Past


def begin(steps: int, obs_size: int, action_size: int) -> Past:
    """Return the empty past with which an episode begins."""
    blank = lambda *shape: jnp.zeros((steps, *shape))
    return Past(blank(obs_size), blank(action_size), blank(), blank())


def append(past: Past, obs: Array, action: Array, reward: Array) -> Past:
    """Append a step, leaves (..., O), (..., A) and (...,), and drop the oldest one."""
    latest = Past(obs, action, reward, jnp.ones_like(reward))
    lead = reward.ndim
    join = lambda old, new: jnp.concatenate(
        [jax.lax.slice_in_dim(old, 1, None, axis=lead), jnp.expand_dims(new, lead)], axis=lead
    )
    return jax.tree.map(join, past, latest)


def relabel(one: Callable[[Transition], Transition], transition: Transition) -> Transition:
    """Relabel a transition and its past as another task's by ``one``, which relabels single steps."""
    past: Past = transition.extras
    following = jnp.concatenate([past.obs[1:], transition.obs[None]])

    def step(obs: Array, action: Array, reward: Array, next_obs: Array) -> Transition:
        return one(transition._replace(obs=obs, action=action, reward=reward, next_obs=next_obs, extras=None))

    then = jax.vmap(step)(past.obs, past.action, past.reward, following)
    known = past.known > 0
    past = past._replace(
        obs=jnp.where(known[:, None], then.obs, past.obs), reward=jnp.where(known, then.reward, past.reward)
    )
    return one(transition)._replace(extras=past)


class TrajectoryEncoder(nn.Module):
    """Encodes the last steps as features of the task.

    For steps t with state, action, reward and change of state (s_t, a_t, r_t, s_{t+1} - s_t), of which n were taken in
    this episode:
        z = W mean_t MLP([s_t, a_t, r_t, s_{t+1} - s_t]) + b
    and z = b while n = 0. In a Markov process the order of these steps tells nothing of the task, so their features are
    averaged; PEARL's context encoder combines them by a product without order too (Rakelly et al. 2019, section 4.1).
    All steps are one batched product, where a recurrent network (Duan et al. 2016, "RL^2") takes H in sequence.

    Differs from PEARL: z is a point and not a distribution; each network has its own encoder, trained by that network's
    loss; the steps are those right before the observation, and not drawn from all of the task's.
    """

    size: int  # number of features
    widths: tuple[int, ...] = (64, 64)
    layer_norm: bool = False

    @nn.compact
    def __call__(self, seen: Seen) -> Array:
        """Map observations (..., O) and past steps (..., H, x) to features (..., Z)."""
        past = seen.past
        following = jnp.concatenate([past.obs[..., 1:, :], seen.obs[..., None, :]], axis=-2)
        steps = jnp.concatenate([past.obs, past.action, past.reward[..., None], following - past.obs], axis=-1)
        known = past.known[..., None]
        encoded = MLP(self.widths, self.layer_norm)(steps * known)
        mean = jnp.sum(encoded * known, axis=-2) / jnp.maximum(jnp.sum(known, axis=-2), 1)
        return nn.Dense(self.size)(mean)
