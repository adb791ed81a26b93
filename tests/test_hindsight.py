"""Relabelled steps beside steps of an environment that had the other goal; what batches are made of; refusals."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import compiled
from probes import QUICK, Goals, Stub, one_in, pick, quick, train

import mtjax.train
from mtjax.agents.base import Memory
from mtjax.agents.parts.knowing.last_steps import append, begin
from mtjax.envs import make
from mtjax.experience import Replay, hindsight
from mtjax.experience import ring as rings
from mtjax.experience.replay import Buffer
from mtjax.types import InputError, Transition

WORLDS = 256
KEY = jax.random.key(4)
STRAIGHT = {"target-radius": "0.1,0.2"}
SCALED = {"goal-x": "-0.1,0.2", "reward-scale": "1,3"}
# Family, settings, steps to take before the one that is relabelled, and whether observations show the goal.
FAMILIES = {
    "point-mass": ("point-mass-vary-goal", {"combine": "grid", "vary": {"goal-x": "-0.1,0.2", "goal-y": "0,0.1"}}, 3),
    "point-mass-easy": ("point-mass-easy", {"vary": {"goal-x": "-0.1,0.2"}}, 3),
    "point-mass-scale": ("point-mass-vary-goal", {"combine": "paired", "vary": SCALED}, 3),
    "reacher-target": ("reacher-vary-goal", {"vary": {"target-angle": "-1,2", **STRAIGHT}}, 3),
    "reacher": ("reacher-easy", {"vary": {"target-size": "0.1,0.15"}}, 3),
    "cheetah-speed": ("cheetah-run-vary-speed", {"vary": {"speed": "1,3"}}, 10),
    "cheetah-direction": ("cheetah-vary-direction", {}, 10),
    "cheetah-run": ("cheetah-run", {"vary": {"speed": "1,3"}}, 10),
    "walker-speed": ("walker-vary-speed", {"vary": {"speed": "0.5,3"}}, 3),
    "walker-run": ("walker-run", {"vary": {"speed": "2,8"}}, 3),
    "finger-target": ("finger-turn-vary-target", {"vary": {"target-angle": "-1,1", "target-size": "0.07,0.1"}}, 3),
    "finger": ("finger-turn-easy", {"vary": {"target-size": "0.1,0.15"}}, 3),
    "maze": ("two-goal-maze-seen", {}, 0),
}
SHOWN = {"reacher", "finger", "maze"}  # whose observations differ between goals


def family(name):
    env, settings, _ = FAMILIES[name]
    return make(env, **settings, **({} if name == "maze" else {"engine": "c"}))


def alike(tasks, index):
    """One task for every world."""
    return jax.tree.map(lambda x: np.broadcast_to(np.asarray(x)[index], (WORLDS, *x.shape[1:])), tasks)


def with_goal_of(env, task, state, key):
    """The state as an episode of ``task`` has it that draws its goal with ``key``."""
    if hasattr(env, "polar_target"):
        return state._replace(extra=env.target(task, key))
    if hasattr(env, "target_angle"):
        return state._replace(extra=env.target(task, env.target_angle(task, key)))
    return state


@pytest.mark.parametrize("name", one_in(4, FAMILIES))
def test_a_relabelled_step_is_that_of_the_other_task(name):
    """Reward, discount and both observations, as if the same state had been stepped with the other goal."""
    env, keys = family(name), jax.random.split(KEY, WORLDS)
    tasks, programs, random = env.tasks(), compiled(env), np.random.default_rng(0)
    old, new = alike(tasks, 0), alike(tasks, -1)
    draw = lambda: np.float32(random.uniform(-1, 1, (WORLDS, env.spec.action_size)))
    if env.discrete:
        draw = lambda: np.int32(random.integers(env.spec.action_size, size=WORLDS))
    before = programs.reset(old, keys)
    for _ in range(FAMILIES[name][2]):
        before = programs.step(old, before.state, draw())
    action = draw()
    after = programs.step(old, before.state, action)
    transition = Transition(before.obs, action, after.reward, 1.0 - after.terminated, after.obs)
    relabelled = jax.jit(jax.vmap(env.relabel), compiler_options=QUICK)(new, transition, keys)

    state = jax.vmap(partial(with_goal_of, env))(new, before.state, keys)
    expected = programs.step(new, state, action)
    np.testing.assert_allclose(relabelled.reward, expected.reward, atol=2e-6)
    np.testing.assert_array_equal(relabelled.discount, 1.0 - expected.terminated)
    np.testing.assert_allclose(relabelled.next_obs, expected.obs, rtol=1e-6, atol=1e-6)
    if name == "maze":  # what a reset shows is the same in both tasks
        np.testing.assert_array_equal(relabelled.obs, programs.reset(new, keys).obs)
    else:
        shown = jax.vmap(env.observe)(new, state)
        np.testing.assert_allclose(relabelled.obs, shown, rtol=1e-6, atol=1e-6)
    assert np.mean(np.abs(relabelled.reward - after.reward) > 1e-3) > 0.02
    assert np.any(np.abs(relabelled.next_obs - after.obs) > 1e-3) == (name in SHOWN)


@pytest.mark.parametrize("name", one_in(2, ["point-mass-easy", "point-mass-vary-goal"]))
def test_a_scale_multiplies_rewards_alone(name):
    """Of the same worlds under the same actions."""
    env = make(name, vary={"reward-scale": "0.01,1,100"}, combine="grid", split="none", engine="c")
    keys, action = jax.random.split(KEY, WORLDS), jnp.full((WORLDS, 2), 0.3)
    tasks, programs = env.tasks(), compiled(env)
    starts = [programs.reset(alike(tasks, i), keys) for i in range(3)]
    found = [programs.step(alike(tasks, i), begun.state, action) for i, begun in enumerate(starts)]
    for i, scale in enumerate((0.01, 1, 100)):
        np.testing.assert_allclose(found[i].reward, scale * found[1].reward, rtol=1e-5)
        np.testing.assert_array_equal(found[i].obs, found[1].obs)
    assert np.any(np.asarray(found[1].reward) > 1e-3)


@pytest.mark.parametrize("name", ["point-mass", "reacher"])
def test_a_relabelled_past_is_that_of_the_other_task(name):
    """Past rewards and observations too: the same actions from the same start, under the other goal all along."""
    env = family(name)
    tasks, key, goal_key = env.tasks(), jax.random.key(0), jax.random.key(1)
    old, new = pick(tasks, 0), pick(tasks, -1)
    actions = np.float32(np.random.default_rng(0).uniform(-1, 1, (5, env.spec.action_size)))
    step = jax.jit(env.step, compiler_options=QUICK)

    def play(task, at_goal):
        """Transitions with the three steps before each."""
        world = at_goal(env.reset(old, key).state)
        obs, past, steps = env.observe(task, world), begin(3, env.spec.obs_size, env.spec.action.blank()), []
        for action in actions:
            after = step(task, world, action)
            steps.append(Transition(obs, action, after.reward, jnp.float32(1), after.obs, memory=Memory(past)))
            past, world, obs = append(past, obs, action, after.reward), after.state, after.obs
        return steps

    ours = play(old, lambda world: world)
    theirs = play(new, lambda world: with_goal_of(env, new, world, goal_key))
    one = lambda step: env.relabel(new, step, goal_key)
    again = jax.jit(lambda transition: hindsight.with_past(one, transition), compiler_options=QUICK)
    for i in (1, 4):  # with one step known, and with all three
        found = again(ours[i])
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(theirs[i]), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)
        changed = zip(jax.tree.leaves(found.memory), jax.tree.leaves(ours[i].memory), strict=True)
        assert not all(np.allclose(a, b) for a, b in changed)


# Batches.


TASKS, BATCHES, BATCH = 4, 3, 400


def filled(with_context=False):
    """Rings of 25 steps of 4 environments, 100 rows of each task: observation (task, row), reward -1."""
    task, row = np.meshgrid(np.arange(TASKS), np.arange(100), indexing="ij")
    obs = np.float32(np.stack([task, row], axis=-1)) + 1
    number = np.full((TASKS, 100), -1, np.float32)
    context = obs[..., :1] - 100 if with_context else None
    rows = Transition(obs, obs[..., :1], number, number, obs, context=context)
    return rings.Ring(jax.tree.map(lambda x: x.reshape(TASKS, 25, 4, *x.shape[2:]), rows), np.int32(0), np.int32(25))


def batches(env, share):
    sample = lambda tasks, replay, key: hindsight.sample(env, tasks, share, replay, key, (TASKS, BATCHES, BATCH))
    rows = quick(sample, *(inputs := (env.tasks(), filled(env.drawn), KEY)))(*inputs)
    return jax.tree.map(np.asarray, rows)


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_a_batch_has_exactly_its_share_of_other_tasks_steps(share):
    """The first of each batch, from any other task, with this task's reward; the rest as they were stored."""
    rows, count = batches(Goals(), share), round(share * BATCH)
    assert rows.obs.shape == (TASKS, BATCHES, BATCH, 2)
    for task in range(TASKS):
        source = rows.obs[task, ..., 0] - 1
        assert np.all(source[:, count:] == task)
        np.testing.assert_array_equal(rows.reward[task, :, count:], -1)
        np.testing.assert_array_equal(rows.reward[task, :, :count], (task + 1) * rows.obs[task, :, :count, 0])
        chances = np.bincount(source[:, :count].astype(int).ravel(), minlength=TASKS) / (BATCHES * count)
        np.testing.assert_allclose(chances, np.where(np.arange(TASKS) == task, 0, 1 / 3), atol=0.1)
    assert len(np.unique(rows.obs[0, ..., 1])) == 100  # any row
    np.testing.assert_array_equal(rows.obs, rows.next_obs)
    np.testing.assert_array_equal(rows.obs[..., :1], rows.action)  # rows stay whole


