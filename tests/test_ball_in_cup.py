"""What is the ball's own: the string, the cup, and starts in which nothing touches."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import set_physics

from mtjax.envs.dm_control.ball_in_cup import BallInCup
from mtjax.types import InputError


@pytest.fixture(scope="module")
def env():
    return BallInCup(vary={"string-length": [0.3, 0.35]}, split="none", engine="c")


def hanging(model):
    """How far the ball comes to rest below the cup's bottom [m]."""
    data = mujoco.MjData(model)
    for _ in range(20):
        mujoco.mj_step(model, data, 250)
        data.qvel[:] = 0
    return data.ten_length[0]


def test_the_ball_hangs_at_the_strings_length(env):
    np.testing.assert_allclose([hanging(model) for model in env.models], [0.3, 0.35], atol=3e-3)


def test_no_string_is_so_short_that_it_is_stretched_at_a_start():
    with pytest.raises(InputError, match=r"string-length must be greater than 0\.29"):
        BallInCup(vary={"string-length": [0.25]})


def test_starts_fill_the_box_where_nothing_touches(env):
    tasks = jax.tree.map(lambda x: jnp.repeat(x[:1], 2000, axis=0), env.tasks())
    step = jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), 2000))
    qpos = np.asarray(step.state.qpos)
    model = env.models[0]
    data, limit = mujoco.MjData(model), model.tendon_range[0, 1]
    for data.qpos[:] in qpos:
        mujoco.mj_forward(model, data)
        assert data.ncon == 0 and data.ten_length[0] < limit
    assert not np.any(qpos[:, :2]) and not np.any(step.state.qvel)
    low, high = qpos[:, 2:].min(axis=0), qpos[:, 2:].max(axis=0)
    np.testing.assert_allclose([low, high], [[-0.2, 0.2], [0.2, 0.5]], atol=2e-3)
    # The box has 0.12 m^2; what the cup's walls and the ball's radius take of it leaves no start in the bottom.
    assert not np.any(np.hypot(qpos[:, 2], qpos[:, 3] - 0.3) < 0.02)


@pytest.mark.parametrize(
    ("cup", "ball", "caught"),
    [
        ((0, 0), (0, 0.35), 1),
        ((0.1, -0.1), (0.1, 0.25), 1),
        ((0.1, -0.1), (0, 0.35), 0),
        ((0, 0), (0.024, 0.374), 1),
        ((0, 0), (0.026, 0.35), 0),
        ((0, 0), (0, 0.376), 0),
    ],
)
def test_the_ball_is_caught_while_all_of_it_is_in_the_cup(env, cup, ball, caught):
    """The box goes with the cup and leaves the ball's middle 2.5 cm to each side."""
    task = jax.tree.map(lambda x: x[0], env.tasks())
    world = set_physics(env, task, None, np.array([*cup, *ball]), np.zeros(4))
    assert env.reward(task, world, jnp.zeros(2)) == caught
