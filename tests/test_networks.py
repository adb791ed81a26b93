"""Networks against plain NumPy, one task and one expert at a time; the policy's density against its distribution."""

import re
from statistics import NormalDist

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import tasks_of, tiny

from mtjax.agents.networks import MLP, Network, Params, Trunk, join, orthogonal
from mtjax.agents.parts.encoders.care import Experts, Mixture
from mtjax.agents.parts.policies import Gaussian
from mtjax.types import Spec

TASKS, BATCH, OBS, ACTION, CONTEXT, OUT = 3, 4, 2, 1, 2, 5


@pytest.fixture(scope="module")
def data():
    """Observations (B, O), actions (B, A) and one task's features (Z,)."""
    random = np.random.default_rng(0)
    return tuple(np.float32(random.normal(size=shape)) for shape in ((BATCH, OBS), (BATCH, ACTION), (CONTEXT,)))


def jiggle(tree):
    """Random values everywhere, so that biases and scales matter too."""
    random = np.random.default_rng(1)
    return jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape)), tree)


def plain_mlp(params, x, layer_norm=False):
    for i in range(sum(name.startswith("Dense") for name in params)):
        x = x @ np.asarray(params[f"Dense_{i}"]["kernel"]) + np.asarray(params[f"Dense_{i}"]["bias"])
        if layer_norm:
            norm = params[f"LayerNorm_{i}"]
            x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
            x = x * np.asarray(norm["scale"]) + np.asarray(norm["bias"])
        x = np.maximum(x, 0)
    return x


def close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("layer_norm", [False, True])
def test_mlp_is_dense_then_norm_then_relu(data, layer_norm):
    """In every layer, the last included."""
    module = MLP((6, 7), layer_norm)
    params = jiggle(jax.eval_shape(module.init, jax.random.key(0), data[0]))
    close(module.apply(params, data[0]), plain_mlp(params["params"], data[0], layer_norm))


def test_join_repeats_the_task_for_every_sample(data):
    """Inputs in the order given, the task last; also for a single sample, and for no features."""
    obs, action, features = data
    found = join(obs, action, task=features)
    close(found, np.concatenate([obs, action, np.tile(features, (BATCH, 1))], axis=1))
    close(join(obs[0], task=features), np.concatenate([obs[0], features]))
    close(join(obs, task=jnp.zeros(0)), obs)


@pytest.mark.parametrize("own_heads", [False, True])
def test_a_task_uses_the_shared_body_and_its_own_head_alone(data, own_heads):
    """The network mapped over tasks against one task at a time in NumPy."""
    obs, action, _ = data
    features = np.float32(np.random.default_rng(2).normal(size=(TASKS, CONTEXT)))
    network = Network(Trunk((6,)), ("head",) if own_heads else ())
    params = jiggle(network.init(jax.random.key(0), TASKS, OUT, features[0], obs[0], action[0]))
    mapped = jax.vmap(network.apply, (Params(None, 0), 0, None, None))(params, features, obs, action)
    for i in range(TASKS):
        inputs = np.concatenate([obs, action, np.tile(features[i], (BATCH, 1))], axis=1)
        hidden = plain_mlp(params.shared["body"]["params"]["MLP_0"], inputs)
        head = {k: v[i] for k, v in params.own["head"].items()} if own_heads else params.shared["head"]
        close(mapped[i], hidden @ np.asarray(head["kernel"]) + np.asarray(head["bias"]))


def test_heads_begin_differently_and_do_not_touch_each_other(data):
    """One task's head does nothing to another task's output."""
    network = Network(Trunk((6,)), own=("head",))
    params = network.init(jax.random.key(0), TASKS, OUT, data[2], data[0])
    kernel = params.own["head"]["kernel"]
    assert not np.allclose(kernel[0], kernel[1]) and kernel.shape == (TASKS, 6, OUT)
    changed = Params(params.shared, {"head": {"kernel": kernel.at[1].add(1.0), "bias": params.own["head"]["bias"]}})
    over_tasks = jax.vmap(network.apply, (Params(None, 0), None, None))
    difference = np.abs(over_tasks(changed, data[2], data[0]) - over_tasks(params, data[2], data[0])).max(axis=(1, 2))
    assert difference[0] == difference[2] == 0 < difference[1]


