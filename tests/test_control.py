"""Cart-pole and acrobot against MTEnv's equations, written out here in float64, and the rules around them."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import tiny

import mtjax
from mtjax.config import configure
from mtjax.envs.mtenv.control import (
    Acrobot,
    AcrobotState,
    CartPole,
    CartPoleState,
    acrobot_numbers,
    acrobot_parameters,
    cartpole_numbers,
    cartpole_parameters,
    choose,
)
from mtjax.learning import loop

CARTPOLE_RANGES = {
    "gravity": (4.8, 14.8),
    "cart-mass": (0.5, 1.5),
    "pole-mass": (0.01, 0.19),
    "pole-length": (0.2, 0.8),
    "force": (-10.0, 10.0),
}
ACROBOT_RANGES = {
    "link-length-1": (0.5, 1.5),
    "link-length-2": (0.5, 1.5),
    "link-mass-1": (0.5, 1.5),
    "link-mass-2": (0.5, 1.5),
    "torque-sign": (-1.0, 1.0),
}
COUNT = 500
TOP_SPEEDS = np.array([5 * math.pi, 11 * math.pi])


def drawn(family, ranges, **settings):
    """Tasks in MTEnv's ranges, as the registered families draw them."""
    vary = {name: f"{low}:{high}" for name, (low, high) in ranges.items()}
    return family(vary=vary, **({"combine": "random", "num_tasks": COUNT, "split": "none"} | settings))


CARTPOLE, ACROBOT = drawn(CartPole, CARTPOLE_RANGES), drawn(Acrobot, ACROBOT_RANGES)


@pytest.fixture(scope="module")
def cartpole():
    """One step, over tasks, states and actions (COUNT, ...)."""
    return jax.jit(jax.vmap(CARTPOLE.step))


@pytest.fixture(scope="module")
def acrobot():
    return jax.jit(jax.vmap(ACROBOT.step))


def first(env):
    return jax.tree.map(lambda x: x[0], env.tasks())


def values_of(env):
    """The parameters of every task, in float64."""
    return {name: np.float64(x) for name, x in env.table.tasks.goal.items()}


def assert_close(ours, theirs, error=1e-5):
    np.testing.assert_array_less(np.abs(ours - theirs), error * np.maximum(1, np.abs(theirs)))


def cartpole_reference(p, x, force):
    """The state (R, 4) after one Euler step of 0.02 s."""
    _, velocity, angle, turning = x.T
    total, moment = p["cart-mass"] + p["pole-mass"], p["pole-mass"] * p["pole-length"]
    sin, cos = np.sin(angle), np.cos(angle)
    base = (force + moment * turning**2 * sin) / total
    inertia = p["pole-length"] * (4 / 3 - p["pole-mass"] * cos**2 / total)
    turn = (p["gravity"] * sin - cos * base) / inertia
    return x + 0.02 * np.stack([velocity, base - moment * turn * cos / total, turning, turn], axis=1)


def test_cartpole_follows_the_equations(cartpole):
    """500 tasks, states and pushes: states to 1e-5 of their size, and the same falls; the reward is always 1."""
    random = np.random.default_rng(0)
    x = np.float32(random.uniform([-2.4, -3, -0.21, -3], [2.4, 3, 0.21, 3], (COUNT, 4)))
    action = random.uniform(-1, 1, (COUNT, 1))
    step = cartpole(CARTPOLE.tasks(), CartPoleState(*jnp.asarray(x.T)), jnp.float32(action))
    p = values_of(CARTPOLE)
    expected = cartpole_reference(p, np.float64(x), np.where(action[:, 0] >= 0, 1, -1) * p["force"])
    assert_close(step.obs, expected)
    fallen = (np.abs(expected[:, 0]) > 2.4) | (np.abs(expected[:, 2]) > math.radians(12))
    np.testing.assert_array_equal(step.terminated, fallen)
    assert 20 < fallen.sum() < COUNT - 20
    np.testing.assert_array_equal(step.reward, np.ones(COUNT))


@pytest.mark.parametrize(
    ("state", "falls"),
    [
        ((2.39, 0, 0, 0), False),
        ((2.41, 0, 0, 0), True),
        ((-2.41, 0, 0, 0), True),
        ((0, 0, 0.209, 0), False),
        ((0, 0, 0.21, 0), True),
        ((0, 0, -0.21, 0), True),
    ],
)
def test_a_cartpole_falls_at_its_limits(state, falls):
    """2.4 m from the centre, and 12 degrees (0.2094 rad) from upright; both counted after the step."""
    step = jax.jit(CARTPOLE.step)(first(CARTPOLE), CartPoleState(*jnp.float32(state)), jnp.ones(1))
    assert bool(step.terminated) == falls


