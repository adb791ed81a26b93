"""Rules whose weights are learned over time: GradNorm and FAMO, by hand and where the right weights are known."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK

from mtjax.agents.fit import above_least
from mtjax.agents.networks import Params
from mtjax.agents.parts.gradients import surgery
from mtjax.agents.parts.gradients.balancing import FAMO, Balance, GradNorm
from mtjax.agents.parts.gradients.rules import Mean
from mtjax.types import InputError

KEY = jax.random.key(0)
quick = partial(jax.jit, compiler_options=QUICK)


def orthogonal(lengths):
    """The Gram matrix of orthogonal gradients."""
    return jnp.diag(jnp.square(jnp.float32(lengths)))


class Adam:
    """Kingma & Ba (2015), algorithm 1, in float64."""

    def __init__(self, lr):
        self.lr, self.steps, self.mean, self.square = lr, 0, 0.0, 0.0

    def __call__(self, slope):
        self.steps += 1
        self.mean = 0.9 * self.mean + 0.1 * slope
        self.square = 0.999 * self.square + 0.001 * slope**2
        mean, square = self.mean / (1 - 0.9**self.steps), self.square / (1 - 0.999**self.steps)
        return -self.lr * mean / (np.sqrt(square) + 1e-8)


# GradNorm.


@quick
def balance(memory, lengths, losses, asymmetry=1.0):
    """GradNorm for several updates: lengths and losses (H, T); weights (H, T) and the last memory."""
    rule = GradNorm(gradnorm_asymmetry=1.0)
    object.__setattr__(rule, "gradnorm_asymmetry", asymmetry)  # traced, so that one program serves all

    def update(memory, seen):
        weights, memory = rule.weigh(memory, orthogonal(seen[0]), seen[1], KEY)
        return memory, weights

    memory, weights = jax.lax.scan(update, memory, (jnp.float32(lengths), jnp.float32(losses)))
    return weights, memory


def run_gradnorm(lengths, losses, asymmetry=1.0, memory=None):
    lengths, losses = np.broadcast_arrays(np.float32(lengths), np.float32(losses))
    memory = GradNorm().init(lengths.shape[-1]) if memory is None else memory
    weights, memory = balance(memory, lengths, losses, asymmetry)
    return np.asarray(weights) * lengths.shape[-1], memory


def gradnorm_by_hand(lengths, losses, asymmetry, lr=0.025):
    """Algorithm 1 of Chen et al. (2018), as written, with lengths in units of their mean."""
    weights, first, adam, found = np.ones(lengths.shape[1]), losses[0], Adam(lr), []
    for n, loss in zip(np.float64(lengths), np.float64(losses), strict=True):
        found.append(weights)
        ratio = loss / first
        target = np.mean(weights * n) * (ratio / ratio.mean()) ** asymmetry
        slope = n * np.sign(weights * n - target) / np.mean(weights * n)
        weights = weights + adam(slope)
        weights = weights * len(weights) / weights.sum()
    return np.stack(found)


@pytest.mark.parametrize("asymmetry", [0.0, 0.5, 1.5])
def test_gradnorm_by_hand(asymmetry):
    """Three tasks, twelve updates of changing lengths and losses; the first update is the mean's."""
    random = np.random.default_rng(1)
    lengths, losses = random.uniform(0.2, 3, (12, 3)), random.uniform(0.5, 2, (12, 3))
    weights, memory = run_gradnorm(lengths, losses, asymmetry)
    np.testing.assert_array_equal(weights[0], np.ones(3))
    np.testing.assert_allclose(weights, gradnorm_by_hand(lengths, losses, asymmetry), rtol=1e-4)
    np.testing.assert_allclose(weights.sum(axis=1), 3, rtol=1e-5)
    np.testing.assert_allclose(memory.first, losses[0], rtol=1e-6)  # and not the last, as in MTRL


def test_gradnorm_s_first_step_by_hand():
    """Of lengths 1 and 3, mean 2, the short one gains Adam's first step, a learning rate, and the long one loses it."""
    weights, _ = run_gradnorm([[1.0, 3.0]] * 2, 1.0, 0.0)
    np.testing.assert_allclose(weights[1], [1.025, 0.975], rtol=1e-5)


