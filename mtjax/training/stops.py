"""What ends a run before its last step: signals, and numbers that are not finite."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.parallel import hosts
from mtjax.types import Array

_HINT = "Try lower learning rates or max-gradient-norm"
_HINT_REWARD = "Mend what the environment computes, such as a logarithm of 0"
_HINT_WORLDS = "Try milder values of what varies, more solver iterations or lower learning rates"


@contextlib.contextmanager
def stop_signals(doing: Callable[[str], None] = lambda what: None) -> Iterator[list[int]]:
    """Collect Ctrl-C and SIGTERM instead of stopping at once. A second Ctrl-C stops as usual.

    Args:
        doing: shows what a run does now; it must be safe in a signal's handler.
    """
    received: list[int] = []

    def note(number, _frame) -> None:
        received.append(number)
        doing("ends after this chunk")
        signal.signal(signal.SIGINT, signal.default_int_handler)

    numbers = (signal.SIGINT, signal.SIGTERM)
    try:
        before = [signal.signal(number, note) for number in numbers]
    except ValueError:  # not in the main thread, where Python keeps signals
        yield received
        return
    try:
        yield received
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def require_finite(
    bad_step: np.ndarray, bad_reward: np.ndarray, lost: np.ndarray, first_step: int, last: Callable[[], str]
) -> None:
    """Check that all numbers of a chunk are finite.

    Args:
        bad_step: (S, T), the first step of the chunk with a number that is not, or -1.
        bad_reward: (S, T), the first step of the chunk with a reward that is not, or -1.
        lost: (S, T), how many worlds blew up in the chunk.
        first_step: the steps of every environment before the chunk.
        last: returns a clause on the run's last checkpoint.

    Raises:
        FloatingPointError: one is not. The message names task, step and checkpoint.
    """
    if np.all(bad_step < 0):
        return
    step = int(np.min(bad_step[bad_step >= 0]))
    seed, task = (int(i) for i in np.argwhere(bad_step == step)[0])
    of_reward = np.argwhere(bad_reward == step)
    seed, task = (int(i) for i in of_reward[0]) if len(of_reward) else (seed, task)
    what, hint = ("the reward is not", _HINT_REWARD) if len(of_reward) else ("numbers stopped being", _HINT)
    if not len(of_reward) and lost[seed, task] > 1:
        hint = f"{lost[seed, task]:,.0f} worlds of the task blew up in these steps. {_HINT_WORLDS}"
    raise FloatingPointError(
        f"{what} finite at step {first_step + step} of task {task} (number {seed} of the run's seeds); {last()}. {hint}"
    )


def require_finite_parameters(finite: np.ndarray, iteration: int, last: Callable[[], str]) -> None:
    """Check the result of ``finite_seeds`` before agents are saved, as a chunk's last update is in none of its losses.

    Raises:
        FloatingPointError: an agent holds numbers that are not finite.
    """
    if not np.all(finite):
        raise FloatingPointError(
            f"parameters stopped being finite in the update before step {iteration} (number {np.argmin(finite)} of the "
            f"run's seeds); {last()}. {_HINT}"
        )


def finite_seeds(state: Any) -> np.ndarray:
    """Return which seeds (S,) of an agent's state, leaves (S, ...), have finite numbers only."""
    return hosts.gather(_finite_seeds(state))


@jax.jit
def _finite_seeds(state: Any) -> Array:
    floats = [x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x).reshape(len(x), -1), axis=1) for x in floats]), axis=0)
