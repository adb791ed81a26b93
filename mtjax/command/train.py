"""The command ``python -m mtjax.train``: start or resume a run, and print its folder and scores."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from mtjax.agents.unseen_tasks import describe_unseen
from mtjax.checks import require_port
from mtjax.command import live_page, search, sweep
from mtjax.command.run_config import parse
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import RunConfig
from mtjax.learning import populations
from mtjax.learning.evaluation import as_one_seed
from mtjax.parallel import hosts
from mtjax.progress import duration
from mtjax.report.curve import draw
from mtjax.report.tables import split_table
from mtjax.saved import checkpoint, lock
from mtjax.saved.config_json import describe_stop, import_flags, write_config
from mtjax.saved.folder import new_directory, record_steps, resumed_config, short_name
from mtjax.saved.result import Result
from mtjax.training import memory
from mtjax.training.journal import Hooks
from mtjax.training.launch import check, launch, load_start
from mtjax.types import InputError


def main(argv: Sequence[str]) -> None:
    """Start or resume a run, a sweep or a search."""
    if "--distributed" in argv:
        hosts.initialise()  # before anything looks at the devices
    paged = any(word.split("=", 1)[0] == "--view" for word in argv)
    live_page.require_none(paged and (search.is_search(argv) or sweep.is_sweep(argv)))
    if search.is_search(argv):
        return search.main(argv)
    if sweep.is_sweep(argv):
        if "--distributed" in argv:
            raise InputError("a sweep runs in one process; leave out --distributed")
        return sweep.main(argv)
    config = parse(argv)
    resume = any(word.split("=", 1)[0] == "--resume" for word in argv)
    directory = Path(config.resume) if resume else None
    if directory is not None:
        config = resumed_config(config, directory, argv)
    enable_compile_cache()
    begun = directory is not None and checkpoint.newest(directory / "checkpoints") is not None
    start = None if begun else load_start(config)
    check(config, start)
    if directory is None and memory.seeds_exceed_memory(config):
        live_page.require_none(config.view)
        return sweep.run_all([config], "rounds")
    directory = _prepare(config, directory)
    with live_page.page(config.view * hosts.is_first(), directory, import_flags(config)):
        result = launch(config, Hooks(directory, start, resume))
        if hosts.is_first():
            _conclude(config, result, directory)
    if result.signal and not result.finished:
        sys.exit(128 + result.signal)


@hosts.by_first
def _prepare(config: RunConfig, directory: Path | None) -> Path:
    """Make the folder of a new run with its config.json, or update the steps of a resumed run."""
    if config.view:
        require_port(config.view)
    if directory is not None:
        with lock.hold(directory):
            record_steps(directory / "config.json", config.plan.steps)
        return directory
    directory = new_directory(Path(config.runs), f"{short_name(config.env)}-{config.agent}")
    write_config(directory, config)
    return directory


def _conclude(config: RunConfig, result: Result, directory: Path) -> None:
    draw(config, result.evaluations, directory)
    if not result.finished:
        return print(describe_stop(config, directory))
    if len(result.evaluations.steps):
        found = as_one_seed(result.evaluations) if config.plan.rule else result.evaluations
        print(split_table(found, config.family.parts), *[populations.NO_INTERVAL] * bool(config.plan.rule), sep="\n")
        if told := describe_unseen(config.learner):
            print(f"unseen tasks: {told}")
    rest = max(result.total_seconds - result.compile_seconds - result.trained_seconds, 0)
    print(
        f"done in {duration(result.total_seconds)}: compiled in {duration(result.compile_seconds)}, trained in "
        f"{duration(result.trained_seconds)}, evaluated and saved in {duration(rest)}; run: {directory}"
    )
    words = [f"--run={directory}", *import_flags(config)]
    if config.plan.rule and len(result.evaluations.steps):
        words += [f"--point={populations.best(result.evaluations.returns['train'][:, -1])}"]
    films = any(part.family.films for part in config.family.parts)
    words += ["--video"] * films
    print(f"look at it: python -m mtjax.evaluate {shlex.join(words)}{'    # or --view: on a page' * films}")
