"""Soft modularization routes every task through layers of modules."""

import dataclasses
from typing import ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents.networks import MLP, ReLU
from mtjax.agents.parts.encoders.base import Identity
from mtjax.types import Array, InputError


class Modules(nn.Module):
    """Applies a layer of M modules, as one batched product, and mixes the outputs for the next layer."""

    width: int
    official: bool
    layer_norm: bool

    @nn.compact
    def __call__(self, x: Array, weights: Array) -> Array:
        """Map inputs (..., M, I) of the modules, or one (..., I) for all, by weights (..., R, M) to (..., R, D)."""
        num_modules, init = weights.shape[-1], nn.initializers.lecun_normal(batch_axis=0)
        kernel = self.param("kernel", init, (num_modules, x.shape[-1], self.width))
        bias = self.param("bias", nn.initializers.zeros, (num_modules, self.width))
        x = jnp.einsum("...mi,mid->...md" if x.ndim == weights.ndim else "...i,mid->...md", x, kernel) + bias
        norm = nn.LayerNorm(feature_axes=(-2, -1)) if self.layer_norm else lambda x: x  # a scale for each module
        mix = lambda x: jnp.einsum("...rm,...md->...rd", weights, x)
        return ReLU()(norm(mix(x))) if self.official else mix(ReLU()(norm(x)))


class Routing(nn.Module):
    """Maps f(s) h(z) (..., F) to every layer's weights (..., R, M) of M modules for R receivers; rows sum to one."""

    num_layers: int
    num_modules: int
    official: bool
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, joint: Array) -> list[Array]:
        for i, width in enumerate(self.widths if self.official else ()):
            joint = nn.Dense(width, name=f"embed_{i}")(ReLU()(joint))
        receivers = (self.num_modules,) * (self.num_layers - 1) + (1,) * self.official
        found, seen, gate = [], [], joint
        for i, count in enumerate(receivers):
            if i:
                previous = jnp.concatenate(seen, axis=-1) if self.official else seen[-1]
                gate = nn.Dense(joint.shape[-1], name=f"up_{i}")(previous) * joint
            scores = nn.Dense(count * self.num_modules, name=f"down_{i}")(ReLU()(gate))
            weights = jax.nn.softmax(scores.reshape(*scores.shape[:-1], count, self.num_modules), axis=-1)
            self.sow("intermediates", "weights", weights)
            found.append(weights)
            seen.append(weights.reshape(scores.shape) if self.official else scores)
        return found


class SoftTrunk(nn.Module):
    """Applies layers of modules, weighed by a routing network, to an encoding of the observation."""

    num_layers: int
    num_modules: int
    module_width: int
    official: bool
    routing_widths: tuple[int, ...]
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        *inner, size = self.hidden
        inputs = MLP(tuple(inner), self.layer_norm, name="base")(jnp.concatenate([obs, *action], axis=-1))
        x = nn.Dense(size, name="base_out")(inputs)  # f(s)
        task = nn.Dense(size, name="task")(features)  # h(z): (F,) where features are a task's, once for all samples
        routing = Routing(self.num_layers, self.num_modules, self.official, self.routing_widths, name="routing")
        every_weights = routing(x * task)
        x = ReLU()(x) if self.official else x
        for i, weights in enumerate(every_weights):
            x = Modules(self.module_width, self.official, self.layer_norm, name=f"modules_{i}")(x, weights)
        return x.reshape(*x.shape[:-2], -1)


@dataclasses.dataclass(frozen=True)
class SoftModules(Identity):
    """SoftModules routes every task softly through layers of modules (Yang, Xu, Wu and Wang 2020).

    L layers of M modules W_j^l are applied to an encoding f(s) of the observation and, in a critic, the action. Module
    i of a layer takes a mixture of the previous layer's modules j. A routing network computes the weights from the
    state and the task's features z:
        p^1 = W_d^1 relu(f(s) h(z)),   p^(l+1) = W_d^(l+1) relu((W_u^l p^l) f(s) h(z))
        phat_i = softmax_j p_ij
        g_i^(l+1) = sum_j phat_ij^l relu(W_j^l g_j^l),   g_j^1 = f(s)
        output = sum_j W_j^L g_j^L
    The last layer's modules are one linear layer on all g_j^L concatenated: the network's head. So num_layers counts
    the head, and num_layers - 1 layers of modules are below it. f is an MLP of the widths ``hidden``, and h is linear.

    ``variant="official"`` computes what the authors' code does: MLP layers embed f(s) h(z) for the routing alone; relu
    is applied to f(s) before the modules; every p depends on all weights before it, and not only on the last scores;
    relu follows each mixture instead of each module; the L-th layer has modules too, and a last p mixes them for the
    head.

    Differs from the paper: all weights start by LeCun's initialisation; layer normalisation, if any, precedes relu in f
    and in the modules. The paper also weighs the tasks' losses by their temperatures: see sampler=temperature.
    """

    needs_features: ClassVar[bool] = True
    num_layers: int = 2
    """Number of layers of modules, with the head, as in the paper. The paper: 2 x 2 of 256 and 4 x 4 of 128."""
    num_modules: int = 2
    """Number of modules in a layer."""
    module_width: int = 256
    """Width of a module's output."""
    variant: Literal["paper", "official"] = "paper"
    """Use the paper's equations, or those of the authors' code."""
    routing_widths: tuple[int, ...] = (256, 256)
    """Widths of the layers that embed the routing's input in the official variant."""

    def __post_init__(self):
        if self.num_layers < 2:
            raise InputError(f"num-layers must be at least 2, as weights lie between layers, not {self.num_layers}")
        if min(self.num_modules, self.module_width, *self.routing_widths) < 1:
            raise InputError("soft-modules needs at least one module, and layers of at least one unit")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        shape = (self.num_layers, self.num_modules, self.module_width)
        return SoftTrunk(*shape, self.variant == "official", self.routing_widths, hidden, layer_norm)
