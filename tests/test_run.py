"""The host loop: what a run leaves behind, that it repeats to the bit, and that it stops and goes on cleanly."""

import contextlib
import csv
import dataclasses
import errno
import io
import itertools
import json
import math
import os
import pathlib
import pickle
import re
import resource
import shlex
import shutil
import signal
import sys
import threading
import types

import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from conftest import SHORT_RUN
from probes import one_in, train_objects, with_nets

import mtjax
import mtjax.train
from mtjax.command import process, run_config
from mtjax.compiling import trace_cache
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import Plan, fit_chunk
from mtjax.learning import loop
from mtjax.learning.evaluation import load_evaluations, save_evaluations
from mtjax.learning.loop import Settings
from mtjax.names import Notice
from mtjax.progress import duration
from mtjax.report import read_runs
from mtjax.saved import checkpoint, log
from mtjax.saved.config_json import from_json
from mtjax.saved.folder import evaluations_of, new_directory
from mtjax.saved.records import Records
from mtjax.training import entries, journal, run
from mtjax.training.console import Clock
from mtjax.training.journal import Journal
from mtjax.training.stops import require_finite, stop_signals
from mtjax.types import SPLITS, InputError

CLOCKS = {"seconds", "wall_seconds"}
CHUNK = 100  # environment steps of a seed in a chunk of SHORT_RUN


@pytest.fixture(scope="module")
def play(short_family):
    """Train as SHORT_RUN does, apart from what is given."""

    def play(directory=None, settings=None, **changes):
        program = run_config.parse(SHORT_RUN)
        settings = settings or program.training
        if directory is not None:
            directory.mkdir(exist_ok=True)
        return train_objects(
            program.family,
            program.learner,
            settings=settings,
            directory=directory,
            **{**dataclasses.asdict(program.plan), **changes},
        )

    return play


@pytest.fixture(scope="module")
def whole(play, tmp_path_factory):
    """A run that nothing interrupted."""
    return play(tmp_path_factory.mktemp("whole"))


def rows_of(directory):
    with (directory / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k not in CLOCKS} for row in csv.DictReader(file)]


def bytes_of(state):
    """Every leaf of a state by its path, typed keys too."""
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return {jax.tree_util.keystr(k): np.asarray(plain(x)).tobytes() for k, x in jax.tree.leaves_with_path(state)}


def assert_same_run(result, whole):
    assert rows_of(result.directory) == rows_of(whole.directory)
    assert bytes_of(result.state) == bytes_of(whole.state)
    assert_same_evaluations(result.evaluations, whole.evaluations)
    on_disk = load_evaluations(result.directory / "evaluations.npz")
    assert_same_evaluations(on_disk, whole.evaluations)


def assert_same_evaluations(some, others):
    for x, y in zip(jax.tree.leaves(some), jax.tree.leaves(others), strict=True):
        np.testing.assert_array_equal(x, y)


def after(chunks, act):
    """A function for on_chunk that acts once a number of chunks are done."""
    return lambda row: act() if row["steps"] == chunks * CHUNK else None


# What a run leaves behind.


def test_folder_holds_all_there_is_to_know(finished_run):
    """Nothing else either: no half-written file stays."""
    files = {"config.json", "metrics.csv", "evaluations.npz", "checkpoints", "curve.png"}
    assert {path.name for path in finished_run.iterdir()} == files
    assert finished_run.name.startswith("finger-short-sac-conditioned-2")
    assert matplotlib.image.imread(finished_run / "curve.png").std() > 0


def test_config_records_settings_and_circumstances(finished_run):
    """Names, settings, versions, engine, device and command."""
    config = json.loads((finished_run / "config.json").read_text())
    assert (config["env"], config["agent"], config["engine"], config["device"]) == (
        "finger-short",
        "sac-conditioned",
        "c",
        jax.devices()[0].device_kind,
    )
    assert config["versions"]["jax"] == jax.__version__
    assert config["versions"]["mtjax"] == mtjax.__version__
    assert {"mujoco", "mujoco-mjx", "flax", "optax", "numpy", "orbax-checkpoint"} <= set(config["versions"])
    assert config["training"]["chunk_steps"] == 25 and config["learner"]["hidden"] == [8, 8]
    assert config["command"].startswith("python -m mtjax.train --env=finger-short ")


def test_recorded_command_repeats_the_program(finished_run):
    """The words after ``python -m mtjax.train`` parse to what the file records."""
    words = shlex.split(json.loads((finished_run / "config.json").read_text())["command"])
    recorded = from_json(finished_run / "config.json")
    assert run_config.parse([*words[3:], f"--runs={recorded.runs}"]) == recorded


