"""Ways to keep an agent able to learn, for actors and critics that are plain MLPs which all tasks share.

Some renew single hidden units after updates. What they remember of units is the network "plasticity", which no fit
names. One changes all weights where a task of a sequence ends. ``plasticity`` has their equations.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import jax.numpy as jnp

from mtjax.agents import parts
from mtjax.agents.parts import plasticity
from mtjax.agents.parts.plasticity import Layer, Units
from mtjax.types import Array

NET = "plasticity"
"""The network that holds what is remembered of units."""


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
    """Begins dormant units anew at times (Sokar et al. 2023)."""

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
        return memory, *plasticity.redo(layer, hidden, fresh, self.dormant_threshold)


@dataclasses.dataclass(frozen=True)
class ContinualBackprop(Nothing):
    """Begins the least useful unit of a layer anew, slowly and all the time (Dohare et al. 2024).

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
        return [plasticity.new_units(width) for width in widths]

    def renew(self, memory: Units, layer: Layer, hidden: Array, fresh: Array) -> tuple[Any, Layer, Array]:
        settings = {"rate": self.replacement_rate, "maturity": self.maturity, "decay": self.utility_decay}
        return plasticity.continual_backprop(memory, layer, hidden, fresh, **settings)


@dataclasses.dataclass(frozen=True)
class ShrinkAndPerturb(Nothing):
    """Shrinks all shared weights towards freshly drawn ones where a task ends (Ash and Adams 2020)."""

    changes: ClassVar[bool] = True
    shrink: float = 0.5
    """Factor of the old weights (lambda)."""
    perturb: float = 0.5
    """Factor of the fresh weights, which are drawn as the first ones were."""

    def __post_init__(self):
        parts.require_shares(self, "shrink", "perturb")

    def change(self, params: Any, fresh: Any) -> Any:
        return plasticity.shrink_and_perturb(params, fresh, self.shrink, self.perturb)


Renewing = Nothing
PLASTICITY: dict[str, type[Renewing]] = {
    "none": Nothing,
    "redo": ReDo,
    "continual-backprop": ContinualBackprop,
    "shrink-and-perturb": ShrinkAndPerturb,
}
