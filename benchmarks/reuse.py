"""Measure what options that some tasks taught are worth in tasks that were held out.

    python benchmarks/reuse.py [--env=craft] [--tasks plank ...] [--held-out rope ...] [--steps N] [--new-steps N]
                               [--seeds 10] [--training NAME=VALUE ...] [--within SECONDS] [--devices 0 ...] [--out DIR]

First ``options`` and ``ppo`` learn some tasks of a family. Both see a task by its context, and follow no sketch. Then
the held-out tasks, made of the same parts in other orders, are learned in five ways:

- ``kept``: the policy over options learns, and the options stay as they are;
- ``tuned``: all of ``options`` goes on to learn;
- ``scratch``: ``options`` begins anew;
- ``ppo-tuned``, ``ppo``: the same two of PPO.

Seeds are paired: each way begins from the networks of its own seed. Every run is a process of its own with all seeds in
one program, in ``OUT/RUN.run``, and writes ``OUT/RUN.json`` with the returns (S, V) of every evaluation, means over
tasks and episodes. Finished runs are not run again; one that was stopped goes on if the same command is given again.
The table has the return in the first evaluation, in the last, and on average over the evaluations, that is the area
under the curve.
``--training`` replaces settings of both agents, the loop and the family, such as ``num_envs=32``.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import parts
import resumable
from report import markdown, record, run_main, settings_of

from mtjax.compiling.programs import enable_compile_cache
from mtjax.report import stats

_COMMON = {"num_envs": 64, "unroll": 32, "epochs": 2, "minibatches": 4, "gamma": 0.95, "chunk_steps": 3200}
_COMMON |= {"eval_episodes": 16, "split": "none", "quiet": True}
_OF_OPTIONS = {"sampler": "by-length", "least_weight": 0.1}


class Learning(NamedTuple):
    """Holds how an agent learns some tasks."""

    agent: str
    settings: dict[str, Any]
    start: str = ""  # the run from whose networks it begins


TAUGHT = {"taught-options": Learning("options", _OF_OPTIONS), "taught-ppo": Learning("ppo", {})}
WAYS = {
    "kept": Learning("options", {**_OF_OPTIONS, "keep_options": True}, "taught-options"),
    "tuned": Learning("options", _OF_OPTIONS, "taught-options"),
    "scratch": Learning("options", _OF_OPTIONS),
    "ppo-tuned": Learning("ppo", {}, "taught-ppo"),
    "ppo": Learning("ppo", {}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="craft")
    parser.add_argument("--tasks", nargs="+", default=["plank", "stick", "cloth", "bridge"])
    parser.add_argument("--held-out", nargs="+", default=["rope", "bed", "axe", "shears"])
    parser.add_argument("--steps", type=parts.whole, default=15_000_000, help="of each seed on the training tasks")
    parser.add_argument("--new-steps", type=parts.whole, default=8_000_000, help="of each seed on the held-out tasks")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of agents, loop and family")
    parser.add_argument("--out", type=Path, default=Path("runs") / "reuse")
    parser.add_argument("--run", help=argparse.SUPPRESS)
    parts.add_flags(parser)
    arguments = parser.parse_args()
    if parts.is_part():
        return measure(arguments, arguments.run)
    for runs in (TAUGHT, WAYS):
        left = parts.run_parts(__file__, [part(arguments, run) for run in runs], arguments.out, arguments)
        parts.require_all(left)
    parts.end(table(arguments.out), arguments.out, left)


def part(arguments: argparse.Namespace, run: str) -> parts.Part:
    """Return the part of a run."""
    numbers = [f"--{name.replace('_', '-')}={getattr(arguments, name)}" for name in ("steps", "new_steps", "seeds")]
    lists = ["--tasks", *arguments.tasks, "--held-out", *arguments.held_out, "--training", *arguments.training]
    places = [f"--env={arguments.env}", f"--out={arguments.out}", f"--run={run}"]
    return parts.Part(run, [*places, *numbers, *lists])


def measure(arguments: argparse.Namespace, run: str) -> None:
    """Learn the tasks of a run, or go on with it, and write the returns of all evaluations."""
    enable_compile_cache()
    how = (TAUGHT | WAYS)[run]
    goals, steps = (arguments.tasks, arguments.steps) if run in TAUGHT else (arguments.held_out, arguments.new_steps)
    given: dict[str, Any] = (
        _COMMON | how.settings | settings_of(arguments.training) | {"vary": {"goal": ",".join(goals)}}
    )
    given |= {"start": arguments.out / f"{how.start}.run"} if how.start else {}
    folder = arguments.out / f"{run}.run"
    result = resumable.train(folder, arguments.env, how.agent, steps=steps, seeds=arguments.seeds, **given)
    scores = np.float64(result.evaluations.returns["train"]).mean(axis=(2, 3))
    figures = {"run": run, "returns": np.round(scores, 4).tolist(), **resumable.summary(result)}
    parts.write_result(arguments.out / f"{run}.json", record(arguments, figures))


def table(out: Path) -> str:
    """Return the returns of each way, with intervals over seeds, and what it gains on average over ``scratch``."""
    found = {way: np.array(result["returns"]) for way, result in parts.results_of(out, WAYS).items()}
    plain, rows = found["scratch"].mean(axis=1), []
    for way, scores in found.items():
        areas = scores.mean(axis=1)
        gained = stats.paired_difference(areas, plain)
        rows.append(
            [way, *(f"{stats.seed_interval(x):.2f}" for x in (scores[:, 0], scores[:, -1], areas)), f"{gained:+.2f}"]
        )
    return markdown(["way", "at first", "at the end", "on average", "on average, less scratch"], rows)


if __name__ == "__main__":
    run_main(main)