def test_metrics_have_a_row_a_seed_a_chunk(finished_run):
    """Steps count every task and environment of one seed; returns are of finished episodes."""
    rows = rows_of(finished_run)
    assert [(r["seed"], r["iteration"], r["steps"]) for r in rows] == [
        (str(seed), str(25 * chunk), str(CHUNK * chunk)) for chunk in range(1, 7) for seed in (0, 1)
    ]
    learned = {"actor_loss", "critic_loss", "entropy", "temperature", "value", "td_error", "td_error_0", "td_error_1"}
    played = {"return", "episodes", "lost", "return_0", "return_1"}
    assert set(rows[0]) == {"seed", "iteration", "steps"} | played | learned
    for row in rows:
        assert float(row["return"]) == pytest.approx((float(row["return_0"]) + float(row["return_1"])) / 2, rel=1e-5)
        assert 0 < float(row["return"]) < 45


def test_seconds_of_metrics_grow(finished_run):
    """Training seconds never exceed seconds since the start."""
    with (finished_run / "metrics.csv").open(newline="") as file:
        clocks = np.array([[float(row["seconds"]), float(row["wall_seconds"])] for row in csv.DictReader(file)])
    assert np.all(np.diff(clocks[::2], axis=0) > 0) and np.all(clocks[:, 0] <= clocks[:, 1] + 1e-3)


def test_evaluations_are_whole(finished_run):
    """Arrays (S, V, T, episodes) of each split with the steps and the parameter's values."""
    with np.load(finished_run / "evaluations.npz") as file:
        assert file["steps"].tolist() == [200, 400, 600]
        shapes = {split: file[split].shape for split in ("train", "interpolation", "extrapolation")}
        values = {split: file[f"{split}_values"] for split in shapes}
        assert len(np.unique(np.concatenate([file[s].reshape(-1) for s in shapes]))) == 6 * 7
    assert shapes == {"train": (2, 3, 2, 1), "interpolation": (2, 3, 1, 1), "extrapolation": (2, 3, 4, 1)}
    np.testing.assert_allclose(values["train"], [1.0, 1.2], rtol=1e-6)
    np.testing.assert_allclose(values["interpolation"], [1.1], rtol=1e-6)
    np.testing.assert_allclose(values["extrapolation"], [0.6, 0.8, 1.4, 1.6], rtol=1e-6)


def test_two_newest_checkpoints_stay(finished_run):
    """A checkpoint an evaluation, under its iteration."""
    assert {path.name for path in (finished_run / "checkpoints").iterdir()} == {"100", "150"}


def test_runs_of_one_second_have_folders_of_their_own(tmp_path, monkeypatch):
    """Folders that exist are left as they are."""
    monkeypatch.setattr("time.strftime", lambda _: "20260101-000000")
    first = new_directory(tmp_path / "runs", "name")
    (first / "config.json").write_text("mine")
    names = [new_directory(tmp_path / "runs", "name").name for _ in range(2)]
    assert [first.name, *names] == [f"name-20260101-000000{end}" for end in ("", "-1", "-2")]
    assert (first / "config.json").read_text() == "mine"


def test_no_directory_writes_nothing_and_prints_nothing(play, tmp_path, monkeypatch, capsys):
    """The library does not surprise: a chunk's first row goes to on_chunk alone, and an evaluation to on_evaluation."""
    monkeypatch.chdir(tmp_path)
    seen, evaluated = [], []
    result = play(None, steps=200, on_chunk=seen.append, on_evaluation=lambda found: evaluated.append(found.steps))
    assert not list(tmp_path.iterdir()) and capsys.readouterr() == ("", "")
    assert seen == result.rows[::2] and [row["seed"] for row in result.rows] == [0, 1, 0, 1]
    assert result.finished and result.directory is None and result.evaluations.steps.tolist() == [200]
    assert [steps.tolist() for steps in evaluated] == [[200]]


@pytest.mark.slow
def test_profile_is_of_one_warm_chunk(play, tmp_path, capsys):
    """The trace is in the run's folder, and the line says where; compiling is timed apart from running."""
    result = play(tmp_path, steps=300, profile=True, quiet=False)
    (trace,) = tmp_path.glob("profile/plugins/profile/*/*.trace.json.gz")
    lines = capsys.readouterr().out.splitlines()
    said = [i for i, line in enumerate(lines) if f"profile of one chunk: {tmp_path / 'profile'} " in line]
    chunks = [i for i, line in enumerate(lines) if "of 300 steps" in line]
    assert trace.stat().st_size and len(said) == 1 and chunks[0] < said[0] < chunks[1]
    compiled = next(line for line in lines if line.startswith("compiled in "))
    assert compiled == f"compiled in {duration(result.compile_seconds)}" and result.compile_seconds > 0
    assert result.seconds == pytest.approx(float(result.rows[-1]["seconds"]), abs=1e-3)


@pytest.mark.slow
def test_profile_of_a_run_of_one_chunk_is_of_that(play, tmp_path):
    play(tmp_path, steps=100, profile=True)
    assert list(tmp_path.glob("profile/plugins/profile/*/*.trace.json.gz"))


