"""What a run prints, writes of its chunks and evaluations beside checkpoints, and whom it calls."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from mtjax.agents import settings as settings_of
from mtjax.config import RunConfig
from mtjax.learning.evaluation import Evaluations
from mtjax.learning.loop import TrainState
from mtjax.parallel import hosts
from mtjax.saved import log
from mtjax.saved.policy import Policy
from mtjax.saved.records import Records
from mtjax.training.console import (
    Clock,
    Console,
    describe_resumption,
    describe_rounding,
    describe_running,
    describe_warmup,
)
from mtjax.training.entries import Entries
from mtjax.training.sinks import Sink, open_sinks, write_rows

_WHEN = ("iteration", "steps", "seconds", "wall_seconds")  # columns of metrics.csv


class Hooks(NamedTuple):
    """What a run has beside its configuration: where it begins and is written, whom it calls, and what it prints."""

    directory: Path | None = None
    """An existing folder for metrics, evaluations and checkpoints, in which no other process writes; None for none."""
    start: Policy | tuple[Policy, ...] | None = None
    """The policy to fine-tune, or those that teach."""
    resume: bool = False
    """Continue from the newest whole checkpoint in ``directory``, or start over if there is none yet."""
    on_chunk: Callable[[dict[str, Any]], Any] | None = None
    on_evaluation: Callable[[Evaluations], None] | None = None
    quiet: bool = False
    label: str = ""
    """The first words of progress lines."""


NO_HOOKS = Hooks()


@dataclasses.dataclass(frozen=True)
class Journal:
    """Prints and writes what happens in a run."""

    config: RunConfig
    hooks: Hooks
    entries: Entries

    @cached_property
    def console(self) -> Console:
        total = self.config.length * self.config.worlds
        return Console(total, self.hooks.quiet or not hosts.is_first(), self.hooks.label)

    @cached_property
    def records(self) -> Records:
        return Records(self.hooks.directory)

    def introduce(self) -> None:
        """Say how many steps a new run takes, and what the first of them are."""
        config, total = self.config, self.console.total
        rounding = describe_rounding(config.plan.steps, total, config.steps_per_chunk)
        for line in (*rounding, *describe_warmup(config.warmup, total)):
            self.console.say(line)

    def begin(self, steps: int) -> None:
        """Begin to count the chunks and evaluations to come, in a run that is at a step; say so if it is resumed."""
        if steps:
            again = max(self.records.last_iteration() * self.config.worlds - steps, 0)
            self.console.say(describe_resumption(steps, self.console.total, again))
        self.console.clock = self._clock(steps)

    def _clock(self, steps: int) -> Clock:
        """Return a clock that counts the chunks and evaluations to come, however many there are."""
        chunk, every = self.config.steps_per_chunk, self.config.plan.interval
        count = max(-(-(self.console.total - steps) // chunk), 0)
        last = steps + (count - 1) * chunk  # where the last chunk begins
        evaluations = max(count - 1 if chunk >= every else last // every - steps // every, 0) + (count > 0)
        return Clock(count, evaluations, min(max(-(-(self.config.warmup - steps) // chunk), 0), count))

    @contextlib.contextmanager
    def sinks(self, steps: int) -> Iterator[list[Sink]]:
        """Open where metrics go beside metrics.csv, in a run that is at a step."""
        with contextlib.ExitStack() as opened:
            sinks: list[Sink] = []
            if self.records.writes:
                assert self.hooks.directory is not None
                config, agent = self.config, settings_of(self.config.trained)
                told = {**dataclasses.asdict(config.plan), **dataclasses.asdict(config.played), **agent}
                asked = config.tensorboard, config.wandb, config.trackio
                sinks = open_sinks(self.hooks.directory, *asked, steps, told)
            for sink in sinks:
                opened.callback(sink.close)
            yield sinks

    def columns(self, metrics: Any) -> list[str]:
        """Return the columns of metrics.csv, given the shapes of a chunk's metrics."""
        empty = jax.tree.map(lambda x: np.zeros(x.shape), metrics)
        first = log.metric_rows(empty, np.zeros(1), dict.fromkeys(_WHEN))[0]
        return list({"seed": 0, **self.entries.point(0), **first})

    def chunk(
        self, metrics: dict[str, Any], elapsed: float, now: Any, started: float, sinks: list[Sink]
    ) -> list[dict[str, Any]]:
        """Write the metrics of a chunk that took ``elapsed`` seconds, and return them: a row for each entry of S.

        Args:
            now: where the run is after it.
            started: the clock when the user began to wait.
        """
        passed = time.monotonic() - started
        iteration = now.steps // self.config.worlds
        when = (iteration, now.steps, f"{now.seconds:.3f}", f"{now.wall + passed:.3f}")
        lines = log.metric_rows(metrics, np.asarray(self.entries.seeds), dict(zip(_WHEN, when, strict=True)))
        numbers = self.entries.numbers(now.state)
        new = [{"seed": row["seed"], **numbers[k], **row} for k, row in enumerate(lines)]
        self.records.add_rows(new)
        write_rows(sinks, lines, self.entries.names)
        self.console.clock.chunk(elapsed)
        self._tell_lost(metrics["lost"])
        rate = self.config.steps_per_chunk * len(lines) / elapsed
        self.console.progress(now.steps, passed, rate, metrics["return"], self._running(now.state, metrics["return"]))
        return new

    def _tell_lost(self, lost: np.ndarray) -> None:
        """Print how many worlds (S, T) a chunk has lost, and their tasks. Print nothing if there are none."""
        if count := int(lost.sum()):
            tasks = ", ".join(map(str, np.flatnonzero(lost.sum(axis=0))))
            worlds = "1 world" if count == 1 else f"{count} worlds"
            self.console.say(f"{worlds} (task {tasks}) blew up; new episodes began there")

    def _running(self, state: TrainState, returns: np.ndarray) -> str:
        """Return a text on episodes that still run, if none has ended in a chunk with these returns (S, T)."""
        if np.isfinite(returns).any() or jax.process_count() > 1:
            return ""
        totals, ages, counted = jax.device_get((state.total, state.worlds.age, state.counted))
        return describe_running(totals, ages, counted, self.config.family.episode_length)

    def evaluation(self, evaluations: Evaluations, sinks: list[Sink]) -> None:
        """Write the last evaluation's means by split: of returns and of metrics, such as success, over their tasks."""
        scores = {"": evaluations.returns, **{f"/{name}": x for name, x in evaluations.metrics.items()}}
        last = {f"{split}{name}": x[:, -1] for name, of in scores.items() for split, x in of.items() if x.size}
        mean = lambda x: log.number(x[np.isfinite(x)].mean() if np.isfinite(x).any() else np.nan)
        rows = [{"steps": evaluations.steps[-1]} for _ in self.entries.seeds]
        rows = [row | {f"evaluation/{name}": mean(x[k]) for name, x in last.items()} for k, row in enumerate(rows)]
        write_rows(sinks, rows, self.entries.names)

    @contextlib.contextmanager
    def profiled(self, done: int, steps: int) -> Iterator[None]:
        """Trace the run's second, warm chunk, or its only one, if ``profile`` asks for it."""
        only = not done and steps + self.config.steps_per_chunk >= self.config.plan.steps
        if not (self.config.profile and self.records.writes and (done == 1 or only)):
            yield
            return
        place = self.hooks.directory / "profile"  # type: ignore
        with jax.profiler.trace(place):
            yield
        self.console.say(f"profile of one chunk: {place} (xprof --logdir={place}, or its *.trace.json.gz in Perfetto)")
