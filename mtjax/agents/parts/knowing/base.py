"""``Nothing`` is the interface of ways to know a task, and the one that knows nothing."""

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp

from mtjax.agents.networks import Params
from mtjax.types import Array, Key, Metrics, Spec, Task, Transition


@dataclasses.dataclass(frozen=True)
class Nothing:
    """Shows networks nothing of their task.

    Every way of knowing a task is a class with these methods. What it learns is a network of the agent's, ``knowing``,
    which the critics' loss trains. Agents that learn an actor from rollouts train it in the actor's step instead, by
    the actor's loss and a share of the critic's, so that nothing else moves the policy; but not what has a loss of its
    own (``join``).
    """

    borrowed: ClassVar[tuple[str, ...]] = ()  # names of what an unseen task uses of its nearest training task
    tells: ClassVar[bool] = False  # whether networks see features of the task
    by_number: ClassVar[bool] = False  # whether these are the number of a training task, one-hot
    by_parameters: ClassVar[bool] = False  # whether these are the task's parameters
    embeds: ClassVar[bool] = False  # whether every training task has a learned vector, called embedding
    recurs: ClassVar[bool] = False  # whether features are a memory that learns, through the steps of a window
    burn_in: ClassVar[int] = 0  # first steps of a window that only renew that memory
    draws: ClassVar[bool] = False  # whether its own loss needs a key

    @property
    def by_actor(self) -> bool:
        """Whether the actor's step trains it, in agents that learn an actor from rollouts."""
        return type(self).join is Nothing.join

    @property
    def history(self) -> int:
        """Number of last steps from which features are made."""
        return 0

    def refuses(self) -> str:
        """Return why it cannot be used with these settings; empty if it can."""
        return ""

    def table(self, spec: Spec, num_tasks: int) -> Array | None:
        """Return the vectors of tasks that are known before a run: (T, V), or of all splits' tasks; None for none.

        Raises:
            InputError: they cannot be had.
        """
        return None

    def init(self, num_tasks: int, seen: Any, action: Array, own: bool, key: Key) -> Params:
        """Initialise what is learned.

        Args:
            seen: an observation (O,), with the last steps if there is a ``history``.
            action: (A,).
            own: whether every task has networks of its own.
        """
        return Params({}, {})

    def begin(self, obs_size: int, action_size: int) -> Any:
        """Return the memory with which a trial begins, of observations and actions of these sizes; None for none."""
        return None

    def remember(self, params: dict[str, Any], hidden: Any, step: Transition) -> Any:
        """Return the memory after a step, whose observations are as networks take them.

        Args:
            params: the named parts of ``knowing``, of this task.
        """
        return hidden

    def task_vector(self, number: Array, task: Task, num_tasks: int, table: Array | None) -> Array:
        """Return those features (Z,) of a task that need no learned parameters.

        Args:
            number: () of the task if it is a training task, else of the nearest one.
        """
        return jnp.zeros(0)

    def features(self, params: dict[str, Any], task_vector: Array, seen: Any) -> Array:
        """Return the features (Z,) or (..., Z) of one task that networks take as inputs.

        Args:
            params: the named parts of ``knowing``, of this task.
            task_vector: from the method of that name, (Z,) or (..., Z).
            seen: observations (..., O), with the last steps if there is a ``history``.
        """
        return task_vector

    def join(self, loss: Array, metrics: Metrics, params: dict[str, Any], seen: Any) -> tuple[Array, Metrics]:
        """Add what it learns by to the critics' loss of one task, and its metrics to theirs.

        Args:
            params: the named parts of ``knowing``, of this task.
            seen: the observations of a batch, as for ``features``.
        """
        return loss, metrics
