"""Distral against sums worked out in NumPy, and against the one optimum that a bandit has."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.optimize
from probes import QUICK, learner, of_task, one_in, pick, random_batch, slow_but, tasks_of, tiny, with_nets
from probes import act as act_once

from mtjax.agents import agent
from mtjax.agents.distral import Distral
from mtjax.agents.networks import Params
from mtjax.agents.parts.gradients import descent
from mtjax.agents.parts.policies import Gaussian
from mtjax.agents.replay_batches import Batch
from mtjax.agents.sac import SAC
from mtjax.agents.state import axes_of
from mtjax.agents.unseen_tasks import describe_unseen
from mtjax.types import InputError, Spec

SPEC, BATCH = Spec.vector(3, 2, 1), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
GAUSSIAN = Gaussian()
KEY, FEATURES = jax.random.key(5), jnp.zeros(0)


def scattered(tree, size=0.5):
    """Random values everywhere."""
    random = np.random.default_rng(4)
    return jax.tree.map(lambda x: jnp.float32(size * random.normal(size=x.shape)), tree)


@pytest.fixture(scope="module")
def state():
    """Policies, critics and the distilled policy far apart."""
    fresh = learner(tiny("distral"), TASKS, BATCH, SPEC)[0](TASKS, KEY)
    actor, critic, slow = scattered((fresh.nets["actor"], fresh.nets["critic"], fresh.slow))
    return with_nets(fresh, actor=actor, critic=critic)._replace(slow=slow)


@pytest.fixture(scope="module")
def batch():
    return random_batch(0, 3, BATCH, SPEC)


def leaves(tree):
    return [np.asarray(x) for x in jax.tree.leaves(tree)]


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(leaves(a), leaves(b), strict=True))


# The density of a given action.


def plain_log_density(outputs, raw):
    """The log-density of tanh(raw) in float64: the normal one, and the slope of tanh."""
    mean, log_std = np.split(np.asarray(outputs, np.float64), 2, axis=-1)
    log_std = -5 + 3.5 * (np.tanh(log_std) + 1)
    raw = np.asarray(raw, np.float64)
    normal = -0.5 * ((raw - mean) / np.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)
    return np.sum(normal + 2 * np.log(np.cosh(raw)), axis=-1)  # log cosh^-2 is that of the slope


def test_density_of_a_given_action():
    """Of any action under any policy."""
    random = np.random.default_rng(0)
    outputs, raw = jnp.float32(random.normal(size=(50, 6))), jnp.float32(2 * random.normal(size=(50, 3)))
    np.testing.assert_allclose(GAUSSIAN.log_prob(outputs, raw), plain_log_density(outputs, raw), rtol=1e-4, atol=1e-4)


def test_density_of_a_policys_own_actions():
    """It is what drawing says of them; and actions are their squashed form."""
    outputs = jnp.float32(np.random.default_rng(1).normal(size=(50, 6)))
    action, raw, log_prob = GAUSSIAN.draw(outputs, None, KEY)
    np.testing.assert_allclose(GAUSSIAN.log_prob(outputs, raw), log_prob, rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(action, jnp.tanh(raw))


def test_density_and_its_slopes_are_finite_where_tanh_is_one():
    """In float32 tanh(15) is 1, of which the inverse is infinite."""
    raw = jnp.float32([[15.0], [-40.0]])
    outputs = jnp.float32([[14.0, 0.3], [-38.0, -1.0]])
    np.testing.assert_allclose(GAUSSIAN.log_prob(outputs, raw), plain_log_density(outputs, raw), rtol=1e-4)
    slopes = jax.grad(lambda *x: jnp.sum(GAUSSIAN.log_prob(*x)), argnums=(0, 1))(outputs, raw)
    assert all(np.all(np.isfinite(x)) and np.all(x != 0) for x in slopes)


# The divergence of two policies.


def plain_divergence(outputs, others):
    """KL(p | q) in float64, between the normals before the tanh."""
    (m, s), (other_m, other_s) = (
        (half[0], np.exp(-5 + 3.5 * (np.tanh(half[1]) + 1)))
        for half in (np.split(np.float64(x), 2, axis=-1) for x in (outputs, others))
    )
    return np.sum(np.log(other_s / s) + (s**2 + (m - other_m) ** 2) / (2 * other_s**2) - 0.5, axis=-1)


@pytest.mark.parametrize("middle", [0.0, 40.0], ids=["inside", "where tanh is 1"])
@pytest.mark.parametrize("apart", [1.0, 1e-3])
def test_divergence_of_two_policies(middle, apart):
    """Also of policies so near each other that the log-densities of their actions differ by no more than rounding."""
    random = np.random.default_rng(2)
    outputs = jnp.float32(random.normal(size=(50, 6)) + middle * np.repeat([1, 0], 3))
    others = jnp.float32(outputs + apart * random.normal(size=(50, 6)))
    found = GAUSSIAN.divergence(outputs, others)
    np.testing.assert_allclose(found, plain_divergence(outputs, others), rtol=1e-3)
    np.testing.assert_array_equal(GAUSSIAN.divergence(outputs, outputs), 0)


def test_divergence_is_the_mean_of_log_densities():
    """Over many actions; of actions that a task does not have, nothing."""
    outputs, others = jnp.float32(np.random.default_rng(3).normal(size=(2, 6)))
    _, raw, log_prob = GAUSSIAN.draw(jnp.tile(outputs, (100_000, 1)), None, KEY)
    np.testing.assert_allclose(
        GAUSSIAN.divergence(outputs, others), np.mean(log_prob - GAUSSIAN.log_prob(others, raw)), rtol=0.02
    )
    mask, first = jnp.float32([1, 0, 0]), np.array([0, 3])
    np.testing.assert_allclose(
        GAUSSIAN.divergence(outputs, others, mask), GAUSSIAN.divergence(outputs[first], others[first]), rtol=1e-6
    )


# Losses of one task.

ALPHA, TEMPERATURE = 0.3, 0.2


def charged(made, nets, obs):
    """Actions before the tanh, and log pi_i - alpha log pi_0 of them in NumPy."""
    own = made.policy_outputs(nets, FEATURES, obs)
    raw = GAUSSIAN.draw(own, None, KEY).raw
    common = made.actor.apply_distilled(nets["actor"], FEATURES, obs)
    densities = plain_log_density(own, raw), plain_log_density(common, raw)
    return raw, densities[0] - made.distral_alpha * densities[1], densities


def seen(rows, gamma=0.99):
    """What the losses see of transitions of one task."""
    fields = (rows.obs, rows.action, rows.reward, gamma * rows.discount, rows.next_obs)
    return Batch(*fields, features=FEATURES, temperature=TEMPERATURE, mask=None)


def test_critic_target(state, batch):
    """y = r + discount gamma (min Q - a (log pi_i - alpha log pi_0))."""
    made, rows = tiny("distral", distral_alpha=ALPHA, gamma=0.9), pick(batch, 1)
    nets, slow = of_task(state.nets, 1), of_task(state.nets | state.slow, 1)
    raw, cost, _ = charged(made, nets, rows.next_obs)
    values = np.min(made.values(slow, FEATURES, rows.next_obs, jnp.tanh(raw)), axis=0)
    expected = np.asarray(rows.reward) + 0.9 * np.asarray(rows.discount) * (values - TEMPERATURE * cost)
    found = made.critic_target(nets, slow, seen(rows, 0.9), KEY)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    plain = SAC.sample(made, nets, seen(rows), rows.next_obs, KEY).log_prob
    assert np.all(np.abs(cost - plain) > 0.1)  # that the distilled policy has a say here


def test_actor_loss(state, batch):
    """a (log pi_i - alpha log pi_0) - min Q of each policy, less log pi_0 of the distilled one."""
    made, rows = tiny("distral", distral_alpha=ALPHA), pick(batch, 1)
    nets = of_task(state.nets, 1)
    raw, cost, (own, common) = charged(made, nets, rows.obs)
    values = np.min(made.values(nets, FEATURES, rows.obs, jnp.tanh(raw)), axis=0)
    loss, (metrics, *_) = made.actor_loss(nets, seen(rows), KEY)
    policy_loss = np.mean(TEMPERATURE * cost - values)
    np.testing.assert_allclose(loss, policy_loss - np.mean(common), rtol=1e-4)
    np.testing.assert_allclose(metrics["actor_loss"], policy_loss, rtol=1e-4)
    np.testing.assert_allclose(metrics["entropy"], -np.mean(own), rtol=1e-4)
    distilled = made.actor.apply_distilled(nets["actor"], FEATURES, rows.obs)
    policies = made.policy_outputs(nets, FEATURES, rows.obs), distilled
    np.testing.assert_allclose(metrics["kl"], np.mean(plain_divergence(*policies)), rtol=1e-4)


def slopes(made, nets, rows, loss):
    """Gradients of a loss by what they are of: the task's policy, the distilled policy."""
    found = jax.grad(lambda actor: loss(made, nets | {"actor": actor}, seen(rows), KEY)[0])(nets["actor"])
    own = {name: found.own[name] for name in ("body", "head")}
    return own, found.shared["distilled"]


