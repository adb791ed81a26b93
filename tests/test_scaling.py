"""Scales of reward: their statistics by hand, what they preserve, when they change; and networks that begin anew."""

import dataclasses
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from probes import (
    LEARNING,
    QUICK,
    Probe,
    Stub,
    Walk,
    learner,
    one_in,
    only_seed,
    random_batch,
    tasks_of,
    tiny,
    train,
    values,
    with_nets,
)

from mtjax.agents import agent, normalize
from mtjax.agents.fit import reset_networks
from mtjax.agents.networks import Params
from mtjax.agents.parts.scaling import (
    SCALINGS,
    AdaptiveScaling,
    NoScaling,
    PopArt,
    ReturnNormalization,
    ReturnScaling,
    RewardScaling,
)
from mtjax.agents.parts.scaling.returns import Sums
from mtjax.experience import Replay
from mtjax.learning import loop
from mtjax.types import InputError, Spec, Transition

SPEC, BATCH = Spec.vector(3, 2, 1), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(0)
NO_BONUS = jnp.zeros(1)


def stream(rewards, *, ends=(), cuts=(), gamma=0.5):
    """Steps with rewards (H, T, E) whose episodes all terminate after some and are cut off after others.

    Their memories are after each step.
    """
    rewards = np.float32(rewards)
    discounted = total = age = np.zeros(rewards.shape[1:], np.float32)
    for step, reward in enumerate(rewards):
        discounted, total, age = gamma * discounted + reward, total + reward, age + 1
        over = step in (*ends, *cuts)
        everywhere = lambda flag: jnp.full(rewards.shape[1:], flag)
        sums = jax.tree.map(jnp.asarray, Sums(discounted, total, age))
        yield steps(reward, everywhere(over), everywhere(step not in ends), sums)
        if over:
            discounted = total = age = np.zeros(rewards.shape[1:], np.float32)


def steps(reward, ended, discount, memory=None):
    return Transition(
        None, None, *map(jnp.asarray, (reward, jnp.float32(discount))), None, ended, ended, ended, memory=memory
    )


def memory_for(scaling, sums):
    """What a scaling remembers of an episode."""
    return {ReturnScaling: sums, ReturnNormalization: sums.discounted}.get(type(scaling))


def watch(scaling, found, num_tasks=2):
    memory = scaling.init(num_tasks)
    for each in found:
        memory = scaling.observe(memory, each._replace(memory=memory_for(scaling, each.memory)))
    return memory


def observe(agent, state, rewards, ended=False):
    """Show an agent the first steps (T, E) of episodes, which may be their last ones too."""
    reward = jnp.float32(rewards)
    found = steps(reward, jnp.full(reward.shape, ended), jnp.ones(reward.shape))
    return probes.observe(agent, state, found._replace(obs=jnp.zeros((*reward.shape, 3))), TASKS)


def units(scaling, memory, gamma=0.5, bonus=NO_BONUS):
    return np.stack(scaling.units(memory, gamma, bonus))


def random_rewards(steps, num_envs):
    """Rewards (H, T, E) of two tasks that pay in different coin."""
    return np.random.default_rng(0).normal(size=(steps, 2, num_envs)) * [[1.0], [30.0]] + [[0.5], [-4.0]]


def test_rewards_are_divided_by_their_moving_standard_deviation():
    """One environment: MTEnv's estimate, written as it is there."""
    rewards = random_rewards(200, 1)
    memory = watch(RewardScaling(variance_rate=0.01), stream(rewards))
    mean, variance = np.zeros(2), np.ones(2)
    for reward in rewards[..., 0]:
        mean = 0.99 * mean + 0.01 * reward
        variance = 0.99 * variance + 0.01 * (reward - mean) ** 2
    assert variance[1] > 100 * variance[0]
    factor, offset = units(RewardScaling(), memory)
    np.testing.assert_allclose(factor, 1 / np.sqrt(variance), rtol=1e-4)
    np.testing.assert_array_equal(offset, 0)


