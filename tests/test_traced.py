"""The cache of traced programs: a second process traces nothing, and whatever decides a program is in its key."""

import csv
import dataclasses
import json
import os
import pickle
import subprocess
import sys
import types
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_process import environment

import mtjax
from mtjax.compiling import programs, trace_cache
from mtjax.envs.blocks import Blocks
from mtjax.envs.mixtures import States
from mtjax.envs.task_table import Outside

# Runs a command and says, as the last line of its output, how often the steps of programs were traced.
SCRIPT = """
import json, runpy, sys
import mtjax.learning.evaluation, mtjax.learning.loop
count = 0
def counted(step):
    def trace(*arguments, **named):
        global count
        count += 1
        return step(*arguments, **named)
    return trace
for module in (mtjax.learning.evaluation, mtjax.learning.loop):
    module.step_envs = counted(module.step_envs)
module, *sys.argv[1:] = json.loads(sys.argv[1])
runpy.run_module(module, run_name="__main__", alter_sys=True)
print(json.dumps(count))
"""
SMALL = (
    "--agent=sac-conditioned --steps=600 --eval-every=300 --eval-episodes=1 --num-envs=2 "
    "--batch-size=4 --replay-size=200 --warmup-steps=5 --chunk-steps=30 --agent.hidden 8 8"
).split()


class Point(NamedTuple):
    """A container of a program's result."""

    x: object
    y: object


@dataclasses.dataclass(frozen=True)
class Settings:
    """A static argument."""

    factor: float = 2.0
    file: str = ""


INSIDE = types.SimpleNamespace(calls=Outside(()))  # an environment that makes no calls out of XLA


@pytest.fixture
def times():
    """A program of three static arguments with a key in its state. Its attribute counts how often it was traced."""

    def times(env, agent, setting, state, scale):
        program.traced += 1
        new = Point(state.x * setting.factor * scale["by"], jax.random.split(state.y)[0])
        return new, {"sum": jnp.sum(new.x), "nothing": None}

    program = Counted(jax.jit(times, static_argnums=(0, 1, 2)))
    return program


class Counted:
    """A jitted function with a counter of its traces."""

    def __init__(self, jitted):
        self.jitted, self.traced = jitted, 0

    def __getattr__(self, name):
        return getattr(self.jitted, name)

    def __call__(self, *arguments):
        return self.jitted(*arguments)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A cache that takes the code of this process to be known, though tests are not installed."""
    monkeypatch.setattr(trace_cache, "_code", lambda: "the code")
    monkeypatch.setattr(trace_cache, "_folder", [tmp_path / "traced"])
    return tmp_path / "traced"


def arguments():
    return Point(jnp.arange(3.0), jax.random.key(3)), {"by": np.float32(0.3)}


def run(program, setting=None, given=None, donated=(), env=INSIDE):
    """Trace by the cache as a new process would, and call."""
    jax.clear_caches()
    given = given or arguments()
    return (
        trace_cache.trace(env, program, donated, ((), "agent", setting or Settings()), given).lower().compile()(*given)
    )


def same(one, other):
    plain = lambda tree: [np.asarray(jax.random.key_data(x) if x.dtype == key else x) for x in jax.tree.leaves(tree)]
    key = jax.random.key(0).dtype
    equal = all(np.array_equal(x, y) for x, y in zip(plain(one), plain(other), strict=True))
    return equal and jax.tree.structure(one) == jax.tree.structure(other)


@pytest.mark.slow
def test_a_program_is_traced_once(folder, times, monkeypatch):
    """What the file gives back is the program: values, containers and keys. No pickle is loaded."""
    first = run(times)
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, None)
    assert times.traced == 1 and same(first, run(times)) and times.traced == 1
    assert same(first, times.jitted((), "agent", Settings(), *arguments()))
    assert len(list(folder.iterdir())) == 1 and isinstance(first[0], Point)


@pytest.mark.slow
def test_there_is_no_cache_unless_it_is_asked_for(folder, times, monkeypatch):
    """As with MTJAX_CACHE=0, and in a notebook."""
    trace_cache.use_folder(None)
    assert same(run(times), run(times)) and times.traced == 2 and not folder.exists()


@pytest.mark.slow
def test_whatever_decides_a_program_is_in_its_key(folder, times, monkeypatch, tmp_path):
    """Settings, what their files hold, shapes, JAX's configuration, the environment and the code."""
    file = tmp_path / "vectors.npy"
    file.write_bytes(b"one")
    run(times)
    misses = lambda *given: (before := times.traced, run(times, *given), times.traced - before)[2]
    assert misses() == 0
    assert misses(Settings(3.0)) == 1
    assert misses(Settings(2)) == 1  # an integer may trace to another program
    assert misses(Settings(file=str(file))) == 1
    assert misses(Settings(file=str(file))) == 0
    file.write_bytes(b"two")
    assert misses(Settings(file=str(file))) == 1
    state, scale = arguments()
    assert misses(None, (state._replace(x=jnp.arange(4.0)), scale)) == 1
    assert misses(None, (state._replace(x=jnp.arange(3)), scale)) == 1
    with jax.default_matmul_precision("highest"):
        assert misses() == 1
    monkeypatch.setenv("MJX_ANY", "1")
    assert misses() == 1
    monkeypatch.setattr(trace_cache, "_code", lambda: "changed code")
    assert misses() == 1 and misses() == 0


