"""The result of a run in Python: its state, evaluations, metrics and policies."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.agents.swept import Point
from mtjax.checks import amount
from mtjax.learning import trials
from mtjax.learning.evaluation import Evaluations
from mtjax.learning.loop import TrainState
from mtjax.names import nearest_error, public
from mtjax.parallel import hosts
from mtjax.saved.policy import Policy, policy_of
from mtjax.saved.tables import frame_of, members, metrics_frame


class Result(NamedTuple):
    """The result of a run."""

    state: TrainState
    evaluations: Evaluations
    rows: Sequence[dict[str, Any]]  # the lines of metrics.csv
    seconds: float  # of training, without compiling and evaluating; of a resumed run, with those before
    compile_seconds: float  # from the start until the first chunk could begin
    finished: bool  # False if a signal or ``on_chunk`` stopped it
    directory: Path | None
    points: tuple[Point, ...] = ()  # of a sweep: entry k of S is seed k % seeds of point k // seeds
    env: Any = None
    agent: Any = None
    seeds: tuple[int, ...] = ()  # of each point
    trained_seconds: float = 0.0  # of ``seconds``, those since this start
    signal: int = 0  # the signal that came, if any; it stops what would follow a finished run too
    total_seconds: float = 0.0  # from the start to the end: compiling, training, evaluating and saving
    population: str = ""  # how members of S gave way to copies of others, which makes them no independent seeds

    def __repr__(self) -> str:
        """Return a line: steps, and the last evaluation's mean return by split."""
        known = {split: x[:, -1] for split, x in self.evaluations.returns.items() if x.size}
        told = {split: trials.describe(x, self.evaluations.trial) for split, x in known.items()}
        tell = lambda split: f" ({told[split]})" * bool(told[split])
        scores = ", ".join(f"{split} {amount(np.nanmean(x))}{tell(split)}" for split, x in known.items())
        steps = f"{self.rows[-1]['steps']:,} steps" if self.rows else "no steps"
        place = "" if self.directory is None else f", in {str(self.directory)!r}"
        return f"Result({steps}, return {scores or '-'}{'' if self.finished else ', stopped'}{place})"

    @public
    def policy(self, seed: int = 0) -> Policy:
        """Return the trained policy of a seed, counted from 0; in a sweep of entry ``seed`` of S, as ``mtjax.load``.

        Under ``jax.distributed`` every process must call this.

        Raises:
            InputError: the run has no such seed.
        """
        states = jax.tree.map(jnp.asarray, hosts.gather(self.state.agent))
        about = self.points, jnp.asarray(self.seeds), states, seed, self.directory, bool(self.population)
        found = policy_of(self.env, self.agent, *about)
        return dataclasses.replace(found, trial=self.evaluations.trial, entry=seed)

    @public
    def frame(self, of: str = "evaluations") -> Any:
        """Return the run as a pandas table: its evaluations by task, or with "metrics" the lines of metrics.csv.

        Raises:
            InputError: pandas is missing, or there is no such table.
        """
        if of == "metrics":
            return metrics_frame(self.rows)
        if of != "evaluations":
            raise nearest_error("table", of, ("evaluations", "metrics"))
        if not self.population:
            return frame_of(self.env, self.evaluations, self.seeds, self.points)
        return frame_of(self.env, self.evaluations, *members(self.evaluations.seeds))
