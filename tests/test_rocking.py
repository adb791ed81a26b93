"""How exactly a puck that rocks can be simulated at all: MuJoCo alone, in double precision."""

import jax
import mujoco
import numpy as np
import pytest
from needs import needs
from probes import QUICK

import mtjax

NORMAL = 1e-4  # [rad] by which contact normals in single precision are off
ROCKING = 1.3e-2  # of the largest velocity: the median by which such a normal changes how a puck rocks, in one step


def tilting(model):
    """The degrees of freedom by which free things tilt, if their own axis z stands upright."""
    free = model.jnt_dofadr[model.jnt_type == mujoco.mjtJoint.mjJNT_FREE]
    return np.concatenate([free + 3, free + 4])


def turned(model, world, direction):
    """Positions in which the puck is turned by ``NORMAL`` about a horizontal axis, and touches as deeply as before."""
    (joint,) = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    place, body = model.jnt_qposadr[joint], model.jnt_bodyid[joint]
    data = mujoco.MjData(model)
    data.mocap_pos[:], data.mocap_quat[:] = world.mocap[:, :3], world.mocap[:, 3:]

    def depth(qpos):
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        return min(contact.dist for contact in data.contact if body in model.geom_bodyid[contact.geom])

    new, rotation = np.float64(world.qpos), NORMAL / 2 * np.array([np.cos(direction), np.sin(direction)])
    mujoco.mju_mulQuat(
        new[place + 3 : place + 7], np.array([1.0, *rotation, 0.0]), np.float64(world.qpos[place + 3 :][:4])
    )
    new[place + 2] += depth(world.qpos) - depth(new)
    return np.float32(new)


@needs("metaworld")
@pytest.mark.parametrize("name", ["push", "pick-place"])
def test_a_normal_decides_how_a_puck_rocks(name, count=16, steps=30, directions=8):
    """A normal that is off by 1e-4 rad changes how a puck tilts, and nothing else that much.

    A puck on its flat side touches the table in one point of its rim. It is tilted by about 1e-3 rad, so such a normal
    moves that point by degrees round the rim. The puck is turned here, which turns the normal against it. Whoever
    computes normals in single precision is allowed to be off by what MuJoCo itself then is.
    """
    env = mtjax.make(f"metaworld-{name}", num_draws=count, engine="c")
    tasks = jax.tree.map(lambda x: x[0], env.tasks().draws)
    reset, step = (jax.jit(jax.vmap(f), compiler_options=QUICK) for f in (env.reset, env.step))
    random = np.random.default_rng(0)
    action = np.float32(random.uniform(-1, 1, (steps // 5 + 1, count, 4)))
    world = reset(tasks, jax.random.split(jax.random.key(0), count)).state
    for i in range(steps):
        world = step(tasks, world, action[i // 5]).state
    world = jax.device_get(world)
    expected = np.asarray(step(tasks, world, action[-1]).state.qvel)
    errors = []
    for _ in range(directions):
        worlds = [jax.tree.map(lambda x, i=i: x[i], world) for i in range(count)]
        qpos = [
            turned(env.models[row], each, random.uniform(0, 2 * np.pi))
            for row, each in zip(tasks.row, worlds, strict=True)
        ]
        found = np.asarray(step(tasks, world._replace(qpos=np.stack(qpos)), action[-1]).state.qvel)
        errors.append(np.abs(found - expected) / np.abs(expected).max())
    rocking, errors = tilting(env.models[0]), np.concatenate(errors)
    assert ROCKING < np.median(errors[:, rocking].max(axis=1)) < 2 * ROCKING
    assert np.median(np.delete(errors, rocking, axis=1).max(axis=1)) < 1e-3
