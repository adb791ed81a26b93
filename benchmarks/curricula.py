"""Measure what curricula gain: twenty tasks played all at once, or four at a time, for as many steps by as many worlds.

    python benchmarks/curricula.py [--family sailing|racing] [--ways all random progress hardest growing] [--played 4]
                                   [--every STEPS] [--seeds 10] [--steps N] [--evaluations 8] [--episodes 2]
                                   [--training NAME=VALUE ...] [--within SECONDS] [--devices 0 ...] [--out DIR]

PPO learns to sail in twenty winds, from ahead, where a boat must tack, to behind; or to drive on twenty tracks. Each
way but ``all`` plays ``--played`` tasks, chosen anew after ``--every`` steps of every environment. A seed has as many
worlds in all ways, so that each of few tasks has more. Evaluations are of all tasks.

Every way is a process of its own with all seeds in one program, and writes ``OUT/WAY.json`` with the returns (S, V) of
all evaluations, means over tasks and episodes, those of each task (S, N) in the last one, and in how many chunks (N,)
a return of each task was known. Seeds are those of the environment too, so that ways are paired; but a choice by
returns is one for all seeds. Finished ways are not run again; one that was stopped goes on from ``OUT/WAY.run`` if the
same command is given again.

The table has the return of the last evaluation and the mean over all, that is the area under the curve, with intervals
over seeds, and the paired differences of both from ``all`` and from ``random``.
"""

import argparse
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import parts
import resumable
from report import difference, markdown, record, run_main, settings_of

from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.report import stats

WAYS = ("all", "random", "progress", "hardest", "growing")
TASKS = WORLDS = 20  # of a seed
FAMILIES = {"sailing": ("wind-direction", f"0:3.14:{TASKS}"), "racing": ("track", f"0:{TASKS - 1}:{TASKS}")}
_ENOUGH = {"sailing": 10, "racing": 90}  # returns with which a range grows: the mark's prize, and metres of a lap
_SETTINGS = {"hidden": (64, 64), "unroll": 64, "epochs": 4}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", default="sailing", choices=list(FAMILIES))
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=WAYS, metavar="WAY")
    parser.add_argument("--played", type=int, default=4, choices=(2, 4, 5, 10), help="tasks at a time")
    parser.add_argument("--every", type=int, default=640, help="steps of every environment until tasks are chosen")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=parts.whole, default=409_600, help="of each seed, summed over tasks")
    parser.add_argument("--evaluations", type=int, default=8)
    parser.add_argument("--episodes", type=int, default=2, help="of each task in an evaluation")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    parser.add_argument("--out", type=Path, default=Path("runs") / "curricula")
    parts.add_flags(parser)
    parts.run_ways(__file__, parser.parse_args(), measure, table)


def measure(arguments: argparse.Namespace, way: str) -> None:
    """Learn the tasks, or go on with the run that was stopped, and write the returns of all evaluations."""
    enable_compile_cache()
    plain = with_preset(arguments.family, "ppo", vary=dict([FAMILIES[arguments.family]]), combine="grid", split="none")
    given = {**_SETTINGS, **plays(arguments, way), **settings_of(arguments.training)}
    agent, settings = configure(plain.learner, plain.training, given)
    folder = arguments.out / f"{way}.run"
    result = resumable.train(
        folder,
        plain.family,
        agent,
        settings=settings,
        steps=arguments.steps,
        seeds=arguments.seeds,
        eval_every=arguments.steps // arguments.evaluations,
        eval_episodes=arguments.episodes,
    )
    returns = result.evaluations.returns["train"].mean(axis=3, dtype=np.float64)
    known = {(line["iteration"], task) for line in result.rows for task in range(TASKS) if line[f"return_{task}"]}
    counts = Counter(task for _, task in known)
    figures = {
        "way": way,
        "worlds": f"{settings.plays.count(TASKS)} x {settings.num_envs}",
        "returns": np.round(returns.mean(axis=2), 3).tolist(),
        "last": np.round(returns[:, -1], 3).tolist(),
        "known": [counts[task] for task in range(TASKS)],
        "loop": str(settings),
        **resumable.summary(result),
    }
    parts.write_result(arguments.out / f"{way}.json", record(arguments, figures))
    shutil.rmtree(folder, ignore_errors=True)


def plays(arguments: argparse.Namespace, way: str) -> dict[str, Any]:
    """Return the settings of the loop by which a way plays its tasks, with as many worlds as any other way."""
    played = TASKS if way == "all" else arguments.played
    words = [way, arguments.played, arguments.every, _ENOUGH[arguments.family]]
    used = {"all": words[:1], "growing": words}.get(way, words[:3])
    curriculum = ":".join(map(str, used))
    return {"chunk_steps": arguments.every, "num_envs": WORLDS // played, "curriculum": curriculum}


def table(out: Path) -> str:
    """Return the returns of all ways that have finished."""
    found = parts.results_of(out, WAYS)
    against = ["less all's", "less random's"]
    titles = ["way", "tasks x worlds", "last return", *against, "mean return", *against, "worst task", "training s"]
    return markdown(titles, [row(way, found) for way in found])


def row(way: str, found: dict[str, dict[str, Any]]) -> list[str]:
    """Return a way's line of the table."""
    cells = [f"`{way}`", found[way]["worlds"]]
    for pick in (lambda returns: returns[:, -1], lambda returns: returns.mean(axis=1)):
        scores = {name: pick(np.array(result["returns"])) for name, result in found.items() if name != way}
        own = pick(np.array(found[way]["returns"]))
        cells += [f"{stats.seed_interval(own):.1f}", *(difference(own, scores.get(x)) for x in ("all", "random"))]
    worst = np.array(found[way]["last"]).mean(axis=0).min()
    return [*cells, f"{worst:.1f}", f"{found[way]['training_seconds']:.0f}"]


if __name__ == "__main__":
    run_main(main)
