"""The loop by what it stores and reports, mostly with an agent that learns nothing and writes down what it is given."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Broken, Lost, Probe, Stub, Unsound, Walk, one_in, tasks_of, tiny, train

import mtjax
from mtjax.config import configure
from mtjax.experience import Replay
from mtjax.learning import loop
from mtjax.learning.loop import Settings
from mtjax.learning.rollout import bounded_worlds, broadcast_tasks, reset_envs, step_envs
from mtjax.parallel.axes import over_learners, over_worlds
from mtjax.types import Acted, InputError, Spec

ENVS, BATCH, WARMUP, HOLD, CHUNK, UPDATES = 4, 8, 8, 3, 13, 2
SETTINGS = {
    "num_envs": ENVS,
    "updates_per_step": UPDATES,
    "batch_size": BATCH,
    "replay_size": 200,
    "warmup_steps": WARMUP,
    "warmup_hold": HOLD,
    "chunk_steps": CHUNK,
}


@dataclasses.dataclass(frozen=True)
class Recorder(Stub):
    """Acts 2 + task's number, which no random action is; counts updates, and those given the batch before once more."""

    nan_update: int = -1

    def init(self, spec, tasks, key):
        last = jnp.zeros((len(tasks.id), BATCH, spec.obs_size))
        return {"updates": jnp.int32(0), "repeats": jnp.int32(0), "last": last}

    def choose(self, state, obs, task, key):
        return jnp.full(1, 2.0) + task.id

    def update(self, state, window, tasks, key, number):
        batch, count = jax.tree.map(lambda x: x[:, :, 0], window), state["updates"] + 1
        repeats = state["repeats"] + jnp.all(batch.obs == state["last"])
        wrong = (count == self.nan_update) & (tasks.id == 0)
        metrics = {"count": jnp.float32(count), "loss": jnp.where(wrong, jnp.nan, jnp.float32(tasks.id))}
        return {"updates": count, "repeats": repeats, "last": batch.obs}, metrics


@pytest.fixture(scope="module")
def walk():
    """Two seeds of three chunks on walks: states and metrics."""
    return train(Walk(), Recorder(), SETTINGS, seeds=(0, 1), chunks=3)


def stored(state):
    """What the replay of each seed holds, as (S, T, E, H, ...) in the order of time."""
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x)[:, :, : 3 * CHUNK], 2, 3), state.data.ring.rows)


def ends(rows):
    """Whether each stored step ended its episode, by termination or by the limit of five."""
    age = np.floor(rows.obs[..., 0])
    return (rows.discount == 0) | (age == 4)


def test_a_time_limit_is_stored_as_a_step_like_any_other(walk):
    """Discount 1, and the observation that the limit cut off, which no episode begins with."""
    rows = stored(walk[0])
    age, fraction = np.floor(rows.obs[..., 0]), rows.obs[..., 0] % 1
    cut = age == 4
    assert cut.sum() > 20
    assert np.all(rows.discount[cut] == 1)
    np.testing.assert_allclose(rows.next_obs, rows.obs + 1, rtol=1e-6)
    np.testing.assert_array_equal(rows.discount == 0, (fraction < 0.5) & (age == 2))


