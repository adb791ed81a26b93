"""How many steps a second: the environments alone, and the whole training loop, on this machine.

    python benchmarks/steps_per_second.py [--env NAME] [--agent NAME] [--engines c mjx] [--json FILE]

Every figure is the median of several timed calls of an already compiled program; compile time is reported apart.
"""

import argparse
import dataclasses
import json
import os
import platform
import statistics
import subprocess
import time

import jax
import jax.numpy as jnp

import mtjax
from mtjax import cli, loop
from mtjax.types import Agent, Env, InputError


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="finger-spin-vary-size")
    parser.add_argument("--agent", default="sac-conditioned")
    parser.add_argument("--engines", nargs="+", default=["c", "mjx"] if jax.default_backend() == "cpu" else ["mjx"])
    parser.add_argument("--envs-per-task", type=int, nargs="+", default=[8, 26, 102])
    parser.add_argument("--steps", type=int, default=100, help="steps of every environment in a timed call")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    rows = []
    for engine in arguments.engines:
        rows += [environment_rate(arguments, engine, count) for count in arguments.envs_per_task]
    rows.append(training_rate(arguments))
    print(table(rows))
    report = {"machine": machine(), "rows": rows}
    print(json.dumps(report))
    if arguments.json:
        with open(arguments.json, "x") as file:
            json.dump(report, file, indent=2)


def environment_rate(arguments: argparse.Namespace, engine: str, num_envs: int) -> dict:
    """Time random actions in every environment of every task, fresh starts included where episodes end."""
    env = mtjax.make(arguments.env, engine=engine)
    settings = loop.Settings(num_envs=num_envs, updates_per_step=0, replay_size=num_envs, warmup_steps=10**9)
    settings = dataclasses.replace(settings, chunk_steps=arguments.steps)
    return {"what": "environment", "engine": engine} | _time(env, mtjax.agent("sac", hidden=(8,)), settings, arguments)


def training_rate(arguments: argparse.Namespace) -> dict:
    """Time the whole loop as ``mtjax.train`` runs it with the preset of this device."""
    program = cli.with_preset(arguments.env, arguments.agent)
    settings = dataclasses.replace(program.training, chunk_steps=arguments.steps, warmup_steps=1)
    timed = _time(program.family, program.learner, settings, arguments)
    updates = timed["steps_per_second"] / timed["environments"] * settings.updates_per_step
    return {"what": f"training {arguments.agent}", "engine": "auto", **timed, "updates_per_second": updates}


def _time(env: Env, agent: Agent, settings: loop.Settings, arguments: argparse.Namespace) -> dict:
    tasks, seeds = env.tasks("train"), jnp.arange(1)
    before = time.perf_counter()
    state = jax.block_until_ready(loop.init(env, agent, settings, tasks, seeds))
    chunk = loop.run_chunk.lower(env, agent, settings, tasks, state).compile()
    compiled = time.perf_counter() - before
    state, _ = jax.block_until_ready(chunk(tasks, state))
    seconds = []
    for _ in range(arguments.repeats):
        before = time.perf_counter()
        state, _ = jax.block_until_ready(chunk(tasks, state))
        seconds.append(time.perf_counter() - before)
    environments = len(tasks.id) * settings.num_envs
    rate = lambda s: environments * settings.chunk_steps / s
    return {
        "environments": environments,
        "steps_per_second": rate(statistics.median(seconds)),
        "slowest": rate(max(seconds)),
        "fastest": rate(min(seconds)),
        "compile_seconds": compiled,
    }


def machine() -> dict:
    """Where the figures come from."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=os.path.dirname(__file__)
    )
    return {
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mtjax": mtjax.__version__,
        "commit": commit.stdout.strip() or None,
    }


def table(rows: list[dict]) -> str:
    lines = [f"{'what':28} {'engine':7} {'envs':>6} {'steps/s':>12} {'range':>25} {'compile':>9}"]
    for row in rows:
        span = f"{row['slowest']:,.0f} to {row['fastest']:,.0f}"
        lines.append(
            f"{row['what']:28} {row['engine']:7} {row['environments']:6} {row['steps_per_second']:12,.0f} {span:>25} "
            f"{row['compile_seconds']:7.1f} s"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
