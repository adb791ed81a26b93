"""A transformer that knows its task: one pass is many steps, what it attends to, what it learns, and what it costs."""

import dataclasses

import exact
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, of_task, pick, quick, tasks_of, tiny, train
from test_recurrent import Ratios

import mtjax
from mtjax import agents
from mtjax.agents.base import Memory
from mtjax.agents.parts.knowing.recurrent import Track
from mtjax.agents.parts.knowing.transformer import Transformer, attended, shifted
from mtjax.agents.parts.policies import Taken
from mtjax.experience import Rollouts, rollouts
from mtjax.types import InputError, Spec, Transition

KEY, OBS, ACTION, WINDOWS, LENGTH = jax.random.key(2), 3, 2, 4, 7
SMALL = {"transformer_size": 8, "transformer_heads": 2, "attended_steps": 3}
KNOWING = Transformer(**SMALL)


def params_of(knowing):
    """Random parameters, so that biases too are not 0."""
    first = dataclasses.make_dataclass("Seen", ["obs"])(jnp.zeros(OBS))
    params = knowing.init(1, first, jnp.zeros(ACTION), False, KEY).shared
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(KEY, len(leaves))
    noise = [0.3 * jax.random.normal(key, x.shape) for key, x in zip(keys, leaves, strict=True)]
    return jax.tree.map(jnp.add, params, tree.unflatten(noise))


def track_of(state, seed=0, ends=0.3):
    """Windows of random steps. Some end an episode, and of these some the trial, others by a mere limit of time."""
    random, count = np.random.default_rng(seed), WINDOWS * LENGTH
    normal = lambda *size: jnp.float32(random.normal(size=(count, *size)))
    ended, closed, cut = random.random((3, count)) < [[ends], [0.5], [0.7]]
    flags = [jnp.asarray(x) for x in (ended, ended & closed, ended & (closed | cut))]
    return Track(state, normal(OBS), normal(ACTION), normal(), *flags)


def begun(knowing):
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (WINDOWS, *x.shape)), knowing.begin(OBS, ACTION))


@pytest.mark.slow
def test_one_pass_over_a_window_is_its_steps_one_by_one():
    """Before and after every step, through ends of trials and cuts, from a memory that is empty, half full and full."""
    params, state, filled = params_of(KNOWING), begun(KNOWING), set()
    for seed in range(3):
        track = track_of(state, seed)
        filled |= set(np.unique(np.sum(state.known, axis=1)))
        one_by_one = quick(KNOWING.over, params, track)(params, track)
        for after in (False, True):
            shown = jax.jit(KNOWING.shown, static_argnums=2)(params, track, after)
            np.testing.assert_allclose(shown, one_by_one[after].out, atol=1e-5)
        last = lambda x: x.reshape(WINDOWS, LENGTH, *x.shape[1:])[:, -1]
        state = jax.tree.map(last, one_by_one[1])
    assert filled >= {0, 3} and filled & {1, 2}


@pytest.mark.slow
def test_a_trial_begins_with_nothing():
    """After the step that closes a trial networks see 0, and then the same as if no steps had been before."""
    params, track = params_of(KNOWING), track_of(begun(KNOWING), ends=0.0)
    track = track._replace(closed=jnp.arange(WINDOWS * LENGTH) % LENGTH == 2)
    shown = KNOWING.shown(params, track, False).reshape(WINDOWS, LENGTH, -1)
    assert not np.any(shown[:, 3]) and np.all(np.any(np.asarray(shown[:, 4:]), axis=-1))
    changed = track._replace(reward=track.reward + 5 * (jnp.arange(WINDOWS * LENGTH) % LENGTH < 3))
    other = KNOWING.shown(params, changed, False).reshape(WINDOWS, LENGTH, -1)
    np.testing.assert_array_equal(other[:, 3:], shown[:, 3:])
    assert not np.allclose(other[:, 1:3], shown[:, 1:3])


@pytest.mark.parametrize("layers", [1, 2])
def test_the_oldest_steps_fall_out(layers):
    """With C = 3 a step tells of itself and of 3 before it, in each block. What is older changes nothing at all."""
    knowing = dataclasses.replace(KNOWING, transformer_layers=layers)
    params, track = params_of(knowing), track_of(begun(knowing), ends=0.0)
    shown = lambda track: np.asarray(knowing.shown(params, track, True)).reshape(WINDOWS, LENGTH, -1)
    first = jnp.arange(WINDOWS * LENGTH) % LENGTH == 0
    moved = np.abs(shown(track._replace(reward=track.reward + 5 * first)) - shown(track)).max(axis=(0, 2))
    np.testing.assert_array_equal(moved > 1e-6, np.arange(LENGTH) <= 3 * layers)


