"""The table whose object is brought to goals and back: its rules, its tasks, and what worlds without resets play."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, configure, tiny

import mtjax
from mtjax.learning import combinations, curricula, loop
from mtjax.learning.evaluation import draw_in_turn
from mtjax.learning.trials import ResetFree
from mtjax.types import InputError, Transition

PLACES = np.array([(-2.5, -1), (-2.5, 1), (0, 2), (0, -2), (2.5, 0)])
START = 4
KEY = jax.random.key(0)
ENV = mtjax.make("tabletop")
SPARSE = mtjax.make("tabletop", reward_kind="sparse")


def listed():
    """The training task with its draws."""
    return jax.tree.map(lambda x: x[0], ENV.tasks())


def task_to(goal, **values):
    """The task with this goal."""
    task = listed()._replace(draws=None)
    return task._replace(goal=task.goal | {"goal": jnp.float32(goal)} | {k: jnp.float32(x) for k, x in values.items()})


def table(gripper, thing, held=0.0):
    """A world in this state."""
    state = ENV.reset(task_to(0), KEY).state
    return state._replace(gripper=jnp.float32(gripper), object=jnp.float32(thing), held=jnp.float32(held))


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def follow(env, task, state, actions):
    """Steps (H, ...) of a world under actions (H, 3)."""

    def once(state, action):
        step = env.step(task, state, action)
        return step.state, step

    return jax.lax.scan(once, state, actions)[1]


# Rules.


def move_on(gripper, thing, held, action, pace, reach):
    """EARL's rules: grip if near, or let go; then move, and take along what is gripped."""
    held = action[2] > 0 and (held or np.linalg.norm(gripper - thing) < reach)
    moved = np.clip(gripper + pace * np.clip(action[:2], -1, 1), -2.8, 2.8)
    return moved, np.clip(thing + moved - gripper, -2.8, 2.8) if held else thing, held


def way(gripper, thing, goal):
    """What is left to go: home from an object that is where it should be, else with it to its goal and home."""
    if np.linalg.norm(thing - goal) <= 0.1:
        return np.linalg.norm(gripper)
    return np.linalg.norm(gripper - thing) + np.linalg.norm(thing - goal) + np.linalg.norm(goal)


@pytest.mark.parametrize("values", [{"pace": 0.2, "reach": 0.4}, {"pace": 0.35, "reach": 0.9}])
def test_a_table_moves_by_the_rules_of_earl(values):
    """300 random actions, beyond their bounds too, near a corner of the table; the object is gripped and let go."""
    random = np.random.default_rng(0)
    actions = random.uniform([-1.3, -1.35, -0.6], [1.7, 1.65, 2.4], (300, 3))
    gripper, thing, held = np.array([1.0, 1.0]), np.array([1.2, 1.1]), False
    task, goal = task_to(1, **values), PLACES[1]
    steps = follow(ENV, task, table(gripper, thing), jnp.float32(actions))
    found, left = [], way(gripper, thing, goal)
    for action in actions:
        gripper, thing, held = move_on(gripper, thing, held, action, **values)
        before, left = left, way(gripper, thing, goal)
        there = np.hypot(np.linalg.norm(gripper), np.linalg.norm(thing - goal)) <= 0.2
        close = np.clip(np.concatenate([thing - gripper, goal - thing, -gripper]) / 0.4, -1, 1)
        obs = np.concatenate([gripper / 2.8, thing / 2.8, goal / 2.8, [held], close])
        found.append((gripper, thing, held, before - left + there, obs))
    gripper, thing, held, reward, obs = (np.array(x, np.float64) for x in zip(*found, strict=True))
    np.testing.assert_allclose(steps.state.gripper, gripper, atol=1e-4)
    np.testing.assert_allclose(steps.state.object, thing, atol=1e-4)
    np.testing.assert_array_equal(steps.state.held, held)
    np.testing.assert_allclose(steps.reward, reward, atol=1e-4)
    np.testing.assert_allclose(steps.obs, obs, atol=1e-3)
    assert 0.05 < held.mean() < 0.95 and np.abs(gripper).max() == pytest.approx(2.8)
    assert not np.any(steps.terminated) and not ENV.ends_early


