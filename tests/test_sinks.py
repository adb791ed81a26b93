"""Metrics for TensorBoard, Weights & Biases and trackio, beside metrics.csv."""

import json
import os
import re
import subprocess
import sys
import types

import pytest
from needs import needs

import mtjax
from mtjax.training import sinks
from mtjax.types import InputError

SMALL = {"num_envs": 2, "chunk_steps": 25, "batch_size": 4, "replay_size": 200, "warmup_steps": 5, "hidden": (8, 8)}
PLAN = {"steps": 200, "seeds": 2, "eval_every": 100, "eval_episodes": 1}
ASKED = [("tensorboardX", {"tensorboard": True}), ("wandb", {"wandb": "project"}), ("trackio", {"trackio": "project"})]


class Recorder:
    """Stands for all three libraries, and keeps what it is given."""

    def __init__(self):
        self.opened, self.written, self.closed = [], [], 0
        recorder = self

        class Writer:
            def __init__(self, *place, **given):
                self.place = given.get("name") or place[min(1, len(place) - 1)].rsplit("/", 1)[-1]
                recorder.opened.append((self.place, given))

            def add_scalar(self, name, value, step):
                recorder.written.append((self.place, step, name, value))

            def log(self, values, step):
                recorder.written.extend((self.place, step, name, value) for name, value in values.items())

            def flush(self):
                pass

            def close(self):
                recorder.closed += 1

            finish = close

        self.module = types.SimpleNamespace(SummaryWriter=Writer, init=Writer, Settings=lambda **given: given)


@pytest.mark.slow
@pytest.mark.parametrize("library, given", ASKED)
def test_every_number_is_logged_at_its_step(library, given, short_family, tmp_path, monkeypatch):
    """A run for each seed, with the rows of metrics.csv and the evaluations by split."""
    recorder = Recorder()
    monkeypatch.setitem(sys.modules, library, recorder.module)
    folder = tmp_path / "run"
    result = mtjax.train("finger-short", "sac-conditioned", directory=folder, **PLAN, **SMALL, **given)
    prefix = "" if library == "tensorboardX" else "run-"
    assert [place for place, _ in recorder.opened] == [f"{prefix}seed-0", f"{prefix}seed-1"] and recorder.closed == 2
    told = {(place, step, name): value for place, step, name, value in recorder.written}
    for row in result.rows:
        value = told[f"{prefix}seed-{row['seed']}", row["steps"], "td_error"]
        assert value == float(row["td_error"])
    assert {name for place, _, name in told if place.endswith("seed-1")} >= {"return", "episodes", "evaluation/train"}
    scores = [told[f"{prefix}seed-1", step, "evaluation/train"] for step in (100, 200)]
    assert scores == pytest.approx(result.evaluations.returns["train"][1].mean(axis=(1, 2)), rel=1e-5)


@needs("tensorboardX")
def test_tensorboard_writes_files_that_its_reader_reads(tmp_path):
    """By the real library."""
    found = sinks.open_sinks(tmp_path, True, "", "", 0, {})
    row = {"seed": 0, "steps": 5, "return": "2.5", "loss": "", "td_error_0": "1", "td_error_12": "2"}
    sinks.write_rows(found, [row], ["seed-0"])
    found[0].close()
    (file,) = (tmp_path / "tensorboard" / "seed-0").iterdir()
    assert b"return" in file.read_bytes() and b"loss" not in file.read_bytes()
    assert {*re.findall(rb"td_error\w*/\d+", file.read_bytes())} == {b"td_error_by_task/0", b"td_error_by_task/12"}


@pytest.mark.slow
@needs("wandb")
def test_wandb_logs_offline(tmp_path, monkeypatch):
    """By the real library, without a network."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    found = sinks.open_sinks(tmp_path, False, "project", "", 0, {"steps": 5})
    rows = [{"seed": seed, "steps": 5, "return": "2.5"} for seed in range(2)]
    sinks.write_rows(found, rows, ["seed-0", "seed-1"])
    found[0].close()
    assert len(list((tmp_path / "wandb").glob("offline-run-*"))) == 2


@pytest.mark.slow
@needs("trackio")
def test_trackio_keeps_the_runs_of_two_seeds_and_of_a_resumed_one(tmp_path):
    """By the real library, in a process of its own, as it reads its folder once."""
    script = f"""
from pathlib import Path
from mtjax.training import sinks
for step in (5, 10):
    (found,) = sinks.open_sinks(Path({str(tmp_path / "run")!r}), False, "", "project", step - 5, {{"steps": 10}})
    rows = [{{"seed": seed, "steps": step, "return": str(seed + step)}} for seed in range(2)]
    sinks.write_rows([found], rows, ["seed-0", "seed-1"])
    found.close()
"""
    environment = os.environ | {"TRACKIO_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    for seed in range(2):
        words = ["trackio", "get", "metric", "--project=project", f"--run=run-seed-{seed}", "--metric=return", "--json"]
        found = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
        values = [(x["step"], x["value"]) for x in json.loads(found.stdout)["values"]]
        assert values == [(5, 5.0 + seed), (10, 10.0 + seed)]


@pytest.mark.parametrize("library, given", ASKED)
def test_a_missing_library_is_named_before_anything_compiles(library, given, short_family, tmp_path, monkeypatch):
    """With what to install."""
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError, match=f"pip install 'mtjax\\[{library.removesuffix('X')}\\]'"):
        mtjax.train("finger-short", "sac", directory=tmp_path / "run", **PLAN, **given)
    assert not list(tmp_path.iterdir())
