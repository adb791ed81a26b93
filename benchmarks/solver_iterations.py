"""Measure speed and one step's error for numbers of solver iterations, by domain and engine.

    python benchmarks/solver_iterations.py [--envs NAME ...] [--vary NAME=VALUES] [--engines mjx warp]
                                           [--settings 1/2 4/8 ...] [--json FILE]

States are those of random play. The error of a world is the largest difference of any velocity [m/s or rad/s] after
one control step from that of MuJoCo C with its solver run until it improves no more; ``off`` is the share of worlds
whose error exceeds ``--tolerance``. The smallest setting after which neither falls is the one to take. ``lost`` is the
share of worlds whose velocities are not finite, or beyond 1e4, after ``--steps`` random actions.
"""

import argparse
import copy
import statistics
import time
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import learning
import mujoco
import numpy as np
from mujoco import batch
from report import publish, run_main

import mtjax
from mtjax.envs import ENVS, Domain
from mtjax.envs.engines.base import Engine, World
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.mjx import Mjx
from mtjax.envs.physics import mjx_engine
from mtjax.types import InputError, Task

SETTINGS = ("1/2", "1/4", "2/4", "2/8", "3/6", "4/8", "6/12", "10/20")
_HELD = 5  # control steps for which random play holds an action
_FAST = 1e4  # [m/s or rad/s] that only a world has that blew up


class Sample(NamedTuple):
    """Worlds of random play, an action for each, and the velocities (n, nv) after the exact step."""

    tasks: Task
    world: World
    action: jax.Array
    qvel: np.ndarray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=domains(), help="default: one of every MuJoCo domain")
    parser.add_argument(
        "--vary", nargs="*", default=[], metavar="NAME=VALUES", help="what tasks differ in: friction=0.1"
    )
    parser.add_argument("--engines", nargs="+", choices=("c", "mjx", "warp"), help="default: those for this device")
    parser.add_argument("--settings", nargs="+", default=SETTINGS, help="iterations/line-search iterations")
    parser.add_argument("--worlds", type=int, default=256 if jax.default_backend() == "cpu" else 8192)
    parser.add_argument("--sample", type=int, default=1024, help="worlds whose error is measured, at most --worlds")
    parser.add_argument("--play", type=int, default=100, help="control steps of random play before that")
    parser.add_argument("--steps", type=int, default=50, help="control steps of every world in a timed call")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--tolerance", type=float, default=0.01, help="[m/s or rad/s]")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    engines = arguments.engines or (("c", "mjx") if jax.default_backend() == "cpu" else ("mjx",))
    rows = []
    print(HEADER, flush=True)
    for name in arguments.envs:
        for row in measure(name, engines, arguments):
            print(line(row), flush=True)
            rows.append(row)
    publish(arguments, rows)


def domains() -> list[str]:
    """Return the first family's name of every MuJoCo model of this package."""
    own = lambda family: issubclass(family, Domain) and hasattr(family, "model_file")  # Meta-World's are not
    families = {name: family for name, (family, _) in ENVS.items() if own(family)}
    first = {family.model_file: name for name, family in reversed(families.items())}
    return list(first.values())


def measure(name: str, engines: tuple[str, ...], arguments: argparse.Namespace) -> Any:
    """Yield a row for every engine and setting of one environment."""
    env = mtjax.make(name, **learning.family_settings([], arguments.vary, "none" if arguments.vary else None))
    if not isinstance(env, Domain):
        raise InputError(f"{name!r} is no family of one MuJoCo model, such as finger-spin")
    sample = play(env, min(arguments.sample, arguments.worlds), arguments.play)
    for kind in engines:
        for setting in ("model",) if kind == "c" else arguments.settings:
            engine = build(env, kind, setting)
            yield {"env": name, "engine": kind, "setting": setting, **evaluate(engine, sample, arguments)}


def build(env: Domain, kind: str, setting: str) -> Engine:
    """Return the engine ``kind`` of a family, with "iterations/line-search iterations" of its solver."""
    if kind == "c":
        return MujocoC(env.models, env.num_substeps)
    base = copy.copy(mjx_engine(env).base)
    try:
        base.opt.iterations, base.opt.ls_iterations = map(int, setting.split("/"))
    except ValueError:
        raise InputError(f"a setting is iterations/line-search iterations, such as 4/8, not {setting!r}") from None
    if kind == "mjx":
        return Mjx(base, env.num_substeps)
    from mtjax.envs.engines.warp import Warp

    return Warp(base, env.num_substeps)


