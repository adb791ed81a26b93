"""The configuration of a run from a command line: names choose the defaults, and typed flags override them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from mtjax.agents import agent, preset_of, settings
from mtjax.agents.beginning import beginning
from mtjax.agents.hyperparameters import CHOICES, owners, parts_of, replace
from mtjax.command.class_sources import all_flags
from mtjax.command.flags import flag_value, plain_values, split_flags, switched_off, switched_on, vary_flags, with_port
from mtjax.command.imports import import_files, imports_of
from mtjax.command.parsing import parse_with_tyro
from mtjax.command.refusals import check_names, unknown_flag
from mtjax.config import NO_FINE_TUNING, RunConfig, describe_teacher, fit_length, own_files, with_preset
from mtjax.envs import make, require_pictures
from mtjax.envs.family import Family
from mtjax.envs.mixtures import require_family
from mtjax.learning.loop import Settings
from mtjax.names import InputError
from mtjax.saved.config_json import from_json

_PROGRAM = "python -m mtjax.train"


def parse(argv: Sequence[str]) -> RunConfig:
    """Read the configuration of a run from a command line.

    Raises:
        InputError: a name, flag or value cannot be used, or they do not go together.
    """
    return draft(argv).checked()


def draft(argv: Sequence[str]) -> RunConfig:
    """Read a configuration that its reader completes, as a sweep does by points; ``RunConfig.checked`` takes them.

    The names of environment, agent and preset choose the defaults; the other flags change them.

    Raises:
        InputError: a name, flag or value cannot be used.
    """
    files, _ = imports_of(argv)
    argv = plain_values(with_port(import_files(argv)))
    check_names(argv)
    env_name = flag_value(argv, "env", RunConfig.env)
    start = flag_value(argv, "from", "")
    sources = _sources(start, flag_value(argv, "agent", "")) if start or "--from=" in argv else []
    agent_name = flag_value(argv, "agent", sources[0].agent if sources else RunConfig.agent)
    preset_name = flag_value(argv, "preset", RunConfig.preset)
    named = {name for word in argv if (name := _name(word))}
    begun = beginning(preset_of(agent_name).cls, sources[0].learner, sources[0].family) if sources else None
    goes_on = bool(sources) and begun is None and not preset_of(agent_name).cls.taught
    vary, argv = vary_flags(argv)
    chosen, argv = _peel_parts(argv)
    parts = {**(begun.settings if begun else {}), **chosen}
    own = sources[0].learner if goes_on else agent(agent_name)
    of_family, argv = _read(argv, [part.family for part in make(env_name).parts], "env")
    of_agent, argv = _read(argv, [own, *parts_of(own, parts).values()], "agent")
    of_loop, argv = _read(argv, [Settings()], "")
    given = parts if goes_on else parts | of_agent
    default = with_preset(env_name, agent_name, preset_name, given, None, of_loop, vary=vary, **of_family)
    if goes_on:
        default = _fine_tuning(default, sources[0], chosen, of_agent)
    elif sources and begun is None:
        default = _distilling(default, sources)
    default = dataclasses.replace(default, start=start)
    _check_flags(argv, default)
    config = fit_length(parse_with_tyro(RunConfig, argv, default, _PROGRAM), named)
    config = dataclasses.replace(config, imports=tuple(files))
    return dataclasses.replace(config, imports=own_files(config))


def _name(word: str) -> str:
    """Return the setting of a flag, such as unroll of --agent.unroll=32; an empty string for other words."""
    flag = word.split("=", 1)[0].removeprefix("--").removeprefix("agent.")
    return flag.replace("-", "_") if word.startswith("--") else ""


def _sources(start: str, agent_name: str) -> list[RunConfig]:
    """Return the configurations of the runs that --from names: of one, or for an agent that is taught of several."""
    several = bool(agent_name) and preset_of(agent_name).cls.taught
    runs = start.split(",") if several else [start]
    found = [from_json(Path(run) / "config.json") for run in runs]
    for run, source in zip(runs, found, strict=True):
        if source.points:
            raise InputError(f"--from takes a run of one setting, and {run!r} holds {len(source.points)} of a sweep")
    return found


def _distilling(config: RunConfig, sources: Sequence[RunConfig]) -> RunConfig:
    """Return a configuration whose agent is taught by those of runs, and for one run with contexts scaled as there."""
    family, source = config.family, sources[0]
    if len(sources) == 1 and isinstance(family, Family) and isinstance(source.family, Family):
        family = family.scaled_as(source.family)
    sizes = source.family.train_count, source.family.spec.context_size, len(sources)
    return dataclasses.replace(config, family=family, teacher=describe_teacher(source.learner, *sizes))


def _fine_tuning(
    config: RunConfig, source: RunConfig, chosen: Mapping[str, str], of_agent: Mapping[str, Any]
) -> RunConfig:
    """Return a configuration with the agent of the run ``source``, and tasks whose context is scaled as there."""
    had = {"agent": source.agent, **settings(source.learner)}
    for name, given in {"agent": config.agent, **chosen}.items():
        if given != had[name]:
            raise InputError(f"--from goes on with the run's {name}, {had[name]}, not with {given}; leave it out")
    for env in (config.family, source.family):
        require_family(env, NO_FINE_TUNING)
    assert isinstance(config.family, Family) and isinstance(source.family, Family)
    learner = replace(source.learner, {"tune": "all", **of_agent})
    return dataclasses.replace(config, learner=learner, family=config.family.scaled_as(source.family))


def _peel_parts(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --agent.KIND=NAME out of a command line, because each part adds flags of its own."""
    kinds = {f"--agent.{kind}": kind for kind in CHOICES}
    given, rest = split_flags(argv, kinds.__contains__, "a value")
    return {kinds[flag]: name for flag, name in given.items()}, rest


