"""A belief about a hidden task: what it is by hand, what it learns by, which losses reach it, and when it is new."""

import dataclasses
from functools import partial
from typing import NamedTuple

import exact
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import Walk, learn, of_task, only_seed, pick, quick, slow_but, tasks_of, tiny, train
from test_recurrent import Ratios

import mtjax
from mtjax import agents
from mtjax.agents import for_action
from mtjax.agents.base import Memory
from mtjax.agents.parts.knowing.inference import Belief, change, divergence, factor, product, unit
from mtjax.agents.parts.knowing.posterior import Posterior
from mtjax.agents.parts.knowing.recurrent import Following, Hidden, Track
from mtjax.agents.parts.policies import Taken
from mtjax.experience import rollouts
from mtjax.types import Discrete, InputError, Spec, Transition

WAYS = ["varibad", "pearl", "cadm"]
B, L, OBS, ACTION, Z = 2, 6, 3, 2, 4
KEY = jax.random.key(3)
SMALL = {"latent_size": Z, "recurrent_size": 5, "inferred_from": 3, "inference_widths": (8,)}
knowing = lambda way, **given: Posterior(inference=way, **{**SMALL, **given})
posterior = lambda way, **given: {"conditioning": "posterior", "inference": way, **SMALL, **given}


class Shown(NamedTuple):
    """What networks take, with nothing but the past."""

    past: object
    obs: object = None


def params_of(made, obs=OBS, action=ACTION):
    """Random parameters, none of them 0, as biases begin."""
    blank = Transition(jnp.zeros(obs), None, None, None, None)  # type: ignore
    params = made.init(1, blank, jnp.zeros(action), False, KEY).shared
    random = np.random.default_rng(0)
    return jax.tree.map(lambda x: x + 0.1 * np.float32(random.normal(size=x.shape)), params)


def track_of(made, seed=0):
    """Windows of random steps: the first window's trial of two episodes ends at its third step, with another's start.

    What follows the last step of an episode inside a trial is far away.
    """
    random = np.random.default_rng(seed)
    normal = lambda *shape: np.float32(random.normal(size=(B, L, *shape)))
    ended, closed = np.zeros((B, L), bool), np.zeros((B, L), bool)
    ended[0, [0, 2]] = ended[1, 4] = closed[0, 2] = True
    obs, next_obs = normal(OBS), normal(OBS)
    next_obs[ended & ~closed] = 1e3
    flat = lambda x: jnp.asarray(x.reshape(-1, *x.shape[2:]))
    state = jnp.asarray(random.random((B, *made.begin(OBS, ACTION).shape)), jnp.float32)
    return Track(state, *map(flat, (obs, normal(ACTION), normal(), ended, closed, closed, next_obs)), key=KEY)


# By hand.


def test_the_divergence_of_gaussians_by_hand():
    """That of N(1, 4) from N(0, 1) is (4 + 1 - 1 - log 4) / 2; one from itself has none; entries add up."""
    prior, other = unit(Belief(jnp.ones(1), jnp.ones(1))), Belief(jnp.ones(1), jnp.log(4.0)[None])
    assert float(divergence(other, prior)) == pytest.approx((4 + 1 - 1 - np.log(4)) / 2, rel=1e-6)
    assert float(divergence(prior, other)) == pytest.approx(((1 + 1) / 4 - 1 + np.log(4)) / 2, rel=1e-6)
    assert float(divergence(other, other)) == 0
    both = Belief(jnp.array([1.0, 0.0]), jnp.array([np.log(4.0), 0.0], jnp.float32))
    assert float(divergence(both, unit(both))) == pytest.approx(float(divergence(other, prior)), rel=1e-6)


