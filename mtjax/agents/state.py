"""The state of every agent: networks by name. Whoever saves, copies or checks one needs only the names."""

from typing import Any, NamedTuple

import jax

from mtjax.networks import OVER_TASKS, Params
from mtjax.types import Array

Nets = dict[str, Params]
"""Networks by name, of all tasks or of one. What is counted, or tuned by itself, is a net too: moments of observations,
temperatures, units of values. Leaves of ``own`` are (T, ...), or without T those of one task."""


class FitState(NamedTuple):
    """Holds what the gradient steps of some networks remember."""

    optimizer: Any
    rule: Any  # the memory of the rule of gradient surgery


class AgentState(NamedTuple):
    """Holds all that an agent has learned or counted."""

    nets: Nets
    slow: Nets  # slow copies, the targets, by the same names
    fits: dict[str, FitState]  # by the names of the agent's fits

    @property
    def num_tasks(self) -> int:
        """The number T of tasks that the agent knows."""
        return len(self.nets["tasks"].own["context"])


def of_task(nets: Nets, number: Array) -> Nets:
    """Select the networks of the task with this number () int32."""
    return {name: Params(net.shared, jax.tree.map(lambda x: x[number], net.own)) for name, net in nets.items()}


def axes_of(nets: Nets) -> Any:
    """Return the axes of networks for ``jax.vmap`` over tasks."""
    return dict.fromkeys(nets, OVER_TASKS)
