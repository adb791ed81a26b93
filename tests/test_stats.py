import time

import numpy as np
import pytest

from mtjax.names import InputError
from mtjax.report.stats import (
    Bootstrap,
    Interval,
    holm,
    iqm,
    paired_difference,
    paired_p_value,
    probability_of_improvement,
    seed_interval,
    unpaired_difference,
)

DIFFERENCES = [paired_difference, unpaired_difference, probability_of_improvement]


def random_scores(num_seeds, num_tasks=10, seed=7):
    return np.random.default_rng(seed).normal(100.0, 10.0, (num_seeds, num_tasks))


def width(interval):
    return interval.high - interval.low


def test_an_interval_is_written_only_if_there_is_one():
    assert f"{Interval(1.5, 1.0, 2.0):+.1f}" == "+1.5 [+1.0, +2.0]"
    assert f"{seed_interval(np.array([1.0, 2.0])):.2f}" == "1.50"


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


@pytest.mark.parametrize("statistic", [np.mean, iqm])
def test_interval_contains_point_and_is_deterministic(statistic):
    scores = random_scores(5)
    found = seed_interval(scores, statistic)
    assert found.low < found.point < found.high
    assert found.point == pytest.approx(statistic(scores))
    assert seed_interval(scores, statistic) == found
    other = seed_interval(scores, statistic, Bootstrap(seed=1))
    assert other.point == found.point and other[1:] != found[1:]


def test_interval_shrinks_with_seeds_and_grows_with_confidence():
    widths = [width(seed_interval(random_scores(seeds))) for seeds in (8, 32, 128)]
    assert widths[0] > 1.5 * widths[1] > 2.25 * widths[2]
    scores = random_scores(5)
    wide, narrow = (seed_interval(scores, bootstrap=Bootstrap(confidence=c)) for c in (0.99, 0.5))
    assert width(wide) > width(narrow)


def test_interval_of_the_mean_agrees_with_closed_form():
    """The bootstrap distribution of a mean has standard deviation std / sqrt(S) and is nearly normal for S = 100."""
    scores = random_scores(100, 1)
    error = 1.96 * scores.std() / np.sqrt(100)
    point, low, high = seed_interval(scores, bootstrap=Bootstrap(resamples=20_000))
    assert point == pytest.approx(scores.mean())
    assert (low, high) == pytest.approx((point - error, point + error), abs=0.05 * error)


def test_interval_of_two_seeds_agrees_with_enumeration():
    """Resamples of {0, 1} have the means 0, 1/2, 1 with probabilities 1/4, 1/2, 1/4."""
    scores = np.array([0.0, 1.0])
    assert seed_interval(scores, bootstrap=Bootstrap(confidence=0.9, least_seeds=2)) == (0.5, 0.0, 1.0)
    assert seed_interval(scores, bootstrap=Bootstrap(confidence=0.4, least_seeds=2)) == (0.5, 0.5, 0.5)


@pytest.mark.parametrize("statistic", [np.mean, iqm])
def test_whole_seeds_are_resampled(statistic):
    """Tasks that one agent learned rise and fall together, so that twenty of them say no more than one."""
    same = np.tile(np.arange(8.0)[:, None], (1, 20))
    assert seed_interval(same, statistic) == seed_interval(same[:, 0], statistic)


def test_tasks_of_a_seed_stay_together():
    """Each seed is good at one task and bad at the other by as much, so that no seed's mean differs from another's."""
    scores = np.array([[0.0, 10.0], [2.0, 8.0], [10.0, 0.0], [7.0, 3.0]])
    assert seed_interval(scores) == (5, 5, 5)


def test_paired_difference_is_hand_worked():
    """Differences of the seeds are 1 and 3: resamples have the means 1, 2, 3, with probabilities 1/4, 1/2, 1/4."""
    a, b = np.array([[101.0], [3.0]]), np.array([[100.0], [0.0]])
    assert paired_difference(a, b, bootstrap=Bootstrap(confidence=0.9, least_seeds=2)) == (2, 1, 3)
    assert paired_difference(b, a, bootstrap=Bootstrap(confidence=0.9, least_seeds=2)) == (-2, -3, -1)
    assert paired_difference(a, b, bootstrap=Bootstrap(confidence=0.4, least_seeds=2)) == (2, 2, 2)


def test_unpaired_difference_is_hand_worked():
    """Means of a are 3, 52, 101 and of b 0, 50, 100, with 1/4, 1/2, 1/4 each: the ends have 1/16 each."""
    a, b = np.array([[101.0], [3.0]]), np.array([[100.0], [0.0]])
    assert unpaired_difference(a, b, bootstrap=Bootstrap(confidence=0.95, least_seeds=2)) == (2, -97, 101)


def test_pairs_cancel_what_their_seeds_share():
    """And agree with single samples where they share nothing."""
    shared, own = random_scores(30, 1, seed=1), random_scores(30, 1, seed=2)
    noise = 0.1 * random_scores(30, 1, seed=3)
    assert width(paired_difference(shared + noise, shared)) < 0.2 * width(unpaired_difference(shared + noise, shared))
    error = np.hypot(shared.std(), own.std()) / np.sqrt(30)
    assert width(unpaired_difference(shared, own)) == pytest.approx(2 * 1.96 * error, rel=0.1)


