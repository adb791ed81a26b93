"""Soft modules, composed trunks and residual bodies, each against plain NumPy: one sample, module and set at a time."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import QUICK

from mtjax import agents
from mtjax.agents.parts.encoders.composed import Composed, Hypernetwork, HyperTrunk, PaCo, PaCoTrunk
from mtjax.agents.parts.encoders.hypersphere import Hypersphere
from mtjax.agents.parts.encoders.mixture import TaskWeights
from mtjax.agents.parts.encoders.residual import BroNet, BroNetTrunk, SimBa, SimBaTrunk
from mtjax.agents.parts.encoders.soft_modules import Modules, SoftModules
from mtjax.types import InputError

BATCH, OBS, ACTION, CONTEXT = 4, 3, 2, 2
RANDOM = np.random.default_rng(0)
DATA = tuple(jnp.float32(RANDOM.normal(size=size)) for size in ((BATCH, OBS), (CONTEXT,), (BATCH, ACTION)))
OTHER_TASK = (DATA[0], -DATA[1], DATA[2])
compiled = partial(jax.jit, compiler_options=QUICK)


def parameters(module, *data):
    """Random values everywhere, so that biases and scales matter too."""
    random = np.random.default_rng(1)
    shapes = jax.eval_shape(module.init, jax.random.key(0), *data)
    return jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape) * 0.6), shapes)


def apply(module, params, *data):
    return np.asarray(compiled(module.apply)(params, *data))


def plain(params):
    return jax.tree.map(np.float64, params["params"])


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-5)


def relu(x):
    return np.maximum(x, 0)


def dense(layer, x):
    return x @ layer["kernel"] + layer["bias"]


def norm(layer, x):
    """Layer normalisation of one vector, or of every row by a scale of its own."""
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    return x * layer["scale"] + layer["bias"]


def softmax(x):
    return np.exp(x - x.max()) / np.exp(x - x.max()).sum()


def mlp(layers, x, layer_norm=False):
    for i in range(sum(name.startswith("Dense") for name in layers)):
        x = dense(layers[f"Dense_{i}"], x)
        x = relu(norm(layers[f"LayerNorm_{i}"], x) if layer_norm else x)
    return x


# Soft modules.


def soft(num_layers=2, num_modules=2, variant="paper", layer_norm=False, hidden=(6, 5)):
    part = SoftModules(num_layers, num_modules, 4, variant, (7, 6))
    return part.body(hidden, layer_norm)


def plain_routing(p, joint, num_layers, num_modules, official):
    """Every layer's weights [receiver, module], and the scores before softmax, for one sample."""
    if official:
        for i in range(2):
            joint = dense(p[f"embed_{i}"], relu(joint))
    found, scores = [], []
    for i in range(num_layers - 1 + official):
        gate = joint
        if i:
            previous = np.concatenate([w.ravel() for w in found]) if official else scores[-1]
            gate = dense(p[f"up_{i}"], previous) * joint
        scores.append(dense(p[f"down_{i}"], relu(gate)))
        found.append(np.stack([softmax(row) for row in scores[-1].reshape(-1, num_modules)]))
    return found


def plain_soft(p, inputs, features, num_layers, num_modules, official, layer_norm):
    """The base network for one sample, a module at a time."""
    base = dense(p["base_out"], mlp(p["base"], inputs, layer_norm))
    weights = plain_routing(p["routing"], base * dense(p["task"], features), num_layers, num_modules, official)
    inputs = [relu(base) if official else base] * num_modules
    for layer, rows in enumerate(weights):
        modules = p[f"modules_{layer}"]
        outputs = [inputs[j] @ modules["kernel"][j] + modules["bias"][j] for j in range(num_modules)]
        scale = lambda x, m=modules: norm(m["LayerNorm_0"], np.stack(x)) if layer_norm else x
        if official:
            mixed = [sum(row[j] * outputs[j] for j in range(num_modules)) for row in rows]
            inputs = [relu(x) for x in scale(mixed)]
        else:
            outputs = [relu(x) for x in scale(outputs)]
            inputs = [sum(row[j] * outputs[j] for j in range(num_modules)) for row in rows]
    return np.concatenate(inputs)


