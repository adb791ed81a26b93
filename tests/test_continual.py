"""Learning tasks one after another: penalties by their closed forms, and weights that later tasks do not change."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mtjax.agents.parts import forgetting
from mtjax.agents.parts.forgetting import FREE, anchor, penalty

RANDOM = np.random.default_rng(0)
CURVATURES, OPTIMA = np.float32(RANDOM.uniform(0.5, 3, (3, 4))), np.float32(RANDOM.normal(size=(3, 4)))
params_of = lambda theta: {"w": jnp.reshape(theta, (2, 2))}
quadratic = lambda params, i: jnp.sum(CURVATURES[i] * jnp.square(params["w"].ravel() - OPTIMA[i])) / 2


def optimum(loss):
    """The optimum of a quadratic loss, by one step of Newton's method from elsewhere."""
    flat = lambda theta: loss(params_of(theta))
    start = jnp.ones(4)
    return start - jnp.linalg.solve(jax.hessian(flat)(start), jax.grad(flat)(start))


# Penalties.


def test_the_penalty_of_two_quadratics_by_its_closed_form():
    """The optimum is (B + l F)^-1 (B b + l F a) if the first task has left a, with importance F."""
    coefficient, a, fisher = 2.5, OPTIMA[0], CURVATURES[0]
    held = anchor(params_of(a), params_of(fisher))
    found = optimum(lambda params: quadratic(params, 1) + penalty(held, params, coefficient))
    b, curvature = OPTIMA[1], CURVATURES[1]
    expected = (curvature * b + coefficient * fisher * a) / (curvature + coefficient * fisher)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_tasks_one_after_another_are_learned_as_all_at_once():
    """If the importances are the losses' curvatures, and these are diagonal."""
    held = anchor(params_of(OPTIMA[0]), params_of(CURVATURES[0]))
    for i in (1, 2):
        theta = optimum(lambda params, i=i, held=held: quadratic(params, i) + penalty(held, params, 1.0))
        held = anchor(params_of(theta), params_of(CURVATURES[i]), held)
    together = np.sum(CURVATURES * OPTIMA, axis=0) / np.sum(CURVATURES, axis=0)
    np.testing.assert_allclose(theta, together, rtol=1e-5)


def test_all_parameters_are_equally_important_to_l2():
    """The penalty is c / 2 |theta - anchor|^2, and 0 at the anchor."""
    params = {"w": jnp.array([[1.0, 2.0]]), "b": jnp.array([3.0])}
    held = anchor(params, forgetting.l2(params))
    moved = jax.tree.map(lambda x: x + 2, params)
    assert float(penalty(held, moved, 0.5)) == 0.25 * 3 * 4 and float(penalty(held, params, 0.5)) == 0


def test_the_importance_of_a_gaussian_policy():
    """Of N(w x, s): x^2 / s^2 for w, and 2 / s^2 for s, averaged over inputs."""
    x, params = np.float32([1.0, -2.0, 0.5]), {"w": jnp.float32(0.3), "s": jnp.float32(0.4)}
    outputs = lambda params, x: jnp.stack([params["w"] * x, params["s"]])
    information = lambda outputs: jnp.stack([1 / outputs[1] ** 2, 2 / outputs[1] ** 2])
    found = forgetting.ewc(outputs, information, params, x)
    assert float(found["w"]) == pytest.approx(np.mean(x**2) / 0.4**2, rel=1e-5)
    assert float(found["s"]) == pytest.approx(2 / 0.4**2, rel=1e-5)


def test_the_importance_is_the_curvature_of_the_divergence(random):
    """Of log-probabilities, which weigh pi: the diagonal of the second derivative of KL(pi | pi_theta) at pi."""
    x, params = np.float32(random.normal(size=(5, 2))), {"w": jnp.float32(random.normal(size=(2, 3)))}
    outputs = lambda params, x: jax.nn.log_softmax(x @ params["w"])
    found = forgetting.ewc(outputs, jnp.exp, params, x)

    def divergence(flat):
        one = lambda x: jnp.exp(outputs(params, x)) @ (outputs(params, x) - outputs({"w": flat.reshape(2, 3)}, x))
        return jnp.mean(jax.vmap(one)(x))

    curvature = jnp.diag(jax.hessian(divergence)(params["w"].ravel()))
    np.testing.assert_allclose(found["w"].ravel(), curvature, rtol=1e-4)


