"""A recurrent memory of the task: what it keeps, how it learns through windows, and what it is refused with."""

import dataclasses
from functools import partial

import exact
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, of_task, pick, quick, slow_but, tasks_of, tiny, train

import mtjax
from mtjax import agents
from mtjax.agents import on_policy, replay_batches
from mtjax.agents.base import Memory
from mtjax.agents.parts.knowing.recurrent import Following, Recurrent, Track
from mtjax.agents.parts.policies import Taken
from mtjax.agents.ppo import PPO
from mtjax.experience import rollouts
from mtjax.types import InputError, Spec, Transition

SPEC, LENGTH, ENVS, SIZE = Spec.vector(3, 2, 1), 6, 4, 5
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(2)
RECURRENT = {"conditioning": "recurrent", "recurrent_size": SIZE}


def rollout(seed=0):
    """Rollouts (T, H, E, ...) in which every field is random; memories are told for the first step alone."""
    random, shape = np.random.default_rng(seed), (3, LENGTH, ENVS)
    normal = lambda *size: jnp.float32(random.normal(size=(*shape, *size)))
    raw, ended = normal(2), jnp.asarray(random.random(shape) < 0.3)
    return Transition(
        obs=normal(3),
        action=jnp.tanh(raw),
        reward=normal(),
        discount=jnp.ones(shape),
        next_obs=normal(3),
        ended=ended,
        closed=ended,
        cut=ended,
        extras=Taken(raw, normal() - 2),
        memory=Memory(None, normal(SIZE)),
    )


def test_states_over_a_window_are_those_of_steps_one_by_one():
    """With what acting remembers, and anew after a trial. After a step that cuts sums off, no end is seen."""
    knowing, steps = Recurrent(recurrent_size=SIZE), pick(rollout(), 0)
    params = knowing.init(3, jax.tree.map(lambda x: x[0, 0], steps), jnp.zeros(2), False, KEY).shared
    window = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), steps)  # (E, H, ...)
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    rest = (window.obs, window.action, window.reward, window.ended, window.closed, window.cut)
    track = Track(window.memory.hidden[:, 0], *map(flat, rest))
    found = quick(knowing.over, params, track)(params, track)
    before, after = (x.reshape(ENVS, LENGTH, SIZE) for x in found)
    one = jax.jit(lambda hidden, step: knowing.remember(params, hidden, step))
    for world in range(ENVS):
        hidden = window.memory.hidden[world, 0]
        for t in range(LENGTH):
            np.testing.assert_allclose(before[world, t], hidden, atol=1e-5)
            step = pick(window, (world, t))
            following = one(hidden, step._replace(ended=step.ended & ~step.cut))
            np.testing.assert_allclose(after[world, t], following, atol=1e-5)
            hidden = jnp.where(step.closed, knowing.begin(3, 2), one(hidden, step))
    features = lambda past: knowing.features(params, jnp.zeros(0), dataclasses.make_dataclass("Seen", ["past"])(past))
    for past, state in ((track, found[0]), (Following(*track), found[1])):  # another program, which may round otherwise
        np.testing.assert_allclose(features(past), state, rtol=0, atol=2.5e-7)


class Ratios(PPO):
    """Tells how far the ratio of policies is from 1 at most."""

    def gain(self, log_ratio, batch):
        gain, metrics = super().gain(log_ratio, batch)
        return gain, metrics | {"ratio": jnp.max(jnp.abs(jnp.exp(log_ratio) - 1))}


@pytest.mark.slow
def test_the_policy_that_learns_is_the_one_that_played():
    """The states that a window tells are those with which its actions were drawn, so that every ratio begins at 1."""
    agent = tiny("ppo", epochs=1, minibatches=1, **RECURRENT)
    agent = Ratios(**{field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)})
    _, history = train(Walk(episode_length=7), agent, {"num_envs": 4, "unroll": 5, "chunk_steps": 60})
    assert history[0]["ratio"].max() < 1e-5 and np.all(history[0]["bad_step"] == -1)