def _read(argv: Sequence[str], holders: Sequence[Any], group: str) -> tuple[dict[str, Any], list[str]]:
    """Take the flags of dataclasses' settings out of a command line, and read their values by name."""
    known = {flag: (*found, x) for x in holders for flag, found in setting_flags(type(x), group).items()}
    known |= {switched_off(flag): found for flag, found in known.items()}
    types, defaults, words, rest, mine = {}, {}, [], [], False
    for word in argv:
        if word.startswith("--"):
            flag = word.partition("=")[0]
            mine = flag in known
            if mine:
                name, kind, holder = known[flag]
                types[name], defaults[name] = kind, getattr(holder, name)
        (words if mine else rest).append(word)
    if not types:
        return {}, rest
    made: Any = dataclasses.make_dataclass("Given", types.items(), frozen=True)
    learner = ("learner", Annotated[made, tyro.conf.arg(name=group)])
    grouped = dataclasses.make_dataclass("Grouped", [learner], frozen=True)
    return vars(parse_with_tyro(grouped, words, grouped(made(**defaults)), _PROGRAM).learner), rest


def setting_flags(cls: type, group: str) -> dict[str, tuple[str, Any]]:
    """Return the names and types of a dataclass's settings by their flags, which are in a group or in none."""
    found = {}
    hints = get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        marks = getattr(hints[field.name], "__metadata__", ())
        names = [mark.name for mark in marks if getattr(mark, "name", None) is not None]
        bare = not group or any(getattr(mark, "prefix_name", None) is False for mark in marks)
        name = next(iter(names), field.name.replace("_", "-"))
        if name and tyro.conf.Suppress not in marks:
            found[f"--{name}" if bare else f"--{group}.{name}"] = (field.name, hints[field.name])
    return found


def flags(config: RunConfig) -> dict[str, bool]:
    """Return every flag of a configuration, and whether it is a switch."""
    groups = {
        "": [config, config.plan, config.training],
        "env": [config.family, *(part.family for part in config.family.parts)],
        "agent": [config.learner, *parts_of(config.learner).values()],
    }
    found = {f"--agent.{kind}": False for kind in parts_of(config.learner) if kind in CHOICES}
    for group, members in groups.items():
        for member in members:
            for flag, (name, _) in setting_flags(type(member), group).items():
                found[flag] = isinstance(getattr(member, name), bool)
    return found


def _check_flags(argv: Sequence[str], config: RunConfig) -> None:
    known = {**flags(config), "--help": False, "--import": False}
    allowed = {*known, *map(switched_off, known)}  # what is no switch is refused by name when it is parsed
    for word in argv:
        flag = word.split("=", 1)[0]
        if flag.startswith("--") and flag not in allowed:
            require_pictures(config.env, flag.removeprefix("--env."))
            name = flag.removeprefix("--").removeprefix("agent.").replace("-", "_")
            if found := owners(name, "--agent.{}={}"):
                raise InputError(f"unknown flag {flag!r} of {config.agent}; it belongs to {found}")
            if switched_on(flag) in all_flags():
                holder = config.agent if flag.startswith("--agent.") else config.env
                raise InputError(f"{holder} has no flag {flag}; --env, --agent and --help with them list those it has")
            raise unknown_flag(flag, known)
