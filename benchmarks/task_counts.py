"""Measure whether default flags learn as well with one task as with hundreds.

    python benchmarks/task_counts.py [--family=NAME] ... [--tasks 1 2 10 50 200] [--agent=ppo] [--seconds=60]
                                     [--gpus=2] [--out DIR] [NAME=VALUE ...]

Every number of tasks of every family is a process of its own, which trains for so many seconds (compiling and
evaluating do not count), evaluates six times, and writes ``OUT/FAMILY-TASKS-AGENT.json``. A part that is written is not
run again. With ``--seconds=0`` a run takes ``--steps`` environment steps, summed over tasks, as on a CPU, where seconds
depend on what else runs there. Of two processes that share a GPU one compiles while the other trains alone, as training
holds a lock. Further words replace settings of the preset: ``num_envs=2048 minibatches=32 hidden=[256,256]``;
``--name`` tells such runs apart.

The table has the last evaluation's mean return over the training tasks, and the steps, by family and number of tasks.
"""

import argparse
import contextlib
import dataclasses
import fcntl
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

from report import machine, markdown, run_main
from returns import value

from mtjax.config import configure, with_preset
from mtjax.names import replacing
from mtjax.training.programs import enable_compile_cache
from mtjax.training.run import train


class Range(NamedTuple):
    """Holds what varies between the tasks of a family; a single task is the family without it."""

    parameter: str
    low: float
    high: float