@pytest.mark.parametrize(
    "damage", [lambda x: b"", lambda x: x[: len(x) // 2], lambda x: x[:-9] + bytes(9), lambda x: b"no"]
)
def test_a_damaged_file_is_replaced(folder, times, capsys, damage):
    """With one line that says so."""
    first = run(times)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    assert same(first, run(times)) and times.traced == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert same(first, run(times)) and times.traced == 2


def test_what_cannot_be_kept_is_traced_as_ever(folder):
    """A callback into Python belongs to one process."""
    host = lambda x: np.asarray(x) + 1
    given = (jnp.arange(3.0),)
    ask = lambda env, agent, setting, x: jax.pure_callback(host, jax.ShapeDtypeStruct((3,), jnp.float32), x)
    program = jax.jit(ask, static_argnums=(0, 1, 2))
    for _ in range(2):
        assert same(run(program, given=given), jnp.arange(1.0, 4.0))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="MuJoCo's C engine steps on CPUs")
def test_a_program_with_calls_out_of_xla_runs_where_they_have_the_same_names(folder, monkeypatch):
    """A family that is made anew has them. Elsewhere the program is traced anew."""
    family = lambda: mtjax.make("pendulum-swingup", engine="c")
    env, other, count = family(), family(), []

    @partial(jax.jit, static_argnums=(0, 1, 2))
    def program(env, agent, setting, tasks, states, actions):
        count.append(1)
        return jax.vmap(env.step)(tasks, states, actions).obs

    states = jax.vmap(env.reset)(env.tasks(), jax.random.split(jax.random.key(0), 1)).state
    given = env.tasks(), states, jnp.ones((1, 1))
    kept = lambda: trace_cache.trace(env, program, (), (env, "agent", None), given).lower().compile()(*given)
    first = kept()
    jax.clear_caches()
    assert list(env.calls.targets().values()) == [[0, "advance"]] and same(first, kept()) and len(count) == 1
    jax.clear_caches()
    again = lambda: trace_cache.trace(other, program, (), (other, "agent", None), given).lower().compile()(*given)
    assert same(first, again()) and len(count) == 1
    jax.clear_caches()
    monkeypatch.setattr(Outside, "provide", lambda *_: "another")
    assert same(first, again()) and len(count) == 2


def test_objects_that_may_hold_anything_are_in_no_key(folder, times):
    """Then nothing is kept."""
    run(times, dataclasses.replace(Settings(), file=len))  # type: ignore
    assert not folder.exists()


def test_a_donated_argument_is_given_away(folder, times):
    """As by the program itself, so that a state is not in memory twice."""
    for _ in range(2):
        given = arguments()
        run(times, given=given, donated=(0,))
        assert given[0].x.is_deleted()


def test_files_that_were_not_used_for_longest_are_dropped(folder, times, monkeypatch):
    """So that the folder stays small."""
    run(times)
    (old,) = folder.iterdir()
    os.utime(old, (1, 1))
    monkeypatch.setattr(trace_cache, "LIMIT", old.stat().st_size * 1.5)
    run(times, Settings(3.0))
    (new,) = folder.iterdir()
    assert new != old


def test_states_of_mixtures_can_be_written():
    """Their static blocks too."""
    states = States(Blocks(((0, 2), (1, 1)), 3), (Point(0, (1, [2])), None))
    assert trace_cache._decode(json.loads(json.dumps(trace_cache._encode(states)))) == states


def test_only_containers_are_made_from_a_file():
    """No class is imported, and nothing else is called."""
    for place in (["os", "system"], ["subprocess", "Popen"]):
        with pytest.raises(ValueError):
            trace_cache._decode({"class": place, "fields": {"x": 0}})
    with pytest.raises(KeyError):
        trace_cache._decode({"class": ["antigravity", "anything"], "fields": {}})
    assert "antigravity" not in sys.modules


def test_a_process_with_other_code_keeps_nothing():
    """Such as these tests, or a file of the user's own: it may change anything."""
    with pytest.raises(trace_cache.Unkept, match="may change anything"):
        trace_cache._code()


def test_an_error_of_a_traced_program_comes_alone(monkeypatch):
    """And not as one that happened while the cache said why it keeps nothing."""
    monkeypatch.setattr(trace_cache, "_folder", [])  # a test before this one may have given it one

    class Broken:
        def trace(self, *arguments):
            raise KeyError("wnd")

    with pytest.raises(KeyError, match="wnd") as error:
        trace_cache.trace(None, Broken(), (), (), ())
    assert error.value.__context__ is None


def test_changed_source_changes_the_key(monkeypatch, tmp_path):
    """And source that changed while the process ran may not be what it runs."""
    (tmp_path / "a.py").write_text("x = 1")
    monkeypatch.setattr(trace_cache, "_PACKAGE", tmp_path)
    monkeypatch.setattr(trace_cache, "BEGAN", (tmp_path / "a.py").stat().st_mtime + 9)
    before = trace_cache._versions.__wrapped__((tmp_path,))
    (tmp_path / "a.py").write_text("x = 2")
    assert before != trace_cache._versions.__wrapped__((tmp_path,))
    monkeypatch.setattr(trace_cache, "BEGAN", (tmp_path / "a.py").stat().st_mtime)
    with pytest.raises(trace_cache.Unkept, match="just changed"):
        trace_cache._versions.__wrapped__((tmp_path,))


def command(words, cache):
    """Run a command in a process of its own; returns how often it traced a step."""
    env = environment(MTJAX_CACHE=str(cache))
    env.pop("JAX_COMPILATION_CACHE_DIR", None)
    process = [sys.executable, "-c", SCRIPT, json.dumps(words)]
    done = subprocess.run(process, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def results(directory):
    """What a run leaves, but for the times."""
    with (directory / "metrics.csv").open() as file:
        rows = [{k: v for k, v in row.items() if "seconds" not in k} for row in csv.DictReader(file)]
    with np.load(directory / "evaluations.npz") as scores:
        return rows, {name: scores[name].tobytes() for name in scores}


@pytest.mark.slow
@pytest.mark.parametrize("env", ["control-cartpole", pytest.param("finger-spin-vary-size", marks=pytest.mark.nightly)])
def test_a_second_run_traces_nothing(tmp_path, env):
    """Training and evaluation, in JAX and by MuJoCo C; and what they write is what a run without the cache writes."""
    runs = [tmp_path / name for name in ("without", "first", "second")]
    caches = ("0", tmp_path / "cache", tmp_path / "cache")
    train = lambda place, cache: command(["mtjax.train", f"--env={env}", *SMALL, f"--runs={place}"], cache)
    counts = [train(place, cache) for place, cache in zip(runs, caches, strict=True)]
    assert counts[0] > 0 and counts[1] > 0 and counts[2] == 0
    written = [results(next(place.iterdir())) for place in runs]
    assert written[0] == written[1] == written[2]
    evaluate = ["mtjax.evaluate", f"--run={next(runs[0].iterdir())}", "--episodes=2"]
    assert command(evaluate, caches[1]) > 0 and command(evaluate, caches[1]) == 0


@pytest.mark.parametrize(
    ("backend", "flags", "asked"),
    [
        ("gpu", "", [{"xla_gpu_enable_triton_gemm": False}, {"xla_gpu_enable_triton_gemm": False}, None]),
        ("gpu", "--xla_gpu_enable_triton_gemm=true", [None, None, None]),
        ("cpu", "", [{"xla_backend_optimization_level": level} for level in (0, 1, 1)]),
        ("tpu", "", [None, None, None]),
    ],
)
def test_a_program_compiles_sooner_if_it_runs_seldom(monkeypatch, backend, flags, asked):
    """Unless the user's flags say otherwise; and no device sees another's flags."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    monkeypatch.setenv("XLA_FLAGS", flags)
    lowered = types.SimpleNamespace(compile=lambda options: options)
    assert [programs.compile_lowered(lowered, runs) for runs in ("once", "seldom", "often")] == asked
