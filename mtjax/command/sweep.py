"""``python -m mtjax.train --sweep ...``: train every combination of settings, and write one table.

Real numbers of the agent are points of one program (``agents/swept.py``). Each combination of other settings is a
program of its own. A program that does not fit into memory is split into rounds (``memory.py``). Every program and
round is a run in the sweep's folder: ``run-1``, ``run-2`` and so on. A plain run in rounds is a sweep of one setting.
"""

import contextlib
import dataclasses
import itertools
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mtjax.agents import AGENTS, PARTS, swept
from mtjax.checks import amount
from mtjax.command.flags import flag_value
from mtjax.command.run_config import draft, parse
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import RunConfig
from mtjax.learning.evaluation import Evaluations
from mtjax.learning.populations import NO_INTERVAL
from mtjax.report.curve import draw
from mtjax.report.stats import seed_interval
from mtjax.saved import checkpoint, lock
from mtjax.saved.config_json import describe_stop, from_json, write_config
from mtjax.saved.folder import evaluations_of, new_directory, record_steps, resumed_config, short_name
from mtjax.saved.log import aligned, number, write_table
from mtjax.training import memory
from mtjax.training.journal import Hooks
from mtjax.training.launch import check, launch, load_start
from mtjax.types import SPLITS, InputError

_FIXED = ("seed", "seeds", "runs", "resume", "list", "import", "sweep", "from", "preset", "view")
_LONGEST = 100  # of a folder's name
_DIVERGED = "diverged.txt"  # holds the error of a run whose seeds all diverged


class Axis(NamedTuple):
    """One flag, without its dashes, and the values to try."""

    flag: str
    values: tuple[str, ...]

    @property
    def name(self) -> str:
        """Return its name in tables and records."""
        return self.flag.removeprefix("agent.")

    @property
    def setting(self) -> str:
        """Return the name of the agent's setting; an empty string for other flags."""
        return self.name.replace("-", "_") if self.flag != self.name else ""


# Reading the command line.


def is_sweep(argv: Sequence[str]) -> bool:
    """Return whether a command line starts or resumes a sweep."""
    names = [word.split("=", 1)[0] for word in argv]
    if "--sweep" in names and "--resume" in names:
        raise InputError("--resume goes on with a sweep as it was; leave out --sweep")
    resumed = flag_value(argv, "resume", "")
    return "--sweep" in names or bool(resumed and _run_folders(Path(resumed)))


def read_axes(argv: Sequence[str]) -> tuple[list[Axis], list[str]]:
    """Take ``--sweep FLAG=VALUE,VALUE ...`` out of a command line.

    Raises:
        InputError: a word is not a flag with values, or a sweep cannot vary that flag.
    """
    axes, rest, inside = {}, [], False
    for word in argv:
        if word.startswith("--"):
            inside = word == "--sweep" or word.startswith("--sweep=")
            word = word.removeprefix("--sweep").removeprefix("=") if inside else word
        if not inside:
            rest.append(word)
        elif word:
            axis = _axis(word)
            if axis.flag in axes:
                raise InputError(f"--sweep gives {axis.flag} twice; write its values in one list")
            axes[axis.flag] = axis
    if not axes:
        raise InputError("--sweep needs flags and values, such as agent.actor-lr=1e-4,1e-3")
    return list(axes.values()), rest


def _axis(word: str) -> Axis:
    flag, _, text = word.partition("=")
    flag, values = flag.replace("_", "-"), tuple(value.strip() for value in text.split(","))
    if not all(values):
        raise InputError(f"--sweep needs values, not {word!r}; write FLAG=VALUE,VALUE such as agent.actor-lr=1e-4,1e-3")
    if len({_as_number(value) for value in values}) < len(values):
        raise InputError(f"--sweep gives a value of {flag} twice: {text}")
    if flag in _FIXED:
        raise InputError(f"--sweep cannot vary {flag}; give --{flag} once" + (" for all" if flag != "sweep" else ""))
    return Axis(flag, values)