@pytest.mark.parametrize("variant", ["paper", "official"])
@pytest.mark.parametrize(("num_layers", "num_modules"), [(2, 2), (4, 3), (3, 1), (2, 5)])
def test_soft_modules_are_their_equations(variant, num_layers, num_modules):
    """Both variants for several L and M, with and without norms and actions."""
    layer_norm, official = num_modules == 2 or num_layers == 4, variant == "official"
    data = DATA if num_layers != 3 else DATA[:2]
    module = soft(num_layers, num_modules, variant, layer_norm)
    params = parameters(module, *data)
    obs, features, *action = (np.float64(x) for x in data)
    inputs = np.concatenate([obs, *action], axis=-1)
    expected = [plain_soft(plain(params), x, features, num_layers, num_modules, official, layer_norm) for x in inputs]
    found = apply(module, params, *data)
    close(found, np.stack(expected))
    assert found.shape == (BATCH, 4 if official else 4 * num_modules)


@pytest.mark.parametrize("variant", ["paper", "official"])
def test_routing_sums_to_one_over_the_modules_that_are_mixed(variant):
    """Weights (..., receiver, module), which differ between states and between tasks."""
    module = soft(4, 3, variant)
    params = parameters(module, *DATA)
    route = compiled(lambda *data: module.apply(params, *data, mutable="intermediates")[1])
    weights, other = (route(obs, z, act)["intermediates"]["routing"]["weights"] for obs, z, act in (DATA, OTHER_TASK))
    assert [w.shape[1:] for w in weights] == [(3, 3)] * 3 + [(1, 3)] * (variant == "official")
    for mine, others in zip(weights, other, strict=True):
        np.testing.assert_allclose(np.sum(mine, axis=-1), 1, rtol=1e-5)
        assert np.all(np.ptp(mine, axis=0).max(-1) > 1e-3) and np.all(np.abs(mine - others).max(-1) > 1e-6)


def test_one_module_is_a_plain_mlp():
    """There is nothing to weigh, so that the task has no say."""
    module = soft(3, 1)
    params = parameters(module, *DATA)
    p, x = plain(params), np.concatenate([DATA[0], DATA[2]], axis=-1)
    x = dense(p["base_out"], mlp(p["base"], x))
    for layer in (p["modules_0"], p["modules_1"]):
        x = relu(x @ layer["kernel"][0] + layer["bias"][0])
    close(apply(module, params, *DATA), x)
    close(apply(module, params, *OTHER_TASK), x)


def test_modules_begin_with_the_variance_of_a_single_layer():
    """The axis of modules is not taken for inputs; LeCun's initialisation has variance 1 / inputs."""
    init = compiled(lambda key: Modules(100, False, False).init(key, jnp.zeros(60), jnp.ones((4, 4))))
    kernel = init(jax.random.key(0))["params"]["kernel"]
    np.testing.assert_allclose(np.var(kernel, axis=(1, 2)), 1 / 60, rtol=0.1)
    assert not np.allclose(kernel[0], kernel[1])


# Composed trunks.


def plain_trunk(p, x, weights, layer_norm=False):
    """A composed trunk for one sample, from one composed kernel at a time."""
    for i in range(sum(name.startswith("Composed") for name in p)):
        sets = p[f"Composed_{i}"]
        kernel = sum(w * kernel for w, kernel in zip(weights, sets["kernels"], strict=True))
        x = x @ kernel + sum(w * bias for w, bias in zip(weights, sets["biases"], strict=True))
        x = relu(norm(p[f"LayerNorm_{i}"], x) if layer_norm else x)
    return x


@pytest.mark.parametrize("layer_norm", [False, True])
def test_paco_composes_every_hidden_layer(layer_norm):
    """theta = sum_k w_k Phi_k with w an MLP of the features, in actor and critic."""
    module = PaCoTrunk(3, (6, 5), layer_norm, (4,))
    for data in (DATA, DATA[:2]):
        params = parameters(module, *data)
        obs, features, *action = (np.float64(x) for x in data)
        inputs, p = np.concatenate([obs, *action], axis=-1), plain(params)
        weights = dense(p["weights"]["out"], mlp(p["weights"], features))
        rows = [plain_trunk(p["trunk"], x, weights, layer_norm) for x in inputs]
        close(apply(module, params, *data), np.stack(rows))


