"""Measure whether default flags learn as well with one task as with hundreds.

    python benchmarks/task_counts.py [--family=NAME] ... [--tasks 1 2 10 50 200] [--agent=ppo] [--train-seconds=60]
                                     [--devices 0 0 1 1] [--out DIR] [NAME=VALUE ...]

Every number of tasks of every family is a process of its own, which trains for so many seconds (compiling and
evaluating do not count), evaluates six times, and writes ``OUT/FAMILY-TASKS-AGENT.json``. ``parts.py`` says how an
interrupted table goes on. With ``--train-seconds=0`` a run takes ``--steps`` environment steps, summed over tasks, as
on a CPU, where seconds depend on what else runs there. A GPU that ``--devices`` names twice has two processes: one
compiles while the other trains alone, as training holds a lock. Further words replace settings of the preset:
``num_envs=2048 minibatches=32 hidden=[256,256]``; ``--name`` tells such runs apart.

The table has the last evaluation's mean return over the training tasks, and the steps, by family and number of tasks.
"""

import argparse
import contextlib
import dataclasses
import fcntl
import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import parts
from report import markdown, record, run_main, settings_of

import mtjax
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset


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
_CALIBRATION = 6.0  # seconds of training that tell how many steps --train-seconds are


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", action="append", choices=list(FAMILIES), metavar="NAME", help="by default all")
    parser.add_argument("--tasks", type=int, nargs="+", default=[1, 2, 10, 50, 200])
    parser.add_argument("--agent", default="ppo")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--train-seconds", type=float, default=60.0, help="of training; 0 takes --steps instead")
    parser.add_argument("--steps", type=parts.whole, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluations", type=int, default=6)
    parser.add_argument("--name", default="")
    parser.add_argument("--out", type=Path, default=Path("runs") / "task-counts")
    parts.add_flags(parser)
    parser.add_argument("given", nargs="*", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    every = [(family, tasks) for tasks in arguments.tasks for family in arguments.family or FAMILIES]
    if parts.is_part():
        return measure(arguments, *every[0])
    left = parts.run_parts(__file__, [part(arguments, *each) for each in every], arguments.out, arguments)
    parts.end(table(arguments.out), arguments.out, left)


def part(arguments: argparse.Namespace, family: str, tasks: int) -> parts.Part:
    """Return the part of a family with so many tasks. Processes that share a GPU share its memory."""
    kept = ("agent", "preset", "train_seconds", "steps", "seed", "evaluations", "name", "out")
    options = [f"--{name.replace('_', '-')}={getattr(arguments, name)}" for name in kept]
    words = [f"--family={family}", f"--tasks={tasks}", *options, *arguments.given]
    most = max(map(arguments.devices.count, arguments.devices))
    share = {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / most:.2f}"} if most > 1 else {}
    return parts.Part(name_of(arguments, family, tasks), words, share)


def name_of(arguments: argparse.Namespace, family: str, tasks: int) -> str:
    """Return the name of a part."""
    words = [family, str(tasks), arguments.agent, arguments.name, f"seed-{arguments.seed}"]
    return "-".join(filter(None, words))


@contextlib.contextmanager
def alone(place: Path):
    """Hold the lock of this process's GPU, so that one process trains at a time."""
    device = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    with (place / f"device-{device}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def measure(arguments: argparse.Namespace, name: str, tasks: int) -> None:
    """Train on so many tasks of a family, and write what it earned."""
    enable_compile_cache()
    config = with_preset(name, arguments.agent, arguments.preset, split="none", **tasks_of(name, tasks))
    given = settings_of(arguments.given)
    agent, played = configure(config.learner, config.training, given)
    run = lambda **more: mtjax.train(
        *(config.family, agent),
        **{"seed": arguments.seed, "settings": played, "eval_episodes": max(1, 20 // tasks), "quiet": True, **more},
    )
    chunk = played.chunk_steps * played.num_envs * tasks
    begun = time.monotonic()
    run(steps=chunk)
    compiled = time.monotonic() - begun
    with alone(arguments.out):
        steps = arguments.steps
        if arguments.train_seconds:
            learned: list[float] = []

            def enough(row: dict) -> bool:
                learned.append(float(row["seconds"]))
                return len(learned) > 1 and learned[-1] > _CALIBRATION

            run(steps=10**14, eval_every=10**15, on_chunk=enough)
            steps = round(arguments.train_seconds * chunk * (len(learned) - 1) / (learned[-1] - learned[0]))
        result = run(steps=steps, eval_every=-(-steps // arguments.evaluations))
    returns = result.evaluations.returns["train"].mean(axis=(0, 2, 3))
    figures = {
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
        "played": dataclasses.asdict(played),
        "learner": str(agent),
    }
    parts.write_result(arguments.out / f"{name_of(arguments, name, tasks)}.json", record(arguments, figures))
    kept = ("family", "tasks", "name", "worlds", "seconds", "steps_per_second", "compile_seconds", "returns")
    print({key: figures[key] for key in kept}, flush=True)


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
    found = list(parts.read_results(out))
    counts = sorted({each["tasks"] for each in found})
    rows: dict[tuple, dict[int, str]] = {}
    for each in found:
        row = rows.setdefault((each["family"], each["agent"], each["name"]), {})
        row[each["tasks"]] = f"{each['returns'][-1]:.0f} ({each['steps'][-1] / 1e6:.1f}M)"
    body = [[*key, *(row.get(count, "") for count in counts)] for key, row in rows.items()]
    return markdown(["family", "agent", "settings", *(f"T = {count}" for count in counts)], body)


if __name__ == "__main__":
    run_main(main)
