"""Kinds of value: their targets against plain loops and by hand, their slopes, and learning with each of them."""

from math import erf, sqrt

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import LEARNING, Probe, only_seed, tasks_of, tiny, train, values

import mtjax
from mtjax.agents import AGENTS, agent
from mtjax.agents.hyperparameters import require_value_range
from mtjax.agents.parts.values import C51, VALUES, HLGauss, Scalar
from mtjax.command.run_config import parse
from mtjax.training import launch
from mtjax.types import InputError

FIVE = C51(num_bins=5, value_low=-2.0, value_high=2.0)  # atoms -2 -1 0 1 2


def random_target(value, *, seed=0, pessimistic=False, size=4.0):
    """A target, and the inputs it was made of: two critics, six samples, some of which end."""
    random = np.random.default_rng(seed)
    outputs = np.float32(random.normal(size=(2, 6, value.outputs)))
    reward, bonus = np.float32(size * random.normal(size=(2, 6)))
    discount = np.float32([0.9, 0.9, 0.0, 0.5, 1.0, 0.9])
    return value.target(outputs, pessimistic, reward, discount, bonus), (outputs, reward, discount, bonus)


def softmax(x):
    x = np.exp(np.float64(x) - x.max(axis=-1, keepdims=True))
    return x / x.sum(axis=-1, keepdims=True)


def projected(p, places, low, high):
    """Bellemare et al. (2017), algorithm 1, for one sample."""
    spacing = (high - low) / (len(p) - 1)
    shares = np.zeros(len(p))
    for probability, place in zip(p, places, strict=True):
        b = (np.clip(place, low, high) - low) / spacing
        lower, upper = int(np.floor(b)), int(np.ceil(b))
        if lower == upper:
            shares[lower] += probability
        else:
            shares[lower] += probability * (upper - b)
            shares[upper] += probability * (b - lower)
    return shares


@pytest.mark.parametrize("size", [0.5, 4.0], ids=["inside", "beyond"])
@pytest.mark.parametrize("pessimistic", [True, False], ids=["least", "mean"])
def test_c51_projects_as_the_papers_loop_does(pessimistic, size):
    """By the distribution with the least mean of each sample, which is not one critic's throughout, or by the mean."""
    target, (outputs, reward, discount, bonus) = random_target(FIVE, pessimistic=pessimistic, size=size)
    p, atoms = softmax(outputs), np.linspace(-2, 2, 5)
    least = (p @ atoms).argmin(axis=0)
    assert set(least) == {0, 1}
    for i in range(6):
        chosen = p[least[i], i] if pessimistic else p[:, i].mean(axis=0)
        places = reward[i] + discount[i] * (atoms + bonus[i])
        np.testing.assert_allclose(target[i], projected(chosen, places, -2, 2), atol=1e-5)


@pytest.mark.parametrize(
    ("reward", "discount", "bonus", "expected"),
    [
        (0.0, 1.0, 0.0, [0.5, 0, 0, 0.5, 0]),  # as it was
        (1.0, 1.0, 0.0, [0, 0.5, 0, 0, 0.5]),
        (0.25, 1.0, 0.25, [0.25, 0.25, 0, 0.25, 0.25]),  # a bonus shifts as a reward does
        (0.0, 0.5, 0.5, [0, 0.375, 0.25, 0.375, 0]),  # -2 -> -0.75 and 1 -> 0.75
        (0.0, 0.0, 7.0, [0, 0, 1, 0, 0]),  # an end: no bonus either
        (1.5, 0.0, 0.0, [0, 0, 0, 0.5, 0.5]),
        (50.0, 1.0, 0.0, [0, 0, 0, 0, 1]),
        (-50.0, 1.0, 0.0, [1, 0, 0, 0, 0]),
    ],
)
def test_c51_by_hand(reward, discount, bonus, expected):
    """Half at -2 and half at 1, moved."""
    logits = jnp.log(jnp.float32([0.5, 0, 0, 0.5, 0]))[None, None]
    target = FIVE.target(logits, True, *jnp.float32([[reward], [discount], [bonus]]))
    np.testing.assert_allclose(target[0], expected, atol=1e-6)


