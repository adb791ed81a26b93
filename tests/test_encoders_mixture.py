"""Mixtures of experts, FiLM, MOORE and input maps against plain NumPy, one sample and one expert at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from probes import learner, one_in, quick, random_batch, tasks_of, tiny

from mtjax.agents import agent
from mtjax.agents.networks import Network, Params
from mtjax.agents.parts.encoders import ENCODERS
from mtjax.agents.parts.encoders.mixture import Experts, top_k_softmax
from mtjax.agents.parts.encoders.moore import orthonormal
from mtjax.command.keywords import from_keywords
from mtjax.envs.probes import Probe
from mtjax.training.launch import check
from mtjax.types import InputError, Spec

TASKS, BATCH, OBS, ACTION, OUT, HIDDEN = 3, 4, 2, 1, 5, (7, 6)
RANDOM = np.random.default_rng(0)
OBSERVATIONS = np.float32(RANDOM.normal(size=(BATCH, OBS)))
ACTIONS = np.float32(RANDOM.normal(size=(BATCH, ACTION)))
NUMBERS = np.eye(TASKS, dtype=np.float32)  # features that are the task's number

MOE = {"num_experts": 3, "expert_widths": (6, 4)}
PARTS = {
    "attention": ("moe", {**MOE, "mode": "attention"}),
    "top-k": ("moe", {**MOE, "mode": "top-k"}),
    "ensemble": ("moe", {**MOE, "mode": "ensemble"}),
    "cluster": ("moe", {**MOE, "num_experts": 2, "mode": "cluster", "clusters": (1, 0, 1)}),
    "identity": ("moe", {**MOE, "mode": "identity"}),
    "channel": ("film", {"film": "channel", "film_widths": (8,)}),
    "scalar": ("film", {"film": "scalar", "film_widths": (8,)}),
    "moore": ("moore", {"num_experts": 3}),
    "input-map": ("input-map", {}),
}
BODIES = [name for name in PARTS if name != "input-map"]
every_part = pytest.mark.parametrize("name", PARTS)
every_body = pytest.mark.parametrize("name", BODIES)
in_both = pytest.mark.parametrize("inputs", [(OBSERVATIONS,), (OBSERVATIONS, ACTIONS)], ids=["actor", "critic"])


def part(name):
    encoder, settings = PARTS[name]
    return ENCODERS[encoder](**settings)


def jiggle(shapes, seed=1):
    """Random values everywhere, so that biases and scales matter too."""
    random = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape)), shapes)


def body_of(name, inputs, layer_norm=True):
    """A module, compiled to (parameters, features, inputs) -> hidden layer; and random parameters."""
    module = part(name).body(HIDDEN, layer_norm)
    apply = lambda params, features, inputs: module.apply(params, inputs[0], features, *inputs[1:])
    params = jiggle(jax.eval_shape(module.init, jax.random.key(0), inputs[0], NUMBERS[0], *inputs[1:]))
    return quick(apply, params, NUMBERS[0], inputs), params


def close(found, expected, atol=1e-5):
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=atol)


# Plain references: one sample (x,) at a time.


def dense(layer, x):
    return x @ layer["kernel"] + layer["bias"]


def norm(layer, x):
    return (x - x.mean()) / np.sqrt(x.var() + 1e-6) * layer["scale"] + layer["bias"]


def relu(x):
    return np.maximum(x, 0)


def mlp(layers, x):
    for i in range(sum(name.startswith("Dense") for name in layers)):
        x = dense(layers[f"Dense_{i}"], x)
        x = relu(norm(layers[f"LayerNorm_{i}"], x) if f"LayerNorm_{i}" in layers else x)
    return x


def expert(layers, k, x):
    last = sum(name.startswith("kernel") for name in layers) - 1
    for i in range(last + 1):
        x = x @ layers[f"kernel_{i}"][k] + layers[f"bias_{i}"][k]
        if f"norm_{i}" in layers:
            x = norm({name: leaf[k] for name, leaf in layers[f"norm_{i}"].items()}, x)
        x = relu(x) if i < last else x
    return x


def softmax(x):
    return np.exp(x - x.max()) / np.exp(x - x.max()).sum()


def plain_weights(name, p, task):
    if name in ("attention", "top-k"):
        scores = dense(p["gate"]["scores"], mlp(p["gate"]["MLP_0"], NUMBERS[task]))
        kept = np.sort(np.argsort(scores)[-2:]) if name == "top-k" else np.arange(3)
        weights = np.zeros(3)
        weights[kept] = softmax(scores[kept])
        return weights
    return {
        "ensemble": np.full(3, 1 / 3),
        "identity": np.eye(3)[task],
        "cluster": np.eye(2)[(1, 0, 1)[task]],
    }[name]


def plain_mixture(name, p, obs, action, task):
    weights = plain_weights(name, p, task)
    encoding = sum(w * expert(p["experts"], k, obs) for k, w in enumerate(weights))
    return mlp(p["trunk"], np.concatenate([encoding, *action, NUMBERS[task]]))


def plain_film(name, p, obs, action, task):
    x = np.concatenate([obs, *action])
    modulation = dense(p["modulation"], mlp(p["generator"], NUMBERS[task]))
    sizes = HIDDEN if name == "channel" else (1, 1)
    scales, shifts = np.split(modulation, 2)
    for i, (start, size) in enumerate(zip((0, sizes[0]), sizes, strict=True)):
        scale, shift = (values[start : start + size] for values in (1 + scales, shifts))
        x = dense(p["trunk"][f"Dense_{i}"], x)
        x = norm(p["trunk"][f"LayerNorm_{i}"], x) if f"LayerNorm_{i}" in p["trunk"] else x
        x = relu(scale * x + shift) if name == "channel" else scale * relu(x) + shift
    return x


def gram_schmidt(vectors):
    basis = []
    for u in np.float64(vectors):
        r = u - sum(((u @ v) * v for v in basis), np.zeros_like(u))
        basis.append(r / np.linalg.norm(r))
    return np.stack(basis)


def plain_moore(name, p, obs, action, task):
    x = np.concatenate([obs, *action])
    basis = gram_schmidt(np.stack([expert(p["experts"], k, x) for k in range(3)]))
    weights = dense(p["weights"]["out"], mlp(p["weights"], NUMBERS[task]))
    return np.tanh(weights @ basis)


PLAIN = {"moe": plain_mixture, "film": plain_film, "moore": plain_moore}


@in_both
@every_body
def test_every_body_is_its_equations(name, inputs):
    """For every task and sample; and tasks do not come out alike."""
    for layer_norm in (False, True):
        apply, params = body_of(name, inputs, layer_norm)
        plain, p = PLAIN[PARTS[name][0]], jax.tree.map(np.asarray, params["params"])
        found = np.stack([apply(params, NUMBERS[task], inputs) for task in range(TASKS)])
        for task in range(TASKS):
            rows = [plain(name, p, inputs[0][b], [a[b] for a in inputs[1:]], task) for b in range(BATCH)]
            close(found[task], np.stack(rows))
        assert not np.allclose(found[0], found[1]) and not np.allclose(found[1], found[2])


@every_body
def test_features_may_be_a_task_or_a_sample_each(name):
    """One vector (Z,) is the same as its repetition (B, Z), and one sample as a row of many."""
    inputs = (OBSERVATIONS, ACTIONS)
    apply, params = body_of(name, inputs)
    module = part(name).body(HIDDEN, True)
    alone = quick(lambda params, *data: module.apply(params, *data), params, OBSERVATIONS[0], NUMBERS[0], ACTIONS[0])
    each = quick(lambda params, *data: module.apply(params, *data), params, OBSERVATIONS, NUMBERS[[0] * 4], ACTIONS)
    rows = np.stack([apply(params, NUMBERS[task], inputs) for task in range(TASKS)])
    close(each(params, OBSERVATIONS, NUMBERS[[1] * 4], ACTIONS), rows[1])
    close(alone(params, OBSERVATIONS[2], NUMBERS[1], ACTIONS[2]), rows[1, 2])
    numbers = np.array([0, 1, 2, 1])
    close(each(params, OBSERVATIONS, NUMBERS[numbers], ACTIONS), rows[numbers, range(BATCH)])


def network_of(name, seed=3):
    """A critic made of an encoder, compiled over tasks, and random parameters."""
    network = Network(part(name).body(HIDDEN, True), front=part(name).front())
    init = lambda key: network.init(key, TASKS, OUT, NUMBERS[0], OBSERVATIONS[0], ACTIONS[0])
    params = jiggle(jax.eval_shape(init, jax.random.key(0)), seed)
    return init, jax.vmap(network.apply, (Params(None, 0), 0, None, None)), params


@every_part
def test_every_parameter_receives_a_gradient(name):
    """From the outputs of all tasks together: every leaf, every expert's part of one, and every task's part of one."""
    _, apply, params = network_of(name, seed=8)  # by which each expert is among some task's top 2
    total = lambda params: jnp.sum(jnp.sin(apply(params, NUMBERS, OBSERVATIONS, ACTIONS)))
    slopes = jax.tree_util.tree_leaves_with_path(quick(jax.grad(total), params)(params))
    for path, slope in slopes:
        path = jax.tree_util.keystr(path)
        split = "experts" in path or "own" in path
        for i, piece in enumerate(np.asarray(slope) if split else [np.asarray(slope)]):
            assert np.all(np.isfinite(piece)) and np.any(piece != 0), (path, i)


# Mixtures.


def test_experts_are_normalised_each_by_its_own_scale():
    """Before every ReLU and not on the linear output."""
    module = Experts(3, (6, 5, 4), layer_norm=True)
    params = jiggle(jax.eval_shape(module.init, jax.random.key(0), OBSERVATIONS))
    found, p = quick(module.apply, params, OBSERVATIONS)(params, OBSERVATIONS), params["params"]
    p = jax.tree.map(np.asarray, p)
    assert set(p) == {f"{leaf}_{i}" for leaf in ("kernel", "bias") for i in range(3)} | {"norm_0", "norm_1"}
    assert p["norm_0"]["scale"].shape == (3, 6)
    close(found, [[expert(p, k, x) for x in OBSERVATIONS] for k in range(3)])


@pytest.mark.parametrize("k", [2, 3, 5])
def test_top_k_keeps_exactly_k(k):
    """Their weights sum to 1, in the ratio of the soft gate's; ties too leave no more than k."""
    scores = np.float32(np.random.default_rng(0).normal(size=(20, 5)))
    scores[0] = 0.0
    weights = np.asarray(jax.jit(lambda s: top_k_softmax(s, k))(scores))
    np.testing.assert_array_equal(np.sum(weights > 0, axis=1), k)
    close(weights.sum(1), np.ones(20))
    for row, score in zip(weights[1:], scores[1:], strict=True):
        kept = np.argsort(score)[-k:]
        close(row[kept], softmax(score)[kept] / softmax(score)[kept].sum())


