"""Fine-tuning: an agent starts on new tasks from the parameters that a run learned on other tasks."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax import frames
from mtjax.agents import BaseAgent, parts, settings
from mtjax.agents.beginning import Beginning, beginning
from mtjax.agents.state import AgentState, of_tasks
from mtjax.agents.swept import agents_at
from mtjax.config import NO_FINE_TUNING, RunConfig
from mtjax.envs import Family
from mtjax.envs.contexts import ranges
from mtjax.envs.mixtures import require_family
from mtjax.saved import pretrained
from mtjax.saved.policy import Policy
from mtjax.types import Env, InputError, Spec, Task

_FRESH = ("tasks", "sampler")  # networks that belong to the new tasks alone


def require_start(config: RunConfig, start: Policy | None) -> None:
    """Check that a run can begin from a policy, or without one.

    Raises:
        InputError: it cannot.
    """
    learner = config.learner
    begins = start is not None or config.start
    if learner.tune != "all" and not begins:
        raise InputError(f"--tune={learner.tune} leaves the rest as a run left it; say which run: --from=RUN")
    if learner.experience.reset_every and begins:
        raise InputError("--reset-every throws away what --from takes from a run; give one of them")
    if start is not None:
        for each in agents_at(learner, config.points):
            require_fit(start, config.family, each)


def require_fit(start: Policy, env: Env, agent: BaseAgent) -> None:
    """Check that an agent can fine-tune a run's networks on the tasks of ``env``, or begin from those that it takes.

    Raises:
        InputError: the agent differs from the run's, the tasks have other sizes or another context, or the policy comes
            with the package.
    """
    pretrained.require_learning(start.directory)
    begun = beginning(agent, start.agent, start.env)
    if begun is not None:
        return _require_asked(begun, env, agent)
    require_same_agent(start.agent, agent)
    for each in (env, start.env):
        require_family(each, NO_FINE_TUNING)
    family, known = env, start.env
    theirs, ours = known.spec, family.spec
    pictures = frames.shown(theirs.obs) or frames.shown(ours.obs)
    fix = "; give --env.pixels, --env.frames, --env.grey and --env.state as the run has them" * pictures
    _require_sizes(theirs, ours, fix)
    alike = not isinstance(family, Family) or not isinstance(known, Family) or ranges(family) == ranges(known)
    if theirs.context_size != ours.context_size or not alike:
        raise InputError("the context of these tasks is not written as the run's; give env.scaled_as(policy.env)")
    _require_numbers(start, env, agent)


def _require_sizes(theirs: Spec, ours: Spec, fix: str) -> None:
    """Refuse new tasks whose observations or actions have other sizes than those of a run's networks."""
    if frames.seen(theirs) != frames.seen(ours) or theirs.action != ours.action:
        raise InputError(
            f"the run's networks map {describe_sizes(theirs)} to {describe_actions(theirs)}; "
            f"the new tasks have {describe_sizes(ours)} and {describe_actions(ours)}{fix}"
        )


def _require_asked(begun: Beginning, env: Env, agent: BaseAgent) -> None:
    """Refuse an agent or tasks unlike those that the networks ask for which it takes of another agent's run."""
    given = settings(agent)
    for name, value in {**begun.settings, "tune": "all"}.items():
        if given.get(name) != value:
            raise InputError(f"the run's networks need {name.replace('_', '-')}={value}, not {given.get(name)}")
    _require_sizes(begun.spec, env.spec, f"; take {begun.tasks}")


def require_same_agent(old: BaseAgent, agent: BaseAgent) -> None:
    """Refuse an agent that differs from the run's in more than may be adjusted."""
    had, given = _learned(old), _learned(agent)
    if type(agent) is not type(old) or had.keys() != given.keys():
        raise InputError("the agent is not the run's; give the one that learned there")
    other = next((name for name in had if had[name] != given[name] and name not in agent.adjustable), None)
    if other is not None:
        raise InputError(
            f"{other.replace('_', '-')} is the run's, {had[other]}, and cannot be {given[other]}; "
            f"what may change is {', '.join(name.replace('_', '-') for name in agent.adjustable if name in had)}"
        )


def describe_sizes(spec: Spec) -> str:
    """Return what networks see of tasks, as text."""
    seen, size = frames.seen(spec), frames.state_size(spec)
    pictures = [f"pictures {seen[frames.PICTURES].shape}"] if frames.shown(seen) else []
    return " with ".join(pictures + [f"{size} observed numbers"] * (size > 0))


def describe_actions(spec: Spec) -> str:
    """Return how many actions networks are to map to, as text."""
    return f"{spec.action_size} {spec.action.kind} actions"


def _learned(agent: BaseAgent) -> dict[str, Any]:
    """Return the settings of an agent without those of its experience, which fine-tuning may change."""
    collected = parts.settings(agent.experience)
    return {name: value for name, value in settings(agent).items() if name not in collected}


def _require_numbers(start: Policy, env: Env, agent: BaseAgent) -> None:
    """Refuse new tasks for networks that know tasks by number alone."""
    if not agent.conditioning.by_number:
        return
    nearest, count = np.asarray(start.state.nearest(env.tasks("train"))), start.state.num_tasks
    if nearest.tolist() != list(range(count)):
        raise InputError(
            f"with conditioning=one-hot the run's networks know its {count} tasks by number, and the new ones are not "
            "these; use a run with conditioning=embedding or parameters"
        )


def adopt(start: Policy, agent: BaseAgent, tasks: Task, fresh: Any) -> Any:
    """Return an agent's ``fresh`` state (S, ...) for new ``tasks`` (T, ...) with a run's learned values put in.

    The run gives networks, target networks, temperatures, units of values, scales of rewards and moments of
    observations. Each new task takes the parameters that the run's nearest training task has for itself. Optimisers
    and the memories of gradient surgery and samplers stay fresh. Seed number k starts from the run's seed k modulo
    the number of its seeds.

    A run of another agent gives the networks that ``beginning`` names, and nothing else.

    Raises:
        InputError: the shapes of the networks differ.
    """
    begun = beginning(agent, start.agent, start.env)
    put = partial(_adopt, tasks) if begun is None else partial(_take, begun.nets)
    seeds = jnp.arange(len(jax.tree.leaves(fresh)[0])) % len(start.seeds)
    of_seeds = lambda states: jax.tree.map(lambda x: x[seeds], states)
    adopt_all = lambda states, fresh: jax.vmap(put)(of_seeds(states), fresh)
    state = jax.jit(adopt_all)(start.states, fresh)
    require_shapes("run", state, fresh)
    return state


def require_shapes(whose: str, networks: Any, fresh: Any) -> None:
    """Refuse adopted networks (S, ...) that are not as large as ``fresh`` ones."""
    pairs = zip(jax.tree.leaves_with_path(networks), jax.tree.leaves(fresh), strict=True)
    for (path, ours), expected in pairs:
        if ours.shape != expected.shape:
            name = jax.tree_util.keystr(path)
            raise InputError(f"the {whose}'s networks do not fit: {name} is {ours.shape[1:]}, not {expected.shape[1:]}")


def _take(names: Sequence[str], old: AgentState, fresh: AgentState) -> AgentState:
    return fresh.with_nets(**{name: old.nets[name] for name in names})


def _adopt(tasks: Task, old: AgentState, fresh: AgentState) -> AgentState:
    nets, slow = of_tasks((old.nets, old.slow), old.nearest(tasks))
    nets = {name: net for name, net in nets.items() if name not in _FRESH}
    return fresh._replace(nets=fresh.nets | nets, slow=fresh.slow | slow)
