"""What keeps networks able to learn, by numbers worked out by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.agents.parts import plasticity
from mtjax.agents.parts.plasticity import ContinualBackprop, Layer, ReDo, ShrinkAndPerturb, Units

LAYER = Layer(
    into=jnp.float32([[1, 2, 3], [-1, 4, 0.5]]), bias=jnp.float32([0.1, -9, 0.3]), out=jnp.float32([[1], [-2], [4]])
)
FRESH = jnp.float32([[7, 8, 9], [10, 11, 12]])


def outputs(layer, x):
    return np.maximum(x @ layer.into + layer.bias, 0) @ layer.out


def test_parameters_shrink_towards_fresh_ones():
    found = ShrinkAndPerturb(0.5, 0.1).change({"w": jnp.float32([2, -4])}, {"w": jnp.float32([10, 10])})
    np.testing.assert_allclose(found["w"], [2.0, -1.0], rtol=1e-6)


def test_the_activity_of_units_is_relative_to_their_mean():
    """Means 1, 0 and 5 of three units, whose mean is 2; and nothing where all are idle."""
    hidden = jnp.float32([[2, 0, -4], [0, 0, 6]])
    np.testing.assert_allclose(plasticity.activity(hidden), [0.5, 0, 2.5])
    np.testing.assert_array_equal(plasticity.activity(jnp.zeros((2, 3))), 0)


@pytest.mark.parametrize("threshold, dormant", [(0.0, [False, True, False]), (0.5, [True, True, False])])
def test_dormant_units_begin_anew(threshold, dormant):
    """Those at the threshold too; other units stay to the bit."""
    hidden = jnp.float32([[2, 0, -4], [0, 0, 6]])
    _, layer, found = ReDo(threshold).renew({}, LAYER, hidden, FRESH)
    assert found.tolist() == dormant
    for unit, anew in enumerate(dormant):
        expected = (FRESH[:, unit], 0, 0) if anew else (LAYER.into[:, unit], LAYER.bias[unit], LAYER.out[unit])
        for x, y in zip((layer.into[:, unit], layer.bias[unit], layer.out[unit]), expected, strict=True):
            np.testing.assert_array_equal(x, y)


def test_an_idle_unit_that_begins_anew_changes_no_output():
    """The second unit's bias keeps it below 0 for these inputs."""
    x = np.float32([[0.5, 1], [1, -0.2]])
    hidden = np.maximum(x @ LAYER.into + LAYER.bias, 0)
    _, layer, dormant = ReDo(0.0).renew({}, LAYER, jnp.asarray(hidden), FRESH)
    assert dormant.tolist() == [False, True, False]
    np.testing.assert_array_equal(outputs(layer, x), outputs(LAYER, x))


def test_an_optimiser_forgets_the_weights_of_units_that_begin_anew():
    found = plasticity.forget(LAYER, jnp.array([True, False, False]))
    np.testing.assert_array_equal(found.into, [[0, 2, 3], [0, 4, 0.5]])
    np.testing.assert_array_equal(found.bias, np.float32([0, -9, 0.3]))
    np.testing.assert_array_equal(found.out, [[0], [-2], [4]])


def test_the_least_useful_mature_unit_begins_anew_once_it_is_due():
    """Contributions are 1 * 1, 1 * 2 and 5 * 4. The first unit is too young, so the second is the least useful."""
    units = Units(jnp.float32([0, 10, 20]), jnp.int32([1, 5, 5]), jnp.float32(0.5))
    hidden = jnp.float32([[2, 1, -4], [0, 1, 6]])
    step = lambda units, rate: ContinualBackprop(rate, 4, 0.9).renew(units, LAYER, hidden, FRESH)
    waits, layer, chosen = step(units, 0.125)
    np.testing.assert_allclose(waits.utility, [0.1, 9.2, 20], rtol=1e-6)
    assert float(waits.due) == 0.75 and not np.any(chosen) and waits.age.tolist() == [2, 6, 6]
    np.testing.assert_array_equal(layer.into, LAYER.into)
    after, layer, chosen = step(units, 0.25)
    assert chosen.tolist() == [False, True, False] and float(after.due) == 0
    np.testing.assert_allclose(after.utility, [0.1, 0, 20], rtol=1e-6)
    assert after.age.tolist() == [2, 0, 6] and layer.out.tolist() == [[1], [0], [4]]
    np.testing.assert_array_equal(layer.into[:, 1], FRESH[:, 1])


def test_no_unit_begins_anew_before_it_is_mature():
    way = ContinualBackprop(replacement_rate=1.0, maturity=1)
    units, _, chosen = way.renew(way.init([3])[0], LAYER, jnp.ones((1, 3)), FRESH)
    assert not np.any(chosen) and float(units.due) == 0