def test_a_negative_force_exchanges_the_two_pushes(cartpole):
    """And a push of either sign is full, however small its action; 0 counts as forward."""
    tasks = CARTPOLE.tasks()
    turned = tasks._replace(goal=tasks.goal | {"force": -tasks.goal["force"]})
    state = jax.vmap(CARTPOLE.reset)(tasks, jax.random.split(jax.random.key(0), COUNT)).state
    push = lambda tasks, action: cartpole(tasks, state, jnp.full((COUNT, 1), action)).obs
    np.testing.assert_array_equal(push(tasks, 1.0), push(turned, -1.0))
    for weak, full in ((0.0, 1.0), (0.01, 1.0), (-0.01, -1.0)):
        np.testing.assert_array_equal(push(tasks, weak), push(tasks, full))
    assert not np.array_equal(push(tasks, 1.0), push(tasks, -1.0))


def acrobot_slope(p, x, torque):
    """The rates (R, 4) of angles and velocities, from the two equations of motion solved together."""
    angle_1, angle_2, rate_1, rate_2 = x.T
    m1, m2, l1, c, g, inertia = p["link-mass-1"], p["link-mass-2"], p["link-length-1"], 0.5, 9.8, 1.0
    cross = m2 * (c**2 + l1 * c * np.cos(angle_2)) + inertia
    matrix = np.empty((len(x), 2, 2))
    matrix[:, 0, 0] = m1 * c**2 + m2 * (l1**2 + c**2 + 2 * l1 * c * np.cos(angle_2)) + 2 * inertia
    matrix[:, 0, 1] = matrix[:, 1, 0] = cross
    matrix[:, 1, 1] = m2 * c**2 + inertia
    phi_2 = m2 * c * g * np.cos(angle_1 + angle_2 - np.pi / 2)
    phi_1 = -m2 * l1 * c * np.sin(angle_2) * (rate_2**2 + 2 * rate_1 * rate_2)
    phi_1 += (m1 * c + m2 * l1) * g * np.cos(angle_1 - np.pi / 2) + phi_2
    right = np.stack([-phi_1, torque - phi_2 - m2 * l1 * c * rate_1**2 * np.sin(angle_2)], axis=1)
    return np.concatenate([x[:, 2:], np.linalg.solve(matrix, right[..., None])[..., 0]], axis=1)


def acrobot_reference(p, x, torque, dt=0.2):
    """The state (R, 4) after one step of the classic Runge-Kutta method, wrapped and held."""
    one = acrobot_slope(p, x, torque)
    two = acrobot_slope(p, x + dt / 2 * one, torque)
    three = acrobot_slope(p, x + dt / 2 * two, torque)
    four = acrobot_slope(p, x + dt * three, torque)
    x = x + dt / 6 * (one + 2 * two + 2 * three + four)
    angles = (x[:, :2] + np.pi) % (2 * np.pi) - np.pi
    return np.concatenate([angles, np.clip(x[:, 2:], -TOP_SPEEDS, TOP_SPEEDS)], axis=1)


def acrobot_states(random, speeds):
    return np.float32(random.uniform([-np.pi, -np.pi, *-np.array(speeds)], [np.pi, np.pi, *speeds], (COUNT, 4)))


def test_acrobot_follows_the_equations(acrobot):
    """500 tasks, states and torques at up to 4 and 9 rad/s: observations to 1e-5 of their size, and the same ends.

    Near the speed limits (16 and 35 rad/s) one step of 0.2 s turns several times, and amplifies float32's rounding of
    its input beyond that.
    """
    random = np.random.default_rng(1)
    x, choices = acrobot_states(random, (4, 9)), random.integers(0, 3, COUNT)
    action = np.array([-0.7, 0.1, 0.6])[choices]
    state = AcrobotState(jnp.asarray(x[:, :2]), jnp.asarray(x[:, 2:]))
    step = acrobot(ACROBOT.tasks(), state, jnp.float32(action)[:, None])
    p = values_of(ACROBOT)
    expected = acrobot_reference(p, np.float64(x), (choices - 1) * np.where(p["torque-sign"] > 0, 1, -1))
    angles = expected[:, :2]
    turns = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(COUNT, 4)
    assert_close(step.obs, np.concatenate([turns, expected[:, 2:]], axis=1))
    assert np.all(np.abs(step.state.angles) <= np.float32(np.pi))
    there = -np.cos(angles[:, 0]) - np.cos(angles.sum(axis=1)) > 1
    np.testing.assert_array_equal(step.terminated, there)
    np.testing.assert_array_equal(step.reward, np.where(there, 0, -1))
    assert 20 < there.sum() < COUNT - 20


