"""Rules of gradient surgery on Gram matrices against the problems of their papers, in the space of parameters."""

import dataclasses
from functools import partial
from itertools import permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize, nnls

from mtjax.agents.parts.gradients import quadratic, rules
from mtjax.agents.parts.gradients.quadratic import RIDGE
from mtjax.agents.parts.gradients.surgery import RULES, gram_matrix
from mtjax.types import InputError

KEY = jax.random.key(4)


def random_jacobian(num_tasks, num_params=8, seed=0):
    """Gradients (T, P) of which many pairs conflict."""
    return np.random.default_rng(seed).normal(size=(num_tasks, num_params)).astype(np.float32)


def orders_of(key, num_tasks):
    """The orders (T, T) in which each task meets the others, itself included and skipped."""
    size = num_tasks + -num_tasks % min(num_tasks, rules.PCGRAD_BLOCK)
    rows = np.asarray(rules.orders(key, size))[:num_tasks]
    return np.stack([row[row < num_tasks] for row in rows])


def naive_pcgrad(jacobian, orders):
    """Algorithm 1 of Yu et al. (2020), projecting whole gradients; the mean where they sum."""
    jacobian = np.float64(jacobian)
    projected = jacobian.copy()
    for i, order in enumerate(orders):
        for j in order:
            inner = projected[i] @ jacobian[j]
            if j != i and inner < 0:
                projected[i] -= inner / (jacobian[j] @ jacobian[j]) * jacobian[j]
    return projected.mean(axis=0)


def plain_weigh(rule, gram, key=KEY):
    """The weights of a rule without a memory, by its name or itself."""
    rule = RULES[rule]() if isinstance(rule, str) else rule
    weights, memory = rule.weigh(rule.init(len(gram)), gram, jnp.ones(len(gram)), key)
    assert memory is None
    return weights


_weigh = jax.jit(plain_weigh, static_argnums=0)


def weigh(rule, jacobian, key=KEY):
    """The weights of gradients (T, P): one program for each rule and T, whatever P."""
    return _weigh(rule, gram_matrix(jnp.float32(jacobian)), key)


def weights_of(jacobian, key=KEY):
    return weigh("pcgrad", jacobian, key)


@pytest.mark.parametrize("num_tasks", [1, 2, 3, 5, 11, 50])
def test_pcgrad_on_the_gram_matrix_is_pcgrad_on_gradients(num_tasks):
    """With the same orders, for several draws of gradients and keys; 11 tasks are more than a block."""
    for seed in range(4):
        jacobian, key = random_jacobian(num_tasks, seed=seed), jax.random.key(seed)
        expected = naive_pcgrad(jacobian, orders_of(key, num_tasks))
        np.testing.assert_allclose(weights_of(jacobian, key) @ jacobian, expected, rtol=1e-4, atol=1e-5)


def test_two_conflicting_gradients_by_hand():
    """(1, 0) and (-1, 1): each loses its part along the other; (1/2, 1/2) and (0, 1), whose mean is (1/4, 3/4)."""
    jacobian = np.float32([[1.0, 0.0], [-1.0, 1.0]])
    np.testing.assert_allclose(weights_of(jacobian) @ jacobian, [0.25, 0.75], rtol=1e-6)


def test_gradients_without_conflict_are_averaged():
    """Exactly, orthogonal ones included."""
    jacobian = np.abs(random_jacobian(4))
    jacobian[0] = 0
    jacobian[0, 0] = 1
    jacobian[1, 0] = 0
    np.testing.assert_allclose(weights_of(jacobian), np.full(4, 0.25), rtol=1e-6)


def test_a_zero_gradient_changes_nothing():
    """A task that has nothing to say neither divides by zero nor moves the others."""
    pair = np.float32([[1.0, 0.0], [-1.0, 1.0]])
    with_zero = np.insert(pair, 1, 0, axis=0)
    # Sums, as the zero counts in the mean.
    np.testing.assert_allclose(3 * weights_of(with_zero) @ with_zero, 2 * weights_of(pair) @ pair, rtol=1e-5)
    np.testing.assert_allclose(weights_of(np.zeros((3, 5), np.float32)), np.full(3, 1 / 3), rtol=1e-6)


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20])
def test_pcgrad_does_not_depend_on_the_scale_of_the_loss(scale):
    """The weights stay, so that the update scales with the gradients."""
    jacobian = random_jacobian(5)
    np.testing.assert_array_equal(weights_of(jacobian), weights_of(jacobian * np.float32(scale)))