def test_an_object_is_gripped_when_it_is_near_before_the_step():
    """Within the reach alone; it keeps its distance while it is held, and stays where it is let go."""
    task, still, along = task_to(0), [0.0, 0.0], [1.0, -0.5]
    cases = (([0.39, 0.0], 1.0, 1.0), ([0.41, 0.0], 1.0, 0.0), ([0.39, 0.0], 0.0, 0.0), ([0.3, 0.3], 1.0, 0.0))
    for thing, grip, held in cases:
        step = ENV.step(task, table(still, thing), jnp.array([*along, grip]))
        moved = np.array([0.2, -0.1]) * held
        assert float(step.state.held) == held
        np.testing.assert_allclose(step.state.object, np.array(thing) + moved, atol=1e-6)
    far = ENV.step(task, table(still, [1.0, 1.0], held=1.0), jnp.array([*along, 0.1])).state
    assert far.held == 1 and np.allclose(far.object, [1.2, 0.9])  # what is held stays so, however far
    free = ENV.step(task, far, jnp.array([*along, -0.1])).state
    assert free.held == 0 and np.allclose(free.object, far.object) and np.allclose(free.gripper, [0.4, -0.2])


@pytest.mark.parametrize("goal", range(5))
def test_success_asks_for_the_object_at_its_goal_and_the_gripper_at_home(goal):
    """Together within 0.2 m, as EARL has it; held or not."""
    task = task_to(goal)
    cases = (([0.1, 0.1], [0.1, 0.09], 1), ([0.1, 0.1], [0.1, 0.11], 0), ([0, 0], [0, 0.21], 0), ([0.21, 0], [0, 0], 0))
    for gripper, off, there in cases:
        state = table(gripper, PLACES[goal] + off)
        assert float(ENV.metrics(task, state, None)["success"]) == float(SPARSE.reward(task, state, None)) == there
        assert float(ENV.reward(task, state._replace(gained=jnp.float32(0.5)), None)) == there + 0.5
        far = np.hypot(np.linalg.norm(gripper), np.linalg.norm(off)) / 0.2
        assert float(ENV.distance(task, state)) == pytest.approx(far, rel=1e-4)


def scripted(state, goal):
    """To the object, with it to its goal, and home."""
    off = goal - state.object
    there = jnp.linalg.norm(off) < 0.05
    near = jnp.linalg.norm(state.gripper - state.object) < 0.3
    way = jnp.where(there, -state.gripper, jnp.where(near, off, state.object - state.gripper))
    return jnp.append(jnp.clip(way / 0.2, -1, 1), jnp.where(near & ~there, 1.0, -1.0))


def test_a_scripted_gripper_solves_every_task_from_every_other():
    """Round all five places without a reset, and what rewards tell of the way adds up to all of it."""

    @partial(jax.jit, compiler_options=QUICK)
    def play(task, state):
        def once(state, _):
            step = ENV.step(task, state, scripted(state, jnp.float32(PLACES)[task.goal["goal"].astype(int)]))
            return step.state, step

        return jax.lax.scan(once, state, length=200)

    state = ENV.reset(task_to(0), KEY).state
    for goal in (0, 1, 2, 3, START, 2, 0, 3, 1, START):
        whole = way(np.asarray(state.gripper), np.asarray(state.object), PLACES[goal])
        state, steps = play(task_to(goal), state)
        success = np.asarray(steps.metrics["success"])
        assert success[-1] == 1 and 10 < np.argmax(success) < 80 and np.all(np.diff(success) >= 0)
        earned = float(np.sum(steps.reward)) - success.sum()
        assert earned == pytest.approx(whole - np.linalg.norm(state.gripper), abs=1e-3)


# Tasks.


