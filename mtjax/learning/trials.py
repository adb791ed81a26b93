"""A trial is what an agent plays with one task and one memory. It says what begins anew where an episode ends.

For the learner a trial is the whole problem: the task and the agent's memory end with it, and not with each of its
episodes. Inside a trial no state is terminal, and what follows the last step of an episode that terminated is the first
observation of the next (Duan et al. 2016, "RL^2"). Where a mere limit of time ends an episode, sums of rewards are cut,
and the value that would follow counts, inside a trial as at its end: an agent that does not see the time cannot foresee
it. In families of a finite horizon (``Family.finite_horizon``) time is part of the problem: an episode's last step is a
terminal one, so that sums run through a whole trial.
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import numpy as np

from mtjax.learning.curricula import EVERYTHING, Curriculum
from mtjax.types import Array, InputError

MOST = 10_000
"""Largest number of episodes of a trial."""


class Ends(NamedTuple):
    """Says what has ended with a step; each is bool of any one shape."""

    episode: Array
    trial: Array  # the task and the agent's memory begin anew
    terminal: Array  # nothing follows for the learner, whose values are 0 there
    world: Array  # the world begins anew: its state, and with it the observation
    cut: Array  # sums of rewards end: the trial does, or a limit of time stopped what would have gone on


@dataclasses.dataclass(frozen=True)
class EachEpisode:
    """A trial is one episode. A time limit cuts it off: it could have gone on, so the value after it counts."""

    episodes: ClassVar[int] = 1  # of a trial
    keeps_state: ClassVar[bool] = False  # whether worlds go on where an episode ends

    def ends(self, terminated: Array, timeout: Array, lost: Array, episode: Any) -> Ends:
        """Return what has ended with a step.

        Args:
            terminated: the world reached a terminal state, or the end of a finite horizon.
            timeout: the episode has taken as many steps as it may.
            lost: the world blew up (``rollout.step_envs``).
            episode: int32, how many episodes of the trial came before; None where trials are single episodes.
        """
        ended = terminated | lost | timeout
        return Ends(ended, ended, terminated, ended, ended)


@dataclasses.dataclass(frozen=True)
class Repeated:
    """A trial is some episodes of one task. It is terminal where its last episode is; every time limit cuts sums."""

    episodes: int
    keeps_state: ClassVar[bool] = False

    def __post_init__(self):
        if not 2 <= self.episodes <= MOST:
            raise InputError(f"a repeated trial has 2 to {MOST} episodes, not {self.episodes}")

    def ends(self, terminated: Array, timeout: Array, lost: Array, episode: Any) -> Ends:
        ended = terminated | lost | timeout
        last = ended & (episode + 1 == self.episodes)
        return Ends(ended, last, last & terminated, ended, last | ended & ~terminated)


@dataclasses.dataclass(frozen=True)
class ResetFree:
    """A world goes on over time limits, where only its task changes, and what is observed of it. A lost one is reset.

    No state is terminal, and no limit is one for the learner.
    """

    plays: Curriculum = EVERYTHING  # what says which task follows
    episodes: ClassVar[int] = 1
    keeps_state: ClassVar[bool] = True

    def ends(self, terminated: Array, timeout: Array, lost: Array, episode: Any) -> Ends:
        ended = lost | timeout
        return Ends(ended, ended, terminated & False, lost, ended)


Trials = EachEpisode | Repeated | ResetFree
EACH_EPISODE = EachEpisode()


def of_episodes(count: int) -> EachEpisode | Repeated:
    """Return the trials of so many episodes."""
    return EACH_EPISODE if count == 1 else Repeated(count)


def require_whole(episodes: int, trial: int, name: str = "episodes") -> None:
    """Check that a number of episodes makes whole trials.

    Raises:
        InputError: it does not.
    """
    if episodes % trial:
        more = at_least(episodes, trial)
        raise InputError(f"{name} must be a multiple of a trial's {trial} episodes, such as {more}; not {episodes}")


def at_least(episodes: int, trial: int) -> int:
    """Return the smallest number of episodes that makes whole trials, from a number on."""
    return -(-episodes // trial) * trial


def describe(returns: np.ndarray, trial: int) -> str:
    """Return the mean return of the first, the last and all episodes of trials as text; empty where these are one.

    Args:
        returns: (..., episodes), those of a trial one after another.
        trial: episodes of a trial.
    """
    if trial == 1:
        return ""
    mean = np.nanmean(returns.reshape(-1, trial), axis=0)
    return f"episode 1 of a trial {mean[0]:.3g}, episode {trial} {mean[-1]:.3g}, mean {np.mean(mean):.3g}"
