"""IMPALA: its batch against V-trace by hand, the policy that lags behind, and probes learned by the loop."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, learn, mean_actions, of_task, only_seed, pick, quick, slow_but, tasks_of, tiny, train
from test_ppo import BEST, KNOWN, SCALES, random_steps

from mtjax import agents
from mtjax.agents import critics
from mtjax.agents.base import judged
from mtjax.agents.parts import targets
from mtjax.envs.probes import Probe
from mtjax.experience import rollouts
from mtjax.types import InputError, Spec

SPEC, LENGTH = Spec.vector(3, 2, 1)._replace(sentences=("Walk.", "Run.", "Hop.")), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(2)


def small(**settings):
    return tiny("impala", **{"minibatches": 1, "unroll": LENGTH, **settings})


def test_a_batch_holds_vtrace_of_the_present_policy_and_critic():
    """Window by window; targets and advantages are in the units that have moved by these targets."""
    agent = small(gae_lambda=0.7, normalize_observations=False)
    state, steps = agent.init(SPEC, TASKS, KEY), random_steps(agent)
    window = rollouts.windows(steps, agent.unroll)
    after, batch = quick(agent.prepare, state, window, TASKS)(state, window, TASKS)
    units = critics.Units.of(after)

    def of_world(nets, features, one):
        value, following = (agent.output(nets, features, x) for x in (one.obs, one.next_obs))
        log_ratio = agent.log_ratio(nets, features, one.obs, one.extras, None)
        return targets.vtrace(one, value, following, log_ratio, agent.gamma, 0.7)

    by_hand = jax.jit(of_world)
    for task in range(3):
        nets, features = of_task(state.nets, task), TASKS.context[task]
        for world in range(2):
            found = by_hand(nets, features, pick(window, (task, world)))
            place = slice(world * LENGTH, (world + 1) * LENGTH)
            np.testing.assert_allclose(units.rewards(batch.target)[task, place], found.target, rtol=1e-3, atol=1e-4)
            expected = found.advantage / units.std[task]
            np.testing.assert_allclose(batch.advantage[task, place], expected, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
def test_scales_of_rewards_do_not_weigh_tasks():
    """Rewards a thousand times as large give the same advantages, once the units have moved to them."""
    agent = small(value_rate=1.0)

    @jax.jit
    def advantages(steps):
        state, _ = learn(agent, agent.init(SPEC, TASKS, KEY), steps, TASKS, KEY)
        return agent.prepare(state, rollouts.windows(steps, agent.unroll), TASKS)[1].advantage

    steps = random_steps(agent)
    one, found = (advantages(steps._replace(reward=scale * steps.reward)) for scale in (1.0, 1000.0))
    np.testing.assert_allclose(found, one, rtol=0.1, atol=0.1)


def test_the_policy_that_acts_lags_behind():
    """It is renewed after every so many rollouts; evaluation plays the present one."""
    agent, lagging = small(actor_lr=0.1), small(actor_lr=0.1, actor_lag=3)
    task, obs = pick(TASKS, 0), jnp.float32([0.3, -1.0, 2.0])
    act = lambda agent, state, key: agent.act(state, agent.begin(state, task), obs, task, key).action
    step = jax.jit(lambda state, steps, key: learn(lagging, state, steps, TASKS, key)[0])
    state = lagging.init(SPEC, TASKS, KEY)
    acted, played = [act(lagging, state, KEY)], [act(lagging, state, None)]
    for i in range(3):
        state = step(state, random_steps(lagging, seed=i), jax.random.key(i))
        acted.append(act(lagging, state, KEY))
        played.append(act(lagging, state, None))
    assert np.array_equal(acted[0], acted[1]) and np.array_equal(acted[0], acted[2])
    assert not np.allclose(acted[2], acted[3]) and not np.allclose(played[0], played[1])
    np.testing.assert_array_equal(acted[3], act(agent, state, KEY))


def test_evaluations_by_drawn_actions_draw_them_from_the_present_policy():
    agent, lagging = small(actor_lr=0.1), small(actor_lr=0.1, actor_lag=3)
    task, obs = pick(TASKS, 0), jnp.float32([0.3, -1.0, 2.0])
    act = lambda agent: agent.act(state, agent.begin(state, task), obs, task, KEY).action
    state = learn(lagging, lagging.init(SPEC, TASKS, KEY), random_steps(lagging), TASKS, KEY)[0]
    np.testing.assert_array_equal(act(judged(lagging)), act(agent))
    assert not np.array_equal(act(judged(lagging)), act(lagging))


@pytest.mark.parametrize("lag", slow_but([0, 4], 4))
@pytest.mark.parametrize("kind", slow_but(KNOWN, "delayed"))
@pytest.mark.slow
def test_probes_are_learned(kind, lag):
    """Values of every task, and the best action where there is one; also from older policies."""
    given = {"num_envs": 16, "chunk_steps": 3200, "unroll": 8, "minibatches": 2, "epochs": 2, "gamma": 0.9}
    # At a rate of 3e-3 one seed in six ends at its bounds if what acts lags, and rounding decides which.
    given |= {"actor_lr": 1e-3, "critic_lr": 1e-2, "entropy_cost": 0.0, "actor_lag": lag}
    updates = given["chunk_steps"] // given["unroll"] * given["epochs"] * given["minibatches"]
    agent, tasks = tiny("impala", lr_schedule="linear", lr_updates=updates), tasks_of(kind, SCALES)
    state, history = train(Probe(), agent, given, tasks=tasks)
    state, (expected, obs, tolerance) = only_seed(state.agent), KNOWN[kind]
    seen = jax.vmap(lambda x: agent.view.see(state.nets["inputs"], x[None]))(jnp.float32(obs))
    found = critics.values(agent, state, tasks.context, jnp.broadcast_to(seen, (2, *seen.shape)))
    for i, scale in enumerate(SCALES):
        np.testing.assert_allclose(found[i], [expected(scale, x) for x in obs], atol=tolerance)
    if kind in BEST:
        wanted = [[BEST[kind](scale, x) for x in obs] for scale in SCALES]
        np.testing.assert_allclose(mean_actions(agent, state, tasks, obs), wanted, atol=0.15)
    assert history[0]["bad_step"].max() == -1


@pytest.mark.slow
def test_older_policies_have_ratios_below_one():
    """And the present one has none."""
    found = {}
    for lag in (0, 8):
        agent = small(minibatches=1, actor_lag=lag, actor_lr=0.01)
        _, history = train(Walk(episode_length=40), agent, {"num_envs": 4, "unroll": 5, "chunk_steps": 200})
        found[lag] = float(history[0]["ratio"].mean())
    assert found[0] == pytest.approx(1, abs=1e-5) and found[8] < 0.99


def test_a_lag_needs_an_actor_of_its_own():
    with pytest.raises(InputError, match="actor-lag keeps a copy of the actor alone"):
        agents.agent("impala", actor_lag=2, representation="deepmdp")
    with pytest.raises(InputError, match="actor-lag must be at least 0"):
        agents.agent("impala", actor_lag=-1)
