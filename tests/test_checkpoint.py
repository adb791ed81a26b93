"""Checkpoints: they hold everything, two are kept, and what is damaged is said in a line."""

import gc
import hashlib
import os
import re
import resource
import shutil
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import one_in, with_nets

import mtjax.train
from mtjax.agents.hyperparameters import replace
from mtjax.learning import loop
from mtjax.names import Notice
from mtjax.saved import arrays, checkpoint
from mtjax.saved.config_json import from_json
from mtjax.saved.folder import new_directory, record_steps, require_unused, tell_edits
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


@pytest.mark.slow
def test_newest_checkpoint_has_every_shape_and_type(state, shapes):
    """The last one of the run, with typed keys, and nothing in the place of task vectors."""
    found = jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert found == jax.tree.map(lambda x: (x.shape, x.dtype), shapes)
    assert int(state.iteration) == 150
    assert jnp.issubdtype(state.key.dtype, jax.dtypes.prng_key)
    assert "given" not in state.agent.nets["tasks"].shared


def test_state_comes_back_as_it_went(state, tmp_path):
    """Every leaf of the whole state, also into mere shapes."""
    checkpoint.save(tmp_path / "checkpoints", state)
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
    assert_equal(checkpoint.load(tmp_path / "checkpoints", shapes), state)


def test_task_vectors_come_back(state, tmp_path):
    """An agent that was given vectors keeps them, whatever becomes of their file."""
    vectors = jnp.arange(12.0).reshape(2, 2, 3)
    known = state.agent.nets["tasks"]
    state = state._replace(agent=with_nets(state.agent, tasks=known._replace(shared=known.shared | {"given": vectors})))
    checkpoint.save(tmp_path, state)
    loaded = checkpoint.load_agent(tmp_path, state).nets["tasks"]
    np.testing.assert_array_equal(loaded.shared["given"], vectors)


@pytest.fixture(scope="module")
def older(state, tmp_path_factory):
    """The checkpoints of a run at its 25th iteration. Only to be copied."""
    folder = tmp_path_factory.mktemp("older")
    checkpoint.save(folder, at(state, 25))
    return folder


def test_two_newest_are_kept(state, tmp_path):
    """The newest is the one that is read; saving an iteration twice is harmless."""
    for iteration in (25, 50, 75, 75):
        checkpoint.save(tmp_path, at(state, iteration))
        assert len(list(tmp_path.iterdir())) <= 2
    assert {path.name for path in tmp_path.iterdir()} == {"50", "75"}
    assert int(checkpoint.load(tmp_path, state).iteration) == 75


@pytest.mark.parametrize(
    "name", one_in(4, ["lr[1]", "proj [v2]", "a*", "a?", "50%", "a\nb", "é", "-a", "~", "{a}", "a:b", '"a"'])
)
def test_a_folder_may_have_any_name(state, older, tmp_path, name):
    """No character of it is a pattern, also beside a folder that such a pattern matches."""
    for other in ("ab", "1"):
        shutil.copytree(older, tmp_path / other / "checkpoints")
    (tmp_path / name).mkdir()
    checkpoint.save(tmp_path / name / "checkpoints", at(state, 50))
    assert_equal(checkpoint.load(tmp_path / name / "checkpoints", state), at(state, 50))


@pytest.mark.parametrize("name", ["a\\b", os.fsdecode(b"a\xff")])
def test_names_that_cannot_hold_a_checkpoint_are_refused(state, tmp_path, name):
    """They would be written elsewhere."""
    refused = (
        lambda place: new_directory(place, "run"),
        require_unused,
        lambda place: checkpoint.require_space(place, state),
        lambda place: checkpoint.save(place / "checkpoints", state),
    )
    for use in refused:
        with pytest.raises(InputError, match="must be UTF-8 without backslashes"):
            use(tmp_path / name)
    assert not list(tmp_path.glob("*/*/*"))


