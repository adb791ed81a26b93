"""Measure what policy sketches are worth in the craft world: Andreas et al. 2017, with their ablations.

    python benchmarks/sketches.py [--env=craft-sketched] [--ways NAME ...] [--seeds 10] [--steps N] [--evaluations 10]
                                  [--new-steps N] [--episodes 100] [--training NAME=VALUE ...] [--within SECONDS]
                                  [--devices 0 ...] [--out DIR]

Most ways are the agent ``sketches`` and follow the sketch of their task, so that they see which symbol is due:

- ``modular``: a sub-policy for each symbol, and tasks with short sketches first;
- ``independent``: a policy for each task;
- ``joint``: one policy, which is told its task;
- ``no-curriculum``: as modular, but all tasks count alike from the start;
- ``zero-shot``: as modular, without the family's held-out tasks, which it plays by their sketches alone;
- ``joint-zero-shot``: as joint, told the sketch, without the held-out tasks, which it plays too.

Two ways learn the held-out tasks without their sketches. They are the agent ``options`` with a policy over options for
each task, and for each symbol an option that ends by STOP:

- ``adapted``: the options are the sub-policies of ``OUT/zero-shot.run``, kept as they are, seed by seed;
- ``from-scratch``: the options learn too, and begin anew.

Every way is a process of its own with all seeds in one program, and writes ``OUT/WAY.json`` with the returns (S, V, T)
of all evaluations by split: shares of episodes that made what their task asks for, under drawn actions, as in the
paper. ``OUT/WAY.run`` is its run. Finished ways are not run again; one that was stopped goes on if the same command is
given again. The table has the last evaluation: the mean over tasks, the worst task of each seed, and the mean over
held-out tasks, which are all that the last two ways learn.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import parts
import resumable
from report import markdown, record, run_main, settings_of

import mtjax
from mtjax.compiling.programs import enable_compile_cache
from mtjax.report import stats

_NEW: dict[str, Any] = {"split": "none", "sketched": False, "heads": "disjoint", "conditioning": "none", "gamma": 0.95}
_NEW |= {"endings": "stop", "normalize_observations": False}
_NEW |= {"deliberation_cost": 0.0}  # which teaches to choose options that last, where these stay as they are
SKETCHED: dict[str, dict[str, Any]] = {
    "modular": {"split": "none"},
    "independent": {"split": "none", "sharing": "tasks"},
    "joint": {"split": "none", "sharing": "all", "conditioning": "one-hot"},
    "no-curriculum": {"split": "none", "sampler": "uniform"},
    "zero-shot": {"split": "dense"},
    "joint-zero-shot": {"split": "dense", "sharing": "all", "conditioning": "parameters"},
}
UNSKETCHED: dict[str, dict[str, Any]] = {"adapted": {"keep_options": True, **_NEW}, "from-scratch": _NEW}
WAYS = SKETCHED | UNSKETCHED


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="craft-sketched")
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS), metavar="WAY")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=parts.whole, help="of each seed, summed over tasks; by default the preset's")
    parser.add_argument("--new-steps", type=parts.whole, default=2_000_000, help="of each seed without sketches")
    parser.add_argument("--evaluations", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=100, help="of each task in an evaluation")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of agent, loop and family")
    parser.add_argument("--out", type=Path, default=Path("runs") / "sketches")
    parts.add_flags(parser)
    parts.run_ways(__file__, parser.parse_args(), measure, table, last=UNSKETCHED)


def measure(arguments: argparse.Namespace, way: str) -> None:
    """Learn the tasks, or go on with the run that was stopped, and write the returns of all evaluations."""
    enable_compile_cache()
    folder = arguments.out / f"{way}.run"
    given = WAYS[way] | settings_of(arguments.training)
    given |= new_tasks(arguments, way) if way in UNSKETCHED else {}
    steps = arguments.new_steps if way in UNSKETCHED else arguments.steps
    if steps:
        given |= {"steps": steps, "eval_every": steps // arguments.evaluations}
    result = resumable.train(
        folder,
        arguments.env,
        "options" if way in UNSKETCHED else "sketches",
        seeds=arguments.seeds,
        eval_episodes=arguments.episodes,
        eval_sampled=True,
        quiet=False,
        **given,
    )
    found = result.evaluations
    returns = {split: np.round(x.mean(axis=-1, dtype=np.float64), 4) for split, x in found.returns.items()}
    figures = {
        "way": way,
        "tasks": {split: list(result.env.labels(split)) for split in returns},
        "returns": {split: x.tolist() for split, x in returns.items()},
        **resumable.summary(result),
    }
    parts.write_result(arguments.out / f"{way}.json", record(arguments, figures))


def new_tasks(arguments: argparse.Namespace, way: str) -> dict[str, Any]:
    """Return the settings of a way for the family's held-out tasks, with the run from which it begins."""
    family: Any = mtjax.make(arguments.env)
    given = {"vary": {"goal": ",".join(family.held_out)}, "num_options": len(family.symbols)}
    return given | ({"start": arguments.out / "zero-shot.run"} if way == "adapted" else {})


def table(out: Path) -> str:
    """Return the last returns of all ways that have finished."""
    found = parts.results_of(out, WAYS)
    titles = ["way", "mean", "worst task", "held-out tasks", "million steps", "training s"]
    return markdown(titles, [line(way, result) for way, result in found.items()])


def line(way: str, result: dict[str, Any]) -> list[str]:
    """Return the cells of a way."""
    last = {split: np.array(x)[:, -1] for split, x in result["returns"].items()}
    scores = [last["train"].mean(axis=1), last["train"].min(axis=1)]
    scores += [last["interpolation"].mean(axis=1)] if last["interpolation"].size else []
    cells = [f"{stats.seed_interval(x):.2f}" for x in scores]
    cells = ["-", "-", cells[0]] if way in UNSKETCHED else [*cells, *["-"] * (3 - len(cells))]
    return [f"`{way}`", *cells, f"{result['steps'][-1] / 1e6:.0f}", f"{result['training_seconds']:.0f}"]


if __name__ == "__main__":
    run_main(main)
