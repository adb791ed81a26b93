"""The finger against dm_control's: model, observation, reward and starts."""

from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import require
from probes import set_physics

from mtjax import envs
from mtjax.envs.dm_control.finger import FingerSpin, FingerTurn, FingerTurnTarget
from mtjax.types import Spec

NOMINAL = 1  # the row of finger-spin-vary-size whose size is 1
DYNAMICS = ("body_", "jnt_", "dof_", "geom_", "actuator_", "qpos")
# What only a renderer or the broad phase reads; what collides with what is compared by its outcome below.
NOT_DYNAMICS = ("bvh", "geom_rgba", "geom_matid", "contype", "conaffinity")
ENGINES = {
    "c": ("finger-spin", {"engine": "c"}),
    "mjx": ("finger-spin-vary-touch-size", {"engine": "mjx", "solver_iterations": 20}),
}


def rows(env, ids):
    return jax.tree.map(lambda x: x[np.asarray(ids)], env.tasks("all"))


def put_suite(environment, qpos, qvel):
    with environment.physics.reset_context():
        environment.physics.data.qpos[:] = qpos
        environment.physics.data.qvel[:] = qvel


def read_suite(environment):
    parts = environment.task.get_observation(environment.physics)
    return np.concatenate([parts["position"], parts["velocity"], parts["touch"]])


def same(ours, theirs, name):
    return np.array_equal(np.asarray(getattr(ours, name)), np.asarray(getattr(theirs, name)))


@pytest.fixture(scope="module")
def sizes():
    return envs.make("finger-spin-vary-size", {"size": "0.95:1.4:10"}, engine="c")


@pytest.fixture(scope="module")
def suite_starts(suite_finger):
    """Start positions as dm_control draws them."""
    joints = require("dm_control.suite.finger")
    random, physics = np.random.RandomState(3), suite_finger.physics
    starts = np.empty((3000, 3))
    for start in starts:
        joints._set_random_joint_angles(physics, random)
        start[:] = physics.data.qpos
    return starts


@pytest.fixture(scope="module")
def starts(sizes, programs):
    """Reset of the nominal task from 3000 keys."""
    return programs(sizes).reset(rows(sizes, [NOMINAL] * 3000), jax.random.split(jax.random.key(0), 3000))


def test_model_has_every_dynamics_field_of_dm_control(suite_finger):
    """Bodies, joints, geoms, motors and options are dm_control's bit for bit, the hinge's damping of 0.03 included."""
    ours, theirs = envs.make("finger-spin").models[0], suite_finger.physics.model.ptr
    fields = [f for f in dir(ours) if f.startswith(DYNAMICS) and not any(word in f for word in NOT_DYNAMICS)]
    options = [f for f in dir(ours.opt) if not f.startswith("_")]
    assert len(fields) > 90 and len(options) > 20
    assert [f for f in fields if not same(ours, theirs, f)] == []
    assert [f for f in options if not same(ours.opt, theirs.opt, f)] == []
    assert ours.dof_damping[2] == 0.03


def test_model_has_the_sites_and_sensors_of_dm_control(suite_finger):
    """Every site and sensor we have is dm_control's of the same name: place, size, shape and what it reads."""
    ours, theirs = envs.make("finger-spin").models[0], suite_finger.physics.model.ptr
    for i in range(ours.nsite):
        a, b = ours.site(i), theirs.site(ours.site(i).name)
        for field in ("bodyid", "pos", "quat", "size", "type"):
            assert same(a, b, field), (a.name, field)
    assert ours.nsensor == 2
    for i in range(ours.nsensor):
        a, b = ours.sensor(i), theirs.sensor(ours.sensor(i).name)
        assert a.type == b.type and a.cutoff == b.cutoff
        kind = mujoco.mjtObj(int(a.objtype[0]))
        assert mujoco.mj_id2name(ours, kind, a.objid[0]) == mujoco.mj_id2name(theirs, kind, b.objid[0])


def test_what_can_touch_is_what_touches_in_dm_control(suite_finger, sizes):
    """Over uniformly random positions our model finds dm_control's contacts: nothing it disables is ever in reach."""
    model, random = sizes.models[NOMINAL], np.random.RandomState(0)
    data, contacts = mujoco.MjData(model), []
    for _ in range(1000):
        qpos = random.uniform([-1.92, -1.92, -np.pi], [1.92, 1.92, np.pi])
        put_suite(suite_finger, qpos, np.zeros(3))
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        assert np.array_equal(data.contact.geom, suite_finger.physics.data.contact.geom)
        contacts.append(data.ncon)
    assert np.sum(contacts) > 50


