"""Tabular MDPs and bandits: their chances, the tasks they are drawn as, and the contexts that describe them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import tiny

from mtjax.agents import for_action
from mtjax.config import configure
from mtjax.envs.mtenv.tabular import Bandit, TabularMDP
from mtjax.learning import loop
from mtjax.types import Discrete, InputError, Spec

MDP, BANDIT = TabularMDP(num_tasks=3), Bandit(num_tasks=3)
ENVS = pytest.mark.parametrize("env", [MDP, BANDIT], ids=["tabular-mdp", "bandit"])
SAMPLES = 4000


def pick(tasks, row):
    return jax.tree.map(lambda x: x[row], tasks)


def shapes(tree):
    return jax.tree.map(lambda x: (x.shape, x.dtype), tree)


def within_chance(frequencies, chances, samples):
    """Five standard errors."""
    return np.all(np.abs(frequencies - chances) <= 5 * np.sqrt(0.25 / samples))


@pytest.fixture(scope="module")
def steps():
    """Observations and rewards (T, A, SAMPLES, ...) of first steps, and the states (T, SAMPLES) they are taken from."""
    keys = jax.random.split(jax.random.key(0), SAMPLES)
    tasks, actions = MDP.tasks(), jnp.arange(5)

    def one(task, action, key):
        start = MDP.reset(task, key)
        return start.obs, MDP.step(task, start.state, action)._replace(state=None)

    of_action = jax.vmap(jax.vmap(one, (None, None, 0)), (None, 0, None))
    return jax.jit(jax.vmap(of_action, (0, None, None)))(tasks, actions, keys)


def test_rewards_and_moves_follow_the_task(steps):
    """In every state, under every action, of every task: frequencies are the tables' to five standard errors."""
    start, step = jax.tree.map(np.asarray, steps)
    for t in range(3):
        for s in range(4):
            here = start[t, 0, :, s] == 1
            for a in range(5):
                reward, following = step.reward[t, a, here], step.obs[t, a, here, :4]
                assert within_chance(reward.mean(), MDP.tasks().goal["rewards"][t, s, a], here.sum())
                assert within_chance(following.mean(axis=0), MDP.tasks().goal["transitions"][t, s, a], here.sum())


def test_observations_are_the_state_and_the_last_reward(steps):
    """One-hot, then 0 at first and the step's reward after it; nothing ever terminates."""
    start, step = jax.tree.map(np.asarray, steps)
    assert start.shape == (3, 5, SAMPLES, 5)
    for obs in (start, step.obs):
        np.testing.assert_array_equal(np.sort(obs[..., :4]), np.broadcast_to([0, 0, 0, 1], (*obs.shape[:-1], 4)))
    np.testing.assert_array_equal(start[..., 4], 0)
    np.testing.assert_array_equal(step.obs[..., 4], step.reward)
    assert set(np.unique(step.reward)) == {0, 1} and not np.any(step.terminated)


def test_every_state_is_as_likely_at_the_start(steps):
    """Whatever the task."""
    start = np.asarray(steps[0])[:, 0, :, :4]
    assert within_chance(start.mean(axis=1), 0.25, SAMPLES)


def test_chance_and_moves_are_independent():
    """Over a long episode rewards, moves and later rewards do not repeat each other's draws."""
    env = TabularMDP(num_tasks=1, num_states=2, num_actions=1)
    even = env.task_of({"rewards": np.full((2, 1), 0.5), "transitions": np.full((2, 1, 2), 0.5)})

    def walk(state, _):
        step = env.step(even, state, jnp.int32(0))
        return step.state, step.obs

    state = env.reset(even, jax.random.key(1)).state
    obs = np.asarray(jax.jit(lambda state: jax.lax.scan(walk, state, length=SAMPLES))(state)[1])
    series = np.stack([obs[1:, 0], obs[1:, 2], obs[:-1, 0], obs[:-1, 2]])
    assert np.abs(np.corrcoef(series) - np.eye(4)).max() < 5 / np.sqrt(SAMPLES)


def test_arms_pay_as_the_task_says():
    """Frequencies of every arm of every task; the observation is 0, and nothing terminates."""
    keys = jax.random.split(jax.random.key(0), SAMPLES)

    def one(task, action, key):
        start = BANDIT.reset(task, key)
        return start.obs, BANDIT.step(task, start.state, action)

    of_arm = jax.vmap(jax.vmap(one, (None, None, 0)), (None, 0, None))
    start, step = jax.jit(jax.vmap(of_arm, (0, None, None)))(BANDIT.tasks(), jnp.arange(5), keys)
    assert within_chance(np.mean(step.reward, axis=2), np.asarray(BANDIT.tasks().goal["rewards"]), SAMPLES)
    assert start.shape == step.obs.shape == (3, 5, SAMPLES, 1)
    assert not np.any(start) and not np.any(step.obs) and not np.any(step.terminated)