def test_acrobot_speeds_are_held(acrobot):
    """From anywhere within the limits, nothing leaves them, and some states meet them."""
    x = acrobot_states(np.random.default_rng(2), TOP_SPEEDS)
    state = AcrobotState(jnp.asarray(x[:, :2]), jnp.asarray(x[:, 2:]))
    speeds = np.abs(acrobot(ACROBOT.tasks(), state, jnp.ones((COUNT, 1))).state.velocities)
    assert np.all(speeds <= np.float32(TOP_SPEEDS)) and np.all(speeds.max(axis=0) == np.float32(TOP_SPEEDS))


def test_acrobot_torque_goes_by_thirds_and_by_the_sign_of_the_task(acrobot):
    """A reversed task under -1 moves as an upright one under 1; the sign's size means nothing, and 0 is reversed."""
    tasks = ACROBOT.tasks()
    state = jax.vmap(ACROBOT.reset)(tasks, jax.random.split(jax.random.key(0), COUNT)).state

    def move(sign, action):
        signed = tasks._replace(goal=tasks.goal | {"torque-sign": jnp.full(COUNT, sign)})
        return np.asarray(acrobot(signed, state, jnp.full((COUNT, 1), action)).obs)

    np.testing.assert_array_equal(move(1.0, 1.0), move(-0.1, -1.0))
    np.testing.assert_array_equal(move(0.3, 0.4), move(0.0, -0.4))
    np.testing.assert_array_equal(move(1.0, 0.3), move(-1.0, -0.3))
    assert not np.allclose(move(1.0, 1.0), move(1.0, 0.0)) and not np.allclose(move(1.0, -1.0), move(1.0, 0.0))


def test_the_second_links_length_changes_nothing_and_every_other_parameter_something(acrobot):
    """MTEnv never reads it."""
    tasks, random = ACROBOT.tasks(), np.random.default_rng(3)
    x = acrobot_states(random, (1, 1))
    state = AcrobotState(jnp.asarray(x[:, :2]), jnp.asarray(x[:, 2:]))
    move = lambda goal: np.asarray(acrobot(tasks._replace(goal=goal), state, jnp.ones((COUNT, 1))).obs)
    for name in ACROBOT_RANGES:
        other = tasks.goal | {name: tasks.goal[name] + 0.3 if name != "torque-sign" else -tasks.goal[name]}
        assert np.array_equal(move(other), move(tasks.goal)) == (name == "link-length-2")


