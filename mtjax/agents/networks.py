"""Networks are pure functions of parameters, which are divided into shared ones and each task's own.

A network is a body and a linear head. It is applied to the data of one task; the caller maps over tasks.
"""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from mtjax.types import Array, Key


class Params(NamedTuple):
    """Holds the parameters of a network, divided by which tasks use them."""

    shared: Any  # used by every task
    own: Any  # leaves (T, ...): used by one task each, such as heads or embeddings

    @property
    def parts(self) -> dict[str, Any]:
        """The named parts of one task's network, whether shared or its own."""
        return {**self.shared, **self.own}

    def filled(self, others: "Params") -> "Params":
        """Return these parts, and those of ``others`` that are missing here."""
        return Params({**others.shared, **self.shared}, {**others.own, **self.own})

    def of_first(self) -> "Params":
        """Return the parameters that the first task uses."""
        return Params(self.shared, jax.tree.map(lambda x: x[0], self.own))

    def without(self, names: Collection[str]) -> "Params":
        """Return all parts but those with the given names."""
        keep = lambda parts: {name: part for name, part in parts.items() if name not in names}
        return Params(keep(self.shared), keep(self.own))


STATISTICS = "batch_stats"
"""What a body with batch normalisation remembers of the batches that it has seen, by flax's name."""

OVER_TASKS = Params(shared=None, own=0)
"""Axes of ``Params`` for ``jax.vmap`` over tasks."""


def orthogonal(scale: float = 1.0) -> Callable[..., Array]:
    """Return an initialiser of orthogonal kernels, times ``scale``, which under ``vmap`` draws one after another.

    JAX's QR decomposition of a batch waits for threads of the pool that it runs in. Two such batches at once, as of two
    layers or of a GRU's gates, wait for ever on two CPU cores (seen with jax 0.10.2).
    """
    initializer = nn.initializers.orthogonal(scale)

    def init(key: Key, shape: Any, dtype: Any = jnp.float32) -> Array:
        @jax.custom_batching.custom_vmap
        def draw(key: Key) -> Array:
            return initializer(key, shape, dtype)

        @draw.def_vmap
        def _(count: int, mapped: Any, keys: Key) -> tuple[Array, bool]:
            return jax.lax.map(draw, keys), True

        return draw(key)

    return init


class ReLU(nn.Module):
    """Computes max(x, 0) as a module, so that diagnostics can read the activity of a layer's units."""

    def __call__(self, x: Array) -> Array:
        return nn.relu(x)


class MLP(nn.Module):
    """Applies dense layers with ReLU, and optionally layer normalisation before it."""

    widths: tuple[int, ...]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: Array) -> Array:
        for width in self.widths:
            x = nn.Dense(width)(x)
            x = ReLU()(nn.LayerNorm()(x) if self.layer_norm else x)
        return x


class Trunk(nn.Module):
    """Applies an MLP to the observation, task features and, in a critic, the action."""

    widths: tuple[int, ...]
    layer_norm: bool = False

    @nn.compact
    def __call__(self, obs: Array, features: Array, *action: Array) -> Array:
        return MLP(self.widths, self.layer_norm)(join(obs, *action, task=features))


def join(*inputs: Array, task: Array) -> Array:
    """Concatenate inputs (..., x) of samples and task features: (..., Z), or (Z,) for all samples."""
    task = jnp.broadcast_to(task, (*inputs[0].shape[:-1], task.shape[-1]))
    return jnp.concatenate([*inputs, task], axis=-1)


N = TypeVar("N", bound="Network")


