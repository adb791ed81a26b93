"""Many devices and processes: how they are shared out, and that no result depends on them."""

import csv
import os
import signal
import socket
import subprocess
import sys
import time
import types
from pathlib import Path

import jax
import numpy as np
import pytest
from own_process import environment

import mtjax
import mtjax.train
from mtjax.compiling.programs import jit_programs, sharded_shapes
from mtjax.learning.evaluation import load_evaluations
from mtjax.parallel import hosts as processes
from mtjax.parallel import mesh as meshes
from mtjax.types import InputError

HERE = Path(__file__).parent
TINY_RUN = (
    "--env=pendulum-swingup --env.vary.mass=1,1.5 --split=none --engine=mjx --agent=sac-conditioned --seeds=2 "
    "--eval-every=80 --eval-episodes=1 --num-envs=2 --batch-size=4 --replay-size=40 --warmup-steps=4 "
    "--chunk-steps=10 --agent.hidden 8 8"
).split()


@pytest.fixture
def hosts(monkeypatch):
    """Make JAX see processes with so many devices each."""

    def see(*counts):
        found = [types.SimpleNamespace(process_index=i, number=n) for i, c in enumerate(counts) for n in range(c)]
        monkeypatch.setattr(jax, "process_count", lambda: len(counts))
        monkeypatch.setattr(jax, "devices", lambda: found)
        monkeypatch.setattr(jax, "device_count", lambda: len(found))
        monkeypatch.setattr(meshes, "Mesh", lambda x, _: types.SimpleNamespace(size=x.size, devices=x))

    return see