def test_the_rewards_of_a_step_count_as_often_as_there_are():
    """Four equal ones in one step and in four: the mean is the same, and so is the variance without a shift."""
    four, one = np.ones((1, 2, 4)), np.ones((4, 2, 1))
    together, apart = (watch(RewardScaling(variance_rate=0.1), stream(x)) for x in (four, one))
    np.testing.assert_allclose(together.mean, apart.mean, rtol=1e-6)
    np.testing.assert_allclose(together.mean, 1 - 0.9**4, rtol=1e-6)
    np.testing.assert_allclose(together.variance, 0.9**4 + (1 - 0.9**4) * 0.9**8, rtol=1e-6)


def test_returns_are_scaled_to_their_range():
    """The largest discounted sum, of either sign: 3 + 1 / 2 and 8 / 4 - 6; never smaller once it was larger."""
    rewards = np.array([[[1.0], [8.0]], [[3.0], [0.0]], [[-1.0], [-6.0]], [[0.1], [0.1]]])
    rewards = np.concatenate([rewards, np.zeros_like(rewards)], axis=-1)
    memory = watch(ReturnScaling(), stream(rewards, ends=(2,)))
    np.testing.assert_allclose(units(ReturnScaling(), memory), [[10 / 3.5, 10 / 8], [0, 0]], rtol=1e-6)
    flipped = watch(ReturnScaling(), stream(-rewards, ends=(2,)))
    np.testing.assert_allclose(units(ReturnScaling(), flipped), units(ReturnScaling(), memory))


