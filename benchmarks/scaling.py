"""Measure the training loop with more tasks, environments, seeds or devices, one axis at a time.

    python benchmarks/scaling.py [--axes tasks envs seeds devices] [--agent NAME] [--json FILE] [--plots DIR]

    tasks     at equal total environments and batch
    envs      environments over 8 tasks, with the same updates a step
    seeds     in one program, the same steps of each
    devices   with 40 seeds, which they share

All settings of an axis are compiled first and then timed in turn, round after round, so that other load on the machine
affects all of them. "cost" is the time of a step of every environment beside the axis's base setting (10 tasks; the
fewest environments; 1 seed; 1 device), as the median of each round's ratio. Settings are the preset's of this device
but for what the axis says and a warm-up of one step; no episode ends while timing.
"""

import argparse
import statistics
from pathlib import Path

import jax
from matplotlib.figure import Figure
from report import markdown, publish, run_main
from training import Training

import mtjax
from mtjax.config import RunConfig, configure
from mtjax.envs import Family

_ON_CPU = jax.default_backend() == "cpu"
AXES = {
    "tasks": (1, 10, 200) if _ON_CPU else (1, 2, 5, 10, 20, 50, 100, 200),
    "envs": (64, 512, 4096) if _ON_CPU else (64, 512, 4096, 16_384, 65_536),
    "seeds": (1, 2, 4) if _ON_CPU else (1, 2, 5, 10, 20, 50),
    "devices": (1, 2, 4),
}
BASE = {"tasks": 10, "envs": 64, "seeds": 1, "devices": 1}
_TASKS, _SEEDS = 8, 40  # of the axes of environments and of devices
_SLOTS = 16  # steps of every environment that a ring holds at least


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", default=list(AXES), choices=AXES)
    parser.add_argument("--env", default="finger-spin-vary-size")
    parser.add_argument("--parameter", default="size=0.95:1.13", help="what tasks differ in, and from where to where")
    parser.add_argument("--agent", default="sac-conditioned", choices=list(mtjax.AGENTS))
    parser.add_argument("--worlds", type=int, default=200 if _ON_CPU else 3200, help="environments, over all tasks")
    parser.add_argument("--batch", type=int, default=400 if _ON_CPU else 800, help="transitions, over all tasks")
    parser.add_argument("--steps", type=int, default=100, help="steps of every environment in a timed chunk")
    parser.add_argument("--repeats", type=int, default=5, help="rounds")
    parser.add_argument("--json", help="write the figures to this file too")
    parser.add_argument("--plots", type=Path, help="draw scaling-AXIS.png into this folder")
    arguments = parser.parse_args()
    rows = []
    for axis in arguments.axes:
        values = [value for value in AXES[axis] if axis != "devices" or value <= jax.device_count()]
        if len(values) == 1:
            print(f"{axis}: there is but one")
            continue
        found = along(axis, values, arguments)
        print(table(found), flush=True)
        if arguments.plots:
            draw(arguments.plots / f"scaling-{axis}.png", axis, found)
        rows += found
    publish(arguments, rows)


def along(axis: str, values: list[int], arguments: argparse.Namespace) -> list[dict]:
    """Time all settings of one axis in turn, and return a row for each."""
    contestants = {}
    for value in values:
        contestants[value] = contestant(axis, value, arguments)
        print(f"{axis} {value}: compiled in {contestants[value].compile_seconds:.1f} s", flush=True)
    for _ in range(arguments.repeats):
        for training in contestants.values():
            training.time()
    base = contestants[BASE[axis]]
    return [row(axis, value, training, base) for value, training in contestants.items()]


def contestant(axis: str, value: int, arguments: argparse.Namespace) -> Training:
    """Return the training loop at one setting."""
    num_tasks = {"tasks": value, "envs": _TASKS}.get(axis, 10)
    worlds = value if axis == "envs" else arguments.worlds
    seeds = {"seeds": value, "devices": _SEEDS}.get(axis, 1)
    program = preset(num_tasks, arguments)
    num_envs = max(worlds // num_tasks, 1)
    given = {
        "num_envs": num_envs,
        "batch_size": max(arguments.batch // num_tasks, 1),
        "replay_size": max(10 * program.learner.experience.replay_size // num_tasks, _SLOTS * num_envs),
        "warmup_steps": 1,
        "chunk_steps": arguments.steps,
    }
    agent, settings = configure(program.learner, program.training, given)
    assert isinstance(program.family, Family)
    return Training(program.family, agent, settings, seeds, value if axis == "devices" else 1)


def preset(num_tasks: int, arguments: argparse.Namespace) -> RunConfig:
    name, span = arguments.parameter.split("=", 1)
    middle = sum(map(float, span.split(":"))) / 2
    values = f"{span}:{num_tasks}" if num_tasks > 1 else f"{middle:g}"
    return mtjax.preset(arguments.env, arguments.agent, vary={name: values}, split="none")


def row(axis: str, value: int, training: Training, base: Training) -> dict:
    cost = [own / other for own, other in zip(training.seconds, base.seconds, strict=True)]
    return {
        "axis": axis,
        "value": value,
        "devices": training.num_devices,
        "worlds": training.worlds,
        "steps_per_second": round(statistics.median(training.rates)),
        "slowest": round(min(training.rates)),
        "fastest": round(max(training.rates)),
        "updates_per_second": round(training.updates / statistics.median(training.seconds), 1),
        "cost": round(statistics.median(cost), 3),
        "compile_seconds": round(training.compile_seconds, 1),
        "peak_bytes": training.memory(),
    }


def table(rows: list[dict]) -> str:
    head = ["worlds of a seed", "env-steps/s, all seeds", "range", "updates/s", "cost", "compiled in"]
    cells = lambda row: [
        *(f"{row[name]:,}" for name in ("value", "worlds", "steps_per_second")),
        f"{row['slowest']:,} to {row['fastest']:,}",
        f"{row['updates_per_second']:,.0f}",
        f"{row['cost']:.2f}",
        f"{row['compile_seconds']:.1f} s",
    ]
    return markdown([rows[0]["axis"], *head], [cells(row) for row in rows])


def draw(path: Path, axis: str, rows: list[dict]) -> None:
    """Draw rate and cost along one axis."""
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
