"""The example of what earlier tasks teach: each of its four ways against numbers that are worked by hand."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import binom

import mtjax

FILE = Path(__file__).parents[1] / "examples" / "identify.py"
spec = importlib.util.spec_from_file_location("identify", FILE)
assert spec is not None and spec.loader is not None
identify = importlib.util.module_from_spec(spec)
spec.loader.exec_module(identify)
Counts, Model, Seen = identify.Counts, identify.Model, identify.Seen

CELLS = np.arange(identify.STATES * identify.ACTIONS) // identify.ACTIONS
ACTIONS = np.arange(identify.STATES * identify.ACTIONS) % identify.ACTIONS


def counted(rewards, visits, paid, cell=0, action=0):
    """Counts of visits to one action of one state, and of their rewards."""
    empty = np.zeros(np.shape(rewards)[1:])
    moves, sums = np.zeros((*empty.shape, len(empty))), empty.copy()
    moves[cell, action, 0], sums[cell, action] = visits, paid
    return Counts(jnp.asarray(moves), jnp.asarray(sums))


def seen(cell=0, action=0, reward=1.0, next_cell=0, noise=identify.NOISE):
    return Seen(cell, jnp.zeros(noise), action, jnp.float32(reward), next_cell, jnp.zeros(noise))


# Planning.


def test_values_of_a_plan():
    """A reward of 1/2 in each of three steps; discounted by 1/2 it is 7/8. Of two actions the better one follows."""
    one = Model(jnp.array([[0.5]]), jnp.ones((1, 1, 1)))
    np.testing.assert_allclose(identify.plan(one, 3).ravel(), [1.5, 1.0, 0.5])
    np.testing.assert_allclose(identify.plan(one, 3, 0.5)[0].ravel(), [0.875])
    fork = Model(jnp.array([[0.0, 0.25], [1.0, 0.0]]), jnp.array([[[0, 1.0], [1, 0]], [[0, 1], [1, 0]]]))
    np.testing.assert_allclose(identify.plan(fork, 2)[0], [[1.0, 0.5], [2.0, 0.25]])


# Elimination.


def test_one_visit_tells_where_a_sure_reward_differs():
    """Before it both models are possible, after it the right one is, whichever that is."""
    rewards = jnp.full((2, 3, 2), 0.5).at[0, 1, 1].set(0.0).at[1, 1, 1].set(1.0)
    left = lambda visits, paid: identify.possible(rewards, counted(rewards, visits, paid, 1, 1)).tolist()
    assert left(0, 0) == [True, True]
    assert left(1, 0) == [True, False] and left(1, 1) == [False, True]


@pytest.mark.parametrize(("gap", "visits"), [(1.0, 11), (0.5, 41), (0.25, 163)])
def test_visits_that_tell_two_models_apart(gap, visits):
    """2 ln(2 C / error) / gap^2 with C = 4 and an error of 1/20 is 10.15 / gap^2."""
    assert identify.visits_to_tell(gap, 4, 0.05) == visits


def test_the_farther_of_two_models_goes_after_so_many_visits():
    """0.3 and 0.8 differ by 1/2: 40 visits leave both, 41 the nearer one; a mean between both leaves both."""
    rewards = jnp.stack([jnp.full((1, 1), x) for x in (0.3, 0.8)])
    enough = int(identify.visits_to_tell(0.5, 2, 0.05))
    assert enough == 36  # 2 ln 80 / 0.25 = 35.06
    left = lambda visits, share: identify.possible(rewards, counted(rewards, visits, share * visits)).tolist()
    assert left(enough - 1, 0.75) == [True, True]
    assert left(enough, 0.75) == [False, True] and left(enough, 0.35) == [True, False]


@pytest.mark.parametrize("mean", [0.1, 0.5, 0.9])
def test_the_right_model_is_seldom_eliminated(mean, gap=0.4):
    """The exact chance that a mean is off by half the gap is below error / C."""
    visits = int(identify.visits_to_tell(gap, 4, 0.05))
    off = binom.cdf(np.floor(visits * (mean - gap / 2)), visits, mean)
    off += binom.sf(np.ceil(visits * (mean + gap / 2)) - 1, visits, mean)
    assert off < 0.05 / 4


def test_pairs_differ_most_where_they_say():
    """Three models make three pairs."""
    rewards = jnp.zeros((3, 2, 2)).at[0, 1, 0].set(0.75).at[2, 0, 1].set(0.5)
    pairs = identify.pairs_of(rewards)
    assert [*zip(*(x.tolist() for x in pairs), strict=True)] == [
        (0, 1, 1, 0, 0.75),
        (0, 2, 1, 0, 0.75),
        (1, 2, 0, 1, 0.5),
    ]


def test_clusters_are_the_classes():
    """Twelve tasks with a hundred visits everywhere; the mean of three tasks counts three hundred."""
    rewards = np.random.default_rng(0).permuted(np.tile(np.linspace(0, 1, 32), (4, 1)), axis=1).reshape(4, 8, 4)
    order = np.array([2, 0, 1, 3, 3, 1, 2, 0, 0, 1, 2, 3])
    counts = Counts(jnp.full((12, 8, 4, 8), 12.5), jnp.asarray(100 * rewards[order]))
    models = identify.clusters_of(counts)
    np.testing.assert_allclose(models.rewards, (300 * rewards[[2, 0, 1, 3]] + 1) / 302, rtol=1e-5)
    np.testing.assert_allclose(models.transitions, 1 / 8, rtol=1e-5)


# Thompson sampling.


def test_the_posterior_is_bayes_rule():
    """Classes that pay with 0.8, 0.5 and 0.2: 8, 5 and 2 of 15 after a reward; 16, 25 and 16 of 57 after a miss too."""
    moves = jnp.full((3, 1, 1, 1), 1.0)
    models = Model(jnp.array([0.8, 0.5, 0.2]).reshape(3, 1, 1), moves)
    first = identify.log_likelihoods(models, seen(reward=1.0))
    np.testing.assert_allclose(jax.nn.softmax(first), np.array([8, 5, 2]) / 15, rtol=1e-6)
    both = first + identify.log_likelihoods(models, seen(reward=0.0))
    np.testing.assert_allclose(jax.nn.softmax(both), np.array([16, 25, 16]) / 57, rtol=1e-6)


def test_moves_count_in_the_posterior():
    """Chances of 3/4 and 1/4 for the move and of 1/2 for the reward: 3 to 1."""
    models = Model(jnp.full((2, 2, 1), 0.5), jnp.array([[[[0.25, 0.75]]], [[[0.75, 0.25]]]]).repeat(2, axis=1))
    logs = identify.log_likelihoods(models, seen(cell=0, next_cell=1))
    np.testing.assert_allclose(jax.nn.softmax(logs), [0.75, 0.25], rtol=1e-6)


def test_counts_make_laplaces_model():
    """Two visits, one of them rewarded: (1 + 1) / (2 + 2); three states, of which one was come to twice: 3/5."""
    counts = Counts(jnp.zeros((3, 1, 3)), jnp.zeros((3, 1)))
    for reward in (1.0, 0.0):
        counts = counts.add(seen(cell=1, reward=reward, next_cell=2))
    model = counts.model()
    np.testing.assert_allclose(model.rewards[:, 0], [1 / 2, 1 / 2, 1 / 2])
    np.testing.assert_allclose(model.transitions[1, 0], [1 / 5, 1 / 5, 3 / 5], rtol=1e-6)


# A start.


def test_a_start_is_the_mean_and_backups_follow_deviations():
    """Tables (0, 2) and (4, 2) begin at (2, 2) and are in doubt of the first entry alone."""
    mean, share = identify.start_of(jnp.array([[[0.0, 2.0]], [[4.0, 2.0]]]))
    np.testing.assert_allclose(mean, [[2.0, 2.0]])
    np.testing.assert_allclose(share, [[1.0, 0.0]])
    _, share = identify.start_of(jnp.array([[[0.0, 1.0]], [[4.0, 3.0]]]))
    np.testing.assert_allclose(share, [[2 / 3, 1 / 3]], rtol=1e-6)


def test_a_backup_is_bellmans():
    """One visit that paid 1 and led where 2 is the best value: 1 + 0.9 x 2."""
    learner = identify.Table(taught=False, exploration=0.0)
    table = jnp.zeros((8, 4)).at[5, 3].set(2.0)
    state = learner.begin(identify.Lessons(*[None] * 3, jnp.ones((2, 8, 4)).at[0].set(0), None))._replace(table=table)
    state = learner.learn(None, state, seen(cell=1, action=2, reward=1.0, next_cell=5))
    np.testing.assert_allclose(state.table, table.at[1, 2].set(2.8), rtol=1e-6)


# The group lasso.


def test_rows_shrink_by_the_threshold():
    """max(0, 1 - t / ||w||) w: of (3, 4) a threshold of 1 leaves 4/5, and one of 5 nothing; 0 stays 0."""
    rows = jnp.array([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]])
    np.testing.assert_allclose(identify.shrink(rows, 1.0), [[2.4, 3.2], [0, 0], [0, 0]], rtol=1e-6)
    np.testing.assert_array_equal(identify.shrink(rows, 5.0), np.zeros((3, 2)))
    np.testing.assert_array_equal(identify.shrink(rows, 0.0), rows)


def test_shrinking_is_the_proximal_operator():
    """No nearby row has a smaller ||x - w||^2 / 2 + t ||x||."""
    row, threshold = np.array([1.0, -2.0, 0.5]), 0.7
    cost = lambda x: np.sum((x - row) ** 2) / 2 + threshold * np.linalg.norm(x)
    best = np.asarray(identify.shrink(jnp.asarray(row)[None], threshold)[0], np.float64)
    steps = np.random.default_rng(0).normal(size=(200, 3)) * 1e-2
    assert all(cost(best + step) > cost(best) for step in steps)


def test_with_orthonormal_features_the_lasso_shrinks_least_squares():
    """G = I: the solution is the proximal operator at the moments."""
    moments = jnp.array([[3.0, 0.3, 0.0], [4.0, 0.4, 0.1]])
    found = identify.group_lasso(jnp.stack([jnp.eye(3)] * 2), moments, 1.0)
    np.testing.assert_allclose(found, [[2.4, 3.2], [0, 0], [0, 0]], atol=1e-6)


def test_the_lasso_is_at_its_optimum():
    """Rows that are kept have a slope of -penalty w / ||w||, the others one of at most the penalty."""
    random, penalty = np.random.default_rng(1), 2.0
    data = random.normal(size=(3, 40, 6))
    grams = np.einsum("tnd,tne->tde", data, data)
    truth = np.vstack([random.normal(size=(2, 3)) * 2, np.zeros((4, 3))])
    moments = np.einsum("tde,et->td", grams, truth) + random.normal(size=(3, 6)) * 0.2
    weights = np.asarray(identify.group_lasso(jnp.asarray(grams), jnp.asarray(moments), penalty, steps=300))
    slope = np.einsum("tde,et->dt", grams, weights) - moments.T
    norms = np.linalg.norm(weights, axis=1)
    assert (norms > 0).tolist() == [True, True, False, False, False, False]
    np.testing.assert_allclose(slope[:2], -penalty * weights[:2] / norms[:2, None], atol=2e-3)
    assert np.all(np.linalg.norm(slope[2:], axis=1) <= penalty)


def test_fitted_values_are_those_of_value_iteration():
    """A process without chance, each action of each state seen once, without noise."""
    random = np.random.default_rng(2)
    following, rewards = random.integers(8, size=32), np.float32(random.integers(2, size=32))
    nothing = jnp.zeros((1, 32, identify.NOISE))
    steps = Seen(*(jnp.asarray(x)[None] for x in (CELLS, CELLS, ACTIONS, rewards, following, following)))
    steps = steps._replace(noise=nothing, next_noise=nothing)
    features = 32 + identify.ACTIONS * identify.NOISE
    regress = lambda grams: lambda moments: moments.T  # the features that are seen are orthonormal
    weights = identify.fitted_q(jnp.zeros((1, features)), steps, jnp.ones((1, 32)), regress, 100)[0]
    model = Model(jnp.asarray(rewards).reshape(8, 4), jax.nn.one_hot(following, 8).reshape(8, 4, 8))
    np.testing.assert_allclose(weights[:32].reshape(8, 4), identify.plan(model, 100, identify.DISCOUNT)[0], rtol=1e-5)
    np.testing.assert_array_equal(weights[32:], 0)


def test_noise_has_a_weight_for_each_action():
    """The second action's third number is worth 2."""
    weights = jnp.zeros(32 + identify.ACTIONS * identify.NOISE).at[5 * 4 + 1].set(3.0)
    weights = weights.at[32 + identify.NOISE + 2].set(2.0)
    noise = jnp.zeros(identify.NOISE).at[2].set(0.5)
    np.testing.assert_allclose(identify.values_of(weights, 5, noise), [0, 4, 0, 0])
    np.testing.assert_allclose(identify.features(5, noise, 1) @ weights, 4)


