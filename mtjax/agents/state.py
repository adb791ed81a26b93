"""The state of every agent: networks by name. Whoever saves, copies or checks one needs only the names."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents.networks import OVER_TASKS, Params
from mtjax.tasks import SAME_CONTEXT
from mtjax.types import Array, Task

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
    numbers: dict[str, Array] = {}  # () each: settings of the agent that vary in a sweep, by name  # noqa: RUF012

    @property
    def num_tasks(self) -> int:
        """The number N of tasks that the agent knows."""
        return len(self.nets["tasks"].shared["known"])

    def with_nets(self, **nets: Params) -> "AgentState":
        """Return the state with other networks of these names."""
        return self._replace(nets=self.nets | nets)

    def known(self, task: Task) -> Array:
        """Return the number () int32 of ``task`` if it is a training task, else of the nearest training task.

        Of training tasks that are equally near, up to rounding, it is the lowest number.
        """
        contexts = self.nets["tasks"].shared["known"]
        distance = jnp.sqrt(jnp.sum(jnp.square(contexts - task.context), axis=-1))
        if task.blocks is not None:  # only a task of the same family can be nearest
            distance = jnp.where(task.blocks.related(contexts, task.context), distance, jnp.inf)
        nearest = jnp.argmax(distance <= jnp.min(distance) + 2 * SAME_CONTEXT).astype(jnp.int32)
        return jnp.where(task.id < len(contexts), task.id, nearest)

    def nearest(self, tasks: Task) -> Array:
        """Return the training tasks (T,) nearest to ``tasks`` (T, ...), for training tasks too by their contexts."""
        return jax.vmap(self.known)(tasks._replace(id=jnp.full_like(tasks.id, self.num_tasks)))

    def of_tasks(self, tasks: Task) -> "AgentState":
        """Return the state for acting in ``tasks`` (T, ...) alone, numbered by their places.

        Each has a copy of what its nearest training task has for itself, as far as it is not trained on.
        """
        nets, slow = of_tasks((self.nets, self.slow), jax.vmap(self.known)(tasks))
        known = Params(nets["tasks"].shared | {"known": tasks.context}, {})
        return self._replace(nets=nets | {"tasks": known}, slow=slow)


def of_tasks(tree: Any, rows: Array) -> Any:
    """Select what the tasks with these numbers (T,) have for themselves, in all networks of a tree: leaves (T, ...)."""
    return _map_nets(lambda net: net._replace(own=jax.tree.map(lambda x: x[rows], net.own)), tree)


def with_tasks(tree: Any, played: Any, rows: Array) -> Any:
    """Return networks of all tasks, those of the tasks with these numbers (T,) replaced by ``played``."""
    put = lambda old, new: old.at[rows].set(new)
    return _map_nets(lambda net, new: new._replace(own=jax.tree.map(put, net.own, new.own)), tree, played)


def _map_nets(function: Any, tree: Any, *others: Any) -> Any:
    """Map a function over the networks of trees; other leaves are those of the last tree."""
    one = lambda *nodes: function(*nodes) if isinstance(nodes[0], Params) else nodes[-1]
    return jax.tree.map(one, tree, *others, is_leaf=lambda x: isinstance(x, Params))


def of_task(nets: Nets, number: Array) -> Nets:
    """Select the networks of the task with this number () int32."""
    return {name: Params(net.shared, jax.tree.map(lambda x: x[number], net.own)) for name, net in nets.items()}


def axes_of(nets: Nets) -> Any:
    """Return the axes of networks for ``jax.vmap`` over tasks."""
    return dict.fromkeys(nets, OVER_TASKS)


def over_tasks(function: Any, nets: Nets, *data: Any) -> Any:
    """Map a function of one task's networks and data over all tasks, whose data has leaves (T, ...)."""
    return jax.vmap(function, (axes_of(nets), *[0] * len(data)))(nets, *data)