@pytest.mark.slow
def test_each_loss_reaches_its_own_policy_alone(state, batch):
    """The policy's never the distilled parameters, and distillation these alone, by its actions too."""
    made, rows = tiny("distral", distral_alpha=ALPHA), pick(batch, 1)
    nets = of_task(state.nets, 1)
    own, distilled = slopes(made, nets, rows, SAC.actor_loss)
    both_own, both_distilled = slopes(made, nets, rows, Distral.actor_loss)
    assert all(np.all(x == 0) for x in leaves(distilled))
    assert all(np.any(x != 0) for x in leaves((own, both_distilled)))
    assert same(own, both_own)

    actor, (raw, _, _) = nets["actor"], charged(made, nets, rows.obs)

    def fit(shared):
        outputs = made.actor.apply_distilled(Params({"distilled": shared}, actor.own), FEATURES, rows.obs)
        return -jnp.mean(GAUSSIAN.log_prob(outputs, raw))

    for found, expected in zip(leaves(both_distilled), leaves(jax.grad(fit)(actor.shared["distilled"])), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


def test_the_action_carries_the_distilled_policys_slope(state, batch):
    """Numeric slopes in NumPy, under critics that say nothing, along the biases of mean and deviation."""
    made, rows = tiny("distral", distral_alpha=ALPHA), pick(batch, 1)
    nets = of_task(state.nets, 1)
    mute = nets | {"critic": jax.tree.map(jnp.zeros_like, nets["critic"])}
    own, _ = slopes(made, mute, rows, Distral.actor_loss)
    outputs = np.asarray(made.policy_outputs(nets, FEATURES, rows.obs), np.float64)
    common = made.actor.apply_distilled(nets["actor"], FEATURES, rows.obs)
    noise = np.asarray(jax.random.normal(KEY, (BATCH, 2)), np.float64)

    def loss(bias):
        mean, log_std = np.split(outputs + bias, 2, axis=-1)
        raw = mean + np.exp(-5 + 3.5 * (np.tanh(log_std) + 1)) * noise
        cost = plain_log_density(outputs + bias, raw) - ALPHA * plain_log_density(common, raw)
        return TEMPERATURE * np.mean(cost)

    expected = [(loss(1e-5 * e) - loss(-1e-5 * e)) / 2e-5 for e in np.eye(4)]
    np.testing.assert_allclose(own["head"]["bias"], expected, rtol=2e-3, atol=1e-4)


# Updates.


def test_all_policies_begin_as_one(batch):
    """Where their divergence is zero."""
    init, update = learner(tiny("distral"), TASKS, BATCH, SPEC)
    fresh = init(TASKS, KEY)
    for i in range(3):
        own = {name: pick(fresh.nets["actor"].own[name], i) for name in ("body", "head")}
        assert same(own, fresh.nets["actor"].shared["distilled"])
    _, metrics = update(fresh, batch, TASKS, KEY)
    np.testing.assert_allclose(metrics["kl"], 0, atol=1e-9)


@pytest.mark.slow
def test_without_alpha_it_is_one_sac_for_every_task(state):
    """Policies, critics, slow critics and temperatures of agent ``disjoint``, update by update."""
    distral = learner(tiny("distral", distral_alpha=0.0), TASKS, BATCH, SPEC)[1]
    init, disjoint = learner(tiny("disjoint"), TASKS, BATCH, SPEC)
    mine, theirs = state, init(TASKS, KEY)
    own = lambda state: {name: state.nets["actor"].own[name] for name in ("body", "head")}
    theirs = with_nets(theirs, actor=Params({}, own(state)), critic=state.nets["critic"])._replace(slow=state.slow)
    for i in range(5):
        rows = random_batch(i, 3, BATCH, SPEC)
        mine, metrics = distral(mine, rows, TASKS, jax.random.key(i))
        theirs, expected = disjoint(theirs, rows, TASKS, jax.random.key(i))
        for name in expected:
            np.testing.assert_allclose(metrics[name], expected[name], rtol=1e-3, atol=1e-4)
    for part in (own, lambda x: (x.nets["critic"], x.slow, x.nets["temperature"])):
        for found, wanted in zip(leaves(part(mine)), leaves(part(theirs)), strict=True):
            np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4)
    assert not same(mine.nets["actor"].shared, state.nets["actor"].shared)  # the distilled policy looks on, and learns


