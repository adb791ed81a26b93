"""Networks as pure functions over parameters that know which of them all tasks share.

A network is a body and a linear head, applied to the data of one task; the caller maps over tasks.
"""

import dataclasses
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.types import Array, Key

_LOG_STD_RANGE = (-5.0, 2.0)


class Params(NamedTuple):
    """Parameters of a network, by who uses them."""

    shared: Any  # used by every task
    own: Any  # leaves (T, ...): each task's own, such as its head or its embedding


class MLP(nn.Module):
    """Dense layers with ReLU, and layer normalisation before it if asked for."""

    widths: tuple[int, ...]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for width in self.widths:
            x = nn.Dense(width)(x)
            x = nn.relu(nn.LayerNorm()(x) if self.layer_norm else x)
        return x


class Trunk(nn.Module):
    """An MLP on everything there is: observation, task features and, in a critic, the action."""

    widths: tuple[int, ...]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        return MLP(self.widths, self.layer_norm)(join(obs, *action, task=features))


def join(*inputs: Array, task: Array) -> Array:
    """Concatenate per-sample inputs (..., x) and what is known of the task: (..., Z), or (Z,) for every sample."""
    task = jnp.broadcast_to(task, (*inputs[0].shape[:-1], task.shape[-1]))
    return jnp.concatenate([*inputs, task], axis=-1)


@dataclasses.dataclass(frozen=True)
class Network:
    """A body, and a linear head that is shared or each task's own."""

    body: nn.Module
    own_heads: bool = False
    embedding_size: int = 0

    def init(self, key: Key, num_tasks: int, out: int, features: Array, *inputs: Array) -> Params:
        """Initialise for ``num_tasks`` tasks, ``out`` outputs, and inputs of the given shapes."""
        body_key, head_key, embedding_key = jax.random.split(key, 3)
        shared, own = {}, {}
        if self.embedding_size:
            own["embedding"] = jax.random.normal(embedding_key, (num_tasks, self.embedding_size))
            features = own["embedding"][0]
        shared["body"] = self.body.init(body_key, inputs[0], features, *inputs[1:])
        width = self.body.apply(shared["body"], inputs[0], features, *inputs[1:]).shape[-1]  # type: ignore
        if self.own_heads:
            own["head"] = jax.vmap(lambda k: _init_linear(k, width, out))(jax.random.split(head_key, num_tasks))
        else:
            shared["head"] = _init_linear(head_key, width, out)
        return Params(shared, own)

    def apply(self, params: Params, features: Array, *inputs: Array) -> Array:
        """Map one task's inputs (..., O), (..., A) to outputs (..., out); ``params.own`` holds that task's alone."""
        features = params.own.get("embedding", features)
        hidden: Any = self.body.apply(params.shared["body"], inputs[0], features, *inputs[1:])
        head = params.own["head"] if self.own_heads else params.shared["head"]
        return hidden @ head["kernel"] + head["bias"]


def _init_linear(key: Key, width: int, out: int) -> dict[str, Array]:
    return {"kernel": nn.initializers.lecun_normal()(key, (width, out)), "bias": jnp.zeros(out)}


def tanh_normal(outputs: Array, key: Key | None) -> tuple[Array, Array]:
    """Sample a tanh-squashed Gaussian (Haarnoja et al. 2018, appendix C).

    Args:
        outputs: (..., 2A) means and unbounded log standard deviations.
        key: noise; None takes the mean.

    Returns:
        actions (..., A) in (-1, 1) and their log-probabilities (...,); 0 for the mean action.
    """
    mean, log_std = jnp.split(outputs, 2, axis=-1)
    if key is None:
        return jnp.tanh(mean), jnp.zeros(mean.shape[:-1])
    low, high = _LOG_STD_RANGE
    log_std = low + 0.5 * (high - low) * (jnp.tanh(log_std) + 1)
    noise = jax.random.normal(key, mean.shape)
    raw = mean + jnp.exp(log_std) * noise
    log_normal = -0.5 * jnp.square(noise) - log_std - 0.5 * jnp.log(2 * jnp.pi)
    log_slope = 2 * (jnp.log(2.0) - raw - jax.nn.softplus(-2 * raw))
    return jnp.tanh(raw), jnp.sum(log_normal - log_slope, axis=-1)
