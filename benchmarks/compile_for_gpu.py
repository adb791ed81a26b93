"""Compile the update of every agent with a replay for an H200, on a machine without one: seconds, kernels and bytes.

    pip install 'jax[cuda13]'
    python benchmarks/compile_for_gpu.py [--agents NAME ...] [--tasks 4] [--seeds 10] [--hidden 256 256]
                                         [--pictures 64] [--json FILE]

XLA compiles for a GPU that it is told of (``_H200``), so that slow compiling and odd kernels are found without one. It
cannot try kernels out, which takes more time on a GPU. So matrix products are cuBLAS's here, not XLA's own.

"kernels" are those of one update, "MB" what they read and write by their shapes. "numbers a thread" is the most that a
thread of one of XLA's tiled kernels holds at once. Above some 200 it has no registers for them: the kernel is slow, and
slow to compile. With ``--pictures`` agents see stacks of three square pictures of this side. Then "convolutions" are
those of one update, and "window" is the side of the largest window of one: 3 is a layer's, and one as large as a
picture has no fast kernel.
"""

import argparse
import math
import os
import re
import time
from typing import Any

os.environ["JAX_PLATFORMS"] = "cpu"  # where the script itself computes
os.environ["XLA_FLAGS"] = (
    f"{os.environ.get('XLA_FLAGS', '')} --xla_gpu_autotune_level=0 --xla_gpu_enable_triton_gemm=false"
)

import jax
from jax.experimental import topologies
from jax.sharding import NamedSharding, PartitionSpec
from report import markdown, publish, run_main
from update_cost import AGENTS, random_window, seeing, tasks_of, updates

import mtjax
from mtjax.types import InputError

