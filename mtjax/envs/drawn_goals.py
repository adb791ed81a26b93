"""Families of one training task whose episodes draw their goals, so that worlds can go on with another one."""

import dataclasses
from functools import cached_property
from typing import Annotated, Any, ClassVar

import tyro

from mtjax.envs.variation import Variation
from mtjax.names import nearest_error

_REWARDS = ("dense", "sparse")


@dataclasses.dataclass(frozen=True)
class DrawnGoals:
    """What such a family has. Derive from this first: ``class Mine(DrawnGoals, Pictured, Family)``."""

    context_ranges: Annotated[Any, tyro.conf.Suppress] = ()
    reward_kind: str = "dense"
    """dense: rewards show the way; or sparse: only where all is where it should be."""

    relabels: ClassVar[tuple[str, ...]] = ("goal",)

    def __post_init__(self):
        super().__post_init__()  # type: ignore
        if self.reward_kind not in _REWARDS:
            raise nearest_error("reward-kind", self.reward_kind, _REWARDS)

    @cached_property
    def variation(self) -> Variation:
        """Return the values of the only training task, and as its draws those of all that are listed."""
        listed: Variation = super().variation  # type: ignore
        rows = listed.rows["train"]
        draws = rows if listed.draws is None else listed.draws.reshape(-1, len(listed.names))
        return dataclasses.replace(listed, rows={**listed.rows, "train": rows[:1]}, draws=draws[None])