def test_a_product_of_gaussians_is_ridge_regression():
    """Of r = m a + noise: a step says N(r / a, s^2 / a^2) of m, and nothing where a = 0."""
    random, deviation = np.random.default_rng(0), 0.3
    a = np.concatenate([random.normal(size=9), [0.0]])
    r = 0.7 * a + deviation * random.normal(size=10)
    told = factor(jnp.float32(r / np.where(a, a, 1))[:, None], jnp.float32(a**2 / deviation**2)[:, None])
    found = product(jnp.sum(told, axis=0))
    precision = a @ a / deviation**2 + 1
    np.testing.assert_allclose(found.mean, [a @ r / deviation**2 / precision], rtol=1e-5)
    np.testing.assert_allclose(np.exp(found.log_var), [1 / precision], rtol=1e-5)


def drawn(env, count, key):
    """As many tasks, drawn from those that trials draw."""
    draws = jax.tree.map(lambda x: x[0], env.tasks().draws)
    return jax.tree.map(lambda x: x[jax.random.randint(key, (count,), 0, len(x))], draws)


def pulls(count, length, seed):
    """Arms, one-hot (N, H, 2), and rewards (N, H) of random pulls in the family's own tasks; and these (N, 2)."""
    env = mtjax.make("hidden-bandit", num_draws=1000)
    task_key, arm_key, pull_key = jax.random.split(jax.random.key(seed), 3)
    tasks = drawn(env, count, task_key)
    arms = jax.random.randint(arm_key, (count, length), 0, 2)
    keys = jax.random.split(pull_key, (count, length))
    pull = lambda task, arm, key: env.step(task, env.reset(task, key).state, arm).reward
    reward = jax.jit(jax.vmap(jax.vmap(pull, (None, 0, 0))))(tasks, arms, keys)
    return jax.nn.one_hot(arms, 2), reward, tasks.goal["task"]


def laplace(arms, reward):
    """The chances (N, H, 2) of both arms after each pull, the means of Beta(1 + s, 1 + n - s)."""
    n, s = (np.cumsum(np.asarray(x), axis=1) for x in (arms, arms * reward[..., None]))
    return (1 + s) / (2 + n)


def test_a_product_of_gaussians_is_the_posterior_of_a_bandit():
    """If a pull says N(+-1, 2) of its arm's 2 p - 1, and nothing of the other's."""
    arms, reward, _ = pulls(50, 12, 0)
    told = factor(jnp.broadcast_to(2 * reward[..., None] - 1, arms.shape), arms / 2)
    found = product(jnp.cumsum(told, axis=1))
    np.testing.assert_allclose((found.mean + 1) / 2, laplace(arms, reward), rtol=1e-5)


@pytest.mark.slow
def test_what_a_critic_teaches_a_product_of_gaussians_is_a_bandits_posterior():
    """Factors learn to tell the chances by their product's mean, so that each tells of the pulled arm alone."""
    made, length, steps = knowing("pearl", latent_size=2, inference_widths=(16,)), 5, 600
    arms, reward, chances = pulls(2048, length, 1)
    flat = lambda x: x.reshape(-1, *x.shape[2:])

    def beliefs(params, arms, reward):
        count = len(arms)
        nothing, no = jnp.zeros((count * length, 1)), jnp.zeros(count * length, bool)
        track = Track(jnp.zeros((count, 2, 2)), nothing, flat(arms), flat(reward), no, no, no, nothing)
        told = made.read(params, track).reshape(count, length, 2, 2)
        return (product(jnp.cumsum(told, axis=1)).mean + 1) / 2

    def fit(params):
        optimizer = optax.adam(optax.cosine_decay_schedule(1e-2, steps))

        def step(carry, start):
            params, memory = carry
            batch = [jax.lax.dynamic_slice_in_dim(x, start, 64) for x in (arms, reward, chances)]
            error = lambda params: jnp.mean(jnp.square(beliefs(params, *batch[:2]) - batch[2][:, None]))
            moved, memory = optimizer.update(jax.grad(error)(params), memory)
            return (optax.apply_updates(params, moved), memory), None

        starts = jnp.arange(steps) * 64 % 2048
        return jax.lax.scan(step, (params, optimizer.init(params)), starts)[0][0]

    params = params_of(made, 1, 2)
    params = quick(fit, params)(params)
    arms, reward, _ = pulls(500, length, 2)
    error = np.asarray(beliefs(params, arms, reward)) - laplace(arms, reward)
    assert np.sqrt(np.mean(error**2)) < 0.02 and np.abs(error).max() < 0.1


