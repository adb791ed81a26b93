"""Mixtures of experts encode the observation several times, and weigh the encodings by the task."""

import dataclasses
from typing import ClassVar, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.agents.networks import MLP, ReLU, join
from mtjax.agents.parts.encoders.base import Identity
from mtjax.agents.parts.knowing import Knowing
from mtjax.types import Array, InputError

_BY_NUMBER = ("identity", "cluster")


class Experts(nn.Module):
    """Applies K MLPs of the same shape, with linear outputs, as batched products."""

    num_experts: int
    widths: tuple[int, ...]
    layer_norm: bool = False  # before each ReLU

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Map inputs (..., O) to outputs (K, ..., D)."""
        init = nn.initializers.lecun_normal(batch_axis=0)
        for i, width in enumerate(self.widths):
            kernel = self.param(f"kernel_{i}", init, (self.num_experts, x.shape[-1], width))
            bias = self.param(f"bias_{i}", nn.initializers.zeros, (self.num_experts, width))
            inputs = 0 if i else None  # all experts read the same input, so the first layer is a single product
            x = jax.vmap(lambda x, kernel, bias: x @ kernel + bias, (inputs, 0, 0))(x, kernel, bias)
            if i + 1 < len(self.widths):
                x = nn.LayerNorm(feature_axes=(0, -1), name=f"norm_{i}")(x) if self.layer_norm else x
                x = ReLU()(x)
        return x


def mix(weights: Array, encodings: Array) -> Array:
    """Sum encodings (K, ..., D) by weights (..., K), or (K,) for every sample, to (..., D)."""
    # Without a barrier XLA 0.11 makes a Triton kernel that is wrong for every second task: benchmarks/triton_fusion.py
    weights, encodings = jax.lax.optimization_barrier((weights, encodings))
    weights = jnp.moveaxis(weights, -1, 0)
    # Not a matrix product: for few terms, a sum that fuses with the operations before it is faster on a GPU.
    return jnp.sum(weights.reshape(*weights.shape, *[1] * (encodings.ndim - weights.ndim)) * encodings, axis=0)


def top_k_softmax(scores: Array, k: int) -> Array:
    """Return the softmax of the k highest scores (..., K); the other weights (..., K) are 0."""
    highest, chosen = jax.lax.top_k(scores, k)
    return jnp.einsum("...j,...jk->...k", nn.softmax(highest), jax.nn.one_hot(chosen, scores.shape[-1]))


def check_experts(num_experts: int, expert_widths: tuple[int, ...]) -> None:
    """Raise an InputError unless there are experts, of at least one layer each."""
    if num_experts < 1 or not expert_widths or min(expert_widths) < 1:
        raise InputError(
            "there must be at least one expert with at least one layer of at least one unit, "
            f"not num-experts={num_experts} and expert-widths={expert_widths}"
        )


class Gate(nn.Module):
    """Maps task features to scores (..., K) of the experts by an MLP."""

    num_experts: int
    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, features: Array) -> Array:
        return nn.Dense(self.num_experts, name="scores")(MLP(self.widths)(features))


def _either_way(key, shape: tuple[int, ...], dtype=jnp.float32) -> Array:
    return jax.random.uniform(key, shape, dtype, -1.0, 1.0)


class TaskWeights(nn.Module):
    """Maps task features to weights (..., K) of any sign by an MLP; without hidden layers it is linear.

    Initial weights are about ``level``: their mean square is one to two times its square, for features of length 0 to
    1. Hidden units become active at points spread over the training range, so that tasks along a line have weights that
    do not lie on one.
    """

    num: int
    widths: tuple[int, ...]
    level: float = 1.0

    @nn.compact
    def __call__(self, features: Array) -> Array:
        for width in self.widths:
            features = nn.Dense(width, kernel_init=nn.initializers.he_normal(), bias_init=_either_way)(features)
            features = ReLU()(features)
        slope, level = nn.initializers.variance_scaling(self.level**2, "fan_in", "normal"), self.level
        return nn.Dense(self.num, kernel_init=slope, bias_init=nn.initializers.constant(level), name="out")(features)


class MixtureTrunk(nn.Module):
    """Encodes observations by a mixture of experts, and applies an MLP to the encoding, features and action."""

    spec: "MoE"
    hidden: tuple[int, ...]
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        spec = self.spec
        encodings = Experts(spec.num_experts, spec.expert_widths, name="experts")(obs)  # (K, ..., D)
        match spec.mode:
            case "ensemble":
                weights = jnp.full(spec.num_experts, 1 / spec.num_experts)
            case "identity" | "cluster":
                weights = features @ jax.nn.one_hot(jnp.array(spec.expert_of_task), spec.num_experts)
            case _:
                scores = Gate(spec.num_experts, spec.expert_widths, name="gate")(features)
                weights = nn.softmax(scores) if spec.mode == "attention" else top_k_softmax(scores, spec.top_k)
        encoding = mix(weights, encodings)
        return MLP(self.hidden, self.layer_norm, name="trunk")(join(encoding, *action, task=features))


@dataclasses.dataclass(frozen=True)
class MoE(Identity):
    """Encodes observations by a mixture of experts below the other layers (MTRL's ``moe`` encoder).

    With K encoders E_k of the observation s, and a task with features c and number i,
        z = sum_k w_k E_k(s)
    and actor and critics take [z, c]. The ``mode`` chooses the weights:
        attention   w = softmax(g(c)), with an MLP g
        top-k       the softmax of the k highest scores g(c), and 0 elsewhere (Shazeer et al. 2017, without noise)
        ensemble    w_k = 1 / K
        cluster     the one expert that ``clusters`` gives for task i
        identity    expert i

    Differs from MTRL: experts that a task does not choose have weight 0, and no weight is divided by a count; MTRL's
    keyword clusters divide by 0 for tasks without experts. Under top-k, gradients flow through the weights that are
    kept; MTRL detaches the gate, so that it never learns. top-k=1 is refused, as a single weight is always 1 and gives
    the gate no gradient. No loss balances the experts, so one that no task keeps does not learn. All experts are
    evaluated for every task, in one product.
    """

    needs_features: ClassVar[bool] = True
    num_experts: int = 4
    """Number of encoders in the mixture."""
    expert_widths: tuple[int, ...] = (64, 64)
    """Widths of the layers in each encoder and in the gate; the last is the size of the encoding."""
    mode: Literal["attention", "top-k", "ensemble", "cluster", "identity"] = "attention"
    """Weights of the experts: of a soft gate (attention), of the gate's highest scores (top-k), all equal (ensemble),
    one expert by a table (cluster), or one for each task (identity)."""
    top_k: int = 2
    """Number of experts that a task uses with mode=top-k."""
    clusters: tuple[int, ...] = ()
    """The expert of every training task, numbered from 0, for mode=cluster."""

    def __post_init__(self):
        check_experts(self.num_experts, self.expert_widths)
        if self.mode == "top-k" and not 2 <= self.top_k <= self.num_experts:
            raise InputError(f"top-k must be from 2 to num-experts={self.num_experts}, not {self.top_k}")
        if (self.mode == "cluster") != bool(self.clusters):
            raise InputError("mode=cluster and clusters=TABLE go together; give both or neither")
        if self.clusters and set(self.clusters) != set(range(self.num_experts)):
            last = self.num_experts - 1
            raise InputError(f"clusters must use every expert from 0 to {last} and no other, not {self.clusters}")

    def refuses(self, conditioning: Knowing, otherwise: bool) -> str:
        if self.mode in _BY_NUMBER and not conditioning.by_number:
            return f"picks experts by the task's number under mode={self.mode}; use conditioning=one-hot"
        return "" if self.mode == "ensemble" else super().refuses(conditioning, otherwise)

    @property
    def expert_of_task(self) -> tuple[int, ...]:
        """The expert of every training task, where its number picks one."""
        return self.clusters or tuple(range(self.num_experts))

    def require(self, num_tasks: int) -> None:
        if self.mode in _BY_NUMBER and len(self.expert_of_task) != num_tasks:
            given = f"clusters={self.clusters}" if self.clusters else f"num-experts={self.num_experts}"
            fits = f"fits {len(self.expert_of_task)} training tasks, but there are {num_tasks}"
            raise InputError(f"mode={self.mode} with {given} {fits}")

    def body(self, hidden: tuple[int, ...], layer_norm: bool) -> nn.Module:
        return MixtureTrunk(self, hidden, layer_norm)