def test_gradnorm_makes_weighted_lengths_equal():
    """At a = 0, to within a step: w_i is proportional to 1 / n_i, and sums to T."""
    lengths = np.array([0.5, 1.0, 2.0])
    weights, _ = run_gradnorm(np.tile(lengths, (600, 1)), 1.0, 0.0)
    expected = 3 / lengths / np.sum(1 / lengths)
    np.testing.assert_allclose(weights[-200:].mean(axis=0), expected, atol=0.03)


def test_gradnorm_gives_lengths_in_proportion_to_what_is_left():
    """At a = 1, where losses stay at a half, a quarter and three quarters of the first."""
    left = np.array([0.5, 0.25, 0.75])
    losses = np.concatenate([np.ones((1, 3)), np.tile(left, (600, 1))]) * [1, 10, 100]
    weights, _ = run_gradnorm(np.ones((601, 3)), losses)
    np.testing.assert_allclose(weights[-200:].mean(axis=0), left / left.mean(), atol=0.04)


def test_gradnorm_with_equal_tasks_is_the_mean():
    """Of lengths and losses that fall alike, for ever."""
    losses = np.linspace(2, 1, 20)[:, None] * [1.0, 4.0, 0.25]
    weights, _ = run_gradnorm(np.full((20, 3), 0.5), losses)
    np.testing.assert_allclose(weights, 1, atol=2e-5)


def test_gradnorm_does_not_depend_on_scale_or_order():
    """The scale of all lengths, and of each task's losses, is no matter; tasks may be renamed."""
    random, swap = np.random.default_rng(2), np.array([2, 0, 1])
    lengths, losses = random.uniform(0.2, 3, (8, 3)), random.uniform(0.5, 2, (8, 3))
    weights, _ = run_gradnorm(lengths, losses)
    for scale in (1e-6, 1e6):
        np.testing.assert_allclose(run_gradnorm(lengths * scale, losses)[0], weights, rtol=1e-4)
    np.testing.assert_allclose(run_gradnorm(lengths, losses * [1e-3, 1.0, 1e3])[0], weights, rtol=1e-4)
    np.testing.assert_allclose(run_gradnorm(lengths[:, swap], losses[:, swap])[0], weights[:, swap], rtol=1e-4)


def test_an_absent_task_has_no_say_in_gradnorm():
    """Others' weights are those they have alone; it keeps its own, and begins when it comes."""
    random = np.random.default_rng(3)
    lengths, losses = random.uniform(0.2, 3, (8, 2)), random.uniform(0.5, 2, (8, 2))
    alone, _ = run_gradnorm(lengths, losses)
    assert np.ptp(alone[:, 0]) > 0.05
    with_absent, memory = run_gradnorm(np.insert(lengths, 1, 0, axis=1), np.insert(losses, 1, 0, axis=1))
    np.testing.assert_allclose(with_absent, np.insert(alone, 1, 1, axis=1), rtol=1e-4)
    np.testing.assert_allclose(memory.first, [losses[0, 0], 0, losses[0, 1]], rtol=1e-6)
    _, memory = run_gradnorm([[1.0, 1.0, 1.0]], [[1.0, 5.0, 1.0]], memory=memory)
    np.testing.assert_allclose(memory.first, [losses[0, 0], 5, losses[0, 1]], rtol=1e-6)


@pytest.mark.parametrize("losses", [[0.0, 1.0], [0.0, 0.0], [-1.0, 2.0], [-1.0, -2.0]])
@pytest.mark.parametrize("lengths", [[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [1e-12, 1e12]])
@pytest.mark.parametrize("asymmetry", [0.0, 1.0])
def test_gradnorm_is_finite(losses, lengths, asymmetry):
    """For zero and negative losses, absent tasks and no gradients at all; weights are positive and sum to T."""
    weights, memory = run_gradnorm([lengths] * 5, [losses] * 5, asymmetry)
    assert np.all(np.isfinite(weights)) and np.all(weights > 0)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(memory))
    np.testing.assert_allclose(weights.sum(axis=1), 2, rtol=1e-5)
    if not any(lengths):
        np.testing.assert_array_equal(weights, 1)


