"""Settings of the loop, agents and families that cannot be used together. An InputError says why."""

from typing import Any

import jax

from mtjax import frames
from mtjax.agents import AGENTS, BaseAgent
from mtjax.agents import name_of as agent_name_of
from mtjax.agents.task_changes import consolidates
from mtjax.envs import Family
from mtjax.envs import name_of as env_name_of
from mtjax.envs.choosing import Choosing
from mtjax.envs.engines.base import World
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.experience import Rollouts
from mtjax.learning.loop import Settings
from mtjax.types import Agent, Env, InputError, Returning


def require_agent(settings: Settings, agent: Agent) -> None:
    """Check that an agent can learn from the trials, the worlds and the tasks at a time that settings ask for.

    Raises:
        InputError: it cannot.
    """
    _require_windows(settings.num_envs, agent)
    if settings.trials > 1:
        _require_repeatable(settings.trials, agent)
    if consolidates(agent) and not settings.plays.in_turn:
        raise InputError(
            "continual, reset-optimizer and shrink-and-perturb are for tasks one after another: use "
            "--curriculum=sequence:STEPS"
        )
    if settings.keep_replay:
        _require_one_replay(settings, agent)
    if settings.plays.steps:
        _require_turns(settings, agent)


def require_env(settings: Settings, env: Env, agent: Agent) -> None:
    """Check that a family has the worlds, actions, trials and tasks at a time that settings and agent ask for.

    Raises:
        InputError: its trials draw tasks to which the agent would adapt, its worlds cannot go on, some tasks of a
            mixture cannot be played alone, the replay does not fit it, the agent cannot draw its actions, or its
            parts do not fit the tasks.
    """
    tasks = env.tasks("train")
    if agent.experience.adaptations and tasks.draws is not None:
        raise InputError("this agent adapts to each task by its rollouts, but here trials draw tasks; vary by a list")
    reason = _cannot_go_on(env) if settings.reset_free else ""
    if reason:
        raise InputError(f"--reset-free lets worlds go on, and {reason}; leave it out")
    _require_way_back(settings, env)
    if settings.plays.steps and tasks.blocks is not None:
        tasks.blocks.some(settings.plays.count(len(tasks.id)))
    agent.experience.check(env, settings.num_envs, settings.chunk_steps, agent.unroll)
    if not isinstance(agent, BaseAgent):
        return
    if not isinstance(agent.policy, agent.policies):
        raise _draws_none(env, agent)
    agent.conditioning.table(env.spec, len(tasks.id))
    agent.encoder.require(len(tasks.id))


def _draws_none(env: Env, agent: BaseAgent) -> InputError:
    """Return the error of an agent that cannot draw a family's actions. It names some agents that can."""
    draws = lambda cls: isinstance(agent.policy, cls.policies) and not cls.taught
    able = [name for name, preset in AGENTS.items() if draws(preset.cls) and not preset.cls.follows_sketches][:3]
    if env.spec.symbols:
        able = [name for name, preset in AGENTS.items() if draws(preset.cls) and preset.cls.follows_sketches] + able
    families = [part.family for part in env.parts] if isinstance(env, FamilyOrMixture) else []
    scores = ", or --env.scores" * any(isinstance(family, Choosing) for family in families)
    names, kind = (agent_name_of(agent), env_name_of(env)), env.spec.action.kind
    return InputError(f"{names[0]} draws no {kind} actions, which {names[1]} has: use {', '.join(able)}{scores}")


def _require_windows(num_envs: int, agent: Agent) -> None:
    """Refuse more minibatches than a task's rollout has windows, which for a memory are whole rollouts of worlds."""
    rollouts, length = agent.experience, agent.unroll
    if not isinstance(rollouts, Rollouts) or rollouts.minibatches <= rollouts.num_windows(num_envs, length):
        return
    count, asked = rollouts.num_windows(num_envs, length), rollouts.minibatches
    whole = f"this agent learns from whole rollouts of worlds, and a task has {count}"
    told, worlds = (whole, f", or --num-envs={asked}") if length else (f"a task's rollout has {count} steps", "")
    raise InputError(f"--agent.minibatches={asked} are too many: {told}; use --agent.minibatches={count}{worlds}")