def trials(made, episode, steps, key=KEY):
    """The track of trials of episodes of so many steps, whose (s, a, r, s') are (N, L, ...)."""
    count, length = steps[2].shape
    ends = lambda every: jnp.arange(count * length) % every == every - 1
    obs, action, reward, next_obs = (x.reshape(-1, *x.shape[2:]) for x in steps)
    state = jnp.zeros((count, made.recurrent_size))
    return Track(state, obs, action, reward, ends(episode), ends(length), ends(length), next_obs, key)


def taught(made, episode, steps, rate, updates, batch):
    """Parameters that learned by a belief's own losses from such trials, as many at a time as ``batch`` says."""
    optimizer = optax.adam(optax.cosine_decay_schedule(rate, updates))
    params = params_of(made, steps[0].shape[-1], steps[1].shape[-1])

    def update(carry, i):
        params, memory = carry
        some = [jax.lax.dynamic_slice_in_dim(x, i * batch % len(x), batch) for x in steps]
        seen = Shown(trials(made, episode, some, jax.random.fold_in(KEY, i)))
        moved, memory = optimizer.update(jax.grad(lambda p: made.join(0.0, {}, p, seen)[0])(params), memory)
        return (optax.apply_updates(params, moved), memory), None

    fit = lambda params: jax.lax.scan(update, (params, optimizer.init(params)), jnp.arange(updates))[0][0]
    return jax.jit(fit, compiler_options={"xla_backend_optimization_level": 1})(params)


def foreteller(made, params, track):
    """A function of steps (N L, ...): the rewards (N, L) that are predicted of them after each step of trials."""
    belief = made.way.belief(params, made.over(params, track)[1])
    predict = jax.jit(lambda steps: made.way.foretell(params, steps, belief, KEY)["reward"][0])
    return lambda steps: np.asarray(predict(steps)).reshape(len(track.state), -1)


@pytest.mark.slow
def test_varibad_learns_how_often_the_arms_of_a_bandit_pay():
    """What its belief predicts is nearer to what can be known than half of how much that varies.

    It is not equal to it: a belief predicts past steps too, which it knows, and so leans towards what has happened.
    """
    made, length = knowing("varibad", recurrent_size=32, inference_widths=(32, 32), decoded_steps=8), 8

    def steps_of(arms, reward):
        nothing = jnp.zeros((*reward.shape, 1))
        return nothing, arms, reward, nothing

    params = taught(made, 1, steps_of(*pulls(2048, length, 1)[:2]), rate=3e-3, updates=1000, batch=64)
    arms, reward, _ = pulls(500, length, 2)
    track = trials(made, 1, steps_of(arms, reward))
    foretell = foreteller(made, params, track)
    pulled = lambda arm: track._replace(action=jnp.broadcast_to(jnp.eye(2)[arm], (500 * length, 2)))
    found, expected = np.stack([foretell(pulled(arm)) for arm in (0, 1)], axis=-1), laplace(arms, reward)
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.5 * np.std(expected)


def walks(env, count, seed):
    """The steps (s, a, r, s'), each (N, 2 H, ...), of random walks through trials of two episodes; and goals (N,)."""
    task_key, move_key = jax.random.split(jax.random.key(seed))
    tasks = drawn(env, count, task_key)
    moves = jax.random.randint(move_key, (count, 2, env.steps), 0, env.action_size)
    moves = jnp.repeat(moves, 2, axis=-1)[..., : env.steps]  # each twice, which leads further

    def walk(task, moves):
        def step(before, move):
            after = env.step(task, before.state, move)
            return after, (before.obs, jax.nn.one_hot(move, env.action_size), after.reward, after.obs)

        return jax.lax.scan(step, env.reset(task, KEY), moves)[1]

    steps = jax.jit(jax.vmap(jax.vmap(walk, (None, 0))))(tasks, moves)
    places = np.int32(tasks.goal["task"]) @ [env.size, 1]
    return [x.reshape(count, 2 * env.steps, *x.shape[3:]) for x in steps], places


