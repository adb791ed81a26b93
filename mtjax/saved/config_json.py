"""What config.json holds: a run's configuration as JSON, and as the command that repeats it."""

import dataclasses
import itertools
import json
import platform
import shlex
from collections.abc import Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

from mtjax import __version__
from mtjax.agents import AGENTS, agent, preset_of, settings
from mtjax.agents.hyperparameters import flag_names, of_record, replace
from mtjax.checks import require_run, require_values
from mtjax.config import Plan, RunConfig
from mtjax.envs import ENVS, is_mixture, make
from mtjax.envs.family import Family
from mtjax.envs.mixtures import FamilyOrMixture, Mixture
from mtjax.learning.loop import Settings
from mtjax.names import is_imported, replacing
from mtjax.types import InputError

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")


def to_json(config: RunConfig, extra: dict[str, Any]) -> str:
    """Return the configuration, and the entries of ``extra``, as JSON."""
    record = {**dataclasses.asdict(config), "learner": settings(config.learner)}
    return json.dumps({**record, **extra}, indent=2) + "\n"


def from_json(path: Path, beside: Iterable[Path] = ()) -> RunConfig:
    """Read the configuration of a run from its config.json.

    Args:
        beside: folders of other runs that are read too, so that one error asks for the user's own files of all.

    Raises:
        InputError: there is no such file, or it does not describe a run.
    """
    require_run(path.parent)
    try:
        record = read_record(path)
    except InputError as error:
        raise InputError(f"{error}{_with_copy(path)}") from None
    try:
        return _from_record(record)
    except InputError as error:
        asked = _with_import(error, str(path.parent), record, beside)
        text = f"{str(path)!r}: {error}{_other_version(record)}" if asked is error else str(asked)
        raise InputError(text + _with_copy(path)) from None
    except Exception as error:  # whatever an edited record makes of the classes it is read into
        text = f"{str(path)!r} does not describe a run: {type(error).__name__}: {str(error)[:150]}"
        raise InputError(text + _other_version(record) + _with_copy(path)) from None


def write_config(directory: Path, config: RunConfig) -> None:
    """Write config.json into the folder of a new run."""
    with replacing(directory / "config.json") as new:
        new.write_text(to_json(config, run_metadata(config)))


def require_names(config: RunConfig) -> None:
    """Refuse a family or an agent that ``from_json`` would not make again from a recorded name.

    Raises:
        InputError: the configuration has such a one.
    """
    if not config.env:
        raise InputError("a run's folder needs an environment derived from Family and an agent from BaseAgent")
    record = json.loads(to_json(config, {}))
    try:
        again = _from_record(record)
    except InputError:
        again = None
    for kind, part in (("env", "family"), ("agent", "learner")):
        made = getattr(config, part)
        if made != getattr(again, part, None):
            name = type(made).__name__
            raise InputError(f"a run's folder needs a name for {name}: mtjax.register('my-{kind}', {name}) gives one")


def read_record(path: Path) -> dict[str, Any]:
    """Read what a config.json holds, whose entry "plan" holds entries too; the others may be anything.

    Raises:
        InputError: it cannot be read, or is not of this form.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{str(path)!r} does not describe a run: {type(error).__name__}: {error}") from None
    if not isinstance(record, dict) or not isinstance(record.get("plan"), dict):
        raise InputError(f"{str(path)!r} does not describe a run: it has no entry called plan")
    return record


def _from_record(record: Any) -> RunConfig:
    config = RunConfig(
        env=record["env"],
        agent=record["agent"],
        preset=record["preset"],
        runs=record["runs"],
        start=record.get("start", ""),
        sweep=tuple(record.get("sweep", ())),
        points=tuple(record.get("points", ())),
        teacher=record.get("teacher"),
        imports=_imports(record),
        tensorboard=record.get("tensorboard", False),
        wandb=record.get("wandb", ""),
        trackio=record.get("trackio", ""),
        plan=Plan(**record["plan"]),
        training=Settings(**record["training"]),
        learner=agent(record["agent"], **of_record(preset_of(record["agent"]).cls, record["learner"])),
        family=make(record["env"], **record["family"]),
    )
    require_values(config)
    if not all(isinstance(word, str) for word in config.sweep):
        raise InputError(f"sweep must be a list of texts, not {config.sweep}")
    for point in config.points:
        replace(config.learner, point)  # which checks the values
    return config


def _imports(record: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the user's own files that a run names. Its command holds them where no list does."""
    words = [word for word in shlex.split(str(record.get("command", ""))) if word.startswith("--import=")]
    return tuple(record.get("imports") or (word.removeprefix("--import=") for word in words))


