"""How well and how fast agents learn a family: every agent, many seeds in one program each.

    python benchmarks/learning.py [--env NAME] [--agents NAME ...] [--seeds 10] [--steps N] [--out DIR]

Writes, into a new folder: ``metrics.csv`` (training returns over steps and seconds, a line a chunk and seed),
``evaluations.csv`` (each evaluation by split, a line a seed), ``learning.png`` and ``table.md``. Intervals
are 95% bootstrap intervals over seeds. "Seconds to 900" is training time, without compiling and evaluating, until the
training policy's mean return over tasks (and seeds) first reaches 900.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import mtjax
from mtjax import plot
from mtjax.log import append_rows
from mtjax.run import Result, enable_compile_cache
from mtjax.stats import seed_interval
from mtjax.types import InputError

MARKS = (700, 800, 900, 950)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="finger-spin-vary-size")
    parser.add_argument("--agents", nargs="+", default=list(mtjax.AGENTS))
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, help="by default the preset's")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--eval-every", type=int, default=0)
    parser.add_argument("--eval-episodes", type=int, default=10)
    parser.add_argument("--vary", nargs="*", default=[], metavar="NAME=VALUES", help="besides what the family varies")
    parser.add_argument("--out", type=Path, default=Path("runs") / f"learning-{time.strftime('%Y%m%d-%H%M%S')}")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True)
    enable_compile_cache()
    lines = [heading()]
    curves = {}
    for name in arguments.agents:
        result, wall = learn(arguments, name)
        curves[name] = (result.evaluations.steps, result.evaluations.returns["train"])
        lines.append(row(name, result, wall))
        print(lines[-1], flush=True)
        save(arguments.out, name, result)
        plot.compare(arguments.out / f"after-{name}.png", curves)
    table = "\n".join(lines)
    (arguments.out / "table.md").write_text(table + "\n")
    (arguments.out / f"after-{arguments.agents[-1]}.png").rename(arguments.out / "learning.png")
    for path in arguments.out.glob("after-*.png"):
        path.unlink()
    print(table)


def learn(arguments: argparse.Namespace, name: str) -> tuple[Result, float]:
    """Train one agent with its preset; returns the result and the seconds it took in all."""
    vary = dict(pair.split("=", 1) for pair in arguments.vary)
    program = mtjax.preset(arguments.env, name, arguments.preset, vary=vary)
    before = time.monotonic()
    result = mtjax.train(
        program.family,
        program.learner,
        steps=arguments.steps or program.plan.steps,
        seeds=arguments.seeds,
        seed=arguments.seed,
        eval_every=arguments.eval_every,
        eval_episodes=arguments.eval_episodes,
        settings=program.training,
        quiet=False,
    )
    return result, time.monotonic() - before


def save(folder: Path, name: str, result: Result) -> None:
    """Append the curves of one agent to the folder's files."""
    kept = ("seed", "steps", "seconds", "wall_seconds", "return")
    append_rows(folder / "metrics.csv", [{"agent": name} | {k: r[k] for k in kept} for r in result.rows])
    rows = []
    for split, returns in result.evaluations.returns.items():
        for s, of_seed in enumerate(returns.mean(axis=(-1, -2)) if returns.size else []):
            for steps, score in zip(result.evaluations.steps, of_seed, strict=True):
                rows.append({"agent": name, "seed": s, "split": split, "steps": int(steps), "return": f"{score:.2f}"})
    append_rows(folder / "evaluations.csv", rows)


def heading() -> str:
    marks = [f"s to {mark}" for mark in MARKS]
    cells = [
        "agent",
        "train",
        "interpolation",
        "extrapolation",
        "worst task",
        *marks,
        "training s",
        "wall s",
        "steps/s",
    ]
    return "| " + " | ".join(cells) + " |\n|" + "---|" * len(cells)


def row(name: str, result: Result, wall: float) -> str:
    """One agent's line: last evaluation by split, times, rate."""
    scores = {split: x[:, -1].mean(axis=-1) for split, x in result.evaluations.returns.items() if x.size}  # (S, T)
    cells = [name]
    for split in ("train", "interpolation", "extrapolation"):
        point, low, high = seed_interval(scores[split])
        cells.append(f"{point:.0f} [{low:.0f}, {high:.0f}]")
    cells.append(f"{scores['train'].mean(axis=0).min():.0f}")
    cells += [seconds_to(result, mark) for mark in MARKS]
    steps = int(result.rows[-1]["steps"]) * len(scores["train"])
    return "| " + " | ".join([*cells, f"{result.seconds:.1f}", f"{wall:.0f}", f"{steps / result.seconds:,.0f}"]) + " |"


def seconds_to(result: Result, mark: float) -> str:
    """Training seconds until the mean over tasks and seeds of the training return first reached a mark."""
    by_step: dict[int, list[tuple[float, float]]] = {}
    for line in result.rows:
        if line["return"] != "":
            by_step.setdefault(int(line["steps"]), []).append((float(line["seconds"]), float(line["return"])))
    for points in by_step.values():
        seconds, returns = np.mean(points, axis=0)
        if returns >= mark:
            return f"{seconds:.1f}"
    return "-"


if __name__ == "__main__":
    try:
        main()
    except (InputError, FileExistsError) as error:
        raise SystemExit(f"error: {error}") from None