def test_orders_are_uniform_and_tasks_may_be_renamed():
    """The mean over keys is the mean over all orders, and permuting the tasks permutes it."""
    jacobian, swap = np.float32([[1, 0], [-0.6, 1], [-0.5, -0.9]]), np.array([2, 0, 1])
    keys = jax.random.split(KEY, 20_000)
    many = jax.jit(jax.vmap(partial(plain_weigh, "pcgrad"), (None, 0)))
    weights = np.asarray(many(gram_matrix(jacobian), keys))
    error = 5 * (weights @ jacobian).std(axis=0) / np.sqrt(len(weights)) + 1e-5
    exact = np.mean([naive_pcgrad(jacobian, [order] * 3) for order in permutations(range(3))], axis=0)
    assert np.all(error > 1e-4)  # the order matters for these gradients
    assert np.all(np.abs((weights @ jacobian).mean(axis=0) - exact) < error)
    renamed = np.asarray(many(gram_matrix(jacobian[swap]), keys))
    np.testing.assert_allclose(renamed.mean(axis=0), weights.mean(axis=0)[swap], atol=0.01)


@pytest.mark.parametrize("num_tasks", [3, 12])
def test_a_block_of_projections_is_those_one_by_one(num_tasks, monkeypatch):
    """However many are written out in one piece; also more blocks than are unrolled."""
    jacobian = random_jacobian(num_tasks)
    for block in (1, 4):
        monkeypatch.setattr(rules, "PCGRAD_BLOCK", block)
        expected = naive_pcgrad(jacobian, orders_of(KEY, num_tasks))
        weights = jax.jit(partial(plain_weigh, "pcgrad"))(gram_matrix(jacobian))
        np.testing.assert_allclose(weights @ jacobian, expected, atol=1e-5)


def test_orders_are_each_task_s_own():
    """Permutations, which differ between tasks and with the key."""
    found = np.asarray(rules.orders(KEY, 9))
    np.testing.assert_array_equal(np.sort(found, axis=1), np.tile(np.arange(9), (9, 1)))
    assert len(np.unique(found, axis=0)) == 9
    assert not np.array_equal(found, rules.orders(jax.random.key(5), 9))


# Rules of the Gram matrix alone, against their papers' problems solved in float64 on whole gradients.

C = rules.CAGrad().cagrad_radius
DETERMINISTIC = sorted(name for name, rule in RULES.items() if hasattr(rule.weigh, "__wrapped__"))
deterministic = pytest.mark.parametrize("rule", DETERMINISTIC)


def update_of(rule, jacobian):
    """The update (P,) of gradients (T, P), summed in float64."""
    return np.float64(weigh(rule, jacobian)) @ np.float64(jacobian)


def reference_cagrad(jacobian, c=C):
    """max_d min_i g_i . d within c |g_0| of g_0, over t = (d - g_0) / (c |g_0|) and the level."""
    mean = jacobian.mean(axis=0)
    radius = c * np.linalg.norm(mean)
    move = lambda point: mean + radius * point[:-1]
    constraints = (
        {"type": "ineq", "fun": lambda point: jacobian @ move(point) - point[-1]},
        {"type": "ineq", "fun": lambda point: 1 - point[:-1] @ point[:-1]},
    )
    start = np.append(np.zeros_like(mean), (jacobian @ mean).min())
    found = minimize(lambda point: -point[-1], start, constraints=constraints, options={"ftol": 1e-14, "maxiter": 1000})
    assert found.status in (0, 8)  # 8: no further descent in float64
    return move(found.x) / (1 + c**2)


def reference_mgda(jacobian):
    """The shortest vector of the convex hull: with the least squares sum w = 1 beside J^T w = 0, up to a factor."""
    weights, _ = nnls(np.vstack([jacobian.T, np.ones(len(jacobian))]), np.append(np.zeros(jacobian.shape[1]), 1.0))
    return weights / weights.sum() @ jacobian


def reference_imtl_g(jacobian):
    """The paper's closed form: w_2..T = g_1 U^T (D U^T)^-1 of differences of gradients D and of directions U.

    Then the bound: magnitudes of ten in all where the update is longer, or turned against the tasks.
    """
    units = jacobian / np.linalg.norm(jacobian, axis=1, keepdims=True)
    across = (units[0] - units[1:]).T
    others = jacobian[0] @ across @ np.linalg.inv((jacobian[0] - jacobian[1:]) @ across)
    weights = np.append(1 - others.sum(), others)
    gain = units[0] @ (weights @ jacobian)
    size = np.abs(weights).sum() / 10
    return weights @ jacobian / (max(1, size) if gain > 0 else -size)


