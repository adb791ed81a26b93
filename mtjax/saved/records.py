"""The files of a run: metrics, evaluations and checkpoints, as it writes them and as a resumed run finds them."""

import contextlib
import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mtjax.learning.evaluation import Evaluations, load_evaluations, require_same_run, save_evaluations
from mtjax.learning.loop import TrainState
from mtjax.names import notice, replacing
from mtjax.parallel import hosts
from mtjax.saved import checkpoint, log
from mtjax.types import InputError


class Records:
    """Writes and reads the files in a run's folder. Only the first process writes, apart from checkpoints.

    Without a folder nothing is written, and nothing is found.
    """

    def __init__(self, directory: Path | None):
        self.directory = directory
        self.writes = directory is not None and hosts.is_first()
        self.checkpoints = Path() if directory is None else directory / "checkpoints"
        self.writer = None if directory is None else checkpoint.Writer(self.checkpoints)

    def resumes(self, resume: bool) -> int:
        """Return the iteration of the checkpoint to resume from, 0 if there is none. Every process must call this.

        Raises:
            InputError: there is one, and the run is not to be resumed.
        """
        newest = None if self.directory is None else checkpoint.newest(self.checkpoints)
        iteration = hosts.largest(0 if newest is None else int(newest.name))
        if iteration and not resume:
            raise InputError(f"{str(self.directory)!r} holds a run; resume it, or choose another folder")
        if self.writes:
            checkpoint.remove_unfinished(self.checkpoints)
        return iteration

    def restore(self, shapes: TrainState) -> TrainState:
        """Return the state of the newest whole checkpoint. Damaged ones after it are renamed."""
        state = checkpoint.load(self.checkpoints, shapes)
        if self.writes:
            checkpoint.set_aside(self.checkpoints, int(state.iteration))
        return state

    def earlier_seconds(self, iteration: int, *form: Any) -> tuple[float, float]:
        """Return the seconds of training and of the wall clock up to an iteration, and drop the lines after it.

        Args:
            form: what ``log.truncate_rows`` is told of the lines.
        """
        return log.truncate_rows(self._path("metrics.csv"), iteration, *form) if self.writes else (0.0, 0.0)

    def last_iteration(self) -> int:
        """Return the iteration of the last row of metrics; 0 if there is none."""
        return log.last_iteration(self._path("metrics.csv")) if self.writes else 0

    def earlier_evaluations(self, steps: int, due: bool, empty: Evaluations) -> Evaluations:
        """Return the evaluations up to a step.

        Args:
            due: whether there should be any.
            empty: those of a run that has none. It is also returned where a file cannot be read, which is renamed.

        Raises:
            InputError: they are of other tasks or seeds.
        """
        if not steps or self.directory is None:
            return empty
        file = self._path("evaluations.npz")
        if not file.exists():
            if due:
                notice(f"{str(file)!r} is missing; the run goes on without its earlier evaluations")
            return empty
        try:
            past = load_evaluations(file)
        except InputError as error:
            aside = file.with_suffix(".damaged.npz")
            if self.writes:
                file.replace(aside)
            notice(f"{error}; the run goes on without its earlier evaluations, and the file is kept as {aside.name!r}")
            return empty
        try:
            require_same_run(file, past, empty)
        except InputError as error:
            raise InputError(f"{error}; move it away to go on") from None
        kept = past.steps <= steps
        upto = lambda splits: {split: x[:, kept] for split, x in splits.items()}
        metrics = {name: upto(splits) for name, splits in past.metrics.items()}
        return empty._replace(steps=past.steps[kept], returns=upto(past.returns), metrics=metrics)

    def add_rows(self, rows: list[dict[str, Any]]) -> None:
        """Append rows to metrics.csv."""
        if self.writes:
            log.append_rows(self._path("metrics.csv"), rows)

    def add_history(self, rows: list[dict[str, Any]]) -> None:
        """Append the rows of a selection to population.csv."""
        if self.writes:
            log.append_rows(self._path("population.csv"), rows)

    def keep_history(self, steps: int) -> None:
        """Drop the rows of population.csv after a step, because a resumed run writes them again."""
        if self.writes and self._path("population.csv").exists():
            log.keep_steps(self._path("population.csv"), steps)

    def save_evaluations(self, evaluations: Evaluations) -> None:
        """Write all evaluations."""
        if self.writes:
            save_evaluations(self._path("evaluations.npz"), evaluations)

    def save(self, state: TrainState) -> None:
        """Begin to write a checkpoint. Errors are raised here, by ``check`` or by ``wait``."""
        if self.writer is not None:
            self.writer.save(state)

    def check(self) -> None:
        """Check that the run can go on in its folder. A config.json that is gone is written again.

        Raises:
            OSError: the folder is gone, or a checkpoint could not be written.
        """
        if self.writes:
            self._keep_config()
        if self.writer is not None and self.writer.pending is not None and self.writer.pending.done():
            self.writer.wait()

    def _keep_config(self) -> None:
        assert self.directory is not None and self.writer is not None
        if not self.directory.is_dir():
            raise OSError(errno.ENOENT, "the run's folder was removed while it ran", str(self.directory))
        file, record = self.directory / "config.json", self.writer.record
        if record is not None and not file.exists():
            with replacing(file) as new:
                new.write_bytes(record)
            notice(f"{str(file)!r} was removed while the run went on, and is written again")

    def wait(self) -> None:
        """Wait until the last checkpoint is written."""
        if self.writer is not None:
            self.writer.wait()

    @contextlib.contextmanager
    def closing(self) -> Iterator[None]:
        """Wait at the end until the last checkpoint is written, whatever the end was."""
        try:
            yield
        except BaseException:
            with contextlib.suppress(OSError):  # the first error is the one to tell
                self.wait()
            raise
        self.wait()

    def last(self) -> str:
        """Return a clause that names the last checkpoint."""
        with contextlib.suppress(OSError):
            self.wait()
        newest = None if self.directory is None else checkpoint.newest(self.checkpoints)
        return "there is no checkpoint from before it" if newest is None else f"the last checkpoint is {str(newest)!r}"

    def _path(self, name: str) -> Path:
        assert self.directory is not None
        return self.directory / name