def test_a_small_share_is_at_least_one_step():
    """Of each batch of each task; none at all would be another method."""
    assert np.all(np.sum(batches(Goals(), 0.001).reward != -1, axis=-1) == 1)


@pytest.mark.parametrize("env", [Goals(drawn=True), Goals(fresh_goals=True)], ids=["drawn", "fresh"])
def test_where_goals_are_drawn_a_tasks_own_steps_are_relabelled_too(env):
    """From all rings alike; each with a draw of the batch's task, whose context it then has."""
    rows = batches(env, 0.5)
    source = rows.obs[..., :200, 0] - 1
    for task in range(TASKS):
        chances = np.bincount(source[task].astype(int).ravel(), minlength=TASKS) / source[task].size
        np.testing.assert_allclose(chances, 0.25, atol=0.1)
    if not env.drawn:
        assert rows.context is None
        return
    context = rows.context[..., 0]
    np.testing.assert_array_equal(context[..., 200:], rows.obs[..., 200:, 0] - 100)
    np.testing.assert_allclose(rows.reward[..., :200], context[..., :200] * rows.obs[..., :200, 0], rtol=1e-6)
    own = context[..., :200] - 10 * np.arange(1, 5)[:, None, None]
    assert np.all((own > 0.05) & (own < 0.95)) and len(np.unique(own.round(3))) == 50


