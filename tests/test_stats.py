import time

import numpy as np
import pytest

from mtjax.report.stats import iqm, mean_interval, seed_interval, stratified_bootstrap


def random_scores(num_seeds, num_tasks=10):
    return np.random.default_rng(7).normal(100.0, 10.0, (num_seeds, num_tasks))


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([8, 1, 7, 2, 6, 3, 5, 4], 4.5),  # mean of 3, 4, 5, 6
        ([0, 10, 20, 30, 1000], 20),  # 5 // 4 = 1 off each end
        ([1, 2, 3, 40, 50, 60, 70, 80, 900, 1000], 303 / 6),  # 10 // 4 = 2 off each end
        ([3, 5, 100], 36),  # too few to trim
        ([[1, 2], [3, 100]], 2.5),  # over all entries, not per column
    ],
)
def test_iqm_is_hand_worked_trimmed_mean(scores, expected):
    assert iqm(np.array(scores)) == pytest.approx(expected)


def test_iqm_along_axis_is_iqm_of_each_row():
    scores = random_scores(6)
    np.testing.assert_allclose(iqm(scores, axis=-1), [iqm(row) for row in scores])
    np.testing.assert_allclose(iqm(scores, axis=0), [iqm(column) for column in scores.T])


@pytest.mark.parametrize("interval", [stratified_bootstrap, mean_interval])
def test_interval_contains_point_and_is_deterministic(interval):
    scores = random_scores(5)
    point, low, high = interval(scores)
    assert low < point < high
    assert interval(scores) == (point, low, high)
    assert interval(scores, seed=1)[0] == point
    assert interval(scores, seed=1)[1:] != (low, high)


def test_point_is_the_statistic_of_all_scores():
    scores = random_scores(5)
    assert stratified_bootstrap(scores)[0] == pytest.approx(iqm(scores))
    assert mean_interval(scores)[0] == pytest.approx(scores.mean())


def test_interval_shrinks_with_seeds_and_grows_with_confidence():
    widths = [np.diff(mean_interval(random_scores(seeds))[1:])[0] for seeds in (4, 16, 64)]
    assert widths[0] > 1.5 * widths[1] > 2.25 * widths[2]
    scores = random_scores(5)
    assert np.diff(mean_interval(scores, confidence=0.99)[1:]) > np.diff(mean_interval(scores, confidence=0.5)[1:])


def test_mean_interval_of_one_task_agrees_with_closed_form():
    # The bootstrap distribution of a mean has standard deviation std / sqrt(S) and is nearly normal for S = 100.
    scores = random_scores(100, 1)
    error = 1.96 * scores.std() / np.sqrt(100)
    point, low, high = mean_interval(scores, resamples=20_000)
    assert point == pytest.approx(scores.mean())
    assert (low, high) == pytest.approx((point - error, point + error), abs=0.05 * error)


def test_mean_interval_of_two_seeds_agrees_with_enumeration():
    # Resamples of {0, 1} have the means 0, 1/2, 1 with probabilities 1/4, 1/2, 1/4.
    assert mean_interval(np.array([[0.0], [1.0]]), confidence=0.9) == (0.5, 0.0, 1.0)
    assert mean_interval(np.array([[0.0], [1.0]]), confidence=0.4) == (0.5, 0.5, 0.5)


def test_seeds_are_resampled_within_their_task_only():
    # Tasks on different levels, seeds equal: a resample that mixed tasks would vary.
    scores = np.tile([1.0, 10.0, 100.0, 1000.0], (3, 1))
    assert mean_interval(scores) == pytest.approx((277.75, 277.75, 277.75))
    # Tasks resampled independently vary less than seeds resampled whole.
    same = np.tile(np.arange(5.0)[:, None], (1, 20))
    assert np.diff(mean_interval(same)[1:]) < 0.5 * np.diff(mean_interval(same[:, :1])[1:])


def test_nominal_coverage():
    rng = np.random.default_rng(0)
    intervals = [mean_interval(rng.normal(size=(20, 2)), resamples=300)[1:] for _ in range(200)]
    covered = np.mean([low < 0 < high for low, high in intervals])
    assert 0.87 < covered < 0.99


def test_one_seed_has_no_bounds():
    point, low, high = stratified_bootstrap(random_scores(1))
    assert np.isfinite(point) and np.isnan(low) and np.isnan(high)


def test_fast_enough_to_call_for_every_evaluation():
    began = time.perf_counter()
    stratified_bootstrap(random_scores(10))
    assert time.perf_counter() - began < 0.5  # 0.005 s on an idle core


def test_seed_interval_resamples_whole_seeds():
    """Tasks that one agent learned rise and fall together, so twenty of them say no more than one."""
    same = np.tile(np.arange(5.0)[:, None], (1, 20))
    assert seed_interval(same) == mean_interval(same[:, :1])
