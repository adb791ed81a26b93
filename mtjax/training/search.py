"""A search for good numbers of an agent: trials that optuna asks for in batches, and halving that ends most of them.

A round asks for a batch of trials, which train as the points of one program. At every rung the better half goes on for
twice as many steps, as in successive halving (Jamieson and Talwalkar 2016). What is known of all trials is one value,
``Search``, and the next round follows from it alone: a search that was killed asks for the same trials again.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mtjax.checks import require_library
from mtjax.names import InputError, replacing

FILE = "search.json"
RUNNING, FINISHED, GAVE_WAY, DIVERGED = "running", "finished", "gave way", "diverged"
_LOGARITHMIC = 10  # a range whose end is so many times its beginning is searched by its logarithm
_RANDOM = 10  # trials at random before the first that learns from others, or one batch if that is fewer


class Trial(NamedTuple):
    """One setting, and what became of it."""

    number: int
    round: int  # counted from 1
    values: dict[str, float]
    returns: dict[int, float]  # steps of each rung -> mean return on training tasks
    state: str = RUNNING
    run: str = ""  # the folder of its last run
    point: int = 0  # its number among the points of that run


@dataclasses.dataclass(frozen=True)
class Search:
    """What a search looks for, and its trials so far."""

    ranges: Mapping[str, tuple[float, float]]
    preset: Mapping[str, float]
    """The values that the agent has without a search: the first trial, if they lie in the ranges."""
    count: int
    """Trials in all."""
    batch: int
    """Trials of a round."""
    rungs: tuple[int, ...]
    """Environment steps of each seed after which the better half goes on; the last is the end."""
    seed: int
    words: tuple[str, ...]
    """The command line without ranges, which trains one setting."""
    trials: tuple[Trial, ...] = ()

    @property
    def running(self) -> list[Trial]:
        """Return the trials of this round that go on."""
        return [trial for trial in self.trials if trial.state == RUNNING]

    @property
    def rung(self) -> int:
        """Return the number of the rung that the running trials climb, counted from 0."""
        return len(self.running[0].returns)

    @property
    def round(self) -> int:
        """Return the number of the last round, counted from 1; 0 before the first."""
        return self.trials[-1].round if self.trials else 0

    @property
    def best(self) -> Trial | None:
        """Return the finished trial with the highest return, or None."""
        finished = [trial for trial in self.trials if trial.state == FINISHED]
        return max(finished, key=last_return, default=None)


def rungs(steps: int, batch: int, interval: int, most: int) -> tuple[int, ...]:
    """Return the steps of each rung of a search: halves of the run, at multiples of ``interval`` but for the last.

    Args:
        most: how many there are, if a batch can be halved as often.
    """
    count = min(most, batch.bit_length())
    halves = (math.ceil(steps / 2**i / interval) * interval for i in range(count - 1, 0, -1))
    return (*sorted({rung for rung in halves if rung < steps}), steps)


def last_return(trial: Trial) -> float:
    """Return a trial's return at its last rung; minus infinity if it has none."""
    return list(trial.returns.values())[-1] if trial.returns else -math.inf


def taken(search: Search) -> int:
    """Return the environment steps that all trials have taken, of each seed. One that diverged had begun a rung."""
    climbed = (len(trial.returns) + (trial.state == DIVERGED) for trial in search.trials)
    return sum(search.rungs[count - 1] for count in climbed if count)


def ask(search: Search) -> Search:
    """Begin the next round: ask optuna's tree-structured Parzen estimator (Bergstra et al. 2011) for its trials.

    Raises:
        InputError: optuna is not installed.
    """
    optuna = require_library("optuna", "--search")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    startup, begun = min(_RANDOM, search.batch), len(search.trials)
    sampler = optuna.samplers.TPESampler(seed=search.seed + begun, n_startup_trials=startup, constant_liar=True)
    study, space = optuna.create_study(sampler=sampler, direction="maximize"), _space(search)
    study.add_trials([_told(optuna, trial, space) for trial in search.trials])
    if not begun and all(low <= search.preset[name] <= high for name, (low, high) in search.ranges.items()):
        study.enqueue_trial(dict(search.preset))
    size = min(search.batch, search.count - begun)
    asked = [study.ask(space).params for _ in range(size)]
    new = [Trial(begun + i, search.round + 1, _rounded(search, values), {}) for i, values in enumerate(asked)]
    return dataclasses.replace(search, trials=(*search.trials, *new))


