"""Learning to adapt, by closed forms: quadratic tasks, two arms of which one pays, and the curvature of samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import adapted_gain

from mtjax.agents.parts.adaptation import adapt, surrogate

A, C = np.float32([0.5, 1.0, 3.0]), np.float32([-1.0, 0.5, 2.0])
RATE = 0.2
TASKS = {"a": A, "c": C}
BEFORE = {"a": A[:, None], "c": C[:, None]}  # of one step
sampled = lambda log_prob, reward: surrogate(log_prob - jax.lax.stop_gradient(log_prob), reward)
quadratic = lambda x, task: -task["a"] / 2 * jnp.square(x - task["c"])


def optimum(slope):
    """Where a slope that is linear in x is 0."""
    return slope(0.0) / (slope(0.0) - slope(1.0))


@pytest.mark.parametrize("first_order", [False, True])
def test_the_optimum_for_quadratic_tasks(first_order):
    """sum a (1 - r a)^2 c / sum a (1 - r a)^2; of first order (1 - r a) is not squared."""
    found = optimum(jax.grad(lambda x: adapted_gain(quadratic, x, BEFORE, TASKS, RATE, first_order)))
    weight = A * (1 - RATE * A) ** (1 if first_order else 2)
    assert float(found) == pytest.approx(np.sum(weight * C) / np.sum(weight), rel=1e-5)


def test_steps_follow_one_another():
    """Of a quadratic each step leaves 1 - r a of the distance, and each has data of its own."""
    data = {"a": jnp.full(3, 2.0), "c": jnp.full(3, 1.5)}
    assert float(adapt(quadratic, 0.0, data, RATE)) == pytest.approx(1.5 * (1 - (1 - RATE * 2) ** 3), rel=1e-5)
    assert float(jax.grad(lambda x: adapt(quadratic, x, data, RATE))(0.0)) == pytest.approx(
        (1 - RATE * 2) ** 3, rel=1e-5
    )
    assert float(jax.grad(lambda x: adapt(quadratic, x, data, RATE, first_order=True))(0.0)) == 1
    moving = {"a": jnp.ones(2), "c": jnp.array([1.0, 3.0])}
    assert float(adapt(quadratic, 0.0, moving, 0.5)) == pytest.approx(0.5 + 0.5 * (3 - 0.5))


@pytest.mark.parametrize(("rate", "value"), [(1.0, 0.5622), (4.0, 0.7311), (10.0, 0.9241)])
def test_two_arms_of_which_either_may_pay(rate, value):
    """The best start is indifferent, x = 0, and earns sigmoid(rate / 4) after a step along the exact gradient."""
    sign = jnp.array([1.0, -1.0])
    earned = lambda x, sign: jax.nn.sigmoid(sign * x)
    start = lambda x: adapted_gain(earned, x, sign[:, None], sign, rate)
    assert float(start(0.0)) == pytest.approx(value, abs=5e-5)
    assert float(start(0.0)) == pytest.approx(float(jax.nn.sigmoid(rate / 4)), rel=1e-5)
    assert float(jax.grad(start)(0.0)) == pytest.approx(0, abs=1e-6)
    others = jax.vmap(start)(jnp.linspace(-3, 3, 61))
    assert np.all(np.asarray(others) <= float(start(0.0)) + 1e-6)


@pytest.mark.parametrize("x", [-0.7, 0.0, 1.2])
def test_samples_tell_slope_and_curvature(x):
    """Of an arm that pays r with the chance s = sigmoid(x): s (1 - s) r and s (1 - s) (1 - 2 s) r, over both arms."""
    s, r = float(jax.nn.sigmoid(x)), 1.7
    log_prob = lambda x, pays: jax.nn.log_sigmoid(jnp.where(pays, x, -x))

    def expected(gain, derivative):
        of_one = lambda pays: derivative(lambda x: gain(log_prob(x, pays)[None], r * pays))(x)
        return s * float(of_one(1.0)) + (1 - s) * float(of_one(0.0))

    second = lambda f: jax.grad(jax.grad(f))
    assert expected(sampled, jax.grad) == pytest.approx(s * (1 - s) * r, rel=1e-5)
    assert expected(sampled, second) == pytest.approx(s * (1 - s) * (1 - 2 * s) * r, rel=1e-5, abs=1e-6)
    by_log = lambda log_prob, advantage: jnp.mean(log_prob * advantage)
    assert expected(by_log, jax.grad) == pytest.approx(s * (1 - s) * r, rel=1e-5)
    assert expected(by_log, second) == pytest.approx(-s * s * (1 - s) * r, rel=1e-5)  # not the curvature


def test_a_policy_learns_to_adapt_from_samples():
    """By its own pulls before and after the step it finds the indifferent start, from one that prefers an arm.

    Each update has new pulls of two tasks, of which either arm pays.
    """
    pays, rate, count = jnp.array([1.0, 0.0]), 4.0, 2000  # whether the first arm does
    log_prob = lambda x, first: jax.nn.log_sigmoid(jnp.where(first, x, -x))
    gain = lambda x, data: sampled(log_prob(x, data["first"]), data["reward"])

    def pull(x, pays, key):
        first = jax.random.bernoulli(key, jax.nn.sigmoid(x), (count,))
        return {"first": first, "reward": jnp.float32(first == (pays > 0))}

    def update(x, key):
        keys = jax.random.split(key, (2, 2))
        before = jax.vmap(pull, (None, 0, 0))(x, pays, keys[0])
        before = jax.tree.map(lambda leaf: leaf[:, None], before)  # one step
        adapted = jax.vmap(lambda data: adapt(gain, x, data, rate))(before)
        after = jax.vmap(pull)(adapted, pays, keys[1])
        return x + 2 * jax.grad(lambda x: adapted_gain(gain, x, before, after, rate))(x), None

    found, _ = jax.jit(lambda x, keys: jax.lax.scan(update, x, keys))(1.0, jax.random.split(jax.random.key(0), 100))
    assert abs(float(found)) < 0.2
