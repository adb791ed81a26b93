"""Measure the training loop with more tasks, environments, seeds or devices, one axis at a time.

    python benchmarks/scaling.py [--axes tasks envs seeds devices] [--agent NAME] [--within N] [--out DIR] [--plots DIR]

    tasks     at equal total environments and batch
    envs      environments over 8 tasks, with the same updates a step
    seeds     in one program, the same steps of each
    devices   with 40 seeds, which they share; up to as many as there are

Every setting is timed in a process of its own, right after the axis's base setting (10 tasks; the fewest environments;
1 seed; 1 device) in the same process, in turn, round after round, so that other load on the machine affects both.
"cost" is the time of a step of every environment beside the base, as the median of each round's ratio. Settings are the
preset's of this device but for what the axis says and a warm-up of one step; no episode ends while timing.

A process writes ``OUT/AXIS-VALUE.json``; the same command with the same OUT runs those that have none yet. ``table.md``
and, with ``--plots``, figures are of all results in OUT. ``--json`` writes all rows to one file.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import parts
from report import markdown, record, run_main, texts_of

from mtjax.names import InputError

# Values on a CPU, and on a GPU.
AXES = {
    "tasks": ((1, 10, 200), (1, 10, 100, 1000)),
    "envs": ((64, 512, 4096), (64, 512, 4096, 16_384, 65_536)),
    "seeds": ((1, 2, 4), (1, 2, 5, 10, 20, 50)),
    "devices": ((1, 2, 4), (1, 2, 4, 8)),
}
BASE = {"tasks": 10, "envs": 64, "seeds": 1, "devices": 1}
_TASKS, _SEEDS = 8, 40  # of the axes of environments and of devices
_SLOTS = 16  # steps of every environment that a ring holds at least


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", default=list(AXES), choices=AXES)
    parser.add_argument("--env", default="finger-spin-vary-size")
    parser.add_argument("--parameter", default="size=0.95:1.13", help="what tasks differ in, and from where to where")
    parser.add_argument("--agent", default="sac-conditioned")
    parser.add_argument("--on", choices=["gpu", "cpu"], help="whose values and sizes to take; by default this device's")
    parser.add_argument("--worlds", type=int, help="environments, over all tasks; by default 4000, on a CPU 200")
    parser.add_argument("--batch", type=int, help="transitions, over all tasks; by default 4000, on a CPU 400")
    parser.add_argument("--steps", type=int, default=100, help="steps of every environment in a timed chunk")
    parser.add_argument("--repeats", type=int, default=5, help="rounds")
    parser.add_argument("--out", type=Path, default=parts.dated("scaling"))
    parser.add_argument("--json", help="write the figures to this file too")
    parser.add_argument("--plots", type=Path, help="draw scaling-AXIS.png into this folder")
    parser.add_argument("--part", nargs=2, metavar=("AXIS", "VALUE"), help="time this setting in this process")
    parts.add_flags(parser)
    arguments = parser.parse_args()
    kind, count = (arguments.on, 0) if arguments.part else devices()
    arguments.on = arguments.on or kind
    arguments.worlds = arguments.worlds or (4000 if arguments.on == "gpu" else 200)
    arguments.batch = arguments.batch or (4000 if arguments.on == "gpu" else 400)
    if arguments.part:
        measure(arguments, arguments.part[0], int(arguments.part[1]))
        return
    of_all = [part(*each, arguments) for each in settings(arguments, count)]
    left = parts.run_parts(__file__, of_all, arguments.out, arguments)
    parts.end(tabulate(arguments), arguments.out, left)


def settings(arguments: argparse.Namespace, count: int) -> list[tuple[str, int]]:
    """Return axes with their values, up to ``count`` devices, the base first: others are timed beside it."""
    values = [(axis, value) for axis in arguments.axes for value in AXES[axis][arguments.on == "gpu"]]
    return [(axis, value) for axis, value in values if axis != "devices" or value <= count]


def devices() -> tuple[str, int]:
    """Return "gpu" or "cpu", and how many, as a process of its own finds, so that this one does not hold them."""
    code = "import jax; print(jax.default_backend(), jax.device_count())"
    asked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    kind, count = asked.stdout.split()
    return "gpu" if kind == "gpu" else "cpu", int(count)


def part(axis: str, value: int, arguments: argparse.Namespace) -> parts.Part:
    words = [*sys.argv[1:], "--on", arguments.on, "--out", str(arguments.out), "--part", axis, str(value)]
    return parts.Part(f"{axis}-{value}", words)


def measure(arguments: argparse.Namespace, axis: str, value: int) -> None:
    """Time one setting beside its axis's base, and write its row."""
    import jax

    if axis == "devices" and value > jax.device_count():
        raise InputError(f"this process sees {jax.device_count()} of {value} devices")
    base = contestant(axis, BASE[axis], arguments)
    own = base if value == BASE[axis] else contestant(axis, value, arguments)
    for _ in range(arguments.repeats):
        base.time()
        if own is not base:
            own.time()
    result = record(arguments, {"rows": [row(axis, value, own, base)]})
    parts.write_result(arguments.out / f"{axis}-{value}.json", result)


