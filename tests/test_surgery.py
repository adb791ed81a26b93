"""Gradients of several tasks combined, for both kinds of parameters: against slopes worked out by hand."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import learner, random_batch, slow_but, tasks_of, tiny

from mtjax.agents.networks import Params
from mtjax.agents.parts.gradients import surgery
from mtjax.agents.parts.gradients.surgery import RULES
from mtjax.types import Spec

KEY = jax.random.key(4)
SURGICAL = sorted(name for name, rule in RULES.items() if rule.needs == "gradients")
surgical = pytest.mark.parametrize("name", SURGICAL)
LAYERED = [("pcgrad", True), ("gradnorm", True)]
every_rule = pytest.mark.parametrize("name", RULES)


@pytest.mark.parametrize("small", [0, 6, 100])
def test_gram_matrix_is_of_all_leaves(small, monkeypatch):
    """J J^T of the flattened gradients, whatever the shapes of the leaves and how many are put side by side."""
    monkeypatch.setattr(surgery, "SMALL", small)
    random = np.random.default_rng(0)
    leaves = {"a": random.normal(size=(3, 4, 2)), "b": [random.normal(size=3), random.normal(size=(3, 5))]}
    flat = np.concatenate([x.reshape(3, -1) for x in (leaves["a"], *leaves["b"])], axis=1)
    np.testing.assert_allclose(surgery.gram_matrix(jax.tree.map(jnp.float32, leaves)), flat @ flat.T, rtol=1e-4)


@pytest.mark.parametrize("small", [0, 6, 100])
def test_weighted_sums_are_of_each_leaf(small, monkeypatch):
    """In their order and shapes."""
    monkeypatch.setattr(surgery, "SMALL", small)
    random = np.random.default_rng(0)
    weights, leaves = random.normal(size=3), [random.normal(size=(3, *shape)) for shape in ((4, 2), (), (5,), (2, 4))]
    found = surgery.weighted_sums(jnp.float32(weights), [jnp.float32(leaf) for leaf in leaves])
    for total, leaf in zip(found, leaves, strict=True):
        np.testing.assert_allclose(total, np.tensordot(weights, leaf, 1), rtol=1e-4, atol=1e-6)


def test_conflicts_by_hand():
    """Of the pairs of (1, 0), (0, 2), (-3, 0) one points apart: cosines 0, -1 and 0."""
    jacobian = jnp.float32([[1, 0], [0, 2], [-3, 0]])
    found = surgery.conflicts(surgery.gram_matrix(jacobian))
    np.testing.assert_allclose((found["cosine"], found["conflict"]), (-1 / 3, 1 / 3), rtol=1e-6)
    np.testing.assert_allclose(found["gradient_norm"], (1, 2, 3), rtol=1e-6)


@pytest.mark.parametrize("jacobian", [np.ones((1, 2)), np.zeros((3, 2))], ids=["one task", "zero gradients"])
def test_conflicts_of_nothing_are_zero(jacobian):
    """And finite, for a single task and for tasks without gradients."""
    found = surgery.conflicts(surgery.gram_matrix(jnp.float32(jacobian)))
    assert found["cosine"] == found["conflict"] == 0


# Losses of both kinds of parameter.

TASKS = 3
DATA = {
    "goal": np.float32([[1.0, -1.0], [-2.0, 0.5], [0.3, 3.0]]),
    "slope": np.float32([[0.3, -2.0, 1.0], [1.5, 0.4, -0.7], [-1.0, 0.6, 0.8]]),
    "offset": np.float32([0.5, -1.0, 2.0]),
    "factor": np.ones(3, np.float32),
}
PARAMS = Params(
    shared={
        "first": {"bias": jnp.float32([0.2, -0.4])},
        "second": {"bias": jnp.float32([0.1]), "kernel": jnp.float32([0.7, -0.2])},
    },
    own={"y": jnp.float32([[1.0], [2.0], [-0.5]])},
)


def quadratic(params, data):
    """A factor times |a - goal|^2 + (b - slope)^2 / 2 + (a_0 y - offset)^2, in which shared and own parameters meet."""
    first, second, y = params.shared["first"]["bias"], params.shared["second"], params.own["y"][0]
    fit = first[0] * y - data["offset"]
    rest = jnp.concatenate([second["bias"], second["kernel"]]) - data["slope"]
    loss = jnp.sum(jnp.square(first - data["goal"])) + jnp.sum(jnp.square(rest)) / 2 + jnp.square(fit)
    return data["factor"] * loss, {"fit": fit}


def by_hand():
    """Losses (T,), gradients (T, 2) and (T, 3) of the shared layers and own gradients (T, 1), in float64."""
    a, y = np.float64(PARAMS.shared["first"]["bias"]), np.float64(PARAMS.own["y"])[:, 0]
    second = PARAMS.shared["second"]
    fit = a[0] * y - DATA["offset"]
    rest = np.concatenate([second["bias"], second["kernel"]]) - np.float64(DATA["slope"])
    losses = np.sum((a - DATA["goal"]) ** 2, axis=1) + np.sum(rest**2, axis=1) / 2 + fit**2
    first = 2 * (a - DATA["goal"])
    first[:, 0] += 2 * fit * y
    return losses, (first, rest), (2 * fit * a[0])[:, None], fit


def flat(shared):
    """The shared layers' gradients (2,) and (3,)."""
    second = shared["second"]
    return np.asarray(shared["first"]["bias"]), np.concatenate([second["bias"], second["kernel"]])