# Regret.


@pytest.fixture(scope="module")
def process():
    env = mtjax.make("tabular-mdp", num_states=8, num_actions=4, num_tasks=1, split="none")
    return env, jax.tree.map(lambda x: x[0], env.tasks())


def test_who_knows_the_task_has_no_regret(process):
    """Thompson sampling over classes that are all the true one."""
    env, task = process
    model = Model(task.goal["rewards"], task.goal["transitions"])
    models = jax.tree.map(lambda x: jnp.stack([x] * identify.CLASSES), model)
    plans = jnp.stack([identify.plan(model, identify.HORIZON)] * identify.CLASSES)
    lessons = identify.Lessons(models, plans, None, None, None)
    regret = jax.jit(lambda key: identify.regret_of(identify.Thompson(), env, lessons, task, key))(jax.random.key(0))
    np.testing.assert_array_equal(regret, np.zeros(identify.EPISODES))


class Wander:
    """Take a random action."""

    def begin(self, lessons):
        return jax.random.key(0)

    def prepare(self, lessons, state, episode, key):
        return key

    def values(self, lessons, state, cell, noise, moment):
        return jax.random.uniform(jax.random.fold_in(state, moment), (identify.ACTIONS,))

    def learn(self, lessons, state, seen):
        return state


def test_regret_is_what_a_policy_earns_less(process):
    """Of random actions: the best value less theirs, both by dynamic programming, to four standard errors."""
    env, task = process
    model = Model(task.goal["rewards"], task.goal["transitions"])
    run = jax.jit(jax.vmap(lambda key: identify.regret_of(Wander(), env, None, task, key)))
    regrets = np.asarray(run(jax.random.split(jax.random.key(1), 20))).ravel()
    uniform = Model(model.rewards.mean(1, keepdims=True), model.transitions.mean(1, keepdims=True))
    expected = np.mean(
        identify.plan(model, identify.HORIZON)[0].max(-1) - identify.plan(uniform, identify.HORIZON)[0, :, 0]
    )
    assert abs(regrets.mean() - expected) < 4 * regrets.std() / np.sqrt(regrets.size)
    assert expected > 10


@pytest.mark.nightly
def test_earlier_tasks_teach(tmp_path, monkeypatch):
    """Each learner of each panel has less regret than the last one, which was taught nothing; and a figure is drawn."""
    found = identify.measure(3)
    for learners in found.values():
        *taught, without = (regrets[:, -1].mean() for regrets in learners.values())
        assert all(regret < without for regret in taught)
    identify.draw(found, str(tmp_path / "identify.png"))
    assert (tmp_path / "identify.png").stat().st_size < 60_000
