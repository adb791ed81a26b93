"""One process at a time writes into a run's folder."""

import errno
import fcntl
import os
import re
import signal
import subprocess
import sys

import pytest
from own_process import environment

from mtjax.command import process
from mtjax.names import Notice, replacing
from mtjax.saved import lock
from mtjax.train import main
from mtjax.types import InputError

HOLDER = """
import sys, time
from pathlib import Path
from mtjax.saved import lock
with lock.hold(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def other(tmp_path):
    """A process that holds the lock of the folder."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(command, env=environment(), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
        process.kill()


def test_a_second_process_is_refused_until_the_first_is_gone(tmp_path, other):
    """Even if it was killed, and never had a chance to clean up."""
    with pytest.raises(InputError, match=rf"is in use: process {other.pid} on .* writes there") as caught:
        with lock.hold(tmp_path):
            pytest.fail("it holds the lock")
    assert "\n" not in str(caught.value)
    other.send_signal(signal.SIGKILL)
    other.wait()
    with lock.hold(tmp_path):
        assert (tmp_path / "lock").read_text().startswith(f"process {os.getpid()} on ")
    assert not list(tmp_path.iterdir())


def test_two_in_one_process_exclude_each_other(tmp_path):
    """As two notebooks' kernels do; afterwards the lock is free, also after an error."""
    with pytest.raises(ZeroDivisionError), lock.hold(tmp_path):
        with pytest.raises(InputError, match="is in use"), lock.hold(tmp_path):
            pytest.fail("it holds the lock")
        raise ZeroDivisionError
    with lock.hold(tmp_path):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_file_system_without_locks_is_told(tmp_path, monkeypatch, number):
    """And the run goes on."""

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.warns(Notice, match="cannot be locked .*; take care that no other process writes there"):
        with lock.hold(tmp_path):
            pass


@pytest.mark.parametrize("words", [pytest.param([], marks=pytest.mark.slow), ["--steps=900"]])
def test_a_run_in_use_is_not_resumed(copied_run, capsys, monkeypatch, words):
    """One line, and nothing in the folder changes."""
    contents = lambda: {path: path.read_bytes() for path in copied_run.rglob("*") if path.is_file()}
    monkeypatch.setattr("sys.argv", ["train", f"--resume={copied_run}", *words])
    with lock.hold(copied_run):
        before = contents()
        with pytest.raises(SystemExit) as stop:
            process.main(main)
        said = capsys.readouterr()
        assert contents() == before
    assert stop.value.code == 2 and said.err.startswith("error: ") and said.err.count("\n") == 1
    assert f"process {os.getpid()}" in said.err


def test_a_sweep_in_use_is_not_resumed(tmp_path, copied_run):
    """Nor one whose runs are each free."""
    copied_run.rename(tmp_path / "run-1")
    with lock.hold(tmp_path), pytest.raises(InputError, match="is in use"):
        main([f"--resume={tmp_path}"])


@pytest.mark.parametrize(
    "name",
    [
        *("lock", "config.json", "config.json.new", "metrics.csv", "metrics.damaged.csv", "evaluations.npz.new"),
        *("curve.png", "checkpoints", "checkpoints/200.new", "store/9.npz", "tensorboard", "sweep.csv", "run-1"),
    ],
)
@pytest.mark.parametrize("target", ["file", "nothing"])
def test_nothing_is_written_through_a_link(tmp_path, name, target):
    """A folder from elsewhere could name any file of the user."""
    (tmp_path / "file").write_text("mine")
    link = tmp_path / "run" / name
    link.parent.mkdir(parents=True)
    link.symlink_to(tmp_path / target)
    with pytest.raises(InputError, match=re.escape(f"{str(link)!r} is a link")), lock.hold(tmp_path / "run"):
        pass
    assert (tmp_path / "file").read_text() == "mine" and not (tmp_path / "nothing").exists()


def test_other_links_are_left_alone(tmp_path):
    """A run's folder may be one, and users put their own beside its files."""
    (tmp_path / "run" / "wandb").mkdir(parents=True)
    (tmp_path / "run" / "wandb" / "latest-run").symlink_to(tmp_path)
    (tmp_path / "run" / "notes").symlink_to(tmp_path)
    (tmp_path / "latest").symlink_to(tmp_path / "run")
    with lock.hold(tmp_path / "latest"):
        assert (tmp_path / "run" / "lock").exists()


def test_a_file_is_not_replaced_through_a_link(tmp_path):
    """Neither one at its place nor one where it is written first."""
    (tmp_path / "mine").write_text("mine")
    for name in ("a", "a.new"):
        (tmp_path / name).symlink_to(tmp_path / "mine")
    with replacing(tmp_path / "a") as new:
        new.write_text("new")
    assert (tmp_path / "a").read_text() == "new" and (tmp_path / "mine").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "mine"]
