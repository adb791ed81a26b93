"""What a host with four devices does; ``test_devices`` runs this file in a process that has them."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec
from probes import Goals, Walk, tiny, train_objects

from mtjax import envs
from mtjax.compiling.programs import jit_programs
from mtjax.config import configure
from mtjax.learning.loop import Settings
from mtjax.parallel import collectives as shares
from mtjax.parallel import mesh as meshes

SETTINGS = {"num_envs": 2, "batch_size": 4, "replay_size": 40, "warmup_steps": 4, "chunk_steps": 10, "stagger": False}
WIDE = SETTINGS | {"num_envs": 4, "replay_size": 100}  # half full in two chunks
SPARSE = {"n_step": 3, "update_every": 2, "policy_delay": 3}
AGENT = tiny("sac-conditioned", hidden=(8,))
NIGHTLY = pytest.mark.nightly


def play(directory, env, chunks, agent=AGENT, settings=SETTINGS, **changes):
    directory.mkdir(exist_ok=True)
    chunk = len(env.tasks().id) * settings["num_envs"] * settings["chunk_steps"]  # environment steps of a seed
    steps = {"steps": chunks * chunk, "eval_every": 2 * chunk, "eval_episodes": 2}
    return train_objects(env, agent, directory=directory, **settings, **{"seeds": 4, **steps, **changes})


@pytest.fixture
def use(monkeypatch):
    """Let runs see only the first devices."""
    everything = jax.devices()
    return lambda count: monkeypatch.setattr(jax, "devices", lambda: everything[:count])


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Four seeds on a single device, by the path that knows of no other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(meshes, "mesh_for", lambda *_: None)
        return play(tmp_path_factory.mktemp("alone"), Walk(), 4)


@pytest.fixture(scope="module")
def halfway(tmp_path_factory):
    """The folder of a run on four devices that is half done."""
    result = play(tmp_path_factory.mktemp("halfway"), Walk(), 2)
    assert devices_of(result) == 4
    return result.directory


def devices_of(result):
    return len(result.state.worlds.obs.sharding.device_set)


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
    assert len(other.rows) == len(other.state.worlds.obs) * chunks
    np.testing.assert_array_equal(result.evaluations.steps, other.evaluations.steps)
    for split, returns in result.evaluations.returns.items():
        np.testing.assert_allclose(returns, other.evaluations.returns[split], rtol=rtol, atol=rtol)


def test_four_devices_change_no_seed(alone, tmp_path, capfd):
    """Each seed has a device of its own, and learns what it would have learned beside the others on one."""
    result = play(tmp_path / "run", Walk(), 4, quiet=False)
    assert "devices: 4 of 4, 1 seed on each" in capfd.readouterr().out
    assert devices_of(result) == 4 and devices_of(alone) == 1
    assert [len(x.addressable_shards) for x in (result.state.worlds.obs, result.state.data.ring.rows.obs)] == [4, 4]
    assert result.state.iteration.is_fully_replicated and result.state.data.ring.size.is_fully_replicated
    assert_same(result, alone)


def test_a_population_chooses_over_four_devices_as_on_one(tmp_path, monkeypatch):
    """A member's copy may be on another device than its source."""
    chunk = len(Walk().tasks().id) * SETTINGS["num_envs"] * SETTINGS["chunk_steps"]
    given = {"seeds": 2, "population": f"pbt:{2 * chunk}", "sweep": {"tau": [0.1, 0.2]}}
    result = play(tmp_path / "four", Walk(), 4, **given)
    assert devices_of(result) == 4 and len(set(np.asarray(result.state.origins).tolist())) == 3
    monkeypatch.setattr(meshes, "mesh_for", lambda *_: None)
    alone = play(tmp_path / "alone", Walk(), 4, **given)
    assert_same(result, alone)
    rows = [(tmp_path / name / "population.csv").read_text().splitlines() for name in ("four", "alone")]
    assert len(rows[0]) == 5 and rows[0] == rows[1]


