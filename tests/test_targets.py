"""Targets against plain loops, and against each other where theory says that they are the same."""

import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.agents.parts import targets
from mtjax.types import Transition

GAMMA, LAMBDA = 0.9, 0.8
RANDOM = np.random.default_rng(3)
LENGTH, WORLDS = 7, 5
VALUE, NEXT_VALUE, LOG_RATIO = (np.float32(RANDOM.normal(size=(LENGTH, WORLDS))) for _ in range(3))


def steps(ended=None, discount=None):
    shape = (LENGTH, WORLDS)
    ended = RANDOM.random(shape) < 0.3 if ended is None else ended
    discount = np.where(ended & (RANDOM.random(shape) < 0.5), 0.0, 1.0) if discount is None else discount
    reward = np.float32(np.random.default_rng(1).normal(size=shape))
    found = (reward, np.float32(discount), np.asarray(ended))
    return Transition(None, None, *map(jnp.asarray, found[:2]), None, jnp.asarray(found[2]))


STEPS = steps()


def loop(first, back):
    """Compute x_t = first(t, world) + back(t, world) x_(t+1) world by world; x is 0 after an end and the last step."""
    found = np.zeros((LENGTH, WORLDS))
    for world in range(WORLDS):
        later = 0.0
        for t in reversed(range(LENGTH)):
            later = 0.0 if STEPS.ended[t, world] else later
            found[t, world] = later = first(t, world) + back(t, world) * later
    return found


def error(t, world, value=VALUE):
    """r + gamma d V(s') - V(s)."""
    bootstrap = GAMMA * STEPS.discount[t, world] * NEXT_VALUE[t, world]
    return float(STEPS.reward[t, world] + bootstrap - value[t, world])


def test_generalised_advantages_are_discounted_sums_of_errors():
    found = targets.gae(STEPS, VALUE, NEXT_VALUE, GAMMA, LAMBDA)
    np.testing.assert_allclose(found, loop(error, lambda t, world: GAMMA * LAMBDA), rtol=1e-5, atol=1e-6)


def test_lambda_returns_mix_the_next_value_and_the_next_return():
    def cut(t, world):
        return t == LENGTH - 1 or bool(STEPS.ended[t, world])

    def first(t, world):
        share = 1.0 if cut(t, world) else 1 - LAMBDA
        return float(STEPS.reward[t, world] + GAMMA * STEPS.discount[t, world] * share * NEXT_VALUE[t, world])

    expected = loop(first, lambda t, world: GAMMA * float(STEPS.discount[t, world]) * LAMBDA)
    np.testing.assert_allclose(targets.lambda_returns(STEPS, NEXT_VALUE, GAMMA, LAMBDA), expected, rtol=1e-5, atol=1e-6)
    one_step = targets.td(STEPS, NEXT_VALUE, GAMMA)
    np.testing.assert_allclose(targets.lambda_returns(STEPS, NEXT_VALUE, GAMMA, 0.0), one_step, rtol=1e-6)


@pytest.mark.parametrize("largest", [1.0, 2.0])
def test_vtrace_weighs_errors_by_clipped_ratios(largest):
    ratio = np.exp(LOG_RATIO)
    rho, c = np.minimum(largest, ratio), LAMBDA * np.minimum(1.0, ratio)
    gain = loop(lambda t, w: float(rho[t, w]) * error(t, w), lambda t, w: GAMMA * float(c[t, w]))
    found = targets.vtrace(STEPS, VALUE, NEXT_VALUE, LOG_RATIO, GAMMA, LAMBDA, largest)
    np.testing.assert_allclose(found.target, VALUE + gain, rtol=1e-5, atol=1e-5)
    t, world = next((t, w) for t in range(LENGTH - 1) for w in range(WORLDS) if not STEPS.ended[t, w])
    ahead = (1 - LAMBDA) * NEXT_VALUE[t, world] + LAMBDA * found.target[t + 1, world]
    told = rho[t, world] * (STEPS.reward[t, world] + GAMMA * STEPS.discount[t, world] * ahead - VALUE[t, world])
    assert float(found.advantage[t, world]) == pytest.approx(float(told), rel=1e-5)


def test_vtrace_on_policy_is_generalised_advantages():
    """Where s' of a step is s of the next one, as within an episode."""
    whole = steps(ended=np.zeros((LENGTH, WORLDS), bool))
    after = np.concatenate([VALUE[1:], NEXT_VALUE[-1:]])
    found = targets.vtrace(whole, VALUE, after, np.zeros_like(VALUE), GAMMA, LAMBDA)
    advantage = targets.gae(whole, VALUE, after, GAMMA, LAMBDA)
    np.testing.assert_allclose(found.advantage, advantage, atol=1e-6)
    np.testing.assert_allclose(found.target, VALUE + advantage, atol=1e-6)


def test_retrace_cuts_by_the_ratio_of_the_next_action():
    c = LAMBDA * np.minimum(1.0, np.exp(LOG_RATIO))
    after = lambda t, world: GAMMA * float(c[t + 1, world]) if t + 1 < LENGTH else 0.0
    expected = VALUE + loop(error, after)
    found = targets.retrace(STEPS, VALUE, NEXT_VALUE, LOG_RATIO, GAMMA, LAMBDA)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_vtrace_converges_to_the_value_of_the_clipped_policy():
    """On a process with known chances (Espeholt et al. 2018, theorem 1): mu acts, pi is asked for."""
    random = np.random.default_rng(0)
    chances = random.dirichlet(np.ones(3), size=(3, 2))  # (state, action, next state)
    rewards, gamma = random.random((3, 2)), 0.8
    pi, mu = (random.dirichlet(np.ones(2), size=3) for _ in range(2))
    clipped = np.minimum(mu, pi)  # min(1, pi / mu) mu
    clipped /= clipped.sum(axis=1, keepdims=True)
    moves, gains = np.einsum("sa,sax->sx", clipped, chances), np.einsum("sa,sa->s", clipped, rewards)
    exact = np.linalg.solve(np.eye(3) - gamma * moves, gains)

    count = 4000
    states, actions = np.zeros((12, count), int), np.zeros((12, count), int)
    states[0], following = random.integers(3, size=count), np.zeros((12, count), int)
    for t in range(12):
        actions[t] = random.random(count) < mu[states[t], 1]
        chosen = chances[states[t], actions[t]].cumsum(axis=-1)
        following[t] = np.minimum((random.random((count, 1)) > chosen).sum(axis=-1), 2)
        if t < 11:
            states[t + 1] = following[t]
    played = Transition(None, None, jnp.float32(rewards[states, actions]), jnp.ones((12, count)), None, states < 0)
    log_ratio = jnp.float32(np.log(pi[states, actions] / mu[states, actions]))
    value = np.zeros(3)
    for _ in range(400):
        found = targets.vtrace(played, *(jnp.float32(value[x]) for x in (states, following)), log_ratio, gamma, 1.0)
        error = np.asarray(found.target) - value[states]
        value += [0.3 * error[states == s].mean() for s in range(3)]
    np.testing.assert_allclose(value, exact, rtol=0.02)
