"""Targets against plain loops, and against each other where theory says that they are the same."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.agents.parts import targets
from mtjax.envs import make
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
    ends = jnp.asarray(found[2])
    return Transition(None, None, *map(jnp.asarray, found[:2]), None, ends, ends, ends)


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


def retrace(steps, q, next_value, log_ratio, gamma, lambda_):
    """The targets of values of actions."""
    return targets.td(steps, next_value + targets.corrections(steps, q, next_value, log_ratio, gamma, lambda_), gamma)


def test_retrace_cuts_by_the_ratio_of_the_next_action():
    c = LAMBDA * np.minimum(1.0, np.exp(LOG_RATIO))
    after = lambda t, world: GAMMA * float(c[t + 1, world]) if t + 1 < LENGTH else 0.0
    expected = VALUE + loop(error, after)
    found = retrace(STEPS, VALUE, NEXT_VALUE, LOG_RATIO, GAMMA, LAMBDA)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_retrace_with_lambda_0_is_td():
    """To the bit."""
    found = retrace(STEPS, VALUE, NEXT_VALUE, LOG_RATIO, GAMMA, 0.0)
    np.testing.assert_array_equal(found, targets.td(STEPS, NEXT_VALUE, GAMMA))


def test_retrace_on_policy_is_the_lambda_return():
    """By hand for gamma and lambda of a half: of 2 + 6 / 2 = 5, 4 + (10 + 5) / 2 / 2 and 8 + (20 + 7.75) / 2 / 2.

    The value after a step is that of the next action, as where a policy always takes the same one.
    """
    one = lambda *x: jnp.float32(x)[:, None]
    goes_on = jnp.zeros((3, 1), bool)
    steps = Transition(None, None, one(8, 4, 2), one(1, 1, 1), None, goes_on, goes_on, goes_on)
    found = retrace(steps, one(99, 20, 10), one(20, 10, 6), one(0, 0, 0), 0.5, 0.5)
    np.testing.assert_allclose(found[:, 0], [14.9375, 7.75, 5], rtol=1e-6)
    value = np.concatenate([VALUE[:1], NEXT_VALUE[:-1]])
    found = retrace(STEPS, value, NEXT_VALUE, 0 * LOG_RATIO, GAMMA, LAMBDA)
    expected = targets.lambda_returns(STEPS, NEXT_VALUE, GAMMA, LAMBDA)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


class Chain(NamedTuple):
    """Steps (L, N) that a policy mu plays in the tabular process, whose chances are known."""

    chances: np.ndarray  # (state, action, next state)
    rewards: np.ndarray  # (state, action)
    pi: np.ndarray  # (state, action) the policy that is asked for
    mu: np.ndarray
    state: np.ndarray
    action: np.ndarray
    following: np.ndarray

    @property
    def steps(self):
        reward = jnp.float32(self.rewards[self.state, self.action])
        return Transition(None, None, reward, jnp.ones_like(reward), None, *[self.state < 0] * 3)

    @property
    def log_ratio(self):
        return jnp.float32(np.log(self.pi / self.mu)[self.state, self.action])


@pytest.fixture(scope="module")
def chain():
    random, length, count = np.random.default_rng(0), 12, 4000
    tables = jax.tree.map(lambda x: np.asarray(x[0], float), make("tabular-mdp", num_tasks=1).tasks().goal)
    chances, rewards = tables["transitions"], tables["rewards"]
    num_states, num_actions = rewards.shape
    pi, mu = (random.dirichlet(np.ones(num_actions), size=num_states) for _ in range(2))
    draw = lambda shares: np.minimum(
        (random.random((count, 1)) > shares.cumsum(axis=-1)).sum(axis=-1), shares.shape[1] - 1
    )
    now, played = random.integers(num_states, size=count), []
    for _ in range(length):
        action = draw(mu[now])
        then = draw(chances[now, action])
        played.append((now, action, then))
        now = then
    return Chain(chances, rewards, pi, mu, *(np.stack(x) for x in zip(*played, strict=True)))


def values_of(policy, chain, gamma):
    """The values (state,) of a policy, in closed form."""
    moves, gains = np.einsum("sa,sax->sx", policy, chain.chances), np.einsum("sa,sa->s", policy, chain.rewards)
    return np.linalg.solve(np.eye(len(gains)) - gamma * moves, gains)


def test_vtrace_converges_to_the_value_of_the_clipped_policy(chain):
    """Where mu acts and pi is asked for (Espeholt et al. 2018, theorem 1)."""
    gamma, num_states = 0.8, len(chain.rewards)
    clipped = np.minimum(chain.mu, chain.pi)  # min(1, pi / mu) mu
    exact = values_of(clipped / clipped.sum(axis=1, keepdims=True), chain, gamma)
    value = np.zeros(num_states)
    vtrace = jax.jit(lambda now, then: targets.vtrace(chain.steps, now, then, chain.log_ratio, gamma, 1.0))
    for _ in range(400):
        found = vtrace(*(jnp.float32(value[x]) for x in (chain.state, chain.following)))
        error = np.asarray(found.target) - value[chain.state]
        value += [0.3 * error[chain.state == s].mean() for s in range(num_states)]
    np.testing.assert_allclose(value, exact, rtol=0.02)


def test_retrace_converges_to_the_values_of_the_policy(chain):
    """Where mu acts and pi is asked for (Munos et al. 2016, theorem 1). Returns of what mu plays do not."""
    gamma, num_actions = 0.8, chain.rewards.shape[1]
    exact = chain.rewards + gamma * chain.chances @ values_of(chain.pi, chain, gamma)
    place = chain.state * num_actions + chain.action
    times = np.bincount(place.ravel(), minlength=exact.size)

    @jax.jit
    def corrected(q, then):
        return retrace(chain.steps, q, then, chain.log_ratio, gamma, 1.0)

    @jax.jit
    def returns(q, then):
        return targets.lambda_returns(chain.steps, then, gamma, 1.0)

    def error_of(target):
        """How far learned values are from exact ones, in shares of their mean, where mu plays."""
        q = np.zeros(exact.shape)
        for _ in range(50):
            then = np.sum(chain.pi * q, axis=1)[chain.following]
            error = np.asarray(target(jnp.float32(q.flat[place]), jnp.float32(then))) - q.flat[place]
            q += (np.bincount(place.ravel(), error.ravel(), exact.size) / np.maximum(times, 1)).reshape(exact.shape)
        return np.average(np.abs(q - exact).ravel(), weights=times) / np.mean(exact)

    assert error_of(corrected) < 0.02 < 0.05 < error_of(returns)
