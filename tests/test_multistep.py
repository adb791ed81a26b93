"""Multi-step returns: windows of the ring, sums worked by hand, and what agents make of them."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Goals, Stub, Walk, one_in, pick, quick, random_batch, random_past, tasks_of, tiny, train, with_nets

from mtjax.agents import replay_batches
from mtjax.agents.base import Memory
from mtjax.agents.networks import Params
from mtjax.agents.parts.knowing.last_steps import append
from mtjax.agents.swept import with_numbers
from mtjax.experience import Replay, multistep
from mtjax.experience import ring as rings
from mtjax.experience.replay import Buffer, joined
from mtjax.types import InputError, Spec, Transition

SPEC = Spec.vector(3, 2, 1)
TASKS, ENVS, SLOTS = 2, 3, 8


def window(rewards, discounts, ended):
    """A window of steps that begin at observations 0, 1, 2 and so on."""
    obs = jnp.arange(float(len(rewards)))[:, None]
    return Transition(obs, -obs, jnp.float32(rewards), jnp.float32(discounts), obs + 10, *[jnp.array(ended)] * 3)


# For gamma 1/2 and rewards 8, 4, 2: what the window is, its reward, its discount and the step it bootstraps after.
CASES = {
    "goes on": ([1, 1, 1], [False, False, False], 8 + 2 + 0.5, 0.25, 2),
    "terminates in its first step": ([0, 1, 1], [True, False, False], 8, 0, 0),
    "terminates inside": ([1, 0, 1], [False, True, False], 8 + 2, 0, 1),
    "terminates in its last step": ([1, 1, 0], [False, False, True], 8 + 2 + 0.5, 0, 2),
    "is cut off in its first step": ([1, 1, 1], [True, False, False], 8, 1, 0),
    "is cut off inside": ([1, 1, 1], [False, True, False], 8 + 2, 0.5, 1),
    "is cut off, and the next episode terminates": ([1, 1, 0], [False, True, True], 8 + 2, 0.5, 1),
    "is cut off in its last step": ([1, 1, 1], [False, False, True], 8 + 2 + 0.5, 0.25, 2),
}


@pytest.mark.parametrize(("discounts", "ended", "reward", "discount", "final"), CASES.values(), ids=CASES)
def test_a_window_is_the_transition_worked_by_hand(discounts, ended, reward, discount, final):
    """The discount lacks the one gamma by which agents multiply it."""
    joined = multistep.join(window([8, 4, 2], discounts, ended), 0.5)
    np.testing.assert_allclose((joined.reward, joined.discount), (reward, discount), rtol=1e-6)
    np.testing.assert_array_equal((joined.obs[0], joined.action[0], joined.next_obs[0]), (0, 0, 10 + final))
    assert joined.ended == ended[final] and joined.extras is None


def test_what_follows_an_end_does_not_count_even_if_it_is_no_number():
    """0 times NaN would be NaN."""
    steps = window([8, np.nan, 2], [0, 1, 1], [True, False, False])
    assert multistep.join(steps, 0.5).reward == 8


def test_without_discounting_and_without_a_future():
    """gamma of 1 sums rewards; of 0 takes the first alone."""
    steps = window([8, 4, 2], [1, 1, 1], [False, False, False])
    for gamma, reward, discount in ((1.0, 14, 1), (0.0, 8, 0)):
        joined = multistep.join(steps, gamma)
        assert (joined.reward, joined.discount) == (reward, discount)


# Windows of the ring.


def filled(num_steps):
    """A ring of rows (task, environment, step)."""
    ring = rings.init(jnp.zeros(3), TASKS, SLOTS, ENVS)
    for step in range(1, num_steps + 1):
        task, env = np.meshgrid(np.arange(TASKS), np.arange(ENVS), indexing="ij")
        ring = rings.add(ring, np.float32(np.stack([task, env, np.full_like(task, step)], axis=-1))[:, None])
    return ring


@pytest.mark.parametrize("num_steps", [3, 5, 8, 9, 12, 16, 21])
def test_windows_are_all_those_that_lie_between_the_oldest_and_the_latest_step(num_steps):
    """Before, at and after wrapping around: consecutive steps of one environment, never across the write head."""
    rows = np.asarray(rings.sample(filled(num_steps), jax.random.key(0), 500, 3))
    assert rows.shape == (TASKS, 500, 3, 3)
    oldest = max(1, num_steps - SLOTS + 1)
    for task in range(TASKS):
        expected = {(task, env, step) for env in range(ENVS) for step in range(oldest, num_steps - 1)}
        assert {tuple(first) for first in rows[task, :, 0]} == expected
    np.testing.assert_array_equal(rows[:, :, 1:, :2], rows[:, :, :-1, :2])
    np.testing.assert_array_equal(rows[:, :, 1:, 2], rows[:, :, :-1, 2] + 1)


def test_windows_may_come_from_a_ring_of_each_rows_own():
    """As hindsight draws them."""
    ring = np.arange(60).reshape(2, 30) % TASKS
    rows = np.asarray(rings.sample_from(filled(11), jax.random.key(0), jnp.asarray(ring), 2))
    np.testing.assert_array_equal(rows[..., 0], np.repeat(ring[..., None], 2, axis=-1))
    np.testing.assert_array_equal(rows[..., 1, 2], rows[..., 0, 2] + 1)


# Agents.


@dataclasses.dataclass(frozen=True)
class Auditor(Stub):
    """Notes how far joined steps are from those that the walks of the batch's tasks take, and how long they are."""

    n: int = 3

    def init(self, spec, tasks, key):
        return jnp.float32(0.5)  # its discount

    def update(self, state, window, tasks, key, number):
        batch = joined(window, jnp.broadcast_to(state, len(tasks.id)), self.experience.n_step)
        age, count = batch.obs[..., 0], jnp.round((batch.next_obs - batch.obs)[..., 0])
        powers = jnp.where(jnp.arange(self.n) < count[..., None], state ** jnp.arange(self.n), 0)
        scale = tasks.goal["scale"][:, None]
        reward = scale * jnp.sum(powers * (age[..., None] + jnp.arange(self.n)), axis=-1)
        terminated = (age % 1 < 0.5) & (batch.next_obs[..., 0] // 1 == 3)
        discount = jnp.where(terminated & batch.ended, 0, state ** (count - 1))
        wrong = jnp.abs(batch.reward - reward) + (count > self.n) + ((count < self.n) & ~batch.ended)
        wrong += jnp.abs(batch.discount - discount)
        return state, {"wrong": jnp.max(wrong, axis=1), "count": jnp.mean(count, axis=1)}


@pytest.mark.parametrize("stagger", one_in(2, [True, False]))
def test_the_loop_learns_from_joined_steps(stagger):
    """Over two seeds, a ring that wraps around, and episodes that terminate or are cut off, in step or staggered."""
    settings = {"num_envs": 4, "batch_size": 32, "replay_size": 44, "warmup_steps": 3, "chunk_steps": 40, "n_step": 3}
    env = Walk() if not stagger else Unlike()
    _, (metrics,) = train(env, Auditor(), {**settings, "stagger": stagger}, seeds=(0, 1))
    np.testing.assert_allclose(metrics["wrong"], 0, atol=1e-4)
    assert np.all((metrics["count"] > 1.5) & (metrics["count"] < 3))


@dataclasses.dataclass(frozen=True)
class Unlike(Walk):
    """Walks of which none terminates."""

    def start(self, task, key):
        return jax.random.uniform(key, (1,), minval=0.5)


@pytest.mark.slow
def test_relabelled_windows_have_the_new_goal_in_every_step():
    """All rewards of a window are of the batch's task, wherever its steps come from."""
    settings = {"num_envs": 4, "batch_size": 32, "replay_size": 80, "warmup_steps": 9, "chunk_steps": 20, "n_step": 3}
    _, (metrics,) = train(Goals(), Auditor(), {**settings, "hindsight": 0.5}, seeds=(0, 1))
    np.testing.assert_allclose(metrics["wrong"], 0, atol=1e-4)


def windows(num_tasks, history=0):
    """Windows of three steps (T, 4, 3, ...), in which about one step in four terminates."""
    steps = [random_batch(i, num_tasks, 4, SPEC, history) for i in range(3)]
    steps = jax.tree.map(lambda *x: jnp.stack(x, axis=2), *steps)
    return steps._replace(ended=steps.discount == 0, closed=steps.discount == 0, cut=steps.discount == 0)


def test_each_task_has_its_own_discount():
    """By its horizon: 1 - 5 / 125 = 0.96 and 1 - 5 / 250 = 0.98; and the agent makes gamma^m of it."""
    tasks = tasks_of("one-step")._replace(horizon=jnp.int32([125, 250]))
    agent, steps = tiny("sac-conditioned", discounting="horizon", experience=Replay(n_step=3)), windows(2)
    state = agent.init(SPEC, tasks, jax.random.key(0))
    joined = replay_batches.transitions(agent, steps, tasks)
    batch = quick(partial(replay_batches.prepare, agent), state, steps, tasks)(state, steps, tasks)
    for task, gamma in enumerate((0.96, 0.98)):
        each = [multistep.join(pick(steps, (task, b)), gamma) for b in range(4)]
        np.testing.assert_allclose(joined.reward[task], [x.reward for x in each], rtol=1e-6)
        count = np.asarray([next((k + 1 for k in range(3) if steps.ended[task, b, k]), 3) for b in range(4)])
        alive = np.asarray([not steps.ended[task, b].any() for b in range(4)])
        np.testing.assert_allclose(batch.discount[task], alive * gamma**count, rtol=1e-5)


@pytest.mark.slow
def test_a_sweep_joins_by_the_swept_discount():
    """And not by that of the agent whose numbers are varied."""
    tasks, steps, key = tasks_of("one-step"), windows(2), jax.random.key(0)
    replay, number = Replay(n_step=3), jnp.int32(0)
    swept, plain = tiny("sac", experience=replay), tiny("sac", experience=replay, gamma=0.5)

    def loss(agent):
        return agent.update(agent.init(SPEC, tasks, key), steps, tasks, key, number)[1]["critic_loss"]

    numbers = {"gamma": jnp.float32(0.5)}
    found = quick(lambda numbers: loss(with_numbers(swept, numbers)), numbers)(numbers)
    expected = quick(partial(loss, plain))()
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_units_of_a_task_scale_joined_rewards_as_its_values():
    """A value v is learned as f (v - o): then f (y - o) = f (R - (1 - gamma^m d) o) + gamma^m d f (v' - o)."""
    agent, tasks, steps = (
        tiny("multi-head", scaling="popart", gamma=0.9, experience=Replay(n_step=3)),
        tasks_of("one-step"),
        windows(2),
    )
    state = agent.init(SPEC, tasks, jax.random.key(0))
    mean, std = jnp.float32([3.0, -2.0]), jnp.float32([0.5, 4.0])
    scales = state.nets["scaling"].own._replace(mean=mean, variance=std**2)
    state = with_nets(state, scaling=Params({}, scales))
    joined, batch = replay_batches.transitions(agent, steps, tasks), replay_batches.prepare(agent, state, steps, tasks)
    value = 7.0
    target = batch.reward + batch.discount * (value - mean[:, None]) / std[:, None]
    expected = (joined.reward + batch.discount * value - mean[:, None]) / std[:, None]
    np.testing.assert_allclose(target, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_the_past_at_the_bootstrap_is_that_of_the_windows_last_step():
    """An agent that infers its task sees the steps before s_(t+m), and not those of a joined step."""
    agent = tiny("sac", conditioning="inferred", inferred_from=2, experience=Replay(n_step=3))
    tasks, steps = tasks_of("one-step"), windows(2)
    steps = steps._replace(memory=Memory(random_past(np.random.default_rng(0), (2, 4, 3, 2), SPEC)))
    state = agent.init(SPEC, tasks, jax.random.key(0))
    batch = quick(partial(replay_batches.prepare, agent), state, steps, tasks)(state, steps, tasks)
    for task, b in np.ndindex(2, 4):
        final = next((k for k in range(3) if steps.ended[task, b, k]), 2)
        last = pick(steps, (task, b, final))
        expected = append(last.memory.past, last.obs, last.action, last.reward)
        found = batch.next_obs.past, batch.obs.past
        for ours, theirs in zip(found, (expected, pick(steps.memory.past, (task, b, 0))), strict=True):
            jax.tree.map(np.testing.assert_array_equal, pick(ours, (task, b)), theirs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", one_in(2, [{}, {"conditioning": "inferred", "inferred_from": 2}]), ids=["plain", "inferred"]
)
def test_an_agent_learns_from_joined_steps(settings):
    """The whole update runs, for two seeds in one program."""
    given = {"num_envs": 2, "batch_size": 4, "replay_size": 40, "warmup_steps": 3, "chunk_steps": 8, "n_step": 3}
    _, (metrics,) = train(Walk(), tiny("sac", **settings), given, seeds=(0, 1))
    assert np.all(metrics["bad_step"] == -1) and np.all(np.isfinite(metrics["critic_loss"]))


def test_single_steps_are_drawn_as_ever():
    """To the bit: n-step=1 draws rows and joins nothing."""
    ring = jax.tree.map(lambda x: x, filled(11))
    buffer = lambda ring: Buffer(ring, ring.size, None)  # type: ignore
    draw = lambda ring, key: Replay(updates_per_step=2, batch_size=5).batches(
        Walk(), Stub(), tasks_of("one-step"), buffer(ring), key
    )
    found = quick(draw, ring, jax.random.key(3))(ring, jax.random.key(3))
    rows = rings.sample(ring, jax.random.key(3), 10)
    np.testing.assert_array_equal(np.moveaxis(found, 0, 1).reshape(rows.shape), rows)


# Refusals.


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("sac", {"n_step": 0}, "n-step must be at least 1, not 0"),
        ("sac", {"n_step": 12, "warmup_steps": 10}, "warmup-steps of at least 11, not 10"),
        ("deepmdp", {"n_step": 3}, "deepmdp learns models of single steps; use n-step=1, not 3"),
        ("hip-bmdp", {"n_step": 3}, "hip-bmdp learns models of single steps"),
    ],
)
def test_what_cannot_be_right_is_refused(name, settings, message):
    """Before anything compiles."""
    with pytest.raises(InputError, match=message):
        tiny(name, experience=Replay(**settings))


def test_the_ring_must_hold_a_window():
    """Of every environment."""
    with pytest.raises(InputError, match=r"replay-size \(11\) must hold 3 steps of num-envs \(4\)"):
        Replay(replay_size=11, n_step=3).check(Walk(), 4)