@pytest.mark.slow
def test_the_clock_counts_down_to_the_end(play, tmp_path, monkeypatch):
    """Of a run and of the rest of one: its chunks, and its evaluations, the last of which is at no multiple.

    Seconds and rates are those of a chunk, for all seeds.
    """
    made, rates = [], []
    monkeypatch.setattr(journal, "Clock", lambda *given: made.append((given, Clock(*given))) or made[-1][1])
    monkeypatch.setattr(journal.Console, "progress", lambda console, steps, passed, rate, *_: rates.append(rate))
    results = play(tmp_path, steps=500), play(tmp_path, steps=800, resume=True)
    assert [given for given, _ in made] == [(5, 3, 1), (3, 2, 0)]
    clocks = [clock for _, clock in made]
    assert [(clock.chunks, clock.evaluations) for clock in clocks] == [(0, 0)] * 2
    seconds = [sum(clock.chunk_seconds) for clock in clocks]
    assert seconds == pytest.approx([result.trained_seconds for result in results])
    assert rates == pytest.approx([2 * CHUNK / each for clock in clocks for each in clock.chunk_seconds])


def test_profile_needs_a_folder(short_family):
    """It is refused before anything compiles."""
    with pytest.raises(InputError, match=r"profile, .* need the run's folder"):
        mtjax.train("finger-short", "sac", profile=True)


# Repeating.


def test_same_seed_gives_the_same_bytes(finished_run, whole):
    """The program and the function, run twice, agree on every number."""
    shapes = jax.eval_shape(lambda: whole.state)
    again = checkpoint.load(finished_run / "checkpoints", shapes)
    assert bytes_of(again) == bytes_of(whole.state)
    assert rows_of(finished_run) == rows_of(whole.directory)
    assert_same_evaluations(load_evaluations(finished_run / "evaluations.npz"), whole.evaluations)


def test_seeds_differ(whole):
    """Networks, worlds and keys: nothing that chance touches is shared."""
    chance = {
        path: data
        for path, data in bytes_of(whole.state).items()
        if "kernel" in path or path in (".key", ".warmup_key", ".obs", ".env.qpos", ".replay.rows.action")
    }
    assert len(chance) > 10
    assert not [path for path, data in chance.items() if data[: len(data) // 2] == data[len(data) // 2 :]]


@pytest.mark.slow
def test_a_seed_among_many_is_that_seed_alone(short_family, whole):
    """Up to rounding: the same draws, so the first chunk is the same."""
    program = run_config.parse(SHORT_RUN)
    fixed = (program.family, program.learner, program.training, program.family.tasks("train"))
    _, metrics = loop.run_chunk(*fixed, loop.init(*fixed, jnp.array([1])))
    row = whole.rows[1]
    assert row["seed"] == 1
    for name in ("return", "critic_loss", "actor_loss", "entropy"):
        assert float(jnp.mean(metrics[name])) == pytest.approx(float(row[name]), rel=1e-3), name


# Stopping and going on.


@pytest.mark.parametrize("number, chunks", one_in(2, [(signal.SIGINT, 3), (signal.SIGTERM, 1)]))
def test_stopped_run_goes_on_to_the_bit(play, whole, tmp_path, number, chunks):
    """A signal ends the run after its chunk, with a checkpoint; resumed, nothing tells it from an unbroken one.

    Where it stops before its first evaluation, none is missed.
    """
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    stopped = play(tmp_path, on_chunk=after(chunks, lambda: os.kill(os.getpid(), number)))
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before
    assert not stopped.finished and len(rows_of(tmp_path)) == 2 * chunks
    assert (tmp_path / "checkpoints" / str(25 * chunks)).is_dir()
    resumed = play(tmp_path, resume=True)
    steps = [CHUNK * chunk for chunk in range(chunks + 1, 7)]
    assert resumed.finished and [row["steps"] for row in resumed.rows[::2]] == steps
    assert_same_run(resumed, whole)


def test_a_signal_in_the_last_chunk_stops_what_follows_alone(play):
    """The run is finished, and says so."""
    result = play(None, steps=100, on_chunk=after(1, lambda: os.kill(os.getpid(), signal.SIGINT)))
    assert (result.finished, result.signal) == (True, signal.SIGINT)


@pytest.mark.slow
def test_a_run_is_stopped_from_within(play, whole, tmp_path):
    """By True alone, as functions may return anything else; there is a checkpoint, and no signal."""
    seen = []
    stopped = play(tmp_path, on_chunk=lambda line: seen.append(line) or [1, True][len(seen) == 2])
    assert (stopped.finished, stopped.signal, len(seen)) == (False, 0, 2)
    assert_same_run(play(tmp_path, resume=True), whole)


@pytest.mark.slow
def test_broken_run_goes_on_from_its_last_checkpoint(play, whole, tmp_path):
    """Rows that the checkpoint does not know are dropped and written again."""

    def breaks():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        play(tmp_path, on_chunk=after(5, breaks))
    assert len(rows_of(tmp_path)) == 10 and (tmp_path / "checkpoints" / "100").is_dir()
    assert_same_run(play(tmp_path, resume=True), whole)


@pytest.mark.slow
def test_run_that_died_before_its_first_checkpoint_starts_over(play, whole, tmp_path, capsys):
    """What it left in its folder does no harm; the line says that it starts over."""

    def breaks():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        play(tmp_path, on_chunk=after(1, breaks))
    assert len(rows_of(tmp_path)) == 2
    (tmp_path / "checkpoints" / "25.new" / "agent").mkdir(parents=True)
    (tmp_path / "evaluations.npz").write_bytes(b"half")
    assert_same_run(play(tmp_path, resume=True, quiet=False), whole)
    assert "there is no checkpoint yet, so the run starts over" in capsys.readouterr().out
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"100", "150"}


def test_a_run_goes_on_from_the_checkpoint_before_a_damaged_one(play, whole, tmp_path):
    """To the same bytes; the damaged one is kept under another name."""
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    file = max((tmp_path / "checkpoints" / "150").rglob("d/*"), key=lambda path: path.stat().st_size)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with pytest.warns(Notice, match="150' is damaged: .* is used, of iteration 100"):
        assert_same_run(play(tmp_path, resume=True), whole)
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"100", "150", "150.damaged"}


