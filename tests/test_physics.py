"""Both engines against dm_control and each other.

MJX compiles in ten seconds a program, so these tests share two steps and one ``set_physics``, all of 100 worlds: of
the sizes with twenty solver iterations, which stand for the converged solver (more change no bit of any state here),
and of the touch sizes with the default. What needs them is marked slow; ``test_engines`` holds MJX to C by default.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import set_physics

from mtjax import envs
from mtjax.envs.engines import base as physics
from mtjax.envs.physics import mjx_engine
from mtjax.types import InputError

STEPS = 50
NOMINAL = 1  # the row of finger-spin-vary-size whose size is 1
SIZE, TOUCH = "finger-spin-vary-size", "finger-spin-vary-touch-size"
ENGINES = {"c": {"engine": "c"}, "mjx": {"engine": "mjx", "solver_iterations": 20}}
slow = pytest.mark.slow
either_engine = pytest.mark.parametrize("engine", ["c", pytest.param("mjx", marks=slow)])


def make(name, engine):
    """A family; sizes over a wider range than the registered one, with the nominal size as its second."""
    wide = {"vary": {"size": "0.95:1.4:10"}} if name == SIZE else {}
    return envs.make(name, **wide, **ENGINES[engine])


def rows(env, ids):
    return jax.tree.map(lambda x: x[np.asarray(ids)], env.tasks("all"))


def worst(a, b):
    """The largest difference in each world."""
    return np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)).reshape(len(a), -1).max(axis=1)


def assert_within(errors, bounds):
    """Hold each quantile of the errors to its bound: contact amplifies rounding in a few worlds, not in most."""
    measured = {quantile: np.quantile(errors, quantile) for quantile in bounds}
    assert all(measured[q] <= bounds[q] for q in bounds), measured


def assert_same(a, b):
    """Hold every leaf to the same bits."""
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)


def begin(env, worlds):
    """The 100 shared states in the nominal task; from C, whose first state is dm_control's, for both engines."""
    tasks = rows(env, [NOMINAL if "size" in env.varied else 0] * 100)
    c = envs.make("finger-spin", engine="c")
    return tasks, jax.vmap(lambda t, q, v: set_physics(c, t, None, q, v))(rows(c, [0] * 100), worlds.qpos, worlds.qvel)


def start_suite(environment, qpos, qvel):
    environment.reset()
    with environment.physics.reset_context():
        environment.physics.data.qpos[:] = qpos
        environment.physics.data.qvel[:] = qvel


def round_suite(environment):
    """Store dm_control's state as we do between control steps."""
    model, data = environment.physics.model.ptr, environment.physics.data.ptr
    for value in (data.qpos, data.qvel, data.qacc_warmstart):
        value[:] = np.float32(value)
    mujoco.mj_step1(model, data)


def play_suite(environment, worlds, actions, rounded=False):
    """States (B, H, 6), observations (B, H, 9) and rewards (B, H) of ``Environment.step``."""
    states, observations, rewards = [], [], []
    for i in range(len(worlds.qpos)):
        start_suite(environment, worlds.qpos[i], worlds.qvel[i])
        for action in actions[:, i]:
            result = environment.step(action)
            observations.append(np.concatenate(list(result.observation.values())))
            rewards.append(result.reward)
            if rounded:
                round_suite(environment)
            states.append(np.concatenate([environment.physics.data.qpos, environment.physics.data.qvel]))
    shape = (len(worlds.qpos), len(actions))
    return tuple(np.array(x).reshape(*shape, *np.shape(x[0])) for x in (states, observations, rewards))


