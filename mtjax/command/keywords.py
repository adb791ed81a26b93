"""The configuration of a run, made from names or objects and from settings by keyword."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from mtjax import agents
from mtjax.agents import BaseAgent, parts, swept
from mtjax.agents.beginning import Beginning, beginning
from mtjax.agents.hyperparameters import parts_of, unknown_setting
from mtjax.agents.swept import Sweep
from mtjax.checks import shown
from mtjax.config import Plan, RunConfig, configure, describe_teacher, fit_length, own_files, with_preset
from mtjax.envs import make_from
from mtjax.envs.family import Family
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.learning.loop import Settings
from mtjax.names import InputError
from mtjax.saved.policy import Policy
from mtjax.types import Agent, Env


def from_keywords(
    env: Any,
    agent: Any,
    given: Mapping[str, Any],
    *,
    plan: Mapping[str, Any],
    settings: Settings | None = None,
    start: Policy | tuple[Policy, ...] | None = None,
    sweep: Sweep = (),
    **written: Any,
) -> RunConfig:
    """Return the configuration of a run, with the tuned settings of the command line if the agent is given by name.

    Of objects that no name makes again, its ``env`` and ``agent`` are empty.

    Args:
        given: settings of the loop, of the agent or its parts, and of an environment that is given by name.
        plan: the fields of ``Plan`` that are given.
        settings: settings of the training loop; by default those of the preset, or ``Settings()`` for an object.
        start: the policy to fine-tune, or those that teach.
        written: profile, tensorboard, wandb and trackio.

    Raises:
        InputError: there is no such setting, a value is not allowed, or settings do not go together.
    """
    named = isinstance(env, str | FamilyOrMixture) and isinstance(agent, str | BaseAgent)
    _require_learning(env, agent, named)
    if not isinstance(settings, Settings | None):
        raise InputError(f"settings is a mtjax.Settings, not {_kind(settings)}; single settings are given by name")
    name, family, rest = make_from(env, given)
    starts = start if isinstance(start, tuple) else (start,) if start is not None else ()
    begun = _begun(agent, starts)
    known = starts[0].env if len(starts) == 1 and begun is None else None  # whose contexts the networks read
    if isinstance(env, str) and isinstance(family, Family) and isinstance(known, Family):
        family = family.scaled_as(known)
    of_agent = {key: value for key, value in rest.items() if key not in _names(Settings)}
    _require_known(of_agent, agent, name, family, isinstance(env, str))
    if isinstance(agent, str):
        of_loop = {**(vars(settings) if settings else {}), **{x: rest[x] for x in rest.keys() - of_agent}}
        config = with_preset(name, agent, "auto", {**(begun.settings if begun else {}), **of_agent}, family, of_loop)
        length = dataclasses.replace(config.plan if isinstance(env, str) else Plan(), **plan)
        chosen = {*plan, *given, *(_names(Settings) if settings else ())}
        config = fit_length(dataclasses.replace(config, plan=length), chosen)
    else:
        learner, training = configure(agent, settings or Settings(), rest)
        names = (name, agents.name_of(learner)) if named else ("", "")
        config = RunConfig(*names, plan=Plan(**plan), training=training, family=family, learner=learner)
    points, places = swept.grid(sweep), [str(each.directory) for each in starts if each.directory is not None]
    return config.checked(
        start=",".join(places),
        teacher=_teacher(start) if isinstance(start, tuple) else None,
        points=points,
        imports=own_files(config) if named else (),
        sweep=swept.words(config.learner, points),
        **written,
    )


def _begun(agent: Any, starts: Sequence[Policy]) -> Beginning | None:
    """Return what an agent takes of the run of another one, if it begins from such a run."""
    if len(starts) != 1 or not isinstance(agent, str | BaseAgent):
        return None
    return beginning(agents.preset_of(agent).cls if isinstance(agent, str) else agent, starts[0].agent, starts[0].env)


def _teacher(starts: Sequence[Policy]) -> dict[str, Any]:
    """Return the record of those that teach an agent."""
    first = starts[0]
    return describe_teacher(first.agent, first.state.num_tasks, first.env.spec.context_size, len(starts))


def _require_learning(env: Any, agent: Any, named: bool) -> None:
    """Refuse what is neither a name nor an environment or agent, and a name beside an object of another kind."""
    if not isinstance(env, str) and (isinstance(env, type) or not hasattr(env, "reset_worlds")):
        several = "; mtjax.mixture takes several" if isinstance(env, list | tuple) else ""
        raise InputError(f"env is the name of a family, or what mtjax.make returns; not {_kind(env)}{several}")
    if not isinstance(agent, str) and (isinstance(agent, type) or not hasattr(agent, "update")):
        raise InputError(f"agent is a name such as 'care', or what mtjax.agent returns; not {_kind(agent)}")
    if not named and (isinstance(env, str) or isinstance(agent, str)):
        raise InputError("a name goes with an environment derived from Family and an agent derived from BaseAgent")
    for protocol, value in ((Env, env), (Agent, agent)):
        members = {*vars(protocol), *protocol.__annotations__}
        lacks = sorted(name for name in members - {*dir(value)} if not name.startswith("_"))
        if lacks and not isinstance(value, str):
            raise InputError(f"{_kind(value)} lacks what mtjax.types.{protocol.__name__} asks for: {', '.join(lacks)}")


def _kind(value: Any) -> str:
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    return shown(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"


def _names(cls: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(cls)] if dataclasses.is_dataclass(cls) else []


def _require_known(given: Mapping[str, Any], agent: Any, env_name: str, family: Any, by_name: bool) -> None:
    """Refuse a keyword that the agent does not have, and say where it belongs."""
    agent = agents.agent(agent) if isinstance(agent, str) else agent
    known = {name for holder in (agent, *parts_of(agent, given).values()) for name in parts.setting_names(holder)}
    unknown = next((name for name in given if name not in known), None)
    if unknown is None:
        return
    parameter, value = unknown.replace("_", "-"), given[unknown]
    if isinstance(family, Family) and parameter in family.parameters:
        say = f"vary={{{parameter!r}: {value!r}}}"
        where = f"use {say}" if by_name else f"use mtjax.make({env_name!r}, {say})"
        raise InputError(f"{unknown} is a parameter of {env_name}, not a setting: {where}")
    if unknown in _names(type(family)):
        raise InputError(f"{unknown} is a setting of the environment: use mtjax.make({env_name!r}, {unknown}=...)")
    raise unknown_setting("setting", unknown, [*_names(Settings), *_names(Plan), *sorted(known)])
