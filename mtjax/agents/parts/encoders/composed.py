"""Trunks compose the parameters of each task as weighted sums of K sets of parameters."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import flax.linen as nn
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.networks import MLP, ReLU
from mtjax.agents.parts.encoders.base import Identity
from mtjax.agents.parts.encoders.mixture import TaskWeights
from mtjax.types import Array

_lecun = nn.initializers.lecun_normal(batch_axis=0)


class Composed(nn.Module):
    """Applies a dense layer whose kernel and bias are sums of K kernels and biases by weights w."""

    width: int
    init_kernels: Callable[..., Any] = _lecun

    @nn.compact
    def __call__(self, x: Array, weights: Array) -> Array:
        """Map (..., I) to (..., width) by weights (K,) of the task, or (..., K) of each sample."""
        num_sets = weights.shape[-1]
        kernels = self.param("kernels", self.init_kernels, (num_sets, x.shape[-1], self.width))
        biases = self.param("biases", nn.initializers.zeros, (num_sets, self.width))
        if weights.ndim == 1:  # composed once for all samples
            return x @ jnp.tensordot(weights, kernels, axes=1) + weights @ biases
        # A kernel for each sample would not fit in memory; x sum_k w_k W_k is one product with all w_k x concatenated.
        weighed = weights[..., :, None] * x[..., None, :]
        return jnp.einsum("...ki,kio->...o", weighed, kernels) + weights @ biases


class ComposedTrunk(nn.Module):
    """Applies an MLP of composed layers; layer normalisation, if any, has one scale and shift for all tasks."""

    widths: tuple[int, ...]
    layer_norm: bool
    init_kernels: Callable[..., Any] = _lecun

    @nn.compact
    def __call__(self, x: Array, weights: Array) -> Array:
        for width in self.widths:
            x = Composed(width, self.init_kernels)(x, weights)
            x = ReLU()(nn.LayerNorm()(x) if self.layer_norm else x)
        return x


class PaCoTrunk(nn.Module):
    """Applies composed layers by weights that an MLP computes from the task's features."""

    num_sets: int
    hidden: tuple[int, ...]
    layer_norm: bool
    weight_widths: tuple[int, ...] = ()

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        level = self.num_sets**-0.5  # squares of weights add up to between 1 and 2: kernels of LeCun's size
        weights = TaskWeights(self.num_sets, self.weight_widths, level, name="weights")(features)
        return ComposedTrunk(self.hidden, self.layer_norm, name="trunk")(jnp.concatenate([obs, *action], -1), weights)


@dataclasses.dataclass(frozen=True)
class PaCo(Identity):
    """PaCo composes parameters: theta_task = sum_k w_k(task) Phi_k (Sun, Zhang, Xu and Tomizuka 2022).

    Kernels and biases of all hidden layers are such sums, of sets Phi that all tasks share; the task has no other
    influence. A small MLP computes the weights w from the task's features, so that unseen tasks get weights of their
    own.

    Differs from the paper: there every task has a free vector w, as here with conditioning=one-hot and
    ``weight_widths=()``. Weights that are linear in few features would not be free: for tasks along one parameter they
    would lie on a line, and two sets would make all policies. The output layer is the network's head, and is not
    composed (heads=per-task gives each task its own); scales and shifts of layer normalisation are shared; a task whose
    loss explodes is neither masked out nor given new weights.
    """

    needs_features: ClassVar[bool] = True
    num_sets: int = 5
    """Number of sets of parameters. The paper: 5 for 10 tasks."""
    weight_widths: tuple[int, ...] = (64,)
    """Widths of the hidden layers from the task's features to its weights; without any, weights are linear."""

    def __post_init__(self):
        parts.require_counts(self, "num_sets")
        parts.require_widths(self, "weight_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return PaCoTrunk(self.num_sets, hidden, layer_norm, self.weight_widths)


def _first_alone(key, shape: tuple[int, ...], dtype=jnp.float32) -> Array:
    """Initialise the first of K kernels as usual and the others at zero."""
    return jnp.zeros(shape, dtype).at[:1].set(_lecun(key, (1, *shape[1:]), dtype))


class HyperTrunk(nn.Module):
    """Applies composed layers by a code that an MLP with linear output computes from the task's features."""

    hypernetwork_widths: tuple[int, ...]
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        *inner, size = self.hypernetwork_widths
        code = nn.Dense(size, name="code")(MLP(tuple(inner), name="hypernetwork")(features))
        weights = jnp.concatenate([jnp.ones((*code.shape[:-1], 1)), code], axis=-1)
        trunk = ComposedTrunk(self.hidden, self.layer_norm, _first_alone, name="trunk")
        return trunk(jnp.concatenate([obs, *action], axis=-1), weights)


@dataclasses.dataclass(frozen=True)
class Hypernetwork(Identity):
    """The hypernetwork computes the trunk's parameters from the task's features (Rezaei-Shoshtari et al. 2023).

    All kernels and biases of the hidden layers are theta(z) = Theta_0 + sum_k e_k(z) Theta_k, where the code e (K,) is
    an MLP of the features with linear output: a composition of K + 1 sets by weights (1, e). K is the last of
    ``hypernetwork_widths``. There are about K + 1 times the parameters of the trunk (by default 17 times: 1.2 million
    for a trunk of 2 x 256 units), and acting costs as much as with the trunk alone.

    Theta_0 starts by LeCun's initialisation and the other sets at zero, so that all tasks begin with the same network
    of the usual scale ("Bias-HyperInit", Beck et al. 2022). With usual initialisations of a hypernetwork's output,
    kernels have the wrong scale, and learning may fail.

    Differs from the paper: actor and critics are trained by SAC's losses, and not fitted to solutions that were found
    for each task before; the map from code to parameters is linear, of rank K; the output layer is the network's head,
    the same for all tasks.
    """

    needs_features: ClassVar[bool] = True
    hypernetwork_widths: tuple[int, ...] = (64, 16)
    """Widths of the layers that encode the task's features; the last, without ReLU, is the size of the code."""

    def __post_init__(self):
        parts.require_layers(self, "hypernetwork_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return HyperTrunk(self.hypernetwork_widths, hidden, layer_norm)