@dataclasses.dataclass(frozen=True)
class Network:
    """Applies a body and a linear head; each is shared by all tasks, or every task has its own."""

    body: nn.Module
    own: tuple[str, ...] = ()  # those of "sight", "body" and "head" that every task has for itself
    front: nn.Module | None = None  # maps observations before the body; every task's own
    unit_head: bool = False  # keep the head's weights of each output at length 1
    sight: nn.Module | None = None  # maps observations with pictures to vectors, before the body

    def as_kind(self, kind: "type[N]", **changes: Any) -> "N":
        """Return a network of another class with the settings of this one, but for ``changes``."""
        given = {field.name: getattr(self, field.name) for field in dataclasses.fields(Network)}
        return kind(**given | changes)

    def init(self, key: Key, num_tasks: int, out: int, features: Array, *inputs: Array) -> Params:
        """Initialise parameters for ``num_tasks`` tasks, ``out`` outputs, and inputs of the given shapes."""
        body_key, head_key, _, front_key = jax.random.split(key, 4)
        params, parts, init = Params({}, {}), {}, partial(self._init_part, num_tasks)
        if self.sight is not None and isinstance(inputs[0], Mapping):
            parts["sight"] = init("sight", self.sight.init, jax.random.fold_in(key, 5), inputs[0])
            inputs = (self.sight.init_with_output(key, inputs[0])[0], *inputs[1:])  # type: ignore
        if self.front is not None:
            params.own["front"] = self.for_each_task(self.front.init, front_key, num_tasks, inputs[0])
            first = jax.tree.map(lambda x: x[0], params.own["front"])
            inputs = (jnp.asarray(self.front.apply(first, inputs[0])), *inputs[1:])
        data = (inputs[0], features, *inputs[1:])
        hidden, parts["body"] = init("body", self.body.init_with_output, body_key, *data)
        parts["head"] = init("head", lambda key: self._init_head(key, hidden.shape[-1], out), head_key)
        for name, part in parts.items():
            (params.own if name in self.own else params.shared)[name] = part
        if STATISTICS in params.parts["body"]:
            self._give_statistics(params, num_tasks)
        return params

    def _give_statistics(self, params: Params, num_tasks: int) -> None:
        """Move the statistics of a new body to what every task has for itself."""
        if "body" in self.own:
            params.own[STATISTICS] = params.own["body"].pop(STATISTICS)
        else:
            each = lambda x: jnp.repeat(x[None], num_tasks, axis=0)
            params.own[STATISTICS] = jax.tree.map(each, params.shared["body"].pop(STATISTICS))

    def _init_part(self, num_tasks: int, name: str, init, key: Key, *arguments: Any):
        """Initialise a part for all tasks, or separately for every one if it is its own."""
        return self.for_each_task(init, key, num_tasks, *arguments) if name in self.own else init(key, *arguments)

    @staticmethod
    def for_each_task(init, key: Key, num_tasks: int, *arguments: Any):
        """Initialise a part separately for every task, leaves (T, ...)."""
        return jax.vmap(lambda k: init(k, *arguments))(jax.random.split(key, num_tasks))

    def apply(self, params: Params, features: Array, *inputs: Array) -> Array:
        """Map one task's inputs (..., O), (..., A) to outputs (..., out); ``params.own`` is that task's, without T."""
        return self._head(params, self.hidden(params, features, *inputs))

    def fit(self, params: Params, features: Array, *inputs: Array) -> tuple[Array, Any]:
        """Apply to a batch by its own statistics.

        Returns:
            outputs (..., out), and the task's new running statistics by their name among its own parameters: an empty
            table for bodies without batch normalisation.
        """
        hidden, found = self._body(params, features, *inputs, mutable=STATISTICS)
        return self._head(params, hidden), found

    def hidden(self, params: Params, features: Array, *inputs: Array) -> Array:
        """Return the hidden layer (..., width) below the head."""
        return self._body(params, features, *inputs, mutable=False)

    def _body(self, params: Params, features: Array, *inputs: Array, mutable: Any) -> Any:
        parts, obs = params.parts, inputs[0]
        for name, module in (("sight", self.sight), ("front", self.front)):
            obs = module.apply(parts[name], obs) if module is not None and name in parts else obs
        variables = parts["body"] | {name: parts[name] for name in (STATISTICS,) if name in parts}
        return self.body.apply(variables, obs, features, *inputs[1:], mutable=mutable)

    def _head(self, params: Params, hidden: Array) -> Array:
        head = params.parts["head"]
        return hidden @ head[self._head_weights] + head["bias"]

    @property
    def _head_weights(self) -> str:
        return "direction" if self.unit_head else "kernel"

    def _init_head(self, key: Key, width: int, out: int) -> dict[str, Array]:
        init = init_direction if self.unit_head else nn.initializers.lecun_normal()
        return {self._head_weights: init(key, (width, out)), "bias": jnp.zeros(out)}


def init_params(init: Callable[[Key], dict[str, Any]], own: bool, key: Key, num_tasks: int) -> Params:
    """Return the parts, by name, that ``init`` draws: once for all tasks, or each task's own, leaves (T, ...)."""
    return Params({}, Network.for_each_task(init, key, num_tasks)) if own else Params(init(key), {})


# Vectors of length 1, and layers whose weights are such vectors.


def to_unit(x: Array, axis: int = -1, floor: float = 1e-30) -> Array:
    """Scale vectors along an axis to length 1.

    The gradient is finite at zero too. Vectors whose squared length is not far above the ``floor`` stay shorter.
    """
    return x * jax.lax.rsqrt(jnp.sum(jnp.square(x), axis=axis, keepdims=True) + floor)


def init_direction(key: Key, shape: tuple[int, int]) -> Array:
    """Draw weights (inputs, outputs) with a vector of length 1 and of random direction for each output."""
    return to_unit(nn.initializers.lecun_normal()(key, shape), axis=-2)


class UnitDense(nn.Module):
    """Applies a linear layer without bias, in which the weights of each output are a vector of length 1.

    Optimisers keep that length of every leaf called ``direction`` (``descent.on_sphere``).
    """

    width: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        return x @ self.param("direction", init_direction, (x.shape[-1], self.width))
