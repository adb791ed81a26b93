"""The command line of training: names first, then typed overrides of what the names stand for."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mtjax.agents import settings
from mtjax.agents.base import CHOICES, flag_names
from mtjax.commands import check_names, import_files, parse_with_tyro, unknown_flag, value_of
from mtjax.config import RunConfig, from_json, with_preset
from mtjax.names import InputError

_VARY = "--env.vary."
_FAMILY_FLAGS = {"combine": "env.combine", "split": "split"}  # they decide which values are allowed
_DECIDING = ("conditioning", "vectors", "heads")  # which parts go together with the rest of an agent


def parse(argv: Sequence[str]) -> RunConfig:
    """Read a command line: the names choose the defaults, the other flags change them.

    Raises:
        InputError: a name, flag or value cannot be used.
    """
    argv = import_files(argv)
    check_names(argv)
    env_name = value_of(argv, "env", RunConfig.env)
    start = value_of(argv, "from", "")
    begun = from_json(Path(start) / "config.json") if start or "--from=" in argv else None
    if begun is not None and begun.points:
        raise InputError(f"--from takes a run of one setting, and {start!r} holds {len(begun.points)} of a sweep")
    agent_name = value_of(argv, "agent", RunConfig.agent if begun is None else begun.agent)
    preset_name = value_of(argv, "preset", RunConfig.preset)
    vary, argv = _peel_vary(argv)
    chosen, argv = _peel_parts(argv)
    of_family = {name: value for name in ("combine", "split") if (value := value_of(argv, _FAMILY_FLAGS[name], ""))}
    told = {name: value for name in _DECIDING if (value := value_of(argv, f"agent.{name}", ""))}
    default = with_preset(env_name, agent_name, preset_name, {**chosen, **told}, vary=vary, **of_family)
    if begun is not None:
        default = _fine_tuning(default, begun, start, chosen)
    _check_flags(argv, default)
    return parse_with_tyro(RunConfig, argv, default, "python -m mtjax.train")


def _fine_tuning(config: RunConfig, begun: RunConfig, start: str, chosen: Mapping[str, str]) -> RunConfig:
    """A program with the agent of a run, and tasks whose context is written as the run's."""
    had = {"agent": begun.agent, **settings(begun.learner)}
    for name, given in {"agent": config.agent, **chosen}.items():
        if given != had[name]:
            raise InputError(f"--from goes on with the run's {name}, {had[name]}, not with {given}; leave it out")
    learner, family = dataclasses.replace(begun.learner, tune="all"), config.family.scaled_as(begun.family)
    return dataclasses.replace(config, start=start, learner=learner, family=family)


def _peel_vary(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --env.vary.NAME=VALUES out of a command line: which names there are is the family's to say."""
    given, rest = _take(argv, lambda flag: flag.startswith(_VARY), "values; give lo:hi:n, lo:hi or a list a,b,c")
    return {flag.removeprefix(_VARY): value for flag, value in given.items()}, rest


def _peel_parts(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --agent.KIND=NAME out of a command line: the part decides which other flags there are."""
    kinds = {f"--agent.{kind}": kind for kind in CHOICES}
    given, rest = _take(argv, kinds.__contains__, "a value")
    return {kinds[flag]: name for flag, name in given.items()}, rest


def _take(argv: Sequence[str], mine: Callable[[str], bool], needed: str) -> tuple[dict[str, str], list[str]]:
    """Part the flags that are ``mine``, with their values, from the other words of a command line."""
    given, rest, words = {}, [], iter(argv)
    for word in words:
        flag, equals, value = word.partition("=")
        if not mine(flag):
            rest.append(word)
            continue
        given[flag] = value if equals else next(words, "")
        if not given[flag]:
            raise InputError(f"{flag} needs {needed}")
    return given, rest


def flags(config: Any, prefix: str = "--") -> list[str]:
    """Every flag of a program."""
    names = []
    for field in dataclasses.fields(config):
        value, name = getattr(config, field.name), field.name.replace("_", "-")
        if name in ("vary", "context-ranges", "points"):  # a flag for each parameter, taken out before; and no flags
            continue
        if name == "learner":
            names += [f"--{flag}" for flag in flag_names(value).values()]
            continue
        group = {"plan": "--", "training": "--", "family": "--env."}.get(field.name)
        if group is not None:
            names += flags(value, group)
        else:
            name = "from" if name == "start" else name
            names.append(f"--{name}" if name in ("split", "engine") else f"{prefix}{name}")
    return names


def _check_flags(argv: Sequence[str], config: RunConfig) -> None:
    known = flags(config)
    known += [flag.replace("--", "--no-", 1) for flag in known]
    known += ["".join((*flag.rpartition(".")[:2], "no-", flag.rpartition(".")[2])) for flag in known if "." in flag]
    for word in argv:
        flag = word.split("=", 1)[0].replace("_", "-")
        if flag.startswith("--") and flag not in (*known, "--help"):
            raise unknown_flag(flag, known)