def test_top_k_teaches_the_gate_through_what_it_keeps():
    """The kept scores have the slopes of a softmax among themselves, the others none."""
    scores = jnp.float32([1.0, 3.0, 2.0, 0.0])
    slopes = jax.grad(lambda s: top_k_softmax(s, 2)[1])(scores)
    w = 1 / (1 + np.exp(-1.0))
    close(slopes, [0, w * (1 - w), -w * (1 - w), 0])


@pytest.mark.parametrize(("name", "of_task"), [("identity", (0, 1, 2)), ("cluster", (1, 0, 1))])
def test_a_task_moves_its_own_expert_alone(name, of_task):
    """The gradient of one task's output by expert."""
    inputs = (OBSERVATIONS,)
    _, params = body_of(name, inputs)
    module = part(name).body(HIDDEN, False)
    total = lambda params, features: jnp.sum(module.apply(params, OBSERVATIONS, features))
    slope = quick(jax.grad(total), params, NUMBERS[0])
    for task, own in enumerate(of_task):
        kernel = slope(params, NUMBERS[task])["params"]["experts"]["kernel_0"]
        np.testing.assert_array_equal(np.flatnonzero(np.any(kernel != 0, axis=(1, 2))), [own])


MISFITS = [
    ({"mode": "identity", "num_experts": 4}, "num-experts=4 fits 4 training tasks, but there are 3"),
    ({"mode": "cluster", "num_experts": 2, "clusters": (0, 1)}, "fits 2 training tasks, but there are 3"),
]