@pytest.fixture(scope="module")
def actions():
    """Fifty steps of actions for the 100 shared worlds, each held for five steps so that the finger travels."""
    return np.repeat(np.random.RandomState(2).uniform(-1, 1, (STEPS // 5, 100, 2)), 5, axis=0).astype(np.float32)


@pytest.fixture(scope="module")
def suite_play(suite_finger, worlds, actions):
    return play_suite(suite_finger, worlds, actions)


@pytest.fixture(scope="module")
def played(worlds, actions, programs):
    """Fifty steps of the nominal task in an engine: the first ``Step``, and states (B, H, 6)."""

    @lru_cache
    def play(engine):
        env = make(SIZE, engine)
        tasks, world = begin(env, worlds)
        first = step = programs(env).step(tasks, world, actions[0])
        states = [np.concatenate([step.state.qpos, step.state.qvel], axis=1)]
        for action in actions[1:]:
            step = programs(env).step(tasks, step.state, action)
            states.append(np.concatenate([step.state.qpos, step.state.qvel], axis=1))
        return first, np.stack(states, axis=1)

    return play


def test_one_step_of_c_is_that_of_dm_control(played, suite_play):
    """State, observation and reward after one step, to float32 rounding of numbers up to 45 (2e-6 each)."""
    step, (states, observations, rewards) = played("c")[0], suite_play
    assert np.sum(observations[:, 0, 7:].any(axis=1)) >= 20
    np.testing.assert_allclose(step.state.qpos, states[:, 0, :3], rtol=0, atol=1e-6)
    np.testing.assert_allclose(step.state.qvel, states[:, 0, 3:], rtol=0, atol=5e-6)
    np.testing.assert_allclose(step.obs, observations[:, 0], rtol=0, atol=5e-6)
    np.testing.assert_array_equal(step.reward, rewards[:, 0])
    assert 3 < step.reward.sum() < 97


@slow
def test_one_step_of_converged_mjx_is_that_of_dm_control(played, suite_play):
    """Without contact to float32 rounding; in contact to where a float32 solver stops, in a stiff elliptic cone.

    Some contacts lie outside the sensors, so that only half of the worlds that feel nothing are surely free.
    """
    step, (states, observations, rewards) = played("mjx")[0], suite_play
    touched = observations[:, 0, 7:].any(axis=1)
    assert touched.sum() >= 20
    qpos, qvel = worst(step.state.qpos, states[:, 0, :3]), worst(step.state.qvel, states[:, 0, 3:])
    assert_within(qvel[~touched], {0.5: 5e-6, 1: 5e-3})
    assert_within(qvel[touched], {0.5: 3e-4, 0.9: 5e-3, 1: 5e-2})
    assert_within(qpos, {0.5: 3e-6, 0.9: 1e-4, 1: 1e-3})
    assert_within(worst(step.obs[:, 7:], observations[:, 0, 7:]), {0.5: 1e-5, 0.9: 5e-4, 1: 1e-2})
    np.testing.assert_array_equal(step.reward, rewards[:, 0])


def test_fifty_steps_of_c_are_dm_control_with_a_float32_state(played, suite_finger, worlds, actions):
    """Bit for bit, once dm_control's state is rounded to float32 after each step: the engines are one code."""
    states, observations, _ = play_suite(suite_finger, worlds, actions, rounded=True)
    assert observations[:, :, 7:].any(axis=(1, 2)).sum() > 50
    np.testing.assert_array_equal(played("c")[1], states.astype(np.float32))


@pytest.mark.parametrize(
    ("engine", "bounds"), [("c", {0.5: 2e-5, 0.9: 1e-3}), pytest.param("mjx", {0.5: 1e-3, 0.8: 5e-2}, marks=slow)]
)
def test_fifty_steps_follow_dm_control(engine, bounds, played, suite_play):
    """Largest state error of each world on the way; no bound on the last tenth, where contact is chaotic."""
    assert suite_play[1][:, :, 7:].any(axis=(1, 2)).sum() > 50
    assert_within(worst(played(engine)[1], suite_play[0]), bounds)


@slow
def test_a_model_stacked_with_others_moves_as_it_does_alone(played, worlds, actions, programs):
    """MJX: size 1 from the table of ten sizes, against a family that stacks no dynamics and whose one model is size 1.

    That family stops after two iterations, which solves most contacts; a wrong model would be off in every world.
    """
    alone = envs.make(TOUCH, engine="mjx")
    assert "geom_size" in make(SIZE, "mjx").table.tasks.model and set(alone.table.tasks.model) == {"site_size"}
    tasks, world = begin(alone, worlds)
    step, stacked = programs(alone).step(tasks, world, actions[0]), played("mjx")[0]
    assert_within(worst(step.state.qvel, stacked.state.qvel), {0.5: 1e-5, 0.75: 1e-3})
    assert_within(worst(step.obs[:, :4], stacked.obs[:, :4]), {0.5: 1e-6, 0.75: 1e-5})


def contacts_in_play(env, programs, each):
    """Tasks, states and actions of ``each`` worlds of every training task whose touch sensors feel the next step."""
    count = len(env.tasks().id)
    tasks = rows(env, np.repeat(np.arange(count), 100))
    actions = np.random.RandomState(4).uniform(-1, 1, (10, 100 * count, 2)).astype(np.float32)
    world = programs(env).reset(tasks, jax.random.split(jax.random.key(4), 100 * count)).state
    found = [[] for _ in range(count)]
    for action in np.repeat(actions, 10, axis=0):
        before, step = world, programs(env).step(tasks, world, action)
        world = step.state
        for i in np.flatnonzero(np.any(step.obs[:, 7:] > 0, axis=1)):
            found[i // 100].append((jax.tree.map(lambda x, i=i: np.asarray(x)[i], before), action[i]))
    chosen = [entry for task in found for entry in task[:: len(task) // each][:each]]
    world, action = jax.tree.map(lambda *x: np.stack(x), *chosen)
    return rows(env, np.repeat(np.arange(count), each)), world, action


@pytest.fixture(scope="module")
def size_contacts(programs):
    """Ten worlds in contact of each of the ten sizes."""
    return contacts_in_play(make(SIZE, "c"), programs, each=10)


@slow
def test_ten_sizes_in_one_call_move_as_each_does_in_c(size_contacts, programs):
    """All ten stacked models in one MJX step, in contact, against MuJoCo C with each task's own model."""
    tasks, world, action = size_contacts
    c, mjx = (programs(make(SIZE, engine)).step(tasks, world, action) for engine in ENGINES)
    assert np.all(np.any(c.obs[:, 7:] > 0, axis=1))
    errors = worst(c.state.qvel, mjx.state.qvel).reshape(10, 10)
    assert np.all(np.median(errors, axis=1) < 2e-3)
    assert_within(errors, {0.5: 3e-4, 0.9: 5e-3, 1: 5e-2})
    assert_within(worst(c.obs, mjx.obs), {0.5: 3e-4, 0.9: 5e-3, 1: 5e-2})
    wrong = programs(make(SIZE, "c")).step(rows(make(SIZE, "c"), np.roll(tasks.id, 10)), world, action)
    assert np.median(worst(wrong.state.qvel, c.state.qvel)) > 0.1


@slow
def test_default_iterations_are_near_the_converged_solver(programs):
    """One step from the last step's solution: three contacts in four are solved, and the worst are hard impacts.

    An impact that the solver leaves early is off by as much as it should have changed the velocities; the bounds keep
    that to a tenth of contacts.
    """
    c, mjx = (envs.make(TOUCH, engine=engine) for engine in ENGINES)
    assert mjx_engine(mjx).base.opt.iterations == mjx.default_iterations
    tasks, (world, action) = (
        rows(c, [0] * 100),
        contacts_in_play(envs.make("finger-spin", engine="c"), programs, 100)[1:],
    )
    exact, early = (programs(env).step(tasks, world, action) for env in (c, mjx))
    assert np.median(worst(exact.state.qvel, world.qvel)) > 1
    assert_within(worst(exact.state.qvel, early.state.qvel), {0.75: 1e-3, 0.9: 2, 1: 25})


@slow
def test_c_agrees_with_itself_under_every_nesting_of_maps(worlds):
    """Seeds x tasks x environments in one callback are the single calls, bit for bit."""
    env = make(SIZE, "c")
    tasks = rows(env, [0, 5, 9])
    qpos, qvel, action = (x[:24].reshape(2, 3, 4, -1) for x in worlds)

    def play(task, qpos, qvel, action):
        return env.step(task, set_physics(env, task, None, qpos, qvel), action)

    mapped = play
    for task_axis in (None, 0, None):
        mapped = jax.vmap(mapped, (task_axis, 0, 0, 0))
    mapped, single = jax.jit(mapped)(tasks, qpos, qvel, action), jax.jit(play)
    assert np.sum(np.any(mapped.obs[..., 7:] > 0, axis=-1)) >= 5
    for i in np.ndindex(2, 3, 4):
        alone = single(jax.tree.map(lambda x, i=i: x[i[1]], tasks), qpos[i], qvel[i], action[i])
        assert_same(alone, jax.tree.map(lambda x, i=i: x[i], mapped))


@slow
def test_c_follows_a_change_of_tasks_between_calls(size_contacts, programs):
    """A batch that served some tasks serves the same number of others, and remembers nothing of the first."""
    tasks, world, action = size_contacts
    step = programs(make(SIZE, "c")).step
    first = step(tasks, world, action)
    other = step(*jax.tree.map(lambda x: x[::-1], (tasks, world, action)))
    assert_same(first, jax.tree.map(lambda x: x[::-1], other))
    assert_same(first, step(tasks, world, action))


@either_engine
def test_step_is_deterministic(engine, size_contacts, programs):
    """The same tasks, states and actions give the same bits."""
    step = programs(make(SIZE, engine)).step
    assert_same(step(*size_contacts), step(*size_contacts))


@pytest.fixture(scope="module")
def touch_contacts(programs):
    """Ten worlds in contact, each in all ten touch sizes (task-major), with actions."""
    env = make(TOUCH, "c")
    _, world, action = contacts_in_play(envs.make("finger-spin", engine="c"), programs, each=10)
    world, action = jax.tree.map(lambda x: np.tile(x, (10, 1)), (world, action))
    return rows(env, np.repeat(np.arange(10), 10)), world, action


@either_engine
def test_touch_sizes_share_one_dynamics(engine, touch_contacts, programs):
    """Ten steps in contact: ten sensor sizes, one motion, one reward; only touch differs, and grows with the sensor."""
    tasks, world, action = touch_contacts
    env = envs.make(TOUCH, engine=engine)
    touch = []
    for _ in range(10):
        step = programs(env).step(tasks, world, action)
        world = step.state
        touch.append(np.asarray(step.obs[:, 7:]).reshape(10, 10, 2))
    for same in (world.qpos, world.qvel, step.obs[:, :7], step.reward):
        assert np.ptp(np.asarray(same).reshape(10, 10, -1), axis=0).max() < 1e-5
    touch = np.stack(touch)
    assert np.all(np.diff(touch, axis=1) >= -1e-4)
    assert np.max(np.ptp(touch, axis=1)) > 1


@slow
def test_touch_sizes_feel_the_same_in_both_engines(touch_contacts, programs):
    """Every size's touch in the same ten contacts, by ``set_physics`` to the converged forces in float32.

    By ``step`` with two iterations only in the contacts that two solve, for which a sensor of the wrong size would be
    off by the logarithm of the whole force.
    """
    tasks, world, action = touch_contacts
    c, mjx = make(TOUCH, "c"), make(TOUCH, "mjx")
    put = [programs(env).put(tasks, world.qpos, world.qvel) for env in (c, mjx)]
    felt = [np.asarray(jax.vmap(env.observe)(tasks, w))[:, 7:] for env, w in zip((c, mjx), put, strict=True)]
    both = (c, envs.make(TOUCH, engine="mjx"))
    stepped = [np.asarray(programs(env).step(tasks, world, action).obs)[:, 7:] for env in both]
    for exact, _ in (felt, stepped):
        assert np.sum(exact > 0) > 50 and np.sum(np.ptp(exact.reshape(10, 10, 2), axis=0) > 1) >= 5
    np.testing.assert_allclose(felt[1], felt[0], rtol=0, atol=5e-3)
    assert_within(worst(*stepped), {0.8: 5e-3})


@either_engine
def test_set_physics_returns_the_given_state(engine, worlds, programs):
    """Positions and velocities come back as given, and sensors feel the contacts there."""
    env = make(TOUCH, engine)
    tasks = rows(env, [0] * 100)
    world = programs(env).put(tasks, worlds.qpos, worlds.qvel)
    np.testing.assert_array_equal(world.qpos, worlds.qpos)
    np.testing.assert_array_equal(world.qvel, worlds.qvel)
    assert np.any(world.sensors[:50] > 0) and not np.any(world.sensors[50:])
    assert not np.any(world.warmstart)


@slow
def test_nothing_ever_terminates():
    """A whole episode of random actions: finite throughout, and never over."""
    env = make(SIZE, "c")
    tasks = env.tasks()
    state = jax.vmap(env.reset)(tasks, jax.random.split(jax.random.key(0), 10)).state
    actions = jax.random.uniform(jax.random.key(1), (env.episode_length, 10, 2), minval=-1)

    def advance(state, action):
        step = jax.vmap(env.step)(tasks, state, action)
        return step.state, (step.terminated, jnp.isfinite(step.obs), step.obs[:, 7:] > 0)

    terminated, finite, touched = jax.jit(lambda s: jax.lax.scan(advance, s, actions)[1])(state)
    assert terminated.dtype == bool and not np.any(terminated)
    assert np.all(finite) and np.sum(touched) > 100


def test_engine_is_chosen_by_device(monkeypatch):
    """MuJoCo C by default on a CPU only, where alone it can be asked for."""
    assert [physics.choose_engine(engine) for engine in ("auto", "c", "mjx")] == ["c", "c", "mjx"]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert [physics.choose_engine(engine) for engine in ("auto", "mjx")] == ["mjx", "mjx"]
    with pytest.raises(InputError, match="needs JAX on the CPU, not on gpu"):
        physics.choose_engine("c")


@slow
def test_c_serves_two_threads_at_once(worlds):
    """Two threads that step the same family at the same batch size do not mix their worlds."""
    env = envs.make("finger-spin", engine="c")
    tasks = jax.tree.map(lambda x: np.repeat(x, 100, axis=0), env.tasks())
    states = [physics.World(worlds.qpos, worlds.qvel, 0 * worlds.qvel, np.zeros((100, 2), np.float32))] * 2
    actions = [worlds.action, -worlds.action]
    step = jax.vmap(env.step)
    many = jax.jit(lambda w, a: jax.lax.fori_loop(0, 200, lambda _, w: step(tasks, w, a).state, w))
    alone = [jax.block_until_ready(many(*job)) for job in zip(states, actions, strict=True)]
    with ThreadPoolExecutor(2) as pool:
        for _ in range(5):
            together = list(pool.map(lambda job: jax.block_until_ready(many(*job)), zip(states, actions, strict=True)))
            jax.tree.map(np.testing.assert_array_equal, together, alone)
