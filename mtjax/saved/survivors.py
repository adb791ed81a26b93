"""A run of some members of another run, which goes on where that one stopped."""

import csv
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from mtjax.config import RunConfig
from mtjax.learning.evaluation import Evaluations, save_evaluations
from mtjax.learning.loop import TrainState
from mtjax.saved import checkpoint
from mtjax.saved.config_json import from_json, write_config
from mtjax.saved.folder import evaluations_of
from mtjax.saved.policy import state_shapes


def write(parent: Path, directory: Path, config: RunConfig, members: Sequence[int]) -> None:
    """Write the folder of a run of some members of a stopped run: its state, evaluations and metrics so far.

    The folder gets its name last, so that whatever ends the process, a folder of that name is whole.

    Args:
        parent: the folder of the stopped run.
        directory: the folder to make; ``parent`` stays as it is.
        config: the new run's, whose points and seeds are those of the members.
        members: numbers of entries of S of the stopped run.

    Raises:
        InputError: the stopped run has no whole checkpoint.
    """
    new = directory.with_name(f".{directory.name}.new")
    new.mkdir(exist_ok=True)
    write_config(new, config)
    known, rows = from_json(parent / "config.json"), np.asarray(members)
    state = take(checkpoint.load(parent / "checkpoints", state_shapes(known)), rows, state_shapes(config))
    save_evaluations(new / "evaluations.npz", _evaluations(evaluations_of(known, parent), rows))
    _copy_rows(parent / "metrics.csv", new / "metrics.csv", known.members, set(members))
    checkpoint.save(new / "checkpoints", state)
    new.rename(directory)


def take(state: TrainState, members: np.ndarray, like: TrainState) -> TrainState:
    """Return the training state of some members, by their numbers in S. What all have in common stays.

    Args:
        like: the shapes of their state. An array of as many members as before, or of none, has the same shape.
    """
    some = lambda x, shape: x if x.shape == shape.shape else x[members]
    return jax.tree.map(some, state, like)


def _evaluations(past: Evaluations, members: np.ndarray) -> Evaluations:
    some = lambda splits: {split: x[members] for split, x in splits.items()}
    metrics = {name: some(splits) for name, splits in past.metrics.items()}
    return past._replace(returns=some(past.returns), metrics=metrics, seeds=np.asarray(past.seeds)[members])


def _copy_rows(source: Path, target: Path, count: int, members: set[int]) -> None:
    """Copy the lines of some members, where every chunk has one for each of ``count``."""
    with source.open(newline="") as file, target.open("w", newline="") as new:
        head, *rows = csv.reader(file)
        csv.writer(new).writerows([head, *(row for i, row in enumerate(rows) if i % count in members)])
