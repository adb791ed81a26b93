"""Relabelling by inverse reinforcement learning: probabilities on tabular processes, and what batches are made of."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Goals, only_seed, pick, quick, tiny, train
from test_hindsight import BATCH, BATCHES, KEY, TASKS, Auditor, filled

import mtjax
from mtjax.agents.state import of_task
from mtjax.envs import make
from mtjax.experience import hindsight
from mtjax.types import InputError, Transition

GAMMA = 0.9


def processes(num_tasks, num_states=3):
    """Tabular processes with the chances of the first one, and the rewards of each: (A, S, S) and (T, S, A)."""
    env = make("tabular-mdp", num_tasks=num_tasks, num_states=num_states, num_actions=2, split="none")
    goal = env.tasks().goal
    return np.float64(goal["transitions"][0]), np.float64(goal["rewards"])


def values(chances, rewards):
    """Q (T, S, A) of the best policies, by value iteration."""
    q = np.zeros(rewards.shape)
    for _ in range(2000):
        q = rewards + GAMMA * np.einsum("sat,nt->nsa", chances, q.max(axis=-1))
    return q


def by_hand(q, steps):
    """The probability (T, N) that each of the steps (state, action) is of each task, one number at a time."""
    found = np.zeros((len(q), len(steps)))
    partition = [np.mean([np.exp(each[step]) for step in steps]) for each in q]
    for n, step in enumerate(steps):
        weights = [np.exp(q[i][step]) / partition[i] for i in range(len(q))]
        found[:, n] = np.array(weights) / sum(weights)
    return found


STEPS = [(0, 0), (0, 1), (1, 1), (2, 0), (2, 1), (2, 1)]


def scores_of(q):
    return jnp.float32([[each[step] for step in STEPS] for each in q])


def test_probabilities_are_those_of_exact_values():
    """Of three tabular processes that share their chances, by value iteration."""
    q = values(*processes(3))
    found = np.exp(hindsight.posterior(scores_of(q)))
    np.testing.assert_allclose(found, by_hand(q, STEPS), rtol=1e-4)
    np.testing.assert_allclose(found.sum(axis=0), 1, rtol=1e-5)
    assert np.ptp(found, axis=1).min() > 0.01


def test_what_a_task_earns_in_every_step_changes_nothing():
    """A constant reward adds itself over 1 - gamma to Q, which the partition function takes out again."""
    chances, rewards = processes(3)
    plain = hindsight.posterior(scores_of(values(chances, rewards)))
    richer = values(chances, rewards + np.array([0.0, 0.5, -0.2])[:, None, None])
    np.testing.assert_allclose(hindsight.posterior(scores_of(richer)), plain, atol=1e-4)
    without = jax.nn.softmax(scores_of(richer), axis=0)
    assert np.abs(without - np.exp(plain)).max() > 0.3  # as it would without partition functions


def test_in_one_state_it_is_bayes_rule():
    """Of soft-optimal policies pi_i(a) ~ exp Q_i(a), all tasks as likely: pi_i(a) / sum_j pi_j(a)."""
    q = values(*processes(4, num_states=1))[:, 0]
    policies = np.exp(q) / np.exp(q).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(np.exp(hindsight.posterior(jnp.float32(q))), policies / policies.sum(axis=0), rtol=1e-4)


# Batches.


def judge(steps: Transition):
    """The values of steps (T, N): tasks 0 and 2 like the first half of rows, the others the second."""
    first = steps.obs[..., 1] <= 50
    likes = jnp.array([True, False, True, False])[:, None]
    return jnp.where(first == likes, 2.0, 0.0)


def test_a_batch_has_the_steps_that_its_task_values_beside_others():
    """As often as their probabilities say, from all tasks, with this task's reward; the rest as they were stored."""
    env, share = Goals(), 0.5
    sample = lambda tasks, ring, key: hindsight.sample(env, tasks, share, ring, key, (TASKS, BATCHES, BATCH), 0, judge)
    rows = jax.tree.map(np.asarray, quick(sample, *(inputs := (env.tasks(), filled(), KEY)))(*inputs))
    count = round(share * BATCH)
    for task in range(TASKS):
        again, rest = rows.obs[task, :, :count], rows.obs[task, :, count:]
        assert np.all(rest[..., 0] - 1 == task) and np.all(rows.reward[task, :, count:] == -1)
        np.testing.assert_array_equal(rows.reward[task, :, :count], (task + 1) * again[..., 0])
        share_of_first = np.mean(again[..., 1] <= 50)
        liked = np.exp(2) / (1 + np.exp(2))
        np.testing.assert_allclose(share_of_first, liked if task % 2 == 0 else 1 - liked, atol=0.05)
        chances = np.bincount((again[..., 0] - 1).astype(int).ravel(), minlength=TASKS) / again[..., 0].size
        np.testing.assert_allclose(chances, 0.25, atol=0.1)  # from every task's steps, its own too
    np.testing.assert_array_equal(rows.obs, rows.next_obs)


