"""How much each task counts: weights by hand, from the first step on; and what an update does with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, learner, random_batch, tasks_of, tiny, with_nets

from mtjax.agents import agent
from mtjax.agents.base import Memory
from mtjax.agents.networks import Params
from mtjax.agents.parts.samplers import SAMPLERS, ByTemperature, Hardest, Progress, Uniform
from mtjax.types import InputError, Spec, Transition

ALIKE = jnp.full(3, 0.1)
SPEC, BATCH = Spec.vector(3, 2, 1), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(0)


def episodes(returns, ended):
    """One step of every environment (T, E), of which some end with these returns, as a sampler remembers them."""
    returns, ended = jnp.float32(returns), jnp.asarray(ended)
    zeros = jnp.zeros_like(returns)
    return Transition(None, None, zeros, zeros + 1, None, ended, ended, ended, memory=returns)


def all_end(returns):
    return episodes(np.reshape(returns, (-1, 1)), np.ones((len(returns), 1), bool))


def watch(sampler, rounds, num_tasks=3):
    memory = sampler.init(num_tasks)
    for outcome in rounds:
        memory = jax.jit(sampler.observe, compiler_options=QUICK)(memory, outcome)
    return memory


def test_progress_is_the_gap_between_two_moving_means():
    """From 10, 10 and -10 to 20, 10 and -20, at rates of 1/2 and 1/10: |15 - 11| / 15, nothing, and the same."""
    sampler = Progress(least_weight=0.25, progress_fast=0.5, progress_slow=0.1)
    memory = watch(sampler, [all_end([10, 10, -10]), all_end([20, 10, -20])])
    np.testing.assert_allclose(memory.fast, [15, 10, -15], rtol=1e-6)
    np.testing.assert_allclose(memory.slow, [11, 10, -11], rtol=1e-6)
    np.testing.assert_allclose(sampler.weights(memory, ALIKE), 0.25 + 0.75 * 3 * np.array([0.5, 0, 0.5]), rtol=1e-5)
    uneven = watch(sampler, [all_end([10, 10, -10]), all_end([20, 40, 0])])  # to 15, 25, -5 and 11, 13, -9
    shares = np.array([4 / 15, 12 / 25, 4 / 9])
    expected = 0.25 + 0.75 * 3 * shares / shares.sum()
    np.testing.assert_allclose(sampler.weights(uneven, ALIKE), expected, rtol=1e-5)


def test_progress_of_a_task_that_has_ended_no_episode_is_the_others_mean():
    """Of 4 / 15 and nothing: a third of the shares."""
    sampler = Progress(least_weight=0.0, progress_fast=0.5, progress_slow=0.1)
    some = lambda returns: episodes([[returns[0]], [returns[1]], [99]], [[True], [True], [False]])
    memory = watch(sampler, [some([10, 10]), some([20, 10])])
    np.testing.assert_allclose(sampler.weights(memory, ALIKE), [2, 0, 1], atol=1e-6)
    np.testing.assert_array_equal(memory.known, [True, True, False])


def test_episodes_count_one_by_one_and_those_that_go_on_do_not():
    """Two of three environments end with a mean of 4: two steps of 1/10 towards it; elsewhere nothing moves."""
    sampler = Hardest(return_rate=0.1)
    first = episodes([[1, 1, 1], [5, 5, 5]], np.ones((2, 3), bool))
    second = episodes([[3, 5, 77], [6, 7, 8]], [[True, True, False], [False, False, False]])
    memory = watch(sampler, [first, second], 2)
    np.testing.assert_allclose(memory.slow, [1 + (1 - 0.9**2) * 3, 5], rtol=1e-6)


def test_hardest_is_a_softmax_of_standardised_returns():
    """1, 3 and 8: minus their mean of 4, over sqrt(26 / 3); the scale of rewards does not matter."""
    z = np.array([-3, -1, 4]) / np.sqrt(26 / 3)
    expected = 0.2 + 0.8 * 3 * np.exp(-2 * z) / np.exp(-2 * z).sum()
    sampler = Hardest(least_weight=0.2, hardness=2.0)
    for scale, shift in ((1, 0), (1000, -5000)):
        memory = watch(sampler, [all_end(scale * np.array([1, 3, 8]) + shift)])
        np.testing.assert_allclose(sampler.weights(memory, ALIKE), expected, rtol=1e-4)
    flat = Hardest(hardness=0.0)
    np.testing.assert_allclose(flat.weights(memory, ALIKE), 1, rtol=1e-6)


def test_hardest_takes_an_unknown_task_for_an_average_one():
    """Returns of 1 and 3, and none: z of -1, 1 and 0."""
    sampler = Hardest(least_weight=0.0)
    memory = watch(sampler, [episodes([[1], [3], [50]], [[True], [True], [False]])])
    shares = np.exp([1, -1, 0])
    np.testing.assert_allclose(sampler.weights(memory, ALIKE), 3 * shares / shares.sum(), rtol=1e-5)


def test_temperatures_weigh_by_their_inverse_or_as_the_paper_writes():
    """1 / a over the sum of those, in the code; softmax(-a) in the paper."""
    temperature = jnp.float32([0.1, 0.4, 0.02])
    by = lambda **settings: ByTemperature(least_weight=0.0, **settings).weights(None, temperature)
    np.testing.assert_allclose(by(), 3 * np.array([10, 2.5, 50]) / 62.5, rtol=1e-5)
    paper = np.exp(-np.asarray(temperature))
    np.testing.assert_allclose(by(certainty="temperature"), 3 * paper / paper.sum(), rtol=1e-5)
    floored = ByTemperature(least_weight=0.5).weights(None, temperature)
    np.testing.assert_allclose(floored, 0.5 + 0.5 * by(), rtol=1e-5)


EXTREME = [[0, 0, 0], [1e-30, 0, 0], [1e6, -1e6, 0], [7, 7, 7], [-3e4, 1e-3, 5]]


@pytest.mark.parametrize("name", [name for name in SAMPLERS if name != "uniform"])
def test_weights_have_mean_one_and_a_floor(name):
    """Whatever the returns and temperatures, and before any episode has ended; alike where tasks are."""
    sampler = SAMPLERS[name]()
    temperatures = (ALIKE, jnp.float32([1e-6, 1.0, 50.0]))
    for rounds in ([], *([all_end(EXTREME[3]), all_end(returns)] for returns in EXTREME)):
        memory = watch(sampler, rounds)
        for temperature in temperatures:
            weights = sampler.weights(memory, temperature)
            np.testing.assert_allclose(np.mean(weights), 1, rtol=1e-5)
            assert np.all(weights >= 0.1 - 1e-6)
    for rounds in ([], [all_end([7, 7, 7])], [all_end([7, 7, 7]), all_end([9, 9, 9])]):
        np.testing.assert_allclose(sampler.weights(watch(sampler, rounds), ALIKE), 1, rtol=1e-5)


def test_uniform_weighs_nothing():
    """And remembers nothing."""
    assert Uniform().weights(Uniform().init(3), ALIKE) is None and Uniform().begin() is None


@pytest.mark.slow
def test_an_update_weighs_losses_by_the_temperatures_of_the_time():
    """Heads of their own move by their task's weight: first moments of Adam are the plain ones times it."""
    plain, weighed = tiny("multi-head"), tiny("multi-head", sampler="temperature", least_weight=0.0)
    (init, update), (_, weigh) = (learner(x, TASKS, BATCH, SPEC) for x in (plain, weighed))
    temperature = Params({}, {"log": jnp.log(jnp.float32([0.1, 0.4, 0.02]))})
    state, batch = with_nets(init(TASKS, KEY), temperature=temperature), random_batch(0, 3, BATCH, SPEC)
    (first, _), (second, _) = update(state, batch, TASKS, KEY), weigh(state, batch, TASKS, KEY)
    heads = [x.fits["critic"].optimizer[1][0].mu["critic"].own["head"]["kernel"] for x in (first, second)]
    weights = 3 * np.array([10, 2.5, 50]) / 62.5
    np.testing.assert_allclose(heads[1], heads[0] * weights[:, None, None, None], rtol=1e-4, atol=1e-8)


