"""The learning curve in the folder of a run."""

from pathlib import Path

import numpy as np

from mtjax.config import RunConfig
from mtjax.evaluation import Evaluations
from mtjax.parallel import hosts
from mtjax.report import figures
from mtjax.saved.folder import short_name


def draw(config: RunConfig, evaluations: Evaluations, directory: Path) -> None:
    """Draw a run's returns over its steps into curve.png, one line per split; of a sweep, one per point."""
    count = config.plan.seeds
    if not len(evaluations.steps) or not hosts.is_first():
        return
    curves = evaluations.returns
    for p, point in enumerate(config.points):
        named = ", ".join(f"{name} {value:g}" for name, value in point.items())
        curves = {**(curves if p else {}), named: evaluations.returns["train"][p * count : (p + 1) * count]}
    known = {name: x for name, x in curves.items() if np.isfinite(x).all()}
    if known:
        title = f"{config.agent} on {short_name(config.env)}"
        figures.learning_curve(directory / "curve.png", evaluations.steps, known, title, config.warmup)