def _as_number(text: str) -> float | str:
    """Return a number of a text, such as 0.001 of 1e-3; other texts stay as they are."""
    try:
        return float(text)
    except ValueError:
        return text


def _is_agent_number(axis: Axis) -> bool:
    """Return whether an axis is a float of an agent or its parts, which can vary inside one program."""
    tables = [table.values() for kind, table in PARTS.items() if kind not in ("encoder", "experience")]
    classes = [*(preset.cls for preset in AGENTS.values()), *itertools.chain(*tables)]
    return any(f.name == axis.setting and f.type is float for cls in classes for f in dataclasses.fields(cls))


def _to_flags(flag: str, value: str) -> list[str]:
    """Return a flag and its value as words of a command line.

    "true" and "false" are values of switches. Spaces separate the values of a list.
    """
    if value.lower() in ("true", "false"):
        group, dot, name = flag.rpartition(".")
        return [f"--{group}{dot}{'' if value.lower() == 'true' else 'no-'}{name}"]
    first, *others = value.split()
    return [f"--{flag}", first, *others] if others else [f"--{flag}={value}"]


def configurations(argv: Sequence[str]) -> list[RunConfig]:
    """Return the configuration of every program of a sweep, with checked points, before memory splits them.

    Raises:
        InputError: a value is not allowed.
    """
    axes, rest = read_axes(argv)
    inside = [axis for axis in axes if _is_agent_number(axis)]
    outside = [axis for axis in axes if axis not in inside]
    found = []
    for values in itertools.product(*(axis.values for axis in outside)):
        chosen = [Axis(axis.flag, (value,)) for axis, value in zip(outside, values, strict=True)]
        config = draft([*rest, *itertools.chain(*(_to_flags(axis.flag, axis.values[0]) for axis in chosen))])
        sweep = tuple(f"{axis.flag}={','.join(axis.values)}" for axis in (*chosen, *inside))
        points_of_it = swept.grid({axis.setting: [_number(axis, x) for x in axis.values] for axis in inside})
        found.append(config.checked(sweep=sweep, points=points_of_it))
    return found


def _number(axis: Axis, text: str) -> float:
    number = _as_number(text)
    if isinstance(number, str):
        raise InputError(f"{axis.flag} is a number, and {text!r} is none")
    return number


# Running.


def main(argv: Sequence[str]) -> None:
    """Start the sweep of ``--sweep``, or resume the sweep in the folder of ``--resume``."""
    enable_compile_cache()
    if resumed := flag_value(argv, "resume", ""):
        resume = Path(resumed)
        with _locked(resume):
            for directory in _run_folders(resume):
                record_steps(directory / "config.json", resumed_config(parse(argv), directory, argv).plan.steps)
            run_unfinished(resume)
        return
    found = configurations(argv)
    for config in found:
        check(config, load_start(config))
    run_all(found, "sweep")


def run_all(found: Sequence[RunConfig], kind: str) -> None:
    """Make a folder with a run for every program and round, and train them all.

    Raises:
        InputError: a population does not fit into memory together.
    """
    limit = memory.available_bytes()
    split = [memory.split_to_fit(config, limit) for config in found]
    for config, parts in zip(found, split, strict=True):
        if config.plan.rule and len(parts) > 1:
            raise InputError(f"a population is one program: {memory.describe(config, len(parts), limit)}")
    folder = new_directory(Path(found[0].runs), _folder_name(found, kind))
    for i, config in enumerate(itertools.chain(*split)):
        (folder / f"run-{i + 1}").mkdir()
        write_config(folder / f"run-{i + 1}", config)
    for config, parts in zip(found, split, strict=True):
        print(memory.describe(config, len(parts), limit), flush=True)
    with _locked(folder):
        run_unfinished(folder)


def _folder_name(found: Sequence[RunConfig], kind: str) -> str:
    """Return a name with all environments and agents of a sweep, or their numbers if there are many."""
    envs, agents = (list(dict.fromkeys(x)) for x in ([short_name(c.env) for c in found], [c.agent for c in found]))
    name = f"{'+'.join(envs)}-{'+'.join(agents)}-{kind}"
    if len(name) <= _LONGEST:
        return name
    told = [x[0] if len(x) == 1 else f"{len(x)}-{what}" for x, what in ((envs, "environments"), (agents, "agents"))]
    return f"{'-'.join(told)}-{kind}"


