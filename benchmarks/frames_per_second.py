"""Measure frames a second of painters, alone and with the environment's step.

    python benchmarks/frames_per_second.py [--domains finger cheetah ...] [--painters caster warp] [--json FILE]

All contestants are compiled first and then timed in turn, round after round, in this one process, so that other load on
the machine affects all of them. Figures are medians over the rounds. "alone" draws the same worlds again and again;
"with step" steps each world with random actions and draws it, and "step" is the same without pictures.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from report import publish, run_main

import mtjax
from mtjax.envs.pixels import Pictured
from mtjax.types import InputError

DOMAINS = {"finger": "finger-spin", "cheetah": "cheetah-run", "walker": "walker-walk", "cartpole": "cartpole-swingup"}
DOMAINS |= {"corridor": "corridor-maze", "two-goal": "two-goal-maze"}
_ON_CPU = jax.default_backend() == "cpu"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domains", nargs="+", default=list(DOMAINS)[:3], choices=DOMAINS)
    parser.add_argument("--painters", nargs="+", default=["caster"] if _ON_CPU else ["caster", "warp"])  # or auto
    parser.add_argument("--sizes", nargs="+", type=int, default=[64], help="pixels a side")
    parser.add_argument("--worlds", type=int, default=128 if _ON_CPU else 4096)
    parser.add_argument("--steps", type=int, default=20, help="steps of every environment in a timed call")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    rows = []
    for domain in arguments.domains:
        rows += compare(domain, arguments)
        print(table(rows, domain), flush=True)
    publish(arguments, rows)


def compare(domain: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rates of every painter and size for a domain."""
    programs = [(("none", 0, "step"), *stepping(mtjax.make(DOMAINS[domain]), arguments))]
    for painter in arguments.painters:
        for size in arguments.sizes:
            try:
                env = mtjax.make(DOMAINS[domain], pixels=size, painter=painter)
            except InputError as error:
                print(f"{painter}: {error}")
                continue
            programs.append(((painter, size, "alone"), *drawing(env, arguments)))
            programs.append(((painter, size, "with step"), *stepping(env, arguments)))
    seconds: dict[Any, list[float]] = {label: [] for label, _, _ in programs}
    for _ in range(arguments.rounds):
        for label, run, _ in programs:
            seconds[label].append(timed(run))
    frames = arguments.worlds * arguments.steps
    return [
        {
            "domain": domain,
            "painter": label[0],
            "pixels": label[1],
            "what": label[2],
            "frames_per_second": frames / statistics.median(seconds[label]),
            "first_call_s": first,
        }
        for label, _, first in programs
    ]


def timed(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - start


def begin(env: Pictured, count: int) -> tuple[Any, Any]:
    """Return tasks and first steps of so many worlds."""
    task = jax.tree.map(lambda x: jnp.broadcast_to(x[0], (count, *x.shape[1:])), env.tasks())
    return task, jax.jit(jax.vmap(env.reset))(task, jax.random.split(jax.random.key(0), count))


def drawing(env: Pictured, arguments: argparse.Namespace) -> tuple[Callable[[], Any], float]:
    """Return a call that draws all worlds as often as there are steps, and the seconds of its first call."""
    task, first = begin(env, arguments.worlds)

    @jax.jit
    def draw(states):
        def again(states, _):
            picture = jax.vmap(env.look_at)(task, states)["pixels"]
            nudge = 1e-6 * picture[:, 0, 0, 0]  # so that no picture is drawn once for all
            move = lambda x: x + nudge.reshape(-1, *[1] * (x.ndim - 1)) if jnp.issubdtype(x.dtype, jnp.floating) else x
            return jax.tree.map(move, states), picture[:, 0, 0]

        return jax.lax.scan(again, states, length=arguments.steps)[1]

    run = lambda: draw(first.state)
    return run, timed(run)


def stepping(env: Pictured, arguments: argparse.Namespace) -> tuple[Callable[[], Any], float]:
    """Return a call that steps all worlds, and the seconds of its first call."""
    task, first = begin(env, arguments.worlds)

    @jax.jit
    def play(states):
        def advance(states, key):
            action = env.action.random(key, (arguments.worlds,))
            step = jax.vmap(env.step)(task, states, action)
            seen = [x[:, :1].reshape(arguments.worlds, -1)[:, 0] for x in jax.tree.leaves(step.obs)]
            return step.state, (step.reward, seen)

        return jax.lax.scan(advance, states, jax.random.split(jax.random.key(1), arguments.steps))[1]

    run = lambda: play(first.state)
    return run, timed(run)


def table(rows: list[dict[str, Any]], domain: str) -> str:
    lines = [f"{domain:10} {'painter':8} {'pixels':>6} {'what':10} {'frames/s':>12} {'first call':>11}"]
    for row in (row for row in rows if row["domain"] == domain):
        rate, first = f"{row['frames_per_second']:,.0f}", f"{row['first_call_s']:.1f} s"
        lines.append(f"{'':10} {row['painter']:8} {row['pixels']:6} {row['what']:10} {rate:>12} {first:>11}")
    return "\n".join(lines)


if __name__ == "__main__":
    run_main(main)
