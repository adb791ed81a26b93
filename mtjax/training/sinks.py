"""Metrics of a run for TensorBoard, Weights & Biases and trackio, beside metrics.csv. Each seed is a run of its own."""

import contextlib
import contextvars
import io
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from mtjax.checks import require_library

_COUNTS = ("seed", "iteration", "steps")
_OF_TASK = re.compile(r"(\w+)_(\d+)")  # a column of metrics.csv that is of one task


class Sink(Protocol):
    """A sink takes numbers by name at a step."""

    def write(self, run: str, steps: int, values: Mapping[str, float]) -> None: ...
    def close(self) -> None: ...


class TensorBoard:
    """Writes event files, one folder for each seed: ``tensorboard --logdir DIRECTORY``."""

    def __init__(self, directory: Path, first_step: int):
        self.module = require_library("tensorboardX")
        self.directory, self.first_step, self.writers = directory / "tensorboard", first_step, {}

    def write(self, run: str, steps: int, values: Mapping[str, float]) -> None:
        """Append numbers of a seed."""
        if run not in self.writers:
            purge = self.first_step + 1 if self.first_step else None  # a resumed run writes later steps again
            self.writers[run] = self.module.SummaryWriter(str(self.directory / run), purge_step=purge)
        for name, value in values.items():
            self.writers[run].add_scalar(name, value, steps)
        self.writers[run].flush()

    def close(self) -> None:
        """Close the files."""
        for writer in self.writers.values():
            writer.close()


class SeedRuns:
    """Logs to a library that keeps runs: one for each seed, which ``begin`` opens by its name."""

    def __init__(self, begin: Callable[[str], Any]):
        self.begin, self.runs = begin, {}

    def write(self, run: str, steps: int, values: Mapping[str, float]) -> None:
        """Log numbers of a seed."""
        if run not in self.runs:
            with _silence():
                self.runs[run] = self.begin(run)
        self.runs[run].log(dict(values), step=steps)

    def close(self) -> None:
        """Finish the runs."""
        for run in self.runs.values():
            with _silence():
                run.finish()


def _silence() -> Any:
    """Return a context in which a library prints nothing on standard output, which has the run's progress."""
    return contextlib.redirect_stdout(io.StringIO())


def wandb_runs(project: str, directory: Path, config: Mapping[str, Any]) -> SeedRuns:
    """Return runs in a project of Weights & Biases, in a group of the folder's name."""
    module = require_library("wandb")

    def begin(run: str) -> Any:
        name = f"{directory.name}-{run}"
        return module.init(
            project=project,
            group=directory.name,
            name=name,
            id=name.replace("/", "-")[-120:],
            resume="allow",
            dir=str(directory),
            config={**config, "run": run},
            reinit="create_new",
            settings=module.Settings(silent=True, console="off"),
        )

    return SeedRuns(begin)


def trackio_runs(project: str, directory: Path, config: Mapping[str, Any]) -> SeedRuns:
    """Return runs in a project of trackio, in a group of the folder's name."""
    module = require_library("trackio")

    def begin(run: str) -> Any:
        settings = {"resume": "allow", "embed": False, "auto_log_gpu": False, "auto_log_cpu": False}
        settings |= {"group": directory.name, "config": {**config, "run": run}}
        opened = contextvars.Context()  # of its own, as one context has one run, and ends it when another begins
        return opened.run(partial(module.init, project, f"{directory.name}-{run}", **settings))

    return SeedRuns(begin)


def require_sinks(tensorboard: bool, wandb: str, trackio: str) -> None:
    """Check that the libraries of the sinks that a run asks for are installed.

    Raises:
        InputError: one is missing.
    """
    asked = {"tensorboardX": tensorboard, "wandb": wandb, "trackio": trackio}
    for module in (name for name, wanted in asked.items() if wanted):
        require_library(module)


def open_sinks(
    directory: Path, tensorboard: bool, wandb: str, trackio: str, first_step: int, config: Mapping[str, Any]
) -> list[Sink]:
    """Return the sinks that a run asked for.

    Args:
        first_step: the step from which a resumed run goes on; 0 for a new run.

    Raises:
        InputError: a library is missing.
    """
    sinks: list[Sink] = [TensorBoard(directory, first_step)] if tensorboard else []
    sinks += [wandb_runs(wandb, directory, config)] if wandb else []
    return sinks + ([trackio_runs(trackio, directory, config)] if trackio else [])


def write_rows(sinks: Sequence[Sink], rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    """Write rows of metrics, one for each of the runs in ``names``, to every sink. Empty entries are left out.

    Those of tasks are in a group for each metric: ``return_3`` is ``return_by_task/3``.
    """
    grouped = lambda key: _OF_TASK.sub(r"\1_by_task/\2", key)
    for sink in sinks:
        for name, row in zip(names, rows, strict=True):
            numbers = {grouped(key): float(x) for key, x in row.items() if key not in _COUNTS and x != ""}
            sink.write(name, int(row["steps"]), numbers)