@partial(jax.jit, static_argnums=(0, 5))
def combine(rule, params, data, memory, importance=None, per_layer=False):
    return surgery.gradient(rule, quadratic, params, data, memory, KEY, importance, per_layer)


def combined(name, params=PARAMS, data=DATA, importance=None, per_layer=False):
    """What a rule makes of the tasks' gradients at the first update."""
    rule = RULES[name]()
    memory = surgery.init(rule, params, TASKS, per_layer)
    return combine(rule, params, data, memory, importance, per_layer)


@partial(jax.jit, static_argnums=0)
def weights_of(rule, gram, losses, key):
    return rule.weigh(rule.init(len(gram)), gram, losses, key)[0]


def expected_weights(name, gradients, losses, layer=0, num_layers=1):
    """A rule's first weights (T,) for gradients (T, P)."""
    key = jax.random.split(KEY, num_layers)[layer]
    gram = jnp.float32(gradients @ gradients.T)
    return np.float64(weights_of(RULES[name](), gram, jnp.float32(losses), key))


def test_mean_is_the_gradient_of_the_mean_loss():
    """For shared and own parameters, against the slopes worked out by hand."""
    found = combined("mean")
    losses, shared, own, fit = by_hand()
    for total, gradients in zip(flat(found.gradients.shared), shared, strict=True):
        np.testing.assert_allclose(total, gradients.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(found.gradients.own["y"], own / TASKS, rtol=1e-5)
    np.testing.assert_allclose(found.losses, losses, rtol=1e-5)
    np.testing.assert_allclose(found.aux["fit"], fit, rtol=1e-5)
    assert found.metrics == {} and found.memory is None


@surgical
def test_rules_weigh_shared_parameters_alone(name):
    """Shared ones by the rule's weights, which own ones do not enter; own ones are averaged."""
    found = combined(name)
    losses, shared, own, fit = by_hand()
    weights = expected_weights(name, np.concatenate(shared, axis=1), losses)
    for total, gradients in zip(flat(found.gradients.shared), shared, strict=True):
        np.testing.assert_allclose(total, weights @ gradients, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.gradients.own["y"], own / TASKS, rtol=1e-5)
    np.testing.assert_allclose(found.losses, losses, rtol=1e-5)
    np.testing.assert_allclose(found.aux["fit"], fit, rtol=1e-5)
    assert set(found.metrics) == {"cosine", "conflict", "gradient_norm"} and found.metrics["conflict"] > 0


def test_famo_weighs_without_gradients():
    """Shared parameters by weights inverse to the losses; own ones are averaged, as if they were not weighed."""
    found = combined("famo")
    losses, shared, own, _ = by_hand()
    weights = 1 / losses / np.sum(1 / losses)
    for total, gradients in zip(flat(found.gradients.shared), shared, strict=True):
        np.testing.assert_allclose(total, weights @ gradients, rtol=1e-4)
    np.testing.assert_allclose(found.gradients.own["y"], own / TASKS, rtol=1e-4)
    np.testing.assert_allclose(found.losses, losses, rtol=1e-5)
    assert found.metrics == {}


def test_surgery_differs_from_the_mean():
    """Or all of the above would show little."""
    mean = np.concatenate(flat(combined("mean").gradients.shared))
    for name in set(RULES) - {"mean", "gradnorm"}:  # whose first weights are the mean's
        update = np.concatenate(flat(combined(name).gradients.shared))
        assert np.linalg.norm(update - mean) > 0.05 * np.linalg.norm(mean), name


@pytest.mark.parametrize("name", ["pcgrad", "upgrad", "gradnorm"])
def test_each_layer_by_itself(name):
    """Kernel and bias of a layer together, by the weights that its gradients have alone; metrics are of all."""
    found, whole = combined(name, per_layer=True), combined(name)
    losses, shared, own, _ = by_hand()
    for layer, (total, gradients) in enumerate(zip(flat(found.gradients.shared), shared, strict=True)):
        weights = expected_weights(name, gradients, losses, layer, 2)
        np.testing.assert_allclose(total, weights @ gradients, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.gradients.own["y"], own / TASKS, rtol=1e-5)
    for metric, value in whole.metrics.items():
        np.testing.assert_allclose(found.metrics[metric], value, rtol=1e-5)


def test_layers_differ_from_all_at_once():
    """For these gradients, so that the test of each layer has something to find."""
    updates = [np.concatenate(flat(combined("upgrad", per_layer=p).gradients.shared)) for p in (True, False)]
    assert np.linalg.norm(updates[0] - updates[1]) > 0.05 * np.linalg.norm(updates[1])


@pytest.mark.parametrize("per_layer", [True, False])
def test_a_rule_remembers_by_layer(per_layer):
    """GradNorm over three updates of each layer, or of all: as the rule does on that layer's Gram matrix alone."""
    rule = RULES["gradnorm"]()
    losses, shared, _, _ = by_hand()
    blocks = shared if per_layer else [np.concatenate(shared, axis=1)]
    memory, alone = surgery.init(rule, PARAMS, TASKS, per_layer), [rule.init(TASKS) for _ in blocks]
    update = jax.jit(lambda memory, gram: rule.weigh(memory, gram, jnp.float32(losses), KEY))
    for _ in range(3):
        found = combine(rule, PARAMS, DATA, memory, None, per_layer)
        weights, alone = zip(
            *(update(m, jnp.float32(b @ b.T)) for m, b in zip(alone, blocks, strict=True)), strict=True
        )
        memory = found.memory
    of_layer = weights if per_layer else [weights[0], weights[0]]
    for total, gradients, w in zip(flat(found.gradients.shared), shared, of_layer, strict=True):
        np.testing.assert_allclose(total, np.float64(w) @ gradients, rtol=1e-4)
    np.testing.assert_allclose(memory.weights, np.stack([m.weights for m in alone]), rtol=1e-5)
    assert memory.weights.shape == (len(blocks), TASKS) and np.ptp(memory.weights) > 0.05


@pytest.mark.parametrize(("name", "per_layer"), [*((name, False) for name in RULES), *LAYERED])
def test_memories_keep_their_shapes(name, per_layer):
    """Under a scan and a map over seeds, and stay finite."""
    rule = RULES[name]()

    def update(carry, _):
        params, memory = carry
        found = surgery.gradient(rule, quadratic, params, DATA, memory, KEY, None, per_layer)
        params = jax.tree.map(lambda p, g: p - 0.05 * g, params, found.gradients)
        return (params, surgery.adapt_rule(rule, quadratic, params, DATA, found)), jnp.mean(found.losses)

    run = lambda params: jax.lax.scan(update, (params, surgery.init(rule, params, TASKS, per_layer)), length=4)
    seeds = jax.tree.map(lambda x: jnp.stack([x, x + 0.1]), PARAMS)
    (params, memory), losses = jax.jit(jax.vmap(run))(seeds)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((params, memory, losses)))
    if name not in ("mgda", "imtl-g"):  # which may stop where tasks disagree
        assert np.all(losses[:, -1] < losses[:, 0])