@pytest.mark.slow
def test_an_agent_hands_its_sampler_what_it_observes():
    """Its memory changes, and nothing else does."""
    watching = tiny("sac", sampler="hardest")
    state = learner(watching, TASKS, BATCH, SPEC)[0](TASKS, KEY)
    reward, obs = jnp.float32([1, 2, 3]).reshape(3, 1, 1), jnp.zeros((3, 1, 1, 3))
    memory = Memory(None, sampler=reward * 2)  # of the episodes before their last step
    steps = Transition(
        obs, None, -reward, jnp.ones_like(reward), None, reward > 0, reward > 0, reward > 0, memory=memory
    )
    after = watching.observe(state, steps, TASKS)
    np.testing.assert_array_equal(after.nets["sampler"].own.slow, [1, 2, 3])
    assert all(after.nets[name] is net for name, net in state.nets.items() if name not in ("sampler", "scaling"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sampler": "progress", "least_weight": 1.5}, r"least-weight must be in \[0, 1\], not 1.5"),
        ({"sampler": "progress", "progress_fast": 0.01, "progress_slow": 0.1}, "progress-slow must be below"),
        ({"sampler": "hardest", "hardness": -1.0}, "hardness must be at least 0"),
        ({"sampler": "hardest", "return_rate": 0.0}, r"return-rate in \(0, 1\]"),
        ({"sampler": "temperature", "certainty": "log"}, "unknown certainty 'log'; .*log-temperature"),
        ({"sampler": "progres"}, "unknown sampler 'progres'; did you mean 'progress'"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    """With what was given."""
    with pytest.raises(InputError, match=message):
        agent("sac", **settings)


# Sketches.


def short_and_long(rounds, **settings):
    """A curriculum over sketches of one, two and two symbols, after rounds of returns in which every episode ended."""
    sampler = SAMPLERS["by-length"](**{"least_weight": 0.0, "return_rate": 0.5, **settings})
    memory = sampler.init(3)._replace(length=jnp.int32([1, 2, 2]))
    for returns in rounds:
        memory = jax.jit(sampler.observe, compiler_options=QUICK)(memory, all_end(returns))
    return sampler, memory


def test_longer_sketches_follow_when_all_shorter_ones_are_mastered():
    """The first alone until its moving mean, .5 and .75 and .875, is above .8; then by what is missing, and .01."""
    for rounds, expected in (
        ([], [3, 0, 0]),
        ([[0, 0, 0], [1, 1, 0], [1, 1, 0]], [3, 0, 0]),
        ([[0, 0, 0], [1, 1, 0], [1, 1, 0], [1, 1, 0]], np.array([0.135, 0.135, 1.01]) * 3 / 1.28),
    ):
        sampler, memory = short_and_long(rounds)
        np.testing.assert_allclose(sampler.weights(memory, ALIKE), expected, rtol=1e-5)
    sampler, memory = short_and_long([[1, 1, 0]], mastered=1.0)
    np.testing.assert_allclose(sampler.weights(memory, ALIKE), [3, 0, 0])


def test_a_curriculum_begins_with_the_shortest_sketches_there_are():
    sampler, memory = short_and_long([])
    longer = memory._replace(length=jnp.int32([3, 4, 3]))
    np.testing.assert_allclose(sampler.weights(longer, ALIKE), [1.5, 0, 1.5])
    after = sampler.observe(longer, all_end([1, 0, 1]))
    np.testing.assert_array_equal(after.longest, [4, 4, 4])


def test_a_task_that_was_not_played_joins_at_the_length_that_others_reached():
    """A curriculum of the loop played one and two symbols up to two; the third task remembers none."""
    sampler, memory = short_and_long([])
    joined = memory._replace(longest=jnp.int32([2, 2, 0]))
    np.testing.assert_allclose(sampler.weights(joined, ALIKE), [1, 1, 1])
    np.testing.assert_array_equal(sampler.observe(joined, all_end([1, 0, 0])).longest, [2, 2, 2])
