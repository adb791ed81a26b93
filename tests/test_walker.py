"""What is the walker's own: the rewards of its speeds, and what its parameters change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.envs.dm_control.walker import WalkerRun, WalkerSpeed, WalkerStand, WalkerWalk


def first(env):
    return jax.tree.map(lambda x: x[0], env.tasks())


def rewards(env, speeds):
    """The reward of each task (rows) at each forward velocity (columns), upright and high."""
    world = jax.jit(env.reset)(first(env), jax.random.key(0)).state
    root = env.models[0].joint("rootx").dofadr[0]
    put = lambda speed: world._replace(qpos=jnp.zeros(9), qvel=jnp.zeros(9).at[root].set(speed))
    at = lambda task, speed: env.reward(task, put(speed), jnp.zeros(6))
    return jax.vmap(jax.vmap(at, (None, 0)), (0, None))(env.tasks(), jnp.array(speeds, jnp.float32))


@pytest.mark.parametrize(
    ("env", "expected"),
    [
        (WalkerStand(), [[1, 1, 1, 1, 1]]),
        (WalkerWalk(), [[0, 0.5, 1, 1, 1]]),
        (WalkerRun(), [[0, 0.0625, 0.125, 0.25, 1]]),
        (WalkerWalk(vary={"speed": [1, 4]}), [[0, 0.5, 1, 1, 1], [0, 0.125, 0.25, 0.5, 1]]),
        (WalkerSpeed(vary={"speed": [1, 4]}), [[0, 0.5, 1, 0, 0], [0, 0.125, 0.25, 0.5, 0]]),
    ],
)
def test_rewards_of_speed(env, expected):
    """A walker that stands and does not move has a sixth; only the velocity tasks mind one that is too fast."""
    move = np.array(expected)
    expected = move if type(env) is WalkerStand else (5 * move + 1) / 6
    np.testing.assert_allclose(rewards(env, [0, 0.5, 1, 2, 8]), expected, atol=1e-6)


def test_friction_is_the_floors_too_and_only_the_left_foot_grows():
    env = WalkerWalk(vary={"friction": [0.7, 1.5], "foot-length": [0.1, 0.15]}, combine="paired", split="none")
    nominal, changed = env.models
    assert np.all(changed.geom_friction[:, 0] == 1.5) and np.array_equal(
        changed.geom_friction[:, 1:], nominal.geom_friction[:, 1:]
    )
    grown = np.flatnonzero(np.any(changed.geom_size != nominal.geom_size, axis=1))
    assert [changed.geom(i).name for i in grown] == ["left_foot"] and changed.geom("left_foot").size[1] == 0.15