def test_a_folder_that_holds_a_run_is_not_overwritten(play, whole):
    """By a new run that was not meant to go on with it."""
    before = rows_of(whole.directory)
    with pytest.raises(InputError, match="holds a run; resume it, or choose another folder"):
        play(whole.directory)
    assert rows_of(whole.directory) == before


@pytest.mark.slow
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EROFS])
def test_a_checkpoint_that_cannot_be_written_ends_the_run(play, whole, tmp_path, monkeypatch, number):
    """With reason and path. The one before stays, and the run goes on from there once there is room."""
    ask = checkpoint._shortage
    monkeypatch.setattr(
        checkpoint, "_shortage", lambda folder, size: number if folder.name == "100" else ask(folder, size)
    )
    with pytest.raises(OSError, match=re.escape(os.strerror(number))) as caught:
        play(tmp_path)
    assert caught.value.filename == str(tmp_path / "checkpoints" / "100")
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"50"}
    monkeypatch.undo()
    assert_same_run(play(tmp_path, resume=True), whole)


def test_a_checkpoint_that_fails_later_is_told_all_the_same(play, tmp_path, monkeypatch):
    """By the next chunk, or at the end: no run ends well whose last checkpoint is missing."""

    def breaks(written, *_):
        written.wait()  # else it goes on beside the tests that follow, which forbid large files
        raise OSError(errno.EIO, "checkpoint not written", "somewhere")

    monkeypatch.setattr(checkpoint, "_finish", breaks)
    with pytest.raises(OSError, match="checkpoint not written"):
        play(tmp_path, steps=100)


def test_every_chunk_asks_first_whether_the_last_checkpoint_was_written(play, tmp_path, monkeypatch):
    """A run whose checkpoints fail does not train on until the next one."""
    asked = []

    def lost(records):
        asked.append(len(rows_of(tmp_path)) if asked else 0)
        if len(asked) == 4:
            raise OSError(errno.EIO, "checkpoint not written", "somewhere")

    monkeypatch.setattr(Records, "check", lost)
    with pytest.raises(OSError, match="checkpoint not written"):
        play(tmp_path)
    assert asked == [0, 2, 4, 6] and len(rows_of(tmp_path)) == 6