def test_which_steps_are_attended_to():
    """One kept step of two, then three steps; the trial ends with the second."""
    found = attended(jnp.float32([0, 1]), jnp.array([False, True, False]))
    np.testing.assert_array_equal(found, np.array([[0, 1, 0, 0, 0], [0, 1, 1, 0, 0], [0, 0, 0, 0, 0]], bool))
    rows = shifted(jnp.float32([[2, 1]]), 3)
    np.testing.assert_array_equal(rows, [[[2, 1, 0, 0, 0], [0, 2, 1, 0, 0], [0, 0, 2, 1, 0]]])


def test_attention_by_hand():
    """One block, one head, MLP of 0: the sum over a step itself, one before it, and nothing, whose weight is 1."""
    knowing = Transformer(transformer_size=2, transformer_heads=1, transformer_layers=1, attended_steps=2)
    params = jax.tree.map(jnp.zeros_like, params_of(knowing))
    block = params["transformer"]["Block_0"]
    eye, ones = np.eye(2, dtype=np.float32), np.ones(2, np.float32)
    read = np.zeros((OBS + ACTION + 2, 2), np.float32)
    read[:2] = eye
    block |= {"LayerNorm_0": {"scale": ones, "bias": 0 * ones}, "Dense_0": {"kernel": np.concatenate([eye] * 3, 1)}}
    block |= {"bias": np.float32([[0.3, -0.2, 0.5]])}
    block["Dense_1"]["kernel"] = eye
    params["transformer"] |= {"Dense_0": {"kernel": read, "bias": 0 * ones}}
    params["transformer"] |= {"LayerNorm_0": {"scale": ones, "bias": 0 * ones}}
    memory, steps = knowing.begin(OBS, ACTION), np.float32([[1, 3], [2, -1]])
    for x in steps:
        obs = jnp.float32([*x, 0])
        step = Transition(obs, jnp.zeros(ACTION), jnp.float32(0), None, None, jnp.bool_(False))
        memory = knowing.remember(params, memory, step)
    normal = lambda x: (x - x.mean()) / np.sqrt(x.var() + 1e-6)
    old, new = map(normal, steps)
    weights = np.exp([new @ old / np.sqrt(2) - 0.2, new @ new / np.sqrt(2) + 0.5])
    found = weights @ np.stack([old, new]) / (1 + weights.sum())
    np.testing.assert_allclose(memory.out, normal(steps[1] + found), rtol=1e-4)
    np.testing.assert_allclose(memory.keys[0], [old, new], rtol=1e-4)


# In agents.

SPEC, ENVS = Spec.vector(OBS, ACTION, 1), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
SETTINGS = {"conditioning": "transformer", **SMALL}


def rollout(agent):
    """Rollouts (T, H, E, ...) in which every field is random, and memories (T, 1, E, ...) before the first step."""
    random, shape = np.random.default_rng(0), (3, LENGTH, ENVS)
    normal = lambda *size: jnp.float32(random.normal(size=(*shape, *size)))
    raw, ended = normal(ACTION), jnp.asarray(random.random(shape) < 0.3)
    steps = Transition(normal(OBS), jnp.tanh(raw), normal(), jnp.ones(shape), normal(OBS), ended, ended, ended)
    first = lambda x: jnp.float32(random.random((3, 1, ENVS, *x.shape)))
    hidden = jax.tree.map(first, agent.conditioning.begin(OBS, ACTION))
    return steps._replace(extras=Taken(raw, normal() - 2), memory=Memory(None, hidden))


@pytest.mark.slow
def test_each_loss_reaches_all_of_it():
    agent = tiny("ppo", unroll=LENGTH, epochs=1, minibatches=1, **SETTINGS)
    state = agent.init(SPEC, TASKS, KEY)
    state, steps = agent.assess(state, rollout(agent), TASKS)
    state, batch = agent.prepare(state, rollouts.windows(steps, agent.unroll), TASKS)
    nets, one = of_task(state.nets, 0), pick(batch._replace(mask=None), 0)
    for loss in (lambda nets: agent.actor_loss(nets, one, KEY)[0], lambda nets: agent.critic_loss(nets, one)[0]):
        slope = jax.jit(jax.grad(loss))(nets)["knowing"]
        assert all(np.any(np.asarray(x) != 0) for x in jax.tree.leaves(slope))