@ENVS
def test_the_highest_score_is_taken(env):
    """With scores, of equal ones the first: only the action's largest entry matters."""
    env = dataclasses.replace(env, scores=True)
    task = pick(env.tasks(), 0)
    certain = np.zeros_like(task.goal["rewards"])
    certain[..., 2] = 1
    task = task._replace(goal={**task.goal, "rewards": jnp.asarray(certain)})
    state = env.reset(task, jax.random.key(0)).state
    step = jax.jit(lambda action: env.step(task, state, action).reward)
    scores = {(-1, -1, -0.9, -1, -1): 1, (0, 0, 0.1, 0, 0): 1, (-1, -1, 1, 1, -1): 1, (-1, 1, 1, -1, -1): 0}
    for action, reward in scores.items():
        assert step(jnp.float32(action)) == reward


@ENVS
def test_the_same_key_gives_the_same_episode(env):
    """Bit for bit, and another key another one."""
    task = pick(env.tasks(), 0)

    def episode(key):
        start = env.reset(task, key)
        walk = lambda step, _: (env.step(task, step.state, jnp.int32(0)), step.reward)
        return jax.lax.scan(walk, start, length=50)[1]

    run = jax.jit(jax.vmap(episode))
    rewards = run(jax.random.split(jax.random.key(0), 2))
    np.testing.assert_array_equal(rewards, run(jax.random.split(jax.random.key(0), 2)))
    assert not np.array_equal(rewards[0], rewards[1])


def test_tasks_are_drawn_as_mtenv_draws_them():
    """Rewards uniform in [0, 1]; transitions the softmax of standard normal numbers."""
    goal = TabularMDP(num_tasks=1000).table.tasks.goal
    rewards, transitions = goal["rewards"][:1000], goal["transitions"][:1000]
    assert rewards.shape == (1000, 4, 5) and transitions.shape == (1000, 4, 5, 4)
    assert abs(rewards.mean() - 0.5) < 0.01 and abs(rewards.std() - 1 / np.sqrt(12)) < 0.005
    np.testing.assert_allclose(transitions.sum(axis=-1), 1, rtol=1e-5)
    logs = np.log(transitions)
    contrasts = logs[..., 0] - logs[..., 1]  # of two standard normal numbers
    assert abs(contrasts.mean()) < 0.04 and abs(contrasts.std() - np.sqrt(2)) < 0.03
    arms = Bandit(num_tasks=1000).table.tasks.goal["rewards"]
    assert arms.shape == (1010, 5) and abs(arms.mean() - 0.5) < 0.02


@ENVS
def test_more_tasks_keep_the_first_ones(env):
    """A task depends on the seed and its number; held-out tasks are others; another seed gives others still."""
    more, other = type(env)(num_tasks=5), type(env)(num_tasks=3, task_seed=1)
    contexts = np.asarray(env.tasks().context)
    np.testing.assert_array_equal(more.tasks().context[:3], contexts)
    np.testing.assert_array_equal(more.tasks("interpolation").context[:3], env.tasks("interpolation").context)
    everything = np.concatenate([env.tasks("all").context, other.tasks("all").context])
    assert len(np.unique(everything, axis=0)) == len(everything) == 12


@ENVS
def test_held_out_tasks_are_further_draws(env):
    """Up to ten in interpolation, none beyond; --split=none holds out none; ids count through the table."""
    count = lambda env: [len(env.tasks(split).id) for split in ("train", "interpolation", "extrapolation", "all")]
    assert count(env) == [3, 3, 0, 6] and count(type(env)(num_tasks=12)) == [12, 10, 0, 22]
    assert count(type(env)(num_tasks=2, split="none")) == [2, 0, 0, 2]
    np.testing.assert_array_equal(env.tasks("all").id, np.arange(6))
    np.testing.assert_array_equal(env.tasks("interpolation").row, [3, 4, 5])