def reference_nash_mtl(jacobian):
    """G a = 1 / a, where a^T G a / 2 - sum log a is stationary in log a."""
    gram = jacobian @ jacobian.T
    scaled = lambda x: np.exp(x)[:, None] * gram * np.exp(x)
    found = minimize(
        lambda x: scaled(x).sum() / 2 - x.sum(),
        -np.log(np.diag(gram)) / 2,
        jac=lambda x: scaled(x).sum(axis=1) - 1,
        hess=lambda x: scaled(x) + np.diag(scaled(x).sum(axis=1)),
        method="trust-exact",
        options={"gtol": 1e-10},
    )
    np.testing.assert_allclose(scaled(found.x).sum(axis=1), 1, atol=1e-7)
    return np.exp(found.x) / np.exp(found.x).sum() @ jacobian


def reference_aligned_mtl(jacobian):
    """With J = P S Q^T, the mean row of s_min P Q^T."""
    left, stretch, right = np.linalg.svd(jacobian, full_matrices=False)
    return stretch.min() * (left @ right).mean(axis=0)


def reference_upgrad(jacobian):
    """The mean of projections onto the cone, each by non-negative least squares."""
    return np.mean([g + nnls(jacobian.T, -g, maxiter=1000)[0] @ jacobian for g in jacobian], axis=0)


ROOT = np.sqrt(2)


@pytest.mark.parametrize(
    "rule, weights",
    [
        ("cagrad", (0.6, 0.4)),  # d = (1/4, 1/2) / 1.25: with g_0 = (0, 1/2) and |d - g_0| = 1/4, both gain 1/4
        ("mgda", (0.6, 0.4)),  # (1 - 2 w_2)^2 + w_2^2 is least where 10 w_2 = 4
        ("imtl-g", (2 - ROOT, ROOT - 1)),  # the angle's bisector: w ~ 1 / |g|
        ("nash-mtl", (2 - ROOT, ROOT - 1)),  # the bisector too, as two tasks have one cosine
        ("aligned-mtl", (1 - 1 / np.sqrt(5)) * np.array([1, 0.75])),  # G^(-1/2) = ((3, 1), (1, 2)) / sqrt 5
        ("upgrad", (1, 0.75)),  # the projections (1/2, 1/2) = g_1 + g_2 / 2 and (0, 1) = g_1 + g_2
    ],
)
def test_two_conflicting_gradients_of_unequal_length_by_hand(rule, weights):
    """(1, 0) and (-1, 1)."""
    tolerance = 1e-3 if rule == "cagrad" else 1e-4  # the second task is only just held back: between grid points
    np.testing.assert_allclose(weigh(rule, [[1, 0], [-1, 1]]), weights, atol=tolerance)


@deterministic
@pytest.mark.parametrize("shift", [0.0, 0.5, 1.0], ids=["conflict", "some conflict", "little conflict"])
@pytest.mark.parametrize("shape", [(3, 4), (8, 12)])
def test_rules_solve_their_problems(rule, shape, shift):
    """Against solvers that know nothing of Gram matrices; to 1e-3 for CAGrad, which interpolates, else to 4e-4."""
    solve = globals()[f"reference_{rule.replace('-', '_')}"]
    for seed in range(4):
        jacobian = np.float64(random_jacobian(*shape, seed) + np.float32(shift))
        jacobian *= np.linspace(0.3, 2, len(jacobian))[:, None]
        expected = solve(jacobian)
        error = np.linalg.norm(update_of(rule, jacobian) - expected) / np.linalg.norm(expected)
        assert error < (1e-3 if rule == "cagrad" else 4e-4), seed


