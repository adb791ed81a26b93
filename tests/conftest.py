"""What several test files share. Compiled programs live for the whole session: an MJX step costs ten seconds."""

import dataclasses
import gc
import os
import shutil
import sys
from functools import cache, lru_cache
from itertools import count
from pathlib import Path
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from flax.core import Scope, meta
from needs import count_skips, require, skip_without_packages
from probes import set_physics
from tyro import _docstrings

import mtjax.train
from mtjax.envs import ENVS
from mtjax.envs.dm_control.finger import FingerSpin
from mtjax.envs.engines import c
from mtjax.training.allocator import give_back_pages

# Tests compile much and run little: without LLVM's optimisations and by XLA's plain emitters a program is made in a
# fifth of the time. One thread a program is enough, as pytest runs several processes.
QUICK_FLAGS = {"xla_backend_optimization_level": "0", "xla_cpu_parallel_codegen_split_count": "1"}
if jax.__version_info__ < (0, 11):  # later ones end the process at a flag that they no longer know
    QUICK_FLAGS["xla_cpu_use_fusion_emitters"] = "false"


def pytest_configure(config):
    """Compile quickly, here and in processes that tests start, and never twice: workers share what they compiled."""
    if config.option.markexpr == "gpu":
        use_gpu(config)
    else:
        given = os.environ.get("XLA_FLAGS", "")
        added = [f"--{name}={value}" for name, value in QUICK_FLAGS.items() if name not in given]
        os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()
    read_classes_once()
    lower_many_in_one_context()
    trace_initialisers_once()
    files = getattr(config, "cache", None)
    if files is not None:
        keep = {
            "jax_compilation_cache_dir": str(files.mkdir("xla")),
            "jax_persistent_cache_min_compile_time_secs": 0.1,  # what takes less is made as soon as it is read
            "jax_persistent_cache_min_entry_size_bytes": -1,
        }
        for name, value in keep.items():
            os.environ[name.upper()] = str(value)
            jax.config.update(name, value)


def read_classes_once():
    """Keep what tyro reads of a class's source: it forgets it after every command line, of which tests parse hundreds.

    It makes up more than half of the time that a command line takes.
    """
    tokens = getattr(_docstrings, "_ClassTokenization", None)
    if hasattr(getattr(tokens, "make", None), "__wrapped__"):  # tyro may change what is its own
        tokens.make = staticmethod(cache(tokens.make.__wrapped__))  # type: ignore


def lower_many_in_one_context():
    """Lower 50 programs in one MLIR context. JAX makes one for each, which is a sixth of what a small program costs.

    A context keeps all constants and types that it has seen, so that it may not live for ever. What is lowered in the
    midst of another lowering has one of its own: copies of modules would land in the unfinished one otherwise.
    """
    mlir = sys.modules.get("jax._src.interpreters.mlir")
    make, made = getattr(mlir, "make_ir_context", None), count()
    context = getattr(getattr(mlir, "ir", None), "Context", None)
    if mlir is not None and make is not None and context is not None:  # JAX may change what is its own
        of_number = lru_cache(1)(lambda number: make())
        mlir.make_ir_context = lambda: make() if is_current(context) else of_number(next(made) // 50)


def is_current(context) -> bool:
    """Return whether a context of a class is at work in this thread."""
    try:
        return context.current is not None
    except ValueError:
        return False


def trace_initialisers_once():
    """Keep the shapes of what initialisers make. Flax traces each one again wherever a network is applied, to compare.

    That makes up a seventh of the time that tracing an update takes.
    """
    param = Scope.param

    @cache
    def shapes(init, *arguments):
        return shape_of(jax.eval_shape(lambda: init(jax.random.key(0), *arguments)))

    def fast_param(self, name, init_fn, *arguments, unbox=True, **more):
        known = self.has_variable("params", name) and unbox and not more
        value = meta.unbox(self.get_variable("params", name)) if known else None
        try:
            known = known and shape_of(value) == shapes(init_fn, *arguments)
        except TypeError:  # an argument that is no key
            known = False
        if not known:
            return param(self, name, init_fn, *arguments, unbox=unbox, **more)
        self.reserve(name, "params")
        return value

    Scope.param = fast_param


def shape_of(tree):
    """Return the shapes of a tree's leaves."""
    return [np.shape(x) for x in jax.tree.leaves(tree)]


def pytest_collection_finish():
    """Search for garbage between files alone, and never again in what lives on: traces hold very many objects."""
    keep_what_lives()
    gc.disable()


def keep_what_lives():
    """Collect the garbage, and leave what is no garbage now out of later searches."""
    gc.collect()
    gc.freeze()


def use_gpu(config):
    """Share a GPU: take memory as it is needed, do not tune, and give every worker one test after another.

    Tuning tries out dozens of kernels for each matrix product, which takes minutes on a GPU that all workers use. XLA
    compares those kernels with each other by itself. The wrong fusion that these tests once found was wrong either way.
    """
    if "xla_gpu_autotune_level" not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_gpu_autotune_level=0".strip()
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    config.option.dist, config.option.maxschedchunk = "load", 1
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Durations(config), "durations")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    skip_without_packages(item)


def pytest_terminal_summary(terminalreporter):
    count_skips(terminalreporter)


class Durations:
    """Tells how long each test took as soon as it ends, so that a run that is cut off has told it too."""

    def __init__(self, config):
        self.config, self.seconds = config, {}

    def pytest_runtest_logreport(self, report):
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.when == "teardown":
            terminal = self.config.pluginmanager.get_plugin("terminalreporter")
            terminal.write_line(f"{self.seconds.pop(report.nodeid):7.1f} s {report.nodeid}")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """Use every core that this process may, but no more than four without a GPU: each worker takes two gigabytes."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(16 if config.option.markexpr == "gpu" else 4, cores)


class Worlds(NamedTuple):
    """States of the nominal finger: the first half in contact, every second one with a fast hinge."""

    qpos: np.ndarray  # (100, 3)
    qvel: np.ndarray  # (100, 3)
    action: np.ndarray  # (100, 2)


class Programs(NamedTuple):
    """An environment's functions, mapped over a flat batch and compiled once for each batch size."""

    reset: object
    put: object  # tasks, qpos, qvel -> World
    step: object


