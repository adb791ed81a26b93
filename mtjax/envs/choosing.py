"""What families have whose actions are choices, or that say themselves which actions they take."""

import abc
import dataclasses

import jax.numpy as jnp

from mtjax.types import Action, Array, Continuous


class Acting:
    """What a family has that says by ``action`` which actions it takes. Derive from this and ``Family``."""

    @property
    @abc.abstractmethod
    def action(self) -> Action:
        """Return the kind and the size of actions."""

    @property
    def action_size(self) -> int:
        """Return the size A of actions as the vectors that networks take."""
        return self.action.size

    @property
    def discrete(self) -> bool:
        """Whether actions are numbers of choices."""
        return not isinstance(self.action, Continuous)


@dataclasses.dataclass(frozen=True)
class Choosing:
    """What a family has in which an agent chooses one of ``action_size`` actions. Derive from this and ``Family``."""

    scores: bool = False
    """Take a score in [-1, 1] for each action, in place of the number of an action. The highest score counts, of equal
    ones the first. Agents of continuous actions, such as sac, need it."""

    @property
    def discrete(self) -> bool:  # type: ignore[override]
        """Whether an action is the number of a choice, not a vector of scores."""
        return not self.scores

    def chosen(self, action: Array) -> Array:
        """Return the number () of the choice that an action makes."""
        return jnp.argmax(action) if self.scores else action
