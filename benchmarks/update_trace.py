"""Measure where an update's time goes on a GPU: its kernels, and the share of the chip's matrix rate.

    python benchmarks/update_trace.py [--agents NAME ...] [--tasks 10] [--seeds 1] [--hidden 400 400 400]
                                      [--pictures 64] [--json FILE]

Updates like those of ``update_cost.py`` run in a scan under JAX's profiler. From its trace are, for one update: the
kernels and their time, of which matrix products, and the time in which no kernel ran. The multiplications and additions
of matrix products and convolutions are counted in the program as it is traced (two for each). Their share is of the
precision that products have by default (``--peak``, TFLOP/s; of an H200, 495 in TF32 without sparsity, by its data
sheet).
"""

import argparse
import collections
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
from jax.extend.core import jaxprs_in_params
from jax.profiler import ProfileData
from report import markdown, publish, run_main
from update_cost import AGENTS, Contestant, seeing

# Parts of the names of kernels that multiply matrices or convolve: cuBLAS's, cuDNN's, CUTLASS's and XLA's by Triton.
_PRODUCTS = ("gemm", "cutlass", "nvjet", "cublas", "conv", "fprop", "dgrad", "wgrad")
# Convolutions, and where their features are among the arrays that they take and give.
_FEATURES = {"conv_general_dilated": 2, "conv_to_pictures": 0, "conv_to_filters": 1}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", default=["sac", "care", "brc"], choices=AGENTS)
    parser.add_argument("--tasks", type=int, default=10)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--batch", type=int, default=128, help="transitions a task")
    parser.add_argument("--hidden", type=int, nargs="+", default=[400, 400, 400])
    parser.add_argument("--pictures", type=int, help="the side of pictures that agents see in place of numbers")
    parser.add_argument("--updates", type=int, default=20, help="in the trace")
    parser.add_argument("--peak", type=float, default=495.0, help="TFLOP/s of the chip")
    parser.add_argument("--kernels", type=int, default=12, help="so many of the longest are printed")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    if jax.default_backend() != "gpu":
        raise SystemExit("error: this needs a GPU, as it reads the times of its kernels")
    rows = [trace(name, arguments) for name in arguments.agents]
    for row in rows:
        print(f"{row['agent']}: the longest kernels")
        lines = [[name, f"{x['microseconds']:.1f}", f"{x['calls']:.1f}"] for name, x in row["kernels"].items()]
        print(markdown(["kernel", "microseconds an update", "calls"], lines[: arguments.kernels]))
    print(table(rows), flush=True)
    publish(arguments, rows)


def trace(name: str, arguments: argparse.Namespace) -> dict:
    """Return the figures of one agent's update."""
    contestant = Contestant(name, arguments, arguments.tasks, arguments.seeds, seeing(arguments.pictures))
    contestant.time()
    flops = matrix_flops(jax.make_jaxpr(contestant.learn)(contestant.state, contestant.keys)) / arguments.updates
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            before = time.perf_counter()
            contestant.time(count=False)
            wall = (time.perf_counter() - before) / arguments.updates
        events = device_events(next(Path(folder).glob("**/*.xplane.pb")))
    plain = contestant.seconds[0]
    kernels = by_name(events, arguments.updates)
    products = sum(x["microseconds"] for name, x in kernels.items() if is_product(name))
    return {
        "agent": name,
        "milliseconds": 1e3 * plain,
        "milliseconds_traced": 1e3 * wall,
        "busy_milliseconds": busy(events) / arguments.updates / 1e6,
        "product_milliseconds": products / 1e3,
        "launches": sum(x["calls"] for x in kernels.values()),
        "gigaflops": flops / 1e9,
        "share_of_peak": flops / plain / (arguments.peak * 1e12),
        "kernels": kernels,
    }


def matrix_flops(program: Any) -> float:
    """Count the multiplications and additions of products and convolutions in a traced program, with its loops."""
    total = 0.0
    for equation in program.eqns:
        name, given = equation.primitive.name, [*equation.invars, *equation.outvars]
        if name in _FEATURES:
            features = math.prod(given[_FEATURES[name]].aval.shape[:-1])
            total += 2 * features * math.prod(equation.params["filters_shape"])
        if name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            depth = math.prod(equation.invars[0].aval.shape[i] for i in contracted)
            total += 2 * depth * math.prod(equation.outvars[0].aval.shape)
        inner = sum(matrix_flops(part) for part in jaxprs_in_params(equation.params))
        total += inner * equation.params.get("length", 1)
    return total


def device_events(file: Path) -> list[tuple[str, float, float]]:
    """Return (name, start, duration) in nanoseconds of all kernels and copies in a trace."""
    planes = [plane for plane in ProfileData.from_file(str(file)).planes if plane.name.startswith("/device:GPU")]
    lines = [line for plane in planes for line in plane.lines if line.name.startswith("Stream")]
    return [(event.name, event.start_ns, event.duration_ns) for line in lines for event in line.events]


def by_name(events: list[tuple[str, float, float]], updates: int) -> dict[str, dict[str, float]]:
    """Return microseconds and calls of each kernel in one update, the longest first."""
    found = collections.defaultdict(list)
    for name, _, duration in events:
        found[name].append(duration / 1e3)
    rows = {name: {"microseconds": sum(x) / updates, "calls": len(x) / updates} for name, x in found.items()}
    return dict(sorted(rows.items(), key=lambda row: -row[1]["microseconds"]))


def is_product(kernel: str) -> bool:
    return any(part in kernel.lower() for part in _PRODUCTS)


def busy(events: list[tuple[str, float, float]]) -> float:
    """Return the nanoseconds in which at least one kernel ran."""
    total, end = 0.0, -math.inf
    for _, start, duration in sorted(events, key=lambda event: event[1]):
        total += max(0.0, start + duration - max(start, end))
        end = max(end, start + duration)
    return total


def table(rows: list[dict]) -> str:
    head = [
        "agent",
        "ms an update",
        "ms with a kernel",
        "ms of products",
        "kernels",
        "GFLOP",
        "share of the matrix rate",
    ]
    cells = lambda row: [
        row["agent"],
        *(f"{row[name]:.3f}" for name in ("milliseconds", "busy_milliseconds", "product_milliseconds")),
        f"{row['launches']:.0f}",
        f"{row['gigaflops']:.1f}",
        f"{row['share_of_peak']:.1%}",
    ]
    return markdown(head, [cells(row) for row in rows])


if __name__ == "__main__":
    run_main(main)