def test_a_task_learns_from_its_own_data_alone(state, batch):
    """Other data of task 1 move what is its own, and what is distilled, and nothing of the other tasks."""
    _, update = learner(tiny("distral"), TASKS, BATCH, SPEC)
    other = jax.tree.map(lambda x: x.at[1].multiply(0.5), batch)
    (plain, _), (moved, _) = (update(state, rows, TASKS, KEY) for rows in (batch, other))
    slopes = lambda x: optax.tree_utils.tree_get(x.fits["critic"].optimizer, "mu")["critic"].own
    learned = lambda x: ([x.nets[name].own for name in ("actor", "critic", "temperature")], slopes(x))
    for i in range(3):
        assert same(pick(learned(plain), i), pick(learned(moved), i)) == (i != 1)
    assert not same(plain.nets["actor"].shared, moved.nets["actor"].shared)


# A bandit: one step, rewards -sharpness (action - goal)^2 with goals to both sides of 0.

GOAL, SHARPNESS, HEAT = 0.4, 1.0, 0.2


@dataclasses.dataclass(frozen=True)
class KnownCritic(Distral):
    """Its critics are a goal, about which they are right."""

    def values(self, nets, features, obs, action):
        return -SHARPNESS * jnp.square(action[None, :, 0] - nets["critic"].own)


