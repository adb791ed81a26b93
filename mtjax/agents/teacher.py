"""A teacher is an agent of earlier runs, as the agent that it teaches knows it."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mtjax.agents.base import BaseAgent
from mtjax.agents.networks import Params
from mtjax.agents.state import AgentState
from mtjax.types import Acted, Array, Key, Spec, Task, Transition


class Teacher(NamedTuple):
    """Holds an agent that runs have trained, whose states are in a net of the agent that it teaches.

    Parts of that net are the state of the run, which all tasks share, or of several runs each task's own; the number of
    each task in its run; and of several runs each task's context there.
    """

    agent: BaseAgent
    num_tasks: int  # that each run was trained on
    context_size: int  # size of their contexts
    num_runs: int

    def init(self, spec: Spec, tasks: Task, key: Key) -> Params:
        """Return a net for training ``tasks`` (T, ...) whose states are fresh, until those of runs take their place."""
        count = len(tasks.id)
        known = tasks
        if self.num_tasks != count:
            known = jax.tree.map(lambda x: x[jnp.arange(self.num_tasks) % count], tasks._replace(blocks=None))
        known = known._replace(context=jnp.zeros((self.num_tasks, self.context_size)))
        state = self.agent.init(spec._replace(context_size=self.context_size), known, key)._replace(fits={})
        none = jnp.zeros(count, jnp.int32)
        return join([state] * self.num_runs, none, none, known.context[none])

    def act(self, net: Params, memory: Any, obs: Any, task: Task) -> Acted:
        """Choose the likeliest action for one observation of one task, whose net this is."""
        state, task = _known(net, task)
        return self.agent.act(state, memory, obs, task, None)

    def begin(self, net: Params, task: Task) -> Any:
        """Return the memory with which it begins a trial of one task."""
        state, task = _known(net, task)
        return self.agent.begin(state, task)

    def remember(self, net: Params, memory: Any, transition: Transition, task: Task) -> Any:
        """Return the memory after a step of one task, whoever took it."""
        state, task = _known(net, task)
        return self.agent.remember(state, memory, transition._replace(extras=None), task)


def join(states: Sequence[AgentState], run: Array, number: Array, context: Array) -> Params:
    """Return the net of a teacher for tasks (T,).

    Args:
        states: one of each run.
        run: (T,) which of them teaches a task.
        number: (T,) of the task there, or one beyond the last if the run was not trained on it.
        context: (T, C) of the task there.
    """
    if len(states) == 1:
        return Params({"state": states[0]}, {"number": number})
    state = jax.tree.map(lambda *x: jnp.stack(x)[run], *states)
    return Params({}, {"state": state, "number": number, "context": context})


def leave(agent: BaseAgent, state: AgentState) -> tuple[Any, AgentState]:
    """Return an agent and its state without the teacher, whom nobody needs who acts."""
    nets = {name: net for name, net in state.nets.items() if name != "teacher"}
    return dataclasses.replace(agent, teacher=None), state._replace(nets=nets)


def _known(net: Params, task: Task) -> tuple[AgentState, Task]:
    """Return the state of the run that teaches a task, and the task as that run knows it."""
    parts = net.parts
    return parts["state"], task._replace(id=parts["number"], context=parts.get("context", task.context))