def test_gradnorm_s_memory_keeps_its_shape():
    """And its types, as a scan needs; weights come from a memory as it was stored."""
    memory, update = GradNorm().init(3), quick(lambda m: GradNorm().weigh(m, orthogonal([1, 2, 3]), jnp.ones(3), KEY))
    _, after = update(memory)
    shapes = lambda tree: jax.tree.map(lambda x: (jnp.shape(x), jnp.result_type(x)), tree)
    assert shapes(after) == shapes(memory) and isinstance(after, Balance)
    weights, _ = update(memory._replace(weights=jnp.float32([2.0, 0.5, 0.5])))
    np.testing.assert_allclose(weights, np.float32([2.0, 0.5, 0.5]) / 3)


def test_an_actor_s_losses_say_nothing_to_gradnorm():
    """Only lengths count: negative losses weigh as any others do."""
    assert GradNorm(weight_lr=0.1, gradnorm_asymmetry=1.5).for_actor == GradNorm(weight_lr=0.1, gradnorm_asymmetry=0.0)
    losses = np.random.default_rng(4).normal(size=(2, 6, 3))
    lengths = np.random.default_rng(5).uniform(0.2, 3, (6, 3))
    a, b = (run_gradnorm(lengths, x, 0.0)[0] for x in losses)
    np.testing.assert_array_equal(a, b)


# Losses below zero.


@pytest.mark.parametrize("rule", [FAMO(), GradNorm(weight_lr=0.3)], ids=["famo", "gradnorm"])
def test_losses_are_counted_from_the_least_that_they_can_be(rule):
    """Updates in which losses fall, each at its rate: gradients are weighted as if none were below 0; metrics not."""
    scales = jnp.float32([1.0, 2.0, 3.0])

    def found(below):
        def of_task(nets, scale):
            loss = 1 + jnp.square(scale * nets["critic"]) - below
            return loss, {"critic_loss": loss}

        agent = SimpleNamespace(representation=SimpleNamespace(least_loss=-below))
        loss = lambda critic, scale: above_least(agent, of_task)({"critic": critic.shared}, scale)
        memory, gradients = surgery.init(rule, Params(jnp.float32(1), {}), 3), []
        for place, after in ((1.0, 0.5), (0.5, 0.4), (0.4, 0.1), (0.1, 0.1)):
            seen = surgery.gradient(rule, loss, Params(jnp.float32(place), {}), scales, memory, KEY)
            memory = surgery.adapt_rule(rule, loss, Params(jnp.float32(after), {}), scales, seen)
            gradients.append(seen.gradients.shared)
            np.testing.assert_allclose(seen.aux["critic_loss"], 1 + np.square(place * scales) - below, rtol=1e-5)
        return gradients

    np.testing.assert_allclose(found(20.0), found(0.0), rtol=1e-4)


# FAMO.


@quick
def weigh(memory, losses):
    return FAMO().weigh(memory, None, losses, KEY)[0]  # type: ignore


@quick
def adapt(memory, before, after):
    return FAMO().adapt(memory, before, after)


def softmax(x):
    return np.exp(x) / np.exp(x).sum()


@pytest.mark.parametrize("rate", [1.0, 0.3])
def test_famo_by_hand(rate):
    """Two tasks and three, over four updates, by the paper's formulas with z's slope written as a matrix.

    At a rate of 1 weights are the paper's, else of running means that begin with the first losses.
    """
    update = quick(lambda memory, losses: FAMO(famo_rate=rate).weigh(memory, None, losses, KEY))  # type: ignore
    for num_tasks in (2, 3):
        before, after = np.random.default_rng(num_tasks).uniform(0.1, 3, (2, 4, num_tasks))
        memory, logits, adam = FAMO().init(num_tasks), np.zeros(num_tasks), Adam(0.025)
        means = before[0]
        for old, new in zip(before, after, strict=True):
            z = softmax(logits)
            means = means + rate * (old - means)
            weights, memory = update(memory, jnp.float32(old))
            np.testing.assert_allclose(weights, z / means / np.sum(z / means), rtol=1e-4)
            np.testing.assert_allclose(memory.losses, means, rtol=1e-5)
            slope = (np.diag(z) - np.outer(z, z)) @ (np.log(old) - np.log(new)) + 1e-3 * logits
            logits = logits + adam(slope)
            memory = adapt(memory, jnp.float32(old), jnp.float32(new))
            np.testing.assert_allclose(memory.logits, logits, rtol=1e-4, atol=1e-6)