@pytest.mark.parametrize("spread", [0, 2], ids=["equal lengths", "lengths from 0.01 to 100"])
@pytest.mark.parametrize("num_params", [4, 200], ids=["no way to improve", "a way to improve"])
def test_rules_are_certain_of_fifty_tasks(num_params, spread):
    """What each promises, in float64: duality gaps and conditions of optimality, relative to the gradients involved."""
    jacobian = np.float64(random_jacobian(50, num_params))
    jacobian *= 10 ** np.random.default_rng(1).uniform(-spread, spread, size=(50, 1))
    lengths, mean = np.linalg.norm(jacobian, axis=1), jacobian.mean(axis=0)

    weights = np.float64(weigh("cagrad", jacobian)) * (1 + C**2)
    move, radius = weights @ jacobian - mean, C * np.linalg.norm(mean)
    assert np.linalg.norm(move) < radius * (1 + 1e-4)
    simplex = np.maximum(weights - 1 / 50, 0) / np.maximum(weights - 1 / 50, 0).sum()
    bound = simplex @ jacobian @ mean + radius * np.linalg.norm(simplex @ jacobian)  # no d improves all by more
    assert bound - (jacobian @ (mean + move)).min() < 1e-3 * np.linalg.norm(mean) * (simplex @ lengths)

    weights = np.float64(weigh("mgda", jacobian))
    shortest = weights @ jacobian
    assert shortest @ shortest - (jacobian @ shortest).min() < 5e-3 * (weights @ lengths) ** 2
    assert abs(weights.sum() - 1) < 1e-5 and weights.min() > 0

    cone = update_of("upgrad", jacobian)
    assert np.all(jacobian @ cone > -1e-4 * lengths * lengths.mean())
    np.testing.assert_allclose(cone, reference_upgrad(jacobian), atol=1e-4 * lengths.mean())

    weights = np.float64(weigh("nash-mtl", jacobian)) * lengths
    cosines = jacobian @ jacobian.T / np.outer(lengths, lengths) + 50 * RIDGE * np.eye(50)
    gains = weights * (cosines @ weights)
    assert np.ptp(gains) < (0.2 if num_params < 50 else 1e-4) * gains.mean() and weights.min() > 0


@deterministic
def test_all_zero_gradients_are_averaged(rule):
    """Exactly."""
    np.testing.assert_array_equal(weigh(rule, jnp.zeros((3, 5))), np.full(3, np.float32(1 / 3)))


@deterministic
def test_a_task_without_gradient_has_no_say(rule):
    """The others' update stays: as it is where weights sum to one, and times T where tasks are averaged."""
    jacobian = random_jacobian(3)
    with_zero = np.insert(jacobian, 1, 0, axis=0)
    ratio = 1 if rule in ("mgda", "imtl-g", "nash-mtl") else 3 / 4
    np.testing.assert_allclose(update_of(rule, with_zero), ratio * update_of(rule, jacobian), rtol=1e-3, atol=1e-4)


@deterministic
def test_rules_do_not_depend_on_scale_or_order(rule):
    """Weights stay when all losses are scaled, and are renamed with the tasks."""
    jacobian, swap = random_jacobian(5), np.array([2, 0, 4, 1, 3])
    weights = weigh(rule, jacobian)
    for scale in (1e-5, 1e5):
        np.testing.assert_allclose(weigh(rule, jacobian * np.float32(scale)), weights, atol=2e-4)
    np.testing.assert_allclose(weigh(rule, jacobian[swap]), weights[swap], atol=2e-4)


@pytest.mark.parametrize("rule", ["imtl-g", "nash-mtl"])
def test_the_scale_of_one_loss_does_not_turn_the_update(rule):
    """For the rules that promise it; averaging would turn it by 45 degrees."""
    jacobian = random_jacobian(3)
    turned = update_of(rule, jacobian * np.float32([[1], [100], [0.01]]))
    plain = update_of(rule, jacobian)
    assert turned @ plain > (1 - 1e-5) * np.linalg.norm(turned) * np.linalg.norm(plain)


@deterministic
def test_rules_agree_without_conflict(rule):
    """Orthogonal gradients of one length and identical ones are averaged; CAGrad goes on by c, then rescales."""
    ratio = (1 + C) / (1 + C**2) if rule == "cagrad" else 1
    for jacobian in (np.eye(5, 6), np.tile(random_jacobian(1), (5, 1))):
        np.testing.assert_allclose(update_of(rule, jacobian), ratio * jacobian.mean(axis=0), rtol=2e-4, atol=2e-5)


def test_upgrad_averages_wherever_nothing_conflicts():
    """Of unequal lengths and angles, orthogonal pairs included."""
    jacobian = np.abs(random_jacobian(5))
    jacobian[0] = np.eye(8)[0]
    jacobian[1, 0] = 0
    np.testing.assert_allclose(weigh("upgrad", jacobian), np.full(5, 0.2), atol=1e-4)


HARD = {
    "one task": np.ones((1, 3)),
    "opposite": np.array([[1.0, 0], [-1, 0]]),
    "opposite, unequal": np.array([[2.0, 0], [-1, 0]]),
    "repeated and opposite": np.array([[1.0, 2], [1, 2], [1, 2], [-1, -2], [0, 1]]),
    "nearly repeated": np.array([[1.0, 0], [1, 1e-4], [1, -1e-4]]),
    "fifty in a plane": random_jacobian(50, 2),
    "fifty identical": np.ones((50, 3)),
    "lengths from 1e-6 to 1e6": random_jacobian(8) * np.logspace(-6, 6, 8, dtype=np.float32)[:, None],
    "one of 1e-15": np.array([[1.0, 0], [0, 1e-15], [-1, 1]]),
}


