"""Places and velocities of planar bodies against MuJoCo's own."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import set_physics

import mtjax
from mtjax.envs.planar import forward_velocity, is_planar, locate

FAMILIES = (
    "cheetah-run-vary-foot-position",
    "cheetah-run-vary-torso-length",
    "finger-spin-vary-size",
    "hopper-hop",
    "walker-walk-vary-foot-length",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_bodies_are_where_mujoco_has_them(name):
    """First and last task in ten random states each: angles, frames, centres of mass and their velocities."""
    env = mtjax.make(name, engine="c")
    model, random = env.models[0], np.random.default_rng(0)
    assert is_planar(model)
    for row in {0, env.variation.count - 1}:
        task = jax.tree.map(lambda x, row=row: x[row], env.tasks("all"))
        place = jax.jit(lambda qpos, qvel, task=task: locate(model, lambda leaf: env.leaf(task, leaf), qpos, qvel))
        data = mujoco.MjData(env.models[row])
        for _ in range(10):
            data.qpos[:], data.qvel[:] = random.uniform(-2, 2, model.nq), random.uniform(-5, 5, model.nv)
            mujoco.mj_forward(env.models[row], data)
            found = place(jnp.float32(data.qpos), jnp.float32(data.qvel))
            np.testing.assert_allclose(np.cos(found.angle), data.xmat[:, 0], atol=1e-6)
            np.testing.assert_allclose(np.sin(found.angle), data.xmat[:, 2], atol=1e-6)
            np.testing.assert_allclose(found.position, data.xpos[:, [0, 2]], atol=1e-6)
            np.testing.assert_allclose(found.centre, data.xipos[:, [0, 2]], atol=1e-6)
            np.testing.assert_allclose(found.velocity, velocities(env.models[row], data), atol=1e-5)


def velocities(model, data):
    """Of every body's centre of mass, x and z (nbody, 2)."""
    result = np.zeros((model.nbody, 6))
    for body in range(model.nbody):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, result[body], 0)
    return result[:, [3, 5]]


def test_forward_velocity_is_that_of_the_subtree():
    """The mass-weighted mean of all bodies, as MuJoCo's subtree velocity of the torso."""
    env = mtjax.make("cheetah-run", engine="c")
    task, data = jax.tree.map(lambda x: x[0], env.tasks()), mujoco.MjData(env.models[0])
    data.qpos[:], data.qvel[:] = np.linspace(-0.5, 0.5, 9), np.linspace(-3, 4, 9)
    mujoco.mj_forward(env.models[0], data)
    mujoco.mj_subtreeVel(env.models[0], data)
    world = set_physics(env, task, None, data.qpos, data.qvel)
    np.testing.assert_allclose(forward_velocity(env, task, world), data.subtree_linvel[1, 0], rtol=1e-5)


def test_models_that_leave_the_plane_are_told_apart():
    assert not is_planar(mtjax.make("reacher-easy").models[0])
