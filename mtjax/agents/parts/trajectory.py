"""What an agent infers of a hidden task from the steps it has just taken."""

import flax.linen as nn
import jax.numpy as jnp

from mtjax.history import Seen
from mtjax.networks import MLP
from mtjax.types import Array


class TrajectoryEncoder(nn.Module):
    """Encode the last steps as features of the task.

    For steps t with state, action, reward and change of state (s_t, a_t, r_t, s_{t+1} - s_t), of which n were taken in
    this episode:
        z = W mean_t MLP([s_t, a_t, r_t, s_{t+1} - s_t]) + b
    and z = b as long as there is none. Given the task, the steps of a Markov process tell of it in any order, so their
    features are averaged, as the context encoder of PEARL combines them by a product that has no order either
    (Rakelly et al. 2019, section 4.1). That is one batched product over all steps, where a recurrent network (Duan et
    al. 2016, "RL^2") would take H in a row.

    Differs from PEARL: z is a number and not a distribution, each network has an encoder of its own that learns from
    that network's loss, and steps are those right before the observation, not drawn from all of the task's.
    """

    size: int  # of the features
    widths: tuple[int, ...] = (64, 64)
    layer_norm: bool = False

    @nn.compact
    def __call__(self, seen: Seen) -> Array:
        """Map what is seen, leaves (..., O) and (..., H, x), to features (..., Z)."""
        past = seen.past
        following = jnp.concatenate([past.obs[..., 1:, :], seen.obs[..., None, :]], axis=-2)
        steps = jnp.concatenate([past.obs, past.action, past.reward[..., None], following - past.obs], axis=-1)
        known = past.known[..., None]
        encoded = MLP(self.widths, self.layer_norm)(steps * known)
        mean = jnp.sum(encoded * known, axis=-2) / jnp.maximum(jnp.sum(known, axis=-2), 1)
        return nn.Dense(self.size)(mean)