def chances_of_goals(cells, possible, goals):
    """The chances (N, L, M) of cells to be the goal after each step to cells (N, L, M), and whether (N, L) it is met.

    It is the same for all possible cells (M,) where the walker has not been, and 1 for the goal once it is met.
    """
    visited, goal = np.cumsum(cells, axis=1) > 0, np.eye(len(possible))[goals][:, None]
    left, met = possible & ~visited, np.any(visited & (goal > 0), axis=-1)
    return np.where(met[..., None], goal, left / np.maximum(left.sum(axis=-1, keepdims=True), 1)), met


@pytest.mark.nightly
def test_varibad_learns_where_the_goal_of_a_grid_can_be():
    """What is predicted of arriving in a cell is 1.1 P - 0.1, P being its chance to be the goal.

    Walks know nothing of goals, so that where they lead tells nothing. Beliefs are asked about later steps of their
    trials to cells that goals are drawn from. One that learned nothing, P = 1/5, is off by 0.07 before the goal is met.
    """
    settings = {"recurrent_size": 32, "inference_widths": (32, 32), "decoded_steps": 6, "kl_coefficient": 1e-3}
    made, env = knowing("varibad", latent_size=5, **settings), mtjax.make("grid-navi", size=3, steps=6)
    params = taught(made, env.steps, walks(env, 4096, 1)[0], rate=5e-3, updates=4000, batch=32)
    steps, goals = walks(env, 300, 2)
    track, length = trials(made, env.steps, steps), 2 * env.steps
    by_trial = lambda x, j: jnp.repeat(x.reshape(300, length, *x.shape[1:])[:, j], length, axis=0)
    asked = lambda j: jax.tree.map(lambda x: by_trial(x, j), track._replace(state=None, key=None))
    foretell = foreteller(made, params, track)
    found = (np.stack([foretell(asked(j)) for j in range(length)], axis=-1) + 0.1) / 1.1  # (N, L, L)

    cells, possible = np.asarray(steps[3]), np.isin(np.arange(env.size**2), env.pool() @ [env.size, 1])
    chances, met = chances_of_goals(cells, possible, goals)
    expected = np.einsum("ntm,njm->ntj", chances, cells)
    used = np.triu(np.ones((length, length), bool), 1) & (cells @ possible > 0)[:, None]
    assert np.abs(found - expected)[used & ~met[..., None]].mean() < 0.04
    at_goal = used & met[..., None] & (expected == 1)
    later = at_goal & (np.arange(length) >= env.steps)
    assert found[at_goal].mean() > 0.9 and found[later].mean() > 0.9


# Over a window.


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.slow
def test_beliefs_over_a_window_are_those_of_steps_one_by_one(way):
    """Anew after the end of a trial, and not of an episode, at which nothing is known of what follows.

    After a step that cuts sums off the belief is that of going on.
    """
    made = knowing(way)
    params, track = params_of(made), track_of(made)
    before, after = quick(made.over, params, track)(params, track)
    rows = track._replace(state=None, key=None)
    one = jax.jit(lambda memory, step: made.remember(params, memory, step))
    for window in range(B):
        memory = track.state[window]
        for t in range(L):
            step = jax.tree.map(lambda x, i=window * L + t: x[i], rows)
            np.testing.assert_allclose(before[window * L + t], memory, rtol=1e-5, atol=1e-5)
            following = one(memory, step._replace(ended=step.ended & ~step.cut))
            np.testing.assert_allclose(after[window * L + t], following, rtol=1e-5, atol=1e-5)
            memory = made.begin(OBS, ACTION) if step.closed else one(memory, step)
    features = lambda past: made.features(params, jnp.zeros(0), Shown(past))
    np.testing.assert_array_equal(features(track), made.show(params, before))
    np.testing.assert_array_equal(features(Following(*track)), made.show(params, after))
    begun = features(Hidden(made.begin(OBS, ACTION)))
    assert begun.shape == ((Z,) if way == "cadm" else (2 * Z,))
    assert way == "cadm" or not np.any(begun)  # a trial begins with the prior N(0, 1)