def _require_turns(settings: Settings, agent: Agent) -> None:
    """Refuse a curriculum that changes tasks within a chunk, or whose agent holds what belongs to all tasks."""
    told, experience = f"the curriculum {settings.curriculum}", agent.experience
    if settings.plays.steps % settings.chunk_steps:
        raise InputError(
            f"{told} changes tasks between chunks: give a multiple of --chunk-steps={settings.chunk_steps}"
        )
    if experience.reset_every or experience.host_slots(settings.num_envs):
        raise InputError(f"{told} begins a replay anew; use --reset-every=0 and --host-replay-size=0")
    if experience.adaptations:
        raise InputError(f"{told} changes tasks, and this agent adapts to all that it knows; leave it out")
    if isinstance(agent, BaseAgent) and jax.tree.leaves(agent.gradients.init(2)):
        raise InputError(f"{told} needs a rule of gradients without memory of the tasks, such as mean or pcgrad")


def _require_way_back(settings: Settings, env: Env) -> None:
    """Refuse a curriculum that asks worlds to go back to their start, where they are reset or have no task for it."""
    if not settings.plays.goes_back:
        return
    told = f"the curriculum {settings.curriculum}"
    if not settings.reset_free:
        raise InputError(f"{told} is for worlds that are not reset; add --reset-free")
    if not isinstance(env, Returning):
        raise InputError(f"{told} needs a way back to the start, which this family has no task for, as tabletop has")


def _require_one_replay(settings: Settings, agent: Any) -> None:
    """Refuse to keep the replay where tasks do not change, or where a step would be taken for another task's."""
    if not settings.plays.steps or not agent.experience.storage.kept:
        raise InputError("--keep-replay is for an agent with a replay and a curriculum, such as sequence:STEPS")
    blind = not agent.conditioning.tells and agent.heads == "shared"
    if not blind or agent.representation.embeds or agent.unroll or agent.experience.n_step > 1:
        raise InputError(
            "--keep-replay mixes single steps of all tasks: use --agent.conditioning=none, --agent.heads=shared, "
            "--n-step=1 and --agent.target=td"
        )


def _require_repeatable(trials: int, agent: Agent) -> None:
    """Refuse an agent that takes what follows a step for a state of the same episode."""
    follows = f"what follows a step, which in a trial of {trials} episodes may be another episode"
    if agent.experience.storage.kept and agent.experience.hindsight:
        raise InputError(f"hindsight relabels steps by {follows}; use --hindsight=0 or --trials=1")
    if not isinstance(agent, BaseAgent):
        return
    if agent.view.history:
        raise InputError(f"tasks are inferred from {follows}; use --agent.conditioning=recurrent or --trials=1")
    if agent.representation.predicts:
        raise InputError(f"models predict {follows}; use --agent.representation=plain or --trials=1")


def _cannot_go_on(env: Env) -> str:
    """Return why worlds cannot go on where an episode's time is up, with the next one's task; empty if they can."""
    tasks = env.tasks("train")
    if tasks.blocks is not None:
        return "it is for single families, not for mixtures"
    if env.ends_early:
        return "in this family episodes terminate"
    goals, varied, fresh = (env.relabels, env.varied, env.fresh_goals) if isinstance(env, Family) else ((), (), False)
    if fresh:
        return "this family draws its goals with its states"
    if tasks.draws is None:
        return ""
    physical = [name for name in varied if name not in goals]
    if not goals or physical:
        return f"states depend on {', '.join(physical) or 'what episodes draw'}: only goals may be drawn"
    one = jax.tree.map(lambda x: x[0], tasks._replace(draws=None))
    state = jax.eval_shape(env.reset, one, jax.random.key(0)).state
    if isinstance(state, World) and (state.extra is not None or state.mocap is not None):
        return "the states of this family hold its goals"
    return "pictures show the goal of before" if frames.shown(env.spec.obs) else ""
