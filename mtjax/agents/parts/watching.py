"""``Watcher`` is a part that follows episodes as they are played, and counts the steps that were collected."""

from typing import Any

from mtjax.types import Array, Transition


class Watcher:
    """It may keep statistics of all steps, its memory, and something of each episode so far. By default it keeps none.

    So are the scaling of rewards and the sampler of tasks.
    """

    def init(self, num_tasks: int) -> Any:
        """Return the memory before the first step; leaves are (T, ...)."""
        return None

    def begin(self) -> Any:
        """Return what is kept of an episode as it begins; None for nothing."""
        return None

    def remember(self, episode: Any, reward: Array, gamma: float | Array) -> Any:
        """Return what is kept of an episode after a step."""
        return episode

    def observe(self, memory: Any, steps: Transition) -> Any:
        """Update the memory by collected steps (T, N, ...), whose ``memory`` is what was kept after each step."""
        return memory