def test_the_order_of_steps_tells_pearl_nothing():
    made = knowing("pearl")
    params, track = params_of(made), track_of(made)
    track = track._replace(**dict.fromkeys(("closed", "cut"), jnp.zeros(B * L, bool)))
    turned = jax.tree.map(lambda x: x.reshape(B, L, *x.shape[1:])[:, ::-1].reshape(x.shape), track[1:8])
    last = lambda track: made.over(params, track)[1].reshape(B, L, 2, Z)[:, -1]
    np.testing.assert_allclose(
        last(track), last(track._replace(**dict(zip(track._fields[1:8], turned, strict=True)))), rtol=1e-5
    )


def trial_of(track):
    """The number (B, L) of each step's trial."""
    closed = np.asarray(track.closed).reshape(B, L)
    return np.cumsum(closed, axis=1) - closed


@pytest.mark.slow
def test_varibads_losses_by_hand():
    """Every belief predicts all steps of its trial, and parts from the one before it."""
    made = knowing("varibad", decoded_steps=99, state_coefficient=0.5, kl_coefficient=0.3)
    params, track, way = params_of(made), track_of(made), made.way
    loss, metrics = made.join(jnp.float32(7), {}, params, Shown(track))
    before, after = made.over(params, track)
    now, then = (way.belief(params, x) for x in (after, before))
    drawn = now.draw(jax.random.split(KEY)[1])
    rows, trial, within = track._replace(state=None, key=None), trial_of(track), ~np.asarray(track.ended)
    decoding, parted = [], []
    for i, t in np.ndindex(B, L):
        errors, z = [], drawn[i * L + t]
        for j in np.flatnonzero(trial[i] == trial[i, t]):
            step = jax.tree.map(lambda x, k=i * L + j: x[k], rows)
            error = float(way.rewards(params, step, z) - step.reward) ** 2
            moved = float(jnp.mean(jnp.square(way.changes(params, step, z) - (step.next_obs - step.obs))))
            errors.append(error + 0.5 * moved * within[i * L + j])
        decoding.append(np.mean(errors))
        ours, last = (jax.tree.map(lambda x, k=i * L + t: x[k], belief) for belief in (now, then))
        parted.append(0.3 * float(divergence(ours, last)) / len(errors))
    assert float(metrics["decoding_loss"]) == pytest.approx(np.mean(decoding), rel=1e-4)
    assert float(metrics["divergence_loss"]) == pytest.approx(np.mean(parted), rel=1e-4)
    assert float(loss) == pytest.approx(7 + np.mean(decoding) + np.mean(parted), rel=1e-4)


@pytest.mark.slow
def test_some_steps_stand_for_all_of_a_trial():
    """The loss of two steps that are drawn is that of all six on average, also where the trial has fewer."""
    whole, some = (knowing("varibad", decoded_steps=count, kl_coefficient=0.0) for count in (6, 2))
    params, track = params_of(whole), track_of(whole)
    params["belief"] = jax.tree.map(jnp.zeros_like, params["belief"])  # so that every z is drawn from N(0, 1)
    loss = lambda made, key: made.join(jnp.float32(0), {}, params, Shown(track._replace(key=key)))[0]
    keys = jax.random.split(KEY, 3000)
    every, few = (np.asarray(jax.jit(jax.vmap(lambda key, made=made: loss(made, key)))(keys)) for made in (whole, some))
    assert every.mean() == pytest.approx(few.mean(), abs=4 * few.std() / np.sqrt(3000))