@deterministic
@pytest.mark.parametrize("name", HARD)
def test_hard_gradients_give_finite_updates(rule, name):
    """No longer than the longest gradient by more than rounding; UPGrad adds projections up to T times."""
    jacobian = np.float64(HARD[name])
    longest = np.linalg.norm(jacobian, axis=1).max()
    assert np.all(np.isfinite(weigh(rule, jacobian)))
    assert np.linalg.norm(update_of(rule, jacobian)) < longest * (1.2 + 1e-3)


@deterministic
def test_opposite_gradients_stop(rule):
    """Of equal length: no rule prefers one of two tasks."""
    np.testing.assert_allclose(update_of(rule, [[1.0, 2.0], [-1.0, -2.0]]), 0, atol=1e-3)


def test_cagrad_gives_way_no_further_than_it_may_where_none_can_improve():
    """(2, 0) and (-1, 0): with g_0 = (1/2, 0), the second task loses least at d = (1 - c) g_0."""
    np.testing.assert_allclose(update_of("cagrad", [[2.0, 0], [-1, 0]]), [(1 - C) / 2 / (1 + C**2), 0], atol=1e-3)


def test_imtl_g_does_not_turn_against_tasks_that_agree():
    """As the paper's weights do, by summing to one, where the short gradient of three has a negative weight."""
    lengths = np.array([[0.01], [1], [1]])
    units = np.array([[1, 0, 0], [0.8, 0.56, np.sqrt(0.0464)], [0.8, -0.56, np.sqrt(0.0464)]])
    weights = np.linalg.solve(units @ units.T, np.ones(3)) / lengths[:, 0]
    assert weights.sum() < 0
    jacobian = lengths * units
    weights = np.float64(weigh("imtl-g", jacobian))
    assert abs(np.abs(weights).sum() - 10) < 1e-3 and np.all(jacobian @ (weights @ jacobian) > 0)


@deterministic
def test_rules_under_vmap(rule):
    """Seeds side by side receive what each would alone."""
    jacobians = np.stack([random_jacobian(5, seed=seed) for seed in range(3)])
    together = jax.jit(jax.vmap(partial(plain_weigh, rule)))(jax.vmap(gram_matrix)(jacobians))
    np.testing.assert_allclose(together, [weigh(rule, jacobian) for jacobian in jacobians], rtol=1e-3, atol=2e-4)


@pytest.mark.parametrize("radius", [0.2, 0.9])
def test_cagrad_goes_as_far_as_its_radius(radius):
    """Its hyper-parameter is the paper's c."""
    jacobian = np.float64(random_jacobian(4, 6) + np.float32(0.3))
    update = np.float64(weigh(rules.CAGrad(radius), jacobian)) @ jacobian
    expected = reference_cagrad(jacobian, radius)
    assert np.linalg.norm(update - expected) < 2e-3 * np.linalg.norm(expected)


# Rules as parts.


@pytest.mark.parametrize("name", RULES)
def test_rules_are_static_under_jit(name):
    """Frozen, hashable, equal if their settings are, and documented."""
    rule = RULES[name]()
    assert rule == RULES[name]() and hash(rule) == hash(RULES[name]()) and RULES[name].__doc__
    assert all(rule != other() for other in RULES.values() if other is not RULES[name])
    with pytest.raises(dataclasses.FrozenInstanceError):
        rule.anything = 1


def test_the_mean_is_the_mean():
    """Whatever the gradients."""
    np.testing.assert_allclose(weigh("mean", random_jacobian(4)), np.full(4, 0.25))


@pytest.mark.parametrize("radius", [0.0, 1.0, -0.5, float("nan")])
def test_a_radius_that_makes_no_sense_is_refused(radius):
    """CAGrad's promise to descend the mean needs c < 1."""
    with pytest.raises(InputError, match=r"cagrad-radius must be in \(0, 1\), not"):
        rules.CAGrad(radius)


@pytest.mark.parametrize("size", [1, 3, 10, 11])
def test_small_systems_are_solved_as_lapack_does(size):
    random = np.random.default_rng(size)
    factor = random.normal(size=(5, size, size))
    matrix = factor @ factor.swapaxes(1, 2) + 0.1 * np.eye(size)
    sides = random.normal(size=(5, size, 2))
    found = jax.vmap(quadratic.solve)(jnp.float32(matrix), jnp.float32(sides))
    assert found == pytest.approx(np.linalg.solve(matrix, sides), rel=1e-3, abs=1e-3)
