"""Real processes that are killed, stopped and started twice: the run that comes out is the one that nothing stopped."""

import csv
import random
import re
import signal
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_process import environment

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
    """Start a training process; its output is in a file. None outlives the tests of this module."""
    cache, out, begun = tmp_path_factory.mktemp("cache"), tmp_path_factory.mktemp("out") / "out", []
    alike = environment(JAX_PLATFORMS="cpu", MTJAX_CACHE=str(cache))

    def start(*words, out=out):
        with out.open("w") as file:
            command = [sys.executable, "-m", "mtjax.train", *words]
            begun.append(subprocess.Popen(command, env=alike, stdout=file, stderr=subprocess.STDOUT))
        return begun[-1], out

    yield start
    for process in begun:
        process.kill()
        process.wait()


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
        pytest.param(signal.SIGTERM, 3, 15 * SAVE, marks=pytest.mark.nightly),
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


# Worlds outside of JAX, which no checkpoint holds.

WORLD = '''
import time

import gymnasium
import numpy as np


class Slow(gymnasium.Env):
    """Counts its steps, each of half a millisecond."""

    observation_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def __init__(self, raises: int = 0):
        self.raises, self.made = raises, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.age = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        time.sleep(0.0005)
        self.age, self.made = self.age + 1, self.made + 1
        if self.made == self.raises:
            raise RuntimeError("the line is down")
        return np.float32([self.age / 20]), float(action), self.age >= 20, False, {}


gymnasium.register("Slow", Slow, max_episode_steps=30)
'''
CHUNK = 4 * 32  # steps of four worlds
HOSTED = "--env=gymnasium:Slow --agent=ppo --num-envs=4 --chunk-steps=32 --agent.unroll=16 --agent.hidden=8".split()


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A file with an environment of Gymnasium."""
    pytest.importorskip("gymnasium", reason="needs gymnasium")
    file = tmp_path_factory.mktemp("world") / "slow.py"
    file.write_text(WORLD)
    return file


def await_checkpoint(process, out, root):
    """Wait until a process has written a checkpoint."""
    whole = lambda: {path.name for path in root.glob("*/checkpoints/*") if path.name.isdecimal()}
    before, until = whole(), time.monotonic() + 300
    while not whole() - before:
        assert time.monotonic() < until and process.poll() is None, out.read_text()
        time.sleep(0.02)


def steps_in(text, pattern):
    """The number that a pattern finds in a text; 0 if it finds none."""
    found = re.search(pattern, text)
    return int(found[1].replace(",", "")) if found else 0


@pytest.mark.nightly
@pytest.mark.parametrize("kills", [2, 10])
def test_a_hosted_run_loses_at_most_a_chunk_each_time_it_is_killed(start, tmp_path, world, kills):
    """At random moments. It says how much, and its rows and evaluations are those of a whole run."""
    total, chance = 20 * kills * CHUNK, random.Random(kills)
    words = [f"--import={world}", *HOSTED, f"--steps={total}", "--eval-episodes=1", f"--runs={tmp_path}"]
    words.append(f"--eval-every={total // 10}")
    lost, begun = [], [0]
    for kill in range(kills + 1):
        process, out = start(*words)
        if kill < kills:
            await_checkpoint(process, out, tmp_path)
            time.sleep(chance.uniform(0, 0.8))
            process.kill()
            assert process.wait(120) == -signal.SIGKILL, out.read_text()
        else:
            finish(process, out)
        if kill:
            assert "worlds of gymnasium:Slow cannot be saved: new episodes begin" in out.read_text()
            begun.append(steps_in(out.read_text(), r"goes on at step ([\d,]+) of"))
            lost.append(steps_in(out.read_text(), r"the ([\d,]+) steps that were made after it are lost"))
        (record,) = tmp_path.glob("*/config.json")
        words = [f"--import={world}", f"--resume={record.parent}"]
    assert len(lost) == kills and max(lost) <= CHUNK and np.all(np.diff(begun) >= CHUNK)
    with (record.parent / "metrics.csv").open(newline="") as file:
        assert [int(row["steps"]) for row in csv.DictReader(file)] == list(range(CHUNK, total + 1, CHUNK))
    evaluations = load_evaluations(record.parent / "evaluations.npz")
    assert evaluations.steps.tolist() == [total // 10 * k for k in range(1, 11)]


@pytest.mark.slow
def test_a_hosted_run_whose_environment_raises_ends_with_its_checkpoint(start, tmp_path, world):
    """In a line that names the environment, its error, its place and the checkpoint, from which the run goes on."""
    words = [f"--import={world}", *HOSTED, f"--steps={200 * CHUNK}", f"--runs={tmp_path}"]
    process, out = start(*words, '--env.arguments={"raises": 100}', "--eval-every=2560", "--eval-episodes=1")
    assert process.wait(300) == 2
    told = out.read_text().splitlines()[-1]
    (last,) = tmp_path.glob("*/checkpoints/96")
    assert "Slow raised RuntimeError: the line is down" in told and "slow.py, line" in told and str(last) in told
    process, out = start(f"--import={world}", f"--resume={last.parents[1]}")
    assert process.wait(300) == 2 and "goes on at step 384 of" in out.read_text()


@pytest.mark.slow
def test_a_second_process_on_a_folder_is_refused(start, tmp_path):
    """In a line, at once; the first goes on undisturbed."""
    first, out = start(*RUN, f"--steps={100_000 * SAVE}", f"--runs={tmp_path}")
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
