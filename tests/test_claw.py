"""The claw that turns a valve: its rewards, its tasks, how far fingers turn it, and worlds without resets."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import configure, tiny

import mtjax
from mtjax.learning import curricula, loop
from mtjax.learning.evaluation import draw_in_turn
from mtjax.types import InputError, Transition

KEY = jax.random.key(0)
ENV = mtjax.make("claw", engine="c")
SPARSE = mtjax.make("claw", engine="c", reward_kind="sparse")
SWING = jnp.array([0, 3, 6])  # the places of the fingers' swings in an action


def task_to(goal):
    """The task with this goal."""
    task = jax.tree.map(lambda x: x[0], ENV.tasks())._replace(draws=None)
    return task._replace(goal=task.goal | {"goal": jnp.float32(goal)})


def turned_to(angle, velocity=0.0):
    """A world at rest whose valve has this angle."""
    world = ENV.without_physics().reset(task_to(0.5), KEY).state
    return world._replace(qpos=world.qpos.at[0].set(angle), qvel=world.qvel.at[0].set(velocity))


@pytest.mark.parametrize(
    ("goal", "angle", "off"),
    [(0.5, 0.5, 0.0), (0.5, 0.59, 0.09), (1.0, -0.5, -1.5), (-1.0, 2.6 + 2 * math.pi, -2.683185)],
)
def test_rewards_are_those_of_the_shortest_turn(goal, angle, off):
    """Worked by hand; whole turns of the valve do not matter."""
    task, world, there = task_to(goal), turned_to(angle), float(abs(off) <= 0.1)
    assert ENV.reward(task, world, None) == pytest.approx((there + 1 - abs(off) / math.pi) / 2, abs=1e-5)
    assert SPARSE.reward(task, world, None) == ENV.metrics(task, world, None)["success"] == there
    assert ENV.distance(task, world) == pytest.approx(abs(off) / 0.1, abs=1e-4)
    seen = ENV.observe(task, world)
    assert seen.shape == (23,) and math.atan2(seen[-1], seen[-2]) == pytest.approx(off, abs=1e-5)


@pytest.fixture(scope="module")
def play():
    """A function that returns the angle of the valve after each of the actions (H, 9)."""

    @jax.jit
    def angles(actions):
        task = task_to(0.5)
        begun = ENV.reset(task, KEY).state
        begun = begun._replace(qpos=jnp.zeros(10))
        step = lambda state, action: (after := ENV.step(task, state, action).state, after.qpos[0])
        return jax.lax.scan(step, begun, actions)[1]

    return angles


def held(swing, upper, steps=12):
    """Actions that bring all fingers to a swing and a bend, which 12 steps of 0.04 s are enough for."""
    action = jnp.zeros(9).at[SWING].set(swing).at[SWING + 1].set(upper)
    return jnp.broadcast_to(action, (steps, 9))


def test_fingers_turn_the_valve_further_if_they_take_hold_again(play):
    """A push turns it by part of a turn, to both sides; letting go, going back and pushing again turns it on."""
    again = [held(-0.9, 0.8), held(-0.9, 0.0), held(0.9, 0.0), held(0.9, 0.8)]
    angles = np.asarray(play(jnp.concatenate([held(0.9, 0.0), held(0.9, 0.8), *again, *again])))
    pushed, second, third = angles[11], angles[71], angles[119]
    assert 0.2 < pushed < 2 and second > pushed + 0.5 and third > second + 0.5, (pushed, second, third)
    back = np.asarray(play(held(-0.9, 0.0, 120)))
    assert -2 < back[-1] < -0.2


def test_starts_are_at_rest_within_a_tenth_of_a_radian():
    starts = jax.vmap(ENV.reset, (None, 0))(task_to(1), jax.random.split(KEY, 200)).state
    qpos, moving = np.asarray(starts.qpos), np.asarray(starts.qvel)
    assert np.abs(qpos).max() <= 0.1 and np.all(np.ptp(qpos, axis=0) > 0.19) and not moving.any()
    assert not np.any(jax.vmap(ENV.simulator.touching, (None, 0))(task_to(1), starts.qpos))
    assert np.all(jax.vmap(ENV.distance, (None, 0))(ENV.returning(task_to(1)), starts) <= 1 + 1e-5)


def test_episodes_draw_the_goals_that_are_listed():
    draws = ENV.tasks().draws
    assert draws.goal["goal"].tolist() == [[-2, -1, 1, 2]] and draws.context is None
    keys = jax.random.split(KEY, (1, 1, 8))
    assert sorted(np.ravel(draw_in_turn(ENV.tasks(), keys).goal["goal"])) == [-2, -2, -1, -1, 1, 1, 2, 2]
    with pytest.raises(InputError, match="unknown reward-kind 'spares'; did you mean 'sparse'"):
        mtjax.make("claw", reward_kind="spares")


def test_the_friction_of_the_valve_is_that_of_its_joint():
    env = mtjax.make("claw", {"valve-friction": "0.01,0.3", "goal": "1"}, num_tasks=2, combine="paired")
    found = {round(float(model.dof_frictionloss[0]), 3) for model in env.models}
    assert found == {0.01, 0.3} and np.all(env.models[0].dof_frictionloss[1:] == 0)


@pytest.mark.parametrize("env", [ENV, SPARSE], ids=["dense", "sparse"])
def test_steps_are_relabelled_as_the_other_goal_would_have_had_them(env):
    before, after = turned_to(0.42, -0.3), turned_to(0.55)
    action = jnp.zeros(9)
    seen = lambda goal: Transition(
        env.observe(task_to(goal), before),
        action,
        env.reward(task_to(goal), after, action),
        jnp.float32(1),
        env.observe(task_to(goal), after),
    )
    found = env.relabel(task_to(0.5), seen(-1.0), KEY)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(seen(0.5)), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)
    assert float(seen(-1.0).reward) != float(found.reward)


def test_a_graph_goes_on_from_the_goal_that_the_valve_is_at():
    choose = lambda state: curricula.read("graph").follow(
        ENV, jax.tree.map(lambda x: x[0], ENV.tasks()), task_to(0), state, KEY
    )
    assert float(choose(turned_to(1.3)).goal["goal"]) == 1  # the nearest
    assert float(choose(turned_to(1.0)).goal["goal"]) != 1  # any other


@pytest.mark.slow
def test_worlds_go_on_forward_and_backward_where_episodes_end():
    """The goal changes to the way back, and the fingers are where they were."""
    settings = loop.Settings(curriculum="forward-backward", reset_free=True)
    given = {"num_envs": 4, "chunk_steps": 100, "stagger": False, "unroll": 50, "epochs": 1, "minibatches": 1}
    agent, settings = configure(tiny("ppo"), settings, given)
    state = loop.init(ENV, agent, settings, ENV.tasks(), jnp.arange(2))
    goals = [np.asarray(state.worlds.task.goal["goal"])]
    for _ in range(2):
        state, _ = loop.run_chunk(ENV, agent, settings, ENV.tasks(), state)
        goals.append(np.asarray(state.worlds.task.goal["goal"]))
    assert np.all(goals[0] != 0) and np.all(goals[1] == 0) and np.all(goals[2] != 0)
    assert np.all(np.abs(np.asarray(state.worlds.state.qpos)[..., 1:]).max(axis=-1) > 0.15)


@pytest.mark.nightly
def test_mjx_steps_the_claw_as_c_does(count=32):
    """From worlds in which random actions have moved it for a while; in contact the solver stops sooner in float32."""
    other = mtjax.make("claw", engine="mjx", solver_iterations=50)
    task, keys = task_to(0.5), jax.random.split(KEY, count)
    actions = jax.random.uniform(KEY, (40, count, 9), minval=-1.0)
    step = lambda env: jax.vmap(lambda state, action: env.step(task, state, action).state)

    @jax.jit
    def play():
        begun = jax.vmap(lambda key: ENV.reset(task, key).state)(keys)
        return jax.lax.scan(lambda states, action: (step(ENV)(states, action), None), begun, actions)[0]

    before = jax.device_get(play())
    ours, theirs = (jax.device_get(jax.jit(step(env))(before, actions[0])) for env in (other, ENV))
    off = np.abs(ours.qvel - theirs.qvel).max(axis=1) / np.abs(theirs.qvel).max()
    assert np.median(off) < 1e-4 and np.quantile(off, 0.9) < 1e-2, np.sort(off)[-5:]
    assert np.ptp(before.qpos[:, 0]) > 0.5  # the valve has been turned