def test_returns_from_a_step_fit_the_range_or_exceed_it_by_less_than_gamma_times():
    """They fit where rewards stay or rise within an episode, and not where these fall or change their sign."""
    gamma, ages = 0.95, np.arange(80)
    fits = [np.ones(80), ages / 80, np.float32(ages > 70), np.float32(ages == 9)]
    others = [gamma**ages, np.float32(ages < 9), 1 - 2.0 * (ages // 9 % 2), np.random.default_rng(0).normal(size=80)]
    exceeding = []
    for rewards in fits + others:
        memory = watch(ReturnScaling(), stream(rewards[:, None, None], ends=(79,), gamma=gamma), num_tasks=1)
        from_steps = [np.sum(gamma ** ages[: 80 - t] * rewards[t:]) for t in range(80)]
        exceeding.append(np.max(np.abs(from_steps)) * units(ReturnScaling(), memory, gamma=gamma)[0, 0] / 10)
    assert max(exceeding[: len(fits)]) < 1 + 1e-5 and max(exceeding) < 1 + gamma
    assert exceeding[len(fits)] > 1.2  # a reward that falls as gamma^t


def test_what_lies_beyond_a_time_limit_counts_and_beyond_an_end_does_not():
    """Two steps of reward 1 go on for ever if they were cut off: 1 / (1 - gamma) with gamma 0.9, against 1.9."""
    rewards, scaling = np.ones((2, 2, 1)), ReturnScaling(return_range=2.0)
    for over, largest in (({"cuts": (1,)}, 10.0), ({"ends": (1,)}, 1.9)):
        memory = watch(scaling, stream(rewards, gamma=0.9, **over))
        np.testing.assert_allclose(units(scaling, memory, gamma=0.9)[0], 2 / largest, rtol=1e-5)


def test_returns_are_divided_by_their_standard_deviation():
    """Sums of 1, 2.5 and -2, 2 in one task; 8, 4 in the other, whose largest is beyond 1.5 standard deviations."""
    rewards = np.array([[[1.0, -2.0], [8.0, 8.0]], [[2.0, 3.0], [0.0, 0.0]]])
    scaling = ReturnNormalization(return_range=1.5)
    memory = watch(scaling, stream(rewards))
    np.testing.assert_allclose(memory.moments.mean, [0.875, 6.0])
    factor, offset = units(scaling, memory)
    np.testing.assert_allclose(factor, [1 / np.std([1, 2.5, -2, 2]), 1.5 / 8], rtol=1e-5)
    np.testing.assert_array_equal(offset, 0)
    again = watch(scaling, stream(rewards, ends=(0,)))
    np.testing.assert_allclose(again.moments.mean, [(1 + 2 - 2 + 3) / 4, 4.0])


def test_the_bonus_of_entropy_has_room_in_the_range():
    """2 for the rewards, and 0.3 a step for 1 / (1 - gamma) = 2 steps."""
    memory = watch(ReturnScaling(), stream(np.full((1, 2, 1), 2.0)))
    np.testing.assert_allclose(units(ReturnScaling(), memory, bonus=jnp.float32([0.3, 0.0]))[0], [10 / 2.6, 5])


def test_an_update_tells_the_scaling_what_entropy_is_worth():
    """Temperature 0.2, a target of -0.5 for each of two dimensions: half of 0.2 in a step, for two steps."""
    learner_ = agent("sac", scaling="return", gamma=0.5, initial_temperature=0.2, hidden=(4,))
    state = jax.jit(lambda: learner_.init(SPEC, TASKS, KEY), compiler_options=QUICK)()
    state = observe(learner_, state, np.full((3, 2), 4.0))
    batch = random_batch(0, 3, BATCH, SPEC)
    seen = probes.prepare(learner_, state, batch, TASKS)
    np.testing.assert_allclose(seen.reward, batch.reward * 10 / (4 + 2 * 0.1), rtol=1e-5)


def test_nothing_observed_scales_nothing():
    """Factor 1 and offset 0, for every scaling."""
    batch = random_batch(0, 2, BATCH, SPEC)
    for scaling in (cls() for cls in SCALINGS.values()):
        rewards = scaling.rewards(scaling.init(2), batch, jnp.full(2, 0.9), jnp.full(1, 0.5))
        np.testing.assert_allclose(rewards, batch.reward, rtol=1e-6)


# ARS.


def test_ars_brings_all_tasks_to_the_best_mean_reward():
    """Means of 4, 1 and -2 give 1, 4 and 4 / 0.01."""
    rewards = np.array([[[3.0, 5.0], [2.0, 0.0], [0.0, 0.0]], [[4.0, 4.0], [0.0, 2.0], [-4.0, -4.0]]])
    memory = watch(AdaptiveScaling(), stream(rewards), 3)
    np.testing.assert_allclose(memory.mean, [4, 1, -2])
    np.testing.assert_allclose(units(AdaptiveScaling(), memory)[0], [1, 4, 400], rtol=1e-5)
    np.testing.assert_allclose(units(AdaptiveScaling(), watch(AdaptiveScaling(), stream(-abs(rewards)), 3))[0], 1)


def test_ars_keeps_its_factors_from_the_first_update_to_the_next_reset():
    """Whatever is seen between."""
    scaling, rewards = AdaptiveScaling(), np.array([[[4.0], [1.0]], [[4.0], [7.0]]])
    first, second = stream(rewards)
    memory = scaling.observe(scaling.init(2), first)
    np.testing.assert_allclose(units(scaling, memory)[0], [1, 4])
    memory, critics = scaling.renew(memory, jnp.zeros((2, 3)), (Params({}, {}),))
    assert critics == (Params({}, {}),)
    memory = scaling.observe(memory, second)
    memory, _ = scaling.renew(memory, jnp.ones((2, 3)), ())
    np.testing.assert_allclose(memory.mean, 4)
    np.testing.assert_allclose(units(scaling, memory)[0], [1, 4])
    np.testing.assert_allclose(units(scaling, scaling.reset(memory))[0], 1)


# Pop-Art.


def critic(seed):
    """A critic of two tasks and three heads each, on four features."""
    random = np.random.default_rng(seed)
    head = {"kernel": jnp.float32(random.normal(size=(2, 3, 4, 1))), "bias": jnp.float32(random.normal(size=(2, 3, 1)))}
    return Params({"body": jnp.ones(3)}, {"head": head, "embedding": jnp.ones((2, 5))})


def says(params, scaling, memory):
    """Values (T, N, Z) in reward, of random features."""
    features = np.random.default_rng(9).normal(size=(7, 4))
    head, (factor, offset) = params.own["head"], units(scaling, memory)[..., None, None]
    scaled = np.einsum("zd,tndo->tnz", features, head["kernel"]) + head["bias"]
    return scaled / factor + offset


def test_popart_preserves_what_critics_say_while_its_statistics_move():
    """The critic's values and the slow critic's, of tasks on scales of 0.01 and of 1000; all else is left alone."""
    scaling, critics = PopArt(target_rate=0.1), (critic(0), critic(1))
    memory = scaling.init(2)
    before = [says(params, scaling, memory) for params in critics]
    renew = jax.jit(scaling.renew, compiler_options=QUICK)
    random = np.random.default_rng(2)
    mean, square = np.zeros(2), np.ones(2)  # as in the papers, of first and second moment
    for _ in range(50):
        raw = random.normal(size=(2, 16)) * [[0.01], [1000.0]] + [[0.02], [5000.0]]
        factor, offset = units(scaling, memory)
        memory, critics = renew(memory, jnp.float32((raw - offset[:, None]) * factor[:, None]), critics)
        mean = 0.9 * mean + 0.1 * raw.mean(axis=1)
        square = 0.9 * square + 0.1 * (raw**2).mean(axis=1)
    factor, offset = units(scaling, memory)
    for params, values_before, seed in zip(critics, before, (0, 1), strict=True):
        for found, wanted, shift in zip(says(params, scaling, memory), values_before, offset, strict=True):
            largest = max(np.abs(wanted).max(), abs(shift))  # of what is summed, rounded once a step
            np.testing.assert_allclose(found, wanted, rtol=0, atol=50 * np.finfo(np.float32).eps * largest)
        assert not np.allclose(params.own["head"]["kernel"], critic(seed).own["head"]["kernel"], rtol=0.1)
        np.testing.assert_array_equal(params.own["embedding"], 1)
        np.testing.assert_array_equal(params.shared["body"], 1)
    np.testing.assert_allclose(offset, mean, rtol=1e-4)
    np.testing.assert_allclose(1 / factor, np.sqrt(square - mean**2), rtol=1e-3)


def test_targets_in_a_tasks_units_are_its_targets_in_reward():
    """(r + d v' - m) / s, for v' = m + s next and any bonus, which is worth s in reward; ends included."""
    scaling, batch = PopArt(), random_batch(0, 2, 6, SPEC)
    memory = scaling.init(2)._replace(mean=jnp.float32([3.0, -100.0]), variance=jnp.float32([4.0, 900.0]))
    mean, std = np.array([[3.0], [-100.0]]), np.array([[2.0], [30.0]])
    next_value, discount = np.float32(np.random.default_rng(1).normal(size=(2, 6))), 0.9 * np.asarray(batch.discount)
    found = scaling.rewards(memory, batch, jnp.full(2, 0.9), NO_BONUS) + discount * next_value
    expected = (batch.reward + discount * (mean + std * next_value) - mean) / std
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    assert 0 in discount


def test_popart_stays_finite_where_targets_do_not_vary():
    """Its standard deviation has a floor."""
    scaling, critics = PopArt(target_rate=0.5), (critic(0),)
    memory = scaling.init(2)
    for _ in range(100):
        factor, offset = units(scaling, memory)
        memory, critics = scaling.renew(memory, jnp.float32((7.0 - offset) * factor)[:, None].repeat(3, 1), critics)
    np.testing.assert_allclose(units(scaling, memory), [[1e4, 1e4], [7, 7]], rtol=1e-3)
    assert np.all(np.isfinite(critics[0].own["head"]["kernel"]))


@pytest.mark.parametrize("by", [1.0, 100.0])
def test_popart_begins_with_the_scale_of_the_rewards_before_learning(by):
    """The root of their mean square, whatever the pieces they come in; 1 where all are 0, and targets alone later."""
    scaling, random = PopArt(target_rate=0.1), np.random.default_rng(3)
    rewards = np.float32(by * random.normal(size=(2, 30))) * [[1], [0]]
    memory = scaling.init(2)
    for part in np.split(rewards, [3, 20], axis=1):
        memory = scaling.observe(memory, SimpleNamespace(reward=jnp.float32(part)))
    first = units(scaling, memory)
    np.testing.assert_allclose(first, [[1 / np.sqrt(np.mean(rewards[0] ** 2)), 1], [0, 0]], rtol=1e-5)
    memory, _ = scaling.renew(memory, jnp.float32(random.normal(size=(2, 8))), (critic(0),))
    later = scaling.observe(memory, SimpleNamespace(reward=jnp.full((2, 5), 1e3)))
    np.testing.assert_array_equal(units(scaling, later), units(scaling, memory))
    assert not np.allclose(units(scaling, memory), first, rtol=1e-4)


# In an agent.


@pytest.mark.slow
def test_an_update_rescales_critic_and_target_beside_its_own_step():
    """The update of an agent without Pop-Art, with heads brought to the new units after it."""
    plain, scaled = (tiny("multi-head", scaling=name) for name in ("none", "popart"))
    (init, update), (_, plain_update) = learner(scaled, TASKS, BATCH, SPEC), learner(plain, TASKS, BATCH, SPEC)
    state, batch = init(TASKS, KEY), random_batch(0, 3, BATCH, SPEC)
    after, metrics = update(state, batch, TASKS, KEY)
    expected, _ = plain_update(with_nets(state, scaling=Params({}, None)), batch, TASKS, KEY)
    scales = after.nets["scaling"].own
    assert not np.allclose(scales.mean, state.nets["scaling"].own.mean, atol=1e-6)
    assert "target" not in metrics
    factor, offset = units(scaled.scaling, scales)
    for kind in ("nets", "slow"):
        found, wanted = (getattr(x, kind)["critic"].own["head"] for x in (after, expected))
        np.testing.assert_allclose(found["kernel"], wanted["kernel"] * factor[:, None, None, None], rtol=1e-5)
        biases = (wanted["bias"] - offset[:, None, None]) * factor[:, None, None]
        np.testing.assert_allclose(found["bias"], biases, rtol=1e-4, atol=1e-6)
    found, wanted = (x.nets["actor"].own["head"]["kernel"] for x in (after, expected))
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("name", one_in(3, ["reward", "return", "return-std"]))
def test_statistics_change_by_what_is_observed_alone(name):
    """Not by learning and not by acting; and they decide what an update sees."""
    scaled = tiny("sac", scaling=name)
    init, update = learner(scaled, TASKS, BATCH, SPEC)
    state, batch = init(TASKS, KEY), random_batch(0, 3, BATCH, SPEC)
    seen = observe(scaled, state, np.full((3, 2), [[5.0], [1.0], [90.0]]))
    same = lambda a, b: all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    scales = lambda state: state.nets["scaling"]
    assert not same(scales(seen), scales(state))
    assert same(with_nets(seen, scaling=None), with_nets(state, scaling=None))
    (before, first), (after, second) = update(state, batch, TASKS, KEY), update(seen, batch, TASKS, KEY)
    assert same(scales(before), scales(state)) and same(scales(after), scales(seen))
    assert not np.allclose(first["critic_loss"], second["critic_loss"])


def test_agents_without_statistics_remember_nothing():
    """The loop saves itself the trouble."""
    for made in (tiny("sac"), tiny("multi-head", scaling="popart")):
        assert made.scaling.begin() is None and made.sampler.begin() is None
    assert NoScaling().init(3) is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scaling": "popart"}, "use value=scalar and heads=per-task or disjoint, not scalar and shared"),
        ({"scaling": "popart", "heads": "per-task", "value": "c51"}, "not c51 and per-task"),
        ({"scaling": "return", "gamma": 1.0}, "use gamma below 1"),
        ({"scaling": "return", "return_range": 0.0}, "return-range must be greater than 0"),
        ({"scaling": "return-std", "return_range": -1.0}, "return-range must be greater than 0"),
        ({"scaling": "reward", "variance_rate": 0.0}, r"variance-rate must be in \(0, 1\], not 0.0"),
        ({"scaling": "popart", "heads": "per-task", "target_rate": 1.5}, "target-rate must be"),
        ({"scaling": "ars", "least_mean_reward": 0.0}, "least-mean-reward must be greater than 0"),
        ({"scaling": "ars"}, "scaling=ars renews its factors where networks are reset, and here none are"),
        ({"scaling": "pop-art"}, "unknown scaling 'pop-art'; did you mean 'popart'"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    """With what was given."""
    with pytest.raises(InputError, match=message):
        agent("sac", **settings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    one_in(
        4,
        [
            ("multi-head", {"scaling": "popart", "target_rate": 0.02}),
            ("sac-conditioned", {"scaling": "return", "value": "c51", "num_bins": 41, "return_range": 8.0}),
            ("sac-conditioned", {"scaling": "reward"}),
            ("sac-conditioned", {"scaling": "return-std", "value": "c51", "num_bins": 41, "value_high": 6.0}),
        ],
    ),
    ids=["popart", "return", "reward", "return-std"],
)
def test_values_are_known_in_reward_whatever_their_scale(name, settings):
    """Two steps, of which the second earns 200 or -0.5; errors are relative to the task's own scale."""
    rates = {"gamma": 0.9, "initial_temperature": 1e-6, "temperature_lr": 1e-9, "tau": 0.3}
    scaled = tiny(name, **rates, **settings, actor_lr=1e-2, critic_lr=1e-2, conditioning="one-hot")
    scales = (200.0, -0.5)
    tasks = tasks_of("delayed", scales)
    state, history = train(Probe("delayed"), scaled, LEARNING, tasks=tasks)
    state = only_seed(state.agent)
    factor, offset = units(scaled.scaling, state.nets["scaling"].own, gamma=0.9)
    found = values(scaled, state, tasks, [0.0, 1.0], [0.1, -0.6]) / factor[:, None, None] + offset[:, None, None]
    for estimates, scale in zip(found, scales, strict=True):
        np.testing.assert_allclose(estimates / scale, np.tile([0.9, 1.0], (2, 1)), atol=0.1)
    np.testing.assert_allclose(history[0]["return"], [scales], rtol=1e-5)


# Networks that begin anew.

BRIEF = {"num_envs": 2, "batch_size": 4, "replay_size": 40, "warmup_steps": 4, "chunk_steps": 10}


@dataclasses.dataclass(frozen=True)
class Diary(Stub):
    """Notes as bits in which of the steps it was reset, and how many updates it has taken since."""

    def init(self, spec, tasks, key):
        return {"step": jnp.int32(0), "resets": jnp.int32(0), "updates": jnp.int32(0), "noise": jnp.float32(0)}

    def assess(self, state, steps, tasks):
        return state | {"step": state["step"] + 1}, steps

    def update(self, state, window, tasks, key, number):
        return state | {"updates": state["updates"] + 1}, {"updates": jnp.float32(state["updates"])}

    def reset(self, state, spec, tasks, key):
        assert spec.obs_size == 1 and len(tasks.id) == 2
        resets = state["resets"] | (1 << (state["step"] - 1))  # the step is taken, and not yet learned from
        return state | {"resets": resets, "updates": jnp.int32(0), "noise": jax.random.normal(key)}


@pytest.mark.parametrize("seeds", one_in(2, [((3, 5),), ((3,),)]))
@pytest.mark.parametrize(
    ("every", "expected"), one_in(2, [(3, (6, 9, 12, 15, 18)), (0, ()), (11, (11,)), (4, (8, 12, 16))])
)
def test_resets_come_at_multiples_of_their_period_after_the_warmup(every, expected, seeds, monkeypatch):
    """In all seeds alike, across chunks, before the step is learned from; each seed with a key of its own."""
    monkeypatch.setattr(loop, "reset_networks", Diary.reset)
    settings = BRIEF | {"reset_every": every}
    state, _ = train(Walk(), Diary(), settings, seeds=seeds, chunks=2)
    for seed in range(len(seeds)):
        assert [i for i in range(31) if state.agent["resets"][seed] >> i & 1] == list(expected)
        assert state.agent["updates"][seed] == 20 - max(expected, default=BRIEF["warmup_steps"])
        assert (state.agent["noise"][seed] != 0) == bool(expected)
    assert len(np.unique(state.agent["noise"])) == (len(seeds) if expected else 1)


@pytest.mark.slow
def test_a_reset_renews_all_that_learns_and_nothing_else():
    """What it renews is as if just initialised; statistics of the data, and who the tasks are, stay."""
    scaled = tiny("sac-conditioned", scaling="ars", reset_every=9, sampler="hardest", normalize_observations=True)
    init, update = learner(scaled, TASKS, BATCH, SPEC)
    state = init(TASKS, KEY)
    rewards = np.full((3, 3, 2), [[5.0], [1.0], [90.0]])
    for i, reward in enumerate(rewards):
        state = observe(scaled, state, reward, ended=i == 1)
        state, _ = update(state, random_batch(i, 3, BATCH, SPEC), TASKS, jax.random.key(i))
    key = jax.random.key(7)
    fresh, anew = init(TASKS, key), jax.jit(partial(reset_networks, scaled, spec=SPEC, tasks=TASKS, key=key))(state)
    kept = {name: state.nets[name] for name in ("inputs", "tasks", "sampler")}
    before, after = (x.nets["scaling"].own for x in (state, anew))
    given = with_nets(fresh, **kept, scaling=Params({}, scaled.scaling.reset(before)))
    assert jax.tree.structure(given) == jax.tree.structure(anew)
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(given), jax.tree.leaves(anew), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, err_msg=jax.tree_util.keystr(path))
    assert anew.nets["inputs"].shared["moments"].count == 3 * 3 * 2 and np.all(anew.nets["sampler"].own.known)
    assert np.all(before.factor > 0) and np.all(after.factor == 0) and np.all(after.count == 6)
    assert normalize.init(3).count == 0


@pytest.mark.slow
def test_resets_work_in_the_loop_with_seeds():
    """ARS under two seeds: the factors of the last reset, from the mean rewards of that time."""
    settings = BRIEF | {"reset_every": 8, "warmup_steps": 2}
    state, _ = train(Probe("one-step"), tiny("sac", scaling="ars", reset_every=8, hidden=(8,)), settings, seeds=(3, 5))
    scales = state.agent.nets["scaling"].own
    np.testing.assert_allclose(scales.mean, np.tile([1.0, -0.5], (2, 1)), rtol=1e-5)
    np.testing.assert_allclose(scales.factor, np.tile([1.0, 100.0], (2, 1)), rtol=1e-5)
    updates = state.agent.fits["actor"].optimizer[1][0].count
    np.testing.assert_array_equal(updates, 2)  # since step 8 of 10


def test_a_negative_period_is_refused():
    """As other settings of the loop are."""
    with pytest.raises(InputError, match="reset-every must be at least 0, not -1"):
        Replay(reset_every=-1)


def test_a_batch_is_scaled_and_nothing_else_of_it():
    """Rewards alone: times the task's factor."""
    scaling, batch = RewardScaling(), random_batch(0, 2, BATCH, SPEC)
    memory = scaling.init(2)._replace(variance=jnp.float32([4.0, 25.0]))
    assert isinstance(batch, Transition)
    expected = batch.reward / np.array([[2.0], [5.0]])
    np.testing.assert_allclose(scaling.rewards(memory, batch, jnp.full(2, 0.9), NO_BONUS), expected, rtol=1e-5)