FAMILIES: dict[str, Range | None] = {
    "finger-spin": Range("size", 0.95, 1.13),
    "cheetah-run": Range("torso-length", 0.5, 1.4),
    "walker-walk": Range("friction", 0.7, 1.6),
    "cartpole-swingup": Range("pole-mass", 0.1, 0.55),
    "reacher-vary-goal": Range("target-angle", -2, 2),
    "point-mass-vary-goal": None,  # a goal for each task, drawn at random
}
_CALIBRATION = 6.0  # seconds of training that tell how many steps --seconds are
_GPU = "MTJAX_TASK_COUNTS_GPU"  # tells a part which GPU it shares


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", action="append", choices=list(FAMILIES), metavar="NAME", help="by default all")
    parser.add_argument("--tasks", type=int, nargs="+", default=[1, 2, 10, 50, 200])
    parser.add_argument("--agent", default="ppo")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--seconds", type=float, default=60.0, help="of training; 0 takes --steps instead")
    parser.add_argument("--steps", type=lambda x: int(float(x)), default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluations", type=int, default=6)
    parser.add_argument("--gpus", type=int, default=1)
    parser.add_argument("--processes", type=int, default=2, help="at a time, on each GPU")
    parser.add_argument("--name", default="")
    parser.add_argument("--out", type=Path, default=Path("runs") / "task-counts")
    parser.add_argument("--part", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("given", nargs="*", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    parts = [(family, tasks) for tasks in arguments.tasks for family in arguments.family or FAMILIES]
    if arguments.part:
        measure(arguments, *parts[0])
    else:
        run_parts(arguments, [part for part in parts if not file_of(arguments, *part).exists()])
        print(table(arguments.out))


def file_of(arguments: argparse.Namespace, family: str, tasks: int) -> Path:
    """Return the file of a part's results."""
    words = [family, str(tasks), arguments.agent, arguments.name, f"seed-{arguments.seed}"]
    return arguments.out / ("-".join(filter(None, words)) + ".json")


def run_parts(arguments: argparse.Namespace, parts: list[tuple[str, int]]) -> None:
    """Run each part in a process of its own, several at a time."""
    slots: Queue[int] = Queue()
    for slot in range(arguments.gpus * arguments.processes):
        slots.put(slot)
    kept = ("agent", "preset", "seconds", "steps", "seed", "evaluations", "name", "out")
    options = [f"--{name}={getattr(arguments, name)}" for name in kept]

    def run(part: tuple[str, int]) -> None:
        slot = slots.get()
        gpu, file = str(slot % arguments.gpus), file_of(arguments, *part)
        own = {_GPU: gpu, "XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / arguments.processes:.2f}"}
        own |= {"CUDA_VISIBLE_DEVICES": gpu} if arguments.gpus > 1 else {}
        command = [sys.executable, __file__, "--part", f"--family={part[0]}", f"--tasks={part[1]}", *options]
        with file.with_suffix(".log").open("w") as log:
            subprocess.run([*command, *arguments.given], env=os.environ | own, stdout=log, stderr=log, check=False)
        print(file.with_suffix(".log").read_text().strip().rpartition("\n")[2], flush=True)
        slots.put(slot)

    with ThreadPoolExecutor(arguments.gpus * arguments.processes) as pool:
        list(pool.map(run, parts))


@contextlib.contextmanager
def alone(place: Path):
    """Hold the GPU's lock, so that one process trains at a time."""
    with (place / f"gpu-{os.environ.get(_GPU, 0)}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def measure(arguments: argparse.Namespace, name: str, tasks: int) -> None:
    """Train on so many tasks of a family, and write what it earned."""
    enable_compile_cache()
    config = with_preset(name, arguments.agent, arguments.preset, split="none", **tasks_of(name, tasks))
    given = {key: value(x) for key, x in (word.split("=", 1) for word in arguments.given)}
    agent, played = configure(config.learner, config.training, given)
    run = lambda **more: train(
        *(config.family, agent), seed=arguments.seed, settings=played, eval_episodes=max(1, 20 // tasks), **more
    )
    chunk = played.chunk_steps * played.num_envs * tasks
    begun = time.monotonic()
    run(steps=chunk)
    compiled = time.monotonic() - begun
    with alone(arguments.out):
        steps = arguments.steps
        if arguments.seconds:
            enough = lambda row: float(row["seconds"]) > _CALIBRATION
            tried = run(steps=10**14, eval_every=10**15, on_chunk=enough)
            learned = [float(row["seconds"]) for row in tried.rows]
            steps = round(arguments.seconds * chunk * (len(learned) - 1) / (learned[-1] - learned[0]))
        result = run(steps=steps, eval_every=-(-steps // arguments.evaluations))
    returns = result.evaluations.returns["train"].mean(axis=(0, 2, 3))
    record = {
        "family": name,
        "tasks": tasks,
        "agent": arguments.agent,
        "name": arguments.name,
        "given": given,
        "seed": arguments.seed,
        "worlds": played.num_envs * tasks,
        "steps": [int(x) for x in result.evaluations.steps],
        "returns": [round(float(x), 1) for x in returns],
        "worst_task": round(float(result.evaluations.returns["train"][:, -1].mean(axis=(0, 2)).min()), 1),
        "seconds": round(result.seconds, 1),
        "steps_per_second": round(int(result.evaluations.steps[-1]) / result.seconds),
        "compile_seconds": round(compiled, 1),
        "settings": dataclasses.asdict(played),
        "learner": str(agent),
        "machine": machine(),
    }
    with replacing(file_of(arguments, name, tasks)) as new:
        new.write_text(json.dumps(record, indent=1, default=str) + "\n")
    kept = ("family", "tasks", "name", "worlds", "seconds", "steps_per_second", "compile_seconds", "returns")
    print(json.dumps({key: record[key] for key in kept}), flush=True)


def tasks_of(name: str, count: int) -> dict[str, Any]:
    """Return the settings of a family with so many tasks."""
    varied = FAMILIES[name]
    if varied is None:
        return {"num_tasks": count}
    if count > 1:
        return {"vary": {varied.parameter: f"{varied.low}:{varied.high}:{count}"}}
    return {"vary": {"target-angle": "1"}} if name == "reacher-vary-goal" else {}


def table(out: Path) -> str:
    """Return the table of all parts: a row for each family and setting, a column for each number of tasks."""
    records = [json.loads(path.read_text()) for path in sorted(out.glob("*.json"))]
    counts = sorted({record["tasks"] for record in records})
    rows: dict[tuple, dict[int, str]] = {}
    for record in records:
        row = rows.setdefault((record["family"], record["agent"], record["name"]), {})
        row[record["tasks"]] = f"{record['returns'][-1]:.0f} ({record['steps'][-1] / 1e6:.1f}M)"
    body = [[*key, *(row.get(count, "") for count in counts)] for key, row in rows.items()]
    return markdown(["family", "agent", "settings", *(f"T = {count}" for count in counts)], body)


if __name__ == "__main__":
    run_main(main)
