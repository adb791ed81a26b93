"""Aggregate scores with intervals, after Agarwal et al. 2021, "Deep RL at the Edge of the Statistical Precipice".

Axes: ``S`` seeds, ``T`` tasks.
"""

from collections.abc import Callable

import numpy as np


def iqm(scores: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Return the interquartile mean: the mean without the lowest and the highest quarter, each rounded down.

    It is over all entries, or along ``axis``, and equals rliable's ``aggregate_iqm`` (SciPy's 25 % trimmed mean).
    """
    ordered = np.sort(scores, axis=axis)
    axis = -1 if axis is None else axis
    size = ordered.shape[axis]
    middle = np.arange(size // 4, size - size // 4)
    return np.mean(np.take(ordered, middle, axis=axis), axis=axis)


def stratified_bootstrap(
    scores: np.ndarray,
    statistic: Callable[..., np.ndarray] = iqm,
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[float, float, float]:
    """Return a statistic of scores (S, T) and its percentile bootstrap interval: (point, low, high).

    Seeds are drawn with replacement independently within each task (Agarwal et al. 2021, section 4.1). That treats the
    tasks of one seed as separate runs; where one agent learned them all, resample whole seeds by giving each seed's
    mean as scores (S, 1). One seed says nothing about the spread between seeds: then both bounds are nan.

    Args:
        scores: (S, T).
        statistic: takes an array and ``axis``, as ``iqm`` and ``np.mean`` do.
    """
    scores = np.asarray(scores, np.float64)
    num_seeds, num_tasks = scores.shape
    point = float(statistic(scores, axis=None))
    if num_seeds == 1:
        return point, np.nan, np.nan
    chosen = np.random.default_rng(seed).integers(num_seeds, size=(resamples, num_seeds, num_tasks))
    resampled = scores[chosen, np.arange(num_tasks)].reshape(resamples, -1)
    tail = (1 - confidence) / 2
    low, high = np.quantile(statistic(resampled, axis=-1), [tail, 1 - tail])
    return point, float(low), float(high)


def mean_interval(
    scores: np.ndarray, resamples: int = 2000, confidence: float = 0.95, seed: int = 0
) -> tuple[float, float, float]:
    """Return the mean of scores (S, T) and its interval, as ``stratified_bootstrap`` does: (point, low, high)."""
    return stratified_bootstrap(scores, np.mean, resamples, confidence, seed)


def seed_interval(scores: np.ndarray) -> tuple[float, float, float]:
    """Return the mean of scores (S, T) and its interval over whole seeds, as one agent learned all tasks of a seed."""
    return mean_interval(np.mean(scores, axis=1, keepdims=True))