_H200 = """
gpu_device_info {
  threads_per_block_limit: 1024
  threads_per_warp: 32
  shared_memory_per_block: 49152
  shared_memory_per_core: 233472
  threads_per_core_limit: 2048
  core_count: 132
  fpus_per_core: 128
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  memory_bandwidth: 4800000000000
  l2_cache_size: 62914560
  clock_rate_ghz: 1.98
  device_memory_size: 150000000000
  shared_memory_per_block_optin: 232448
  cuda_compute_capability { major: 9 }
  registers_per_core_limit: 65536
  registers_per_block_limit: 65536
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 10 }
runtime_version { major: 13 minor: 0 patch: 0 }
device_description_str: "NVIDIA H200"
"""
# Of a number; else 4. Those of s8 are the workspaces of cuBLAS, which no agent's data have the type of.
_BYTES = {"pred": 1, "s8": 0, "u8": 1, "f16": 2, "bf16": 2, "f64": 8, "s64": 8, "u64": 8}
_SHAPE = re.compile(r"\b([a-z]+\d*)\[([\d,]*)\]")
_INSTRUCTION = re.compile(r"\s+(?:ROOT )?%([\w.\-]+) = (.+?) ([\w\-]+)\((.*)")
_WINDOW = re.compile(r"custom-call\(.*window=\{size=(\d+)x.*__cudnn\$conv")
_TILED = re.compile(
    r'calls=%([\w.\-]+).*"kind":"__triton",.*"num_warps":"(\d+)","output_tiles":\[\{"sizes":\[([^\]]*)\]'
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", nargs="+", default=AGENTS, choices=AGENTS)
    parser.add_argument("--tasks", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--batch", type=int, default=64, help="transitions a task")
    parser.add_argument("--hidden", type=int, nargs="+", default=[256, 256])
    parser.add_argument("--pictures", type=int, help="the side of pictures that agents see in place of numbers")
    parser.add_argument("--json", help="write the figures to this file too")
    arguments = parser.parse_args()
    place, rows = h200(), []
    for name in arguments.agents:
        rows.append(measure(name, arguments, place))
        print(rows[-1], flush=True)
    print(table(rows), flush=True)
    publish(arguments, rows)


def h200() -> NamedSharding:
    """Return the place of arrays on an H200 that need not be there."""
    try:
        described = topologies.get_topology_desc(platform="cuda", target_config=_H200, topology="1x1x1")
    except Exception as error:  # without the plugin, whatever JAX raises
        raise InputError(f"cannot compile for a GPU: {error}; pip install 'jax[cuda13]'") from None
    return NamedSharding(topologies.make_mesh(described, (1,), ("device",)), PartitionSpec())


def measure(name: str, arguments: argparse.Namespace, place: NamedSharding) -> dict:
    """Compile two updates in a scan, for all seeds."""
    agent, tasks = mtjax.agent(name, hidden=arguments.hidden), tasks_of(arguments.tasks)
    spec = seeing(arguments.pictures)
    window = random_window(spec, arguments.tasks, arguments.batch)
    seeds = jax.numpy.arange(arguments.seeds, dtype=jax.numpy.uint32)
    state = jax.eval_shape(jax.vmap(lambda seed: agent.init(spec, tasks, jax.random.key(seed))), seeds)

    def learn(state: Any, seeds: Any, window: Any, tasks: Any) -> Any:
        return updates(agent, tasks, window, 2)(state, jax.vmap(jax.random.key)(seeds))

    there = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place)
    given = jax.tree.map(there, (state, seeds, window, tasks))
    lowered = jax.jit(learn, out_shardings=place).trace(*given).lower(lowering_platforms=("cuda",))
    before = time.perf_counter()
    text = lowered.compile().as_text() or ""
    seconds = time.perf_counter() - before
    touched, windows = kernels(text), [int(side) for side in _WINDOW.findall(text)]
    return {
        "agent": name,
        "compile_seconds": round(seconds, 1),
        "kernels": len(touched),
        "megabytes": round(sum(touched) / 1e6, 1),
        "numbers_a_thread": numbers_a_thread(text),
        **({"convolutions": len(windows), "window": max(windows, default=0)} if arguments.pictures else {}),
    }


def kernels(text: str) -> list[float]:
    """Return the bytes that each kernel of an update reads and writes: of the loop with the most instructions."""
    bodies = set(re.findall(r"body=%([\w.\-]+)", text))
    loops = [body for name, body in computations(text).items() if name in bodies]
    shapes, touched = {}, []
    for line in max(loops, key=len).splitlines():
        if found := _INSTRUCTION.match(line):
            name, shape, operation, rest = found.groups()
            shapes[name] = shape
            if operation in ("fusion", "custom-call", "copy"):
                read = re.findall(r"%([\w.\-]+)", rest.split("), ")[0])
                touched.append(sum(map(num_bytes, [shape, *(shapes.get(x, "") for x in read)])))
    return touched


def numbers_a_thread(text: str) -> int:
    """Return the most numbers that a thread of a tiled kernel holds at once."""
    bodies, most = computations(text), 0
    for line in text.splitlines():
        if found := _TILED.search(line):
            name, warps, tile = found.groups()
            sizes = [math.prod(of) for _, of in shapes_in(bodies[name])]
            out = shapes_in(line)[0][1]
            blocks = math.prod(-(-n // t) for n, t in zip(out, map(int, re.findall(r"\d+", tile)), strict=True))
            most = max(most, round(max(sizes) / blocks / (32 * int(warps))))
    return most


def computations(text: str) -> dict[str, str]:
    """Return the computations of a compiled program by name."""
    return {x[1]: x[0] for x in re.finditer(r"^(?:ENTRY )?%([\w.\-]+) \(.*?^}", text, re.DOTALL | re.MULTILINE)}


def shapes_in(text: str) -> list[tuple[str, list[int]]]:
    return [(kind, [int(n) for n in sizes.split(",") if n]) for kind, sizes in _SHAPE.findall(text)]


def num_bytes(text: str) -> float:
    return sum(_BYTES.get(kind, 4) * math.prod(sizes) for kind, sizes in shapes_in(text))


def table(rows: list[dict]) -> str:
    head = ["agent", "compiled in", "kernels", "MB", "numbers a thread", "convolutions", "window"]
    return markdown(head[: len(rows[0])], [[*map(str, row.values())] for row in rows])


if __name__ == "__main__":
    run_main(main)
