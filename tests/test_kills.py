"""Real processes that are killed, stopped and started twice: the run that comes out is the one that nothing stopped."""

import csv
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mtjax
from mtjax.learning.evaluation import load_evaluations
from mtjax.saved import checkpoint
from mtjax.saved.config_json import from_json
from mtjax.saved.policy import state_shapes

RUN = (
    "--env=bandit --env.scores --agent=sac-conditioned --seeds=2 --num-envs=2 --batch-size=4 --replay-size=200 "
    "--warmup-steps=5 --chunk-steps=25 --eval-every=500 --eval-episodes=1 --agent.hidden 8 8"
).split()
SAVE = 500  # environment steps between two checkpoints
LONGEST = 8.0  # seconds until a process is killed, of which it takes about half to begin


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """Start a training process; its output is in a file."""
    cache, out = tmp_path_factory.mktemp("cache"), tmp_path_factory.mktemp("out") / "out"
    root = str(Path(mtjax.__file__).parents[1])
    environment = {**os.environ, "PYTHONPATH": root, "JAX_PLATFORMS": "cpu", "MTJAX_CACHE": str(cache)}

    def start(*words, out=out):
        with out.open("w") as file:
            command = [sys.executable, "-m", "mtjax.train", *words]
            return subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT), out

    return start


def finish(process, out):
    code = process.wait(600)
    assert code == 0, out.read_text()[-3000:]


def outcome(folder):
    """All that a run leaves but clocks: rows, evaluations, and every byte of its state."""
    with (folder / "metrics.csv").open(newline="") as file:
        rows = [{k: v for k, v in row.items() if not k.endswith("seconds")} for row in csv.DictReader(file)]
    evaluations = load_evaluations(folder / "evaluations.npz")
    state = checkpoint.load(folder / "checkpoints", state_shapes(from_json(folder / "config.json")))
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    leaves = [np.asarray(plain(x)).tobytes() for x in jax.tree.leaves(state)]
    return rows, [np.asarray(x).tobytes() for x in jax.tree.leaves(evaluations)], leaves


def interrupted(start, root, steps, rounds, number):
    """Start a run, send its process a signal at random moments, each time resume it, and let the last one finish."""
    codes, chance = [], random.Random(number * rounds)
    words = [*RUN, f"--steps={steps}", f"--runs={root}"]
    for _ in range(rounds):
        process, out = start(*words)
        time.sleep(chance.uniform(0, LONGEST))
        process.send_signal(number)
        codes.append(process.wait(120))
        if codes[-1] == 128 + number:
            assert "the state is saved. Go on with:" in out.read_text()
        for record in root.glob("bandit-*/config.json"):  # at most one; a folder without it was left half-made
            words = [f"--resume={record.parent}"]
    finish(*start(*words))
    (record,) = root.glob("bandit-*/config.json")
    return record.parent, codes


@pytest.mark.parametrize(
    "number, rounds, steps",
    [
        pytest.param(signal.SIGKILL, 3, 15 * SAVE, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 3, 15 * SAVE, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, 20, 120 * SAVE, marks=pytest.mark.nightly),
        pytest.param(signal.SIGTERM, 20, 120 * SAVE, marks=pytest.mark.nightly),
    ],
)
def test_a_run_that_is_ended_at_random_moments_ends_as_any_other(start, tmp_path, number, rounds, steps):
    """To the byte. A process that a signal stops says so by its exit code, whatever it was about."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    finish(*start(*RUN, f"--steps={steps}", f"--runs={whole}"))
    folder, codes = interrupted(start, broken, steps, rounds, number)
    allowed = {-number} if number == signal.SIGKILL else {-number, 128 + number}  # the first before there is a state
    assert set(codes) <= allowed | {0}, codes
    (unbroken,) = whole.iterdir()
    assert outcome(folder) == outcome(unbroken)
    assert {path.name for path in folder.iterdir()} == {path.name for path in unbroken.iterdir()}
    names = lambda run: {path.name for path in (run / "checkpoints").iterdir()}
    assert names(folder) == names(unbroken)


@pytest.mark.slow
def test_a_second_process_on_a_folder_is_refused(start, tmp_path):
    """In a line, at once; the first goes on undisturbed."""
    first, out = start(*RUN, f"--steps={100_000 * SAVE}", f"--runs={tmp_path}")
    try:
        until = time.monotonic() + 300
        while not list(tmp_path.glob("*/checkpoints/*00")):
            assert time.monotonic() < until and first.poll() is None, out.read_text()
            time.sleep(0.2)
        (folder,) = tmp_path.iterdir()
        second, other = start(f"--resume={folder}", out=tmp_path / "second")
        assert second.wait(120) == 2
        assert other.read_text().count("\n") == 1 and f"in use: process {first.pid} on " in other.read_text()
        assert first.poll() is None
        first.send_signal(signal.SIGINT)
        assert first.wait(120) == 130
    finally:
        first.kill()
