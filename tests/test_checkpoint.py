"""Checkpoints: they hold everything, two are kept, and what is damaged is said in a line."""

import gc
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax import loop
from mtjax.config import from_json
from mtjax.training import checkpoint
from mtjax.types import InputError


@pytest.fixture(scope="module")
def shapes(finished_run):
    program = from_json(finished_run / "config.json")
    tasks, seeds = program.family.tasks("train"), jnp.arange(2)
    return jax.eval_shape(lambda: loop.init(program.family, program.learner, program.training, tasks, seeds))


@pytest.fixture(scope="module")
def state(finished_run, shapes):
    return checkpoint.load(finished_run / "checkpoints", shapes)


def assert_equal(some, others):
    assert jax.tree.structure(some) == jax.tree.structure(others)
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    for x, y in zip(jax.tree.leaves(some), jax.tree.leaves(others), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(np.asarray(plain(x)), np.asarray(plain(y)))


def at(state, iteration):
    return state._replace(iteration=jnp.full_like(state.iteration, iteration))


def test_newest_checkpoint_has_every_shape_and_type(state, shapes):
    """The last one of the run, with typed keys, and nothing in the place of task vectors."""
    found = jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert found == jax.tree.map(lambda x: (x.shape, x.dtype), shapes)
    assert int(state.iteration) == 150
    assert jnp.issubdtype(state.key.dtype, jax.dtypes.prng_key)
    assert state.agent.vectors is None


def test_state_comes_back_as_it_went(state, tmp_path):
    """Every leaf of the whole state, also into mere shapes."""
    checkpoint.save(tmp_path / "checkpoints", state)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    assert_equal(checkpoint.load(tmp_path / "checkpoints", shapes), state)


def test_task_vectors_come_back(state, tmp_path):
    """An agent that was given vectors keeps them, whatever becomes of their file."""
    vectors = jnp.arange(12.0).reshape(2, 2, 3)
    state = state._replace(agent=state.agent._replace(vectors=vectors))
    checkpoint.save(tmp_path, state)
    np.testing.assert_array_equal(checkpoint.load_agent(tmp_path, state).vectors, vectors)


def test_two_newest_are_kept(state, tmp_path):
    """The newest is the one that is read; saving an iteration twice is harmless."""
    for iteration in (25, 50, 75, 75):
        checkpoint.save(tmp_path, at(state, iteration))
        assert len(list(tmp_path.iterdir())) <= 2
    assert {path.name for path in tmp_path.iterdir()} == {"50", "75"}
    assert int(checkpoint.load(tmp_path, state).iteration) == 75


def test_agent_is_read_without_the_rest(copied_run, state, shapes):
    """Acting needs neither replay nor worlds, not even their files."""
    shutil.rmtree(copied_run / "checkpoints" / "150" / "loop")
    assert_equal(checkpoint.load_agent(copied_run / "checkpoints", shapes), state.agent)


def empty_files(folder):
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(b"")


def halve_files(folder):
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def halve_data(folder):
    for path in folder.glob("*/**/d/*"):
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def lose_data(folder):
    for path in folder.glob("*/**/d"):
        shutil.rmtree(path)


def lose_agent(folder):
    shutil.rmtree(folder / "agent")


def lose_metadata(folder):
    for path in folder.rglob("_*METADATA"):
        path.unlink()


DAMAGES = [empty_files, halve_files, halve_data, lose_data, lose_agent, lose_metadata]


@pytest.mark.parametrize("read", [checkpoint.load, checkpoint.load_agent])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_an_input_error(copied_run, shapes, damage, read, capfd):
    """One line that names the folder, whichever file is lost or cut short, and no noise from the threads that read."""
    damage(copied_run / "checkpoints" / "150")
    with pytest.raises(InputError, match="checkpoint") as caught:
        read(copied_run / "checkpoints", shapes)
    assert "\n" not in str(caught.value) and str(copied_run) in str(caught.value)
    assert len(str(caught.value)) < 400
    gc.collect()  # when coroutines that nobody awaited complain
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("made", [False, True])
def test_no_checkpoint_is_an_input_error(tmp_path, shapes, made):
    """A run that ended before its first one."""
    if made:
        (tmp_path / "checkpoints").mkdir()
    with pytest.raises(InputError, match="holds no checkpoint"):
        checkpoint.load(tmp_path / "checkpoints", shapes)
    assert (tmp_path / "checkpoints").exists() == made


def test_size_counts_bytes(tmp_path):
    """Of arrays and of mere shapes."""
    state = {"a": jnp.zeros((3, 5), jnp.float32), "b": jax.ShapeDtypeStruct((7,), jnp.int8)}
    assert checkpoint.size_of(state) == 67


def test_space_is_for_one_more_than_is_kept(tmp_path, monkeypatch):
    """As a new checkpoint is written before an old one goes."""
    state = np.zeros(1000, np.int8)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage._replace(free=3000))
    checkpoint.require_space(tmp_path, state)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage._replace(free=2999))
    with pytest.raises(InputError, match="free"):
        checkpoint.require_space(tmp_path, state)