def test_without_hindsight_batches_are_those_of_before():
    """To the bit: the same key draws the same rows as the replay alone does."""
    settings, replay = Replay(updates_per_step=BATCHES, batch_size=BATCH), filled()
    found = settings.batches(Goals(), Auditor(), Goals().tasks(), Buffer(replay, replay.size, KEY), KEY)
    rows = rings.sample(replay, KEY, BATCHES * BATCH)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(rows), strict=True):
        np.testing.assert_array_equal(np.moveaxis(a, 0, 1).reshape(b.shape), b)


@dataclasses.dataclass(frozen=True)
class Auditor(Stub):
    """Acts at random, and notes how far rewards are from what the walks of the batch's tasks pay."""

    def init(self, spec, tasks, key):
        return jnp.float32(0)

    def choose(self, state, obs, task, key):
        return jax.random.uniform(key, (1,))

    def update(self, state, window, tasks, key, number):
        batch = jax.tree.map(lambda x: x[:, :, 0], window)
        scale = tasks.goal["scale"][:, None] if batch.context is None else batch.context[..., 0]
        wrong = jnp.abs(batch.reward - scale * batch.obs[..., 0])
        return state + 1, {"wrong": jnp.max(wrong, axis=1), "spread": jnp.std(scale * jnp.ones_like(wrong), axis=1)}


