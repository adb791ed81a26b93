"""The folder of a run, and its config.json: settings, versions, device and command."""

import contextlib
import dataclasses
import json
import re
import textwrap
import time
from collections import ChainMap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mtjax.agents import settings
from mtjax.checks import shown
from mtjax.config import RunConfig
from mtjax.learning.evaluation import Evaluations, load_evaluations, no_evaluations, require_same_run
from mtjax.names import SPLITS, notice, replacing
from mtjax.parallel import hosts
from mtjax.saved.arrays import require_place
from mtjax.saved.config_json import from_json, read_record, require_names, write_config
from mtjax.types import InputError

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


@hosts.by_first
def prepare(config: RunConfig, directory: Path, resume: bool) -> Path:
    """Make the folder of a new run with its config.json, or check that it holds the run to resume."""
    file = directory / "config.json"
    if resume:
        _require_same(config, from_json(file), directory)
        record_steps(file, config.plan.steps)
        return directory
    require_names(config)
    require_unused(directory)
    directory.mkdir(parents=True, exist_ok=True)
    write_config(directory, config)
    return directory


def _require_same(config: RunConfig, recorded: RunConfig, directory: Path) -> None:
    """Refuse to resume a run with other settings than it had, apart from its steps."""
    fields = lambda held: {field.name: getattr(held, field.name) for field in dataclasses.fields(held)}
    alone = lambda config: {"env": config.env, "agent": config.agent, "sweep": config.points}
    parts = lambda config: (config.family, config.training, config.plan)
    every = lambda config: {**alone(config), **settings(config.learner), **ChainMap(*map(fields, parts(config)))}
    now, then = ({**every(each), "steps": None} for each in (config, recorded))
    name = next((name for name in {**now, **then} if now.get(name) != then.get(name)), None)
    if name is not None:
        raise InputError(
            f"the run in {str(directory)!r} had {name}={shown(then.get(name))}, not {shown(now.get(name))}; "
            "resume it with the same, or start a new run in another directory"
        )


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
    plain = re.sub("[:/]", "-", env_name)  # of other packages' environments
    return plain if len(plain) <= _LONGEST else f"mixture-of-{count}"


def resumed_config(config: RunConfig, directory: Path, argv: Sequence[str]) -> RunConfig:
    """Return the configuration of the run to resume, with the steps of ``--steps`` if that was given."""
    recorded = from_json(directory / "config.json")
    extended = any(word.split("=", 1)[0] == "--steps" for word in argv)
    steps = config.plan.steps if extended else recorded.plan.steps
    now: dict[str, Any] = {"plan": dataclasses.replace(recorded.plan, steps=steps)}
    now |= {"tensorboard": recorded.tensorboard or config.tensorboard, "wandb": config.wandb or recorded.wandb}
    now |= {"trackio": config.trackio or recorded.trackio}
    now |= {"view": config.view, "profile": config.profile, "distributed": config.distributed}
    return recorded.checked(**now)


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
    value_of = lambda entries, name: entries.get(name, ...)  # None is a value too
    names = [name for name in {**before, **values} if value_of(values, name) != value_of(before, name)]
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


def evaluations_before(config: RunConfig) -> Evaluations:
    """Return the evaluations of a run that has not begun."""
    values = {split: config.family.task_values(split) for split in SPLITS}
    seeds = [*config.plan.all_seeds] * max(len(config.points), 1)
    return no_evaluations(seeds, values, config.plan.eval_episodes, config.training.trials)


def has_evaluations(directory: Path) -> bool:
    """Return whether a run's folder has evaluations that can be read."""
    try:
        return len(load_evaluations(directory / "evaluations.npz").steps) > 0
    except InputError:
        return False


def evaluations_of(config: RunConfig, directory: Path) -> Evaluations:
    """Read the evaluations of a run, given its configuration.

    Raises:
        InputError: the file is missing or damaged, or of another run.
    """
    file = directory / "evaluations.npz"
    found = load_evaluations(file)
    require_same_run(file, found, evaluations_before(config))
    return found
