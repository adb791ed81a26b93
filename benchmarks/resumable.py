"""Training that a stopped benchmark does not lose: a run lies in a folder until its results are written."""

import math
from pathlib import Path
from typing import Any

from report import read_lines

import mtjax
from mtjax.saved.result import Result
from mtjax.types import Agent, Env


def train(folder: Path, family: Env | str, agent: Agent | str, seconds: float = math.inf, **given: Any) -> Result:
    """Train by ``mtjax.train`` in a folder, or go on with the run that was stopped there.

    Checkpoints are written after evaluations and after a signal. The disk needs room for three training states, replay
    included. The caller removes the folder once the results are written.

    Args:
        seconds: of training, after which the run is enough; then ``on_chunk`` cannot be given.

    Returns:
        the result, with the lines of metrics from before the stop too.

    Raises:
        InputError: the run in the folder had other settings.
        SystemExit: a signal has stopped the run.
    """

    if seconds < math.inf:
        given["on_chunk"] = lambda line: float(line["seconds"]) > seconds
    result = mtjax.train(family, agent, directory=folder, resume=(folder / "config.json").exists(), **given)
    if result.signal:
        raise SystemExit(f"stopped: the run is in {folder}, and the same command with the same --out goes on with it")
    return result._replace(rows=read_lines(folder / "metrics.csv"))


def summary(result: Result) -> dict[str, Any]:
    """Return what every record of a run has: steps of its evaluations, seconds by two clocks, and the agent."""
    last = result.rows[-1]
    return {
        "steps": result.evaluations.steps.tolist(),
        "training_seconds": round(float(last["seconds"]), 1),
        "wall_seconds": round(float(last["wall_seconds"]), 1),
        "learner": str(result.agent),
    }