@pytest.mark.parametrize(("settings", "message"), MISFITS)
def test_tables_of_tasks_must_fit_the_tasks(settings, message, monkeypatch):
    """By the agent, and before a run compiles anything or makes a folder."""
    made = agent("sac", encoder="moe", conditioning="one-hot", hidden=(4,), **settings)
    monkeypatch.setattr(Probe, "tasks", lambda *_: tasks_of("one-step", (1.0, -0.5, 0.3)))
    env = Probe()
    with pytest.raises(InputError, match=message):
        jax.eval_shape(lambda: made.init(env.spec, env.tasks(), jax.random.key(0)))
    with pytest.raises(InputError, match=message):
        check(from_keywords(env, made, {}, plan={}))


REFUSED = [
    ({"encoder": "moe", "mode": "identity", "conditioning": "parameters"}, "conditioning=one-hot"),
    ({"encoder": "moe", "mode": "cluster", "num_experts": 1, "clusters": (0,)}, "conditioning=one-hot"),
    ({"encoder": "moe"}, "conditioning cannot be none"),
    ({"encoder": "film"}, "conditioning cannot be none"),
    ({"encoder": "moore"}, "conditioning cannot be none"),
    ({"encoder": "moe", "mode": "sofft"}, "attention"),
    ({"encoder": "care", "variant": "mtrl", "unit_attention": True, "conditioning": "parameters"}, "no inner products"),
    ({"encoder": "moe", "num_experts": 0}, "at least one expert"),
    ({"encoder": "moe", "expert_widths": ()}, "at least one expert"),
    ({"encoder": "moore", "num_experts": 0}, "at least one expert"),
    ({"encoder": "moore", "weight_widths": (0,)}, "weight-widths must be of at least one unit each"),
    ({"encoder": "moe", "mode": "top-k", "top_k": 1}, "top-k must be from 2 to num-experts=4, not 1"),
    ({"encoder": "moe", "mode": "top-k", "top_k": 5}, "top-k must be from 2"),
    ({"encoder": "moe", "mode": "cluster"}, "go together"),
    ({"encoder": "moe", "clusters": (0, 1, 2, 3)}, "go together"),
    ({"encoder": "moe", "mode": "cluster", "clusters": (0, 1, 2, 4)}, "every expert from 0 to 3"),
    ({"encoder": "moe", "mode": "cluster", "clusters": (0, 1, 2)}, "every expert from 0 to 3"),
    ({"encoder": "film", "film": "chanel"}, "channel"),
    ({"encoder": "film", "film_widths": (8, 0)}, "film-widths"),
]


