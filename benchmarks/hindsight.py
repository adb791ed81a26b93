"""Measure what hindsight across tasks is worth, and which task steps should be replayed for.

    python benchmarks/hindsight.py [--env=reacher-vary-goal] [--ways none uniform inverse] [--share 0.5] [--seeds 10]
                                   [--steps N] [--evaluations 20] [--training NAME=VALUE ...] [--within SECONDS]
                                   [--devices 0 ...] [--out DIR]

An agent learns tasks that differ in their goals alone. A share of each batch is replayed as steps of other tasks:

- ``none``: of none;
- ``uniform``: drawn uniformly, for any task (Andrychowicz et al. 2017, across tasks);
- ``inverse``: those that the critics value most for a task beside other tasks (Eysenbach et al. 2020, HIPI).

Every way is a process of its own with all seeds in one program, and writes ``OUT/WAY.json`` with the returns (S, V) of
all evaluations, means over tasks and episodes. Seeds are those of the environment too, so that ways are paired.
Finished ways are not run again; one that was stopped goes on from ``OUT/WAY.run`` if the same command is given again.

The table has the return of the last evaluation and the mean over all, that is the area under the curve, with intervals
over seeds, and the paired difference of areas from ``none`` and from ``uniform``.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import parts
import resumable
from report import difference, markdown, record, run_main, settings_of

from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.report import stats

WAYS = ("none", "uniform", "inverse")
_SETTINGS = {"num_envs": 4, "batch_size": 32, "hidden": (128, 128), "replay_size": 50_000, "warmup_steps": 250}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="reacher-vary-goal")
    parser.add_argument("--agent", default="sac-conditioned", help="one with a replay")
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=WAYS, metavar="WAY")
    parser.add_argument("--share", type=float, default=0.5, help="of each batch that is replayed as of other tasks")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=parts.whole, default=400_000, help="of each seed, summed over tasks")
    parser.add_argument("--evaluations", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=2, help="of each task in an evaluation")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    parser.add_argument("--out", type=Path, default=Path("runs") / "hindsight")
    parts.add_flags(parser)
    parts.run_ways(__file__, parser.parse_args(), measure, table)


def measure(arguments: argparse.Namespace, way: str) -> None:
    """Learn the tasks, or go on with the run that was stopped, and write the returns of all evaluations."""
    enable_compile_cache()
    plain = with_preset(arguments.env, arguments.agent)
    given = {**_SETTINGS, **settings_of(arguments.training)}
    if way != "none":
        given |= {"hindsight": arguments.share, "hindsight_choice": way}
    worlds = given["num_envs"] * plain.family.train_count
    chunk = arguments.steps // arguments.evaluations // worlds
    agent, settings = configure(plain.learner, plain.training, {**given, "chunk_steps": chunk})
    folder = arguments.out / f"{way}.run"
    result = resumable.train(
        folder,
        plain.family,
        agent,
        settings=settings,
        steps=arguments.evaluations * chunk * worlds,
        seeds=arguments.seeds,
        eval_every=chunk * worlds,
        eval_episodes=arguments.episodes,
    )
    returns = result.evaluations.returns["train"].mean(axis=(2, 3), dtype=np.float64)
    figures = {"way": way, "returns": np.round(returns, 2).tolist(), **resumable.summary(result)}
    parts.write_result(arguments.out / f"{way}.json", record(arguments, figures))
    shutil.rmtree(folder, ignore_errors=True)


def table(out: Path) -> str:
    """Return the returns of all ways that have finished."""
    found = parts.results_of(out, WAYS)
    areas = {way: np.array(result["returns"]).mean(axis=1) for way, result in found.items()}
    titles = ["way", "last return", "mean return", "less none's", "less uniform's", "training s"]
    return markdown(titles, [row(way, found[way], areas) for way in found])


def row(way: str, result: dict[str, Any], areas: dict[str, np.ndarray]) -> list[str]:
    """Return a way's line of the table."""
    last = stats.seed_interval(np.array(result["returns"])[:, -1])
    against = [difference(areas[way], areas.get(other)) if other != way else "-" for other in ("none", "uniform")]
    seconds = f"{result['training_seconds']:.0f}"
    return [f"`{way}`", f"{last:.0f}", f"{stats.seed_interval(areas[way]):.0f}", *against, seconds]


if __name__ == "__main__":
    run_main(main)