@pytest.mark.parametrize("chosen", [0, 2])
def test_a_one_hot_weight_picks_one_set(chosen):
    """The layer is then a dense layer, and no other set gets a gradient."""
    module, x, weights = Composed(5), DATA[0], jax.nn.one_hot(chosen, 3)
    params = parameters(module, x, weights)
    p = plain(params)
    close(apply(module, params, x, weights), np.float64(x) @ p["kernels"][chosen] + p["biases"][chosen])
    slopes = compiled(jax.grad(lambda params: jnp.sum(module.apply(params, x, weights) ** 2)))(params)["params"]
    others = [k for k in range(3) if k != chosen]
    for leaf in slopes.values():
        assert np.any(leaf[chosen] != 0) and not np.any(leaf[np.array(others)])


def test_composing_once_is_composing_for_every_sample(random):
    """The layer takes weights (K,) or (B, K): the same function by two ways."""
    module, x, weights = Composed(5), DATA[0], jnp.float32([0.3, -1.2, 0.7])
    params = parameters(module, x, weights)
    close(apply(module, params, x, jnp.tile(weights, (BATCH, 1))), apply(module, params, x, weights))
    every = jnp.float32(random.normal(size=(BATCH, 3)))
    rows = [apply(module, params, x[i], every[i]) for i in range(BATCH)]
    close(apply(module, params, x, every), np.stack(rows))


def test_a_hypernetwork_writes_every_hidden_layer():
    """Kernels and biases are the linear output of an MLP on the features."""
    module = HyperTrunk((7, 3), (6, 5), True)
    params = parameters(module, *DATA)
    p, inputs = plain(params), np.concatenate([DATA[0], DATA[2]], axis=-1)
    weights = np.concatenate([[1.0], dense(p["code"], mlp(p["hypernetwork"], np.float64(DATA[1])))])
    assert len(weights) == 4
    rows = [plain_trunk(p["trunk"], x, weights, True) for x in inputs]
    close(apply(module, params, *DATA), np.stack(rows))


def test_generated_kernels_begin_as_usual_ones_and_the_same_for_all_tasks(random):
    """LeCun's variance 1 / inputs, no bias; and yet the features move them after a step."""
    module, obs = HyperTrunk((8, 4), (90, 70), False), jnp.float32(random.normal(size=(BATCH, 50)))
    params = compiled(module.init)(jax.random.key(0), obs, DATA[1])
    for name, size in (("Composed_0", 50), ("Composed_1", 90)):
        layer = params["params"]["trunk"][name]
        code = np.concatenate([[1.0], random.normal(size=4)])  # any code writes the same kernel
        np.testing.assert_allclose(np.var(np.tensordot(code, layer["kernels"], 1)), 1 / size, rtol=0.1)
        assert not np.any(np.tensordot(code, layer["biases"], 1))
    run = compiled(module.apply)
    np.testing.assert_array_equal(run(params, obs, DATA[1]), run(params, obs, -3 * DATA[1]))
    slopes = compiled(jax.grad(lambda params: jnp.sum(module.apply(params, obs, DATA[1]) ** 2)))(params)
    after = jax.tree.map(lambda x, slope: x - 0.1 * slope, params, slopes)
    assert not np.allclose(run(after, obs, DATA[1]), run(after, obs, -3 * DATA[1]))


