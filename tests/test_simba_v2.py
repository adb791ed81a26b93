"""SimbaV2: its body against plain NumPy, and weights that stay on the unit sphere."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import learner, random_batch, slow_but, tasks_of, tiny

from mtjax.agents import agent
from mtjax.agents.networks import Params
from mtjax.agents.parts.encoders import Hypersphere
from mtjax.agents.parts.gradients.descent import adam, on_sphere
from mtjax.types import InputError, Spec

SPEC, BATCH = Spec.vector(3, 2, 1), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))


def unit(x):
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def directions(tree):
    """Weights on the sphere (..., inputs, outputs) by path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(x) for path, x in leaves if path[-1].key == "direction"}


def lengths(direction):
    return np.linalg.norm(direction, axis=-2)


def test_the_body_is_its_equations(random):
    """Embedding, two blocks and the last hidden layer, with random parameters and a task's features."""
    obs, features, action = (jnp.float32(random.normal(size=size)) for size in ((4, 3), (2,), (4, 2)))
    module = Hypersphere(expansion=3, input_shift=2.0).body((6, 6), layer_norm=False)
    start = module.init(jax.random.key(0), obs, features, action)
    params = jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape)), start)
    layers = jax.tree.map(np.float64, params["params"])
    dense = lambda i, x: x @ layers[f"UnitDense_{i}"]["direction"]
    # A factor is its parameter times how it begins, over how the parameter begins.
    first = {f"Scaler_{i}": gain for i, gain in ((0, 1), (1, 1), (2, 6**0.5 / 3), (3, 1), (4, 6**0.5 / 3), (5, 1))}
    scaled = lambda i, x: first[f"Scaler_{i}"] * layers[f"Scaler_{i}"]["scale"] * x
    inputs = np.concatenate([obs, action, np.tile(features, (4, 1)), np.full((4, 1), 2.0)], axis=-1)
    x = unit(scaled(0, dense(0, unit(inputs))))
    for block in (0, 1):
        inner = np.maximum(scaled(2 * block + 1, dense(2 * block + 1, x)), 0)
        assert inner.shape == (4, 18)
        x = unit(x + scaled(2 * block + 2, unit(dense(2 * block + 2, inner)) - x))
    np.testing.assert_allclose(
        module.apply(params, obs, features, action), scaled(5, dense(5, x)), rtol=1e-3, atol=1e-4
    )

    begins = {name: layer["scale"][0] for name, layer in start["params"].items() if "Scaler" in name}
    gain = (2 / 6) ** 0.5
    expected = (gain, gain / 3**0.5, 6**-0.5, gain / 3**0.5, 6**-0.5, 1.0)
    np.testing.assert_allclose([begins[f"Scaler_{i}"] for i in range(6)], expected, rtol=1e-6)
    assert not jax.tree.leaves([layer for name, layer in start["params"].items() if "bias" in layer])


def test_a_step_ends_on_the_sphere_and_others_are_as_they_were():
    """By hand: (3, 4) becomes (0.6, 0.8); a leaf of any other name takes the optimiser's step."""
    params = {"direction": jnp.float32([[1.0, 0.0], [0.0, 1.0]]), "kernel": jnp.float32([[1.0], [0.0]])}
    slopes = {"direction": jnp.float32([[-2.0, -1.0], [-4.0, 0.0]]), "kernel": jnp.float32([[-2.0], [-4.0]])}
    optimizer = on_sphere(optax.sgd(1.0))
    updates, _ = optimizer.update(slopes, optimizer.init(params), params)
    after = optax.apply_updates(params, updates)
    np.testing.assert_allclose(after["direction"], [[0.6, 0.5**0.5], [0.8, 0.5**0.5]], rtol=1e-6)
    np.testing.assert_array_equal(after["kernel"], [[3.0], [4.0]])


def test_what_is_not_tuned_stays_to_the_bit(random):
    """Though scaling it to length 1 again would round."""
    weights = jnp.float32(random.normal(size=(5, 7)))
    params = Params({"body": {"direction": weights}, "head": {"direction": weights}}, {})
    optimizer = adam(0.1, 0.0, 0.0, "heads")
    updates, _ = optimizer.update(jax.tree.map(jnp.ones_like, params), optimizer.init(params), params)
    after = optax.apply_updates(params, updates)
    np.testing.assert_array_equal(after.shared["body"]["direction"], weights)
    np.testing.assert_allclose(lengths(after.shared["head"]["direction"]), 1, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("heads", slow_but(["shared", "per-task", "disjoint"], "per-task"))
def test_weights_begin_and_stay_on_the_sphere(heads):
    """Every unit of actor and critics, outputs too; and target critics lie inside, as means of such weights."""
    made = tiny("simba-v2", heads=heads, weight_decay=0.1, actor_lr=0.1, critic_lr=0.1)
    init, update = learner(made, TASKS, BATCH, SPEC)
    before = after = init(TASKS, jax.random.key(0))
    for i in range(3):
        after, _ = update(after, random_batch(i, 3, BATCH, SPEC), TASKS, jax.random.key(i))
    for network in ("actor", "critic"):
        old, new = (directions(state.nets[network]) for state in (before, after))
        assert len(old) == 5  # an embedding, a block of two, the last hidden layer and the head
        for path in old:
            np.testing.assert_allclose(lengths(old[path]), 1, rtol=1e-5, err_msg=path)
            np.testing.assert_allclose(lengths(new[path]), 1, rtol=1e-5, err_msg=path)
            assert np.abs(old[path] - new[path]).max() > 0.05
    assert all(np.all(lengths(x) < 1 + 1e-5) for x in directions(after.slow["critic"]).values())


def test_an_input_of_any_length_is_told_from_its_double():
    """The constant beside the inputs keeps what the norm would lose."""
    module = Hypersphere().body((8,), layer_norm=False)
    obs, none = jnp.float32([[1.0, -2.0], [2.0, -4.0], [0.0, 0.0]]), jnp.zeros(0)
    found = module.apply(module.init(jax.random.key(0), obs, none), obs, none)
    assert np.all(np.isfinite(found)) and np.abs(found[0] - found[1]).max() > 1e-2


def test_a_head_of_length_one_cannot_be_rescaled():
    """By name, before anything compiles."""
    with pytest.raises(InputError, match="scaling=popart rescales heads, which unit-head keeps at length 1"):
        agent("simba-v2", value="scalar", heads="per-task", scaling="popart")