@pytest.mark.slow
def test_both_losses_train_the_memory_in_the_actors_step_in_ppo_and_the_critics_in_sac():
    """Through all steps of a window; half the critic's counts."""
    agent = tiny("ppo", unroll=LENGTH, epochs=1, minibatches=1, **RECURRENT)
    state, steps = agent.init(SPEC, TASKS, KEY), rollout()
    state, steps = agent.assess(state, steps, TASKS)
    state, batch = agent.prepare(state, rollouts.windows(steps, agent.unroll), TASKS)
    nets, one = of_task(state.nets, 0), pick(batch._replace(mask=None), 0)
    slope = lambda loss: jax.jit(jax.grad(lambda nets: loss(nets)[0]))(nets)["knowing"]
    actors, critics = slope(lambda nets: agent.actor_loss(nets, one, KEY)), slope(lambda x: agent.critic_loss(x, one))
    both = slope(lambda nets: on_policy.actor_step_loss(agent, nets, one, KEY))
    for found, *of_one in zip(*map(jax.tree.leaves, (both, actors, critics)), strict=True):
        assert all(np.any(np.asarray(x) != 0) for x in of_one)
        np.testing.assert_allclose(found, of_one[0] + 0.5 * of_one[1], rtol=1e-4, atol=1e-6)
    teachers = lambda name: {fit for fit, made in tiny(name, **RECURRENT).fits.items() if "knowing" in made.names}
    assert teachers("ppo") == {"actor"} and teachers("sac") == {"critic"}


@pytest.mark.slow
def test_critics_do_not_move_the_policy():
    """Over all updates of a rollout ratios stay 1 while the actor hardly learns, though critics learn fast."""
    agent = tiny("ppo", epochs=3, minibatches=2, actor_lr=1e-9, critic_lr=1e-2, **RECURRENT)
    agent = Ratios(**{field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)})
    _, history = train(Walk(episode_length=7), agent, {"num_envs": 4, "unroll": 5, "chunk_steps": 60})
    assert history[0]["ratio"].max() < 1e-4


@pytest.mark.slow
def test_values_at_the_end_of_a_window_know_the_last_step():
    """What follows a step is judged with the state after it, also if memory begins anew there. It knows of no end."""
    agent = tiny("ppo", unroll=LENGTH, gae_lambda=0.0, advantage_normalization="none", **RECURRENT)
    agent = dataclasses.replace(agent, value_normalization="none", normalize_observations=False)
    state, steps = agent.init(SPEC, TASKS, KEY), rollout()
    critic = state.nets["critic"]
    wide = critic._replace(shared=critic.shared | {"head": jax.tree.map(lambda x: 1e3 * x, critic.shared["head"])})
    state = state._replace(nets=state.nets | {"critic": wide})
    _, found = agent.assess(state, steps, TASKS)
    nets, knowing = of_task(state.nets, 0), agent.conditioning
    for world in range(ENVS):
        hidden = steps.memory.hidden[0, 0, world]
        for t in range(LENGTH):
            step = pick(steps, (0, t, world))
            after = knowing.remember(nets["knowing"].parts, hidden, step._replace(ended=jnp.bool_(False)))
            value = lambda obs, features: agent.critic.apply(nets["critic"], features, obs)[0]
            error = step.reward + agent.gamma * value(step.next_obs, after) - value(step.obs, hidden)
            assert float(found.extras.advantage[0, t, world]) == pytest.approx(float(error), rel=1e-3, abs=1e-2)
            hidden = jnp.where(step.ended, knowing.begin(3, 2), after)


@pytest.mark.slow
def test_sac_learns_from_windows_that_begin_with_the_stored_state():
    """All steps of a window count, and another stored state gives other losses."""
    agent = tiny("sac", recurrent_steps=4, **RECURRENT)
    state = agent.init(SPEC, TASKS, KEY)
    steps = jax.tree.map(lambda x: jnp.swapaxes(x, 1, 2)[:, :, :4], rollout()._replace(extras=None))  # (T, B, L, ...)
    batch = replay_batches.prepare(agent, state, steps, TASKS)
    assert batch.reward.shape == (3, ENVS * 4)
    np.testing.assert_array_equal(batch.obs.past.state, steps.memory.hidden[:, :, 0])
    update = jax.jit(lambda steps: agent.update(state, steps, TASKS, KEY, jnp.int32(0))[1]["critic_loss"])
    other = steps._replace(memory=Memory(None, steps.memory.hidden + 1.0))
    later = steps._replace(memory=Memory(None, steps.memory.hidden.at[:, :, 1:].add(1.0)))
    assert not np.allclose(update(steps), update(other)) and np.allclose(update(steps), update(later))


