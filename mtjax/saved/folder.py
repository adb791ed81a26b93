"""The folder of a run, and its config.json: settings, versions, device and command."""

import contextlib
import dataclasses
import itertools
import json
import platform
import shlex
import textwrap
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

from mtjax import __version__
from mtjax.agents import settings
from mtjax.agents.choices import flag_names
from mtjax.config import RunConfig, from_json, import_flags, read_record, to_json
from mtjax.envs.family import Family
from mtjax.envs.mixtures import Mixture
from mtjax.envs.tabled import Tabled
from mtjax.names import notice, replacing
from mtjax.saved.arrays import require_place
from mtjax.types import InputError

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "orbax-checkpoint", "numpy")
_LONGEST = 80
_MOST_TOLD = 3


def new_directory(root: Path, name: str) -> Path:
    """Make a new folder called ``name`` and the time, and return it."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    if root.is_file():
        raise InputError(f"{str(root)!r} is a file, and runs need a folder; choose another place with --runs")
    require_place(root)
    try:
        root.mkdir(parents=True, exist_ok=True)
        for attempt in range(1000):
            directory = root / (f"{name}-{stamp}" + (f"-{attempt}" if attempt else ""))
            with contextlib.suppress(FileExistsError):
                directory.mkdir()
                return directory
    except OSError as error:
        fix = "choose another place with --runs"
        raise InputError(f"{str(root)!r} cannot take a run ({error.strerror}); {fix}") from None
    raise InputError(f"cannot find a new name for a run in {str(root)!r}")


def require_unused(directory: Path) -> None:
    """Raise InputError if a folder holds a run, or files of one, so that nothing is overwritten."""
    require_place(directory)
    held = [
        name for name in ("config.json", "metrics.csv", "evaluations.npz", "checkpoints") if (directory / name).exists()
    ]
    if directory.is_file() or held:
        holds = f"holds {held[0]} of a run already" if held else "is a file"
        raise InputError(f"{str(directory)!r} {holds}; give another directory, or resume=True to continue that run")


def remove_unused(directory: Path) -> None:
    """Remove the folder of a run that was refused before it began, so that it holds config.json alone."""
    if [file.name for file in directory.iterdir()] == ["config.json"]:
        (directory / "config.json").unlink()
        directory.rmdir()


def short_name(env_name: str) -> str:
    """Return an environment's name for folders and titles, shortened for mixtures of many families."""
    count = env_name.count("+") + 1
    return env_name if len(env_name) <= _LONGEST else f"mixture-of-{count}"


def resumed_config(config: RunConfig, directory: Path, argv: Sequence[str]) -> RunConfig:
    """Return the configuration of the run to resume, with the steps of ``--steps`` if that was given."""
    recorded = from_json(directory / "config.json")
    extended = any(word.split("=", 1)[0] == "--steps" for word in argv)
    steps = config.plan.steps if extended else recorded.plan.steps
    now: dict[str, Any] = {"plan": dataclasses.replace(recorded.plan, steps=steps)}
    now |= {"tensorboard": recorded.tensorboard or config.tensorboard, "wandb": config.wandb or recorded.wandb}
    return dataclasses.replace(recorded, **now, profile=config.profile, distributed=config.distributed)


def write_config(directory: Path, config: RunConfig) -> None:
    """Write config.json into the folder of a new run."""
    with replacing(directory / "config.json") as new:
        new.write_text(to_json(config, run_metadata(config)))


def record_steps(file: Path, steps: int) -> None:
    """Write the new number of steps into config.json, so that the next resume uses it too."""
    record = read_record(file)
    if record["plan"].get("steps") != steps:  # an edited record may lack it
        with replacing(file) as new:
            new.write_text(json.dumps(_with_steps(record, steps), indent=2) + "\n")


def _with_steps(record: Mapping[str, Any], steps: Any) -> dict[str, Any]:
    """Return a record of another number of steps, also in its command."""
    changed = {**record, "plan": {**record["plan"], "steps": steps}}
    if isinstance(record.get("command"), str):
        before = record["plan"].get("steps")
        changed["command"] = record["command"].replace(f" --steps={before} ", f" --steps={steps} ")
    return changed


def tell_edits(file: Path, copy: Path) -> None:
    """Warn if a run's config.json differs from the copy in its checkpoint by more than ``record_steps`` wrote.

    The warning names the entries. Runs of earlier versions have no copy.
    """
    if not copy.is_file() or not file.is_file():
        return
    try:
        now, then = read_record(file), read_record(copy)
    except InputError as error:
        return notice(f"{error}. So it is unknown whether {str(file)!r} was edited; it is used as it is")
    longer = _with_steps(then, now["plan"].get("steps"))
    values, before = _entries(now), _entries(longer if longer.get("command") == now.get("command") else then)
    names = [name for name in {**before, **values} if values.get(name) != before.get(name)]
    if not names:
        return
    short = lambda value: textwrap.shorten(json.dumps(value), _LONGEST)
    told = [f"{name} is {short(values.get(name))}, not {short(before.get(name))}" for name in names[:_MOST_TOLD]]
    told += [f"and {len(names) - _MOST_TOLD} more"] * (len(names) > _MOST_TOLD)
    notice(f"{str(file)!r} was edited or damaged, and is used as it is; unlike in {str(copy)!r}, {'; '.join(told)}")


def _entries(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a record by name, such as learner.actor_lr."""
    inner = lambda name, x: {f"{name}.{key}": each for key, each in x.items()} if isinstance(x, dict) else {name: x}
    return {name: value for outer, x in record.items() for name, value in inner(outer, x).items()}


def run_metadata(config: RunConfig) -> dict:
    """Return what else decides a run's results: engine, device and versions; and the command that repeats it."""
    versions = {"mtjax": __version__}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "engine": config.family.engine_name,
        "device": str(jax.devices()[0].device_kind),
        "python": platform.python_version(),
        "versions": versions,
        "command": shlex.join(["python", "-m", "mtjax.train", *to_flags(config)]),
    }


def to_flags(config: RunConfig) -> list[str]:
    """Return every setting as a flag, so that the command keeps its meaning when presets change."""
    words = [f"--env={config.env}", f"--agent={config.agent}", *import_flags(config)]
    words += [f"--from={config.start}"] if config.start else []
    words += ["--tensorboard"] * config.tensorboard + [f"--wandb={config.wandb}"] * bool(config.wandb)
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


def _family_settings(env: Tabled) -> dict[str, Any]:
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
