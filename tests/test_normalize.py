"""Running moments against NumPy's of everything at once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.agents import normalize


def fitted(*batches):
    moments = normalize.init(batches[0].shape[-1])
    for batch in batches:
        moments = normalize.update(moments, jnp.float32(batch))
    return moments


def random_batches(*sizes, offset=0.0, scale=1.0):
    random = np.random.default_rng(0)
    return [offset + scale * random.normal(size=(size, 3)) for size in sizes]


def test_moments_of_nothing_normalise_to_the_identity():
    """An agent that has not learned yet sees what there is."""
    x = jnp.float32([[1.0, -2.0, 9.0]])
    np.testing.assert_array_equal(normalize.apply(normalize.init(3), x), x)


@pytest.mark.parametrize(("offset", "scale"), [(0.0, 1.0), (5.0, 0.1), (-1000.0, 1.0), (0.0, 1e4)])
def test_batches_of_any_size_add_up_to_the_moments_of_all(offset, scale):
    """Also far from zero, where a mean of squares less the square of the mean would cancel."""
    batches = random_batches(1, 7, 64, 2, 300, offset=offset, scale=scale)
    everything = np.float32(np.concatenate(batches)).astype(np.float64)
    moments = fitted(*batches)
    assert moments.count == len(everything)
    np.testing.assert_allclose(moments.mean, everything.mean(axis=0), rtol=1e-6, atol=1e-6 * scale)
    np.testing.assert_allclose(moments.deviation / moments.count, everything.var(axis=0), rtol=1e-3)


def test_leading_axes_are_all_samples():
    """A batch (T, B, O) counts as T B observations."""
    (batch,) = random_batches(24)
    shaped, flat = fitted(batch.reshape(4, 6, 3)), fitted(batch)
    for a, b in zip(shaped, flat, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_fitted_data_have_zero_mean_and_unit_variance():
    """Dimension by dimension, whatever their units."""
    (batch,) = random_batches(500)
    batch = batch * [0.1, 1.0, 50.0] + [3.0, 0.0, -100.0]
    x = normalize.apply(fitted(batch), jnp.float32(batch))
    np.testing.assert_allclose(x.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(x.std(axis=0), 1, rtol=1e-3)


def test_a_constant_dimension_stays_finite():
    """It is centred and scaled by no more than the inverse of the least deviation."""
    moments = fitted(np.full((10, 3), 7.0))
    np.testing.assert_allclose(normalize.apply(moments, jnp.full(3, 7.0)), 0, atol=1e-3)
    np.testing.assert_allclose(normalize.apply(moments, jnp.full(3, 7.005)), 5, rtol=1e-3)


def test_what_lies_far_outside_is_clipped():
    """At ten deviations on either side, infinities included; what lies within keeps its slope."""
    moments = fitted(np.float32([[-1.0, 4.0, 0.0], [1.0, 6.0, 0.0]]))
    x = jnp.float32([[9.9, 5.0, 1e-3], [11.0, -6.0, 1.0], [-jnp.inf, 1e30, -1.0]])
    np.testing.assert_allclose(normalize.apply(moments, x), [[9.9, 0, 1], [10, -10, 10], [-10, 10, -10]], rtol=1e-4)
    slopes = jax.jacobian(lambda x: normalize.apply(moments, x))(x[0])
    np.testing.assert_allclose(jnp.diag(slopes), [1, 1, 1000], rtol=1e-4)


def count(moments, batch):
    """Count a batch as agents do."""
    return normalize.update(moments, normalize.bounded(moments, jnp.float32(batch)))


def test_what_lies_far_off_is_counted_at_a_hundred_deviations():
    """Before any observation nothing is far."""
    x = jnp.float32([[5e9, 5.0, -1e9], [99.0, 4.5, 0.099]])
    np.testing.assert_array_equal(normalize.bounded(normalize.init(3), x), x)
    moments = fitted(np.float32([[-1.0, 4.0, 0.0], [1.0, 6.0, 0.0]]))
    np.testing.assert_allclose(normalize.bounded(moments, x), [[100, 5, -0.1], [99, 4.5, 0.099]], rtol=1e-6)


def test_a_world_that_flies_off_leaves_the_scale_of_others_as_it_is():
    """Ten steps of it after a million others change the deviation by 5%."""
    moments = fitted(np.random.default_rng(0).normal(size=(1_000_000, 3)))
    spoiled = count(moments, np.full((10, 3), 1e9))
    np.testing.assert_allclose(normalize._std(spoiled), normalize._std(moments), rtol=0.05)


def test_what_begins_rarely_has_its_own_deviation_soon():
    """It was constant, and is 1 in one of 50 steps after that."""
    moments, random = fitted(np.zeros((1000, 3))), np.random.default_rng(0)
    for _ in range(50):
        moments = count(moments, random.random((1000, 3)) < 0.02)
    np.testing.assert_allclose(normalize._std(moments), np.sqrt(0.02), rtol=0.15)


@pytest.mark.parametrize(("before", "batches"), [(1_000, 60), (100_000, 60)])
def test_a_number_that_begins_to_vary_late_gets_its_scale(before, batches):
    """It was constant, so that its first values lie far off: with as many as before them it has its own deviation."""
    moments = fitted(np.zeros((before, 3)))
    for batch in np.random.default_rng(0).normal(size=(batches, before // 50, 3)):
        moments = count(moments, batch)
    np.testing.assert_allclose(normalize._std(moments), np.sqrt(batches / (batches + 50)), rtol=0.25)