def plain_experts(params, x, num_experts):
    encodings = []
    for k in range(num_experts):
        first, second = ((params[f"kernel_{i}"][k], params[f"bias_{i}"][k]) for i in (0, 1))
        encodings.append(np.maximum(x @ first[0] + first[1], 0) @ second[0] + second[1])
    return np.stack(encodings)


def test_experts_are_separate_networks_with_a_linear_output(data):
    """Each against its own slice of the parameters."""
    module = Experts(3, (6, 4))
    params = jiggle(jax.eval_shape(module.init, jax.random.key(0), data[0]))
    found = module.apply(params, data[0])
    close(found, plain_experts(params["params"], data[0], 3))
    assert np.any(found < 0)


def test_experts_begin_with_the_variance_of_a_single_layer():
    """The axis of experts is not taken for inputs; LeCun's initialisation has variance 1 / inputs."""
    kernel = Experts(8, (100,)).init(jax.random.key(0), jnp.zeros(50))["params"]["kernel_0"]
    np.testing.assert_allclose(np.var(kernel, axis=(1, 2)), 1 / 50, rtol=0.1)
    assert not np.allclose(kernel[0], kernel[1])


@pytest.mark.parametrize("variant", ["paper", "mtrl"])
@pytest.mark.parametrize("with_action", [False, True], ids=["actor", "critic"])
def test_care_is_its_equations(data, variant, with_action):
    """The mixture by a loop over samples and experts."""
    obs, action, features = data
    actions = (action,) if with_action else ()
    module = Mixture(3, (6, 4), variant, 3.0, False, (7,), layer_norm=True)
    params = jiggle(jax.eval_shape(module.init, jax.random.key(0), obs, features, *actions))
    p = jax.tree.map(np.asarray, params["params"])
    dense = lambda layer, x: x @ layer["kernel"] + layer["bias"]
    context = dense(p["context_out"], plain_mlp(p["context"], features))
    encodings = plain_experts(p["experts"], obs, 3)
    rows = []
    for b in range(BATCH):
        if variant == "paper":
            scores = np.array([encodings[k, b] @ context for k in range(3)]) / 3.0
        else:
            scores = dense(p["gate_out"], plain_mlp(p["gate"], context))
        attention = np.exp(scores - scores.max()) / np.exp(scores - scores.max()).sum()
        encoding = sum(attention[k] * encodings[k, b] for k in range(3))
        encoding = plain_mlp(p["after"], encoding) if variant == "paper" else encoding
        rows.append(np.concatenate([encoding, *(a[b] for a in actions), context]))
    close(module.apply(params, obs, features, *actions), plain_mlp(p["trunk"], np.stack(rows), layer_norm=True))
    one = module.apply(params, obs[0], features, *(a[0] for a in actions))
    close(one, module.apply(params, obs, features, *actions)[0])


def test_layer_norm_is_in_the_trunk_alone(data):
    """The setting is the critic's; encoders have none."""
    params = Mixture(2, (4,), "paper", 2.0, False, (7,), layer_norm=True).init(jax.random.key(0), data[0], data[2])[
        "params"
    ]
    has_norm = {name for name, part in params.items() if any("LayerNorm" in key for key in part)}
    assert has_norm == {"trunk"}


def std_of(log_std):
    """The deviation that an unbounded output stands for: log_std goes smoothly from -5 to 2."""
    return np.exp(-5 + 3.5 * (np.tanh(log_std) + 1))


def test_log_probability_is_the_slope_of_the_distribution():
    """P(A <= a) = Phi((artanh a - mean) / std), differentiated numerically, for one dimension at a time."""
    random = np.random.default_rng(0)
    outputs = np.concatenate([random.normal(size=(50, 2)), random.normal(-0.2, 0.2, size=(50, 2))], axis=1)
    actions, _, found = Gaussian().draw(jnp.float32(outputs), None, jax.random.key(0))
    actions = np.clip(np.float64(actions), -0.999, 0.999)
    kept = np.all(np.abs(actions) < 0.99, axis=1)  # artanh amplifies float32 rounding beyond
    normal = NormalDist()
    expected = np.zeros(50)
    for i in np.flatnonzero(kept):
        for action, mean, log_std in zip(actions[i], outputs[i, :2], outputs[i, 2:], strict=True):
            below = lambda a, mean=mean, log_std=log_std: normal.cdf((np.arctanh(a) - mean) / std_of(log_std))
            expected[i] += np.log((below(action + 1e-5) - below(action - 1e-5)) / 2e-5)
    assert kept.sum() > 20
    np.testing.assert_allclose(found[kept], expected[kept], atol=2e-3)