def optimum(alpha):
    """Mean and deviation (before the tanh) of the first task's policy; the second's mirrors it.

    Policies minimise their loss by quadrature; the normal that fits both best has their moments: 0 and m^2 + s^2.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    weights = weights / weights.sum()
    log_normal = lambda raw, mean, std: -0.5 * ((raw - mean) / std) ** 2 - np.log(std) - 0.5 * np.log(2 * np.pi)

    def loss(x, common_std):
        mean, std = x[0], np.exp(x[1])
        raw = mean + std * nodes
        squash = 2 * np.log(np.cosh(raw))
        cost = log_normal(raw, mean, std) + squash - alpha * (log_normal(raw, 0.0, common_std) + squash)
        return weights @ (HEAT * cost + SHARPNESS * (np.tanh(raw) - GOAL) ** 2)

    x = np.array([GOAL, -1.0])
    for _ in range(200):
        common_std = np.hypot(x[0], np.exp(x[1]))
        x = scipy.optimize.minimize(loss, x, (common_std,), tol=1e-9).x
    return x[0], np.exp(x[1])


@pytest.mark.slow
@pytest.mark.parametrize("alpha", slow_but([0.0, 0.5, 0.9], 0.5))
def test_a_bandits_optimum(alpha):
    """The more the distilled policy counts, the nearer it draws the tasks' policies, and exactly so far."""
    made, optimizer = KnownCritic(hidden=(8,), distral_alpha=alpha), optax.adam(3e-3)
    rows = jax.tree.map(jnp.zeros_like, random_batch(0, 2, 256, Spec.vector(1, 1, 1)))
    goals, temperature = jnp.float32([GOAL, -GOAL]), jnp.full(2, HEAT)
    own = Batch(rows.obs, rows.action, rows.reward, rows.discount, rows.next_obs, jnp.zeros((2, 0)), temperature, None)
    nets = {"critic": Params({}, goals), "representation": Params({}, {}), "knowing": Params({}, {})}
    axes = axes_of(["actor", *nets])

    def learn(carry, key):
        actor, memory = carry
        loss = lambda actor, keys: jax.vmap(made.actor_loss, (axes, 0, 0))(nets | {"actor": actor}, own, keys)[0]
        slope = jax.grad(lambda actor: jnp.mean(loss(actor, jax.random.split(key, 2))))(actor)
        actor, memory = descent.step(optimizer, slope, memory, actor)
        policy = lambda nets: made.policy_outputs(nets, FEATURES, jnp.zeros(1))
        return (actor, memory), jax.vmap(policy, (axes,))(nets | {"actor": actor})

    actor = made.actor.init(KEY, 2, 2, FEATURES, jnp.zeros(1))
    run = partial(jax.jit, compiler_options=QUICK)(
        lambda *start: jax.lax.scan(learn, start, jax.random.split(KEY, 1500))
    )
    outputs = run(actor, optimizer.init(actor))[1]
    mean, log_std = np.split(np.mean(outputs[-500:], axis=0), 2, axis=-1)
    expected_mean, expected_std = optimum(alpha)
    np.testing.assert_allclose(mean[:, 0], [expected_mean, -expected_mean], atol=0.03)
    np.testing.assert_allclose(np.exp(-5 + 3.5 * (np.tanh(log_std) + 1)), expected_std, rtol=0.06)