def test_a_checkpoint_that_cannot_be_read_back_takes_no_others_place(state, tmp_path, monkeypatch):
    """A writer that lost the data without an error ends the run with the reason."""
    for iteration in (25, 50):
        checkpoint.save(tmp_path, at(state, iteration))

    def lose(written):
        written_well(written)
        for path in tmp_path.glob("75.new/loop/d/*"):
            path.unlink()
        shutil.rmtree(tmp_path / "75.new" / "agent" / "ocdbt.process_0")

    written_well = arrays.Written.wait
    monkeypatch.setattr(arrays.Written, "wait", lose)
    with pytest.raises(OSError, match="the one before it stays") as caught:
        checkpoint.save(tmp_path, at(state, 75))
    assert caught.value.filename == str(tmp_path / "75")
    assert {path.name for path in tmp_path.iterdir()} == {"25", "50"}


def test_arrays_that_are_missing_are_counted(state, tmp_path):
    """The reader of a folder without data finds none, and raises no error by itself."""
    checkpoint.save(tmp_path, state)
    part, count = {"agent": state.agent}, len(jax.tree.leaves(state.agent))
    arrays.require_readable(tmp_path / "150", part)
    (tmp_path / "150" / "agent" / "manifest.ocdbt").unlink()
    with pytest.raises(OSError, match=f"0 of {count} arrays of agent can be read back"):
        arrays.require_readable(tmp_path / "150", part)


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


def lose_sums(folder):
    (folder / "checksums.txt").unlink()


DAMAGES = [empty_files, halve_files, halve_data, lose_data, lose_agent, lose_metadata, lose_sums]


@pytest.mark.parametrize("damage", DAMAGES)
def test_the_checkpoint_before_a_damaged_one_is_used(copied_run, shapes, damage, capfd):
    """Whichever file is lost or cut short, and no noise from the threads that read."""
    damage(copied_run / "checkpoints" / "150")
    with pytest.warns(Notice, match=r"150' is damaged: .* missing or has changed; .* is used, of iteration 100"):
        assert int(checkpoint.load(copied_run / "checkpoints", shapes).iteration) == 100
    with pytest.warns(Notice, match="of iteration 100"):
        checkpoint.load_agent(copied_run / "checkpoints", shapes)
    gc.collect()  # when coroutines that nobody awaited complain
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("read", [checkpoint.load, checkpoint.load_agent, checkpoint.load_ring])
def test_no_whole_checkpoint_is_an_input_error(copied_run, shapes, read, capfd):
    """One line that names the newest one."""
    for folder in (copied_run / "checkpoints").iterdir():
        halve_files(folder)
    with pytest.raises(InputError, match=r"150' is damaged: .*; there is no whole one before it") as caught:
        read(copied_run / "checkpoints", shapes)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    assert capfd.readouterr() == ("", "")


def test_every_flipped_bit_is_noticed(copied_run):
    """150 of them, in files of every kind; whole again, the checkpoint is whole."""
    folder, random = copied_run / "checkpoints" / "150", np.random.default_rng(0)
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.stat().st_size)
    assert {path.name for path in files} > {"checksums.txt", "_METADATA"}
    for number in range(150):
        file = files[number % len(files)]
        before = file.read_bytes()
        place, bit = random.integers(len(before)), random.integers(8)
        file.write_bytes(flipped(before, place, bit))
        assert checkpoint._damage(folder, ("agent", "loop")), (file, place, bit)
        file.write_bytes(before)
    assert checkpoint._damage(folder, ("agent", "loop")) == ""


def flipped(content, place, bit):
    return content[:place] + bytes([content[place] ^ (1 << bit)]) + content[place + 1 :]


@pytest.mark.slow
def test_every_flipped_bit_of_a_record_is_noticed(copied_run):
    """300 of them. A record that cannot be read is refused, with the place of the copy; any other is told."""
    file, copy = copied_run / "config.json", copied_run / "checkpoints" / "150" / "config.json"
    whole, refused, random = file.read_bytes(), 0, np.random.default_rng(0)
    assert copy.read_bytes() == whole
    for number in range(300):
        file.write_bytes(flipped(whole, random.integers(len(whole)), number % 8))
        try:
            from_json(file)
        except InputError as error:
            refused += 1
            assert f"{str(copy)!r} holds it as it was" in str(error)
        else:
            with pytest.warns(Notice, match="was edited or damaged, and is used as it is; unlike in"):
                tell_edits(file, copy)
    assert 0 < refused < 300