@pytest.mark.parametrize("x", [[1.0, -2.0, 0.5], np.arange(96.0)], ids=["one", "three groups"])
def test_the_importance_of_a_linear_network_to_mas(x):
    """|d (w x)^2 / dw| = 2 |w| x^2, averaged over inputs."""
    x, params = np.float32(x), {"w": jnp.float32(-0.3)}
    found = forgetting.mas(lambda params, x: (params["w"] * x)[None], params, x)
    assert float(found["w"]) == pytest.approx(2 * 0.3 * np.mean(x**2), rel=1e-5)


# PackNet.


def network(params, x):
    """The outputs (N,) of a network with one hidden layer at inputs (N, 2)."""
    hidden = jnp.tanh(x @ params["first"]["kernel"] + params["first"]["bias"])
    return (hidden @ params["second"]["kernel"])[:, 0]


def blank(random):
    normal = lambda *shape: jnp.float32(random.normal(size=shape))
    return {"first": {"kernel": normal(2, 32), "bias": normal(32)}, "second": {"kernel": normal(32, 1) / 6}}


def learn(params, owners, owner, x, y, seen, steps=1000):
    """Learn y (N,) by AdamW, which decays all weights, with those that ``owner`` has."""
    optimizer = optax.adamw(1e-2, weight_decay=0.01)
    error = lambda params: jnp.mean(jnp.square(network(seen(params), x) - y))

    def step(carry, _):
        params, memory = carry
        updates, memory = optimizer.update(jax.grad(error)(params), memory, params)
        updates = jax.tree.map(lambda x, given: jnp.where(given == owner, x, 0.0), updates, owners)
        return (optax.apply_updates(params, updates), memory), None

    return jax.lax.scan(step, (params, optimizer.init(params)), length=steps)[0][0]


def learn_pruned(params, owners, task, share, x, y):
    """Learn a task with the free weights, keep a share of them, and go on with these."""
    params = jax.jit(lambda params: learn(params, owners, FREE, x, y, lambda params: params))(params)
    params, owners = forgetting.prune(params, owners, task, share)
    seen = lambda params: forgetting.seen_by(params, owners, task)
    return jax.jit(lambda params: learn(params, owners, task, x, y, seen))(params), owners


@pytest.mark.slow
def test_later_tasks_change_nothing_of_earlier_ones_to_the_bit(random):
    """Though they are others, and the optimiser decays weights; and each is learned."""
    x = jnp.float32(random.normal(size=(40, 2)))
    tasks = [jnp.sin(2 * x[:, 0]), x[:, 1], jnp.abs(x[:, 0])]
    params, then = blank(random), []
    owners = forgetting.unowned(params)
    outputs = jax.jit(lambda params, owners, task: network(forgetting.seen_by(params, owners, task), x))
    for i, y in enumerate(tasks, 1):
        params, owners = learn_pruned(params, owners, i, 1 / (4 - i), x, y)
        then.append((np.asarray(outputs(params, owners, i)), y))
    for i, (before, y) in enumerate(then, 1):
        np.testing.assert_array_equal(outputs(params, owners, i), before)
        assert np.mean(np.square(before - y)) < 0.2 * np.var(y)
    assert all(np.all(np.asarray(x) > FREE) for x in jax.tree.leaves(owners))


def test_a_task_keeps_the_largest_of_its_free_weights():
    """The others become 0 and stay free; vectors are the first task's."""
    params = {"kernel": jnp.array([[5.0, -4.0, 3.0], [-2.0, 1.0, 0.0]]), "bias": jnp.array([0.1])}
    params, owners = forgetting.prune(params, forgetting.unowned(params), 1, 1 / 3)
    np.testing.assert_array_equal(owners["kernel"], [[1, 1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(params["kernel"], [[5, -4, 0], [0, 0, 0]])
    assert owners["bias"] == 1
    params = {"kernel": params["kernel"].at[1].set(jnp.array([7.0, 8.0, -9.0])), "bias": params["bias"]}
    params, owners = forgetting.prune(params, owners, 2, 1 / 2)
    np.testing.assert_array_equal(owners["kernel"], [[1, 1, 0], [0, 2, 2]])
    np.testing.assert_array_equal(params["kernel"], [[5, -4, 0], [0, 8, -9]])
    first = forgetting.seen_by(params, owners, 1)
    np.testing.assert_array_equal(first["kernel"], [[5, -4, 0], [0, 0, 0]])
    assert owners["bias"] == 1 and float(first["bias"][0]) == pytest.approx(0.1)