@pytest.mark.parametrize(
    "counts, seeds, used",
    [((4,), 4, 4), ((4,), 8, 4), ((4,), 6, 3), ((4,), 2, 2), ((8,), 10, 5), ((2, 2), 8, 4), ((4, 2), 6, 2)],
)
def test_most_devices_that_divide_the_seeds_are_used(hosts, counts, seeds, used):
    """Of every process as many, so that each has seeds of its own."""
    hosts(*counts)
    mesh = meshes.mesh_for(seeds, 10, 16)
    assert mesh.devices.shape == (used, 1)
    owners = [device.process_index for device in mesh.devices[:, 0]]
    assert owners == sorted(owners) and {owners.count(i) for i in range(len(counts))} == {used // len(counts)}
    assert meshes.mesh_for(seeds, 10, 16, most=1) is None or len(counts) > 1
    line = meshes.describe(mesh, seeds, 16)
    assert f"devices: {used} of {sum(counts)}" in line and "environments on each" not in line


@pytest.mark.parametrize(
    "counts, seeds, tasks, envs, shape",
    [
        ((4,), 1, 8, 1024, (1, 4)),  # 2048 worlds on each
        ((4,), 1, 8, 1023, (1, 3)),  # which four do not divide
        ((4,), 1, 8, 512, (1, 2)),  # four would have too few
        ((4,), 2, 4, 1024, (2, 2)),
        ((4,), 3, 8, 4096, (3, 1)),  # seeds first
        ((8,), 3, 8, 4096, (3, 2)),
        ((4,), 5, 2, 1000, (1, 4)),  # one device has a part of every seed
        ((4, 4), 2, 8, 1024, (2, 4)),
        ((3, 4), 2, 8, 1024, (2, 2)),
        ((2, 2), 4, 64, 4096, (4, 1)),
    ],
)
def test_devices_left_over_share_the_environments_of_a_seed(hosts, counts, seeds, tasks, envs, shape):
    """Evenly, of one process alone, and only as many as still have enough worlds."""
    hosts(*counts)
    mesh = meshes.mesh_for(seeds, tasks, envs)
    assert mesh.devices.shape == shape
    owners = [{device.process_index for device in group} for group in mesh.devices]
    assert owners == [{i} for i in range(len(counts)) for _ in range(shape[0] // len(counts))]
    assert len({(device.process_index, device.number) for device in mesh.devices.flat}) == shape[0] * shape[1]


@pytest.mark.parametrize(
    "counts, seeds, envs, line",
    [
        ((4,), 1, 1024, "devices: 4 of 4, 1 seed on every 4, 256 of each task's 1024 environments on each"),
        ((4, 4), 4, 1024, "8 of 8 in 2 processes, 1 seed on every 2, 512 of each task's 1024 environments on each"),
        ((4,), 6, 1024, "3 of 4, 2 seeds on each; the others would need more seeds or environments, or a number of"),
        ((4,), 1, 100, "1 of 4, 1 seed on each; the others would need more seeds or environments, or a number of"),
    ],
)
def test_the_line_says_who_has_what(hosts, counts, seeds, envs, line):
    """And, where devices are left, what they would need."""
    hosts(*counts)
    assert line in meshes.describe(meshes.mesh_for(seeds, 8, envs), seeds, envs)


@pytest.mark.parametrize("counts, seeds", [((1,), 1), ((1,), 10), ((4,), 1), ((2,), 5)])
def test_one_device_needs_no_mesh(hosts, counts, seeds):
    """Then the programs are the loop's own, and arrays stay where they are."""
    hosts(*counts)
    assert meshes.mesh_for(seeds, 10, 16) is None
    assert jit_programs(None, mtjax.agent("sac")) == (
        mtjax.learning.loop.init,
        mtjax.learning.loop.run_chunk,
        mtjax.learning.evaluation.evaluate,
    )
    state = object()
    assert (
        meshes.replicate(None, state) is meshes.shard_by_seed(None, state) is sharded_shapes(None, None, state) is state
    )
    assert bool(meshes.describe(None, seeds, 16)) == (sum(counts) > 1)


def test_processes_must_share_seeds_evenly(hosts):
    """A process without a seed could not take part."""
    hosts(1, 1)
    with pytest.raises(InputError, match=r"2 processes cannot share 3 seeds evenly; --seeds must be a multiple"):
        meshes.mesh_for(3, 10, 16)


@pytest.mark.parametrize("given", [(), ("JAX_NUM_PROCESSES",), ("JAX_COORDINATOR_ADDRESS", "JAX_PROCESS_ID")])
def test_missing_variables_are_named(monkeypatch, given):
    """Before anything waits for processes that will not come."""
    for name in (*processes._VARIABLES, *processes._LAUNCHERS):
        monkeypatch.delenv(name, raising=False)
    for name in given:
        monkeypatch.setenv(name, "1")
    with pytest.raises(InputError, match="--distributed needs a launcher") as caught:
        processes.initialise()
    assert {name for name in processes._VARIABLES if name in str(caught.value)} == set(processes._VARIABLES) - set(
        given
    )


@pytest.mark.parametrize("count, index", [("two", "0"), ("2", "2")])
def test_variables_that_mean_nothing_are_refused(monkeypatch, count, index):
    """A count that is no number, a process beyond the count."""
    for name, value in zip(processes._VARIABLES, ("localhost:1", count, index), strict=True):
        monkeypatch.setenv(name, value)
    with pytest.raises(InputError, match="--distributed cannot join the other processes"):
        processes.initialise()


def python(*words, **variables):
    """Start a Python process of its own, on CPUs."""
    env = environment(**{"JAX_PLATFORMS": "cpu", "MTJAX_CACHE": "0"} | variables)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen([sys.executable, *words], env=env, cwd=HERE, **pipes)


@pytest.mark.slow
@pytest.mark.parametrize("which", ["not nightly", pytest.param("nightly", marks=pytest.mark.nightly)])
def test_four_devices(which):
    """The tests of ``four_devices.py``, where JAX shows four devices of this CPU."""
    words = ("-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", which, "four_devices.py")
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=4"
    assert "skipped" not in finish(*words, XLA_FLAGS=flags)


def finish(*words, **variables):
    """Run Python to its end; returns what it said."""
    process = python(*words, **variables)
    said = process.communicate(timeout=600)[0]
    assert process.returncode == 0, said[-5000:]
    return said


def free_port():
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        return probe.getsockname()[1]


def rows_of(directory):
    with (directory / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_two_processes_are_one_run(tmp_path):
    """Each has a seed; the first writes both, a signal to the second stops both, and one process alone goes on."""
    cache = {"MTJAX_CACHE": str(tmp_path / "cache")}
    found = {"JAX_COORDINATOR_ADDRESS": f"localhost:{free_port()}", "JAX_NUM_PROCESSES": "2", **cache}
    words = ["-m", "mtjax.train", "--distributed", *TINY_RUN, "--steps=100000000", f"--runs={tmp_path / 'two'}"]
    both = [python(*words, **found, JAX_PROCESS_ID=str(i)) for i in range(2)]
    try:
        deadline = time.monotonic() + 400
        while not list(tmp_path.glob("two/*/metrics.csv")):
            assert time.monotonic() < deadline and all(p.poll() is None for p in both), "they do not train"
            time.sleep(0.2)
        both[1].send_signal(signal.SIGTERM)
        said = [process.communicate(timeout=120)[0] for process in both]
    finally:
        for process in both:
            process.kill()
            process.stdout.close()
            process.wait()
    assert [process.returncode for process in both] == [143, 143], said
    assert "devices: 2 of 2 in 2 processes, 1 seed on each" in said[0] and "stopped; the state is saved" in said[0]
    assert "run:" not in said[1] and "compiled" not in said[1]

    (directory,) = (tmp_path / "two").iterdir()
    steps = int(rows_of(directory)[-1]["steps"])
    finish("-m", "mtjax.train", f"--resume={directory}", f"--steps={steps + 40}", **cache)
    rows = rows_of(directory)
    assert [(row["seed"], int(row["steps"])) for row in rows] == [
        (seed, steps) for steps in range(40, steps + 41, 40) for seed in "01"
    ]

    finish("-m", "mtjax.train", *TINY_RUN, "--steps=80", f"--runs={tmp_path / 'one'}", **cache)
    (alone,) = (tmp_path / "one").iterdir()
    for row, expected in zip(rows[:4], rows_of(alone), strict=True):  # later, rounding has grown
        for name in row.keys() - {"seconds", "wall_seconds"}:
            number = lambda x: float(x or "nan")
            assert number(row[name]) == pytest.approx(number(expected[name]), rel=1e-3, abs=1e-4, nan_ok=True), name
    returns = [load_evaluations(folder / "evaluations.npz").returns["train"][:, :1] for folder in (directory, alone)]
    assert returns[0].shape == (2, 1, 2, 1)
    np.testing.assert_allclose(*returns, rtol=0.05)
