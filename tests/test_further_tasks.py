"""Tasks with rewards of our own on dm_control's bodies: what is rewarded in states whose reward is known."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import set_physics, slow_but

from mtjax import envs


def rewards(name, qvel, qpos=None):
    """The rewards of one family in states with these velocities (N, nv) and positions, which are else the model's."""
    env = envs.make(name, engine="c")
    task, start = jax.tree.map(lambda x: x[0], env.tasks()), np.asarray(env.models[0].qpos0)
    qvel = np.float32(qvel)
    qpos = np.broadcast_to(start, (len(qvel), len(start))) if qpos is None else np.float32(qpos)
    score = lambda p, v: env.reward(task, set_physics(env, task, None, p, v), jnp.zeros(env.action_size))
    return np.asarray(jax.jit(jax.vmap(score))(qpos, qvel))


def along(name, joint, velocities):
    """Velocities (N, nv) of one joint alone."""
    model = envs.make(name, engine="c").models[0]
    return np.asarray(velocities)[:, None] * np.eye(model.nv)[model.joint(joint).dofadr[0]]


BACKWARD = ("cheetah-run", "hopper-hop", "walker-run", "walker-walk")


@pytest.mark.parametrize("name", slow_but(BACKWARD, "hopper-hop"))
def test_backwards_is_forwards_in_a_mirror(name):
    """The model's own pose, moved along x at a half and all of the speed that is asked for, and the other way."""
    speed = envs.ENVS[name][0].parameters["speed"].nominal
    moved = [speed / 2, speed, -speed]
    forwards, backwards = (rewards(x, along(x, "rootx", moved)) for x in (name, f"{name}-backward"))
    assert forwards[2] < forwards[0] < forwards[1] and np.argmax(backwards) == 2
    mirrored = rewards(f"{name}-backward", along(name, "rootx", np.negative(moved)))
    np.testing.assert_allclose(mirrored, forwards, rtol=1e-6)


def test_a_jump_is_rewarded_for_the_height_of_the_centre_of_mass():
    model = envs.make("cheetah-jump", engine="c").models[0]
    lift = np.array([0.0, 0.2, 0.4, 2.0])
    qpos = model.qpos0 + lift[:, None] * np.eye(model.nq)[1]
    height = model.body_subtreemass[1] ** -1 * _moment(model) + lift
    expected = np.clip((height - 0.45) / 0.55, 0, 1)
    np.testing.assert_allclose(rewards("cheetah-jump", np.zeros((4, model.nv)), qpos), expected, rtol=1e-5)


def _moment(model):
    """Mass times height of all bodies in the model's own pose."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.dot(model.body_mass, data.xipos[:, 2])


def test_a_pendulum_is_rewarded_for_spinning_one_way():
    np.testing.assert_allclose(rewards("pendulum-spin", [[9.0], [6.0], [3.0], [0.0], [-6.0]]), [1, 1, 0.5, 0, 0])


def test_a_ball_is_rewarded_for_going_round_the_cup():
    """It hangs 0.3 m below the cup's bottom, or closer, and moves as the cup sees it."""
    hanging, closer = [0, 0, 0, -0.008], [0, 0, 0, 0.067]  # 0.3 and 0.225 m
    moving = [[0, 0, 3, 0], [0, 0, 1.5, 0], [-3, 0, 0, 0], [0, 0, -3, 0], [0, 0, 0, 3], [0, 0, 3, 0]]
    found = rewards("ball-in-cup-spin", moving, [hanging] * 5 + [closer])
    np.testing.assert_allclose(found, [1, 0.5, 1, 0, 0, 0.5], atol=1e-5)
