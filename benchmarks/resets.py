"""Measure what it costs to learn without resets: success of the deployed policy, whose episodes begin at the start.

    python benchmarks/resets.py [--ways NAME ...] [--env tabletop] [--agent ppo] [--seeds 3] [--steps N]
                                [--evaluations 12] [--episodes 20] [--env-settings NAME=VALUE ...]
                                [--training NAME=VALUE ...] [--within SECONDS] [--devices 0 ...] [--out DIR]

Four ways, with one preset and as many steps: ``resets``, the bound; and without them ``naive``, goals alone, one drawn
after another; ``forward-backward``, a goal and the way back to the start in turns; and ``graph``, the nearest goal, or
from a goal any other one. Every way is a process of its own with all seeds in one program, and writes ``OUT/WAY.json``
with the success (S, V) of all evaluations, under the mean action. Finished ways are not run again; a way that was
stopped goes on from ``OUT/WAY.run`` if the same command is given again.

The table has success at the end of an episode, as the mean over all evaluations and in the last one, as Sharma et al.
2022 have it (their last tenth of training), with intervals over seeds, and the paired difference from ``naive``.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import parts
import resumable
from report import markdown, record, run_main, settings_of

from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.report import stats

WAYS: dict[str, dict[str, Any]] = {
    "resets": {},
    "naive": {"reset_free": True},
    "forward-backward": {"reset_free": True, "curriculum": "forward-backward"},
    "graph": {"reset_free": True, "curriculum": "graph"},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS), metavar="NAME")
    parser.add_argument("--env", default="tabletop")
    parser.add_argument("--agent", default="ppo")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, help="of all environments; by default those of the preset")
    parser.add_argument("--evaluations", type=int, default=12)
    parser.add_argument("--episodes", type=int, default=20, help="of every evaluation, which plays all goals as often")
    parser.add_argument(
        "--env-settings", nargs="*", default=[], metavar="NAME=VALUE", help="such as reward_kind=sparse"
    )
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    parser.add_argument("--out", type=Path, default=Path("runs") / "resets")
    parts.add_flags(parser)
    parts.run_ways(__file__, parser.parse_args(), measure, table)


def measure(arguments: argparse.Namespace, way: str) -> None:
    """Learn in a way, or go on with the run that was stopped, and write the success of all evaluations."""
    enable_compile_cache()
    plain = with_preset(arguments.env, arguments.agent, **settings_of(arguments.env_settings))
    agent, settings = configure(plain.learner, plain.training, {**settings_of(arguments.training), **WAYS[way]})
    folder, steps = arguments.out / f"{way}.run", arguments.steps or plain.plan.steps
    result = resumable.train(
        folder,
        plain.family,
        agent,
        settings=settings,
        steps=steps,
        seeds=arguments.seeds,
        eval_every=steps // arguments.evaluations,
        eval_episodes=arguments.episodes,
    )
    found = result.evaluations
    rounded = lambda scores: np.asarray(np.round(np.float64(scores["train"].mean(axis=(2, 3))), 5)).tolist()
    figures = {
        "way": way,
        "success": rounded(found.metrics["success"]),
        "success_ever": rounded(found.metrics["success_ever"]),
        "returns": rounded(found.returns),
        "loop": str(settings),
        **resumable.summary(result),
    }
    parts.write_result(arguments.out / f"{way}.json", record(arguments, figures))
    shutil.rmtree(folder, ignore_errors=True)


def table(out: Path) -> str:
    """Return the success of all ways that have finished."""
    found = parts.results_of(out, WAYS)
    titles = ["way", "success, mean over training", "success, last evaluation", "mean less naive's", "seconds"]
    return markdown(titles, [row(found, way) for way in found])


def row(found: dict[str, Any], way: str) -> list[str]:
    """Return a way's line of the table."""
    success, naive = (np.array(found[each]["success"]) if each in found else None for each in (way, "naive"))
    means = [success.mean(axis=1), success[:, -1]]  # type: ignore
    against = "-"
    if naive is not None and way != "naive" and naive.shape == success.shape:  # type: ignore
        against = f"{stats.paired_difference(means[0], naive.mean(axis=1)):.2f}"
    return [f"`{way}`", *(f"{stats.seed_interval(x):.2f}" for x in means), against, f"{found[way]['wall_seconds']}"]


if __name__ == "__main__":
    run_main(main)