@every_rule
def test_twice_the_importance_is_twice_the_loss(name):
    """For every rule, in gradients of shared and own parameters; what is reported is the loss as it is."""
    factors = jnp.float32([1, 2, 1])
    found, expected = combined(name, importance=factors), combined(name, data={**DATA, "factor": factors})
    for a, b in zip(jax.tree.leaves(found.gradients), jax.tree.leaves(expected.gradients), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.losses, by_hand()[0], rtol=1e-5)
    plain = combined(name)
    np.testing.assert_allclose(found.gradients.own["y"], plain.gradients.own["y"] * factors[:, None], rtol=1e-4)
    if name != "famo":  # which evens out the scales of losses
        assert not np.allclose(flat(found.gradients.shared)[0], flat(plain.gradients.shared)[0], rtol=1e-3)


@every_rule
def test_rules_agree_where_tasks_do(name):
    """The same data for every task: nothing conflicts, and all rules average; CAGrad goes further by its radius."""
    same = {k: np.repeat(v[:1], TASKS, axis=0) for k, v in DATA.items()}
    params = PARAMS._replace(own={"y": jnp.ones((TASKS, 1))})
    mean, found = combined("mean", params, same), combined(name, params, same)
    ratio = 1.5 / 1.25 if name == "cagrad" else 1
    for a, b in zip(flat(mean.gradients.shared), flat(found.gradients.shared), strict=True):
        np.testing.assert_allclose(ratio * a, b, rtol=1e-3)
    np.testing.assert_allclose(mean.gradients.own["y"], found.gradients.own["y"], rtol=1e-5)
    if found.metrics:
        np.testing.assert_allclose((found.metrics["cosine"], found.metrics["conflict"]), (1, 0), atol=1e-6)