def test_edges_between_choices_belong_to_the_higher_one():
    """And both ends of the range are choices."""
    edges = np.float32([-1, -0.34, -0.33, 0.33, 0.34, 1])
    np.testing.assert_array_equal(choose(edges, 3), [0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(choose(jnp.float32([-1, -1e-6, 0, 1]), 2), [0, 0, 1, 1])


@pytest.mark.parametrize(("env", "width"), [(CARTPOLE, 0.05), (ACROBOT, 0.1)], ids=["cartpole", "acrobot"])
def test_episodes_start_near_rest(env, width):
    """All four numbers are uniform around 0, the same for the same key, and nothing has been earned."""
    keys = jax.random.split(jax.random.key(0), 2000)
    reset = jax.jit(jax.vmap(env.reset, (None, 0)))
    step = reset(first(env), keys)
    numbers = np.stack([x.reshape(2000, -1) for x in jax.tree.leaves(step.state)], axis=-1).reshape(2000, -1)
    assert numbers.shape[1] == 4 and np.abs(numbers).max() <= width
    np.testing.assert_allclose(numbers.std(axis=0), width / math.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(numbers.mean(axis=0), 0, atol=0.05 * width)
    assert not np.any(step.terminated) and not np.any(step.reward)
    again = reset(first(env), keys)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(step), jax.tree.leaves(again), strict=True))
    assert not np.array_equal(step.obs[0], step.obs[1])


@pytest.mark.parametrize(
    ("name", "ranges"), [("control-cartpole", CARTPOLE_RANGES), ("control-acrobot", ACROBOT_RANGES)]
)
def test_registered_families_draw_from_the_ranges(name, ranges):
    """Of which MTEnv draws."""
    found = mtjax.make(name).variation
    assert dict(zip(found.names, zip(found.low, found.high, strict=True), strict=True)) == ranges


@pytest.mark.parametrize(("env", "ranges"), [(CARTPOLE, CARTPOLE_RANGES), (ACROBOT, ACROBOT_RANGES)])
def test_random_tasks_fill_the_ranges(env, ranges):
    """The context is the varied parameters, each scaled to [-1, 1]; those that do not vary are nominal."""
    tasks = env.tasks()
    for column, (name, (low, high)) in enumerate(ranges.items()):
        values = np.asarray(tasks.goal[name])
        assert low <= values.min() < low + 0.02 * (high - low) and high - 0.02 * (high - low) < values.max() <= high
        scaled = (values - (low + high) / 2) / ((high - low) / 2)
        np.testing.assert_allclose(tasks.context[:, column], scaled, atol=1e-5)
    nominal = type(env)().tasks().goal
    assert {name: float(x[0]) for name, x in nominal.items()} == {
        name: pytest.approx(p.nominal) for name, p in env.parameters.items()
    }


def test_the_force_may_be_negative_and_a_mass_may_not():
    """A force has a direction."""
    env = CartPole(vary={"force": "-10,10"})
    np.testing.assert_array_equal(env.tasks().goal["force"], [-10, 10])
    with pytest.raises(ValueError, match="cart-mass must be greater than 0"):
        CartPole(vary={"cart-mass": "-1,1"})


def test_mtenv_numbers_of_a_cartpole():
    """Its five numbers and our five values stand for each other; a force of 0 N is 10 N there."""
    values = cartpole_parameters([1, -1, 0.5, -0.5, -0.25])
    assert values == pytest.approx(
        {"gravity": 14.8, "cart-mass": 0.5, "pole-mass": 0.145, "pole-length": 0.35, "force": -2.5}
    )
    np.testing.assert_allclose(cartpole_numbers(values), [1, -1, 0.5, -0.5, -0.25])
    assert cartpole_parameters(np.zeros(5)) == pytest.approx({n: p.nominal for n, p in CartPole.parameters.items()})
    with pytest.raises(ValueError):
        cartpole_parameters(np.zeros(7))


def test_mtenv_numbers_of_an_acrobot():
    """Its seven numbers, of which it reads five, and our five values stand for each other."""
    values = acrobot_parameters([1, -1, 0.5, -0.5, 0.8, 0.9, -0.25])
    expected = {"link-length-1": 1.5, "link-length-2": 0.5, "link-mass-1": 1.25, "link-mass-2": 0.75}
    assert values == pytest.approx(expected | {"torque-sign": -0.25})
    np.testing.assert_allclose(acrobot_numbers(values), [1, -1, 0.5, -0.5, 0, 0, -0.25])
    with pytest.raises(ValueError):
        acrobot_parameters(np.zeros(5))


def seen(env, row, state):
    """The scene of a task with its bodies where a picture of the state shows them."""
    model = env.scene_model(row)
    data = mujoco.MjData(model)
    data.qpos[:] = env.visible(None, state).joints
    mujoco.mj_forward(model, data)
    return data


def test_a_picture_shows_the_cart_and_a_pole_of_the_tasks_length():
    """A pole leans towards positive x where its angle is positive. Its middle is at half its length."""
    env = mtjax.make("control-cartpole", vary={"pole-length": "0.3,0.8"}, combine="grid", split="none")
    for row, length in enumerate((0.3, 0.8)):
        data = seen(env, row, CartPoleState(*map(jnp.float32, (-1.2, 0, 0.2, 0))))
        np.testing.assert_allclose(data.geom_xpos[1], [-1.2, 0, 0], atol=1e-6)
        middle = [-1.2 + length * math.sin(0.2), -0.2, length * math.cos(0.2)]
        np.testing.assert_allclose(data.geom_xpos[2], middle, atol=1e-6)


def test_a_picture_shows_both_links_of_an_acrobot():
    """Its end is where the episode's rule has it: above the bar exactly if the episode ends."""
    first, second = 2.5, 0.4
    data = seen(ACROBOT, 0, AcrobotState(jnp.array([first, second]), jnp.zeros(2)))
    elbow = np.array([math.sin(first), 0, -math.cos(first)])
    np.testing.assert_allclose(data.geom_xpos[1], elbow / 2, atol=1e-6)
    half = np.array([math.sin(first + second), 0, -math.cos(first + second)]) / 2
    np.testing.assert_allclose(data.geom_xpos[2], elbow + half, atol=1e-6)
    assert data.geom_xpos[0, 2] == 1


@pytest.mark.parametrize("env", [CARTPOLE, ACROBOT], ids=["cartpole", "acrobot"])
def test_an_agent_trains_on_it(env):
    """Traced, not run: the loop, agent and tasks fit together, and time limits are the loop's to count."""
    env, agent = dataclasses.replace(env, num_tasks=3), tiny("sac-conditioned")
    given = {"num_envs": 2, "batch_size": 4, "replay_size": 12, "warmup_steps": 1, "chunk_steps": 2}
    agent, settings = configure(agent, loop.Settings(), given)
    assert env.episode_length == 500
    state = jax.eval_shape(lambda: loop.init(env, agent, settings, env.tasks(), jnp.arange(1)))
    after, _ = jax.eval_shape(lambda state: loop.run_chunk(env, agent, settings, env.tasks(), state), state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
