"""The jitted programs of a run: split over devices, traced, compiled, and cached between runs."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import jax
from jax.sharding import Mesh, NamedSharding

from mtjax.compiling import trace_cache
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.learning.evaluation import begin, evaluate, play_on
from mtjax.learning.loop import TrainState, init, run_chunk
from mtjax.parallel.mesh import BY_SEED, BY_WORLD, REPLICATED
from mtjax.types import Agent, Env

Runs = Literal["once", "seldom", "often"]
_CUBLAS = {"xla_gpu_enable_triton_gemm": False}
_FLAGS: dict[str, dict[Runs, dict[str, Any]]] = {  # XLA's, by the device and by how often a program runs
    "cpu": {runs: {"xla_backend_optimization_level": int(runs != "once")} for runs in get_args(Runs)},
    "gpu": {"once": _CUBLAS, "seldom": _CUBLAS},
}


class Jitted(NamedTuple):
    """The jitted functions of a run. They take the arguments of ``loop.init``, ``loop.run_chunk`` and ``evaluate``."""

    init: Any
    chunk: Any
    evaluate: Any


class Programs(NamedTuple):
    """The compiled programs of a run."""

    chunk: Callable  # state -> state, metrics
    evaluate: Callable  # agents' state, number of the evaluation -> returns
    metrics: Any  # the shapes of a chunk's metrics
    ready: Callable[[], Any] = lambda: None  # waits until ``evaluate`` is compiled


def _specs(agent: Agent) -> TrainState:
    """Return how devices share each field of a training state."""
    by_world = TrainState(*[BY_WORLD] * len(TrainState._fields))  # type: ignore
    data = agent.experience.storage.sharding
    alone = dict.fromkeys(("iteration", "rows", "heard", "begun"), REPLICATED)
    return by_world._replace(agent=BY_SEED, data=data, key=BY_SEED, origins=BY_SEED, **alone)  # type: ignore


def jit_programs(mesh: Mesh | None, agent: Agent) -> Jitted:
    """Return the jitted functions of a run, split over the mesh if there is one."""
    if mesh is None:
        return Jitted(init, run_chunk, evaluate)
    state = _specs(agent)
    return Jitted(
        _split(mesh, init, (REPLICATED, BY_SEED, BY_SEED), state),
        _split(mesh, run_chunk, (REPLICATED, state), (state, BY_SEED), donated=(4,)),
        _split(mesh, evaluate, (BY_SEED, REPLICATED, BY_SEED, REPLICATED), BY_SEED),
    )


def _split(mesh: Mesh, program: Callable, inputs: tuple, outputs: Any, donated: tuple[int, ...] = ()) -> Any:
    """Return a program of three static arguments and ``inputs`` that splits its work over the mesh."""

    def split(env, agent, setting, *arguments):
        own = partial(program, env, agent, setting)
        return jax.shard_map(own, mesh=mesh, in_specs=inputs, out_specs=outputs, check_vma=False)(*arguments)

    places = [jax.tree.map(partial(NamedSharding, mesh), specs) for specs in (inputs, outputs)]
    return jax.jit(
        split, static_argnums=(0, 1, 2), in_shardings=places[0], out_shardings=places[1], donate_argnums=donated
    )


# The functions that are kept, and what they donate.
_DONATED = {init: (), run_chunk: (1,), evaluate: (), begin: (), play_on: ()}


def trace(function: Any, env: Any, agent: Agent, setting: Any, *arguments: Any) -> jax.stages.Traced:
    """Trace a jitted function of three static arguments, or read it from the cache if it was traced before."""
    static = (env, agent, setting)
    if function not in _DONATED or not isinstance(env, FamilyOrMixture):  # the first if it is split over devices
        return function.trace(*static, *arguments)
    return trace_cache.trace(env, function, _DONATED[function], static, arguments)


def load_kernels(env: Env) -> bool:
    """Compile or load what an environment runs outside XLA. XLA may compile meanwhile.

    Returns:
        whether XLA must compile nothing while programs first run.
    """
    return isinstance(env, FamilyOrMixture) and env.calls.load_kernels()


def sharded_shapes(mesh: Mesh | None, agent: Agent, shapes: TrainState) -> TrainState:
    """Return the shapes of a training state with the devices of every leaf."""
    if mesh is None:
        return shapes
    put = lambda spec, part: jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=NamedSharding(mesh, spec)), part
    )
    return jax.tree.map(put, _specs(agent), shapes)


def compile_lowered(program: Any, runs: Runs = "often") -> Any:
    """Compile a lowered program, in less time if it runs seldom.

    On a CPU, LLVM's later passes are left out: they take a quarter of the compile time and make nothing faster. On a
    GPU, matrix products of programs that run seldom are cuBLAS's: XLA tries dozens of kernels of its own for each.
    """
    flags = _FLAGS.get(jax.default_backend(), {}).get(runs, {})
    given = os.environ.get("XLA_FLAGS", "")
    return program.compile({name: value for name, value in flags.items() if name not in given} or None)


def enable_compile_cache() -> None:
    """Cache traced and compiled programs in ~/.cache/mtjax/xla or $MTJAX_CACHE. MTJAX_CACHE=0 turns this off."""
    place = os.environ.get("MTJAX_CACHE", "~/.cache/mtjax/xla")
    if place == "0":
        return
    folder = Path(place).expanduser()
    trace_cache.use_folder(folder / "traced")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
