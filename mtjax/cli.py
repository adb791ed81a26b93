"""The command line: names first, then typed overrides of what the names stand for; and its record as JSON."""

import contextlib
import dataclasses
import importlib.util
import io
import itertools
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tyro

from mtjax.agents import AGENTS, settings
from mtjax.agents.base import CHOICES, flag_names
from mtjax.config import NO_FINE_TUNING, PRESETS, RunConfig, from_json, with_preset
from mtjax.envs import ENVS, Family, Mixture, make
from mtjax.envs.mixture import require_family
from mtjax.names import nearest_error
from mtjax.types import InputError

_VARY = "--env.vary."
_FAMILY_FLAGS = {"combine": "env.combine", "split": "split"}  # they decide which values are allowed
_DECIDING = ("conditioning", "vectors", "heads")  # which parts go together with the rest of an agent
P = TypeVar("P")


def parse(argv: Sequence[str]) -> RunConfig:
    """Read a command line: the names choose the defaults, the other flags change them.

    Raises:
        InputError: a name, flag or value cannot be used.
    """
    argv = import_files(argv)
    env_name = _peel(argv, "env", RunConfig.env)
    start = _peel(argv, "from", "")
    begun = from_json(Path(start) / "config.json") if start or "--from=" in argv else None
    if begun is not None and begun.points:
        raise InputError(f"--from takes a run of one setting, and {start!r} holds {len(begun.points)} of a sweep")
    agent_name = _peel(argv, "agent", RunConfig.agent if begun is None else begun.agent)
    preset_name = _peel(argv, "preset", RunConfig.preset)
    if preset_name not in PRESETS:
        raise nearest_error("preset", preset_name, PRESETS)
    vary, argv = _peel_vary(argv)
    chosen, argv = _peel_parts(argv)
    of_family: dict[str, Any] = {
        name: value for name in ("combine", "split") if (value := _peel(argv, _FAMILY_FLAGS[name], ""))
    }
    if "+" in env_name:
        of_family, argv = _peel_shared(argv, make(env_name))
    told = {name: value for name in _DECIDING if (value := _peel(argv, f"agent.{name}", ""))}
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
    for env in (config.family, begun.family):
        require_family(env, NO_FINE_TUNING)
    assert isinstance(config.family, Family) and isinstance(begun.family, Family)
    learner, family = dataclasses.replace(begun.learner, tune="all"), config.family.scaled_as(begun.family)
    return dataclasses.replace(config, start=start, learner=learner, family=family)


def _peel(argv: Sequence[str], name: str, default: str) -> str:
    """Find --name=VALUE or --name VALUE; the last one counts."""
    value = default
    for i, word in enumerate(argv):
        if word.startswith(f"--{name}="):
            value = word.split("=", 1)[1]
        elif word == f"--{name}":
            if i + 1 == len(argv):
                raise InputError(f"--{name} needs a value")
            value = argv[i + 1]
    return value


def import_files(argv: Sequence[str]) -> list[str]:
    """Run the FILE.py of every --import=FILE.py, which may register families; returns the other words.

    Raises:
        InputError: there is no such file.
    """
    for word in argv:
        if word.startswith("--import="):
            _import(Path(word.split("=", 1)[1]))
    return [word for word in argv if not word.startswith("--import=")]


def _import(path: Path) -> None:
    if not path.is_file() or path.suffix != ".py":
        raise InputError(f"--import needs a Python file, and {str(path)!r} is none")
    known = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    if any(file and Path(file).resolve() == path.resolve() for file in known):
        return
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def _peel_vary(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --env.vary.NAME=VALUES out of a command line: which names there are is the family's to say."""
    given, rest = _take(argv, lambda flag: flag.startswith(_VARY), "values; give lo:hi:n, lo:hi or a list a,b,c")
    return {flag.removeprefix(_VARY): value for flag, value in given.items()}, rest


def _peel_parts(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --agent.KIND=NAME out of a command line: the part decides which other flags there are."""
    kinds = {f"--agent.{kind}": kind for kind in CHOICES}
    given, rest = _take(argv, kinds.__contains__, "a value")
    return {kinds[flag]: name for flag, name in given.items()}, rest


def _peel_shared(argv: Sequence[str], mixture: Mixture) -> tuple[dict[str, Any], list[str]]:
    """Take the flags that hold for every family of a mixture out of a command line, and read their values."""
    fields = {f.name: (f.type, getattr(family, f.name)) for family in mixture.families for f in shared_fields(family)}
    known = {_family_flag(name): name for name in fields}
    known |= {_negated(flag): name for flag, name in known.items()}
    given, words, rest = {}, [], []
    name = None
    for word in argv:
        if word.startswith("--"):
            flag, equals, value = word.partition("=")
            name = known.get(flag.replace("_", "-"))
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
    """The fields of a family that are flags by themselves."""
    return [field for field in dataclasses.fields(family) if field.name not in ("vary", "context_ranges")]


def _family_flag(name: str) -> str:
    flag = name.replace("_", "-")
    return f"--{flag}" if flag in ("split", "engine") else f"--env.{flag}"


def _negated(flag: str) -> str:
    group, dot, name = flag.removeprefix("--").rpartition(".")
    return f"--{group}{dot}no-{name}"


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
        if isinstance(value, Mixture):
            shared = [f.name for family in value.families for f in shared_fields(family)]
            names += [_family_flag(each) for each in dict.fromkeys(shared)]
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
            error = nearest_error("flag", flag, known)
            raise InputError(str(error).split("choose from")[0] + "--help lists the flags")


def parse_with_tyro(cls: type[P], argv: Sequence[str], default: P, name: str) -> P:
    """Parse with tyro, whose framed error becomes one line.

    Raises:
        InputError: tyro refused the command line.
    """
    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            return tyro.cli(cls, args=list(argv), default=default, prog=name)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        message = re.sub(r"^Error parsing ((plan|training|family|learner): )?", "", _unframed(output.getvalue()))
        raise InputError(message or "the command line cannot be read; --help lists the flags") from None


def _unframed(text: str) -> str:
    """The lines between the first two rules of tyro's frame, which has no corners where output is not UTF-8."""
    is_rule = lambda line: line.startswith("╭") or not line.strip(" │─╰╯-")
    below = itertools.dropwhile(lambda line: not is_rule(line), text.splitlines())
    next(below, None)
    return " ".join(line.strip(" │") for line in itertools.takewhile(lambda line: not is_rule(line), below))


def catalogue() -> str:
    """List families and agents with the first sentence of their documentation."""
    first = lambda cls: (cls.__doc__ or "").split(".")[0].split(" (")[0].replace("\n", " ").split("  ")[0]
    lines = ["environments:"]
    for name, (family, _) in ENVS.items():
        tasks = make(name).train_count
        lines.append(f"  {name:36} {tasks:3} task{'s' if tasks > 1 else ' '}  {first(family)}")
    lines.append("agents:")
    return "\n".join(lines + [f"  {name:36} {preset.says}" for name, preset in AGENTS.items()])


def main(run: Any) -> None:
    """Run a program's entry point; what the user got wrong becomes a line and exit code 2."""
    try:
        run(sys.argv[1:])
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except OSError as error:
        print(f"error: {error.strerror or error}: {error.filename or ''}".rstrip(": "), file=sys.stderr)
        sys.exit(2)