@contextlib.contextmanager
def files_of_at_most(size):
    """Make the system refuse longer files, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_is_told_with_the_file(tmp_path):
    """The system leaves the name out."""
    with files_of_at_most(100), pytest.raises(OSError, match="File too large") as caught:
        log.append_rows(tmp_path / "metrics.csv", [{"x": "1" * 200}])
    assert caught.value.filename == str(tmp_path / "metrics.csv")


def test_a_full_disk_leaves_the_file_before(whole, tmp_path):
    """And no half of a new one."""
    file = shutil.copy(whole.directory / "evaluations.npz", tmp_path / "evaluations.npz")
    with files_of_at_most(100), pytest.raises(OSError, match="File too large") as caught:
        save_evaluations(file, whole.evaluations)
    assert caught.value.filename == str(file) and list(tmp_path.iterdir()) == [file]
    assert_same_evaluations(load_evaluations(file), whole.evaluations)


@pytest.mark.slow
def test_lost_evaluations_are_told(play, tmp_path):
    """The run goes on without those before, from the first one on."""
    play(tmp_path, steps=200)
    (tmp_path / "evaluations.npz").unlink()
    with pytest.warns(Notice, match=r"evaluations.npz' is missing; the run goes on"):
        assert play(tmp_path, resume=True).evaluations.steps.tolist() == [400, 600]


def test_damaged_evaluations_do_not_stop_a_resumed_run(play, whole, tmp_path):
    """It goes on without them, says so, and keeps the file."""
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "checkpoints" / "150")
    (tmp_path / "evaluations.npz").write_bytes(b"half")
    with pytest.warns(Notice, match=r"evaluations\.npz', which is damaged: .*; the run goes on without .* kept as"):
        assert play(tmp_path, resume=True).evaluations.steps.tolist() == [600]
    assert (tmp_path / "evaluations.damaged.npz").read_bytes() == b"half"
    assert load_evaluations(tmp_path / "evaluations.npz").steps.tolist() == [600]


def test_damaged_evaluations_of_a_finished_run_are_made_again(play, whole, tmp_path):
    """From its last state."""
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    (tmp_path / "evaluations.npz").write_bytes(b"half")
    with pytest.warns(Notice, match="the run goes on without its earlier evaluations"):
        found = play(tmp_path, resume=True).evaluations
    assert found.steps.tolist() == load_evaluations(tmp_path / "evaluations.npz").steps.tolist() == [600]
    assert np.isfinite(found.returns["train"]).all()


def test_damaged_metrics_do_not_stop_a_resumed_run(play, whole, tmp_path):
    """It goes on with the lines that can be read, under the columns that it writes."""
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "checkpoints" / "150")
    content = (tmp_path / "metrics.csv").read_bytes().replace(b"actor_loss", b"actor_lo\xf3s", 1)
    lines = [*content.splitlines(keepends=True), b"0,75,300,0.5\n", b"0,nonsense,1\n"]
    lines[3] = lines[3].replace(b",", b',"', 1)
    (tmp_path / "metrics.csv").write_bytes(b"".join(lines))
    with pytest.warns(Notice, match=r"metrics\.csv' is damaged: 7 rows up to step 100 are left"):
        play(tmp_path, resume=True)
    rows = rows_of(whole.directory)
    assert rows_of(tmp_path) == rows[:2] + rows[3:]


def another_file(folder, **changed):
    """Change arrays of a run's evaluations; a function of the old one gives the new one."""
    with np.load(folder / "evaluations.npz") as file:
        arrays = {name: changed.get(name, lambda x: x)(file[name]) for name in file}
    np.savez(folder / "evaluations.npz", **arrays)


OTHER_RUNS = [
    (dict.fromkeys([*SPLITS, "seeds"], lambda x: x[:1]), "it has 1 seeds, not 2"),
    ({"seeds": lambda x: x + 1}, "it has other seeds"),
    (dict.fromkeys(SPLITS, lambda x: x.repeat(2, -1)), "it has 2 episodes of a task, not 1"),
    ({"interpolation_values": lambda x: x + 0.001}, "it has other interpolation tasks"),
    ({name: lambda x: np.repeat(x, 2, x.ndim // 2) for name in ("train", "train_values")}, "it has other train tasks"),
]


@pytest.mark.parametrize(("changed", "said"), OTHER_RUNS)
def test_evaluations_of_another_run_are_refused(finished_run, copied_run, changed, said):
    """As they would be joined with this run's, and drawn under its name."""
    another_file(copied_run, **changed)
    config = from_json(finished_run / "config.json")
    evaluations_of(config, finished_run)
    with pytest.raises(InputError, match=f"is of another run than config.json beside it: {said}$"):
        evaluations_of(config, copied_run)
    with pytest.raises(InputError, match=said):
        read_runs.read(copied_run)


def test_evaluations_of_another_run_are_not_gone_on_with(play, whole, tmp_path):
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    another_file(tmp_path, seeds=lambda x: x + 1)
    with pytest.raises(InputError, match="it has other seeds; move it away to go on"):
        play(tmp_path, resume=True)


def test_evaluations_without_their_seeds_are_those_of_earlier_versions(finished_run, copied_run):
    another_file(copied_run, seeds=lambda x: x[:0])
    config = from_json(finished_run / "config.json")
    old, new = evaluations_of(config, copied_run), evaluations_of(config, finished_run)
    assert_same_evaluations(old._replace(seeds=np.arange(2)), new)


def test_evaluations_after_the_checkpoint_are_dropped(play, whole, tmp_path):
    """A run that died between an evaluation and its checkpoint evaluates again, under the same number."""
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "checkpoints" / "150")
    assert_same_run(play(tmp_path, resume=True), whole)


@pytest.mark.slow
def test_finished_run_can_be_extended(play, whole, tmp_path):
    """More steps go on as if they had been asked for at once."""
    assert play(tmp_path, steps=400).finished
    assert_same_run(play(tmp_path, resume=True), whole)


def test_the_clock_counts_without_going_through_the_chunks():
    """As many chunks, evaluations and chunks with random actions as one by one; at once if there are billions."""
    random = np.random.default_rng(0)
    for _ in range(300):
        chunk, count, begun, every, warmup = (int(random.integers(1, most)) for most in (40, 30, 30, 300, 200))
        total = chunk * count
        plan = Plan(steps=int(random.integers(total - chunk + 1, total + 1)), eval_every=every)
        config = types.SimpleNamespace(steps_per_chunk=chunk, warmup=warmup, plan=plan)
        one = types.SimpleNamespace(config=config, console=types.SimpleNamespace(total=total))
        steps = chunk * min(begun - 1, count)
        ends = range(steps + chunk, total + chunk, chunk)
        clock, due = Journal._clock(one, steps), [run.is_due(config, end) for end in ends]
        expected = len(ends), sum(due), sum(end - chunk < warmup for end in ends)
        assert (clock.chunks, clock.evaluations, clock.warmup) == expected
    one.console.total = 10**15 * chunk
    assert Journal._clock(one, 0).chunks == 10**15


@pytest.mark.slow
def test_both_clocks_go_on(play, tmp_path):
    """Though another process resumes the run."""
    play(tmp_path, steps=400)
    file = tmp_path / "metrics.csv"
    with file.open(newline="") as opened:
        rows = [{**row, "seconds": "1000.0", "wall_seconds": "2000.0"} for row in csv.DictReader(opened)]
    file.unlink()
    log.append_rows(file, rows)
    result = play(tmp_path, resume=True)
    last = result.rows[-1]
    assert 1000 < float(last["seconds"]) < 1500 and 2000 < float(last["wall_seconds"]) < 2500
    assert result.trained_seconds == pytest.approx(result.seconds - 1000)  # those of this process


def test_finished_run_has_nothing_to_resume(play, whole, tmp_path, capsys, monkeypatch):
    """Resuming it changes nothing and compiles nothing, and a line says what would go on."""
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    monkeypatch.setattr(run, "compile_lowered", None)
    result = play(tmp_path, resume=True, quiet=False)
    out = capsys.readouterr().out
    assert "the run has made all its" in out and "compil" not in out
    assert result.finished and not result.rows and result.seconds == pytest.approx(whole.seconds, abs=1e-3)
    assert_same_run(result, whole)


@pytest.mark.parametrize("torn", ["0,", "0,1", "0,75,300,0.5", "0,nonsense"])
def test_torn_metrics_do_not_stop_a_resumed_run(play, whole, tmp_path, torn):
    """What a killed process left of its last line is no row. It has no end."""
    shutil.copytree(whole.directory, tmp_path, dirs_exist_ok=True)
    shutil.rmtree(tmp_path / "checkpoints" / "150")
    with (tmp_path / "metrics.csv").open("a") as file:
        file.write(torn)
    assert_same_run(play(tmp_path, resume=True), whole)


def test_second_interrupt_is_pythons_own():
    """Who insists gets out; the handlers from before come back all the same."""
    before, told = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)], []
    with pytest.raises(KeyboardInterrupt), stop_signals(told.append) as received:
        os.kill(os.getpid(), signal.SIGINT)
        assert received == [signal.SIGINT] and told == ["ends after this chunk"]
        os.kill(os.getpid(), signal.SIGINT)
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before


