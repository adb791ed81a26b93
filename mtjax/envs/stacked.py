"""Environments whose observations hold the last pictures, for users who keep no memory of their own."""

import dataclasses
from typing import Any, NamedTuple

from mtjax import frames
from mtjax.envs.mixtures import require_family
from mtjax.envs.pixels import Pictured
from mtjax.names import public
from mtjax.parallel import axes
from mtjax.types import Array, InputError, Key, Spec, Step, Task


class Remembered(NamedTuple):
    """The state of a world, and what an agent sees of it: its last pictures."""

    world: Any
    seen: Any


@dataclasses.dataclass(frozen=True)
class Stacked:
    """A family with pictures, each observation of which holds the last ``family.frames``: (H, W, N C), newest last.

    ``reset`` and ``step`` are as the family's. Its state holds the pictures before the newest.
    """

    family: Pictured

    def __post_init__(self):
        require_family(self.family, "pictures are stacked for one family")
        if not getattr(self.family, "pixels", 0):
            raise InputError("there is nothing to stack without pictures; give pixels=64")

    def tasks(self, split: str = "train") -> Task:
        """Return the tasks of a split."""
        return self.family.tasks(split)

    def task_values(self, split: str) -> Any:
        """Return the values (T,) that tell the tasks of a split apart."""
        return self.family.task_values(split)

    @property
    def ends_early(self) -> bool:
        """Return whether episodes may end before their limit."""
        return self.family.ends_early

    @property
    def reset_batches(self) -> int:
        """Return in how many batches all worlds are reset."""
        return self.family.reset_batches

    @property
    def cheap_starts(self) -> bool:
        """Return whether to begin an episode costs a GPU less than to ask whether one ended."""
        return self.family.cheap_starts

    @property
    def finite_horizon(self) -> bool:
        """Return whether how long an episode is, is part of the problem."""
        return self.family.finite_horizon

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        return self.family.episode_length

    @property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context."""
        spec = self.family.spec
        return spec._replace(obs=frames.seen(spec), frames=1)

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a fresh random state."""
        step = self.family.reset(task, key)
        return self._show(step, frames.begin(step.obs, self.family.frames))

    def step(self, task: Task, state: Remembered, action: Array) -> Step:
        """Advance one step under ``action`` (A,)."""
        step = self.family.step(task, state.world, action)
        return self._show(step, frames.push(state.seen, step.obs))

    reset_worlds, step_worlds, renew_worlds = axes.reset_worlds, axes.step_worlds, axes.renew_worlds
    observe_worlds, where_worlds = axes.observe_worlds, staticmethod(axes.where_worlds)

    def _show(self, step: Step, seen: Any) -> Step:
        return step._replace(obs=seen, state=Remembered(step.state, seen))


@public
def stacked(family: Any) -> Any:
    """Return a family whose observations hold its last ``family.frames`` pictures at once.

    Raises:
        InputError: the family shows no pictures.
    """
    return Stacked(family)
