"""What keeps a network able to learn: old weights shrink, and units that do little begin anew.

All are pure functions of one hidden layer of H units with their weights: ``Layer`` holds those into the units and those
out of them. A unit that begins anew has weights out of it of 0, so that it changes no output at first if it was idle.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.types import Array


def shrink_and_perturb(params: Any, fresh: Any, shrink: float | Array, perturb: float | Array) -> Any:
    """Return shrink theta + perturb phi, for parameters theta and freshly drawn ones phi (Ash and Adams 2020)."""
    return jax.tree.map(lambda x, y: shrink * x + perturb * y, params, fresh)


class Layer(NamedTuple):
    """Holds the weights around H hidden units, or as many values of an optimiser."""

    into: Array  # (I, H)
    bias: Array  # (H,)
    out: Array  # (H, K)


def renew(layer: Layer, fresh: Array, units: Array) -> Layer:
    """Begin some units anew: weights into them are those of ``fresh`` (I, H), bias and weights out of them 0.

    Args:
        units: (H,) bool.
    """
    return Layer(
        jnp.where(units, fresh, layer.into),
        jnp.where(units, 0.0, layer.bias),
        jnp.where(units[:, None], 0.0, layer.out),
    )


def forget(moments: Layer, units: Array) -> Layer:
    """Return an optimiser's moments of a layer, 0 for the weights around ``units`` (H,) that begin anew."""
    return renew(moments, jnp.zeros_like(moments.into), units)


# ReDo (Sokar et al. 2023).


def activity(hidden: Array) -> Array:
    """Return the scores (H,) of units from what they put out for some inputs (N, H):

    s_i = mean_x |h_i(x)| / (1 / H sum_k mean_x |h_k(x)|)

    All are 0 if no unit puts anything out.
    """
    size = jnp.mean(jnp.abs(hidden), axis=0)
    mean = jnp.mean(size)
    return jnp.where(mean > 0, size / jnp.where(mean > 0, mean, 1.0), 0.0)


def redo(layer: Layer, hidden: Array, fresh: Array, threshold: float | Array) -> tuple[Layer, Array]:
    """Begin dormant units anew: those with s_i <= threshold for the outputs (N, H) of the layer.

    Returns:
        the layer, and which units (H,) were dormant.
    """
    dormant = activity(hidden) <= threshold
    return renew(layer, fresh, dormant), dormant


# Continual backpropagation (Dohare et al. 2024).


class Units(NamedTuple):
    """Holds what continual backpropagation remembers of H units."""

    utility: Array  # (H,)
    age: Array  # (H,) int32, steps since a unit began
    due: Array  # () units that should have begun anew by now, less those that have


def new_units(count: int) -> Units:
    """Return the memory of units that have just begun."""
    return Units(jnp.zeros(count), jnp.zeros(count, jnp.int32), jnp.float32(0))


def continual_backprop(
    units: Units,
    layer: Layer,
    hidden: Array,
    fresh: Array,
    *,
    rate: float | Array = 1e-4,
    maturity: int | Array = 10_000,
    decay: float | Array = 0.99,
) -> tuple[Units, Layer, Array]:
    """Begin the least useful of mature units anew, slowly, after a step of learning:

        u_i <- decay u_i + (1 - decay) mean_x |h_i(x)| sum_k |w_ik|

    ``rate`` times the number of units older than ``maturity`` adds up; whenever that reaches 1, one unit begins anew.

    Args:
        hidden: (N, H) what units put out.

    Returns:
        the memory, the layer, and which units (H,), at most one, begin anew.
    """
    contribution = jnp.mean(jnp.abs(hidden), axis=0) * jnp.sum(jnp.abs(layer.out), axis=1)
    utility, age = decay * units.utility + (1 - decay) * contribution, units.age + 1
    mature = age > maturity
    due = units.due + rate * jnp.sum(mature)
    least = jnp.argmin(jnp.where(mature, utility, jnp.inf))
    chosen = (jnp.arange(len(age)) == least) & mature & (due >= 1)
    memory = Units(jnp.where(chosen, 0.0, utility), jnp.where(chosen, 0, age), due - jnp.any(chosen))
    return memory, renew(layer, fresh, chosen), chosen
