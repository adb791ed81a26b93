"""Measure ways to remember tasks that are learned one after another, beside each task alone.

    python benchmarks/continual.py [--env=NAME] [--tasks=N] [--each=STEPS] [--methods NAME ...] [--seeds=10]
                                   [--best=RETURN] [--devices 0 ...] [--out DIR] [NAME=VALUE ...]

Every method is a process of its own with all seeds in one program; ``alone`` trains a network for each task from
scratch, for as many steps of it. Seeds are those of the environment too, so that methods are paired. A method is
NAME, or NAME:SETTING=VALUE:..., such as ewc:ewc_coefficient=100. Each part writes ``OUT/METHOD.json`` with the scores
(S, V, N) of every evaluation of all tasks; in its name colons and equals signs are dashes. ``parts.py`` says how an
interrupted table goes on. Further words replace settings of the agent or the loop. Scores are returns divided by
``--best``, or success if that is 0.

The table has performance, forgetting and forward transfer (``mtjax.report.sequences``) with intervals over seeds, and
the paired difference of performance from ``none``.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import parts
from learning import cell
from report import markdown, record, run_main
from returns import value

import mtjax
from mtjax.compiling.programs import enable_compile_cache
from mtjax.report import sequences, stats

_COMMON = {"conditioning": "one-hot", "normalize_observations": False}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="point-mass-vary-goal")
    parser.add_argument("--agent", default="sac")
    parser.add_argument("--tasks", type=int, default=4)
    parser.add_argument("--each", type=int, default=2000, help="steps of every environment for each task")
    parser.add_argument("--evaluations", type=int, default=4, help="during each task")
    parser.add_argument("--episodes", type=int, default=4, help="of each task in an evaluation")
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--methods", nargs="+", default=["alone", "none", "l2", "ewc", "mas", "packnet"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--best", type=float, default=100.0, help="return that is the score 1; 0 takes success")
    parser.add_argument("--out", type=Path, default=Path("runs") / "continual")
    parts.add_flags(parser)
    parser.add_argument("given", nargs="*", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    if parts.is_part():
        return measure(arguments, arguments.methods[0])
    left = parts.run_parts(__file__, [part(arguments, x) for x in arguments.methods], arguments.out, arguments)
    print(table(arguments.out))
    parts.require_all(left)


def part(arguments: argparse.Namespace, method: str) -> parts.Part:
    """Return the part of a method."""
    kept = ("env", "agent", "tasks", "each", "evaluations", "episodes", "envs", "seeds", "best", "out")
    options = [f"--{name}={getattr(arguments, name)}" for name in kept]
    return parts.Part(name_of(method), [*options, f"--methods={method}", "--", *arguments.given])


def name_of(method: str) -> str:
    """Return the name of a method's part, which is that of a file."""
    return method.replace(":", "-").replace("=", "-")


def measure(arguments: argparse.Namespace, method: str) -> None:
    """Learn the tasks by a method, and write the scores of every evaluation."""
    enable_compile_cache()
    chunk, tasks = arguments.each // arguments.evaluations, arguments.tasks
    name, *words = method.split(":")
    given = {key: value(x) for key, x in (word.split("=", 1) for word in [*arguments.given, *words])}
    alone = name == "alone"
    how: dict[str, Any] = {"heads": "disjoint"} if alone else {"continual": name}
    how |= {} if alone else {"curriculum": f"sequence:{arguments.each}"}
    played = {"num_tasks": tasks, "num_envs": arguments.envs, "chunk_steps": chunk, "seeds": arguments.seeds}
    played |= {"steps": tasks * arguments.each * arguments.envs, "split": "none", "quiet": True}
    played |= {"eval_every": chunk * arguments.envs * (tasks if alone else 1), "eval_episodes": arguments.episodes}
    result = mtjax.train(arguments.env, arguments.agent, **{**_COMMON, **how, **played, **given})
    found = result.evaluations
    scores = found.returns["train"] / arguments.best if arguments.best else found.metrics["success"]["train"]
    figures = {
        "method": method,
        "scores": np.round(np.float64(scores.mean(axis=-1)), 5).tolist(),
        "steps": found.steps.tolist(),
        "seconds": round(result.total_seconds, 1),
        "learner": str(result.agent),
    }
    parts.write_result(arguments.out / f"{name_of(method)}.json", record(arguments, figures))


def table(out: Path) -> str:
    """Return the measures of all methods that have finished."""
    found = {x["method"]: np.array(x["scores"]) for x in parts.read_results(out)}
    alone = found.pop("alone", None)
    rows = []
    for method, scores in found.items():
        spans = sequences.spans_of(scores.shape[1], scores.shape[2])
        performance, lost = sequences.performance(scores), sequences.forgetting(scores, spans)[:, :-1]
        transfer, against = "-", "-"
        if alone is not None and len(alone) == len(scores):
            gained = sequences.forward_transfer(sequences.areas(scores, spans), alone.mean(axis=1))
            transfer = cell(stats.seed_interval(gained.mean(axis=1)), ".2f")
        plain = found.get("none")
        if plain is not None and method != "none" and len(plain) == len(scores):
            against = cell(stats.paired_difference(performance, sequences.performance(plain)), ".2f")
        own = [cell(stats.seed_interval(x), ".2f") for x in (performance, lost)]
        rows.append([method, *own, transfer, against])
    return markdown(["method", "performance", "forgetting", "forward transfer", "performance less none's"], rows)


if __name__ == "__main__":
    run_main(main)