def _run_folders(folder: Path) -> list[Path]:
    """Return the folders of a sweep's runs in order. A run of several points is a sweep by itself."""
    if (folder / "config.json").is_file():
        return [folder] if from_json(folder / "config.json").points else []
    runs = [path for path in folder.glob("run-*") if re.fullmatch(r"run-[0-9]+", path.name)]
    return sorted(runs, key=lambda run: int(run.name.removeprefix("run-")))


def _locked(folder: Path) -> contextlib.AbstractContextManager:
    """Hold the lock of a sweep's folder. A run of several points is locked while it trains."""
    return contextlib.nullcontext() if (folder / "config.json").is_file() else lock.hold(folder)


def run_unfinished(folder: Path) -> None:
    """Train all runs of a sweep that are not finished, and print the table of the whole sweep."""
    runs, told = _run_folders(folder), ""
    print(f"sweep: {folder}", flush=True)
    for i, run in enumerate(runs):
        config = from_json(run / "config.json")
        told = f"\n{NO_INTERVAL}" if config.plan.rule else told
        if final_evaluations(config, run) is not None or (run / _DIVERGED).exists():
            continue
        label, resume = f"run {i + 1} of {len(runs)}", checkpoint.newest(run / "checkpoints") is not None
        start = None if resume else load_start(config)
        signal = 0
        try:
            grow = lambda _: _write_table(folder, runs)
            result = launch(config, Hooks(run, start, resume, on_evaluation=grow, label=label))
            if result.finished:
                settings = [_values(config, point) for point in config.points or ({},)]
                labels = [", ".join(f"{name} {value}" for name, value in values.items()) for values in settings]
                draw(config, evaluations_of(config, run), run, labels)
            signal = 0 if result.finished and run == runs[-1] else result.signal
        except FloatingPointError as error:
            print(f"{label}: {error}", flush=True)
            (run / _DIVERGED).write_text(f"{error}\n")
        _write_table(folder, runs)
        if signal:
            print(table(rows(runs)), describe_stop(config, folder), sep="\n")
            sys.exit(128 + signal)
    print(f"{table(rows(runs))}{told}\nsweep: {folder}")


def _write_table(folder: Path, runs: Sequence[Path]) -> None:
    """Write the table of all settings anew, with the latest evaluations."""
    write_table(folder / "sweep.csv", rows(runs))


def final_evaluations(config: RunConfig, run: Path) -> Evaluations | None:
    """Return the evaluations of a finished run; None if it is not finished."""
    found = _latest_evaluations(config, run)
    return found if found and found.steps[-1] >= config.plan.steps else None


def _latest_evaluations(config: RunConfig, run: Path) -> Evaluations | None:
    """Return the evaluations of a run; None if it has none yet, or a damaged file, which the resumed run replaces.

    A file of another run is none either; the resumed run refuses it.
    """
    try:
        found = evaluations_of(config, run)
    except InputError:
        return None
    return found if len(found.steps) else None


# The table.


def rows(runs: Sequence[Path]) -> list[dict[str, Any]]:
    """Return a row for each setting: its runs, values, diverged seeds, and last evaluation of each split so far."""
    found: dict[tuple, list[_Part]] = {}
    for run in runs:
        config = from_json(run / "config.json")
        evaluations, points = _latest_evaluations(config, run), config.samples.points
        count = config.members // len(points)
        for p, point in enumerate(points):
            mine = slice(p * count, (p + 1) * count)
            returns = evaluations and {split: x[mine, -1] for split, x in evaluations.returns.items() if x.size}
            steps = int(evaluations.steps[-1]) if evaluations else 0
            part = _Part(run.name, p, count, (run / _DIVERGED).exists(), returns, steps, config.plan.population)
            found.setdefault(tuple(_values(config, point).items()), []).append(part)
    made = [_row(dict(values), parts) for values, parts in found.items()]
    columns = dict.fromkeys(name for row in made for name in row)
    return [{name: row.get(name, "") for name in columns} for row in made]


