"""``python -m mtjax.train --search=N --agent.NAME=LOW..HIGH``: find good numbers of an agent, and write one table.

Each round of trials is the axis of points of one program (``agents/swept.py``), and each rung of it a run in the
search's folder: ``run-1``, ``run-2`` and so on. ``training/search.py`` asks for trials and ends them.
"""

import contextlib
import dataclasses
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtjax.agents import swept
from mtjax.agents.hyperparameters import flag_names
from mtjax.checks import amount, require_library
from mtjax.command.flags import flag_value, last_given, split_flags
from mtjax.command.run_config import draft, parse
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import RunConfig
from mtjax.saved import checkpoint, lock, survivors
from mtjax.saved.config_json import describe_stop, from_json, import_flags, write_config
from mtjax.saved.folder import evaluations_of, new_directory, short_name
from mtjax.saved.log import aligned, number, write_table
from mtjax.training import memory
from mtjax.training import search as searching
from mtjax.training.journal import Hooks
from mtjax.training.launch import check, launch, load_start
from mtjax.training.search import Search, Trial
from mtjax.types import InputError

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER})\.\.({_NUMBER})")
_OWN_FLAGS = ("--search", "--search-batch", "--search-rungs")
_NOT_WITH = ("sweep", "population", "distributed")
_ROUNDS = 4
_LEAST_EVALUATIONS = 4
_SHOWN = 10  # trials of the table on the console

# Reading the command line.


def is_search(argv: Sequence[str]) -> bool:
    """Return whether a command line starts or resumes a search.

    Raises:
        InputError: there is a range and no ``--search``.
    """
    names = [word.split("=", 1)[0] for word in argv]
    if "--search" in names:
        return True
    ranges, _ = read_ranges(argv)
    if ranges:
        flag = next(iter(ranges))
        raise InputError(f"--{flag} has a range, and a run takes one value; --search=20 looks for a good one")
    resumed = flag_value(argv, "resume", "")
    return bool(resumed) and (Path(resumed) / searching.FILE).is_file()


def read_ranges(argv: Sequence[str]) -> tuple[dict[str, tuple[float, float]], list[str]]:
    """Take flags with values LOW..HIGH out of a command line.

    Returns:
        flags without their dashes, with their ranges; and the other words.

    Raises:
        InputError: a range has no inside, or a flag has two.
    """
    found, rest = {}, list[str]()
    for word in argv:
        flag, equals, value = word.partition("=")
        ends = _RANGE.fullmatch(value or word)
        if ends is None:
            rest.append(word)
            continue
        flag = flag if equals else rest.pop() if rest and "=" not in rest[-1] else ""
        low, high = map(float, ends.groups())
        if not flag.startswith("--"):
            raise InputError(f"{word!r} belongs to no flag; write --agent.NAME=LOW..HIGH")
        flag = flag.removeprefix("--").replace("_", "-")
        if not low < high:
            raise InputError(f"--{flag} needs a range LOW..HIGH whose end is above its beginning, not {ends[0]}")
        if flag in found:
            raise InputError(f"--{flag} has two ranges; give one")
        found[flag] = (low, high)
    return found, rest


