"""Gradient surgery on Gram matrices against the algorithm as written, in the space of parameters."""

from itertools import permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.agents import surgery
from mtjax.networks import Params

KEY = jax.random.key(4)


def random_jacobian(num_tasks, num_params=8, seed=0):
    """Gradients (T, P) of which many pairs conflict."""
    return np.random.default_rng(seed).normal(size=(num_tasks, num_params)).astype(np.float32)


def orders_of(key, num_tasks):
    """The orders (T, T) in which each task meets the others: a permutation a task, itself included and skipped."""
    return np.asarray(_orders(jax.random.split(key, num_tasks)))


@jax.jit
def _orders(keys):
    return jax.vmap(lambda k: jax.random.permutation(k, len(keys)))(keys)


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


@jax.jit
def weights_of(jacobian, key=KEY):
    gram = surgery.gram_matrix(jnp.asarray(jacobian))
    return surgery.pcgrad(gram, key)


@pytest.mark.parametrize("num_tasks", [1, 2, 3, 5, 11])
def test_pcgrad_on_the_gram_matrix_is_pcgrad_on_gradients(num_tasks):
    """With the same orders, for several draws of gradients and keys; 11 tasks are more than are unrolled."""
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
    many = jax.jit(lambda gram: jax.vmap(lambda k: surgery.pcgrad(gram, k))(jax.random.split(KEY, 20_000)))
    weights = np.asarray(many(surgery.gram_matrix(jnp.asarray(jacobian))))
    error = 5 * (weights @ jacobian).std(axis=0) / np.sqrt(len(weights)) + 1e-5
    exact = np.mean([naive_pcgrad(jacobian, [order] * 3) for order in permutations(range(3))], axis=0)
    assert np.all(error > 1e-4)  # the order matters for these gradients
    assert np.all(np.abs((weights @ jacobian).mean(axis=0) - exact) < error)
    renamed = np.asarray(many(surgery.gram_matrix(jnp.asarray(jacobian[swap]))))
    np.testing.assert_allclose(renamed.mean(axis=0), weights.mean(axis=0)[swap], atol=0.01)


def test_gram_matrix_is_of_all_leaves():
    """J J^T of the flattened gradients, whatever the shapes of the leaves."""
    random = np.random.default_rng(0)
    leaves = {"a": random.normal(size=(3, 4, 2)), "b": [random.normal(size=3), random.normal(size=(3, 5))]}
    flat = np.concatenate([x.reshape(3, -1) for x in (leaves["a"], *leaves["b"])], axis=1)
    np.testing.assert_allclose(surgery.gram_matrix(jax.tree.map(jnp.float32, leaves)), flat @ flat.T, rtol=1e-4)


def test_conflicts_by_hand():
    """Of the pairs of (1, 0), (0, 2), (-3, 0) one points apart: cosines 0, -1 and 0."""
    jacobian = jnp.float32([[1, 0], [0, 2], [-3, 0]])
    found = surgery.conflicts(surgery.gram_matrix(jacobian))
    np.testing.assert_allclose((found["cosine"], found["conflict"]), (-1 / 3, 1 / 3), rtol=1e-6)


@pytest.mark.parametrize("jacobian", [np.ones((1, 2)), np.zeros((3, 2))], ids=["one task", "zero gradients"])
def test_conflicts_of_nothing_are_zero(jacobian):
    """And finite, for a single task and for tasks without gradients."""
    found = surgery.conflicts(surgery.gram_matrix(jnp.float32(jacobian)))
    assert found["cosine"] == found["conflict"] == 0


# The gradient of losses of both kinds of parameter.

TASKS = 3
DATA = {"goal": np.float32([[1.0, -1.0], [-2.0, 0.5], [0.3, 3.0]]), "offset": np.float32([0.5, -1.0, 2.0])}
PARAMS = Params(shared={"x": jnp.float32([0.2, -0.4])}, own={"y": jnp.float32([[1.0], [2.0], [-0.5]])})


def quadratic(params, data):
    """|x - goal|^2 + (x_0 y - offset)^2, in which shared and own parameters meet."""
    fit = params.shared["x"][0] * params.own["y"][0] - data["offset"]
    loss = jnp.sum(jnp.square(params.shared["x"] - data["goal"])) + jnp.square(fit)
    return loss, {"fit": fit}


def by_hand():
    """Shared gradients (T, 2) and own gradients (T, 1) of each task's loss."""
    x, y = np.asarray(PARAMS.shared["x"]), np.asarray(PARAMS.own["y"])[:, 0]
    fit = x[0] * y - DATA["offset"]
    shared = 2 * (x - DATA["goal"])
    shared[:, 0] += 2 * fit * y
    return shared, (2 * fit * x[0])[:, None], fit


def test_mean_is_the_gradient_of_the_mean_loss():
    """For shared and own parameters, against the slopes worked out by hand and against a mean of vmap(grad)."""
    gradients, aux, metrics = surgery.gradient("mean", quadratic, PARAMS, DATA, KEY)
    shared, own, fit = by_hand()
    np.testing.assert_allclose(gradients.shared["x"], shared.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(gradients.own["y"], own / TASKS, rtol=1e-5)
    np.testing.assert_allclose(aux["fit"], fit, rtol=1e-5)
    assert metrics == {}
    alone = lambda own, data: jax.grad(lambda shared: quadratic(Params(shared, own), data)[0])(PARAMS.shared)
    each = jax.vmap(alone)(PARAMS.own, DATA)
    np.testing.assert_allclose(gradients.shared["x"], each["x"].mean(axis=0), rtol=1e-5)


def test_pcgrad_projects_shared_parameters_alone():
    """Shared ones as in the naive algorithm, whose conflicts own parameters do not decide; own ones are averaged."""
    gradients, aux, metrics = surgery.gradient("pcgrad", quadratic, PARAMS, DATA, KEY)
    shared, own, fit = by_hand()
    expected = naive_pcgrad(shared, orders_of(KEY, TASKS))
    assert not np.allclose(expected, shared.mean(axis=0), rtol=0.05)
    np.testing.assert_allclose(gradients.shared["x"], expected, rtol=1e-4)
    np.testing.assert_allclose(gradients.own["y"], own / TASKS, rtol=1e-5)
    np.testing.assert_allclose(aux["fit"], fit, rtol=1e-5)
    assert set(metrics) == {"cosine", "conflict"} and metrics["conflict"] > 0


def test_rules_agree_where_tasks_do():
    """The same data for every task: nothing conflicts, and projecting is averaging."""
    same = {k: np.repeat(v[:1], TASKS, axis=0) for k, v in DATA.items()}
    params = PARAMS._replace(own={"y": jnp.ones((TASKS, 1))})
    mean, _, _ = surgery.gradient("mean", quadratic, params, same, KEY)
    projected, _, metrics = surgery.gradient("pcgrad", quadratic, params, same, KEY)
    for a, b in zip(jax.tree.leaves(mean), jax.tree.leaves(projected), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)
    np.testing.assert_allclose((metrics["cosine"], metrics["conflict"]), (1, 0), atol=1e-6)
