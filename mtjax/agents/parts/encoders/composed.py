"""Trunks whose parameters are made for each task: weighted sums of K sets of parameters."""

import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar

import flax.linen as nn
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts.encoders.base import Identity
from mtjax.agents.parts.encoders.mixture import TaskWeights
from mtjax.networks import MLP, ReLU
from mtjax.types import Array, InputError

_lecun = nn.initializers.lecun_normal(batch_axis=0)


class Composed(nn.Module):
    """A dense layer of which kernel and bias are sums of K kernels and biases by weights w."""

    width: int
    init_kernels: Callable[..., Any] = _lecun

    @nn.compact
    def __call__(self, x: Array, weights: Array) -> Array:
        """Map (..., I) to (..., width) by a task's weights (K,), or by weights (..., K) of every sample."""
        num_sets = weights.shape[-1]
        kernels = self.param("kernels", self.init_kernels, (num_sets, x.shape[-1], self.width))
        biases = self.param("biases", nn.initializers.zeros, (num_sets, self.width))
        if weights.ndim == 1:  # composed once for all samples
            return x @ jnp.tensordot(weights, kernels, axes=1) + weights @ biases
        # Kernels of every sample would not fit in memory; x sum_k w_k W_k is one product on all w_k x side by side.
        weighed = weights[..., :, None] * x[..., None, :]
        return jnp.einsum("...ki,kio->...o", weighed, kernels) + weights @ biases


class ComposedTrunk(nn.Module):
    """An MLP of composed layers; layer normalisation, if any, has one scale and shift for all tasks."""

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
    """Composed layers by weights that an MLP makes of the task's features."""

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
    """Parameter composition (Sun, Zhang, Xu and Tomizuka 2022): theta_task = sum_k w_k(task) Phi_k.

    Every hidden layer's kernel and bias are such sums, of sets Phi that all tasks share; the task enters in no other
    way. A small MLP makes the weights w of the task's features, so that tasks that were not trained on get a policy of
    their own from the sets.

    Differs from the paper: there every task has a vector w of its own, which ``weight_widths=()`` is for
    conditioning=one-hot. Linear in few parameters, weights would not be free: of tasks along one parameter they would
    be a line, and two sets would make all policies, however many there are. The output layer is the network's head,
    composed for no task (heads=per-task gives each its own); scales and shifts of layer normalisation are shared; a
    task whose loss explodes is neither masked out nor given new weights from those of solved tasks.
    """

    needs_features: ClassVar[bool] = True
    num_sets: int = 5
    """Sets of parameters. The paper: 5 for 10 tasks."""
    weight_widths: tuple[int, ...] = (64,)
    """Widths of the hidden layers between the task's features and its weights; none makes these linear."""

    def __post_init__(self):
        parts.require_counts(self, "num_sets")
        parts.require_widths(self, "weight_widths")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return PaCoTrunk(self.num_sets, hidden, layer_norm, self.weight_widths)


def _first_alone(key, shape: tuple[int, ...], dtype=jnp.float32) -> Array:
    """Initialise the first of K kernels as usual and the others at zero."""
    return jnp.zeros(shape, dtype).at[:1].set(_lecun(key, (1, *shape[1:]), dtype))


class HyperTrunk(nn.Module):
    """Composed layers by a code of the task's features, which an MLP with linear output makes."""

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
    """A network that writes the trunk's parameters from the task's features (Rezaei-Shoshtari et al. 2023).

    All kernels and biases of the hidden layers are theta(z) = Theta_0 + sum_k e_k(z) Theta_k, where the code e (K,) is
    an MLP of the features with linear output: a composition of K + 1 sets by weights (1, e). With K the last of
    ``hypernetwork_widths``, it has about K + 1 times the parameters of the trunk that it writes (17 times by default:
    1.2 million for a trunk of 2 x 256 units), and acts at the trunk's cost.

    Theta_0 starts by LeCun's initialisation and the other sets at zero, so that every task begins with the same usual
    network ("Bias-HyperInit", Beck et al. 2022). Usual initialisations of a hypernetwork's output make kernels of the
    wrong size, with which learning may fail.

    Differs from the paper: actor and critics are trained by SAC's losses from experience, and not fitted to solutions
    that were found for each task before; the map from code to parameters is linear, of rank K; the output layer is the
    network's head, the same for all tasks.
    """

    needs_features: ClassVar[bool] = True
    hypernetwork_widths: tuple[int, ...] = (64, 16)
    """Widths of the layers that encode the task's features; the last is the size of the code, without relu."""

    def __post_init__(self):
        if not self.hypernetwork_widths or min(self.hypernetwork_widths) < 1:
            raise InputError(f"hypernetwork-widths needs a layer of at least one unit, not {self.hypernetwork_widths}")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return HyperTrunk(self.hypernetwork_widths, hidden, layer_norm)
