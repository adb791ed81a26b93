"""Attentive sharing: its numbers by hand, who gets gradients, and grids in which sub-networks are shared or not."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK
from test_encoders_modules import BATCH, DATA, apply, close, mlp, parameters, plain, relu, softmax

from mtjax import agents
from mtjax.agents.parts.encoders.attentive import Attentive
from mtjax.types import InputError

HIDDEN = (6, 5)
FILE = Path(__file__).parents[1] / "examples" / "attentive.py"


@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("widths", [(), (7,)])
def test_hidden_layers_are_weighed_by_state_and_task(layer_norm, widths):
    """One sample and one sub-network at a time, in NumPy."""
    module = Attentive(3, widths).body(HIDDEN, layer_norm)
    params = parameters(module, *DATA)
    p, (obs, features, action) = plain(params), (np.float64(x) for x in DATA)
    found = apply(module, params, *DATA).reshape(BATCH, 3, HIDDEN[-1])
    for row, seen in zip(found, np.concatenate([obs, action], axis=-1), strict=True):
        looks = mlp(p.get("attention", {}), np.concatenate([seen, features]))
        weights = softmax(looks @ p["scores"]["kernel"] + p["scores"]["bias"])
        for k in range(3):
            layers = jax.tree.map(lambda x, k=k: x[k], p["subnetworks"])
            close(row[k], weights[k] * mlp(layers, seen, layer_norm))


def test_a_head_on_them_weighs_the_outputs_of_sub_networks():
    """sum_k w_k (W_k h_k) + b, with the part of the head below each sub-network."""
    module = Attentive(2).body(HIDDEN, False)
    params = parameters(module, *DATA)
    found, intermediates = module.apply(params, *DATA, mutable="intermediates")
    weights = intermediates["intermediates"]["weights"][0]
    head = np.random.default_rng(3).normal(size=(10, 4))
    hidden = np.asarray(found).reshape(BATCH, 2, 5) / weights[..., None]
    expected = sum(weights[:, k, None] * (hidden[:, k] @ head[5 * k : 5 * k + 5]) for k in (0, 1))
    close(np.asarray(found) @ head, expected)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, rtol=1e-6)


def test_one_sub_network_is_a_plain_network_without_the_task():
    module = Attentive(1).body(HIDDEN, False)
    params = parameters(module, *DATA)
    layers = jax.tree.map(lambda x: x[0], plain(params)["subnetworks"])
    close(apply(module, params, *DATA), mlp(layers, np.concatenate([DATA[0], DATA[2]], axis=-1)))


def test_the_order_of_sub_networks_does_not_matter():
    """With scores, sub-networks and head in another order the outputs are the same."""
    module, order = Attentive(3).body(HIDDEN, True), np.array([2, 0, 1])
    params, head = parameters(module, *DATA), np.random.default_rng(4).normal(size=(3, 5, 2))
    inner = params["params"]
    other = {
        **inner,
        "subnetworks": jax.tree.map(lambda x: x[order], inner["subnetworks"]),
        "scores": jax.tree.map(lambda x: x[..., order], inner["scores"]),
    }
    found = apply(module, params, *DATA) @ head.reshape(15, 2)
    close(apply(module, {"params": other}, *DATA) @ head[order].reshape(15, 2), found)


def test_every_parameter_gets_a_gradient_and_none_flows_through_a_weight_of_zero():
    module = Attentive(3, (7,)).body(HIDDEN, True)
    random = np.random.default_rng(5)
    data = tuple(jnp.float32(random.normal(size=(64, size))) for size in (3, 2, 2))
    params = parameters(module, *data)
    target = jnp.float32(random.normal(size=(64, 1)))
    grad = jax.jit(
        jax.grad(lambda params: jnp.sum((module.apply(params, *data) - target) ** 2)), compiler_options=QUICK
    )
    for path, slope in jax.tree_util.tree_leaves_with_path(grad(params)):
        rows = slope if path[1].key == "subnetworks" else slope[None]
        assert np.all(np.isfinite(slope)) and np.all(np.abs(rows).reshape(len(rows), -1).max(1) > 0), path
    params["params"]["scores"]["bias"] = params["params"]["scores"]["bias"].at[1].set(-1e9)
    slopes = grad(params)["params"]["subnetworks"]
    assert not any(np.any(x[1]) for x in jax.tree.leaves(slopes)) and all(np.any(x[0]) for x in jax.tree.leaves(slopes))


@pytest.mark.slow
def test_tasks_without_a_weight_in_common_share_nothing():
    """A task that weighs only the first sub-network moves no other, nor its part of the head."""
    module = Attentive(2, ()).body(HIDDEN, False)
    obs, _, action = DATA
    first = jnp.float32([1, 0])
    params = parameters(module, obs, first, action)
    kernel = jnp.zeros_like(params["params"]["scores"]["kernel"]).at[-2].set(jnp.float32([50.0, -50.0]))
    params["params"]["scores"] = {"kernel": kernel, "bias": jnp.zeros(2)}
    grad = jax.grad(lambda params: jnp.sum(module.apply(params, obs, first, action) ** 2))(params)["params"]
    assert not any(np.any(x[1]) for x in jax.tree.leaves(grad["subnetworks"]))
    assert np.any(relu(apply(module, params, obs, first, action)[:, :5]))
    np.testing.assert_array_equal(apply(module, params, obs, first, action)[:, 5:], 0)


def test_settings_that_make_no_network_are_refused():
    for settings, says in (
        ({"num_subnetworks": 0}, "num-subnetworks must be at least 1"),
        ({"attention_widths": (4, 0)}, "attention-widths must be of at least one unit each"),
        ({"conditioning": "none"}, "conditioning cannot be none"),
    ):
        with pytest.raises(InputError, match=says):
            agents.agent("attentive", **settings)


# Grids.


@pytest.fixture(scope="module")
def grids():
    spec = importlib.util.spec_from_file_location("attentive", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_grid_is_as_it_says(grids):
    """A move off the edge stays, any corner ends the episode, and only the task's own pays."""
    env = grids.Grid()
    tasks = env.tasks()
    assert len(tasks.id) == 20 and env.spec.obs_size == 49
    task = jax.tree.map(lambda x: x[4], tasks)  # the second order, the lower left corner
    np.testing.assert_array_equal(task.goal["corner"], [0, 0])
    at = lambda x, y: grids.Place(jnp.int32([x, y]))
    for start, action, cell, reward, ends in (
        ((0, 3), 0, (0, 3), 0, False),
        ((0, 3), 1, (1, 3), 0, False),
        ((0, 1), 2, (0, 0), 1, True),
        ((5, 0), 1, (6, 0), 0, True),
    ):
        step = env.step(task, at(*start), jnp.int32(action))
        assert (tuple(map(int, step.state.cell)), float(step.reward), bool(step.terminated)) == (cell, reward, ends)
    starts = np.asarray(jax.vmap(lambda key: env.reset(task, key).state.cell)(jax.random.split(jax.random.key(0), 500)))
    assert not any(tuple(start) in {(0, 0), (0, 6), (6, 0), (6, 6)} for start in starts.tolist())


@pytest.mark.nightly
def test_two_sub_networks_learn_swapped_actions_and_one_learns_half(grids):
    """Blind to the task, the same actions lead to one end in one task and to the other in the other."""
    one, two = (grids.learned(grids.CORRIDOR, grids.shared(count), 60, seeds=2)[1] for count in (1, 2))
    np.testing.assert_allclose(one.mean(axis=1), 0.5)
    assert np.all(two == 1)


@pytest.mark.nightly
def test_twenty_tasks_learn_as_much_with_five_sub_networks_as_with_networks_of_their_own(grids, tmp_path):
    env, agent = grids.Grid(), grids.shared(5)
    own = grids.learned(env, grids.made(heads="disjoint", conditioning="none"), 100)[1]
    states, five = grids.learned(env, agent, 100)
    assert own.mean() > 0.98 and five.mean() > own.mean() - 0.02
    weights = grids.weights_of(env, agent, jax.tree.map(lambda x: x[0], states))
    assert weights.shape == (20, 49, 5)
    np.testing.assert_allclose(weights.sum(axis=-1), 1, rtol=1e-5)
    grids.draw(env, weights, str(tmp_path / "weights.png"))
    assert Path(tmp_path / "weights.png").stat().st_size < 60_000