@pytest.mark.slow
def test_optima_differ():
    """Or the test above would show nothing."""
    means = [optimum(alpha)[0] for alpha in (0.0, 0.5, 0.9)]
    assert means[0] > means[1] + 0.06 > means[2] + 0.12


# Acting.


def test_training_tasks_play_their_own_policies_and_others_the_distilled_one(state):
    """Whatever their contexts."""
    made, obs = tiny("distral"), jnp.float32([0.3, -1.0, 0.5])
    act = lambda task: np.asarray(act_once(made, state, obs, task, None))
    mean = lambda outputs: np.tanh(np.asarray(outputs)[:2])
    own = [made.policy_outputs(of_task(state.nets, i), FEATURES, obs) for i in range(3)]
    common = made.actor.apply_distilled(of_task(state.nets["actor"], 0), FEATURES, obs)
    for i in range(3):
        np.testing.assert_allclose(act(pick(TASKS, i)), mean(own[i]), rtol=1e-5)
    for number, context in ((3, 1.0), (9, -7.0)):
        unseen = pick(TASKS, 0)._replace(id=jnp.int32(number), context=jnp.float32([context]))
        np.testing.assert_allclose(act(unseen), mean(common), rtol=1e-5)
    assert len(np.unique(np.stack([mean(x) for x in (*own, common)]), axis=0)) == 4
    assert describe_unseen(made) == "the distilled policy plays them"


@pytest.mark.slow
@pytest.mark.parametrize("conditioning", one_in(2, ["one-hot", "parameters", "embedding"]))
def test_a_distilled_policy_may_be_told_the_task(conditioning):
    """As the others are; it then acts differently in different tasks."""
    made = tiny("distral", conditioning=conditioning)
    fresh = learner(made, TASKS, BATCH, SPEC)[0](TASKS, KEY)
    played = [
        np.asarray(act_once(made, fresh, jnp.ones(3), pick(TASKS, i)._replace(id=jnp.int32(7)), None)) for i in (0, 1)
    ]
    assert not np.allclose(played[0], played[1], atol=1e-3)
    assert ("nearest" in describe_unseen(made)) == (conditioning != "parameters")


# What makes no sense.


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"distral_alpha": 1.1}, r"distral-alpha must be in \[0, 1\], not 1.1"),
        ({"distral_alpha": float("nan")}, "distral-alpha must be"),
        ({"heads": "per-task"}, "a policy of its own: heads is disjoint, not per-task"),
        ({"gradients": "pcgrad"}, "no parameters that tasks share for gradients=pcgrad; use mean"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    """With what is allowed."""
    with pytest.raises(InputError, match=message):
        agent("distral", **settings)


# With PopArt.


@pytest.mark.slow
def test_with_popart_an_update_is_the_same_for_rewards_of_any_scale():
    """From the first one on, as the first units are those of rewards before it; temperatures are in these units."""
    scales, made = jnp.float32([0.01, 1.0, 100.0]), tiny("distral", scaling="popart", target_rate=0.1)
    init, update = learner(made, TASKS, BATCH, SPEC)
    begun, steps = init(TASKS, KEY), random_batch(0, 3, BATCH, SPEC)

    def after(by):
        window = steps._replace(reward=steps.reward * by[:, None])
        units = made.scaling.observe(begun.nets["scaling"].own, window)
        return update(with_nets(begun, scaling=Params({}, units)), window, TASKS, KEY)[0]

    plain, scaled = after(jnp.ones(3)), after(scales)
    for name in ("actor", "critic", "temperature"):
        for x, y in zip(leaves(plain.nets[name]), leaves(scaled.nets[name]), strict=True):
            np.testing.assert_allclose(x, y, atol=1e-5)
    old, new = (x.nets["scaling"].own for x in (plain, scaled))
    np.testing.assert_allclose(new.mean, scales * old.mean, rtol=1e-4)
    np.testing.assert_allclose(new.variance, jnp.square(scales) * old.variance, rtol=1e-4)
