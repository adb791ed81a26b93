"""What is the cheetah's own: its weight, the pool of settled starts, and the rewards of speed and direction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import require

from mtjax.envs.dm_control import cheetah
from mtjax.envs.dm_control.cheetah import CheetahDirection, CheetahRun, CheetahSpeed


def rewards(env, speeds):
    """The reward of each task (rows) at each forward velocity (columns)."""
    tasks = env.tasks()
    world = jax.jit(env.reset)(jax.tree.map(lambda x: x[0], tasks), jax.random.key(0)).state
    root = env.models[0].joint("rootx").dofadr[0]
    put = lambda speed: world._replace(qvel=jnp.full(9, 0.0).at[root].set(speed))
    at = lambda task, speed: env.reward(task, put(speed), jnp.zeros(6))
    return jax.vmap(jax.vmap(at, (None, 0)), (0, None))(tasks, jnp.array(speeds, jnp.float32))


@pytest.mark.parametrize("shape", ["torso-length", "foot-size", "foot-position", "back-foot-length"])
def test_shapes_change_where_the_weight_is_and_not_how_much(shape):
    """All together 14 kg; a heavier torso adds to it, whatever the shape."""
    env = CheetahRun(vary={shape: [1.3 * CheetahRun.parameters[shape].nominal], "torso-mass": [1.0, 2.0]}, split="none")
    light, heavy = (model.body_mass for model in env.models)
    np.testing.assert_allclose(light.sum(), 14, rtol=1e-12)
    np.testing.assert_allclose(heavy - light, np.eye(8)[1] * light, atol=1e-12)


def test_settled_states_are_those_of_dm_control():
    """From the same poses the same states after the same 200 steps, as far as chaos lets last bits pass."""
    physics = require("dm_control.suite").load("cheetah", "run").physics
    limited = physics.model.jnt_limited.astype(bool)
    states = cheetah._settle(CheetahRun().models * 16, np.random.default_rng(0))
    poses, expected = np.random.default_rng(0).uniform(*physics.model.jnt_range[limited].T, (16, 6)), []
    for pose in poses:
        physics.reset()
        physics.data.qpos[limited] = pose
        physics.step(nstep=200)
        expected.append(np.concatenate([physics.data.qpos, physics.data.qvel]))
    np.testing.assert_allclose(states, expected, atol=1e-6)


def test_every_model_has_a_pool_of_its_own_and_starts_in_it():
    """Pools differ between models, goals share their model's, and starts are drawn from all of a pool."""
    env = CheetahRun(vary={"foot-size": [0.046, 0.06], "speed": [5, 10]}, split="none", engine="c")
    tasks = env.tasks()
    pools = np.asarray(tasks.goal["starts"])
    assert pools.shape == (4, 64, 18)
    np.testing.assert_array_equal(pools[0], pools[1])
    assert not np.any(pools[0] == pools[2]) and len(np.unique(pools[2], axis=0)) == 64
    reset = jax.jit(jax.vmap(jax.vmap(env.reset, (None, 0)), (0, None)))
    step = reset(tasks, jax.random.split(jax.random.key(0), 600))
    drawn = np.concatenate([step.state.qpos, step.state.qvel], axis=-1)
    for states, pool in zip(drawn, pools, strict=True):
        assert {row.tobytes() for row in np.unique(states, axis=0)} == {row.tobytes() for row in pool}
    np.testing.assert_array_equal(step.obs, drawn[..., 1:])


def test_pools_shrink_with_many_models():
    env = CheetahRun(vary={"foot-size": "0.04:0.06:40"}, split="none")
    assert env.table.tasks.goal["starts"].shape == (40, 25, 18)


def test_running_is_rewarded_up_to_the_speed_asked_for():
    expected = [[0, 0, 0.5, 1, 1], [0, 0, 0.2, 0.4, 1]]
    np.testing.assert_allclose(rewards(CheetahRun(vary={"speed": [4, 10]}), [-2, 0, 2, 4, 12]), expected, atol=1e-6)


def test_being_faster_than_the_speed_asked_for_is_worse():
    expected = [[0, 0.5, 1, 0.5, 0, 0], [0, 0.25, 0.5, 0.75, 1, 0]]
    np.testing.assert_allclose(rewards(CheetahSpeed(vary={"speed": [2, 4]}), [0, 1, 2, 3, 4, 9]), expected, atol=1e-6)


def test_only_the_direction_asked_for_is_rewarded():
    expected = [[1, 0.5, 0, 0, 0], [0, 0, 0, 0.5, 1]]
    env = CheetahDirection(vary={"direction": [-1, 1]}, split="none")
    np.testing.assert_allclose(rewards(env, [-12, -5, 0, 5, 12]), expected, atol=1e-6)