# Burn-in.

BURN, LEARNED = 2, 4
WAYS = {
    "recurrent": RECURRENT,
    **{x: {"conditioning": "posterior", "inference": x, "recurrent_size": SIZE} for x in ("varibad", "pearl", "cadm")},
}


def burning(way):
    """An agent with burn-in and one without, and windows (T, B, BURN + LEARNED, ...) with random memories."""
    agent, plain = (tiny("sac", recurrent_steps=LEARNED, burn_in=n, **WAYS[way]) for n in (BURN, 0))
    steps = jax.tree.map(lambda x: jnp.swapaxes(x, 1, 2), rollout()._replace(extras=None, memory=None))
    blank = agent.conditioning.begin(3, 2)
    hidden = np.random.default_rng(1).random((*steps.reward.shape, *blank.shape))
    closed = steps.closed.at[:, 0, 0].set(True)  # some trials end inside burn-in, others do not
    memory = Memory(None, jnp.float32(hidden))
    return agent, plain, steps._replace(ended=closed, closed=closed, cut=closed, memory=memory)


def burned(agent, params, windows):
    """The memories (T, B, ...) after burn-in, step by step as acting has them."""
    knowing = agent.conditioning
    one = jax.jit(jax.vmap(jax.vmap(lambda hidden, step: knowing.remember(params, hidden, step))))
    hidden, blank = windows.memory.hidden[:, :, 0], knowing.begin(3, 2)
    for t in range(BURN):
        step = jax.tree.map(lambda x, t=t: x[:, :, t], windows._replace(memory=None))
        closed = step.closed.reshape(*step.closed.shape, *[1] * blank.ndim)
        hidden = jnp.where(closed, blank, one(hidden, step))
    return hidden


def rest_of(windows, hidden):
    """The steps after burn-in, which begin with these memories (T, B, ...)."""
    rest = jax.tree.map(lambda x: x[:, :, BURN:], windows)
    return rest._replace(memory=Memory(None, rest.memory.hidden.at[:, :, 0].set(hidden)))


@pytest.mark.parametrize("way", slow_but(WAYS, "recurrent"))
@pytest.mark.slow
def test_after_burn_in_steps_are_learned_from_with_the_memory_of_present_parameters(way):
    """Loss and gradient are those of the same steps without burn-in, if they begin with that memory."""
    agent, plain, windows = burning(way)
    assert np.any(windows.closed[:, :, :BURN]) and not np.all(np.any(windows.closed[:, :, :BURN], axis=2))
    state = agent.init(SPEC, TASKS, KEY)
    nets = of_task(state.nets, 0)
    rest = rest_of(windows, burned(agent, nets["knowing"].parts, windows))

    def learn(agent, windows):
        batch = agent.view.keyed(replay_batches.prepare(agent, state, windows, TASKS), KEY)
        batch, target = replay_batches.critic_data(agent, state, batch, KEY)
        one, of_one = jax.tree.map(lambda x: x[0], (batch, target))
        loss = lambda nets: (agent.critic_loss(nets, one, of_one)[0], agent.actor_loss(nets, one, KEY)[0])
        return loss(nets), jax.grad(lambda nets: sum(loss(nets)))(nets)

    with_burn_in, without = (quick(partial(learn, a), w) for a, w in ((agent, windows), (plain, rest)))
    found, expected = with_burn_in(windows), without(rest)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5), found, expected)
    assert any(np.any(np.asarray(x) != 0) for x in jax.tree.leaves(found[1]["knowing"]))
    if way != "cadm":  # whose memory is of steps alone
        stale = without(rest_of(windows, windows.memory.hidden[:, :, BURN]))
        assert not np.allclose(found[0][0], stale[0][0])