@pytest.mark.parametrize("value", [C51(), C51(7, -1.0, 9.0), HLGauss(), HLGauss(11, -5.0, 1.0)], ids=repr)
def test_targets_are_distributions_that_keep_the_mean_inside_the_range(value):
    """That of a scalar critic of the same value, wherever no atom leaves the range; and outside it, its nearer end."""
    target, (outputs, reward, discount, bonus) = random_target(value, size=0.01)
    middle = (value.value_low + value.value_high) / 2
    reward = reward + middle * (1 - discount)  # the range shrinks towards its middle
    target = value.target(outputs, False, reward, discount * 0.9, bonus)
    expected = reward + 0.9 * discount * (value.mean(outputs).mean(axis=0) + bonus)
    np.testing.assert_allclose(target.sum(axis=-1), 1, rtol=1e-5)
    assert np.all(target >= 0)
    np.testing.assert_allclose(value.expected(target), expected, atol=2e-3 * (value.value_high - value.value_low))
    for reward, end in ((1e6, -1), (-1e6, 0)):
        target = value.target(outputs, False, jnp.full(6, reward), discount, bonus)
        assert np.all(np.isfinite(target)) and np.all(np.argmax(target, axis=-1) == end % value.num_bins)


def test_hl_gauss_by_hand():
    """Four bins of width 1 around y = 0.5, cut off at the range's ends; the tails' share is everyone's."""
    value = HLGauss(num_bins=4, value_low=-2.0, value_high=2.0)
    below = [(1 + erf((edge - 0.5) / 0.75 / sqrt(2))) / 2 for edge in (-2, -1, 0, 1, 2)]
    expected = np.diff(below) / (below[-1] - below[0])
    np.testing.assert_allclose(value.smooth(jnp.float32([0.5]))[0], expected, atol=1e-6)
    np.testing.assert_allclose(value.atoms, [-1.5, -0.5, 0.5, 1.5], rtol=1e-6)
    np.testing.assert_allclose(expected, [0.0229, 0.2352, 0.5068, 0.2352], atol=1e-4)


@pytest.mark.parametrize("pessimistic", [True, False])
def test_hl_gauss_fits_what_a_scalar_critic_would(pessimistic):
    """The least value or the mean of them, sample by sample."""
    value = HLGauss(num_bins=51)
    target, (outputs, *rest) = random_target(value, pessimistic=pessimistic, size=0.5)
    scalar = Scalar().target(value.mean(outputs)[..., None], pessimistic, *rest)
    np.testing.assert_allclose(target, value.smooth(scalar), atol=1e-6)
    np.testing.assert_allclose(value.expected(target), scalar, atol=1e-3)


@pytest.mark.parametrize("value", [C51(9, -2.0, 2.0), HLGauss(9, -2.0, 2.0)], ids=repr)
def test_the_loss_falls_to_the_entropy_of_its_target(value):
    """The slope is softmax(outputs) - target, and so zero exactly where the critic says what the target does."""
    target, (outputs, *_) = random_target(value)
    total = lambda outputs: jnp.sum(value.loss(outputs, target))
    expected = softmax(outputs) - np.asarray(target)
    np.testing.assert_allclose(jax.grad(total)(jnp.asarray(outputs)), expected, atol=1e-5)
    fitted = jnp.log(target + 1e-12)[None]
    entropy = -np.sum(target * np.log(np.asarray(target) + 1e-12), axis=-1)
    np.testing.assert_allclose(value.loss(fitted, target)[0], entropy, atol=1e-5)
    assert value.loss(jnp.asarray(outputs), target).shape == (2, 6)