def play(env: Domain, count: int, steps: int) -> Sample:
    """Play at random from fresh starts with MuJoCo C, and step once more with its solver run to the end."""
    train = env.tasks()
    tasks = jax.tree.map(lambda x: x[np.arange(count) % len(train.id)], train)
    start = jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), count)).state
    worlds = batch.Batch(env.models[0], count)
    worlds.set_models([exact(env.models[row]) for row in np.asarray(tasks.row)])
    qpos, qvel, warmstart, ctrl = (worlds.bind(x) for x in ("qpos", "qvel", "qacc_warmstart", "ctrl"))
    qpos[:], qvel[:] = start.qpos, start.qvel
    random = np.random.default_rng(0)
    for step in range(steps):
        if step % _HELD == 0:
            ctrl[:] = random.uniform(-1, 1, ctrl.shape)
        worlds.step(nstep=env.num_substeps)
    for view in (qpos, qvel, warmstart, ctrl):
        view[:] = np.float32(view)
    single = jnp.float32
    before = World(single(qpos), single(qvel), single(warmstart), start.sensors, start.extra)
    action = single(ctrl)
    worlds.step(nstep=env.num_substeps)
    return Sample(tasks, before, action, qvel.copy())


def exact(model: mujoco.MjModel) -> mujoco.MjModel:
    model = copy.copy(model)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 500, 100, 1e-12
    return model


def evaluate(engine: Engine, sample: Sample, arguments: argparse.Namespace) -> dict[str, float]:
    """Return errors of one step in the sample's worlds, and the speed of many worlds under random actions."""
    count, sampled = arguments.worlds, len(sample.qvel)
    tasks, world, action = jax.tree.map(lambda x: jnp.asarray(x)[np.arange(count) % sampled], sample[:3])

    @partial(jax.jit, donate_argnums=1)
    def run(tasks: Task, world: World, action: jax.Array, key: jax.Array, steps: int) -> World:
        def advance(step: int, world: World) -> World:
            random = jax.random.uniform(jax.random.fold_in(key, step), action.shape, minval=-1)
            return jax.vmap(engine.step)(tasks, world, jnp.where(step == 0, action, random))

        return jax.lax.fori_loop(0, steps, advance, world)

    before = time.perf_counter()
    compiled = run.lower(tasks, world, action, jax.random.key(0), 1).compile()
    compile_seconds = time.perf_counter() - before

    def call(steps: int, seed: int = 0) -> tuple[World, float]:
        fresh = jax.block_until_ready(jax.tree.map(jnp.copy, world))
        before = time.perf_counter()
        new = jax.block_until_ready(compiled(tasks, fresh, action, jax.random.key(seed), steps))
        return new, time.perf_counter() - before

    first, first_seconds = call(1)
    speeds = np.abs(np.asarray(call(arguments.steps)[0].qvel)).max(axis=1)
    rates = [count * arguments.steps / call(arguments.steps, seed)[1] for seed in range(arguments.repeats)]
    errors = np.max(np.abs(np.asarray(first.qvel, np.float64)[:sampled] - sample.qvel), axis=1)
    errors = np.where(np.isfinite(errors), errors, np.inf)
    median, high = np.quantile(errors, (0.5, 0.99), method="nearest")
    return {
        "median": float(median),
        "p99": float(high),
        "off": float(np.mean(errors > arguments.tolerance)),
        "lost": float(np.mean(~(speeds < _FAST))),  # which is true of NaN
        "steps_per_second": statistics.median(rates),
        "slowest": min(rates),
        "fastest": max(rates),
        "compile_seconds": compile_seconds,
        "first_call_seconds": first_seconds,  # in which Warp compiles its kernels
    }


_ERRORS = f"{'median':>9} {'p99':>9} {'off':>7} {'lost':>7}"
HEADER = f"{'env':26} {'engine':6} {'setting':>7} {_ERRORS} {'steps/s':>12} {'compile':>8}"


def line(row: dict[str, Any]) -> str:
    errors = f"{row['median']:9.1e} {row['p99']:9.1e} {row['off']:7.2%} {row['lost']:7.2%}"
    speed = f"{row['steps_per_second']:12,.0f} {row['compile_seconds']:6.1f} s"
    return f"{row['env']:26} {row['engine']:6} {row['setting']:>7} {errors} {speed}"


if __name__ == "__main__":
    run_main(main)