@pytest.mark.slow
def test_what_changed_in_a_record_is_told(copied_run):
    """By name, and where the run's state is read; nothing is said of more steps, nor where there is no copy."""
    file = copied_run / "config.json"
    record_steps(file, 800)
    mtjax.load(copied_run)
    file.write_text(file.read_text().replace('"actor_lr": 0.002', '"actor_lr": 0.006'))
    with pytest.warns(Notice, match=r"unlike in '.*150/config.json', learner.actor_lr is 0.006, not 0.002$"):
        assert mtjax.load(copied_run).agent.actor_lr == 0.006
    with pytest.warns(Notice, match="learner.actor_lr is 0.006, not 0.002"):
        mtjax.train.main([f"--resume={copied_run}"])
    assert mtjax.load(copied_run).agent.actor_lr == 0.006  # its new checkpoint has it
    file.write_text(file.read_text().replace('"steps": 800', '"steps": 900'))
    with pytest.warns(Notice, match="plan.steps is 900, not 800$"):
        mtjax.load(copied_run)
    for copy in (copied_run / "checkpoints").glob("*/config.json"):
        sums = copy.with_name("checksums.txt")
        sums.write_text("".join(x for x in sums.read_text().splitlines(True) if not x.endswith("  config.json\n")))
        copy.unlink()
    mtjax.load(copied_run)


@pytest.mark.parametrize("content", ["[]", '"x"', "{}", '{"plan": 3}', "[" * 100_000, "1" * 5000, "\udcff", ""])
def test_a_copy_of_a_record_that_is_none_is_told(copied_run, shapes, content):
    """In a line; whatever its checksum says, it only tells of edits."""
    folder = copied_run / "checkpoints" / "150"
    content = content.encode(errors="surrogateescape")
    (folder / "config.json").write_bytes(content)
    sums = (folder / "checksums.txt").read_text().splitlines()
    sums = [f"{hashlib.sha256(content).hexdigest()}  config.json" if x.endswith(" config.json") else x for x in sums]
    (folder / "checksums.txt").write_text("\n".join(sums) + "\n")
    with pytest.warns(Notice, match=r"150/config.json' does not describe a run: .* it is used as it is$"):
        assert int(checkpoint.load(copied_run / "checkpoints", shapes).iteration) == 150
    (copied_run / "config.json").write_bytes(content)
    with pytest.raises(InputError, match=r"config\.json' does not describe a run"):
        record_steps(copied_run / "config.json", 3)


def test_a_record_that_changes_during_a_run_is_told(state, tmp_path):
    """The copies are of the file as it was when the run began."""
    (tmp_path / "config.json").write_text('{"plan": {"steps": 3}, "device": "cpu"}')
    writer = checkpoint.Writer(tmp_path / "checkpoints")
    (tmp_path / "config.json").write_text('{"plan": {"steps": 3}, "device": "cqu"}')
    writer.save(state)
    writer.wait()
    with pytest.warns(Notice, match='device is "cqu", not "cpu"$'):
        checkpoint.load_agent(tmp_path / "checkpoints", state)


@pytest.mark.parametrize(
    ("settings", "seeds", "said"),
    [
        ({"hidden": (16, 8)}, 2, r"agent\.nets\.actor.* is of shape .* there, and of shape .* here; \d+ more differ"),
        ({"num_critics": 3}, 2, r"agent\.nets\.critic.* is of shape .* there, and of shape .* here; \d+ more differ"),
        ({}, 3, r"agent\..* is of shape \(2,.* there, and of shape \(3,.* here; \d+ more differ"),
        ({"shared_temperature": True}, 2, r"agent\..*temperature.* is .* there, and .* here"),
    ],
)
def test_a_checkpoint_of_another_run_is_told_by_name(finished_run, settings, seeds, said):
    """What differs, not which class of the reader could not read it."""
    program = from_json(finished_run / "config.json")
    agent, tasks = replace(program.learner, settings), program.family.tasks("train")
    like = jax.eval_shape(lambda: loop.init(program.family, agent, program.training, tasks, jnp.arange(seeds)))
    with pytest.raises(InputError, match=f"150' is of another run: {said}"):
        checkpoint.load(finished_run / "checkpoints", like)