def _space(search: Search) -> dict[str, Any]:
    distribution = require_library("optuna", "--search").distributions.FloatDistribution
    logarithmic = lambda low, high: 0 < low * _LOGARITHMIC <= high
    return {name: distribution(*ends, log=logarithmic(*ends)) for name, ends in search.ranges.items()}


def _told(optuna: Any, trial: Trial, space: Mapping[str, Any]) -> Any:
    """Return a trial as optuna knows it. What diverged has no value there, and counts as the worst."""
    states = optuna.trial.TrialState
    about = {"params": trial.values, "distributions": dict(space)}
    if trial.state == FINISHED:
        return optuna.create_trial(value=last_return(trial), **about)
    known = {} if trial.state == DIVERGED else trial.returns
    return optuna.create_trial(state=states.PRUNED, intermediate_values=known, **about)


def _rounded(search: Search, values: Mapping[str, float]) -> dict[str, float]:
    """Return values of four digits, which a table shows whole, inside their ranges. The preset's stay as they are."""
    if values == search.preset:
        return dict(values)
    return {name: float(np.clip(float(f"{x:.4g}"), *search.ranges[name])) for name, x in values.items()}


def climb(search: Search, returns: Sequence[float], run: str) -> Search:
    """Return the search after a rung, given the returns of its running trials; NaN of those that diverged.

    The better half of the batch goes on, at least one. Of equals the first one does.
    """
    steps, last = search.rungs[search.rung], search.rung + 1 == len(search.rungs)
    size = len([trial for trial in search.trials if trial.round == search.round])
    most = max(math.ceil(size / 2 ** (search.rung + 1)), 1)
    order = [i for i in np.argsort([-x for x in returns], kind="stable") if math.isfinite(returns[i])]
    kept = {search.running[i].number for i in order[:most]}
    told = {}
    for i, trial in enumerate(search.running):
        value = float(returns[i])
        state = RUNNING if trial.number in kept else GAVE_WAY
        state = DIVERGED if not math.isfinite(value) else FINISHED if last else state
        known = trial.returns | ({steps: value} if math.isfinite(value) else {})
        told[trial.number] = trial._replace(returns=known, state=state, run=run, point=i)
    return dataclasses.replace(search, trials=tuple(told.get(trial.number, trial) for trial in search.trials))


def write(folder: Path, search: Search) -> None:
    """Write search.json anew; whoever reads it sees a whole one."""
    record = dataclasses.asdict(search) | {"trials": [trial._asdict() for trial in search.trials]}
    with replacing(folder / FILE) as new:
        new.write_text(json.dumps(record, indent=2) + "\n")


def read(folder: Path) -> Search:
    """Read the search of a folder.

    Raises:
        InputError: its file is damaged.
    """
    try:
        record = json.loads((folder / FILE).read_text())
        trials = [Trial(**trial) for trial in record.pop("trials")]
        trials = [trial._replace(returns={int(k): float(x) for k, x in trial.returns.items()}) for trial in trials]
        ranges = {name: (float(low), float(high)) for name, (low, high) in record.pop("ranges").items()}
        return Search(
            **record | {"ranges": ranges, "rungs": tuple(record["rungs"]), "words": tuple(record["words"])},
            trials=tuple(trials),
        )
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        text = f"{str(folder / FILE)!r} does not describe a search: {type(error).__name__}: {error}"
        raise InputError(text) from None