def test_donated_state_is_gone(tmp_path):
    """A chunk's replay takes the place of the one before it, on every device."""
    mesh = meshes.mesh_for(4, 2, 2)
    agent, settings = configure(AGENT, Settings(), SETTINGS)
    programs, env = jit_programs(mesh, agent), Walk()
    tasks, seeds = meshes.replicate(mesh, env.tasks()), meshes.shard_by_seed(mesh, jnp.arange(4))
    state = programs.init(env, agent, settings, tasks, seeds, None)
    after, metrics = programs.chunk(env, agent, settings, tasks, state)
    assert state.data.ring.rows.obs.is_deleted() and int(after.iteration) == 10
    assert metrics["return"].shape == (4, 2) and len(metrics["return"].sharding.device_set) == 4


@pytest.mark.parametrize("count", [pytest.param(4, marks=NIGHTLY), 2, pytest.param(1, marks=NIGHTLY)])
def test_checkpoint_goes_on_with_other_devices(alone, halfway, tmp_path, use, count):
    """What four devices saved, four, two or one take up."""
    use(count)
    shutil.copytree(halfway, tmp_path / "run")
    result = play(tmp_path / "run", Walk(), 4, resume=True)
    assert devices_of(result) == count
    assert_same(result, alone)


def test_devices_share_what_comes_back_from_the_host(tmp_path, use):
    """Two seeds of two devices each bring back what one device does. A run may go on with another number."""
    settings = WIDE | {"host_replay_size": 200, "n_step": 2}
    wide = lambda directory, chunks, **changes: play(directory, Walk(), chunks, settings=settings, seeds=2, **changes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(meshes, "LEAST_WORLDS", 1)
        result = wide(tmp_path / "four", 8)
        wide(tmp_path / "other", 6)
    use(1)
    alone, other = wide(tmp_path / "one", 8), wide(tmp_path / "other", 8, resume=True)
    assert (devices_of(result), devices_of(alone)) == (4, 1) and float(alone.state.data.ring.recalled.share) > 0.5
    assert_same(result, alone, chunks=8)
    assert_same(other, alone, chunks=8)


@NIGHTLY
def test_checkpoint_of_one_device_goes_on_with_four(alone, tmp_path, use):
    """The other way round."""
    use(1)
    assert devices_of(play(tmp_path / "run", Walk(), 2)) == 1
    use(4)
    result = play(tmp_path / "run", Walk(), 4, resume=True)
    assert devices_of(result) == 4
    assert_same(result, alone)


@NIGHTLY
def test_host_engine_serves_every_device(short_family, tmp_path, use):
    """MuJoCo C is called back from each device, and steps the worlds that it is given."""
    env = envs.make("finger-short")
    assert env.engine_name == "c"
    result = play(tmp_path / "four", env, 1, eval_episodes=1)
    assert devices_of(result) == 4
    use(1)
    assert_same(result, play(tmp_path / "one", env, 1, eval_episodes=1), chunks=1, rtol=1e-2)


# Environments of a seed on several devices.


@pytest.fixture
def crowd(monkeypatch):
    """Let a device be content with few worlds."""
    monkeypatch.setattr(meshes, "LEAST_WORLDS", 1)


def wide(directory, chunks=4, **changes):
    return play(directory, Walk(), chunks, settings=WIDE, **{"seeds": 1, **changes})


def parts_of(x):
    """Shapes of the parts of an array that devices hold, and how many of these differ in their place."""
    parts = x.addressable_shards
    return {part.data.shape for part in parts}, len({str(part.index) for part in parts})


@pytest.fixture(scope="module")
def wide_alone(tmp_path_factory):
    """One seed with four environments on a single device."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(meshes, "mesh_for", lambda *_: None)
        return wide(tmp_path_factory.mktemp("alone"))


def test_devices_that_share_a_seed_learn_what_one_does(wide_alone, tmp_path, crowd, capfd):
    """Each has an environment of every task and what it brought, and the whole agent."""
    result = wide(tmp_path / "run", quiet=False)
    assert "devices: 4 of 4, 1 seed on every 4, 1 of each task's 4 environments on each" in capfd.readouterr().out
    assert parts_of(result.state.worlds.obs) == ({(1, 2, 1, 1)}, 4)
    assert parts_of(result.state.data.ring.rows.obs) == ({(1, 2, 25, 1, 1)}, 4)
    assert all(x.is_fully_replicated for x in jax.tree.leaves((result.state.agent, result.state.key)))
    assert_same(result, wide_alone)


@pytest.mark.parametrize("given", [pytest.param({}, id="plain"), pytest.param(SPARSE, id="sparse", marks=NIGHTLY)])
def test_two_seeds_on_two_devices_each(tmp_path, use, crowd, given):
    """With parts that watch all outcomes, hindsight, and episodes that draw their tasks."""
    agent = tiny("sac-conditioned", hidden=(8,), scaling="reward", sampler="progress", actor_lr=1e-5)
    settings = WIDE | {"hindsight": 0.5} | given
    share = lambda name: play(tmp_path / name, Goals(drawn=True), 2, agent, settings, seeds=2)
    result = share("four")
    assert parts_of(result.state.worlds.obs) == ({(1, 4, 2, 1)}, 4)
    use(1)
    assert_same(result, share("one"), chunks=2)


@pytest.mark.parametrize("before, after", [pytest.param(4, 1, marks=NIGHTLY), (1, 4)])
def test_checkpoint_goes_on_with_other_shares(wide_alone, tmp_path, use, crowd, before, after):
    """While the ring is half full, which it is in every part alike."""
    use(before)
    halfway = wide(tmp_path, 2)
    assert devices_of(halfway) == before and int(halfway.state.data.ring.size) == 20
    use(after)
    result = wide(tmp_path, resume=True)
    assert devices_of(result) == after
    assert_same(result, wide_alone)


def test_devices_of_a_seed_agree_by_themselves(crowd, monkeypatch):
    """They make the same updates to the bit, where sums are made in the same order."""
    monkeypatch.setattr(shares, "agreed", lambda tree: tree)
    given = WIDE | {"chunk_steps": 12}  # so that no program of before is taken
    agent, settings = configure(AGENT, Settings(), given)
    programs, env = jit_programs(mesh := meshes.mesh_for(1, 2, 4), agent), Walk()
    tasks, seeds = meshes.replicate(mesh, env.tasks()), meshes.shard_by_seed(mesh, jnp.arange(1))
    start = programs.init(env, agent, settings, tasks, seeds, None)
    first = jax.tree.map(np.asarray, start.agent.nets["critic"])
    after, _ = programs.chunk(env, agent, settings, tasks, start)
    assert not jax.tree.all(jax.tree.map(np.array_equal, first, after.agent.nets["critic"]))
    for x in jax.tree.leaves((after.agent, after.data.ring.size, after.iteration)):
        assert len({np.asarray(part.data).tobytes() for part in x.addressable_shards}) == 1


def test_host_engine_serves_shares_of_a_seed(short_family, tmp_path, use, crowd):
    """Each device calls back with its own worlds."""
    env = envs.make("finger-short")
    result = play(tmp_path / "four", env, 1, settings=WIDE, seeds=1, eval_episodes=1)
    assert parts_of(result.state.worlds.state.qpos) == ({(1, 2, 1, 3)}, 4)
    use(1)
    alone = play(tmp_path / "one", env, 1, settings=WIDE, seeds=1, eval_episodes=1)
    assert_same(result, alone, chunks=1, rtol=1e-2)


WHOLE, PART, SEEDS = PartitionSpec(), PartitionSpec(None, shares.AXIS), PartitionSpec("seeds")


def mesh_of(groups):
    return jax.make_mesh((groups, 4 // groups), ("seeds", shares.AXIS), axis_types=(jax.sharding.AxisType.Auto,) * 2)


def shared(function, groups, inputs, outputs=WHOLE):
    """A function of arrays by the devices of each of so many seeds."""
    return jax.jit(jax.shard_map(function, mesh=mesh_of(groups), in_specs=inputs, out_specs=outputs, check_vma=False))


def test_devices_are_counted_where_a_program_is_split():
    """One function, compiled anew for every way; not where a mesh leaves it to the compiler to split."""
    count = jax.jit(lambda x: x + shares.count())
    split = lambda groups: shared(count, groups, WHOLE)(np.float32(0))
    assert [split(1), split(2), split(4), count(np.float32(0)), split(2)] == [4, 2, 1, 1, 2]
    with jax.set_mesh(mesh_of(1)):
        assert count(np.float32(0)) == 1


@pytest.mark.parametrize("groups", [1, 2])
def test_parts_of_what_all_have_make_the_whole_again(groups):
    """Keys too, in the order of the devices."""
    x, keys = np.arange(24.0).reshape(2, 4, 3), jax.random.split(jax.random.key(0), (2, 4))
    np.testing.assert_array_equal(shared(lambda x: shares.own(x, 1), groups, WHOLE, PART)(x), x)
    assert (shared(lambda x: shares.own(x, 1), groups, WHOLE, PART)(keys) == keys).all()
    found = shared(lambda x: shares.whole({"x": x, "odd": x % 2 > 0}, 1), groups, PART)(x)
    np.testing.assert_array_equal(found["x"], x)
    np.testing.assert_array_equal(found["odd"], x % 2 > 0)


@pytest.mark.parametrize("groups", [1, 2])
def test_sums_and_picks_are_among_the_devices_of_a_seed(groups):
    """A row comes from the device that is named, even if others hold what is no number."""
    each = 4 // groups
    x = np.arange(8.0).reshape(2, 4)
    parts = x.reshape(2, each, -1)
    np.testing.assert_array_equal(shared(shares.total, groups, PART)(x), parts.sum(axis=1))
    holder = np.int32([each - 1, 0])
    pick = shared(lambda x: shares.pick({"x": x[:, :1]}, holder), groups, PART)
    np.testing.assert_array_equal(pick(x)["x"][:, 0], [parts[0, -1, 0], parts[1, 0, 0]])
    x[0, 0] = x[1, -1] = np.nan
    found = shared(lambda x: shares.pick(x[:, -1:], holder), groups, PART)(x)
    np.testing.assert_array_equal(found[:, 0], [parts[0, -1, -1], parts[1, 0, -1]])


def test_what_differs_is_made_the_first_devices():
    """Of each seed; counts are left alone, as they cannot round."""

    def drift(x):
        number = jax.lax.axis_index(shares.AXIS)
        return shares.whole(shares.agreed((x + 0.1 * number, jnp.int32(x) + number)), 0)

    floats, counts = shared(drift, 2, SEEDS, SEEDS)(np.float32([1, 2]))
    np.testing.assert_array_equal(floats, [1, 1, 2, 2])
    np.testing.assert_array_equal(counts, [1, 2, 2, 3])


@pytest.mark.parametrize("rule", ["pcgrad", pytest.param("famo", marks=NIGHTLY)])
def test_rollouts_on_two_devices_are_learned_from_as_on_one(crowd, use, rule):
    """Gradients are averaged before they are compared, and so are moments, units and advantages.

    With one minibatch, as each device deals out its own steps, and without entropy's noise.
    """
    settings = {"minibatches": 1, "epochs": 2, "entropy_cost": 0.0, "unroll": 4, "value_normalization": "popart"}
    agent, given = tiny("ppo", hidden=(8,), gradients=rule, **settings), {"num_envs": 4, "chunk_steps": 8}
    states = []
    for count in (2, 1):
        use(count)
        result = train_objects(Walk(), agent, steps=2 * 4 * 16, seeds=1, eval_episodes=1, **given)
        assert devices_of(result) == count
        states.append(jax.tree.leaves(plain(result.state.agent)))
    for x, y in zip(*states, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5)
