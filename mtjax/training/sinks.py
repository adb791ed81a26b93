"""Metrics of a run for TensorBoard and Weights & Biases, beside metrics.csv. Each seed is a run of its own there."""

import re
from collections.abc import Mapping, Sequence
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


class WandB:
    """Logs to a project of Weights & Biases: one run for each seed, in a group of the folder's name."""

    def __init__(self, project: str, directory: Path, config: Mapping[str, Any]):
        self.module = require_library("wandb")
        self.project, self.directory, self.config, self.runs = project, directory, dict(config), {}

    def write(self, run: str, steps: int, values: Mapping[str, float]) -> None:
        """Log numbers of a seed."""
        if run not in self.runs:
            name = f"{self.directory.name}-{run}"
            self.runs[run] = self.module.init(
                project=self.project,
                group=self.directory.name,
                name=name,
                id=name.replace("/", "-")[-120:],
                resume="allow",
                dir=str(self.directory),
                config={**self.config, "run": run},
                reinit="create_new",
                settings=self.module.Settings(silent=True, console="off"),
            )
        self.runs[run].log(dict(values), step=steps)

    def close(self) -> None:
        """Finish the runs."""
        for run in self.runs.values():
            run.finish()


def open_sinks(
    directory: Path, tensorboard: bool, wandb: str, first_step: int, config: Mapping[str, Any]
) -> list[Sink]:
    """Return the sinks that a run asked for.

    Args:
        first_step: the step from which a resumed run goes on; 0 for a new run.

    Raises:
        InputError: a library is missing.
    """
    sinks: list[Sink] = [TensorBoard(directory, first_step)] if tensorboard else []
    return [*sinks, WandB(wandb, directory, config)] if wandb else sinks


def write_rows(sinks: Sequence[Sink], rows: Sequence[Mapping[str, Any]], names: Sequence[str]) -> None:
    """Write rows of metrics, one for each of the runs in ``names``, to every sink. Empty entries are left out.

    Those of tasks are in a group for each metric: ``return_3`` is ``return_by_task/3``.
    """
    grouped = lambda key: _OF_TASK.sub(r"\1_by_task/\2", key)
    for sink in sinks:
        for name, row in zip(names, rows, strict=True):
            numbers = {grouped(key): float(x) for key, x in row.items() if key not in _COUNTS and x != ""}
            sink.write(name, int(row["steps"]), numbers)