class _Part(NamedTuple):
    """The seeds of one setting in one run: all of them, or those of a round."""

    run: str
    number: int
    seeds: int
    diverged: bool
    returns: dict[str, np.ndarray] | None  # split -> (S, T, episodes) of the last evaluation
    steps: int  # of the last evaluation
    population: str = ""  # how its seeds give way to each other


def _row(values: dict[str, str], parts: list[_Part]) -> dict[str, Any]:
    row = {"run": " ".join(part.run for part in parts), "number": parts[0].number, **values}
    row |= {"seeds": sum(part.seeds for part in parts), "steps": min(part.steps for part in parts)}
    known = [part.returns for part in parts if part.returns is not None]
    lost = sum(part.seeds for part in parts if part.diverged)
    if lost:
        return row | {"diverged": lost}
    if len(known) < len(parts):
        return row
    scores = {split: np.concatenate([x[split] for x in known]) for split in known[0]}
    return row | (_scores_of_members if parts[0].population else _scores)(scores)


def _values(config: RunConfig, point: Mapping[str, float]) -> dict[str, str]:
    """Return the values of one setting, in the order of the sweep's flags; of a population all with which it began."""
    axes = [_axis(word) for word in config.sweep]
    return {x.name: f"{point[x.setting]:g}" if x.setting in point else " ".join(x.values) for x in axes}


def _scores(returns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return mean and interval over seeds of returns (S, T, episodes); NaN if a seed diverged."""
    diverged = max(int(np.sum(~np.isfinite(x).all(axis=(1, 2)))) for x in returns.values())
    found: dict[str, Any] = {"diverged": diverged}
    for split, x in returns.items():
        scores = seed_interval(x.mean(axis=-1)) if not diverged else (np.nan,) * 3
        found |= dict(zip((split, f"{split}_low", f"{split}_high"), map(number, scores), strict=True))
    return found


def _scores_of_members(returns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the mean of returns (S, T, episodes) over a population's members that go on. They have no interval."""
    known = np.isfinite(returns["train"]).all(axis=(1, 2))
    found: dict[str, Any] = {"diverged": int(np.sum(~known))}
    for split, x in returns.items():
        mean = x[known].mean() if known.any() else np.nan
        found |= {split: number(mean), f"{split}_low": "", f"{split}_high": ""}
    return found


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a sweep's rows as text: settings, then each split's mean return with its 95% interval over seeds."""
    splits = [split for split in SPLITS if split in rows[0]] or [SPLITS[0]]
    after = list(rows[0]).index("seeds")
    settings = [name for name in list(rows[0])[:after] if name != "number"]
    lines = [[*settings, *splits]]
    for row in rows:
        lines.append([*(str(row[name]) for name in settings), *(_cell(row, split) for split in splits)])
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in (row for row in rows if row.get("train")):
        groups.setdefault(row.get("env", ""), []).append(row)  # returns of different environments are no contest
    return "\n".join([*aligned(lines), *(_highest(env, own, settings) for env, own in groups.items() if len(own) > 1)])


def _highest(env: str, rows: Sequence[Mapping[str, Any]], settings: Sequence[str]) -> str:
    """Return a line on the setting with the highest return on the training tasks of an environment."""
    best = max(rows, key=lambda row: float(row["train"]))
    named = ", ".join(f"{name} {best[name]}" for name in settings if name not in ("run", "env"))
    of = f" of {env}" * bool(env)
    return f"highest on training tasks{of}: {named} ({best['run']}, number {best['number']})"


def _cell(row: Mapping[str, Any], split: str) -> str:
    if not row.get(split):
        return f"{row['diverged']} of {row['seeds']} seeds diverged" if row.get("diverged") else "-"
    told = lambda name: amount(float(row[name]))
    interval = f" [{told(f'{split}_low')}, {told(f'{split}_high')}]" if row[f"{split}_low"] else ""
    return f"{told(split)}{interval}"
