"""Distillation: which trained policy teaches an agent which of its tasks, and what they bring into its state."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax import frames
from mtjax.agents import BaseAgent, name_of
from mtjax.agents import teacher as teachers
from mtjax.agents.parts.policies import Categorical
from mtjax.agents.swept import agents_at
from mtjax.config import RunConfig
from mtjax.envs import Family
from mtjax.envs.contexts import ranges
from mtjax.saved import pretrained
from mtjax.saved.policy import Policy
from mtjax.tasks import SAME_CONTEXT
from mtjax.training.finetune import describe_actions, describe_sizes, require_same_agent, require_shapes
from mtjax.types import Env, InputError, Task

_SAME = 1e-6  # relative difference of parameters of one task, which are float32


class Lessons(NamedTuple):
    """Holds who teaches each task, leaves (T, ...)."""

    run: np.ndarray  # int32 number of the run; -1: none was trained on the task
    number: np.ndarray  # int32 of the task in that run, or one beyond its last if it was not trained on it
    context: np.ndarray  # (T, C) of the task there


def require_teachers(config: RunConfig, starts: Sequence[Policy] | None) -> None:
    """Check that trained policies can teach an agent the tasks of a run.

    Raises:
        InputError: there are none, they differ in their networks or from the tasks in their sizes, or one cannot teach.
    """
    if starts is None:
        if not config.start:
            raise InputError("this agent learns from trained policies; name their runs: --from=RUN")
        return
    for start in starts:
        _require_policy(start, config)
    for other in starts[1:]:
        require_same_agent(starts[0].agent, other.agent)
    if len(starts) == 1:
        _require_scale(starts[0], config.family)
    else:
        _require_lessons(starts, config.family)
    for agent in agents_at(config.learner, config.points):
        if agent.teacher_temperature != 1 and not isinstance(agent.policy, Categorical):
            raise InputError("teacher-temperature is of discrete actions; leave it out")


def _require_policy(start: Policy, config: RunConfig) -> None:
    """Refuse a policy that does not map what the learner sees to its actions, or has to adapt before it plays."""
    pretrained.require_learning(start.directory)
    theirs, ours, agent = start.env.spec, config.family.spec, start.agent
    if frames.seen(theirs) != frames.seen(ours) or theirs.action != ours.action or theirs.mixed != ours.mixed:
        raise InputError(
            f"the teacher maps {describe_sizes(theirs)} to {describe_actions(theirs)}; "
            f"these tasks have {describe_sizes(ours)} and {describe_actions(ours)}"
        )
    if agent.experience.adaptations:
        raise InputError(f"{name_of(agent)} adapts its policy to each task before it plays; it cannot teach")
    if start.trial != config.training.trials and agent.conditioning.recurs:
        raise InputError(f"the teacher remembers trials of {start.trial} episodes; give --trials={start.trial}")


def _require_scale(start: Policy, env: Env) -> None:
    """Refuse tasks whose contexts mean something else to the one policy that teaches them all."""
    families = isinstance(env, Family) and isinstance(start.env, Family)
    if start.env.spec.context_size != env.spec.context_size or (families and ranges(start.env) != ranges(env)):
        raise InputError("the context of these tasks is not written as the teacher's; give env.scaled_as(policy.env)")


def _require_lessons(starts: Sequence[Policy], env: Any) -> None:
    """Refuse tasks that none of several policies was trained on, or policies of tasks that cannot be compared."""
    tasks, theirs = env.tasks("train"), [start.env.tasks("train") for start in starts]
    if any(each.draws is not None or each.blocks is not None for each in (tasks, *theirs)):
        raise InputError("one run teaches mixtures, and tasks that episodes draw; give one")
    if len({each.context.shape for each in theirs}) > 1:
        raise InputError(f"teachers have as many tasks each, not {', '.join(str(len(each.id)) for each in theirs)}")
    other = next((each.params for each in theirs if each.params.keys() != tasks.params.keys()), None)
    if other is not None:
        raise InputError(f"a teacher's tasks have {', '.join(other)}, and these have {', '.join(tasks.params)}")
    unknown = np.flatnonzero(lessons(starts, tasks).run < 0)
    if len(unknown):
        raise InputError(f"none of the teachers was trained on {env.describe(int(unknown[0]))}")


def lessons(starts: Sequence[Policy], tasks: Task) -> Lessons:
    """Return which run teaches each of ``tasks`` (T, ...), and as which of its tasks.

    One run teaches all tasks, each as it plays it. Of several runs, the first that was trained on a task teaches it.
    """
    known = [start.env.tasks("train") for start in starts]
    if len(starts) == 1:
        nearest = starts[0].state.nearest(tasks)
        same = jnp.all(jnp.abs(known[0].context[nearest] - tasks.context) <= SAME_CONTEXT, axis=1)
        number = np.asarray(jnp.where(same, nearest, len(known[0].id)), np.int32)
        return Lessons(np.zeros_like(number), number, np.asarray(tasks.context))
    alike = np.stack([_alike(each, tasks) for each in known])  # (R, T, N)
    run, number = np.argmax(alike.any(axis=2), axis=0), np.argmax(alike, axis=2)
    number = number[run, np.arange(len(run))]
    context = np.stack([np.asarray(each.context) for each in known])[run, number]
    return Lessons(np.where(alike.any(axis=(0, 2)), run, -1).astype(np.int32), number.astype(np.int32), context)


def _alike(theirs: Task, ours: Task) -> np.ndarray:
    """Return which tasks (T, N) have the same parameters."""
    column = lambda tasks, name: np.asarray(tasks.params[name], float)
    each = [np.isclose(column(ours, x)[:, None], column(theirs, x)[None], rtol=_SAME, atol=_SAME) for x in ours.params]
    return np.all(each, axis=0)


def adopt(starts: Sequence[Policy], agent: BaseAgent, tasks: Task, fresh: Any) -> Any:
    """Return an agent's ``fresh`` state (S, ...) for training ``tasks`` (T, ...) with the states of its teachers.

    Seed number k learns from seed k modulo the number of a run's seeds.

    Raises:
        InputError: the shapes of the networks differ.
    """
    found, count = lessons(starts, tasks), len(jax.tree.leaves(fresh)[0])
    of_seeds = lambda start: jax.tree.map(lambda x: x[jnp.arange(count) % len(start.seeds)], start.states)
    states = [of_seeds(start)._replace(fits={}, numbers={}) for start in starts]
    net = jax.vmap(lambda *states: teachers.join(states, *map(jnp.asarray, found)))(*states)
    require_shapes("teacher", net, fresh.nets["teacher"])
    return fresh.with_nets(teacher=net)
