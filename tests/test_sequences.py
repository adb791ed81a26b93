"""Measures of sequences of tasks, by numbers worked out by hand."""

import numpy as np
import pytest

from mtjax.report import sequences

# One seed, two tasks with two evaluations each: the first is learned to 0.8, and falls to 0.2.
SCORES = np.array([[[0.4, 0.0], [0.8, 0.1], [0.5, 0.5], [0.2, 0.9]]])
SPANS = sequences.spans_of(4, 2)


def test_performance_is_the_mean_at_the_end():
    np.testing.assert_allclose(sequences.performance(SCORES), [(0.2 + 0.9) / 2])


def test_forgetting_is_what_a_task_lost_since_its_end():
    np.testing.assert_allclose(sequences.forgetting(SCORES, SPANS), [[0.6, 0]])


def test_transfer_is_the_gain_in_area_by_what_there_was_to_gain():
    areas = sequences.areas(SCORES, SPANS)
    np.testing.assert_allclose(areas, [[0.6, 0.7]])
    np.testing.assert_allclose(sequences.forward_transfer(areas, np.array([[0.6, 0.4]])), [[0, 0.5]], atol=1e-12)
    assert np.isnan(sequences.forward_transfer(areas, np.array([[1.0, 0.4]]))[0, 0])


def test_seeds_are_measured_apart():
    both = np.concatenate([SCORES, 1 - SCORES])
    np.testing.assert_allclose(sequences.forgetting(both, SPANS), [[0.6, 0], [-0.6, 0]])


def test_tasks_have_equally_many_evaluations():
    with pytest.raises(ValueError, match="5 evaluations are not equally many for each of 2 tasks"):
        sequences.spans_of(5, 2)