@pytest.mark.parametrize(("settings", "message"), REFUSED)
def test_what_cannot_work_is_refused(settings, message):
    with pytest.raises(InputError, match=message):
        agent("sac", **settings)


def test_an_ensemble_needs_not_know_the_task():
    """The only mixture that an agent may have which is told nothing."""
    made = agent("sac", encoder="moe", mode="ensemble", hidden=(4,))
    state = jax.eval_shape(lambda: made.init(Spec.vector(3, 2, 1), tasks_of("one-step"), jax.random.key(0)))
    assert set(state.nets["actor"].shared["body"]["params"]) == {"experts", "trunk"}


# FiLM.


@pytest.mark.parametrize("name", ["channel", "scalar"])
def test_film_begins_as_the_plain_network(name):
    """Without the task: at the start its features change nothing, bit for bit."""
    module, data = part(name).body(HIDDEN, True), (OBSERVATIONS, NUMBERS[0], ACTIONS)
    params = quick(module.init, jax.random.key(0), *data)(jax.random.key(0), *data)
    assert any(np.any(x != 0) for x in jax.tree.leaves(params["params"]["generator"]))
    apply = quick(lambda *data: module.apply(*data), params, *data)
    found = [np.asarray(apply(params, OBSERVATIONS, c, ACTIONS)) for c in (NUMBERS[0], 9 * NUMBERS[1])]
    np.testing.assert_array_equal(*found)
    trunk = jax.tree.map(np.asarray, params["params"]["trunk"])
    close(found[0], [mlp(trunk, np.concatenate([o, a])) for o, a in zip(OBSERVATIONS, ACTIONS, strict=True)])


@pytest.mark.parametrize(("name", "outputs"), [("channel", 2 * (7 + 6)), ("scalar", 2 * 2)])
def test_film_has_a_scale_and_a_shift_a_unit_or_a_layer(name, outputs):
    module = part(name).body(HIDDEN, False)
    shapes = jax.eval_shape(module.init, jax.random.key(0), OBSERVATIONS, NUMBERS[0])["params"]
    assert shapes["modulation"]["kernel"].shape == (8, outputs)