def test_starts_are_near_one_place_and_differ():
    """By up to 0.1 m; nothing is held, and the way back is done there."""
    states = jax.vmap(lambda key: ENV.reset(task_to(0), key).state)(jax.random.split(KEY, 500))
    off = np.concatenate([states.gripper, states.object - PLACES[START]], axis=1)
    assert np.all(np.abs(off) <= 0.1 + 1e-6) and np.all(np.ptp(off, axis=0) > 0.19) and not np.any(states.held)
    assert np.all(jax.vmap(ENV.distance, (None, 0))(ENV.returning(task_to(0)), states) <= 1 + 1e-5)


def test_episodes_draw_the_goals_that_are_listed():
    """By number or by name; evaluations play each as often; a range of another parameter is drawn with them."""
    draws = ENV.tasks().draws
    assert draws.goal["goal"].tolist() == [[0, 1, 2, 3]] and draws.context is None
    keys = jax.random.split(KEY, (1, 1, 8))
    assert sorted(np.asarray(draw_in_turn(ENV.tasks(), keys).goal["goal"]).ravel()) == [0, 0, 1, 1, 2, 2, 3, 3]
    named = mtjax.make("tabletop", vary={"goal": "left,start"})
    assert named.tasks().draws.goal["goal"].tolist() == [[2, 4]]
    reach = mtjax.make("tabletop", vary={"reach": "0.3:0.5"}, num_draws=8).tasks()
    assert len(reach.id) == 1 and np.ptp(reach.draws.goal["reach"]) > 0.15 and reach.draws.id.shape == (1, 32)
    assert {*np.asarray(reach.draws.goal["goal"]).ravel().tolist()} == {0, 1, 2, 3}
    with pytest.raises(InputError, match="goal is one of 0"):
        mtjax.make("tabletop", vary={"goal": "0:3"})
    with pytest.raises(InputError, match="unknown reward-kind 'sprase'; did you mean 'sparse'"):
        mtjax.make("tabletop", reward_kind="sprase")


@pytest.mark.parametrize("env", [ENV, SPARSE])
def test_steps_are_relabelled_as_the_other_task_would_have_had_them(env):
    """What is observed and what is earned, exactly; also where the object arrives."""
    actions = jnp.float32(np.random.default_rng(1).uniform([-1, -1, -0.2], [1, 1, 1.8], (60, 3)))
    start = table(*(PLACES[2] - [(0.3, 0.4), (0.05, 0.2)]))
    for one, other in ((0, 2), (2, START)):
        before, after = (follow(env, task_to(goal), start, actions) for goal in (one, other))
        for i in (1, 2, 10, 59):
            steps = [
                Transition(x.obs[i - 1], actions[i], x.reward[i], jnp.float32(1), x.obs[i]) for x in (before, after)
            ]
            found = env.relabel(task_to(other), steps[0], KEY)
            for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(steps[1]), strict=True):
                np.testing.assert_allclose(x, y, atol=2e-5)


# What follows in worlds that are not reset.


def chosen(name, task, state, count=200):
    """The goals that may follow, by how often they do."""
    choose = lambda key: curricula.read(name).follow(ENV, listed(), task, state, key).goal["goal"]
    goals = np.asarray(jax.vmap(choose)(jax.random.split(KEY, count)))
    return {int(goal): float(np.mean(goals == goal)) for goal in np.unique(goals)}


def test_forward_and_backward_take_turns():
    """After every goal the way back, wherever the world is; after the way back any goal, and each as often."""
    state = table([1.0, 1.0], [-1.0, 0.5])
    assert all(chosen("forward-backward", task_to(goal), state) == {START: 1.0} for goal in range(4))
    goals = chosen("forward-backward", task_to(START), state)
    assert set(goals) == {0, 1, 2, 3} and all(0.15 < share < 0.35 for share in goals.values())
    assert set(chosen("all", task_to(2), state)) == {0, 1, 2, 3}