def test_targets_burn_in_with_slow_parameters():
    """What slow networks see is their own memory after burn-in."""
    agent, plain, windows = burning("recurrent")
    state = agent.init(SPEC, TASKS, KEY)
    slow = jax.tree.map(lambda x: 0.5 * x, state.nets["knowing"].shared)
    rest = rest_of(windows, burned(agent, slow, windows))
    seen = [replay_batches.prepare(a, state, w, TASKS).next_obs for a, w in ((agent, windows), (plain, rest))]
    features = lambda way, seen: jax.vmap(lambda seen: way.features(slow, jnp.zeros(0), seen))(seen)
    found, expected = (features(a.conditioning, x) for a, x in zip((agent, plain), seen, strict=True))
    assert found.shape == (3, ENVS * LEARNED, SIZE)
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_without_burn_in_a_track_stays_as_it_is():
    track = Track(*[jnp.zeros(1)] * 7)
    assert Recurrent().burned_in({}, track) is track


def test_a_ring_holds_a_whole_window():
    """Burn-in counts; with fewer slots a window would wrap around in time."""
    agent = tiny("sac", conditioning="recurrent", recurrent_steps=4, burn_in=2, replay_size=50, warmup_steps=10)
    assert agent.unroll == 6
    with pytest.raises(InputError, match=r"replay-size \(50\) must hold 6 steps of num-envs \(10\)"):
        mtjax.train(Walk(), agent, num_envs=10, steps=400, quiet=True)


@pytest.mark.usefixtures("optimised")
@pytest.mark.slow
def test_a_memory_explores_as_well_as_can_be():
    """Ten pulls of two arms that every trial draws: within 3% of the best strategy, which earns 6.02; told 6.67."""
    pulls, trials = 10, 2000
    given = dict(unroll=pulls, minibatches=4, gamma=1.0, actor_lr=1e-3, entropy_cost=0.01)
    agent, steps = mtjax.agent("rl2", hidden=(32, 32), recurrent_size=32, **given), 300 * 256 * pulls
    plan = dict(steps=steps, eval_every=steps, eval_episodes=trials * pulls, chunk_steps=100 * pulls)
    result = mtjax.train(mtjax.make("hidden-bandit"), agent, trials=pulls, num_envs=256, quiet=True, **plan)
    found = result.evaluations.returns["train"][0, -1, 0].reshape(trials, pulls).sum(axis=1).mean()
    assert found > 0.97 * exact.bandit(2, pulls)


@pytest.mark.slow
def test_a_run_with_a_recurrent_memory_stays_finite():
    """With a replay, and as many steps as a window before the first update."""
    given = {"num_envs": 2, "batch_size": 4, "replay_size": 60, "warmup_steps": 4, "chunk_steps": 16}
    _, (metrics,) = train(Walk(), tiny("sac", recurrent_steps=4, **RECURRENT), given, seeds=(0, 1))
    assert np.all(metrics["bad_step"] == -1) and np.all(np.isfinite(metrics["critic_loss"]))


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("sac", {"n_step": 3, "warmup_steps": 50}, "needs n-step=1"),
        ("sac", {"hindsight": 0.5, "warmup_steps": 50}, "hindsight=0"),
        ("sac", {"warmup_steps": 3, "recurrent_steps": 5}, "warmup-steps of at least 4, not 3"),
        ("sac", {"warmup_steps": 8, "recurrent_steps": 5, "burn_in": 5}, "after burn-in=5 .* of at least 9, not 8"),
        ("sac", {"burn_in": -1}, "burn-in must be at least 0"),
        ("ppo", {"burn_in": 4}, "burn-in=4 renews memories that a replay has stored, and PPO learns from rollouts"),
        ("hip-bmdp", {"unseen_theta": "inferred"}, "two memories of an episode"),
        ("ppo", {"recurrent_size": 0}, "recurrent-size must be at least 1"),
    ],
)
def test_what_a_memory_cannot_do_is_refused(name, settings, message):
    with pytest.raises(InputError, match=message):
        agents.agent(name, conditioning="recurrent", **settings)


def test_without_a_memory_there_is_nothing_to_burn_in():
    with pytest.raises(InputError, match="unknown setting of sac 'burn_in'; it belongs to conditioning='recurrent'"):
        agents.agent("sac", burn_in=4)