def _with_import(error: InputError, run: str, record: Mapping[str, Any], beside: Iterable[Path]) -> InputError:
    """Return an error that asks for the user's own files, if a run needs some that are not imported.

    It also asks for those of the runs beside. They are never run because a run's record names them.
    """
    missing = lambda record: [file for file in _imports(record) if not is_imported(Path(file))]
    if mine := missing(record):
        others = [file for folder in beside for file in missing(read_record(folder / "config.json"))]
        flags = shlex.join(f"--import={file}" for file in dict.fromkeys([*mine, *others]))
        return InputError(f"{run!r} uses code of your own: add {flags} (in Python: import that file first)")
    env, name = str(record.get("env")), str(record.get("agent"))
    if (env not in ENVS and not is_mixture(env)) or name not in AGENTS:
        return InputError(f"{error}. If it is your own, give --import=FILE.py with the file that registers it")
    return error


def _with_copy(path: Path) -> str:
    """Return a clause that names the newest checkpoint's copy of a record if the record has changed since then."""
    copies = (file for file in path.parent.glob(f"checkpoints/*/{path.name}") if file.parent.name.isdecimal())
    newest = max(copies, key=lambda file: int(file.parent.name), default=path)
    return "" if newest.read_bytes() == path.read_bytes() else f"; {str(newest)!r} holds it as it was"


def _other_version(record: Any) -> str:
    """Return a clause if another version of mtjax wrote a record, else an empty string."""
    versions = record.get("versions") if isinstance(record, dict) else None
    wrote = versions.get("mtjax") if isinstance(versions, dict) else None
    return f" (mtjax {wrote} wrote it, and this is {__version__})" if wrote not in (None, __version__) else ""


# The command.


def import_flags(config: RunConfig) -> list[str]:
    """Return the --import flags that register the user's own families, agent and parts in another process."""
    return [f"--import={file}" for file in config.imports]


def describe_stop(config: RunConfig, folder: Path) -> str:
    """Return lines on how to go on with a run, sweep or search that was stopped."""
    words = shlex.join([f"--resume={folder}", *import_flags(config)])
    return f"stopped; the state is saved. Go on with:\n  python -m mtjax.train {words}"


def run_metadata(config: RunConfig) -> dict:
    """Return what else decides a run's results: engine, device and versions; and the command that repeats it."""
    versions = {"mtjax": __version__}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    words = to_flags(config)
    return {
        "engine": config.family.engine_name,
        "device": str(jax.devices()[0].device_kind),
        "python": platform.python_version(),
        "versions": versions,
        "command": shlex.join(["python", "-m", "mtjax.train", *words]),
    }


def to_flags(config: RunConfig) -> list[str]:
    """Return every setting as a flag, so that the command keeps its meaning when presets change."""
    words = [f"--env={config.env}", f"--agent={config.agent}", *import_flags(config)]
    words += [f"--from={config.start}"] if config.start else []
    words += ["--tensorboard"] * config.tensorboard + [f"--wandb={config.wandb}"] * bool(config.wandb)
    words += [f"--trackio={config.trackio}"] * bool(config.trackio)
    found = {"--": {**_fields(config.plan), **_fields(config.training)}, "--env.": _family_settings(config.family)}
    for prefix, items in found.items():
        words += itertools.chain(*(_flag(prefix, name.replace("_", "-"), value) for name, value in items.items()))
    names, values = flag_names(config.learner), settings(config.learner)
    for name, flag in names.items():
        group, dot, rest = flag.rpartition(".")
        words += _flag(f"--{group}{dot}", rest, values[name])
    return words + (["--sweep", *config.sweep] if config.sweep else [])


def _fields(family: Any) -> dict[str, Any]:
    return {field.name: getattr(family, field.name) for field in dataclasses.fields(family)}


def _family_settings(env: FamilyOrMixture) -> dict[str, Any]:
    """Return the settings of a family; of a mixture its own, its families' common ones and varied parameters."""
    if isinstance(env, Family):
        return _fields(env)
    each = {part.name: _fields(part.family) for part in env.parts}
    names = dict.fromkeys(name for own in each.values() for name in own)
    held = {name: [own[name] for own in each.values() if name in own] for name in names if name != "vary"}
    alike = {name: values[0] for name, values in held.items() if values.count(values[0]) == len(values)}
    vary = [(f"{name}.{parameter}", values) for name, own in each.items() for parameter, values in own["vary"]]
    own = {"scenes": env.scenes} if isinstance(env, Mixture) else {}
    return {"vary": tuple(vary), **own, **alike}


def _flag(prefix: str, name: str, value: object) -> list[str]:
    if name == "context-ranges":  # --from takes them from its run
        return []
    if name == "vary":
        return [f"{prefix}vary.{parameter}={values}" for parameter, values in value]  # type: ignore
    prefix = "--" if name in ("split", "engine") else prefix
    match value:
        case bool():
            return [f"{prefix}{name}" if value else f"{prefix}no-{name}"]
        case tuple():
            return [f"{prefix}{name}", *map(str, value)] if value else []
    return [f"{prefix}{name}={value}"] if value != "" else []