@pytest.mark.parametrize(
    ("gripper", "thing", "follows"),
    [
        ([0.0, 0.0], [2.5, 0.0], {0, 1, 2, 3}),
        ([0.1, 0.0], [0.0, 2.1], {0, 1, 3, START}),
        ([0.0, 0.0], [1.5, 0.0], {START}),
        ([0.0, 0.3], [0.0, 2.0], {2}),
        ([2.0, 2.0], [-2.0, -0.2], {0}),
    ],
)
def test_a_graph_goes_from_an_end_to_any_other_and_from_elsewhere_to_the_nearest(gripper, thing, follows):
    """Whatever was played before."""
    for before in (0, START):
        assert set(chosen("graph", task_to(before), table(gripper, thing))) == follows


def play(curriculum, chunks=3, reset_free=True, num_envs=4):
    """Chunks of 100 steps of some worlds, two episodes long: goals, and places of gripper and object, after each."""
    env = mtjax.make("tabletop")
    agent, settings = configure(
        tiny("ppo"),
        loop.Settings(curriculum=curriculum, reset_free=reset_free),
        {"num_envs": num_envs, "chunk_steps": 200, "stagger": False, "unroll": 50, "epochs": 1, "minibatches": 1},
    )
    assert settings.trial == ResetFree(settings.plays)
    state = loop.init(env, agent, settings, env.tasks(), jnp.arange(2))
    seen = [jax.device_get(state.worlds)]
    for _ in range(chunks):
        state, _ = loop.run_chunk(env, agent, settings, env.tasks(), state)
        seen.append(jax.device_get(state.worlds))
    goals = np.stack([worlds.task.goal["goal"][:, 0] for worlds in seen])  # (chunks + 1, S, E)
    for worlds, goal in zip(seen, goals, strict=True):
        np.testing.assert_allclose(worlds.obs[:, 0, :, 4:6] * 2.8, PLACES[goal.astype(int)], atol=1e-5)
    places = lambda name: np.stack([getattr(worlds.state, name)[:, 0] for worlds in seen])  # (chunks + 1, S, E, 2)
    return goals, places("gripper"), places("object")


@pytest.mark.slow
def test_worlds_play_on_forward_and_backward():
    """The goal changes where an episode's time is up, and the gripper is where it was."""
    goals, gripper, _ = play("forward-backward")
    assert np.all(goals[::2] < START) and np.all(goals[1::2] == START)
    assert np.all(np.linalg.norm(gripper[1:], axis=-1) > 0.15)  # no world is at its start


@pytest.mark.slow
def test_worlds_play_on_by_the_graph():
    """Each goal is one that follows from where gripper and object are. Of many worlds some have moved the object."""
    goals, gripper, thing = play("graph")
    assert np.all(goals[0] < START) and np.all(np.linalg.norm(gripper[1:], axis=-1) > 0.15)
    assert len(np.unique(play("graph", num_envs=64)[0][1:])) > 1
    for k, seed, world in np.ndindex(*goals[1:].shape):
        at = k + 1, seed, world
        assert int(goals[at]) in chosen("graph", task_to(goals[k, seed, world]), table(gripper[at], thing[at]))


@dataclasses.dataclass(frozen=True)
class NoWayBack:
    """A family that does not say how worlds get back."""

    def tasks(self, split):
        return ENV.tasks(split)


def test_ways_back_are_refused_where_there_are_none():
    """With resets, and in families without a task for it."""
    agent = tiny("ppo")
    for name in ("forward-backward", "graph"):
        settings = loop.Settings(curriculum=name)
        with pytest.raises(InputError, match=f"the curriculum {name} is for worlds that are not reset; add --reset-fr"):
            combinations.require_env(settings, ENV, agent)
        settings = dataclasses.replace(settings, reset_free=True)
        combinations.require_env(settings, ENV, agent)
        with pytest.raises(InputError, match="needs a way back to the start"):
            combinations._require_way_back(settings, NoWayBack())
