"""One process at a time writes into a run's folder."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import mtjax
from mtjax import commands
from mtjax.names import Notice
from mtjax.train import main
from mtjax.training import lock
from mtjax.types import InputError

HOLDER = """
import sys, time
from pathlib import Path
from mtjax.training import lock
with lock.hold(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def other(tmp_path):
    """A process that holds the lock of the folder."""
    root = str(Path(mtjax.__file__).parents[1])
    command = [sys.executable, "-c", HOLDER, str(tmp_path)]
    with subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": root}, stdout=subprocess.PIPE, text=True
    ) as process:
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


@pytest.mark.parametrize("words", [[], ["--steps=900"]])
def test_a_run_in_use_is_not_resumed(copied_run, capsys, monkeypatch, words):
    """One line, and nothing in the folder changes."""
    contents = lambda: {path: path.read_bytes() for path in copied_run.rglob("*") if path.is_file()}
    monkeypatch.setattr("sys.argv", ["train", f"--resume={copied_run}", *words])
    with lock.hold(copied_run):
        before = contents()
        with pytest.raises(SystemExit) as stop:
            commands.main(main)
        said = capsys.readouterr()
        assert contents() == before
    assert stop.value.code == 2 and said.err.startswith("error: ") and said.err.count("\n") == 1
    assert f"process {os.getpid()}" in said.err


def test_a_sweep_in_use_is_not_resumed(tmp_path, finished_run):
    """Nor one whose runs are each free."""
    (tmp_path / "run-1").symlink_to(finished_run)
    with lock.hold(tmp_path), pytest.raises(InputError, match="is in use"):
        main([f"--resume={tmp_path}"])