@lru_cache
def compiled(env) -> Programs:
    put = jax.vmap(lambda task, qpos, qvel: set_physics(env, task, None, qpos, qvel))
    return Programs(jax.jit(jax.vmap(env.reset)), jax.jit(put), jax.jit(jax.vmap(env.step)))


MOST_MAPPINGS = 45_000  # of the 65,530 that Linux gives a process
MOST_BYTES, MOST_MEMORY = 4e9, 1 / 6  # of memory, and of the machine's, which at most four processes share


def is_full() -> bool:
    """Return whether this process holds many programs: each takes some mappings of memory."""
    mappings, statm = Path("/proc/self/maps"), Path("/proc/self/statm")
    if not statm.is_file():  # other systems do not tell
        return True
    most = min(MOST_BYTES / os.sysconf("SC_PAGE_SIZE"), MOST_MEMORY * os.sysconf("SC_PHYS_PAGES"))
    return int(statm.read_text().split()[1]) > most or mappings.read_text().count("\n") >= MOST_MAPPINGS


def caches_of_tests():
    """Return the functions of test files that keep what they returned."""
    files = [module for name, module in sys.modules.items() if name.startswith("test_")]
    own = [x for file in files for x in vars(file).values() if getattr(x, "__module__", None) == file.__name__]
    return [x for x in own if hasattr(x, "cache_clear")]


@pytest.fixture
def random():
    """What a test draws from: the same numbers, whichever tests ran before it."""
    return np.random.default_rng(0)


@pytest.fixture(scope="module", autouse=True)
def forget_programs():
    """Drop what files have compiled and cached, and what JAX has, once the process is full.

    What is free by then goes back to the system. A worker kept gigabytes of it. Until then the next file finds
    the small programs of JAX's own functions, which every file would compile again.
    """
    yield
    if not is_full():
        return keep_what_lives()
    gc.unfreeze()
    for cached in (compiled, probes._programs, probes._agent_programs, *caches_of_tests()):
        cached.cache_clear()
    jax.clear_caches()
    keep_what_lives()
    give_back_pages()


@pytest.fixture(autouse=True)
def forget_worlds():
    """Drop the worlds of MuJoCo's C engine after a test: thousands of each family take gigabytes together."""
    yield
    c._batches.clear()


@pytest.fixture
def optimised(monkeypatch):
    """Let XLA optimise a run, in this process or in one that the test starts: it runs for longer than it compiles."""
    flags = os.environ.get("XLA_FLAGS", "").split()
    monkeypatch.setenv("XLA_FLAGS", " ".join(x for x in flags if x.strip("-").split("=")[0] not in QUICK_FLAGS))


@pytest.fixture(scope="session")
def programs():
    return compiled


@pytest.fixture(scope="session")
def suite_finger():
    """dm_control's own finger-spin environment, after the reset that sets the hinge's damping."""
    environment = require("dm_control.suite").load("finger", "spin", task_kwargs={"random": 0})
    environment.reset()
    return environment


@pytest.fixture(scope="session")
def worlds(suite_finger) -> Worlds:
    """States that random play reaches: overlaps that no motion leads to amplify rounding beyond any use."""
    random = np.random.RandomState(1)
    touching, free = [], []
    while len(touching) < 50 or len(free) < 50:
        suite_finger.reset()
        for _ in range(10):
            action = random.uniform(-1, 1, 2)
            for _ in range(10):
                suite_finger.step(action)
            data = suite_finger.physics.data
            (touching if data.ncon else free).append((data.qpos.copy(), data.qvel.copy()))
    states = np.float32(touching[:50] + free[:50])
    states[::2, 1, 2] = random.uniform(-40, 25, 50)
    return Worlds(states[:, 0], states[:, 1], np.float32(random.uniform(-1, 1, (100, 2))))


@dataclasses.dataclass(frozen=True)
class ShortFinger(FingerSpin):
    """Short episodes whose returns tell any two of them apart, as the rare rewards of the real family do not."""

    episode_steps: ClassVar[int] = 20

    def reward(self, task, world, action):
        return 1 + jnp.cos(world.qpos[2]) + 0.1 * jnp.mean(action)


SHORT_RUN = (
    "--env=finger-short --agent=sac-conditioned --steps=600 --seeds=2 --eval-every=200 --eval-episodes=1 --num-envs=2 "
    "--batch-size=4 --replay-size=200 --warmup-steps=5 --chunk-steps=25 --agent.hidden 8 8"
).split()


@pytest.fixture(scope="session")
def short_family():
    """Makes ``finger-short`` a name like any other, and keeps compiled programs out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ENVS, "finger-short", (ShortFinger, {"vary": {"size": "1:1.2:2"}, "engine": "c"}))
        patch.setenv("MTJAX_CACHE", "0")
        yield


@pytest.fixture(scope="session")
def finished_run(short_family, tmp_path_factory):
    """The folder of a run of ``SHORT_RUN`` by the program. Only to be read; what writes takes ``copied_run``."""
    runs = tmp_path_factory.mktemp("runs")
    mtjax.train.main([*SHORT_RUN, f"--runs={runs}"])
    (directory,) = runs.iterdir()
    return directory


@pytest.fixture
def copied_run(finished_run, tmp_path):
    return shutil.copytree(finished_run, tmp_path / "run")
