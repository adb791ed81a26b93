"""Progress of a run: its steps, the time that is left, returns and evaluations."""

import math
from collections.abc import Mapping

import numpy as np

from mtjax.checks import amount
from mtjax.learning import trials
from mtjax.progress import LONGEST, Display, duration

_SHARE = 1 / 3  # of a run under random actions from which a warning is due
_LINES = 50  # plain lines in a run


class Clock:
    """Estimates the seconds that a run still takes: chunks that learn, and evaluations with their checkpoints.

    Random actions are faster than learning, so that chunks of the warm-up tell nothing of those to come.
    """

    def __init__(self, chunks: int, evaluations: int, warmup: int = 0):
        self.chunks, self.evaluations = chunks, evaluations  # that are still to come
        self.warmup = warmup  # chunks, the first ones, in which some actions are random
        self.chunk_seconds: list[float] = []
        self.evaluation_seconds: list[float] = []

    def chunk(self, seconds: float) -> None:
        """Note a chunk."""
        self.chunks -= 1
        self.chunk_seconds.append(seconds)

    def evaluation(self, seconds: float) -> None:
        """Note an evaluation, without what it waited for its program."""
        self.evaluations -= 1
        self.evaluation_seconds.append(seconds)

    @property
    def left(self) -> str:
        """Return the time that is left as text: by the last ten chunks, and at least, while no evaluation is timed."""
        learning = self.chunk_seconds[self.warmup :]
        if self.chunks > 0 and not learning:
            return "warming up"
        each, score = (float(np.mean(x[-10:])) if x else 0.0 for x in (learning, self.evaluation_seconds))
        seconds = max(self.chunks, 0) * each + max(self.evaluations, 0) * score
        known = self.evaluation_seconds or self.evaluations <= 0
        return f"{duration(seconds)} left" if known else f"at least {duration(seconds)} left" if seconds else ""


class Console(Display):
    """Shows the progress of a run."""

    def __init__(self, total_steps: int, quiet: bool = False, label: str = "", clock: Clock | None = None):
        super().__init__(total_steps, quiet)
        self.label, self.clock = f"{label}  " if label else "", clock or Clock(0, 0)
        self.evaluated, self.shown = "", (0, -math.inf)  # steps and seconds of the last line

    def progress(self, steps: int, seconds: float, rate: float, returns: np.ndarray, running: str = "") -> None:
        """Show steps, rate, time left and returns.

        Args:
            seconds: since the start.
            rate: steps a second of all seeds.
            returns: (S, T) of this chunk's episodes, NaN where none ended.
            running: a text on the episodes that still run, shown if none has ended.
        """
        if self.quiet:
            return
        left = self.clock.left
        told = describe_returns(returns) or running or "no episode has ended"
        if self.bar is not None:  # whose end a narrow terminal cuts off, so that what matters most comes first
            text = f"{self.label}{told}  {left}  {steps:,} of {self.total:,}  {rate:,.0f} steps/s{self.evaluated}"
            self.doing(text, steps)
        elif self._is_due(steps, seconds):
            self.shown, when = (steps, seconds), f"{duration(seconds)}{', ' * bool(left)}{left}"
            self.say(f"{self.label}{steps:,} of {self.total:,} steps  {when}  {rate:,.0f} steps/s  {told}")

    def _is_due(self, steps: int, seconds: float) -> bool:
        """Return whether a plain line is due: the first, the last, and after a share of the run or some seconds."""
        before, then = self.shown
        return steps - before >= self.total / _LINES or seconds - then >= LONGEST or steps >= self.total

    def evaluation(
        self,
        steps: int,
        returns: Mapping[str, np.ndarray],
        success: Mapping[str, np.ndarray] | None = None,
        trial: int = 1,
    ) -> None:
        """Show an evaluation's mean return, worst task, and success at the end if tasks tell it.

        Of trials of several episodes, the mean return of the first and the last one is shown too.

        Args:
            returns: (S, T, episodes) by split.
            success: of the same shapes; NaN where a task does not tell it.
            trial: episodes of a trial.
        """
        shares = success or {}
        tell = lambda split, x: _of_split(split, x) + _of_trial(x, trial) + _share(shares.get(split))
        told = ", ".join(tell(split, x) for split, x in returns.items() if x.size)
        self.say(f"{self.label}evaluation at {steps:,} steps: {told}")
        means = ", ".join(f"{split} {amount(x.mean())}" for split, x in returns.items() if x.size)
        self.evaluated = f"  evaluated {means}"


def describe_returns(returns: np.ndarray) -> str:
    """Return the mean of returns (S, T), and those of the worst and the best task; empty if none is known."""
    known = np.isfinite(returns)
    if not known.any():
        return ""
    tasks = [np.mean(column[seen]) for column, seen in zip(returns.T, known.T, strict=True) if seen.any()]
    mean = f"return {amount(np.mean(returns[known]))}"
    if len(tasks) == 1:
        return mean
    return f"{mean} (worst task {amount(min(tasks))}, best {amount(max(tasks))})"


def describe_running(totals: np.ndarray, ages: np.ndarray, counted: np.ndarray, horizon: int) -> str:
    """Return a text on the returns so far of episodes that still run, leaves (S, T, E), if some began at age 0."""
    if not counted.any() or not ages[counted].any():
        return ""
    age = int(np.max(ages[counted]))
    return f"episodes still run: return {amount(np.mean(totals[counted]))} so far, at step {age:,} of {horizon:,}"


def describe_warmup(steps: int, total: int) -> list[str]:
    """Return lines on the random actions at the start of a run, which may be most of it."""
    if steps <= 0:
        return []
    lines = [f"random actions until step {steps:,}; learning begins there"]
    if steps > total * _SHARE:
        share = min(steps / total, 1)
        lines.append(
            f"warning: {share:.0%} of this run's {total:,} steps are random actions: "
            "give more --steps, or a lower --warmup-steps"
        )
    return lines


def describe_resumption(steps: int, total: int, again: int = 0) -> str:
    """Return a line on where a resumed run goes on, if it does, and on the steps that it has to play ``again``."""
    if steps >= total:
        return f"the run has made all its {steps:,} steps; --steps=N with a larger N goes on"
    lost = f"; the {again:,} steps that were made after it are lost, and are made again" if again else ""
    return f"goes on at step {steps:,} of {total:,}{lost}"


def describe_rounding(steps: int, total: int, chunk: int) -> list[str]:
    """Return a line if a run's steps are rounded up, to whole chunks of all worlds."""
    return [f"{steps:,} steps are rounded up to {total:,}, whole chunks of {chunk:,}"] if total > steps else []


def _of_split(split: str, returns: np.ndarray) -> str:
    worst = f" (worst task {amount(returns.mean(axis=(0, 2)).min())})" if returns.shape[1] > 1 else ""
    return f"{split} {amount(returns.mean())}{worst}"


def _of_trial(returns: np.ndarray, trial: int) -> str:
    told = trials.describe(returns, trial)
    return f" ({told})" * bool(told)


def _share(success: np.ndarray | None) -> str:
    known = np.zeros(0) if success is None else success[np.isfinite(success)]
    return f", success {known.mean():.2f}" if known.size else ""