@pytest.mark.parametrize("engine", ["c", pytest.param("mjx", marks=pytest.mark.slow)])
def test_observation_and_reward_are_those_of_dm_control(engine, suite_finger, worlds, programs):
    """At 100 states, 50 in contact. Kinematics to float32 rounding (sums of numbers below 50 carry 4e-6).

    Touch is the logarithm of a force: C solves in float64; MJX in float32, where the solver's stopping point moves
    forces by up to some 1e-3 of themselves.
    """
    name, settings = ENGINES[engine]
    env = envs.make(name, **settings)
    tasks = rows(env, [0] * 100)
    world = programs(env).put(tasks, worlds.qpos, worlds.qvel)
    obs, reward = jax.vmap(env.observe)(tasks, world), jax.vmap(env.reward)(tasks, world, worlds.action)
    expected_obs, expected_reward = [], []
    for qpos, qvel in zip(worlds.qpos, worlds.qvel, strict=True):
        put_suite(suite_finger, qpos, qvel)
        expected_obs.append(read_suite(suite_finger))
        expected_reward.append(suite_finger.task.get_reward(suite_finger.physics))
    expected_obs = np.array(expected_obs)
    assert np.sum(expected_obs[:, 7:].any(axis=1)) >= 25
    assert 10 < sum(expected_reward) < 90
    np.testing.assert_allclose(obs[:, :7], expected_obs[:, :7], rtol=0, atol=4e-6)
    np.testing.assert_allclose(obs[:, 7:], expected_obs[:, 7:], rtol=0, atol=2e-6 if engine == "c" else 5e-3)
    np.testing.assert_array_equal(reward, expected_reward)


def test_reward_counts_a_hinge_of_exactly_the_threshold(sizes):
    """The threshold belongs to the rewarded side, and only one direction of turning counts."""
    task = jax.tree.map(lambda x: x[0], sizes.tasks())
    world = set_physics(sizes, task, None, np.zeros(3), np.zeros(3))
    speeds = jnp.array([-15.0, -14.99, 15.0, -40.0])
    rewards = [float(sizes.reward(task, world._replace(qvel=world.qvel.at[2].set(s)), jnp.zeros(2))) for s in speeds]
    assert rewards == [1, 0, 0, 1]


def ks_distance(a, b):
    """The largest distance between two empirical distribution functions."""
    where = np.concatenate([a, b])
    steps = [np.searchsorted(np.sort(x), where, side="right") / len(x) for x in (a, b)]
    return np.abs(steps[0] - steps[1]).max()


@pytest.mark.parametrize("joint", range(3))
def test_starts_are_distributed_as_in_dm_control(joint, starts, suite_starts):
    """Two-sample Kolmogorov-Smirnov: of 3000 against 3000, equal laws exceed 0.05 once in a thousand draws."""
    ours, theirs = np.asarray(starts.state.qpos)[:, joint], suite_starts[:, joint]
    assert ks_distance(ours, theirs) < 0.05
    assert ks_distance(ours + 0.3, theirs) > 0.05


def test_start_joints_depend_on_each_other_as_in_dm_control(starts, suite_starts):
    """Rejection couples the joints; products of standardised joints have a standard error of about 0.02 each."""

    def products(qpos):
        x = (qpos - suite_starts.mean(0)) / suite_starts.std(0)
        return np.array([np.mean(a * b) for a in (x.T, x.T**2) for a, b in zip(a, np.roll(a, 1, axis=0), strict=True)])

    np.testing.assert_allclose(products(np.asarray(starts.state.qpos)), products(suite_starts), atol=0.1)


def test_starts_are_at_rest_and_feel_nothing(starts):
    """An episode begins without velocity, touch or reward, and with what the sensors say of those positions."""
    assert not np.any(starts.state.qvel) and not np.any(starts.obs[:, 4:]) and not np.any(starts.reward)
    np.testing.assert_allclose(starts.obs[:, :2], starts.state.qpos[:, :2], atol=1e-6)


@pytest.fixture(scope="module")
def size_starts(sizes, programs):
    """Reset of all ten sizes, 300 starts each, in either engine from the same keys."""
    keys, ids = jax.random.split(jax.random.key(1), 3000), np.repeat(np.arange(10), 300)

    @lru_cache
    def start(engine):
        env = envs.make("finger-spin-vary-size", {"size": "0.95:1.4:10"}, engine=engine)
        return programs(env).reset(rows(sizes, ids), keys)

    return start


def contact_counts(model, positions):
    data, counts = mujoco.MjData(model), []
    for data.qpos[:] in positions:
        mujoco.mj_forward(model, data)
        counts.append(data.ncon)
    return np.array(counts)


