"""The command line: names first, then typed overrides of what the names stand for; and its record as JSON."""

import contextlib
import dataclasses
import importlib.util
import io
import itertools
import json
import re
import sys
import tomllib
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

import tyro

from mtjax.agents import AGENTS, PARTS, SAC, agent, settings
from mtjax.envs import ENVS, Family, make
from mtjax.loop import Settings
from mtjax.names import nearest_error
from mtjax.run import Plan
from mtjax.types import InputError

PRESETS = ("auto", "cpu", "gpu")
_VARY = "--env.vary."
_FAMILY_FLAGS = {"combine": "env.combine", "split": "split"}  # they decide which values are allowed
_DECIDING = ("conditioning", "vectors", "heads")  # which parts go together with the rest of an agent
P = TypeVar("P")


@dataclasses.dataclass(frozen=True)
class Program:
    """Train a multi-task agent: ``python -m mtjax.train --env=NAME --agent=NAME``."""

    env: str = "finger-spin-vary-size"
    """Name of the environment family; --list shows all. --import=FILE.py makes those known that a file registers."""
    agent: str = "sac-conditioned"
    """Name of the agent; --list shows all. Its parts: --agent.encoder, --agent.gradients, --agent.value,
    --agent.scaling and --agent.sampler, each by name and with flags of its own."""
    preset: Literal["auto", "cpu", "gpu"] = "auto"
    """Tuned defaults of the flags below for a kind of device; auto chooses by the device that JAX runs on."""
    runs: str = "runs"
    """Folder in which the run's own folder is made."""
    resume: str = ""
    """A run's folder to go on with; only --steps may be given beside it."""
    start: Annotated[str, tyro.conf.arg(name="from")] = ""
    """A run's folder whose agent to fine-tune on this environment's tasks. Agent and networks are the run's; rates of
    learning and --tune may be given. What every task has for itself begins as that of the run's nearest training task,
    and seeds beyond the run's begin with its first ones again."""
    sweep: tuple[str, ...] = ()
    """Train once for every combination of values: agent.actor-lr=1e-4,1e-3 agent.num-experts=2,4 and so on, flags
    without their dashes. The agent's numbers vary inside one program, beside the seeds; whatever else varies is one
    program after another. A table of all settings lies in the sweep's folder, whose name --resume takes too."""
    points: Annotated[tuple[dict[str, float], ...], tyro.conf.Suppress] = ()
    profile: bool = False
    """Leave a trace of one warm chunk, by JAX's profiler, in the run's folder."""
    distributed: bool = False
    """Run as one of several processes, each on devices of its own, that share the seeds. All are started with the same
    command: by SLURM's srun, Open MPI or Kubernetes, or with JAX_COORDINATOR_ADDRESS (host:port of process 0),
    JAX_NUM_PROCESSES and JAX_PROCESS_ID in the environment. They share the folder of --runs."""
    list: bool = False
    """Print the families and agents, and stop."""
    plan: Annotated[Plan, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Plan)
    training: Annotated[Settings, tyro.conf.arg(name="")] = dataclasses.field(default_factory=Settings)
    family: Annotated[Family, tyro.conf.arg(name="env")] = dataclasses.field(
        default_factory=lambda: make("finger-spin")
    )
    learner: Annotated[SAC, tyro.conf.arg(name="agent")] = dataclasses.field(default_factory=SAC)


def parse(argv: Sequence[str]) -> Program:
    """Read a command line: the names choose the defaults, the other flags change them.

    Raises:
        InputError: a name, flag or value cannot be used.
    """
    argv = import_files(argv)
    env_name = _peel(argv, "env", Program.env)
    start = _peel(argv, "from", "")
    begun = from_json(Path(start) / "config.json") if start or "--from=" in argv else None
    if begun is not None and begun.points:
        raise InputError(f"--from takes a run of one setting, and {start!r} holds {len(begun.points)} of a sweep")
    agent_name = _peel(argv, "agent", Program.agent if begun is None else begun.agent)
    preset_name = _peel(argv, "preset", Program.preset)
    if preset_name not in PRESETS:
        raise nearest_error("preset", preset_name, PRESETS)
    vary, argv = _peel_vary(argv)
    chosen, argv = _peel_parts(argv)
    of_family = {name: value for name in ("combine", "split") if (value := _peel(argv, _FAMILY_FLAGS[name], ""))}
    told = {name: value for name in _DECIDING if (value := _peel(argv, f"agent.{name}", ""))}
    default = with_preset(env_name, agent_name, preset_name, {**chosen, **told}, vary=vary, **of_family)
    if begun is not None:
        default = _fine_tuning(default, begun, start, chosen)
    _check_flags(argv, default)
    return parse_with_tyro(Program, argv, default, "python -m mtjax.train")


