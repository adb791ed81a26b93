"""``Watcher`` says what scalings and samplers follow of episodes as they are played, and of the steps collected."""

from typing import Any, Protocol

from mtjax.types import Array, Transition


class Watcher(Protocol):
    """It may keep statistics of all steps, its memory, and something of each episode. By default it keeps neither."""

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