def test_an_episode_goes_on_until_it_ends_and_the_next_begins_anew(walk):
    """Environments end at different times: each is reset exactly when its own episode ends."""
    rows = stored(walk[0])
    ended = ends(rows)[..., :-1]
    assert 0.1 < ended.mean() < 0.5
    following, next_obs = rows.obs[..., 1:, 0], rows.next_obs[..., :-1, 0]
    np.testing.assert_array_equal(following[~ended], next_obs[~ended])
    assert np.all(following[ended] < 1)
    state = walk[0]
    np.testing.assert_array_equal(state.worlds.obs[..., 0] // 1, state.worlds.age)


def test_every_episode_begins_somewhere_else(walk):
    """Over seeds, tasks, environments and episodes."""
    rows = stored(walk[0])
    starts = rows.obs[..., 0][np.floor(rows.obs[..., 0]) == 0]
    assert len(starts) > 100 and len(np.unique(starts)) == len(starts)
    assert 0.4 < starts.mean() < 0.6


def test_reported_returns_are_those_of_the_episodes(walk):
    """Summed by hand from what was stored, and counted in the chunk in which an episode ended."""
    state, history = walk
    rows, scales = stored(state), (1.0, -0.5)
    ended, spanning = ends(rows), 0
    for seed, task in np.ndindex(2, 2):
        found = [[] for _ in history]
        for env in range(ENVS):
            total = begun = 0
            for step in range(3 * CHUNK):
                total += rows.reward[seed, task, env, step]
                if ended[seed, task, env, step]:
                    found[step // CHUNK].append(total)
                    spanning += begun // CHUNK < step // CHUNK
                    total, begun = 0, step + 1
        for returns, metrics in zip(found, history, strict=True):
            assert metrics["episodes"][seed, task] == len(returns)
            np.testing.assert_allclose(metrics["return"][seed, task], np.mean(returns), rtol=1e-5)
    assert spanning > 4
    expected = np.reshape(scales, (2, 1, 1)) * rows.obs[..., 0]
    np.testing.assert_allclose(rows.reward, expected, rtol=1e-6)


def test_first_episodes_of_staggered_worlds_are_not_reported():
    """They are shorter than others: in two steps some of them end, and none that began at its beginning."""
    state, (metrics,) = train(Walk(), Recorder(), {**SETTINGS, "chunk_steps": 2, "stagger": True})
    assert np.all(np.sum(state.counted, axis=2) > 1) and np.all(metrics["episodes"] == 0)


def test_warmup_acts_at_random_and_then_the_agent_does(walk):
    """For exactly as many steps as asked, in uniform actions held as long as asked; then each task by its own."""
    actions = stored(walk[0]).action[..., 0]
    random, chosen = actions[..., :WARMUP], actions[..., WARMUP:]
    held = random[..., ::HOLD]
    np.testing.assert_array_equal(random, np.repeat(held, HOLD, axis=-1)[..., :WARMUP])
    assert np.all(np.abs(held) <= 1) and len(np.unique(held)) == held.size
    assert abs(held.mean()) < 0.3 and abs(held.var() - 1 / 3) < 0.15
    np.testing.assert_array_equal(chosen[:, 0], 2.0)
    np.testing.assert_array_equal(chosen[:, 1], 3.0)


class Noting(Stub):
    """Remembers ten times as much after every step, and stores what it acted on."""

    def begin(self, state, task):
        return jnp.int32(1)

    def act(self, state, memory, obs, task, key):
        return Acted(jnp.zeros(1), memory + 1)

    def remember(self, state, memory, transition, task):
        return 10 * memory


def test_a_step_keeps_to_a_tasks_actions_and_to_what_the_agent_noted():
    """Whatever explores; acting reads the memory from before a step, which is stored with it."""
    env, agent, learners = Walk(), Noting(), jnp.zeros((1, 1))
    tasks = env.tasks()._replace(action_mask=jnp.array([[1.0], [0.0]]))
    worlds = reset_envs(env, agent, learners, tasks, jax.random.split(jax.random.key(0), (1, 2, 3)))
    for count in (10, 100):
        worlds, step = step_envs(env, agent, learners, tasks, worlds, None, lambda action: action + 5)
        np.testing.assert_array_equal(step.transition.action[0, :, :, 0], [[5] * 3, [0] * 3])
        assert np.all(worlds.memory == count) and worlds.memory.shape == (1, 2, 3)
        assert np.all(step.transition.memory == count // 10) and np.all(step.transition.extras == count // 10 + 1)


def test_updates_begin_after_the_warmup_and_each_has_its_own_batch(walk):
    """So many a step, and losses are averaged over the updates that took place."""
    state, history = walk
    first = UPDATES * (CHUNK - WARMUP)
    np.testing.assert_array_equal(state.agent["updates"], first + 2 * UPDATES * CHUNK)
    np.testing.assert_array_equal(state.agent["repeats"], 0)
    np.testing.assert_allclose(history[0]["count"], (1 + first) / 2)
    np.testing.assert_allclose(history[1]["count"], first + (1 + UPDATES * CHUNK) / 2)
    np.testing.assert_allclose(history[1]["loss"], [[0, 1], [0, 1]])
    np.testing.assert_array_equal(state.iteration, 3 * CHUNK)
    np.testing.assert_array_equal(state.data.ring.size, 3 * CHUNK)


def test_finite_numbers_report_no_bad_step(walk):
    """-1 for every seed and task."""
    for metrics in walk[1]:
        np.testing.assert_array_equal(metrics["bad_step"], -np.ones((2, 2)))


def test_a_bad_step_names_its_task():
    """A loss in the first task, by its update; a reward in the second, by its step, and at its first time."""
    env, update = Broken(), 7
    state, (metrics,) = train(env, Recorder(nan_update=update), SETTINGS)
    in_loss = WARMUP + (update - 1) // UPDATES
    np.testing.assert_array_equal(metrics["bad_step"], [[in_loss, env.broken_age]])
    assert np.isnan(state.data.ring.rows.reward[0, 1]).any() and not np.isnan(state.data.ring.rows.reward[0, 0]).any()


@pytest.mark.slow
def test_a_bad_reward_is_not_blamed_on_the_tasks_that_share_the_networks():
    """Learned from in the step in which it occurs, it spoils all losses; the first bad step is its own task's."""
    env, settings = Broken(), {**SMALL, "replay_size": 2, "warmup_steps": 1, "chunk_steps": 6}
    _, (metrics,) = train(env, tiny("sac-conditioned", hidden=(8,)), settings)
    first, second = metrics["bad_step"][0]
    assert second == env.broken_age < first


@pytest.mark.parametrize("value", one_in(3, [np.nan, -np.inf, 2e10]))
def test_the_episode_of_a_lost_world_is_cut_off(monkeypatch, value):
    """It leaves a step without reward that goes nowhere and bootstraps. Its return does not count; another begins."""
    monkeypatch.setattr(loop, "_MOST_LOST", 1.0)
    state, (metrics,) = train(Lost(value=value), Recorder(), {**SETTINGS, "stagger": False})
    rows = jax.tree.map(lambda x: np.moveaxis(np.asarray(x)[0, :, :CHUNK], 1, 2), state.data.ring.rows)  # (T, E, H)
    lost = (np.floor(rows.obs[..., 0]) == 1) & (rows.obs[..., 0] % 1 < Lost.share)
    lost[0] = False
    assert 0 < lost.sum() < 12 and all(np.all(np.isfinite(x)) for x in jax.tree.leaves((rows, state.worlds.obs)))
    np.testing.assert_array_equal(rows.next_obs[lost], rows.obs[lost])
    np.testing.assert_array_equal(rows.reward[lost], 0)
    np.testing.assert_array_equal(rows.discount, 1)
    assert np.all(rows.obs[..., 1:, 0][lost[..., :-1]] < 1)
    np.testing.assert_array_equal(metrics["lost"], lost.sum(axis=(1, 2))[None])
    np.testing.assert_array_equal(metrics["episodes"], np.sum(np.floor(rows.obs[..., 0]) == 4, axis=(1, 2))[None])
    np.testing.assert_array_equal(metrics["bad_step"], [[-1, -1]])


@pytest.mark.parametrize("value", [np.nan, -np.nan, np.inf, -np.inf, 1.1e10, -1.1e10])
@pytest.mark.parametrize("size", [1, 3, 33, 400])
def test_one_number_beyond_the_bound_is_seen_wherever_it_is(value, size):
    """In one of two arrays of an observation; the bound itself is within."""
    obs = {"a": np.random.RandomState(0).normal(size=(1, 2, size, size)).astype(np.float32)}
    obs |= {"b": np.full((1, 2, size, 2, 2), -1e10, np.float32), "c": np.full((1, 2, size), 2**31 - 1)}
    obs["a"][0, 1, np.arange(size), np.arange(size)] = value
    np.testing.assert_array_equal(jax.jit(bounded_worlds)(obs), [[[True] * size, [False] * size]])


def test_worlds_that_are_lost_often_are_a_bad_step():
    """More than once in 10,000 steps: at the first time, of their task alone."""
    _, (metrics,) = train(Lost(share=0.9), Recorder(), {**SETTINGS, "stagger": False})
    np.testing.assert_array_equal(metrics["bad_step"], [[-1, 1]])


def test_one_lost_world_stops_no_run_however_short_its_chunks():
    """Though it is more than one in 10,000 steps."""
    _, (metrics,) = train(Lost(share=0.1), Recorder(), {**SETTINGS, "stagger": False})
    np.testing.assert_array_equal(metrics["lost"], [[0, 1]])
    np.testing.assert_array_equal(metrics["bad_step"], [[-1, -1]])


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize("share", one_in(2, [1.0, 0.05]))
def test_an_episode_that_begins_with_no_number_is_a_bad_step(share, early):
    """The step before it, of its task alone, or the first of the chunk. No world is lost: the next step has numbers."""
    state, (metrics,) = train(Unsound(share=share, early=early), Recorder(), {**SETTINGS, "stagger": False})
    begun = np.isnan(np.asarray(state.data.ring.rows.obs)[0, 1, :CHUNK, :, 0])  # (H, E)
    first = np.flatnonzero(begun.any(axis=1))[0]
    assert (first > 0) == (share < 1)
    np.testing.assert_array_equal(metrics["bad_step"], [[-1, max(first - 1, 0)]])
    np.testing.assert_array_equal(metrics["lost"], 0)


# With an agent that learns.

SMALL = dict(num_envs=2, batch_size=4, replay_size=12, warmup_steps=4, chunk_steps=4)  # one chunk of warm-up


def learn(seeds, chunks=2):
    return train(Walk(), tiny("sac-conditioned", hidden=(8,)), SMALL, seeds=seeds, chunks=chunks)


def leaves_of(state):
    """Every array, with keys as numbers."""
    raw = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return [np.asarray(raw(x)) for x in jax.tree.leaves(state)]


@pytest.mark.slow
def test_seeds_do_not_touch_each_other():
    """Two in one program are each one alone, up to the rounding of products of other shapes."""
    both, _ = learn((3, 5))
    each = lambda state: leaves_of(state._replace(data=(state.data.ring.rows, state.data.key), iteration=None))
    for i, seed in enumerate((3, 5)):
        alone, _ = learn((seed,))
        for a, b in zip(each(both), each(alone), strict=True):
            np.testing.assert_allclose(a[i], b[0], rtol=1e-3, atol=1e-5)
    kernel = both.agent.nets["actor"].shared["head"]["kernel"]
    assert not np.allclose(kernel[0], kernel[1])


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes():
    """State and metrics; another seed gives others."""
    first, second, other = (learn((seed,)) for seed in (3, 3, 4))
    assert [x.tobytes() for x in leaves_of(first)] == [x.tobytes() for x in leaves_of(second)]
    differs = [a.tobytes() != b.tobytes() for a, b in zip(leaves_of(first), leaves_of(other), strict=True)]
    assert sum(differs) > 10


@pytest.mark.slow
def test_the_agent_rests_through_the_warmup():
    """Its state is what it began with, to the bit, until learning starts."""
    start, _ = learn((3,), chunks=0)
    warm, (metrics,) = learn((3,), chunks=1)
    after, _ = learn((3,), chunks=2)
    bytes_of = lambda state: [x.tobytes() for x in leaves_of(state.agent)]
    assert bytes_of(start) == bytes_of(warm) != bytes_of(after)
    assert np.all(metrics["critic_loss"] == 0) and np.all(metrics["bad_step"] == -1)
    np.testing.assert_array_equal(after.agent.fits["actor"].optimizer[1][0].count, SMALL["chunk_steps"])


@dataclasses.dataclass(frozen=True)
class Counted(Walk):
    """A walk that notes whenever it is traced."""

    traces = []  # noqa: RUF012

    def rules(self, task, state, action):
        self.traces.append(1)
        return super().rules(task, state, action)


def test_chunks_compile_once_and_take_over_the_memory_of_the_state():
    """However many there are; the state that was given is gone."""
    env, tasks = Counted(), Walk().tasks()
    agent, settings = configure(Recorder(), Settings(stagger=False), SETTINGS)
    state, counts = loop.init(env, agent, settings, tasks, jnp.uint32([0])), []
    for _ in range(3):
        given = state
        state, _ = loop.run_chunk(env, agent, settings, tasks, state)
        counts.append(len(env.traces))
        assert all(
            x.is_deleted() for x in (given.data.ring.rows.obs, given.worlds.obs, given.agent["updates"], given.key)
        )
    assert counts[0] == counts[1] == counts[2] > 0
    assert state.iteration == 3 * CHUNK


def test_collecting_without_learning_is_allowed():
    """No updates: no losses, and the agent stays."""
    state, (metrics,) = train(Walk(), Recorder(), {**SETTINGS, "updates_per_step": 0})
    assert set(metrics) == {"return", "episodes", "lost", "bad_step", "bad_reward"}
    assert state.agent["updates"] == 0 and state.iteration == CHUNK


# The parts.


def test_spread_repeats_tasks_along_seeds_and_environments():
    """Every leaf (T, ...) becomes (S, T, E, ...)."""
    worlds = broadcast_tasks(tasks_of("one-step", (1.0, 2.0, 3.0)), (2, 3, 4))
    assert worlds.context.shape == (2, 3, 4, 1) and worlds.id.shape == (2, 3, 4)
    np.testing.assert_array_equal(worlds.goal["scale"], np.broadcast_to(np.float32([[1], [2], [3]]), (2, 3, 4)))


def test_over_worlds_maps_single_worlds_in_place():
    """The function sees one world of each argument; results lie where the arguments did."""
    scale, pairs = np.arange(24.0).reshape(2, 3, 4), np.arange(48.0).reshape(2, 3, 4, 2)
    total, doubled = over_worlds(lambda scale, pair: (scale * 100 + pair[0] + pair[1], 2 * pair))(scale, pairs)
    np.testing.assert_array_equal(total, scale * 100 + pairs.sum(axis=-1))
    np.testing.assert_array_equal(doubled, 2 * pairs)


def test_over_learners_gives_each_world_its_seeds_learner_and_its_task():
    """Learners along the first axis, tasks along the second, and arguments a world each."""
    learners, tasks, x = np.float32([7, 8]), tasks_of("one-step", (1.0, 2.0, 3.0)), np.arange(24.0).reshape(2, 3, 4)
    code = lambda learner, task, x: learner * 10_000 + task.goal["scale"] * 100 + x
    expected = np.reshape([70_000, 80_000], (2, 1, 1)) + np.reshape([100, 200, 300], (3, 1)) + x
    np.testing.assert_array_equal(over_learners(code)(learners, tasks, x), expected)


def test_capacity_is_a_whole_number_of_steps():
    """Rounded down, as a slot of the ring holds a step of all environments; what is stored is as large."""
    agent, settings = configure(Recorder(), Settings(), {**SMALL, "num_envs": 3, "replay_size": 17})
    assert agent.experience.capacity(3) == 15 and Replay(replay_size=12).capacity(2) == 12
    start = jax.eval_shape(lambda: loop.init(Probe(), agent, settings, Probe().tasks(), jnp.uint32([0])))
    assert start.data.ring.rows.obs.shape == (1, 2, 5, 3, 1) and start.worlds.obs.shape == (1, 2, 3, 1)
    assert Probe().spec == Spec.vector(1, 1, 1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 0}, "num-envs must be at least 1, not 0"),
        ({"batch_size": -3}, "batch-size must be at least 1, not -3"),
        ({"updates_per_step": -1}, "updates-per-step must be at least 0, not -1"),
        ({"warmup_steps": 0}, "warmup-steps must be at least 1, not 0"),
        ({"warmup_hold": 0}, "warmup-hold must be at least 1, not 0"),
        ({"chunk_steps": 0}, "chunk-steps must be at least 1"),
        ({"num_envs": 32, "replay_size": 31}, r"replay-size \(31\) must hold one step of num-envs \(32\)"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    """With the flag, what was given and what is allowed."""
    with pytest.raises(InputError, match=message):
        mtjax.train(Walk(), tiny("sac"), steps=10, **settings)


@dataclasses.dataclass(frozen=True)
class Drifting(Walk):
    """Walks whose episodes draw a scale of their own, which is also their reward."""

    def tasks(self, split="train"):
        tasks = super().tasks(split)
        scales = jnp.linspace(1.0, 2.0, 50)[None] + 10 * jnp.arange(len(tasks.id))[:, None]
        draws = jax.tree.map(lambda x: jnp.broadcast_to(x[:, None], (*x.shape[:1], 50, *x.shape[1:])), tasks)
        return tasks._replace(draws=draws._replace(context=scales[..., None], goal=draws.goal | {"scale": scales}))


def test_contexts_are_stored_only_where_those_of_a_task_differ():
    """Else every transition of a task would hold the same numbers."""
    (agent, settings), tasks = configure(Recorder(), Settings(), SETTINGS), Drifting().tasks()
    hidden = tasks._replace(draws=tasks.draws._replace(context=None))
    shapes = [jax.eval_shape(partial(loop.init, Walk(), agent, settings), x, jnp.uint32([0])) for x in (tasks, hidden)]
    stored = [state.data.ring.rows.context for state in shapes]
    assert stored[0].shape == (1, 2, 50, ENVS, 1) and stored[1] is None


class Sees(Recorder):
    """Acts by what it is shown of the task."""

    def choose(self, state, obs, task, key):
        return task.context + 100 * task.id


@pytest.mark.slow
def test_episodes_draw_their_tasks_where_those_are_continuous():
    """Each episode has one draw of its own task from start to end, stored and acted on; the next has another."""
    state, _ = train(Drifting(), Sees(), SETTINGS, seeds=(0, 1), chunks=3)
    rows = stored(state)
    context = rows.context[..., 0]
    assert np.all((context - 10 * np.arange(2)[:, None, None] >= 1) & (context - 10 * np.arange(2)[:, None, None] <= 2))
    goes_on = ~ends(rows)[..., :-1]
    assert np.all((context[..., 1:] == context[..., :-1])[goes_on])
    assert np.mean((context[..., 1:] != context[..., :-1])[~goes_on]) > 0.9
    learned = np.arange(3 * CHUNK) >= WARMUP
    acted = rows.action[..., 0] - 100 * np.arange(2)[:, None, None]
    np.testing.assert_allclose(acted[..., learned], context[..., learned], rtol=1e-6)