def test_signals_are_left_alone_outside_the_main_thread():
    """Training in a thread works, without the clean stop."""
    seen = []

    def work():
        with stop_signals() as received:
            seen.append((received, signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [([], signal.getsignal(signal.SIGINT))]


# Numbers that are not finite.


@pytest.mark.slow
def test_lost_worlds_are_told(play, monkeypatch, capsys):
    """On the console by their tasks, and by their number in the metrics of their seed."""
    chunk = run._Run._play

    def lose(self, *given):
        now, metrics = chunk(self, *given)
        return now, metrics | {"lost": np.array([[0, 2], [0, 1]])}

    monkeypatch.setattr(run._Run, "_play", lose)
    result = play(steps=50, quiet=False)
    assert "3 worlds (task 1) blew up; new episodes began there\n" in capsys.readouterr().out
    assert [row["lost"] for row in result.rows] == ["2", "1"]


def lost_world(state):
    """An observation of seed 1, task 1 that is not a number."""
    worlds = state.worlds._replace(obs=state.worlds.obs.at[1, 1, 0, 3].set(jnp.nan))
    return state._replace(worlds=worlds)


def diverged_critic(state):
    """Values in seed 1 whose square is beyond 32 bits; every task meets them at once."""
    far = lambda name: jax.tree.map(lambda x: x.at[1].multiply(1e10), state.agent.nets[name])
    agent = with_nets(state.agent, critic=far("critic"), representation=far("representation"))
    return state._replace(agent=agent)


@pytest.mark.parametrize("poison, task", [(lost_world, 1), (diverged_critic, 0)])
def test_not_finite_numbers_stop_the_run_and_spare_the_checkpoint(play, whole, tmp_path, monkeypatch, poison, task):
    """The message names step, task and seed; no row or checkpoint is written of the chunk."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings into the working directory
    directory = tmp_path / "run"
    shutil.copytree(whole.directory, directory)
    load, before = checkpoint.load, rows_of(directory)
    monkeypatch.setattr(checkpoint, "load", lambda *arguments: poison(load(*arguments)))
    told = rf"finite at step 150 of task {task} \(number 1 of the run's seeds\); the last checkpoint is '.*/150'"
    with pytest.raises(FloatingPointError, match=told):
        play(directory, resume=True, steps=800)
    assert rows_of(directory) == before
    monkeypatch.undo()
    assert bytes_of(checkpoint.load(directory / "checkpoints", whole.state)) == bytes_of(whole.state)


def test_spoiled_parameters_are_not_saved(play, tmp_path, monkeypatch):
    """Those of a chunk's last update, which none of its losses has seen."""
    lose = lambda net: jax.tree.map(lambda x: x.at[1].set(jnp.nan), net)
    spoil = lambda agent: with_nets(agent, actor=lose(agent.nets["actor"]))
    check, times = entries.finite_seeds, itertools.count(1)
    monkeypatch.setattr(entries, "finite_seeds", lambda agent: check(spoil(agent) if next(times) == 2 else agent))
    with pytest.raises(FloatingPointError, match=r"before step 100 \(number 1 .*; the last checkpoint is '.*/50'"):
        play(tmp_path)
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"50"}


def test_before_the_first_checkpoint_there_is_none_to_name(tmp_path):
    """The message says so."""
    with pytest.raises(FloatingPointError, match=r"step 12 of task 0 .*; there is no checkpoint from before it"):
        require_finite(np.array([[2, -1]]), np.full((1, 2), -1), np.zeros((1, 2)), 10, Records(tmp_path).last)


@pytest.mark.parametrize(
    "reward, lost, hint",
    [
        (-1, 1, r"\. Try lower learning rates or max-gradient-norm$"),
        (-1, 1200, r"\. 1,200 worlds of the task blew up in these steps\. Try milder values of what varies, "),
        (5, 1200, r"\. Mend what the environment computes"),
    ],
)
def test_a_run_of_worlds_that_blow_up_says_so(reward, lost, hint):
    """One world may blow up by itself, and a reward that is not finite comes first."""
    with pytest.raises(FloatingPointError, match=f"finite at step 15 of task 1 .*{hint}"):
        require_finite(np.array([[-1, 5]]), np.array([[-1, reward]]), np.array([[0, lost]]), 10, lambda: "none")


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_run_exits_with_the_signal(short_family, tmp_path, monkeypatch, capsys, number, code):
    """After saving, so that no script takes it for finished."""
    monkeypatch.setattr(sys, "argv", ["train", *SHORT_RUN, f"--runs={tmp_path}"])
    metrics, pid = log.metric_rows, os.getpid()
    monkeypatch.setattr(log, "metric_rows", lambda *given: (os.kill(pid, number), metrics(*given))[1])
    with pytest.raises(SystemExit) as stop:
        process.main(mtjax.train.main)
    (directory,) = tmp_path.iterdir()
    assert stop.value.code == code and f"--resume={directory}" in capsys.readouterr().out
    assert {path.name for path in directory.iterdir()} == {"config.json", "metrics.csv", "checkpoints"}
    assert [path.name for path in (directory / "checkpoints").iterdir()] == ["25"]


def test_a_run_writes_its_record_again(short_family, tmp_path, monkeypatch):
    """If somebody removes config.json while it runs; without its folder it ends with the reason."""
    metrics, gone = log.metric_rows, []

    def remove(*given):
        (directory,) = tmp_path.iterdir()
        shutil.rmtree(directory) if gone else (directory / "config.json").unlink()
        gone.append(directory)
        return metrics(*given)

    monkeypatch.setattr(log, "metric_rows", remove)
    with (
        pytest.warns(Notice, match=r"config\.json' was removed while the run went on, and is written again"),
        pytest.raises(OSError, match=r"folder was removed while it ran|No such file"),
    ):
        mtjax.train.main([*SHORT_RUN, f"--runs={tmp_path}"])


def test_a_stopped_run_draws_the_curve_so_far(short_family, tmp_path, monkeypatch):
    """If there was an evaluation."""
    monkeypatch.setattr(sys, "argv", ["train", *SHORT_RUN, "--eval-every=100", f"--runs={tmp_path}"])
    metrics, pid = log.metric_rows, os.getpid()
    monkeypatch.setattr(log, "metric_rows", lambda *given: (os.kill(pid, signal.SIGINT), metrics(*given))[1])
    with pytest.raises(SystemExit):
        process.main(mtjax.train.main)
    (directory,) = tmp_path.iterdir()
    assert (directory / "evaluations.npz").exists() and (directory / "curve.png").exists()


# Arguments.


@pytest.mark.parametrize("field", ["steps", "seeds", "seed", "eval_every", "eval_episodes"])
def test_plan_refuses_numbers_that_mean_nothing(field):
    """The message names the flag."""
    with pytest.raises(InputError, match=f"{field.replace('_', '-')} must be at least"):
        Plan(**{field: -1})


def test_chunks_are_no_longer_than_the_run():
    """Whole iterations, at least as many as the steps need."""
    assert fit_chunk(Settings(num_envs=2, chunk_steps=1000), 3, 601).chunk_steps == 101
    assert fit_chunk(Settings(num_envs=2, chunk_steps=10), 3, 601).chunk_steps == 6  # 102 iterations, not 110
    assert fit_chunk(Settings(num_envs=2, chunk_steps=60), 3, 601, grain=32).chunk_steps == 64
    assert fit_chunk(Settings(num_envs=16, chunk_steps=62), 10, 100_000).chunk_steps == 25  # 625 in 25 chunks
    assert fit_chunk(Settings(num_envs=2048, chunk_steps=512), 1, 10**7, grain=32).chunk_steps == 9 * 32  # 153 of 32
    assert fit_chunk(Settings(num_envs=2, chunk_steps=10**9), 3, 10**15).chunk_steps > 10**8  # at once


def test_a_run_is_hardly_longer_than_its_steps():
    """By less than an iteration of all worlds and 2%; chunks are at most 50, or four times as many as are needed."""
    random = np.random.default_rng(0)
    for _ in range(1000):
        tasks, envs, chunk, grain = (int(random.integers(1, most)) for most in (20, 100, 2000, 40))
        steps = int(10 ** random.uniform(0, 9))
        length = fit_chunk(Settings(num_envs=envs, chunk_steps=chunk), tasks, steps, grain).chunk_steps
        worlds, count = tasks * envs, math.ceil(steps / (length * tasks * envs))
        assert length % grain == 0 and length < chunk + grain
        assert count * length * worlds < 1.02 * steps + grain * worlds
        assert count <= max(50, 4 * math.ceil(math.ceil(steps / (worlds * grain)) / math.ceil(chunk / grain)))


@pytest.mark.parametrize("plan, every", [(Plan(5), 1), (Plan(101), 11), (Plan(100), 10), (Plan(100, eval_every=7), 7)])
def test_there_are_ten_evaluations_unless_told(plan, every):
    """No more, whatever the number of steps."""
    assert plan.interval == every


@pytest.mark.slow
def test_steps_are_rounded_up_to_whole_chunks(play):
    """A run never falls short of what was asked, and its chunks are equal and no longer than they need be."""
    assert [row["steps"] for row in play(None, steps=101).rows] == [52, 52, 104, 104]


def test_full_disk_is_met_before_training(play, tmp_path, monkeypatch):
    """The check comes before compiling, and says what would help."""
    monkeypatch.setattr("shutil.disk_usage", lambda _: types.SimpleNamespace(free=1000))
    with pytest.raises(
        InputError, match=r"checkpoints need [\d.]+ MB .* has 0.0 MB free; lower --replay-size or .* with --runs$"
    ):
        play(tmp_path)
    assert not list(tmp_path.iterdir())


class Harm:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (pathlib.Path.touch, (self.path,))


def damaged_evaluations(name, whole, harm):
    """The content of a damaged evaluations.npz."""
    file = io.BytesIO()
    arrays = dict(np.load(io.BytesIO(whole)))
    match name:
        case "empty" | "junk" | "zeroed":
            return {"empty": b"", "junk": b"PK not a zip file", "zeroed": bytes(len(whole))}[name]
        case "truncated":
            return whole[: len(whole) // 2]
        case "flipped":
            place = whole.index(arrays["train"].tobytes())
            return whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]
        case "one array":
            np.save(file, arrays["train"])
        case "pickle":
            pickle.dump(Harm(harm), file)
        case "objects":
            np.savez(file, **{**arrays, "train": np.array([Harm(harm)], object)}, allow_pickle=True)
        case "text":
            np.savez(file, **{**arrays, "steps": np.array(["a"])})
        case "other shapes":
            np.savez(file, **{**arrays, "train": arrays["train"][:, :1]})
        case "other seeds":
            np.savez(file, **{**arrays, "train": arrays["train"][:1]})
        case "other metrics":
            np.savez(file, **arrays, **{f"{split}_success": arrays[split][:, :1] for split in SPLITS})
        case "no steps":
            np.savez(file, **{k: x for k, x in arrays.items() if k != "steps"})
    return file.getvalue()


@pytest.mark.parametrize(
    "name",
    [
        *"empty junk zeroed truncated flipped pickle objects text".split(),
        *("one array", "other shapes", "other seeds", "other metrics", "no steps"),
    ],
)
def test_damaged_evaluations_are_an_input_error(whole, tmp_path, name):
    """One line that names the file; no code in it runs, and nobody advises to let it."""
    content = damaged_evaluations(name, (whole.directory / "evaluations.npz").read_bytes(), tmp_path / "harm")
    (tmp_path / "evaluations.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"cannot read evaluations from .*evaluations\.npz") as caught:
        load_evaluations(tmp_path / "evaluations.npz")
    assert "\n" not in str(caught.value) and "allow_pickle" not in str(caught.value)
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize("place, folder", [("0", None), ("/some/where", "/some/where")])
def test_compile_cache_follows_the_environment(monkeypatch, place, folder):
    """MTJAX_CACHE names the folder, and 0 keeps none."""
    updates = {}
    monkeypatch.setattr(jax.config, "update", updates.__setitem__)
    monkeypatch.setattr(trace_cache, "_folder", [])
    monkeypatch.setenv("MTJAX_CACHE", place)
    enable_compile_cache()
    assert updates.get("jax_compilation_cache_dir") == folder
    assert trace_cache._folder == ([pathlib.Path(folder, "traced")] if folder else [])