def _fine_tuning(program: Program, begun: Program, start: str, chosen: Mapping[str, str]) -> Program:
    """A program with the agent of a run, and tasks whose context is written as the run's."""
    had = {"agent": begun.agent, **settings(begun.learner)}
    for name, given in {"agent": program.agent, **chosen}.items():
        if given != had[name]:
            raise InputError(f"--from goes on with the run's {name}, {had[name]}, not with {given}; leave it out")
    learner, family = dataclasses.replace(begun.learner, tune="all"), program.family.scaled_as(begun.family)
    return dataclasses.replace(program, start=start, learner=learner, family=family)


def with_preset(
    env_name: str,
    agent_name: str,
    preset_name: str = "auto",
    agent_settings: Mapping[str, str] = MappingProxyType({}),
    **family_settings: Any,
) -> Program:
    """Return the program that a family and an agent, each with any settings of its own, and a preset stand for.

    Raises:
        InputError: a name or setting is unknown.
    """
    family = make(env_name, **family_settings)
    preset = load_preset(env_name, _device_preset() if preset_name == "auto" else preset_name)
    of_agent = preset.get("agent", {}) | preset.get(agent_name, {})
    return Program(
        env=env_name,
        agent=agent_name,
        preset=preset_name,  # type: ignore
        plan=Plan(**preset.get("plan", {})),
        training=Settings(**preset.get("training", {})),
        family=family,
        learner=agent(agent_name, **{**of_agent, **agent_settings}),
    )


def load_preset(env_name: str, name: str) -> dict[str, Any]:
    """Read the tables of a preset: the family's own file, or the domain's, or the default one."""
    folder = resources.files("mtjax") / "configs"
    words = env_name.split("-")
    names = ["-".join(words[:n]) for n in range(len(words), 0, -1)]
    file = next((f for n in [*names, "default"] if (f := folder / f"{n}.toml").is_file()), None)
    assert file is not None, "the package lacks configs/default.toml"
    return tomllib.loads(file.read_text())[name]


def _device_preset() -> str:
    import jax

    return "cpu" if jax.default_backend() == "cpu" else "gpu"


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


def import_flag(family: Family) -> list[str]:
    """The flag that makes a family of the user's own known to another program; none for those of this package."""
    module = type(family).__module__
    file = getattr(sys.modules.get(module), "__file__", None)
    return [] if module.split(".")[0] == "mtjax" or file is None else [f"--import={Path(file).resolve()}"]


def _peel_vary(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --env.vary.NAME=VALUES out of a command line: which names there are is the family's to say."""
    given, rest = _take(argv, lambda flag: flag.startswith(_VARY), "values; give lo:hi:n, lo:hi or a list a,b,c")
    return {flag.removeprefix(_VARY): value for flag, value in given.items()}, rest


def _peel_parts(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --agent.KIND=NAME out of a command line: the part decides which other flags there are."""
    kinds = {f"--agent.{kind}": kind for kind in PARTS}
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


def flags(program: Any, prefix: str = "--") -> list[str]:
    """Every flag of a program."""
    names = []
    for field in dataclasses.fields(program):
        value, name = getattr(program, field.name), field.name.replace("_", "-")
        if name in ("vary", "context-ranges", "points"):  # a flag for each parameter, taken out before; and no flags
            continue
        if name == "learner":
            names += [f"--agent.{setting.replace('_', '-')}" for setting in settings(value) if setting != "tune"]
            names.append("--tune")
            continue
        group = {"plan": "--", "training": "--", "family": "--env."}.get(field.name)
        if group is not None:
            names += flags(value, group)
        else:
            name = "from" if name == "start" else name
            names.append(f"--{name}" if name in ("split", "engine") else f"{prefix}{name}")
    return names


def _check_flags(argv: Sequence[str], program: Program) -> None:
    known = flags(program)
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


# The record of a run.


def to_json(program: Program, extra: dict[str, Any]) -> str:
    """Write everything a run is made of."""
    record = {**dataclasses.asdict(program), "learner": settings(program.learner)}
    return json.dumps({**record, **extra}, indent=2) + "\n"


def from_json(path: Path) -> Program:
    """Read the program of a run from its config.json.

    Raises:
        InputError: there is no such file, or it does not describe a run.
    """
    if not path.is_file():
        raise InputError(f"{str(path.parent)!r} is not a run: it has no config.json")
    try:
        record = json.loads(path.read_text())
        return Program(
            env=record["env"],
            agent=record["agent"],
            preset=record["preset"],
            runs=record["runs"],
            start=record.get("start", ""),
            sweep=tuple(record.get("sweep", ())),
            points=tuple(record.get("points", ())),
            plan=Plan(**record["plan"]),
            training=Settings(**record["training"]),
            family=make(record["env"], **record["family"]),
            learner=agent(record["agent"], **record["learner"]),
        )
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{str(path)!r} does not describe a run: {type(error).__name__}: {error}") from None


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
