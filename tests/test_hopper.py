"""What is the hopper's own: its feeling foot, its height and its speed."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mtjax.envs.dm_control.hopper import HopperHop, HopperStand
from mtjax.envs.planar import Planar


@pytest.fixture
def placed(monkeypatch):
    """Torsos are as high over the foot, and models as fast, as ``World.extra`` says."""

    def planar(domain, task, world):
        height, speed = world.extra
        torso = domain.models[0].body("torso").id
        centre = jnp.full((domain.models[0].nbody, 2), 3.0).at[torso, 1].add(height)
        return Planar(jnp.zeros(len(centre)), centre, centre, jnp.full_like(centre, speed))

    for module in ("mtjax.envs.planar", "mtjax.envs.dm_control.hopper"):
        monkeypatch.setattr(f"{module}.planar", planar)


def rewards(env, heights, speeds, action=(0.0,) * 4):
    """The reward of the first task for the torso's height over the foot, and the forward velocity."""
    task = jax.tree.map(lambda x: x[0], env.tasks())
    world = jax.jit(env.reset)(task, jax.random.key(0)).state
    put = lambda height, speed: world._replace(extra=(height, speed))
    at = lambda height, speed: env.reward(task, put(height, speed), jnp.array(action))
    return jax.vmap(at)(jnp.array(heights, jnp.float32), jnp.array(speeds, jnp.float32))


@pytest.mark.usefixtures("placed")
def test_standing_pays_for_height_less_effort():
    np.testing.assert_allclose(rewards(HopperStand(), [0.5, 0.7, 1.9, 2.1], [0] * 4), [0, 1, 1, 0])
    np.testing.assert_allclose(rewards(HopperStand(), [0.7], [0], (1, 0.5, 0, -1)), [1 - 0.2 * 2.25 / 4], rtol=1e-6)


@pytest.mark.usefixtures("placed")
def test_hopping_pays_for_height_times_speed():
    np.testing.assert_allclose(rewards(HopperHop(), [0.5, 0.7, 0.7, 0.7, 0.7], [2, -1, 0, 1, 3]), [0, 0, 0, 0.5, 1])
    fast = HopperHop(vary={"speed": [4]})
    np.testing.assert_allclose(rewards(fast, [0.7, 0.7], [1, 4]), [0.25, 1])


def test_touch_stays_at_the_ends_of_a_longer_foot():
    short, long = HopperStand(vary={"foot-length": [1.0, 1.5]}, split="none").models
    np.testing.assert_allclose(long.site_pos, 1.5 * short.site_pos)
    np.testing.assert_allclose(long.site_pos[:, 0], [0.255, -0.12])
    reach = lambda m: m.geom("foot").pos[0] + np.array([1, -1]) * m.geom("foot").size[1]
    np.testing.assert_allclose(reach(long), long.site_pos[:, 0])
    np.testing.assert_array_equal(long.site_size, short.site_size)


def test_a_foot_that_starts_in_the_floor_feels_it():
    """In MuJoCo C the first observation has the touch that is found there; three starts in a thousand have some."""
    env = HopperStand(engine="c")
    tasks = jax.tree.map(lambda x: jnp.repeat(x[:1], 3000, axis=0), env.tasks())
    step = jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), 3000))
    model = env.models[0]
    data, expected = mujoco.MjData(model), []
    for data.qpos[:] in np.asarray(step.state.qpos):
        mujoco.mj_forward(model, data)
        expected.append(data.sensordata.copy())
    assert 3 < np.count_nonzero(np.any(expected, axis=1)) < 20
    np.testing.assert_allclose(step.obs[:, 13:], np.log1p(expected), rtol=1e-4, atol=1e-4)
