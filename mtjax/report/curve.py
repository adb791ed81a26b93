"""The learning curve in the folder of a run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mtjax.config import RunConfig
from mtjax.learning.evaluation import Evaluations, as_one_seed
from mtjax.parallel import hosts
from mtjax.report import figures
from mtjax.saved.folder import short_name


def draw(config: RunConfig, evaluations: Evaluations, directory: Path, labels: Sequence[str] = ()) -> None:
    """Draw a run's returns over its steps into curve.png: a line for each split, or in a sweep for each point.

    Of a population it draws the means over members, without intervals. Lines with a diverged seed are left out.

    Args:
        labels: what the lines of a sweep's points are called; by default their values.
    """
    if not len(evaluations.steps) or not hosts.is_first():
        return
    if config.plan.population:
        evaluations, labels = as_one_seed(evaluations), ()
    (points, seeds), train = config.samples, evaluations.returns["train"]
    count = len(seeds)
    labels = labels or [", ".join(f"{name} {value:g}" for name, value in point.items()) for point in points if point]
    of_points = {label: train[p * count : (p + 1) * count] for p, label in enumerate(labels)}
    curves = of_points or evaluations.returns
    known = {name: x for name, x in curves.items() if np.isfinite(x).all()}
    if known:
        title = f"{config.agent} on {short_name(config.env)}"
        figures.learning_curve(directory / "curve.png", evaluations.steps, known, title, config.warmup)