def test_nothing_touches_at_any_start(sizes, size_starts):
    """MuJoCo finds no contact at 300 starts of each size, though it does at a good part of unrejected draws."""
    draws = np.random.RandomState(0).uniform([-1.9, -1.9, -np.pi], [1.9, 1.9, np.pi], (300, 3))
    starts = np.asarray(size_starts("c").state.qpos).reshape(10, 300, 3)
    for model, start in zip(sizes.models, starts, strict=False):
        assert not np.any(contact_counts(model, start))
        assert np.sum(contact_counts(model, draws) > 0) >= 10


@pytest.mark.slow
def test_engines_start_alike(size_starts):
    """Starts and first observations are the same in both engines, to float32 rounding of the kinematics."""
    c, mjx = size_starts("c"), size_starts("mjx")
    np.testing.assert_allclose(c.state.qpos, mjx.state.qpos, rtol=0, atol=1e-6)
    np.testing.assert_allclose(c.obs, mjx.obs, rtol=0, atol=2e-6)


def test_keys_decide_starts(sizes, programs, starts):
    """The same keys give the same starts, and no two keys share one."""
    again = programs(sizes).reset(rows(sizes, [NOMINAL] * 3000), jax.random.split(jax.random.key(0), 3000))
    np.testing.assert_array_equal(starts.state.qpos, again.state.qpos)
    assert len(np.unique(starts.state.qpos, axis=0)) == 3000


def test_sizes_of_the_interface(sizes):
    """Nine observations, two actions, one context; a thousand steps, or 20 seconds, an episode."""
    assert sizes.spec._replace(sentences=()) == Spec.vector(9, 2, 1)
    seconds = sizes.episode_length * sizes.num_substeps * sizes.models[0].opt.timestep
    assert sizes.episode_length == 1000 and seconds == pytest.approx(20)


@pytest.fixture(scope="module")
def turns():
    """FingerTurn's nominal task at 500 starts."""
    env = FingerTurn(engine="c")
    tasks = rows(env, [0] * 500)
    return env, tasks, jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), 500))


def test_targets_of_turn_are_anywhere_on_the_circle_and_stay(turns):
    """Each episode has a target of its own, 0.13 m from the hinge, which the observation shows and steps keep."""
    env, tasks, step = turns
    target = np.asarray(step.state.extra)
    np.testing.assert_allclose(np.linalg.norm(target, axis=1), 0.13, rtol=1e-6)
    assert ks_distance(np.arctan2(target[:, 0], target[:, 1]), np.linspace(-np.pi, np.pi, 500)) < 0.1
    after = jax.jit(jax.vmap(env.step))(tasks, step.state, jnp.zeros((500, 2)))
    np.testing.assert_array_equal(after.state.extra, target)
    for obs in (step.obs, after.obs):
        np.testing.assert_array_equal(obs[:, 9:11], target)
        np.testing.assert_allclose(obs[:, 11], np.linalg.norm(obs[:, 2:4] - target, axis=1) - 0.07, atol=1e-6)
    np.testing.assert_array_equal(after.reward, after.obs[:, 11] <= 0)
    assert 0.05 < np.mean(after.reward) < 0.4


def test_a_target_can_be_the_task(turns):
    """The target is at the angle asked for, 0 up and positive towards x; what the agent sees does not give it away."""
    _, _, step = turns
    env = FingerTurnTarget(
        vary={"target-angle": [0, np.pi / 2], "target-size": [0.05, 0.09]}, combine="paired", engine="c"
    )
    targets = jax.vmap(env.reset, (0, None))(env.tasks(), jax.random.key(0))
    np.testing.assert_allclose(targets.state.extra, [[0, 0.13], [0.13, 0]], atol=1e-7)
    assert targets.obs.shape == (2, 9)
    world = jax.tree.map(lambda x: x[0], step.state)
    tip = step.obs[0, 2:4]
    rewards = jax.vmap(lambda task, x: env.reward(task, world._replace(extra=tip + x), jnp.zeros(2)), (None, 0))
    offsets = jnp.array([[0.045, 0], [0, 0.055], [0.085, 0], [0.095, 0]])
    expected = [[1, 0, 0, 0], [1, 1, 1, 0]]
    for i in range(2):
        np.testing.assert_array_equal(rewards(jax.tree.map(lambda x, i=i: x[i], env.tasks()), offsets), expected[i])


def test_only_spin_frees_the_hinge():
    """The hinge's own damping of 0.5 stays in turn; either can be given another, and another dry friction."""
    hinge = lambda family, **vary: family(vary=vary).models[0]
    assert hinge(FingerSpin).dof_damping[2] == 0.03 and hinge(FingerTurn).dof_damping[2] == 0.5
    for family in (FingerSpin, FingerTurn):
        changed = hinge(family, **{"spinner-damping": [0.2], "spinner-frictionloss": [0.3], "damping": [2.0]})
        np.testing.assert_allclose(changed.dof_damping, [5, 5, 0.4])
        assert changed.dof_frictionloss[2] == 0.3