def parse_search(argv: Sequence[str]) -> tuple[RunConfig, Search]:
    """Return the configuration of one setting, and the search around it, before memory limits its rounds.

    Raises:
        InputError: a value is not allowed.
    """
    ranges, rest = read_ranges(argv)
    config = draft(rest)
    _require_alone(config)
    if not ranges:
        raise InputError("--search needs ranges of the agent's numbers, such as --agent.actor-lr=1e-5..1e-2")
    count, batch = config.search, config.search_batch or -(-config.search // _ROUNDS)
    if count < 2 or not 1 <= batch <= count:
        raise InputError(f"--search={count} needs two trials or more, and --search-batch from 1 to as many: {batch}")
    if config.search_rungs < 1:
        raise InputError(f"--search-rungs must be at least 1, which is the end, not {config.search_rungs}")
    names = {flag: name for name, flag in flag_names(config.learner).items()}
    preset = swept.sweepable(config.learner)
    wrong = next((flag for flag in ranges if names.get(flag) not in preset), None)
    if wrong is not None:
        raise InputError(f"--search looks for real numbers of the agent, and --{wrong} is none; --sweep takes others")
    own = {names[flag]: ends for flag, ends in ranges.items()}
    for ends in zip(*own.values(), strict=True):
        swept.agent_at(config.learner, dict(zip(own, ends, strict=True)))
    config, rungs = _with_rungs(config, batch, config.search_rungs)
    _, words = split_flags(rest, _OWN_FLAGS.__contains__, "a number")
    chosen = {name: preset[name] for name in own}
    return config, Search(own, chosen, count, batch, rungs, config.plan.seed, tuple(words))


def _require_alone(config: RunConfig) -> None:
    """Refuse what does not go with a search."""
    given = {"sweep": config.sweep, "population": config.plan.population, "distributed": config.distributed}
    wrong = next((name for name in _NOT_WITH if given[name]), None)
    if wrong is not None:
        raise InputError(f"--search and --{wrong} do not go together; leave one of them out")
    if config.learner.experience.host_slots(config.training.num_envs):
        raise InputError("--search keeps its replays on the device; leave out --host-replay-size")


def _with_rungs(config: RunConfig, batch: int, most: int) -> tuple[RunConfig, tuple[int, ...]]:
    """Return the configuration of every trial, with an evaluation at each of at most so many rungs, and the rungs."""
    plan, training = config.plan, config.training
    if not plan.eval_every:
        parts = max(2 ** (min(most, batch.bit_length()) - 1), _LEAST_EVALUATIONS)
        plan = dataclasses.replace(plan, eval_every=-(-plan.steps // parts))
    shortest = max(plan.interval // config.worlds, config.learner.experience.steps)
    training = dataclasses.replace(training, chunk_steps=min(training.chunk_steps, shortest))
    plain = dataclasses.replace(
        config, plan=plan, training=training, search=0, search_batch=0, search_rungs=RunConfig.search_rungs
    )
    return plain, searching.rungs(plan.steps, batch, max(plan.interval, plain.steps_per_chunk), most)


# Running.


def main(argv: Sequence[str]) -> None:
    """Start the search of ``--search``, or resume the one in the folder of ``--resume``."""
    enable_compile_cache()
    if resume := flag_value(argv, "resume", ""):
        if any(word.split("=", 1)[0] == "--steps" for word in argv):
            raise InputError("the trials of a search are as long as they were; leave out --steps")
        parse(argv)  # which imports the user's own files
        return _go_on(Path(resume))
    config, search = parse_search(argv)
    require_library("optuna", "--search")
    check(config.checked(points=(dict(search.preset),)), load_start(config))
    search = _fitting(config, search)
    folder = new_directory(Path(config.runs), f"{short_name(config.env)}-{config.agent}-search")
    search = searching.ask(search)
    (folder / "run-1").mkdir()
    write_config(folder / "run-1", _of_rung(config, search))
    searching.write(folder, search)
    _go_on(folder)


def _fitting(config: RunConfig, search: Search) -> Search:
    """Return the search with rounds that fit into memory."""
    many = dataclasses.replace(config, points=(dict(search.preset),) * search.batch)
    largest = min(len(part.points) for part in memory.split_to_fit(many, memory.available_bytes()))
    if largest == search.batch:
        return search
    print(f"memory holds {_trials(largest)} at a time, so a round has no more", flush=True)
    config, rungs = _with_rungs(config, largest, len(search.rungs))
    return dataclasses.replace(search, batch=largest, rungs=rungs)


def _of_rung(config: RunConfig, search: Search) -> RunConfig:
    """Return the configuration of the running trials."""
    points = tuple(trial.values for trial in search.running)
    return dataclasses.replace(config, points=points, sweep=swept.words(config.learner, points))


def _go_on(folder: Path) -> None:
    """Train all that is not finished, and print the table."""
    config = from_json(folder / "run-1" / "config.json")
    with lock.hold(folder):
        search = searching.read(folder)
        print(f"search: {folder}\n{_describe(search)}", flush=True)
        while search.running or len(search.trials) < search.count:
            search = search if search.running else searching.ask(search)
            searching.write(folder, search)
            search = _climb(folder, config, search)
            searching.write(folder, search)
            write_table(folder / "search.csv", _rows(search))
    print("\n".join([*_table(search), *_conclusion(search, folder, import_flags(config))]))


def _describe(search: Search) -> str:
    rounds = -(-search.count // search.batch)
    begin = "begins with the preset's values" if search.trials[0].values == search.preset else "leaves out the preset"
    rungs = ", ".join(f"{steps:,}" for steps in search.rungs)
    return (
        f"{search.count} trials in {rounds} round{'s' * (rounds > 1)}; it {begin}; half of a round ends at each of "
        f"{rungs} steps"
    )


def _trials(count: int) -> str:
    return f"{count} trial{'s' * (count != 1)}"


def _climb(folder: Path, config: RunConfig, search: Search) -> Search:
    """Train the running trials up to their next rung, and return the search after it."""
    run, parent = (folder / f"run-{_run_number(search) - i}" for i in (0, 1))
    rung, now = search.rung, _of_rung(config, search)
    if search.rung and not run.is_dir():
        survivors.write(parent, run, now, _members(search, config.plan.seeds))
    if not (run / "config.json").exists():
        run.mkdir(exist_ok=True)
        write_config(run, now)
    end, checkpoints = search.rungs[rung], run / "checkpoints"
    label = f"round {search.round}, rung {rung + 1} of {len(search.rungs)}: {_trials(len(search.running))}"
    newest = checkpoint.newest(checkpoints)
    if newest is None or int(newest.name) * now.worlds < end:
        try:
            stop = lambda row: row["steps"] >= end
            result = launch(now, Hooks(run, load_start(now), newest is not None, stop, label=label))
        except FloatingPointError as error:
            print(f"{label}: {error}", flush=True)
            return searching.climb(search, [np.nan] * len(search.running), run.name)
        if result.signal:
            print(describe_stop(config, folder))
            sys.exit(128 + result.signal)
    returns = evaluations_of(now, run).returns["train"][:, -1]
    of_trials = returns.reshape(len(search.running), -1).mean(axis=1, dtype=np.float64)
    return searching.climb(search, of_trials.tolist(), run.name)


def _run_number(search: Search) -> int:
    """Return the number of the run that takes the running trials to their next rung."""
    return (search.round - 1) * len(search.rungs) + search.rung + 1


def _members(search: Search, seeds: int) -> list[int]:
    """Return the entries of S that go on, in the run of the rung before."""
    return [trial.point * seeds + seed for trial in search.running for seed in range(seeds)]


# The table.


def _rows(search: Search) -> list[dict[str, Any]]:
    """Return a row for each trial, the longest and best first."""
    order = sorted(search.trials, key=lambda trial: (-len(trial.returns), -searching.last_return(trial)))
    return [_row(trial) for trial in order]


def _row(trial: Trial) -> dict[str, Any]:
    values = {name.replace("_", "-"): f"{x:g}" for name, x in trial.values.items()}
    steps, value = list(trial.returns.items())[-1] if trial.returns else (0, np.nan)
    about = {"trial": trial.number, "round": trial.round, **values, "steps": steps, "return": number(value)}
    return about | {"state": trial.state, "run": trial.run, "point": trial.point}


def _table(search: Search) -> list[str]:
    """Return the lines of the best trials."""
    shown = [name for name in _rows(search)[0] if name not in ("run", "point")]
    rows = [{**row, "return": row["return"] and amount(float(row["return"]))} for row in _rows(search)]
    lines = [shown, *([str(row[name]) or "-" for name in shown] for row in rows[:_SHOWN])]
    return aligned(lines) + [f"{len(rows) - _SHOWN} more are in search.csv"] * (len(rows) > _SHOWN)


def _conclusion(search: Search, folder: Path, imports: Sequence[str]) -> list[str]:
    """Return lines on the best trial: how to train its values again, and how to score it."""
    best = search.best
    if best is None:
        return [f"no trial finished; all diverged. search: {folder}"]
    flags = [f"--agent.{name.replace('_', '-')}={x:g}" for name, x in best.values.items()]
    again = shlex.join(["python", "-m", "mtjax.train", *last_given([*search.words, *flags])])
    point = ["python", "-m", "mtjax.evaluate", f"--run={folder / best.run}", *imports, f"--point={best.point}"]
    told = "it was chosen by its returns, which therefore look too good: train it with other seeds"
    with contextlib.suppress(StopIteration):
        told = f"{_beside(next(trial for trial in search.trials if trial.values == search.preset), best)}. {told}"
    whole, share = len(search.trials) * search.rungs[-1], searching.taken(search)
    steps = f"trials took {share:,} steps a seed, {share / whole:.0%} of the {whole:,} that all to the end take"
    value = amount(searching.last_return(best))
    chosen = [f"best at the end: trial {best.number}, {value}. {told}", f"  {again}", f"score it: {shlex.join(point)}"]
    return [steps, *chosen, f"search: {folder}"]


def _beside(preset: Trial, best: Trial) -> str:
    """Return how the preset did, and whether the best trial at the end was below it."""
    told = f"the preset, trial {preset.number}: {amount(searching.last_return(preset))}"
    if preset.state == searching.GAVE_WAY:
        told += f" after {list(preset.returns)[-1]:,} steps, where it gave way"
    elif preset is not best:
        told += f", {preset.state}"
    if searching.last_return(preset) <= searching.last_return(best):
        return told
    return (
        f"{told}. That is above trial {best.number}: no gain over the preset is shown; --search-rungs=1 ends none early"
    )
