"""What is the hard bodies' own: swimmers of any length, low starts of quadrupeds, a dog that is read at run time."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import require

from mtjax import envs
from mtjax.envs.dm_control import attitude, dog
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.mjx import Mjx
from mtjax.envs.physics import mjx_engine
from mtjax.types import InputError


@pytest.mark.parametrize("links", [3, 10])
def test_a_swimmer_may_have_any_number_of_links(links):
    """The links are those of dm_control's own swimmers: the same inertia in the same pose."""
    swimmer = require("dm_control.suite.swimmer")
    ours, theirs = envs.make("swimmer-swimmer6", links=links).models[0], swimmer.swimmer(links).physics.model.ptr
    for field in ("body_mass", "body_pos", "body_inertia", "jnt_range", "jnt_pos", "dof_M0", "actuator_gear"):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=1e-12)
    assert envs.make("swimmer-swimmer6", links=links).spec.obs_size == 4 * links + 1
    with pytest.raises(InputError, match="links must be from 3 to 64, not 2"):
        envs.make("swimmer-swimmer6", links=2)


def test_longer_links_hang_on_each_other():
    """The end of a straight swimmer is where the lengths of its links add up to; the nose stays."""
    for length in (0.1, 0.15):
        model = envs.make("swimmer-swimmer6").compile_spec({"link-length": length}).compile()
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        tail, half = data.body("segment_4"), model.geom("inertial_4").size[1]
        assert tail.xpos[1] + half == pytest.approx(0.05 + 5 * length) and half == length / 2
        np.testing.assert_allclose(np.diff(data.xanchor[3:, 1]), length)


def test_attitudes_are_mujocos():
    """Directions and vectors in the frame of a body, of quaternions of any length."""
    for quat, vector in np.random.default_rng(0).normal(size=(5, 2, 4)):
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, quat / np.linalg.norm(quat))
        matrix, vector = matrix.reshape(3, 3), vector[:3]
        np.testing.assert_allclose(attitude.upward(jnp.float32(quat)), matrix[2], atol=1e-6)
        found = attitude.into_frame(jnp.float32(quat), jnp.float32(vector))
        np.testing.assert_allclose(found, vector @ matrix, atol=1e-5)


def test_a_quadruped_starts_as_low_as_it_can():
    """Nothing touches at a start, and something does 0.01 m lower, for tasks of two foot lengths."""
    env = envs.make("quadruped-walk", vary={"foot-length": "0.2,0.4"}, split="none", engine="c")
    tasks = jax.tree.map(lambda x: x[np.arange(100) % 2], env.tasks())
    starts = np.asarray(jax.jit(jax.vmap(env.start))(tasks, jax.random.split(jax.random.key(0), 100))[0])
    for i, qpos in enumerate(starts):
        data = mujoco.MjData(env.models[i % 2])
        data.qpos[:] = qpos
        mujoco.mj_kinematics(env.models[i % 2], data)
        mujoco.mj_collision(env.models[i % 2], data)
        assert data.ncon == 0
        data.qpos[2] -= 0.0101
        mujoco.mj_kinematics(env.models[i % 2], data)
        mujoco.mj_collision(env.models[i % 2], data)
        assert data.ncon > 0
    assert np.ptp(starts[:, 2]) > 0.3


def test_actions_span_the_ranges_of_the_servos():
    env = envs.make("quadruped-walk", engine="c")
    low, high = env.models[0].actuator_ctrlrange.T
    for action, expected in ((-1, low), (1, high), (0, (low + high) / 2)):
        _, found = env.control(env.tasks(), None, jnp.full(12, float(action)))
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_dog_asks_for_dm_control_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(dog, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install dm_control"):
        dog._read_dog.__wrapped__()
    with pytest.raises(InputError, match=r"this scene is of meshes.*leave out pixels"):
        envs.make("dog-walk", pixels=64)


@pytest.mark.nightly  # MJX takes minutes to compile it
def test_a_dog_in_mjx_steps_as_the_same_dog_does_in_c():
    """One that touches nothing but the floor: dropped, so that its paws come to bear it."""
    env = envs.make("dog-walk", engine="mjx", solver_iterations=30)
    base, task = mjx_engine(env).base, jax.tree.map(lambda x: x[0], env.tasks())
    exact, mjx = MujocoC([base], env.num_substeps), Mjx(base, env.num_substeps)
    keys, steps = jax.random.split(jax.random.key(0), 4), 12
    qpos, qvel = jax.vmap(env.start, (None, 0))(task, keys)
    world = jax.vmap(exact.forward, (None, 0, 0))(task, qpos, qvel)
    for i in range(steps):
        ctrl = jax.random.uniform(jax.random.key(i), (4, base.nu), minval=-1.0)
        world = jax.vmap(exact.step, (None, 0, 0))(task, world, ctrl)
    expected = jax.vmap(exact.step, (None, 0, 0))(task, world, ctrl)
    options = {"xla_backend_optimization_level": 1}
    found = (
        jax.jit(jax.vmap(mjx.step, (None, 0, 0)))
        .lower(task, world, ctrl)
        .compile(compiler_options=options)(task, world, ctrl)
    )
    scale = np.abs(expected.qvel).max()
    assert np.abs(np.asarray(expected.sensors)).max() > 10  # paws bear it
    np.testing.assert_allclose(found.qvel, expected.qvel, atol=1e-2 * scale)
    np.testing.assert_allclose(found.act, expected.act, atol=1e-6)
