"""Features of a hidden task, which a trajectory encoder infers from the last steps."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import MLP, Params, init_params
from mtjax.agents.parts.knowing.base import Nothing
from mtjax.types import Array, Key


class Past(NamedTuple):
    """Holds the last H steps of an episode, the latest one last; entries from before the episode are zero."""

    obs: Array  # (..., H, O) before the action
    action: Array  # (..., H, A); of discrete actions (..., H) int32, or (..., H, D) int32 of several
    reward: Array  # (..., H)
    known: Array  # (..., H) 1 for a step that was taken, 0 from before the episode


class Seen(NamedTuple):
    """Holds an observation and the steps before it."""

    obs: Array  # (..., O)
    past: Past


def begin(steps: int, obs_size: int, action: Array) -> Past:
    """Return the empty past with which an episode begins; its actions are like ``action``, and zero."""
    blank = lambda *shape: jnp.zeros((steps, *shape))
    return Past(blank(obs_size), jnp.zeros((steps, *action.shape), action.dtype), blank(), blank())


def append(past: Past, obs: Array, action: Array, reward: Array) -> Past:
    """Append a step, leaves (..., O), (..., A) and (...,), and drop the oldest one."""
    latest = Past(obs, action, reward, jnp.ones_like(reward))
    lead = reward.ndim
    join = lambda old, new: jnp.concatenate(
        [jax.lax.slice_in_dim(old, 1, None, axis=lead), jnp.expand_dims(new, lead)], axis=lead
    )
    return jax.tree.map(join, past, latest)


def without_past(seen: Any) -> Any:
    """Return observations without the past steps that may come with them."""
    return seen.obs if isinstance(seen, Seen) else seen


class TrajectoryEncoder(nn.Module):
    """Encodes the last steps as features of the task.

    For steps t with state, action, reward and change of state (s_t, a_t, r_t, s_{t+1} - s_t), of which n were taken in
    this episode:
        z = W mean_t MLP([s_t, a_t, r_t, s_{t+1} - s_t]) + b
    and z = b while n = 0. In a Markov process the order of these steps tells nothing of the task, so their features are
    averaged; PEARL's context encoder combines them by a product without order too (Rakelly et al. 2019, section 4.1).
    All steps are one batched product, where a recurrent network (Duan et al. 2016, "RL^2") takes H in sequence.

    Layers are normalised. Differs from PEARL: z is a point and not a distribution; the steps are those right before the
    observation, and not drawn from all of the task's.
    """

    size: int  # number of features
    widths: tuple[int, ...] = (64, 64)

    @nn.compact
    def __call__(self, seen: Seen) -> Array:
        """Map observations (..., O) and past steps (..., H, x) to features (..., Z)."""
        past = seen.past
        following = jnp.concatenate([past.obs[..., 1:, :], seen.obs[..., None, :]], axis=-2)
        steps = jnp.concatenate([past.obs, past.action, past.reward[..., None], following - past.obs], axis=-1)
        known = past.known[..., None]
        encoded = MLP(self.widths, layer_norm=True)(steps * known)
        mean = jnp.sum(encoded * known, axis=-2) / jnp.maximum(jnp.sum(known, axis=-2), 1)
        return nn.Dense(self.size)(mean)


@dataclasses.dataclass(frozen=True)
class LastSteps(Nothing):
    """Shows networks what a trajectory encoder infers of a hidden task from the last steps."""

    embedding_size: int = 16
    """Size of the features that are learned or inferred."""
    inferred_from: int = 8
    """Number of last steps from which the task is inferred; they are stored with every transition."""

    tells: ClassVar[bool] = True

    def __post_init__(self):
        parts.require_counts(self, "embedding_size", "inferred_from")

    @property
    def history(self) -> int:
        return self.inferred_from

    @property
    def encoder(self) -> TrajectoryEncoder:
        return TrajectoryEncoder(self.embedding_size)

    def init(self, num_tasks: int, seen: Any, action: Array, own: bool, key: Key) -> Params:
        return init_params(lambda key: {"trajectory": self.encoder.init(key, seen)}, own, key, num_tasks)

    def features(self, params: dict[str, Any], task_vector: Array, seen: Any) -> Array:
        return self.encoder.apply(params["trajectory"], seen)  # type: ignore