@every_rule
def test_an_absent_task_leaves_the_others_alone(name):
    """Of importance 0, so that loss and gradient are zero: the update's direction is the others' own."""
    found = combined(name, importance=jnp.float32([1, 0, 1]))
    update = np.concatenate(flat(found.gradients.shared))
    assert np.all(np.isfinite(update)) and np.all(np.isfinite(found.gradients.own["y"]))
    losses, shared, own, _ = by_hand()
    np.testing.assert_allclose(found.gradients.own["y"], own * [[1], [0], [1]] / TASKS, rtol=1e-4)
    pair = [0, 2]
    gradients = np.concatenate(shared, axis=1)[pair]
    weights = weights_of(RULES[name](), jnp.float32(gradients @ gradients.T), jnp.float32(losses[pair]), KEY)
    expected = np.float64(weights) @ gradients
    cosine = update @ expected / np.linalg.norm(update) / np.linalg.norm(expected)
    np.testing.assert_allclose(cosine, 1, atol=1e-4)


@every_rule
def test_nothing_to_learn_is_finite(name):
    """Losses and gradients of zero give an update of zero."""
    found = combined(name, importance=jnp.zeros(TASKS))
    assert all(np.array_equal(x, np.zeros_like(x)) for x in jax.tree.leaves(found.gradients))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((found.memory, found.metrics)))


# The second look.


def test_the_second_look_is_at_the_new_losses():
    """FAMO's logits move by what the step did to each task's loss on the same data; the task that fell least gains."""
    rule = RULES["famo"]()
    before = combined("famo")
    moved = jax.tree.map(lambda p, g: p - 0.02 * g, PARAMS, before.gradients)
    memory = jax.jit(lambda: surgery.adapt_rule(rule, quadratic, moved, DATA, before))()
    after = np.asarray(combined("mean", moved).losses)
    expected = rule.adapt(before.memory, before.losses, jnp.asarray(after))
    np.testing.assert_allclose(memory.logits, expected.logits, rtol=1e-4)
    gain = np.log(np.asarray(before.losses) / after)
    assert memory.logits[np.argmin(gain)] > 0 > memory.logits[np.argmax(gain)]


def test_other_rules_keep_their_memory():
    """Their loss is not even traced."""

    def never(params, data):
        raise AssertionError

    for name in set(RULES) - {"famo"}:
        before = combined(name)
        assert surgery.adapt_rule(RULES[name](), never, PARAMS, DATA, before) is before.memory


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(["gradnorm", "famo"], "famo"))
def test_agents_remember_their_weights(name):
    """What a rule learned of the critic is in the agent's state: nothing at first, and other after each update."""
    tasks, spec = tasks_of("one-step", (1.0, -0.5, 0.3)), Spec.vector(3, 2, 1)
    init, update = learner(tiny(name), tasks, 4, spec)
    state = init(tasks, KEY)
    seen = []
    for i in range(3):
        seen.append(np.ravel(state.fits["critic"].rule[0]))
        state, _ = update(state, random_batch(i, 3, 4, spec), tasks, jax.random.key(i))
    np.testing.assert_array_equal(seen[0], np.float32(name == "gradnorm"))
    assert not np.allclose(seen[0], seen[1]) and not np.allclose(seen[1], seen[2])
    rules = {name: fit.rule for name, fit in state.fits.items()}
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((rules, state.nets["critic"])))
    assert (rules["actor"] is None) == (name == "famo")