def test_famo_s_weights_by_hand():
    """At first inverse to losses 1 and 3: 3/4 and 1/4; then the task that fell less gains a learning rate."""
    memory = FAMO().init(2)
    np.testing.assert_allclose(weigh(memory, jnp.float32([1, 3])), [0.75, 0.25], rtol=1e-6)
    memory = adapt(memory, jnp.float32([1, 3]), jnp.float32([0.5, 2.9]))
    np.testing.assert_allclose(memory.logits, [-0.025, 0.025], rtol=1e-4)
    ratio = np.exp(0.05)
    np.testing.assert_allclose(weigh(memory, jnp.float32([1, 1])), [1 / (1 + ratio), ratio / (1 + ratio)], rtol=1e-5)


def test_famo_learns_what_rare_batches_say():
    """Two tasks estimate a mean of 0.05 from batches: one in twenty is 1, the others 0, and the ones never coincide.

    Weights by a batch's own losses pass over the ones, as their loss is the largest.
    """
    targets = np.zeros((4000, 2), np.float32)
    targets[0::20, 0] = targets[10::20, 1] = 1

    def estimate(rate):
        rule = FAMO(famo_rate=rate)

        def update(carry, target):
            point, memory = carry
            loss = lambda point: 1e-4 + jnp.square(point - target)
            weights, memory = rule.weigh(memory, None, loss(point), KEY)  # type: ignore
            moved = point - 0.01 * weights * 2 * (point - target)
            return (moved, rule.adapt(memory, loss(point), loss(moved))), moved

        run = quick(lambda: jax.lax.scan(update, (jnp.zeros(2), rule.init(2)), targets))
        return np.mean(run()[1][-1000:], axis=0)

    np.testing.assert_allclose(estimate(FAMO().famo_rate), 0.05, atol=0.01)
    assert np.all(estimate(1.0) < 0.01)


def test_famo_lowers_log_losses_at_one_rate():
    """Losses x^2 and y^2 from (1, 3) fall as z / x^2 and z / y^2: nine to one at first, alike once z is as they are."""
    rule = FAMO(weight_lr=0.005, famo_decay=0.0, famo_rate=1.0)

    def update(carry, _):
        point, memory = carry
        weights, memory = rule.weigh(memory, None, jnp.square(point), KEY)  # type: ignore
        moved = point - 3e-4 * weights * 2 * point
        memory = rule.adapt(memory, jnp.square(point), jnp.square(moved))
        return (moved, memory), jnp.log(jnp.square(point)) - jnp.log(jnp.square(moved))

    run = quick(lambda: jax.lax.scan(update, (jnp.float32([1, 3]), rule.init(2)), length=1500))
    (point, memory), gains = run()
    assert np.all(gains > 0)
    np.testing.assert_allclose(gains[0, 0] / gains[0, 1], 9, rtol=0.01)
    late = np.float64(gains[-300:]).mean(axis=0)
    np.testing.assert_allclose(late[0] / late[1], 1, atol=0.02)
    np.testing.assert_allclose(jax.nn.softmax(memory.logits), point**2 / np.sum(point**2), atol=0.01)


def test_famo_s_weights_return_to_equal_ones():
    """By its decay, where all losses fall alike."""
    memory = FAMO().init(2)._replace(logits=jnp.float32([1.0, -1.0]))
    after = adapt(memory, jnp.ones(2), jnp.full(2, 0.5))
    np.testing.assert_allclose(after.logits, [0.975, -0.975], rtol=1e-4)


