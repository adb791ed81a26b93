"""What a host with four devices does; ``test_devices`` runs this file in a process that has them."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, tiny

from mtjax import devices, envs, run
from mtjax.loop import Settings

SETTINGS = Settings(num_envs=2, batch_size=4, replay_size=40, warmup_steps=4, chunk_steps=10)
CHUNK = 2 * 2 * 10  # environment steps of a seed
AGENT = tiny("sac-conditioned", hidden=(8,))


def play(directory, env, chunks, **changes):
    directory.mkdir(exist_ok=True)
    steps = {"steps": chunks * CHUNK, "eval_every": 2 * CHUNK, "eval_episodes": 2}
    return run.train(env, AGENT, settings=SETTINGS, directory=directory, **{"seeds": 4, **steps, **changes})


@pytest.fixture
def use(monkeypatch):
    """Let runs see only the first devices."""
    everything = jax.devices()
    return lambda count: monkeypatch.setattr(jax, "devices", lambda: everything[:count])


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Four seeds on a single device, by the path that knows of no other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(devices, "mesh_for", lambda seeds: None)
        return play(tmp_path_factory.mktemp("alone"), Walk(), 4)


@pytest.fixture(scope="module")
def halfway(tmp_path_factory):
    """The folder of a run on four devices that is half done."""
    result = play(tmp_path_factory.mktemp("halfway"), Walk(), 2)
    assert devices_of(result) == 4
    return result.directory


def devices_of(result):
    return len(result.state.obs.sharding.device_set)


def plain(state):
    of_key = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return jax.tree.map(lambda x: np.asarray(of_key(x)), state)


def assert_same(result, other, chunks=4, rtol=1e-4):
    """State, lines of metrics and evaluations, up to rounding; keys and counts to the bit."""
    for x, y in zip(jax.tree.leaves(plain(result.state)), jax.tree.leaves(plain(other.state)), strict=True):
        assert x.shape == y.shape and x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol * 0.1)
    clocks = ("seconds", "wall_seconds")
    for row, expected in zip(result.rows, other.rows[-len(result.rows) :], strict=True):
        assert row.keys() == expected.keys()
        for name in row.keys() - set(clocks):
            number = lambda x: float(x) if x != "" else np.nan
            assert number(row[name]) == pytest.approx(number(expected[name]), rel=rtol, abs=rtol, nan_ok=True), name
    assert len(other.rows) == 4 * chunks
    np.testing.assert_array_equal(result.evaluations.steps, other.evaluations.steps)
    for split, returns in result.evaluations.returns.items():
        np.testing.assert_allclose(returns, other.evaluations.returns[split], rtol=rtol, atol=rtol)


def test_four_devices_change_no_seed(alone, tmp_path, capfd):
    """Each seed has a device of its own, and learns what it would have learned beside the others on one."""
    result = play(tmp_path / "run", Walk(), 4, quiet=False)
    assert "devices: 4 of 4, 1 seed on each" in capfd.readouterr().out
    assert devices_of(result) == 4 and devices_of(alone) == 1
    assert [len(x.addressable_shards) for x in (result.state.obs, result.state.replay.rows.obs)] == [4, 4]
    assert result.state.iteration.is_fully_replicated and result.state.replay.size.is_fully_replicated
    assert_same(result, alone)


def test_donated_state_is_gone(tmp_path):
    """A chunk's replay takes the place of the one before it, on every device."""
    mesh = devices.mesh_for(4)
    programs, env = devices.programs(mesh), Walk()
    tasks, seeds = devices.everywhere(mesh, env.tasks()), devices.by_seed(mesh, jnp.arange(4))
    state = programs.init(env, AGENT, SETTINGS, tasks, seeds, None)
    after, metrics = programs.chunk(env, AGENT, SETTINGS, tasks, state)
    assert state.replay.rows.obs.is_deleted() and int(after.iteration) == 10
    assert metrics["return"].shape == (4, 2) and len(metrics["return"].sharding.device_set) == 4


@pytest.mark.parametrize("count", [4, 2, 1])
def test_checkpoint_goes_on_with_other_devices(alone, halfway, tmp_path, use, count):
    """What four devices saved, four, two or one take up."""
    use(count)
    shutil.copytree(halfway, tmp_path / "run")
    result = play(tmp_path / "run", Walk(), 4, resume=True)
    assert devices_of(result) == count
    assert_same(result, alone)


def test_checkpoint_of_one_device_goes_on_with_four(alone, tmp_path, use):
    """The other way round."""
    use(1)
    assert devices_of(play(tmp_path / "run", Walk(), 2)) == 1
    use(4)
    result = play(tmp_path / "run", Walk(), 4, resume=True)
    assert devices_of(result) == 4
    assert_same(result, alone)


def test_host_engine_serves_every_device(short_family, tmp_path, use):
    """MuJoCo C is called back from each device, and steps the worlds that it is given."""
    env = envs.make("finger-short")
    assert env.engine_name == "c"
    result = play(tmp_path / "four", env, 1, eval_episodes=1)
    assert devices_of(result) == 4
    use(1)
    assert_same(result, play(tmp_path / "one", env, 1, eval_episodes=1), chunks=1, rtol=1e-2)