def test_the_difference_is_that_of_the_two_statistics():
    a, b = random_scores(8), random_scores(8, seed=1)
    for difference in (paired_difference, unpaired_difference):
        assert difference(a, b, iqm).point == pytest.approx(iqm(a) - iqm(b))


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ([[1], [3]], [[2], [2]], 0.5),  # 3 beats both, 1 neither
        ([[2], [3]], [[2], [1]], 7 / 8),  # a tie and three wins of four
        ([[5, 0]], [[1, 1], [2, 9]], 0.5),  # all pairs on one task, none on the other
        ([[5, 0], [5, 3]], [[1, 1], [2, 2]], 0.75),
    ],
)
def test_probability_of_improvement_is_hand_worked(a, b, expected):
    a, b = np.array(a), np.array(b)
    assert probability_of_improvement(a, b).point == pytest.approx(expected)
    assert probability_of_improvement(b, a).point == pytest.approx(1 - expected)


def test_interval_of_the_probability_of_improvement_is_hand_worked():
    """One seed of a beats b and the other does not: a resample has both with 1/2, and each alone with 1/4."""
    a, b = np.array([[1.0], [3.0]]), np.array([[2.0], [2.0]])
    assert probability_of_improvement(a, b, Bootstrap(confidence=0.9, least_seeds=2)) == (0.5, 0, 1)
    assert probability_of_improvement(a, b, Bootstrap(confidence=0.4, least_seeds=2)) == (0.5, 0.5, 0.5)


def test_nominal_coverage():
    """It is 90 % with ten seeds, as the docstring says, within what 1000 intervals tell."""
    rng = np.random.default_rng(0)
    intervals = [seed_interval(rng.normal(size=10), bootstrap=Bootstrap(300)) for _ in range(1000)]
    assert 0.87 < np.mean([low < 0 < high for _, low, high in intervals]) < 0.93


@pytest.mark.parametrize("seeds", [1, 2])
def test_one_or_two_seeds_have_no_bounds(seeds):
    one = random_scores(seeds)
    for point, low, high in (seed_interval(one), *(f(one, one + 1) for f in DIFFERENCES)):
        assert np.isfinite(point) and np.isnan(low) and np.isnan(high)


def test_pairs_need_the_same_seeds():
    with pytest.raises(ValueError, match="as many seeds of one as of the other, not 3 and 2"):
        paired_difference(random_scores(3), random_scores(2))


def test_fast_enough_to_call_for_every_evaluation():
    began = time.perf_counter()
    seed_interval(random_scores(10))
    assert time.perf_counter() - began < 0.5  # 0.005 s on an idle core


def test_p_is_that_of_a_paired_t_test_over_seeds():
    """Of each seed's mean; SciPy's own gives the same. Two tasks of a seed are no two samples."""
    from scipy.stats import ttest_rel

    a, b = random_scores(6), random_scores(6, seed=8) + 3
    expected = ttest_rel(a.mean(axis=1), b.mean(axis=1)).pvalue
    assert paired_p_value(a, b) == pytest.approx(expected, rel=1e-10)
    assert paired_p_value(np.repeat(a, 2, axis=1), np.repeat(b, 2, axis=1)) == pytest.approx(expected, rel=1e-10)
    assert paired_p_value(a, a) == 1.0 and paired_p_value(a, a + 1) < 1e-12
    assert np.isnan(paired_p_value(a[:1], b[:1]))
    with pytest.raises(ValueError, match="as many seeds"):
        paired_p_value(a, b[:3])


def test_holm_multiplies_the_smallest_by_their_number():
    """The next by one less, and none is below one before it (Holm 1979)."""
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm(np.array([0.4, np.nan, 0.3])) == pytest.approx([0.6, np.nan, 0.6], nan_ok=True)
    assert holm(np.array([])).shape == (0,)


@pytest.mark.parametrize(("seeds", "low", "high"), [(3, 0.70, 0.80), (5, 0.80, 0.88), (10, 0.87, 0.93)])
def test_intervals_of_few_seeds_hold_less_than_they_say(seeds, low, high):
    """Those of 95 % hold the mean of normal scores as often as ``seed_interval`` says, by the samples of 1,000 runs."""
    samples = np.random.default_rng(0).normal(size=(1000, seeds))
    few = Bootstrap(resamples=500)
    held = [interval.low <= 0 <= interval.high for interval in (seed_interval(x, np.mean, few) for x in samples)]
    assert low < np.mean(held) < high


def test_the_interval_of_three_seeds_is_their_range():
    """From the worst to the best one, whatever lies between."""
    interval = seed_interval(np.array([3.0, 9.0, 4.0]))
    assert (interval.low, interval.high) == (3.0, 9.0)


@pytest.mark.parametrize(
    "use",
    [
        iqm,
        lambda x: iqm(x, axis=0),
        seed_interval,
        lambda x: seed_interval(x, iqm),
        lambda x: paired_difference(x, np.zeros((4, 2))),
        lambda x: unpaired_difference(np.zeros((4, 2)), x),
        lambda x: probability_of_improvement(np.zeros((4, 2)), x),
    ],
)
def test_scores_that_are_no_numbers_are_refused(use):
    """A seed that diverged is left out by whoever compares, not in silence."""
    scores = np.arange(8.0).reshape(4, 2)
    use(scores)
    scores[1] = np.nan
    with pytest.raises(InputError, match="2 of 8 scores are NaN, as of seeds that diverged; leave out those seeds"):
        use(scores)
