"""Worlds with more than positions and velocities: activations of actuators, and bodies that a domain moves."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import needs

from mtjax.envs.compiled import stack_differing
from mtjax.envs.engines.base import World, at_rest
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.mjx import Mjx
from mtjax.types import Task

COUNT, SUBSTEPS = 6, 5
MODEL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="post" pos="0 0 3"/>
    <body name="mover" mocap="true" pos="0 0 1" quat="1 0 0 0"/>
    <body name="hand" pos="0 0 1">
      <freejoint/>
      <geom size="0.05" mass="1"/>
      <body pos="0 0 -0.1">
        <joint name="swing" axis="0 1 0" damping="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <equality><weld body1="mover" body2="hand" solref="0.02 1"/></equality>
  <actuator><general joint="swing" dyntype="filter" dynprm="0.1"/></actuator>
  <sensor><framepos objtype="xbody" objname="hand"/><framepos objtype="xbody" objname="mover"/></sensor>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(scope="module")
def task(model):
    return Task(*[jnp.int32(0)] * 2, jnp.zeros(1), {}, {}, {}, jnp.int32(10))  # type: ignore


@pytest.fixture(scope="module")
def start(model):
    """Worlds whose movers are apart from the hand."""
    qpos = np.tile(np.float32(model.qpos0), (COUNT, 1))
    qpos[:, 7] = np.linspace(-1, 1, COUNT)
    world = jax.vmap(lambda qpos: at_rest(model, qpos, jnp.zeros(model.nv, jnp.float32)))(qpos)
    drift = np.random.RandomState(0).uniform(-0.1, 0.1, (COUNT, 1, 3))
    return world._replace(mocap=world.mocap.at[:, :, :3].add(drift))


def plain(model, world, ctrl):
    """One world's step by plain MuJoCo calls."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:], data.qacc_warmstart[:] = world.qpos, world.qvel, world.act, world.warmstart
    data.mocap_pos[:], data.mocap_quat[:], data.ctrl[:] = world.mocap[:, :3], world.mocap[:, 3:], ctrl
    for _ in range(SUBSTEPS):
        mujoco.mj_step(model, data)
    return [np.float32(x) for x in (data.qpos, data.qvel, data.act)]


def stepped(engine, task, world, ctrl, steps=3):
    """Yield the worlds before and after each step. Movers move on between steps."""
    step = jax.jit(jax.vmap(engine.step, in_axes=(None, 0, 0)))
    for _ in range(steps):
        new = step(task, world, ctrl)
        yield world, new
        world = new._replace(mocap=new.mocap.at[:, :, 0].add(0.01))


@pytest.fixture
def ctrl():
    return jnp.linspace(-1, 1, COUNT)[:, None]


def test_c_steps_as_plain_mujoco_does(model, task, start, ctrl):
    """Bit for bit, for three steps between which the mover moves."""
    for world, new in stepped(MujocoC([model], SUBSTEPS), task, start, ctrl):
        for i in range(COUNT):
            expected = plain(model, jax.tree.map(lambda x, i=i: np.asarray(x)[i], world), ctrl[i])
            for found, exact in zip((new.qpos, new.qvel, new.act), expected, strict=True):
                np.testing.assert_array_equal(found[i], exact)
        np.testing.assert_allclose(new.sensors[:, 3:], new.mocap[:, 0, :3], atol=1e-6)
        assert np.all(np.abs(new.act) > 0.01)


def agree(engine, model, task, start, ctrl):
    exact = list(stepped(MujocoC([model], SUBSTEPS), task, start, ctrl))
    for (_, ours), (_, theirs) in zip(stepped(engine, task, start, ctrl), exact, strict=True):
        for found, expected in zip(ours, theirs, strict=True):
            if expected is not None:
                np.testing.assert_allclose(found, expected, atol=1e-3 * np.max(np.abs(expected)))


@pytest.mark.slow
def test_mjx_steps_as_c_does(model, task, start, ctrl):
    agree(Mjx(model, SUBSTEPS), model, task, start, ctrl)


@pytest.mark.slow
@needs("warp")
def test_warp_steps_as_c_does(model, task, start, ctrl):
    from mtjax.envs.engines.warp import Warp

    agree(Warp(model, SUBSTEPS), model, task, start, ctrl)


FLOORS = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="floor"><body name="slab" pos="0 0 -0.1"><geom type="box" size="1 1 0.1"/></body></body>
    <body pos="0 0 0.52"><freejoint/><geom size="0.05" mass="1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["c", "mjx", pytest.param("warp", marks=needs("warp"))])
def test_things_rest_on_the_floor_of_their_own_task(name):
    """Bodies that are fixed to the world collide where each task has them: a ball falls half a metre, or none."""
    models = [mujoco.MjModel.from_xml_string(FLOORS) for _ in range(2)]
    models[1].body("floor").pos[2] = 0.47
    task = Task(*[jnp.arange(2)] * 2, jnp.zeros((2, 1)), {}, stack_differing(models), {}, jnp.full(2, 10))  # type: ignore
    if name == "warp":
        from mtjax.envs.engines.warp import Warp

    engine = MujocoC(models, 20) if name == "c" else Warp(models[0], 20) if name == "warp" else Mjx(models[0], 20)
    world = jax.vmap(engine.place, in_axes=(0, None, None))(task, np.float32(models[0].qpos0), np.zeros(6, np.float32))
    step = jax.jit(jax.vmap(engine.step))
    for _ in range(10):
        world = step(task, world, jnp.zeros((2, 0)))
    np.testing.assert_allclose(world.qpos[:, 2], [0.05, 0.52], atol=2e-3)


def test_bodies_begin_where_the_model_has_them(model):
    world = at_rest(model, jnp.zeros(model.nq), jnp.zeros(model.nv))
    assert isinstance(world, World)
    np.testing.assert_array_equal(world.mocap, [[0, 0, 1, 1, 0, 0, 0]])
    np.testing.assert_array_equal(world.act, [0])