@pytest.mark.parametrize("drawn", one_in(2, [False, True]))
def test_the_loop_learns_from_relabelled_batches(drawn):
    """Over two seeds: every reward is what the task of its row of the batch pays, and its context is that task's."""
    settings = {
        "num_envs": 4,
        "batch_size": 8,
        "replay_size": 80,
        "warmup_steps": 3,
        "chunk_steps": 9,
        "hindsight": 0.5,
    }
    state, (metrics,) = train(Goals(drawn=drawn), Auditor(), settings, seeds=(0, 1))
    assert metrics["wrong"].shape == (2, TASKS)
    np.testing.assert_allclose(metrics["wrong"], 0, atol=2e-5)
    np.testing.assert_array_equal(state.agent, 6)
    assert np.all(metrics["spread"] > 0.05) == drawn


# Refusals.


@pytest.mark.parametrize(
    ("name", "settings", "reason"),
    [
        ("cheetah-run-vary-torso-length", {}, "torso-length changes what happens; vary nothing but speed"),
        ("point-mass-vary-goal", {"vary": {"mass": "0.5:2"}}, "mass changes what happens"),
        ("cheetah-run", {}, "its tasks have the same goal; vary speed"),
        ("walker-stand", {}, "its rewards do not follow"),
        ("two-goal-maze", {}, "its rewards do not follow"),
        ("tabular-mdp", {}, "its rewards do not follow"),
        ("control-cartpole", {}, "its rewards do not follow"),
    ],
)
def test_families_that_cannot_relabel_are_refused_with_the_reason(name, settings, reason):
    """Before anything is compiled: what varies is not a goal, or rewards cannot be told from observations."""
    env = make(name, **settings)
    with pytest.raises(InputError, match=reason):
        hindsight.require(env)
    with pytest.raises(InputError, match=reason):
        mtjax.train(env, mtjax.agent("sac"), steps=10, hindsight=0.5)


def test_families_that_can_relabel_are_not_refused():
    """All those above, and those that draw a goal in every episode though nothing else varies."""
    for name in FAMILIES:
        hindsight.require(family(name))
    for name in ("reacher-easy", "finger-turn-hard", "reacher-vary-goal", "point-mass-vary-goal"):
        hindsight.require(make(name))


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_a_share_is_from_0_to_1(share):
    """As a flag is checked, so is the setting."""
    with pytest.raises(InputError, match="hindsight is a share from 0 to 1, not"):
        Replay(hindsight=share)


def test_the_command_line_refuses_before_it_makes_a_folder(tmp_path):
    """With the reason, so that no empty run is left."""
    with pytest.raises(InputError, match="damping changes what happens"):
        words = ["--env=reacher-vary-goal", "--env.vary.damping=1,2", "--hindsight=0.5", f"--runs={tmp_path}"]
        mtjax.train.main([*words, "--engine=c"])
    assert not list(tmp_path.iterdir())