@pytest.mark.parametrize(("widths", "expected"), [((), (1, 2)), ((64,), (7 / 6, 13 / 6))])
def test_paco_begins_with_kernels_of_the_usual_size(widths, expected):
    """Between one and two times LeCun's variance, for features from nothing to unit ones."""
    module = PaCoTrunk(5, (80,), False, widths)
    init = compiled(jax.vmap(lambda key: module.init(key, jnp.zeros(50), jnp.zeros(64))["params"]))
    params = init(jax.random.split(jax.random.key(0), 50))
    kernels, of_task = params["trunk"]["Composed_0"]["kernels"], TaskWeights(5, widths, 5**-0.5)
    for size, variance in zip((0.0, 1.0), expected, strict=True):
        weights = jax.vmap(lambda p, size=size: of_task.apply({"params": p}, jnp.full(64, size)))(params["weights"])
        np.testing.assert_allclose(50 * np.var(np.einsum("sk,skio->sio", weights, kernels)), variance, rtol=0.15)


def effective_rank(rows):
    """Singular values of more than a hundredth of the largest."""
    values = np.linalg.svd(np.asarray(rows), compute_uv=False)
    return np.sum(values > 0.01 * values[0])


@pytest.mark.parametrize(("name", "num"), [("paco", {"num_sets": 5}), ("moore", {"num_experts": 4})])
def test_weights_of_tasks_along_one_parameter_are_not_a_line(name, num):
    """Ten scalar contexts, as the agent makes its networks: by a linear map every task would mix the same two."""
    contexts, obs = jnp.linspace(-1, 1, 10)[:, None], jnp.zeros((10, OBS))

    def weights(**settings):
        module = agents.agent(name, **num, **settings).encoder.body((8,), False)
        params = module.init(jax.random.key(0), obs, contexts)
        _, seen = module.apply(params, obs, contexts, capture_intermediates=lambda m, _: m.name == "weights")
        (found,) = seen["intermediates"]["weights"]["__call__"]
        return found

    assert effective_rank(weights(weight_widths=())) == 2
    assert effective_rank(weights()) >= 4


def test_weights_of_a_task_fit_what_a_line_cannot(random):
    """Ten tasks' random weights, of which the best line leaves three quarters; every task reaches its own."""
    contexts, wanted = jnp.linspace(-1, 1, 10)[:, None], jnp.float32(random.normal(size=(10, 5)))
    module, optimizer = TaskWeights(5, (64,)), optax.adam(1e-2)
    loss = lambda params: jnp.mean((module.apply(params, contexts) - wanted) ** 2)

    def step(carry, _):
        updates, memory = optimizer.update(jax.grad(loss)(carry[0]), carry[1])
        return (optax.apply_updates(carry[0], updates), memory), None

    params = module.init(jax.random.key(0), contexts)
    fit = compiled(lambda *start: jax.lax.scan(step, start, length=2000)[0][0])
    line = np.linalg.lstsq(np.hstack([contexts, np.ones((10, 1))]), wanted, rcond=None)[1].sum() / wanted.size
    assert loss(fit(params, optimizer.init(params))) < 0.1 * line


# Residual bodies.


def test_bronet_is_its_equations():
    """Dense, norm, relu; then blocks of dense, norm, relu, dense, norm added to their input."""
    module = BroNet().body((6, 6), layer_norm=False)
    params = parameters(module, *DATA)
    p = plain(params)
    layer = lambda i, x: norm(p[f"LayerNorm_{i}"], dense(p[f"Dense_{i}"], x))
    x = relu(layer(0, np.concatenate([DATA[0], DATA[2], np.tile(DATA[1], (BATCH, 1))], axis=-1)))
    x = x + layer(2, relu(layer(1, x)))
    x = x + layer(4, relu(layer(3, x)))
    close(apply(module, params, *DATA), x)


def test_simba_is_its_equations():
    """A linear layer; blocks of norm, wide dense, relu, dense added to their input; a last norm."""
    module = SimBa(expansion=3).body((6, 6), layer_norm=False)
    params = parameters(module, *DATA)
    p = plain(params)
    x = dense(p["Dense_0"], np.concatenate([DATA[0], DATA[2], np.tile(DATA[1], (BATCH, 1))], axis=-1))
    for i in (0, 1):
        inner = dense(p[f"Dense_{2 * i + 1}"], norm(p[f"LayerNorm_{i}"], x))
        assert inner.shape == (BATCH, 18)
        x = x + dense(p[f"Dense_{2 * i + 2}"], relu(inner))
    close(apply(module, params, *DATA), norm(p["LayerNorm_2"], x))