def test_samples_have_the_given_mean_and_deviation():
    """Before the squashing, over many keys."""
    outputs = jnp.float32([0.3, -0.2])
    actions, *_ = jax.vmap(lambda key: Gaussian().draw(outputs, None, key))(jax.random.split(jax.random.key(0), 20_000))
    raw = np.arctanh(np.float64(actions[:, 0]))
    np.testing.assert_allclose((raw.mean(), raw.std()), (0.3, std_of(-0.2)), rtol=0.03)


def test_no_key_takes_the_mean_action():
    """Whose log-probability is given as 0, for want of a density."""
    action, _, log_prob = Gaussian().draw(jnp.float32([[0.3, -2.0, 1.0, 1.0]]), None, None)
    np.testing.assert_allclose(action, np.tanh([[0.3, -2.0]]), rtol=1e-6)
    assert log_prob.shape == (1,) and log_prob[0] == 0


def test_extreme_outputs_stay_finite():
    """Saturated actions, and deviations at both ends, in value and in gradient."""
    outputs = jnp.float32([[mean, log_std] for mean in (-100.0, 0.0, 100.0) for log_std in (-100.0, 100.0)])
    total = lambda outputs: jnp.sum(Gaussian().draw(outputs, None, jax.random.key(0)).log_prob)
    assert np.all(np.isfinite(Gaussian().draw(outputs, None, jax.random.key(0)).log_prob))
    assert np.all(np.isfinite(jax.grad(total)(outputs)))


def test_a_body_may_be_any_module(data):
    """A network asks its body for nothing but the call."""

    class Sum(nn.Module):
        @nn.compact
        def __call__(self, obs, features, *action):
            return obs + jnp.sum(features)

    network = Network(Sum())
    params = network.init(jax.random.key(0), TASKS, OUT, data[2], data[0])
    close(network.apply(params, data[2], data[0]), (data[0] + data[2].sum()) @ params.shared["head"]["kernel"])


# Orthogonal kernels. Two batches of QR decompositions at once can wait for each other for ever, on few cores.


def matrices(function, *args):
    """The shapes of all matrices that are decomposed, such as "3,3"."""
    return re.findall(r":f32\[([0-9,]+)\] = qr\[", str(jax.make_jaxpr(function)(*args)))


def test_kernels_are_drawn_one_after_another():
    draw_one = lambda key: orthogonal(2**0.5)(key, (3, 3, 2, 4))
    draw = jax.vmap(jax.vmap(draw_one))
    keys = jax.random.split(jax.random.key(0), (2, 3))
    drawn = draw(keys)
    for place in np.ndindex(2, 3):
        kernel = np.asarray(drawn[place]).reshape(-1, 4)
        assert kernel.T @ kernel == pytest.approx(2 * np.eye(4), abs=1e-5)
        assert np.array_equal(drawn[place], draw_one(keys[place]))
    found = matrices(draw, keys)
    assert found and all(shape.count(",") == 1 for shape in found)


@pytest.mark.parametrize(
    "settings",
    [{"conditioning": "recurrent"}, {"conditioning": "posterior"}, {"representation": "encoded"}],
    ids=lambda settings: next(iter(settings.values())),
)
def test_seeds_begin_one_after_another(settings):
    """Of agents with a GRU or convolutions."""
    spec = Spec.vector(3, 2, 1)
    if "representation" in settings:
        spec = spec._replace(obs={"pixels": jax.ShapeDtypeStruct((16, 16, 3), jnp.uint8)})
    agent, tasks = tiny("ppo", **settings), tasks_of("one-step", (1.0, -0.5))
    found = matrices(jax.vmap(lambda key: agent.init(spec, tasks, key)), jax.random.split(jax.random.key(0), 3))
    assert found and all(shape.count(",") == 1 for shape in found)