@pytest.mark.parametrize(
    "number, version", [("", "an earlier version of mtjax (format 1"), ("9", "a later version of mtjax (format 9")]
)
def test_a_checkpoint_of_another_version_is_told(copied_run, shapes, number, version):
    """If its arrays are others. While they are the same, it is read."""
    folder = copied_run / "checkpoints" / "150"
    file, sums = folder / "format.txt", folder / "checksums.txt"
    digest, (line,) = hashlib.sha256(number.encode()).hexdigest(), re.findall(r".*  format\.txt\n", sums.read_text())
    sums.write_text(sums.read_text().replace(line, f"{digest}  format.txt\n" if number else ""))
    file.write_text(number) if number else file.unlink()
    assert int(checkpoint.load(copied_run / "checkpoints", shapes).iteration) == 150
    other = shapes._replace(agent=jax.tree.map(lambda x: jax.ShapeDtypeStruct((*x.shape, 2), x.dtype), shapes.agent))
    said = f"150' was made by {version}, this one reads {checkpoint._FORMAT})"
    for read in (checkpoint.load, checkpoint.load_agent):
        with pytest.raises(InputError, match=re.escape(said)):
            read(copied_run / "checkpoints", other)


def test_stray_folders_are_ignored(copied_run, shapes):
    """Empty ones, names that only look like numbers, and those of other programs; files with a number for a name."""
    folder = copied_run / "checkpoints"
    for name in ("99999", "\u00b2", "\u0661", "150.new", "-1", "1e9"):
        (folder / name).mkdir()
    (folder / "88888").write_text("")
    assert int(checkpoint.load(folder, shapes).iteration) == 150
    (folder / "99999" / "notes.txt").write_text("mine")
    with pytest.warns(Notice, match="99999' is damaged: checksums.txt is missing"):
        assert int(checkpoint.load(folder, shapes).iteration) == 150


def test_damaged_checkpoints_are_set_aside(copied_run, shapes):
    """Under another name, so that nothing is lost and the run can write its own."""
    folder = copied_run / "checkpoints"
    checkpoint.set_aside(folder, 100)
    assert {path.name for path in folder.iterdir()} == {"100", "150.damaged"}
    assert int(checkpoint.load(folder, shapes).iteration) == 100


def test_saving_does_not_wait(state, tmp_path, monkeypatch):
    """The state may be overwritten at once: what is written is what it was."""
    gate, seal = threading.Event(), checkpoint._finish
    monkeypatch.setattr(checkpoint, "_finish", lambda *given: gate.wait(60) and seal(*given))
    spoil = jax.jit(lambda tree: jax.tree.map(jnp.zeros_like, tree), donate_argnums=0)
    agent = jax.tree.map(jnp.copy, state.agent)
    writer = checkpoint.Writer(tmp_path)
    writer.save(state._replace(agent=agent))
    jax.block_until_ready(spoil(agent))
    assert not (tmp_path / "150").exists()
    gate.set()
    writer.wait()
    assert_equal(checkpoint.load_agent(tmp_path, state), state.agent)


def test_a_full_disk_keeps_the_checkpoint_before(state, tmp_path, capfd):
    """One error with the reason and the place, no page of log, and nothing half-written stays."""
    checkpoint.save(tmp_path, at(state, 25))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, before[1]))  # the system then refuses longer files
    try:
        with pytest.raises(OSError, match=r"File too large.*; the one before it stays") as caught:
            checkpoint.save(tmp_path, at(state, 50))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert caught.value.filename == str(tmp_path / "50")
    assert [path.name for path in tmp_path.iterdir()] == ["25"]
    assert int(checkpoint.load(tmp_path, state).iteration) == 25
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
    with pytest.raises(InputError, match=r"free; lower --replay-size or choose another place with --runs$"):
        checkpoint.require_space(tmp_path, state)


def test_a_run_to_resume_needs_no_space_for_what_it_has(tmp_path, monkeypatch):
    """Where that is not enough, neither its settings nor its place can change."""
    usage = shutil.disk_usage(tmp_path)
    (tmp_path / "checkpoints" / "25").mkdir(parents=True)
    (tmp_path / "checkpoints" / "25" / "data").write_bytes(bytes(2000))
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage._replace(free=1000))
    checkpoint.require_space(tmp_path, np.zeros(1000, np.int8))
    with pytest.raises(InputError, match="free; make room there") as caught:
        checkpoint.require_space(tmp_path, np.zeros(1001, np.int8))
    assert "choose" not in str(caught.value)