def test_residual_bodies_have_a_block_for_each_hidden_layer():
    """Whose norms do not depend on the setting."""
    for layer_norm in (False, True):
        assert BroNet().body((8,), layer_norm) == BroNetTrunk(8, 1)
        assert SimBa(2).body((8, 8, 8), layer_norm) == SimBaTrunk(8, 3, 2)


# All of them.


MODULES = {
    "soft-modules": soft(3, 2, "paper", True),
    "soft-modules-official": soft(3, 2, "official", True),
    "paco": PaCo(3).body((6, 5), True),
    "hypernetwork": Hypernetwork((8, 6)).body((6, 5), True),
    "bronet": BroNet().body((6, 6), True),
    "simba": SimBa(2).body((6, 6), True),
    "hypersphere": Hypersphere(2).body((6, 6), True),
}
EVERY_MODULE = pytest.mark.parametrize("name", MODULES)


@EVERY_MODULE
def test_features_of_the_task_or_of_every_sample_are_the_same(name):
    """Features (Z,) for all samples, (B, Z), and one sample alone; and samples of different tasks do not mix."""
    module, (obs, features, action) = MODULES[name], DATA
    params = parameters(module, *DATA)
    once = apply(module, params, *DATA)
    close(apply(module, params, obs, jnp.tile(features, (BATCH, 1)), action), once)
    close(apply(module, params, obs[1], features, action[1]), once[1])
    mixed = jnp.tile(features, (BATCH, 1)).at[1].multiply(-2.0)
    found = apply(module, params, obs, mixed, action)
    others = np.array([0, 2, 3])
    close(found[others], once[others])
    assert np.abs(found[1] - once[1]).max() > 1e-3
    close(found[1], apply(module, params, obs[1], mixed[1], action[1]))


@EVERY_MODULE
def test_every_parameter_gets_a_gradient(name, random):
    """Each leaf, and each module's or set's slice of it."""
    module = MODULES[name]
    obs, features, action = (jnp.float32(random.normal(size=(64, size))) for size in (OBS, CONTEXT, ACTION))
    params = parameters(module, obs, features, action)
    target = jnp.float32(random.normal(size=64))[:, None]
    loss = lambda params: jnp.sum((module.apply(params, obs, features, action) - target) ** 2)
    for path, slope in jax.tree_util.tree_leaves_with_path(compiled(jax.grad(loss))(params)):
        rows = slope if slope.ndim == 3 or path[-1].key == "biases" else slope[None]
        assert np.all(np.isfinite(slope)) and np.all(np.abs(rows).reshape(len(rows), -1).max(1) > 0), path


def test_settings_that_make_no_network_are_refused():
    """By name, with what is allowed."""
    refused = (
        ("soft-modules", {"num_layers": 1}, "num-layers must be at least 2"),
        ("soft-modules", {"num_modules": 0}, "at least one module"),
        ("soft-modules", {"variant": "oficial"}, "did you mean 'official'"),
        ("paco", {"num_sets": 0}, "num-sets must be at least 1"),
        ("paco", {"weight_widths": (4, 0)}, "weight-widths must be of at least one unit each"),
        ("hypernetwork", {"hypernetwork_widths": ()}, "at least one unit"),
        ("simba", {"expansion": 0}, "expansion must be at least 1"),
        ("hypersphere", {"expansion": 0}, "expansion must be at least 1"),
        ("hypersphere", {"input_shift": 0.0}, "input-shift must be greater than 0"),
        ("hypersphere", {"hidden": (8, 4)}, r"hypersphere.*\(8, 4\)"),
        ("bronet", {"hidden": (8, 4)}, r"bronet.*\(8, 4\)"),
        ("simba", {"hidden": (8, 4)}, r"simba.*\(8, 4\)"),
        ("paco", {"conditioning": "none"}, "conditioning cannot be none"),
    )
    for encoder, settings, says in refused:
        with pytest.raises(InputError, match=says):
            agents.agent("sac", **{"encoder": encoder, "conditioning": "parameters", **settings})