def test_windows_have_the_memory_of_their_world():
    """Of memories that are known before the first steps alone, a window has that of the world whose steps it has."""
    experience, worlds = Rollouts(unroll=5, minibatches=2, epochs=1), jnp.arange(6.0)
    steps = jnp.broadcast_to(worlds, (1, 5, 6))
    agent = dataclasses.make_dataclass("Agent", ["unroll"])(5)
    data = Transition(None, None, steps, None, None, memory=worlds[None, None])
    batches = experience.batches(None, agent, None, data, KEY)  # type: ignore
    memories, rewards = [], []
    for batch in batches:
        window = experience.window(data, batch)
        memories.append(np.squeeze(window.memory, axis=(0, 2)))
        rewards.append(window.reward[0])
    np.testing.assert_array_equal(np.sort(np.concatenate(memories)), worlds)
    np.testing.assert_array_equal(np.stack(rewards), np.broadcast_to(np.stack(memories)[..., None], (2, 3, 5)))


class Kept(Ratios):
    """Requires that its rollouts of seven steps keep the memory before the first alone."""

    def observe(self, state, steps, tasks):
        assert {x.shape[1] for x in jax.tree.leaves(steps.memory.hidden)} == {1} and steps.reward.shape[1] == 7
        return super().observe(state, steps, tasks)


@pytest.mark.slow
@pytest.mark.parametrize("way", [SETTINGS, pytest.param({"conditioning": "recurrent"}, marks=pytest.mark.slow)])
def test_the_policy_that_learns_is_the_one_that_played(way):
    """A rollout keeps its first memory alone, and tells of it what actions were drawn with: ratios begin at 1."""
    agent = tiny("ppo", epochs=1, minibatches=1, **way)
    agent = Kept(**{field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)})
    given = {"num_envs": 4, "unroll": 7, "chunk_steps": 35, "trials": 2}
    _, history = train(Walk(episode_length=4), agent, given)
    assert history[0]["ratio"].max() < 1e-4 and np.all(history[0]["bad_step"] == -1)


@pytest.mark.usefixtures("optimised")
@pytest.mark.nightly  # it takes a minute
def test_it_explores_as_well_as_can_be():
    """Ten pulls of two arms that every trial draws: within 3% of the best strategy, which earns 6.02; told 6.67.

    In two evaluations of 2,000 trials each, half-way and at the end, whose mean is sure to .03.
    """
    pulls, trials = 10, 2000
    known = {"conditioning": "transformer", "transformer_size": 32, "attended_steps": pulls}
    given = dict(unroll=pulls, minibatches=4, gamma=1.0, actor_lr=1e-3, entropy_cost=0.01)
    agent, steps = mtjax.agent("rl2", hidden=(32, 32), **known, **given), 150 * 256 * pulls
    plan = dict(steps=steps, eval_every=steps // 2, eval_episodes=trials * pulls, chunk_steps=75 * pulls)
    result = mtjax.train(mtjax.make("hidden-bandit"), agent, trials=pulls, num_envs=256, quiet=True, **plan)
    found = result.evaluations.returns["train"][0, -2:, 0].reshape(-1, pulls).sum(axis=1).mean()
    assert found > 0.97 * exact.bandit(2, pulls)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("ppo", {"transformer_size": 64, "transformer_heads": 5}, "must be a multiple of transformer-heads=5"),
        ("ppo", {"attended_steps": 0}, "attended-steps must be at least 1, not 0"),
        ("ppo", {"transformer_layers": 0}, "transformer-layers must be at least 1, not 0"),
        ("ppo", {"recurrent_size": 32}, "recurrent_size"),
        ("sac", {"n_step": 3, "warmup_steps": 50}, "conditioning=transformer needs n-step=1"),
        ("hip-bmdp", {"unseen_theta": "inferred"}, "conditioning=transformer and theta-from are two memories"),
    ],
)
def test_what_it_cannot_do_is_refused(name, settings, message):
    with pytest.raises(InputError, match=message):
        agents.agent(name, conditioning="transformer", **settings)