def contestant(axis: str, value: int, arguments: argparse.Namespace) -> Any:
    """Return the training loop at one setting."""
    from training import Training

    import mtjax
    from mtjax.config import configure

    num_tasks = {"tasks": value, "envs": _TASKS}.get(axis, 10)
    worlds = value if axis == "envs" else arguments.worlds
    seeds = {"seeds": value, "devices": _SEEDS}.get(axis, 1)
    ((name, span),) = texts_of([arguments.parameter]).items()
    values = f"{span}:{num_tasks}" if num_tasks > 1 else f"{sum(map(float, span.split(':'))) / 2:g}"
    program = mtjax.preset(arguments.env, arguments.agent, vary={name: values}, split="none")
    experience: Any = program.learner.experience
    num_envs = max(worlds // num_tasks, 1)
    given = {
        "num_envs": num_envs,
        "batch_size": max(arguments.batch // num_tasks, 1),
        "replay_size": max(10 * experience.replay_size // num_tasks, _SLOTS * num_envs),
        "warmup_steps": 1,
        "chunk_steps": arguments.steps,
    }
    agent, settings = configure(program.learner, program.training, given)
    made = Training(program.family, agent, settings, seeds, value if axis == "devices" else 1)  # type: ignore
    print(f"{axis} {value}: compiled in {made.compile_seconds:.1f} s", flush=True)
    return made


def row(axis: str, value: int, training: Any, base: Any) -> dict:
    cost = [own / other for own, other in zip(training.seconds, base.seconds, strict=True)]
    rate = statistics.median(training.rates)
    return {
        "axis": axis,
        "value": value,
        "devices": training.num_devices,
        "worlds": training.worlds,
        "steps_per_second": round(rate),
        "substeps_per_second": round(rate * training.substeps),
        "slowest": round(min(training.rates)),
        "fastest": round(max(training.rates)),
        "updates_per_second": round(training.updates / statistics.median(training.seconds), 1),
        "cost": round(statistics.median(cost), 3),
        "compile_seconds": round(training.compile_seconds, 1),
        "peak_bytes": training.memory(),
    }


def tabulate(arguments: argparse.Namespace) -> str:
    """Return the tables of all results in the folder, and write and draw what was asked for."""
    found = list(parts.read_results(arguments.out))
    rows = [line for result in found for line in result["rows"]]
    tables = []
    for axis in (axis for axis in AXES if any(line["axis"] == axis for line in rows)):
        of_axis = sorted((line for line in rows if line["axis"] == axis), key=lambda line: line["value"])
        tables.append(table(of_axis))
        if arguments.plots:
            draw(arguments.plots / f"scaling-{axis}.png", axis, of_axis)
    if arguments.json:
        machines = [json.loads(text) for text in sorted({json.dumps(result["machine"]) for result in found})]
        kept = {name: value for name, value in vars(arguments).items() if name not in ("json", "plots", "part")}
        report = {"benchmark": os.path.basename(__file__), "machines": machines, "settings": kept, "rows": rows}
        with open(arguments.json, "x") as file:
            json.dump(report, file, indent=2, default=str)
    return "\n\n".join(tables)


def table(rows: list[dict]) -> str:
    head = ["worlds of a seed", "env-steps/s, all seeds", "range", "substeps/s", "updates/s", "cost", "compiled in"]
    cells = lambda row: [
        *(f"{row[name]:,}" for name in ("value", "worlds", "steps_per_second")),
        f"{row['slowest']:,} to {row['fastest']:,}",
        f"{row['substeps_per_second']:,}",
        f"{row['updates_per_second']:,.0f}",
        f"{row['cost']:.2f}",
        f"{row['compile_seconds']:.1f} s",
    ]
    return markdown([rows[0]["axis"], *head], [cells(row) for row in rows])


def draw(path: Path, axis: str, rows: list[dict]) -> None:
    """Draw rate and cost along one axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    values = [row["value"] for row in rows]
    for axes, name, label in zip(
        figure.subplots(1, 2), ("steps_per_second", "cost"), ("env-steps/s, all seeds", "cost of a step"), strict=True
    ):
        axes.plot(values, [row[name] for row in rows], "o-", color="#0072B2")
        axes.set(xscale="log", xlabel=axis, ylabel=label, ylim=(0, None))
        axes.set_xticks(values, [f"{value:,}" for value in values])
        axes.minorticks_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    run_main(main)