def test_the_actor_has_a_slope_through_every_kind_of_value():
    """The mean of the outputs depends on each."""
    for cls in VALUES.values():
        slope = jax.grad(cls().mean)(jnp.linspace(-1.0, 1.0, cls().outputs))
        assert np.count_nonzero(slope) >= cls().outputs - 1  # an atom at the mean may have none


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"value": "c51", "num_bins": 1}, "num-bins must be at least 2, not 1"),
        ({"value": "c51", "value_low": 3.0, "value_high": 3.0}, "value-low must be below value-high, not 3.0 and 3.0"),
        ({"value": "hl-gauss", "value_high": float("nan")}, "value-low must be below"),
        ({"value": "hl-gauss", "bin_sigma": 0.0}, "bin-sigma must be greater than 0"),
        ({"value": "c15"}, "unknown value 'c15'; did you mean 'c51'"),
        ({"num_bins": 7}, "unknown setting of sac 'num_bins'"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    """With what was given."""
    with pytest.raises(InputError, match=message):
        agent("sac", **settings)


def test_returns_must_be_scaled_to_a_range_that_nobody_chose():
    """Before anything compiles, by the program too; at every point of a sweep."""
    for name, settings in (("sac", {"value": "c51"}), ("sac", {"value": "hl-gauss", "scaling": "reward"})):
        with pytest.raises(InputError, match=f"value={settings['value']} reaches returns from -10 to 10.*=return w"):
            mtjax.train(Probe("delayed"), agent(name, **settings), steps=10)
    sweep = {"value_high": [20.0, 10.0]}
    with pytest.raises(InputError, match="value=c51 reaches returns from -10 to 10"):
        mtjax.train(Probe("delayed"), agent("brc", scaling="none"), steps=10, sweep=sweep)
    with pytest.raises(InputError, match="scaling=none does not keep them there"):
        launch.check(parse(["--env=pendulum-swingup", "--engine=mjx", "--agent=brc", "--agent.scaling=none"]))


@pytest.mark.parametrize(
    "name, settings, said",
    [
        ("xqc", {"scaling": "none"}, "from -5 to 5, and scaling=none does.*use scaling=return with return-range=5, or"),
        ("simba-v2", {"scaling": "reward"}, "from -5 to 5, and scaling=reward does"),
        ("simba-v2", {"scaling": "none", "value": "hl-gauss"}, "from -10 to 10, and scaling=none does"),
        ("xqc", {"scaling": "return"}, "and scaling=return with return-range=10 does.*use return-range=5"),
        ("brc", {"return_range": 100.0}, "from -10 to 10, and scaling=return with return-range=100"),
    ],
)
def test_returns_that_would_saturate_a_distribution_are_refused(name, settings, said):
    """In agents whose own range is another than that of the values' class, and where returns are scaled too far."""
    with pytest.raises(InputError, match=said):
        require_value_range(agent(name, **settings))


def test_a_range_that_is_given_or_scaled_to_is_taken():
    """Given on a command line too, where a part has its settings after its name."""
    for settings in ({"value": "c51", "value_high": 200.0}, {"value": "hl-gauss", "scaling": "return"}, {}):
        require_value_range(agent("sac", **settings))
    of_gains = {"scaling": "return", "value_low": 0.0, "value_high": 10.0}  # of which none is negative
    for settings in (of_gains, {"scaling": "return", "return_range": 5.0}, {"scaling": "none", "value_high": 200.0}):
        require_value_range(agent("xqc", **settings))
    for name in AGENTS:
        require_value_range(agent(name))
    words = ["--env=pendulum-swingup", "--agent=sac", "--agent.value=c51", "--agent.value-high=200"]
    require_value_range(parse(words).learner)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "critic_reduction"), [("c51", "min"), ("hl-gauss", "mean")])
def test_distributional_critics_learn_known_values(kind, critic_reduction):
    """Two steps, of which the second earns 1 or -0.5: Q(1) = scale, Q(0) = 0.9 scale."""
    learner = tiny(
        "sac-conditioned",
        value=kind,
        critic_reduction=critic_reduction,
        **{"num_bins": 41, "value_low": -2.0, "value_high": 2.0},
        **{"gamma": 0.9, "initial_temperature": 1e-6, "temperature_lr": 1e-9},
        **{"tau": 0.3, "actor_lr": 1e-2, "critic_lr": 1e-2},
    )
    tasks = tasks_of("delayed")
    state, _ = train(Probe("delayed"), learner, LEARNING, tasks=tasks, chunks=1)
    found = values(learner, only_seed(state.agent), tasks, [0.0, 1.0], [0.1, -0.6])
    for estimates, scale in zip(found, (1.0, -0.5), strict=True):
        np.testing.assert_allclose(estimates, np.tile([0.9 * scale, scale], (2, 1)), atol=0.1)