# MOORE.


def vectors(*shape):
    return np.float32(np.random.default_rng(3).normal(size=shape))


ORTHONORMAL = jax.jit(orthonormal)
# The gradient of a function of the basis that is not stationary anywhere, and its value.
PROBE = jax.jit(jax.value_and_grad(lambda u: jnp.vdot(orthonormal(u), jnp.cos(jnp.arange(u.size).reshape(u.shape)))))


def test_experts_become_orthonormal_in_their_order():
    """Every sample by itself; and as textbook Gram-Schmidt."""
    u = vectors(5, 2, 3, 12)
    v = np.asarray(ORTHONORMAL(u))
    for i in np.ndindex(2, 3):
        rows = v[(slice(None), *i)]
        close(rows @ rows.T, np.eye(5))
        close(rows, gram_schmidt(u[(slice(None), *i)]), atol=1e-4)


def test_the_scale_of_an_expert_does_not_matter():
    """Its direction alone is what it contributes."""
    u = vectors(3, 4, 8)
    close(ORTHONORMAL(u * np.float32([0.5, 10, 300])[:, None, None]), ORTHONORMAL(u), atol=1e-4)


def test_gradients_go_through_gram_schmidt():
    """Against differences of the textbook process in double precision."""
    u = vectors(3, 5)
    direction = np.cos(np.arange(15)).reshape(3, 5)
    expected = np.zeros((3, 5))
    for i in np.ndindex(3, 5):
        step = np.zeros((3, 5))
        step[i] = 1e-6
        expected[i] = np.sum((gram_schmidt(u + step) - gram_schmidt(u - step)) * direction) / 2e-6
    np.testing.assert_allclose(PROBE(u)[1], expected, rtol=1e-3, atol=1e-4)


def replaced(**rows):
    u = vectors(3, 5)
    for k, row in rows.items():
        u[int(k[1])] = row
    return u