@pytest.mark.slow
def test_cadms_losses_by_hand():
    """Every context predicts the next steps of its window and trial, forward and backward."""
    made = knowing("cadm", decoded_steps=2, backward_coefficient=0.7)
    params, track, way = params_of(made), track_of(made), made.way
    loss, metrics = made.join(jnp.float32(0), {}, params, Shown(track))
    context = way.context(params, made.over(params, track)[0])
    trial, within, model = trial_of(track), ~np.asarray(track.ended), way.dense(OBS)
    forward, backward = [], []
    for i, t in np.ndindex(B, L):
        for j in range(t, min(t + 2, L)):
            k = i * L + j
            if trial[i, j] != trial[i, t] or not within[k]:
                continue
            s, a, after = track.obs[k], track.action[k], track.next_obs[k]
            predict = lambda name, start, a=a, z=context[i * L + t]: model.apply(params[name], start, a, z)
            forward.append(float(jnp.mean(jnp.square(predict("forward", s) - (after - s)))))
            backward.append(float(jnp.mean(jnp.square(predict("backward", after) - (s - after)))))
    assert float(metrics["forward_loss"]) == pytest.approx(np.mean(forward), rel=1e-4)
    assert float(metrics["backward_loss"]) == pytest.approx(0.7 * np.mean(backward), rel=1e-4)
    assert float(loss) == pytest.approx(np.mean(forward) + 0.7 * np.mean(backward), rel=1e-4)


def test_what_follows_an_episode_is_no_change():
    track = track_of(knowing("pearl"))
    moved = np.asarray(change(track))
    ended = np.asarray(track.ended)
    assert not moved[ended].any() and np.all(np.abs(moved) < 100) and np.all(moved[~ended] != 0)


# Which losses reach it.

SPEC_OF_ROLLOUT, LENGTH, ENVS = Spec.vector(OBS, ACTION, 1), 6, 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))


def rollout(agent, lead=(LENGTH, ENVS)):
    """Rollouts (T, *lead, ...) in which every field is random."""
    random, shape = np.random.default_rng(0), (3, *lead)
    normal = lambda *size: jnp.float32(random.normal(size=(*shape, *size)))
    raw, ended, begun = normal(ACTION), jnp.asarray(random.random(shape) < 0.3), agent.conditioning.begin(OBS, ACTION)
    hidden = jnp.float32(random.random((*shape, *begun.shape)))
    steps = Transition(normal(OBS), jnp.tanh(raw), normal(), jnp.ones(shape), normal(OBS), ended, ended, ended)
    return steps._replace(extras=Taken(raw, normal() - 2), memory=Memory(None, hidden))


def batch_of(agent):
    """A batch of one task of PPO, with a key, and that task's networks."""
    state = agent.init(SPEC_OF_ROLLOUT, TASKS, KEY)
    state, steps = agent.assess(state, rollout(agent), TASKS)
    state, batch = agent.prepare(state, rollouts.windows(steps, agent.unroll), TASKS)
    one = pick(batch._replace(mask=None), 0)
    return of_task(state.nets, 0), one._replace(obs=one.obs._replace(past=one.obs.past._replace(key=KEY)))


def zero(tree):
    return [not np.any(np.asarray(x)) for x in jax.tree.leaves(tree)]


@pytest.mark.slow
@pytest.mark.parametrize("way", slow_but(WAYS, "varibad"))
def test_losses_reach_what_infers_the_task_where_they_may(way):
    """In PPO: no loss of the actor; the critic's in pearl alone; and its own reaches all of it."""
    agent = tiny("ppo", unroll=LENGTH, epochs=1, minibatches=1, **posterior(way))
    nets, batch = batch_of(agent)
    plain = dataclasses.replace(agent, conditioning=knowing(way, kl_coefficient=0.0))
    slope = lambda loss: jax.jit(jax.grad(loss))(nets)["knowing"]
    of_actor = slope(lambda nets: agent.actor_loss(nets, batch, KEY)[0])
    of_critic = slope(lambda nets: agent.fitting_loss(agent.output(nets, batch.features, batch.obs), batch))
    of_all = slope(lambda nets: agent.critic_loss(nets, batch)[0])
    assert agent.fits["actor"].names == ("actor",) and "knowing" in agent.fits["critic"].names
    assert not any(zero(of_all))
    if way == "pearl":
        own = slope(lambda nets: plain.critic_loss(nets, batch)[0])
        assert not any(zero(of_critic)) and jax.tree.all(jax.tree.map(np.allclose, own, of_critic))
    else:
        assert all(zero(of_actor)) and all(zero(of_critic))