def test_the_context_is_the_whole_task():
    """MTEnv's 100 numbers, rewards then transitions, as 2 x - 1."""
    tasks = MDP.tasks()
    vectors = [Spec.vector(5, 5, 100), Spec.vector(1, 5, 5)]
    for env, spec in zip((MDP, BANDIT), vectors, strict=True):
        assert env.spec._replace(sentences=()) == spec._replace(action=Discrete(5))
        assert dataclasses.replace(env, scores=True).spec._replace(sentences=()) == spec
    numbers = (np.asarray(tasks.context) + 1) / 2
    np.testing.assert_allclose(numbers[:, :20].reshape(3, 4, 5), tasks.goal["rewards"], atol=1e-6)
    np.testing.assert_allclose(numbers[:, 20:].reshape(3, 4, 5, 4), tasks.goal["transitions"], atol=1e-6)
    np.testing.assert_allclose((BANDIT.tasks().context + 1) / 2, BANDIT.tasks().goal["rewards"], atol=1e-6)


def test_a_task_of_ones_own():
    """Tables make a task with the context that belongs to them; wrong shapes are refused."""
    env = TabularMDP(num_states=3, num_actions=2)
    tables = env.draw_tables(np.random.default_rng(7))
    task = env.task_of(tables, row=4)
    assert task.id == task.row == 4 and task.context.shape == (6 + 18,)
    np.testing.assert_array_equal(task.goal["rewards"], np.float32(tables["rewards"]))
    with pytest.raises(InputError, match="the tables of a task have the shapes"):
        MDP.task_of(tables)
    with pytest.raises(InputError, match="the tables of a task have the shapes"):
        env.task_of({"rewards": tables["rewards"]})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TabularMDP(num_states=0), "num-states and num-actions must be at least 1"),
        (lambda: Bandit(num_arms=0), "num-arms must be at least 1, not 0"),
        (lambda: Bandit(num_tasks=0), "num-tasks"),
        (lambda: Bandit(vary={"arms": "1:2:3"}), "unknown parameter 'arms'"),
        (lambda: TabularMDP(split="hip-bmdp"), "hip-bmdp"),
    ],
)
def test_wrong_settings_are_refused(make, message):
    """Before anything is drawn."""
    with pytest.raises(InputError, match=message):
        make()


@pytest.mark.parametrize("name", ["sac-conditioned", "ppo"])
@ENVS
def test_an_agent_trains_on_it(env, name):
    """Traced, not run: the loop, agent and tasks fit together, keys in the state included; the loop counts time."""
    given: dict = {"num_envs": 2, "chunk_steps": 2}
    if name == "ppo":
        agent, given = for_action(tiny("ppo"), env.spec.action), given | {"unroll": 2, "minibatches": 1}
    else:
        env, agent = dataclasses.replace(env, scores=True), tiny(name)
        given |= {"batch_size": 4, "replay_size": 12, "warmup_steps": 1}
    agent, settings = configure(agent, loop.Settings(), given)
    assert env.episode_length == 100
    state = jax.eval_shape(lambda: loop.init(env, agent, settings, env.tasks(), jnp.arange(1)))
    after, _ = jax.eval_shape(lambda state: loop.run_chunk(env, agent, settings, env.tasks(), state), state)
    assert shapes(after) == shapes(state)


# Scales of rewards.


@pytest.mark.parametrize("kind", [TabularMDP, Bandit])
def test_tasks_can_differ_by_the_scale_of_their_rewards(kind):
    """Their values in turn; all else is as without, what is observed of a reward too."""
    plain, scaled = kind(num_tasks=5), kind(num_tasks=5, vary={"reward-scale": "0.01,1,100"})
    np.testing.assert_allclose(scaled.tasks().params["reward-scale"], [0.01, 1, 100, 0.01, 1])
    np.testing.assert_array_equal(scaled.tasks().context, plain.tasks().context)
    keys = jax.random.split(jax.random.key(0), 50)

    def earned(env):
        one = lambda task, key: env.step(task, env.reset(task, key).state, jnp.int32(0))._replace(state=None)
        return jax.jit(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))(env.tasks(), keys)

    found, wanted = earned(scaled), earned(plain)
    scales = scaled.tasks().params["reward-scale"][:, None]
    np.testing.assert_array_equal(found.reward, scales * wanted.reward)
    np.testing.assert_array_equal(found.obs, wanted.obs)
    assert np.all(wanted.reward.sum(axis=1) > 0)


def test_scales_of_drawn_tasks_are_listed():
    """No episode draws them."""
    with pytest.raises(InputError, match="in turn: list them"):
        TabularMDP(vary={"reward-scale": "0.1:10"})
