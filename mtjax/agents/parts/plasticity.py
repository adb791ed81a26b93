"""Ways to keep an agent able to learn, for actors and critics that are plain MLPs which all tasks share.

Some begin single hidden units anew after updates. A unit that begins anew has weights out of it of 0, so that it
changes no output at first if it was idle. What these ways remember of units is the network "plasticity", which no fit
names. One changes all weights where a task of a sequence ends.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.types import Array

NET = "plasticity"
"""The network that holds what is remembered of units."""


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


@dataclasses.dataclass(frozen=True)
class Nothing:
    """Leaves networks to their gradient steps. Every way is a class with these methods."""

    every: ClassVar[int] = 0
    """Updates from one renewal of units to the next; 0 for none."""
    changes: ClassVar[bool] = False
    """Whether all weights change where a task of a sequence ends."""

    def init(self, widths: Sequence[int]) -> list[Any]:
        """Return what is remembered of the hidden layers of one network before the first update."""
        return [{} for _ in widths]

    def renew(self, memory: Any, layer: Layer, hidden: Array, fresh: Array) -> tuple[Any, Layer, Array]:
        """Begin some units of a layer anew, given what they put out (N, H) and new weights into them (I, H).

        Returns:
            what is remembered, the layer, and which units (H,) begin anew.
        """
        return memory, layer, jnp.zeros(hidden.shape[-1], bool)

    def change(self, params: Any, fresh: Any) -> Any:
        """Return all parameters as they are where a task begins, given freshly drawn ones."""
        return params


@dataclasses.dataclass(frozen=True)
class ReDo(Nothing):
    """Begins dormant units anew at times: those whose score is at most tau (Sokar et al. 2023).

    With what units put out for some inputs x, their scores are
        s_i = mean_x |h_i(x)| / (1 / H sum_k mean_x |h_k(x)|)
    All are 0 if no unit puts anything out.
    """

    dormant_threshold: float = 0.1
    """A unit is dormant if its mean activity is at most this share of its layer's mean (tau)."""
    redo_every: int = 1000
    """Updates from one look at the units to the next."""

    def __post_init__(self):
        parts.require_not_negative(self, "dormant_threshold")
        parts.require_counts(self, "redo_every")

    @property
    def every(self) -> int:  # type: ignore[override]
        return self.redo_every

    def renew(self, memory: Any, layer: Layer, hidden: Array, fresh: Array) -> tuple[Any, Layer, Array]:
        dormant = activity(hidden) <= self.dormant_threshold
        return memory, renew(layer, fresh, dormant), dormant


def activity(hidden: Array) -> Array:
    """Return ReDo's scores (H,) of units from what they put out (N, H)."""
    size = jnp.mean(jnp.abs(hidden), axis=0)
    mean = jnp.mean(size)
    return jnp.where(mean > 0, size / jnp.where(mean > 0, mean, 1.0), 0.0)


class Units(NamedTuple):
    """Holds what continual backpropagation remembers of H units."""

    utility: Array  # (H,)
    age: Array  # (H,) int32, steps since a unit began
    due: Array  # () units that should have begun anew by now, less those that have


@dataclasses.dataclass(frozen=True)
class ContinualBackprop(Nothing):
    """Begins the least useful of a layer's mature units anew, slowly and all the time (Dohare et al. 2024).

    After every update, with what units put out for inputs x and the weights w out of them, their utilities are
        u_i <- eta u_i + (1 - eta) mean_x |h_i(x)| sum_k |w_ik|
    Rho times the number of units older than ``maturity`` adds up; whenever that reaches 1, one unit begins anew.

    Differs from the paper: Adam's moments begin anew with a unit, but not its count of steps.
    """

    every: ClassVar[int] = 1
    replacement_rate: float = 1e-4
    """Share of the mature units that begin anew at each update (rho)."""
    maturity: int = 10_000
    """Updates before a new unit may be replaced."""
    utility_decay: float = 0.99
    """How much of a unit's utility lasts from one update to the next (eta)."""

    def __post_init__(self):
        parts.require_shares(self, "replacement_rate", "utility_decay")
        parts.require_not_negative(self, "maturity")

    def init(self, widths: Sequence[int]) -> list[Any]:
        return [Units(jnp.zeros(width), jnp.zeros(width, jnp.int32), jnp.float32(0)) for width in widths]

    def renew(self, memory: Units, layer: Layer, hidden: Array, fresh: Array) -> tuple[Any, Layer, Array]:
        contribution = jnp.mean(jnp.abs(hidden), axis=0) * jnp.sum(jnp.abs(layer.out), axis=1)
        utility = self.utility_decay * memory.utility + (1 - self.utility_decay) * contribution
        age = memory.age + 1
        mature = age > self.maturity
        due = memory.due + self.replacement_rate * jnp.sum(mature)
        least = jnp.argmin(jnp.where(mature, utility, jnp.inf))
        chosen = (jnp.arange(len(age)) == least) & mature & (due >= 1)
        memory = Units(jnp.where(chosen, 0.0, utility), jnp.where(chosen, 0, age), due - jnp.any(chosen))
        return memory, renew(layer, fresh, chosen), chosen


@dataclasses.dataclass(frozen=True)
class ShrinkAndPerturb(Nothing):
    """Shrinks all shared weights towards freshly drawn ones where a task ends (Ash and Adams 2020).

    Weights theta become lambda theta + perturb phi, for freshly drawn ones phi.
    """

    changes: ClassVar[bool] = True
    shrink: float = 0.5
    """Factor of the old weights (lambda)."""
    perturb: float = 0.5
    """Factor of the fresh weights, which are drawn as the first ones were."""

    def __post_init__(self):
        parts.require_shares(self, "shrink", "perturb")

    def change(self, params: Any, fresh: Any) -> Any:
        return jax.tree.map(lambda x, y: self.shrink * x + self.perturb * y, params, fresh)


Plasticity = Nothing
PLASTICITY: dict[str, type[Plasticity]] = {
    "none": Nothing,
    "redo": ReDo,
    "continual-backprop": ContinualBackprop,
    "shrink-and-perturb": ShrinkAndPerturb,
}