@pytest.mark.parametrize("way", slow_but(WAYS, "pearl"))
@pytest.mark.slow
def test_in_sac_the_actors_loss_does_not_train_it(way):
    """An update moves all of it, and the slow copy of it follows."""
    agent = tiny("sac", recurrent_steps=4, **posterior(way))
    assert "knowing" not in agent.fits["actor"].names
    state, steps = agent.init(SPEC_OF_ROLLOUT, TASKS, KEY), rollout(agent, (ENVS, 4))._replace(extras=None)
    update = jax.jit(lambda state: agent.update(state, steps, TASKS, KEY, jnp.int32(0)))
    after, metrics = update(state)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((after.nets, metrics)))
    for nets in ("nets", "slow"):
        new, old = (getattr(x, nets)["knowing"] for x in (after, state))
        assert not any(zero(jax.tree.map(lambda x, y: x - y, new, old))), nets


@pytest.mark.slow
@pytest.mark.parametrize("name", ["impala", "pqn"])
def test_other_agents_that_learn_from_rollouts_train_it_too(name):
    """All of it, by one update."""
    agent = tiny(name, unroll=LENGTH, epochs=1, minibatches=1, **posterior("varibad"))
    spec = Spec.vector(OBS, ACTION, 1)
    steps = rollout(agent)
    if name == "pqn":
        spec = spec._replace(action=Discrete(ACTION))
        agent = for_action(agent, spec.action)
        choice = jnp.int32(steps.reward > 0)
        steps = steps._replace(action=choice, extras=Taken(choice, steps.reward))
    state = agent.init(spec, TASKS, KEY)
    after, metrics = quick(partial(learn, agent), state, steps, TASKS, KEY)(state, steps, TASKS, KEY)
    assert np.all(np.isfinite(metrics["decoding_loss"])) and np.all(np.isfinite(metrics["divergence_loss"]))
    new, old = (x.nets["knowing"] for x in (after, state))
    assert not any(zero(jax.tree.map(lambda x, y: x - y, new, old)))


# Through trials.


@pytest.mark.slow
@pytest.mark.parametrize("way", [WAYS[0], *(pytest.param(way, marks=pytest.mark.slow) for way in WAYS[1:])])
def test_the_policy_that_learns_is_the_one_that_played(way):
    """What a window tells is what its actions were drawn with, through the episodes of trials: ratios begin at 1."""
    agent = tiny("ppo", epochs=1, minibatches=1, **posterior(way))
    agent = Ratios(**{field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)})
    given = {"num_envs": 4, "unroll": 7, "chunk_steps": 35, "trials": 2}
    _, history = train(Walk(episode_length=4), agent, given)
    assert history[0]["ratio"].max() < 1e-4 and np.all(history[0]["bad_step"] == -1)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_what_is_inferred_changes_between_rollouts_alone(way):
    """In all updates of a rollout the policy sees what was inferred when it was played: while an actor hardly learns,
    ratios stay 1. What infers learns meanwhile, and is seen with the next rollout."""
    agent = tiny("ppo", epochs=3, minibatches=2, actor_lr=1e-9, critic_lr=1e-2, **posterior(way))
    agent = Ratios(**{field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)})
    state, history = train(Walk(episode_length=4), agent, {"num_envs": 4, "unroll": 7, "chunk_steps": 35, "trials": 2})
    nets = only_seed(state.agent).nets
    assert history[0]["ratio"].max() < 1e-4
    assert jax.tree.all(jax.tree.map(np.array_equal, nets["belief"], nets["knowing"]))