def test_famo_does_not_depend_on_scale_or_order():
    """The scale of a task's losses leaves what it learns; the scale of all leaves weights; tasks may be renamed."""
    random, swap = np.random.default_rng(6), np.array([2, 0, 1])
    before, after, factors = jnp.float32(random.uniform(0.5, 2, (3, 3)))
    memory = adapt(FAMO().init(3), before, after)
    scaled = adapt(FAMO().init(3), before * factors, after * factors)
    np.testing.assert_allclose(scaled.logits, memory.logits, rtol=1e-3)
    for scale in (1e-6, 1e6):
        np.testing.assert_allclose(weigh(memory, before * scale), weigh(memory, before), rtol=1e-4)
    renamed = adapt(FAMO().init(3), before[swap], after[swap])
    np.testing.assert_allclose(renamed.logits, memory.logits[swap], rtol=1e-4)
    np.testing.assert_allclose(weigh(renamed, before[swap]), weigh(memory, before)[swap], rtol=1e-5)


def test_an_absent_task_has_no_say_in_famo():
    """A loss of zero has no weight, and is not learned from; others' weights are those they have alone."""
    before, after = jnp.float32([1, 3]), jnp.float32([0.9, 2.0])
    alone = adapt(FAMO().init(2), before, after)
    memory = FAMO().init(3)._replace(logits=jnp.float32([0, 0.7, 0]))
    with_absent = adapt(memory, jnp.float32([1, 0, 3]), jnp.float32([0.9, 0, 2]))
    np.testing.assert_allclose(with_absent.logits, [alone.logits[0], 0.7, alone.logits[1]], rtol=1e-4)
    weights = weigh(with_absent, jnp.float32([1, 0, 3]))
    np.testing.assert_allclose(weights, np.insert(weigh(alone, before), 1, 0), rtol=1e-4)
    _, memory = FAMO().weigh(memory._replace(losses=jnp.full(3, 2.0)), None, jnp.zeros(3), KEY)  # type: ignore
    np.testing.assert_array_equal(memory.losses, 2)  # its running mean waits for it


def test_famo_without_losses_is_the_mean():
    """Nothing is learned from nothing."""
    memory = FAMO().init(3)
    np.testing.assert_allclose(weigh(memory, jnp.zeros(3)), np.full(3, 1 / 3), rtol=1e-6)
    np.testing.assert_array_equal(adapt(memory, jnp.zeros(3), jnp.zeros(3)).logits, np.zeros(3))


def test_famo_s_memory_keeps_its_shape_and_is_finite():
    """Under a scan, with losses of any size, that come and go."""
    losses = jnp.float32([[1e-30, 1e30, 1], [0, 1, 1e-8], [1, 0, 0], [0, 0, 0], [1e8, 1e-8, 3]])

    def update(memory, seen):
        weights, memory = FAMO().weigh(memory, None, seen, KEY)  # type: ignore
        return FAMO().adapt(memory, seen, jnp.roll(seen, 1)), weights

    memory, weights = quick(lambda: jax.lax.scan(update, FAMO().init(3), losses))()
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((memory, weights)))
    np.testing.assert_allclose(np.sum(weights, axis=1), 1, rtol=1e-5)


def test_an_actor_s_losses_are_averaged_under_famo():
    """As they may be negative, and have no logarithm."""
    assert FAMO().for_actor == Mean()


@pytest.mark.parametrize(
    ("rule", "settings", "message"),
    [
        (GradNorm, {"weight_lr": 0.0}, "weight-lr must be greater than 0, not 0.0"),
        (FAMO, {"weight_lr": float("nan")}, "weight-lr must be greater than 0, not nan"),
        (GradNorm, {"gradnorm_asymmetry": -0.1}, "gradnorm-asymmetry must be at least 0, not -0.1"),
        (FAMO, {"famo_decay": -1.0}, "famo-decay must be at least 0, not -1.0"),
        (FAMO, {"famo_rate": 0.0}, r"famo-rate must be in \(0, 1\], not 0.0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(rule, settings, message):
    """With what was given and what is allowed."""
    with pytest.raises(InputError, match=message):
        rule(**settings)
