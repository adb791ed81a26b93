"""The axis S of a run: the seeds of all points of a sweep, or the members of a population."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from mtjax.agents import swept
from mtjax.agents.swept import Point
from mtjax.config import RunConfig
from mtjax.learning.loop import TrainState
from mtjax.saved import log
from mtjax.training import selection
from mtjax.training.stops import finite_seeds, require_finite, require_finite_parameters


@dataclasses.dataclass(frozen=True)
class Entries:
    """The entries of the axis S of a run: the seeds of all points of a sweep, or the members of a population."""

    config: RunConfig

    @cached_property
    def axis(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the seeds (S,) of all points, and the swept values (S,) by name."""
        return swept.seed_axis(self.config.points, np.asarray(self.config.plan.all_seeds, np.int32))

    @property
    def seeds(self) -> np.ndarray:
        return self.axis[0]

    @property
    def end_with_one(self) -> bool:
        """Return whether the run ends when one seed diverges, as in neither a sweep nor a population."""
        return not self.config.points and self.config.plan.rule is None

    def point(self, k: int) -> Point:
        """Return the swept values of entry k."""
        config = self.config
        return config.points[k // config.plan.seeds] if config.points else {}

    def numbers(self, state: TrainState) -> list[Point]:
        """Return the values of every entry in rows: those swept, in a population as they are now."""
        if self.config.plan.rule is None:
            return [self.point(k) for k in range(len(self.seeds))]
        now = selection.numbers_of(state)
        return [{name: log.number(x[k]) for name, x in now.items()} for k in range(len(self.seeds))]  # type: ignore

    @property
    def names(self) -> list[str]:
        """Return the names of all entries for TensorBoard and W&B."""
        values = lambda k: [f"{name}={value:g}" for name, value in self.point(k).items()]
        return ["-".join([*values(k), f"seed-{seed}"]) for k, seed in enumerate(self.seeds)]


@dataclasses.dataclass(frozen=True)
class Watch:
    """Gives up the entries whose numbers stop being finite. Of a single point's seeds none is, so that the run ends."""

    entries: Entries
    last: Callable[[], str]  # returns a clause on the run's last checkpoint
    say: Callable[[str], None]

    def after_chunk(self, metrics: dict[str, Any], first_step: int, diverged: np.ndarray) -> np.ndarray:
        """Return which entries (S,) have diverged before a chunk's end, given those before it.

        Raises:
            FloatingPointError: none is left, or none may be given up.
        """
        broken = np.any(metrics["bad_step"] >= 0, axis=1)
        if self.entries.end_with_one or np.all(broken | diverged):
            require_finite(metrics["bad_step"], metrics["bad_reward"], metrics["lost"], first_step, self.last)
        return self._given_up(broken, diverged)

    def before_saving(self, agents: Any, iteration: int, diverged: np.ndarray) -> np.ndarray:
        """Return the same with those that a chunk's last update has spoiled, as none of its losses has seen that.

        Raises:
            FloatingPointError: none is left, or none may be given up. The checkpoint before must stay.
        """
        finite = finite_seeds(agents)
        if self.entries.end_with_one or np.all(~finite | diverged):
            require_finite_parameters(finite, iteration, self.last)
        return self._given_up(~finite, diverged)

    def _given_up(self, broken: np.ndarray, diverged: np.ndarray) -> np.ndarray:
        for k in np.flatnonzero(broken & ~diverged):
            values = ", ".join(f"{name}={value:g}" for name, value in self.entries.point(int(k)).items())
            name = f"number {k}" if self.entries.config.plan.rule else f"seed {self.entries.seeds[k]} of {values}"
            self.say(f"{name} diverged and is given up")
        return diverged | broken