@pytest.mark.slow
def test_memory_lives_through_a_trial_and_is_new_after_it():
    """PEARL's sums, as a replay stores them: 0 where a trial begins, else what the step before has added to them."""
    agent = tiny("sac", recurrent_steps=4, **posterior("pearl"))
    given = {
        "num_envs": 4,
        "updates_per_step": 0,
        "replay_size": 160,
        "warmup_steps": 4,
        "chunk_steps": 30,
        "trials": 3,
    }
    state, _ = train(Walk(episode_length=4), agent, given)
    rows = only_seed(jax.tree.map(lambda x: np.moveaxis(np.asarray(x)[:, :, :30], 2, 3), state.data.ring.rows))
    params, knowing = only_seed(state.agent).nets["knowing"].shared, agent.conditioning
    flat = rows._replace(ended=jnp.asarray(rows.ended), memory=None)
    after = rows.memory.hidden + np.asarray(knowing.read(params, flat))
    closed = np.asarray(rows.closed)
    expected = np.where(closed[..., None, None], 0, after)[:, :, :-1]
    np.testing.assert_allclose(rows.memory.hidden[:, :, 1:], expected, rtol=1e-4, atol=1e-4)
    assert 0 < closed.sum() < np.asarray(rows.ended).sum() / 2


@pytest.mark.usefixtures("optimised")
@pytest.mark.nightly  # a minute and more each
@pytest.mark.parametrize(("way", "num_envs", "rollouts"), [("varibad", 256, 300), ("pearl", 1024, 240)])
def test_a_belief_explores_as_well_as_can_be(way, num_envs, rollouts):
    """Ten pulls of two arms that every trial draws: within 3% of the best strategy, which earns 6.02; told 6.67.

    In the last two evaluations of 2,000 trials each, whose mean is sure to .03.
    """
    pulls, trials = 10, 2000
    known = {"conditioning": "posterior", "inference": way, "recurrent_size": 32, "inference_widths": (32, 32)}
    given = dict(unroll=pulls, minibatches=4, gamma=1.0, actor_lr=1e-3, entropy_cost=0.03)
    agent, steps = mtjax.agent("ppo", hidden=(32, 32), **known, **given), rollouts * num_envs * pulls
    plan = dict(steps=steps, eval_every=steps // 6, eval_episodes=trials * pulls, chunk_steps=10 * pulls)
    result = mtjax.train(mtjax.make("hidden-bandit"), agent, trials=pulls, num_envs=num_envs, quiet=True, **plan)
    found = result.evaluations.returns["train"][0, -2:, 0].reshape(-1, pulls).sum(axis=1).mean()
    assert found > 0.97 * exact.bandit(2, pulls)


# What is refused.


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("sac", {"n_step": 3, "warmup_steps": 50}, "conditioning=posterior needs n-step=1"),
        ("sac", {"hindsight": 0.5, "warmup_steps": 50}, "hindsight=0"),
        ("sac", {"warmup_steps": 3, "recurrent_steps": 5}, "warmup-steps of at least 4, not 3"),
        ("hip-bmdp", {"unseen_theta": "inferred"}, "conditioning=posterior and theta-from are two memories"),
        ("ppo", {"inference": "varibat"}, "did you mean 'varibad'"),
        ("ppo", {"latent_size": 0}, "latent-size must be at least 1"),
        ("ppo", {"inference_widths": ()}, "inference-widths needs at least one layer"),
        ("ppo", {"kl_coefficient": -1.0}, "kl-coefficient must be at least 0"),
    ],
)
def test_what_a_belief_cannot_do_is_refused(name, settings, message):
    with pytest.raises(InputError, match=message):
        agents.agent(name, conditioning="posterior", **settings)