DEGENERATE = {
    "all-zero": np.zeros((3, 5), np.float32),
    "first-zero": replaced(u0=0.0),
    "second-zero": replaced(u1=0.0),
    "equal": replaced(u1=vectors(3, 5)[0]),
    "opposite": replaced(u1=-3 * vectors(3, 5)[0]),
    "nearly-equal": replaced(u1=vectors(3, 5)[0] * (1 + 1e-6)),
    "in-the-span": replaced(u2=vectors(3, 5)[0] - 2 * vectors(3, 5)[1]),
    "too-many": vectors(5, 3),
    "tiny": vectors(3, 5) * np.float32(1e-20),
    "huge": vectors(3, 5) * np.float32(1e15),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_dependent_experts_stay_finite(name):
    """In value, no longer than a unit vector, and in gradient; none at all is left of what is not new."""
    u = DEGENERATE[name]
    v = np.asarray(ORTHONORMAL(u))
    assert np.all(np.linalg.norm(v, axis=1) <= 1 + 1e-5)
    value, slopes = PROBE(u)
    assert np.isfinite(value) and np.all(np.isfinite(slopes))
    spare = {"all-zero": [0, 1, 2], "first-zero": [0], "second-zero": [1], "in-the-span": [2], "too-many": [3, 4]}
    spare = spare.get(name, [1] if "equal" in name or name == "opposite" else [])
    assert np.all(np.abs(v[spare]) < 0.05)
    kept = [k for k in range(len(u)) if k not in spare and name != "tiny"]
    close(v[kept] @ v[kept].T, np.eye(len(kept)), atol=1e-4)


def test_equal_experts_can_part():
    """The second of two equal ones has a slope, away from the first."""
    slopes = np.asarray(PROBE(DEGENERATE["equal"])[1])
    first = DEGENERATE["equal"][0] / np.linalg.norm(DEGENERATE["equal"][0])
    apart = slopes[1] - (slopes[1] @ first) * first
    assert np.linalg.norm(apart) > 1


def test_a_task_with_features_of_zero_still_sees_its_observation():
    """The middle of the training range has the parameters 0."""
    module = part("moore").body(HIDDEN, False)
    start = lambda key: module.init_with_output(key, OBSERVATIONS, jnp.zeros(1))[0]
    found = np.asarray(quick(start, jax.random.key(0))(jax.random.key(0)))
    assert np.abs(found[0] - found[1]).max() > 0.1 and found.shape == (BATCH, HIDDEN[-1])


def test_no_more_experts_than_directions():
    with pytest.raises(InputError, match="7 orthogonal experts"):
        ENCODERS["moore"](num_experts=7).body((9, 6), False)  # type: ignore


# Input maps.


def test_input_maps_begin_as_the_identity():
    """A network with them is at first the one without."""
    init, apply, _ = network_of("input-map")
    params = quick(init, jax.random.key(0))(jax.random.key(0))
    assert set(params.own) == {"front"}
    kernel, bias = (np.asarray(params.own["front"]["params"]["map"][k]) for k in ("kernel", "bias"))
    np.testing.assert_array_equal(kernel, np.tile(np.eye(OBS), (TASKS, 1, 1)))
    np.testing.assert_array_equal(bias, np.zeros((TASKS, OBS)))
    plain = Network(part("input-map").body(HIDDEN, True))
    data = (NUMBERS, OBSERVATIONS, ACTIONS)
    without = quick(jax.vmap(plain.apply, (None, 0, None, None)), Params(params.shared, {}), *data)
    close(quick(apply, params, *data)(params, *data), without(Params(params.shared, {}), *data))


def test_a_task_maps_its_observations_by_its_own():
    """Into the shared network, which sees action and features as they are."""
    _, apply, params = network_of("input-map")
    data = (NUMBERS, OBSERVATIONS, ACTIONS)
    found = quick(apply, params, *data)(params, *data)
    own = jax.tree.map(np.asarray, params.own["front"]["params"]["map"])
    shared = jax.tree.map(np.asarray, params.shared)
    for task in range(TASKS):
        mapped = OBSERVATIONS @ own["kernel"][task] + own["bias"][task]
        inputs = np.concatenate([mapped, ACTIONS, np.tile(NUMBERS[task], (BATCH, 1))], axis=1)
        hidden = np.stack([mlp(shared["body"]["params"]["MLP_0"], x) for x in inputs])
        close(found[task], dense(shared["head"], hidden))


# In an agent.

TOLD = {"conditioning": "one-hot", "hidden": (6,)}
AGENTS = {name: ("sac", {"encoder": PARTS[name][0], **PARTS[name][1], **TOLD}) for name in PARTS}
AGENTS |= {name: (name, {"hidden": (6,)}) for name in ("film", "moe", "moore")}


@pytest.mark.parametrize("name", one_in(4, AGENTS))
def test_agents_of_these_parts_have_the_right_shapes(name):
    """Traced, under a map over seeds: an update keeps the state's shapes, also where gradients are combined."""
    base, settings = AGENTS[name]
    spec, tasks, keys = (
        Spec.vector(3, 2, 1),
        tasks_of("one-step", (1.0, -0.5, 0.3)),
        jax.random.split(jax.random.key(0), 2),
    )
    made = agent(base, **{"gradients": "pcgrad", **settings})
    state = jax.eval_shape(jax.vmap(lambda key: made.init(spec, tasks, key)), keys)
    update = jax.vmap(lambda state, key: probes.update(made, state, random_batch(0, 3, 4, spec), tasks, key)[0])
    after = jax.eval_shape(update, state, keys)
    assert jax.tree.map(lambda x: x.shape, after) == jax.tree.map(lambda x: x.shape, state)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["top-k", "input-map"])
def test_agents_learn_with_them(name):
    """Two updates, the second of which bootstraps from what the first moved, stay finite and move everything."""
    _, settings = AGENTS[name]
    tasks, spec = tasks_of("one-step", (1.0, -0.5, 0.3)), Spec.vector(3, 2, 1)
    made = tiny("sac", **settings)
    init, update = learner(made, tasks, 4, spec)
    before = after = init(tasks, jax.random.key(0))
    for i in range(2):
        after, metrics = update(after, random_batch(i, 3, 4, spec), tasks, jax.random.key(i))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((after, metrics)))
    fitted = lambda state: [state.nets[name] for name in made.fits["critic"].names]
    pairs = zip(jax.tree.leaves(fitted(before)), jax.tree.leaves(fitted(after)), strict=True)
    assert all(not np.array_equal(a, b) for a, b in pairs)
