"""The configuration of a run, made from names or objects and from settings by keyword."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from mtjax import agents
from mtjax.agents import BaseAgent, swept
from mtjax.agents.choices import flag_names, unknown_setting
from mtjax.agents.choices import settings as settings_of
from mtjax.agents.swept import Point, Sweep
from mtjax.checks import shown
from mtjax.config import Plan, RunConfig, configure, fit_length, own_files, with_preset
from mtjax.envs import BENCHMARKS, ENVS, is_mixture, make, members, name_of
from mtjax.envs.family import Family
from mtjax.envs.tabled import Tabled
from mtjax.loop import Settings
from mtjax.names import InputError, nearest_error
from mtjax.saved.policy import Policy


def configured(
    env: Any,
    agent: Any,
    given: Mapping[str, Any],
    *,
    plan: Mapping[str, Any],
    settings: Settings | None = None,
    start: Policy | None = None,
    sweep: Sweep = (),
    **written: Any,
) -> RunConfig:
    """Return the configuration of a run, with the tuned settings of the command line where names are given.

    Of objects that no name makes again, its ``env`` and ``agent`` are empty.

    Args:
        given: settings of the loop, of the agent or its parts, and of an environment that is given by name.
        plan: the fields of ``Plan``.
        settings: settings of the training loop; by default those of the preset, or ``Settings()`` for an object.
        start: the policy to fine-tune.
        written: profile, tensorboard and wandb.

    Raises:
        InputError: there is no such setting, or a value is not allowed.
    """
    _require_learning(env, agent)
    if not isinstance(settings, Settings | None):
        raise InputError(f"settings is a mtjax.Settings, not {kind_of(settings)}; single settings are given by name")
    family, rest = _family(env, start, given)
    of_agent = {name: value for name, value in rest.items() if name not in _names(Settings)}
    _require_known(of_agent, agent, env, family)
    config = _unchanged(env, agent, family, of_agent)
    by_name = isinstance(agent, str)  # then its learner has the settings already
    changes = {name: rest[name] for name in rest.keys() - of_agent.keys()} if by_name else rest
    learner, training = configure(config.learner, settings or config.training, changes)
    config = dataclasses.replace(config, training=training, learner=learner, start=_place_of(start), **written)
    config = dataclasses.replace(config, plan=dataclasses.replace(config.plan, **plan))
    if by_name:
        chosen = {name for name in plan if plan[name] != getattr(Plan, name)}
        config = fit_length(config, {*given, *chosen, *(_names(Settings) if settings is not None else ())})
    found = swept.grid(sweep)
    config = dataclasses.replace(config, points=found, sweep=_written(learner, found))
    named = config.env in ENVS or is_mixture(config.env)
    return dataclasses.replace(config, imports=own_files(config)) if named else config


def _require_learning(env: Any, agent: Any) -> None:
    """Refuse what is neither a name nor an environment or agent, and a name beside an object of another kind."""
    if not isinstance(env, str) and (isinstance(env, type) or not hasattr(env, "reset_worlds")):
        several = "; mtjax.mixture takes several" if isinstance(env, list | tuple) else ""
        raise InputError(f"env is the name of a family, or what mtjax.make returns; not {kind_of(env)}{several}")
    if not isinstance(agent, str) and (isinstance(agent, type) or not hasattr(agent, "update")):
        raise InputError(f"agent is a name such as 'care', or what mtjax.agent returns; not {kind_of(agent)}")
    if (isinstance(env, str) or isinstance(agent, str)) and not _have_names(env, agent):
        raise InputError("a name goes with an environment derived from Family and an agent derived from BaseAgent")


def _have_names(env: Any, agent: Any) -> bool:
    return isinstance(env, str | Tabled) and isinstance(agent, str | BaseAgent)


def kind_of(value: Any) -> str:
    """Return what a value is, for a message."""
    if isinstance(value, type):
        return f"the class {value.__name__} itself"
    return shown(value) if isinstance(value, str | int | float | None) else f"a {type(value).__name__}"


def _unchanged(env: Any, agent: Any, family: Any, of_agent: Mapping[str, Any]) -> RunConfig:
    """Return the tuned configuration of an agent that is given by name, and the default one of an object."""
    name = env if isinstance(env, str) else name_of(env) if _have_names(env, agent) else ""
    if not isinstance(agent, str):
        return RunConfig(name, agents.name_of(agent) if name else "", family=family, learner=agent)
    config = with_preset(name, agent, "auto", of_agent, family)
    return config if isinstance(env, str) else dataclasses.replace(config, plan=Plan())


def _family(env: Any, start: Policy | None, given: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    """Return the family, and what of ``given`` is not a field of it."""
    if not isinstance(env, str):
        return env, dict(given)
    names = [name for name, _ in members(env)]
    unknown = next((name for name in names if name not in ENVS), None)
    if unknown is not None:
        raise nearest_error("environment", unknown, (*ENVS, *BENCHMARKS))
    own = {name for part in names for name in _names(ENVS[part][0])}
    family = make(env, **{name: value for name, value in given.items() if name in own})
    if start is not None and isinstance(family, Family) and isinstance(start.env, Family):
        family = family.scaled_as(start.env)
    return family, {name: value for name, value in given.items() if name not in own}


def _names(cls: Any) -> list[str]:
    return list(getattr(cls, "__dataclass_fields__", ()))


def _require_known(given: Mapping[str, Any], agent: Any, env: Any, family: Any) -> None:
    """Refuse a keyword that the agent does not have, and say where it belongs."""
    agent = agents.agent(agent) if isinstance(agent, str) else agent
    known = set(settings_of(agent))
    for kind in (name for name in given if name in known and isinstance(given[name], str)):
        with_part = agents.agent(agents.name_of(agent), **{kind: given[kind]}) if kind in _kinds(agent) else agent
        known |= set(settings_of(with_part))
    unknown = next((name for name in given if name not in known), None)
    if unknown is None:
        return
    parameter, value = unknown.replace("_", "-"), given[unknown]
    name = env if isinstance(env, str) else name_of(env)
    if parameter in getattr(family, "parameters", ()):
        say = f"vary={{{parameter!r}: {value!r}}}"
        where = f"use {say}" if isinstance(env, str) else f"use mtjax.make({name!r}, {say})"
        raise InputError(f"{unknown} is a parameter of {name}, not a setting: {where}")
    if unknown in _names(type(family)):
        raise InputError(f"{unknown} is a setting of the environment: use mtjax.make({name!r}, {unknown}=...)")
    raise unknown_setting("setting", unknown, [*_names(Settings), *_names(Plan), *sorted(known)])


def _kinds(agent: Any) -> set[str]:
    return {kind for kind in agents.PARTS if hasattr(agent, kind)}


def _place_of(start: Policy | None) -> str:
    return "" if start is None or start.directory is None else str(start.directory)


def _written(agent: Any, found: tuple[Point, ...]) -> tuple[str, ...]:
    """Return points as ``--sweep`` writes them: each number's flag with its values."""
    flags = flag_names(agent) if found else {}
    values = {name: dict.fromkeys(f"{point[name]:.12g}" for point in found) for name in (found[0] if found else ())}
    return tuple(f"{flags.get(name, name)}={','.join(each)}" for name, each in values.items())
