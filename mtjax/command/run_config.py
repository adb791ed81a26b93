"""The configuration of a run from a command line: names choose the defaults, and typed flags override them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mtjax.agents import preset_of, settings
from mtjax.agents.beginning import beginning
from mtjax.agents.hyperparameters import CHOICES, flag_names, owners
from mtjax.command.class_sources import all_flags
from mtjax.command.flags import flag_value, plain_values, split_flags, switched_off, switched_on, vary_flags, with_port
from mtjax.command.imports import import_files, imports_of
from mtjax.command.parsing import parse_with_tyro
from mtjax.command.refusals import check_names, unknown_flag
from mtjax.config import NO_FINE_TUNING, RunConfig, describe_teacher, fit_length, own_files, with_preset
from mtjax.envs import ENVS, is_mixture, make, require_pictures
from mtjax.envs.family import Family
from mtjax.envs.mixtures import Mixture, require_family
from mtjax.names import InputError
from mtjax.saved.config_json import from_json

_NO_FLAGS = ("vary", "context-ranges", "points", "teacher", "imports")  # vary has one for each parameter, taken out
_FAMILY_FLAGS = {"combine": "env.combine", "split": "split"}  # they decide which values are allowed
_DECIDING = ("vectors", "heads", "actor-heads", "critic-heads", "lr-schedule")  # they decide which parts are allowed


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
    vary, argv = vary_flags(argv)
    chosen, argv = _peel_parts(argv)
    of_family: dict[str, Any] = {
        name: value for name in ("combine", "split") if (value := flag_value(argv, _FAMILY_FLAGS[name], ""))
    }
    for name in ("pixels", "num_tasks"):  # from pictures agents have other defaults, and with other numbers of tasks
        value = flag_value(argv, f"env.{name.replace('_', '-')}", "")
        if value.isdecimal():
            of_family[name] = int(value)
    if is_mixture(env_name):
        of_family, argv = _peel_shared(argv, make(env_name))
    elif "--env.pictures" in argv and hasattr(ENVS[env_name][0], "pictures"):
        of_family["pictures"] = True
    given = {name.replace("-", "_"): flag_value(argv, f"agent.{name}", "") for name in _DECIDING}
    deciding: dict[str, Any] = {name: value for name, value in given.items() if value}
    if switched_off("--agent.normalize-observations") in argv:  # which presets switch on, and some parts refuse
        deciding["normalize_observations"] = False
    begun = beginning(preset_of(agent_name).cls, sources[0].learner, sources[0].family) if sources else None
    of_agent = {**({} if begun is None else begun.settings), **chosen, **deciding}
    of_loop = _of_loop(argv)
    default = with_preset(env_name, agent_name, preset_name, of_agent, None, of_loop, vary=vary, **of_family)
    if sources and begun is None:
        taught = preset_of(agent_name).cls.taught
        default = _distilling(default, sources) if taught else _fine_tuning(default, sources[0], chosen)
    default = dataclasses.replace(default, start=start)
    _check_flags(argv, default)
    config = parse_with_tyro(RunConfig, argv, default, "python -m mtjax.train")
    config = fit_length(config, {name for word in argv if (name := _name(word))})
    config = dataclasses.replace(config, imports=tuple(files))
    return dataclasses.replace(config, imports=own_files(config))


def _of_loop(argv: Sequence[str]) -> dict[str, Any]:
    """Return those settings of the loop on a command line to which presets are fitted."""
    curriculum, worlds = flag_value(argv, "curriculum", ""), flag_value(argv, "num-envs", "")
    given: dict[str, Any] = {"curriculum": curriculum} if curriculum else {}
    return given | ({"num_envs": int(worlds)} if worlds.isdecimal() else {})


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


def _fine_tuning(config: RunConfig, source: RunConfig, chosen: Mapping[str, str]) -> RunConfig:
    """Return a configuration with the agent of the run ``source``, and tasks whose context is scaled as there."""
    had = {"agent": source.agent, **settings(source.learner)}
    for name, given in {"agent": config.agent, **chosen}.items():
        if given != had[name]:
            raise InputError(f"--from goes on with the run's {name}, {had[name]}, not with {given}; leave it out")
    for env in (config.family, source.family):
        require_family(env, NO_FINE_TUNING)
    assert isinstance(config.family, Family) and isinstance(source.family, Family)
    learner, family = dataclasses.replace(source.learner, tune="all"), config.family.scaled_as(source.family)
    return dataclasses.replace(config, learner=learner, family=family)


def _peel_parts(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --agent.KIND=NAME out of a command line, because each part adds flags of its own."""
    kinds = {f"--agent.{kind}": kind for kind in CHOICES}
    given, rest = split_flags(argv, kinds.__contains__, "a value")
    return {kinds[flag]: name for flag, name in given.items()}, rest


def _peel_shared(argv: Sequence[str], mixture: Mixture) -> tuple[dict[str, Any], list[str]]:
    """Take the flags that hold for every family of a mixture out of a command line, and read their values."""
    fields = {f.name: (f.type, getattr(family, f.name)) for family in mixture.families for f in shared_fields(family)}
    known = {family_flag(name): name for name in fields}
    known |= {switched_off(flag): name for flag, name in known.items()}
    given, words, rest = {}, [], []
    name = None
    for word in argv:
        if word.startswith("--"):
            flag, equals, value = word.partition("=")
            name = known.get(flag)
            if name is not None:
                kind, default = fields[name]
                given[name] = (name, kind, dataclasses.field(default=default))
                word = f"--{flag.removeprefix('--').rpartition('.')[2]}{equals}{value}"
        (rest if name is None else words).append(word)
    if not given:
        return {}, rest
    shared = dataclasses.make_dataclass("Shared", given.values(), frozen=True)
    return dataclasses.asdict(parse_with_tyro(shared, words, shared(), "python -m mtjax.train")), rest


def shared_fields(family: Family) -> list[dataclasses.Field]:
    """Return the fields of a family that are command-line flags."""
    return [field for field in dataclasses.fields(family) if field.name not in ("vary", "context_ranges")]


def family_flag(name: str) -> str:
    """Return the command-line flag of a family's field."""
    flag = name.replace("_", "-")
    return f"--{flag}" if flag in ("split", "engine") else f"--env.{flag}"


def flags(config: Any, prefix: str = "--") -> dict[str, bool]:
    """Return every flag of a configuration, and whether it is a switch."""
    found: dict[str, bool] = {}
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), field.name.replace("_", "-")
        if name in _NO_FLAGS:
            continue
        if name == "learner":
            found |= {f"--{flag}": isinstance(settings(value)[name], bool) for name, flag in flag_names(value).items()}
            continue
        if isinstance(value, Mixture):
            shared = {f.name: getattr(family, f.name) for family in value.families for f in shared_fields(family)}
            found |= {family_flag(each): isinstance(x, bool) for each, x in {"scenes": "", **shared}.items()}
            continue
        group = {"plan": "--", "training": "--", "family": "--env."}.get(field.name)
        if group is not None:
            found |= flags(value, group)
        else:
            name = "from" if name == "start" else name
            found[f"--{name}" if name in ("split", "engine") else f"{prefix}{name}"] = isinstance(value, bool)
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
