"""Measure where an update's time goes: its kernels by a trace, and its share of the chip's rate of matrix products.

    python benchmarks/kernels.py [--agents sac care ...] [--tasks 10] [--seeds 1] [--batch 128] [--hidden 400 400 400]
                                 [--top 12] [--json FILE]

Updates are those of ``update_cost.py``. JAX's profiler records one call of them. On a GPU an operation is a kernel. On
a CPU loops and calls are left out, as other operations are inside them. The time that no operation covers is idle:
launches, and waiting for the one before. Operations count as products by their names. "GFLOP" is XLA's own count for
one update, elementwise operations included. The rate that it is compared with is that of a product of two matrices of
8192 x 8192 (1024 on a CPU) in the same process and precision. Kernels inside CUDA graphs are listed one by one only if
XLA makes no graphs: ``XLA_FLAGS=--xla_gpu_enable_command_buffer=``; updates are then slower than usual.
"""

import argparse
import re
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from report import markdown, publish, run_main
from update_cost import SPEC, Contestant, random_window, tasks_of

import mtjax

_ON_CPU = jax.default_backend() == "cpu"
_HOLDS_OTHERS = re.compile(r"(while|call|conditional)([._]\d+)*")  # operations of a CPU's program
_PRODUCT = re.compile(r"gemm|nvjet|cutlass|cublas|(^|_)dot|matmul|custom-call", re.IGNORECASE)


class Operation(NamedTuple):
    """Holds one execution of a kernel or thunk, times in seconds."""

    name: str
    start: float
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", default=["sac", "care"], choices=list(mtjax.AGENTS))
    parser.add_argument("--tasks", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--batch", type=int, default=128, help="transitions a task")
    parser.add_argument("--hidden", type=int, nargs="+", default=[400, 400, 400])
    parser.add_argument("--updates", type=int, default=2 if _ON_CPU else 20, help="in the recorded call")
    parser.add_argument("--top", type=int, default=12, help="operations that are listed")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    rate = product_rate(1024 if _ON_CPU else 8192)
    rows = []
    for name in arguments.agents:
        operations, seconds = trace(name, arguments)
        rows.append(row(name, arguments, operations, seconds, rate))
        print(f"\n{name}\n{slowest(operations, arguments)}", flush=True)
    print("\n" + markdown(list(rows[0]), [[str(x) for x in row.values()] for row in rows]), flush=True)
    publish(arguments, rows)


def product_rate(size: int) -> float:
    """Return the floating-point operations a second of a large product at JAX's default precision."""
    x = jax.random.normal(jax.random.key(0), (size, size))
    times = 10
    product = jax.jit(lambda x: jax.lax.fori_loop(0, times, lambda _, y: x @ y / size**0.5, x))
    jax.block_until_ready(product(x))
    before = time.perf_counter()
    jax.block_until_ready(product(x))
    return 2 * size**3 * times / (time.perf_counter() - before)


def trace(name: str, arguments: argparse.Namespace) -> tuple[list[Operation], float]:
    """Return the operations of one call of ``arguments.updates`` updates, and its seconds without the profiler."""
    contestant = Contestant(name, arguments, arguments.tasks, arguments.seeds)
    for _ in range(3):
        contestant.time()
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            contestant.time(count=False)
        file = next(Path(folder).glob("**/*.xplane.pb"))
        return read(jax.profiler.ProfileData.from_file(str(file))), min(contestant.seconds) * arguments.updates


def read(data: Any) -> list[Operation]:
    """Return the operations in a recorded profile, in the order of their starts."""
    planes = [p for p in data.planes if p.name.startswith("/device:GPU")] or list(data.planes)
    found = []
    for line in (line for plane in planes for line in plane.lines):
        if "stream" in line.name.lower() or "XLA" in line.name:
            for event in line.events:
                stats = dict(event.stats)
                own = "hlo_op" in stats and not _HOLDS_OTHERS.fullmatch(event.name)
                if own or "Stream" in line.name:
                    found.append(Operation(event.name, event.start_ns / 1e9, event.duration_ns / 1e9))
    return sorted(found, key=lambda x: x.start)


def busy_seconds(operations: list[Operation]) -> float:
    """Return the time that at least one operation covers."""
    total, end = 0.0, -float("inf")
    for each in operations:
        total += max(each.start + each.seconds - max(each.start, end), 0.0)
        end = max(end, each.start + each.seconds)
    return total


def row(name: str, arguments: argparse.Namespace, operations: list[Operation], seconds: float, rate: float) -> dict:
    """Return an agent's line: times are milliseconds of one update."""
    each = 1e3 / arguments.updates
    products = [x for x in operations if _PRODUCT.search(x.name)]
    flops = count_flops(name, arguments)
    return {
        "agent": name,
        "seeds": arguments.seeds,
        "ms an update": round(seconds * each, 4),
        "operations": round(len(operations) / arguments.updates, 1),
        "busy ms": round(busy_seconds(operations) * each, 4),
        "products": round(len(products) / arguments.updates, 1),
        "products ms": round(sum(x.seconds for x in products) * each, 4),
        "GFLOP": round(flops / 1e9, 3),
        "share of rate": round(flops * arguments.updates / seconds / rate, 4),
        "rate TFLOP/s": round(rate / 1e12, 2),
    }


def count_flops(name: str, arguments: argparse.Namespace) -> float:
    """Return XLA's count of floating-point operations in one update of all seeds."""
    agent = mtjax.agent(name, hidden=arguments.hidden)
    tasks, window = tasks_of(arguments.tasks), random_window(SPEC, arguments.tasks, arguments.batch)
    state = jax.eval_shape(lambda: agent.init(SPEC, tasks, jax.random.key(0)))
    update = jax.jit(lambda state, key: agent.update(state, window, tasks, key, jnp.int32(0)))
    key = jax.eval_shape(lambda: jax.random.key(0))
    found = update.lower(state, key).compile().cost_analysis()
    return float(found["flops"]) * arguments.seeds  # type: ignore


def slowest(operations: list[Operation], arguments: argparse.Namespace) -> str:
    """Return a table of the kinds of operations that take longest; numbers at the ends of names are left out."""
    times, counts = defaultdict(float), Counter()
    for each in operations:
        kind = re.sub(r"[._]\d+", "", each.name)[:70]
        times[kind] += each.seconds
        counts[kind] += 1
    total = sum(times.values())
    lines = [
        [kind, f"{counts[kind] / arguments.updates:.1f}", f"{1e3 * x / arguments.updates:.4f}", f"{x / total:.0%}"]
        for kind, x in sorted(times.items(), key=lambda item: -item[1])[: arguments.top]
    ]
    return markdown(["operation", "an update", "ms an update", "share"], lines)


if __name__ == "__main__":
    run_main(main)