def test_windows_are_relabelled_whole():
    """By their first steps; each step of a window has the new task's reward."""
    env = Goals()
    sample = lambda tasks, ring, key: hindsight.sample(env, tasks, 1.0, ring, key, (TASKS, 2, 16), 3, judge)
    rows = jax.tree.map(np.asarray, quick(sample, *(inputs := (env.tasks(), filled(), KEY)))(*inputs))
    assert rows.reward.shape == (TASKS, 2, 16, 3)
    scale = np.arange(1, 5)[:, None, None, None]
    np.testing.assert_array_equal(rows.reward, scale * rows.obs[..., 0])
    assert np.all(np.diff(rows.obs[..., 1], axis=-1) == 4)  # of one environment, one after another


@pytest.mark.slow
def test_soft_values_are_those_of_the_critics_over_the_temperature():
    """Of each task's own networks, on steps that are labelled as its own."""
    agent = tiny("sac-conditioned", hindsight=0.5, hindsight_choice="inverse")
    env = make("point-mass-easy", vary={"goal-x": "-0.1,0.2"}, split="none", engine="c")
    tasks = env.tasks()
    state = jax.jit(lambda: agent.init(env.spec, tasks, KEY))()
    state = state.with_nets(temperature=state.nets["temperature"]._replace(own={"log": jnp.log(jnp.array([0.5, 2.0]))}))
    random = np.random.default_rng(0)
    normal = lambda *size: jnp.float32(random.normal(size=(2, 5, *size)))
    obs, action = normal(env.spec.obs_size), jnp.tanh(normal(env.spec.action_size))
    steps = Transition(obs, action, normal(), jnp.ones((2, 5)), obs)
    found = agent.judge(state, tasks, steps)
    for i, temperature in enumerate((0.5, 2.0)):
        nets, features = of_task(state.nets, i), agent.view.features(state, pick(tasks, i))
        q = agent.values(nets, features, obs[i], action[i])
        np.testing.assert_allclose(found[i], np.min(q, axis=0) / temperature, rtol=1e-5)


@dataclasses.dataclass(frozen=True)
class Judging(Auditor):
    """An auditor that also judges, by the observation and by the number of its updates so far."""

    def judge(self, state, tasks, steps):
        return tasks.goal["scale"][:, None] * steps.obs[..., 0] + 0 * state


@pytest.mark.slow
@pytest.mark.parametrize("drawn", [False, True])
def test_the_loop_learns_from_batches_that_were_chosen(drawn):
    """Every reward is what the task of its row of the batch pays, and its context is that task's."""
    settings = {"num_envs": 4, "batch_size": 8, "replay_size": 80, "warmup_steps": 3, "chunk_steps": 9}
    settings |= {"hindsight": 0.5, "hindsight_choice": "inverse"}
    state, (metrics,) = train(Goals(drawn=drawn), Judging(), settings, seeds=(0, 1))
    np.testing.assert_allclose(metrics["wrong"], 0, atol=2e-5)
    np.testing.assert_array_equal(state.agent, 6)


@pytest.mark.slow
def test_sac_learns_from_them():
    """Through the whole loop, by its own critics, with finite numbers."""
    env = make("point-mass-easy", vary={"goal-x": "-0.1,0.2"}, split="none", engine="c")
    given = {"num_envs": 4, "batch_size": 8, "replay_size": 400, "warmup_steps": 20, "chunk_steps": 60}
    agent = tiny("sac-conditioned")
    state, (metrics,) = train(env, agent, given | {"hindsight": 0.5, "hindsight_choice": "inverse"})
    assert np.all(np.isfinite(metrics["critic_loss"])) and metrics["bad_step"].max() == -1
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(only_seed(state.agent.nets["actor"])))


@pytest.mark.parametrize(
    "given, said",
    [
        ({"hindsight": 0.5, "hindsight_choice": "inverted"}, "did you mean 'inverse'"),
        ({"hindsight_choice": "inverse"}, "relabels nothing with hindsight=0"),
    ],
)
def test_choices_that_choose_nothing_are_refused(given, said):
    with pytest.raises(InputError, match=said):
        mtjax.agent("sac", **given)
