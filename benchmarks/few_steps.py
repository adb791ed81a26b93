"""Measure what a policy earns after few gradient steps on a task that it has to find out: MAML beside three others.

    python benchmarks/few_steps.py [--env=point-mass-vary-goal] [--ways NAME ...] [--seeds 5] [--steps N] [--updates 3]
                                   [--training NAME=VALUE ...] [--within SECONDS] [--devices 0 ...] [--out DIR]

No network sees the goal. The ways:

- ``maml``: learns the start from which a gradient step earns most (Finn et al. 2017);
- ``first-order``: the same, where inner steps are constants in the outer one;
- ``plain``: learns all tasks at once, and takes the same gradient steps only in evaluation: fine-tuning;
- ``rl2``: remembers its trial, and takes no gradient step (Duan et al. 2016).

The first three play rollouts of whole episodes between their steps. In evaluation they take 0 to ``--updates`` gradient
steps, each on episodes of ``--adapt-envs`` worlds, on goals of training and on goals that were held out. ``rl2`` plays
trials of as many episodes and one. So column k of the table is what a way earns after k updates, or k episodes.

Every way is a process of its own with all seeds in one program, and writes ``OUT/WAY.json`` with the returns
(S, K + 1) by split, under the mean action, means over tasks and episodes. Finished ways are not run again; one that was
stopped goes on from ``OUT/WAY.run`` if the same command is given again.
"""

import argparse
import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import parts
import resumable
from report import markdown, record, run_main, settings_of

from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.learning.evaluation import Episodes, adapted, evaluate
from mtjax.report import stats
from mtjax.saved.result import Result

FAMILIES = {"point-mass-vary-goal": {"num_tasks": 20, "split": "dense"}}  # others have their own tasks and split
_MAML = {"num_envs": 10, "unroll": 100, "gamma": 0.97, "conditioning": "none"}
_TINY = 1e-6  # of an inner step that does not move a policy
WAYS: dict[str, tuple[str, dict[str, Any]]] = {
    "maml": ("maml", _MAML),
    "first-order": ("maml", {**_MAML, "first_order": True}),
    "plain": ("maml", {**_MAML, "inner_rate": _TINY}),
    "rl2": ("rl2", {"num_envs": 20, "gamma": 0.97, "unroll": 100, "minibatches": 4, "hidden": (64, 64)}),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="point-mass-vary-goal")
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS), metavar="WAY")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=parts.whole, default=6_000_000, help="of each seed, summed over tasks")
    parser.add_argument("--updates", type=int, default=3, help="gradient steps in evaluation, at most")
    parser.add_argument("--adapt-envs", type=int, default=20, help="episodes of each task for a gradient step")
    parser.add_argument("--inner-rate", type=float, default=0.1, help="length of a gradient step")
    parser.add_argument("--episodes", type=int, default=4, help="of each task in an evaluation")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    parser.add_argument("--out", type=Path, default=Path("runs") / "few-steps")
    parts.add_flags(parser)
    parts.run_ways(__file__, parser.parse_args(), measure, table)


def measure(arguments: argparse.Namespace, way: str) -> None:
    """Learn the tasks, or go on with the run that was stopped, and write what is earned after every update."""
    enable_compile_cache()
    learner, given = WAYS[way]
    plain = with_preset(arguments.env, learner, **FAMILIES.get(arguments.env, {}))
    if learner == "maml":
        given = {"inner_rate": arguments.inner_rate, **given}
    else:
        given = {**given, "trials": arguments.updates + 1}
    given = {**given, **settings_of(arguments.training)}
    worlds = given["num_envs"] * plain.family.train_count
    rollout = given["unroll"] * (2 if learner == "maml" else 1)
    chunk = max(arguments.steps // worlds // 10 // rollout, 1) * rollout
    agent, settings = configure(plain.learner, plain.training, {**given, "chunk_steps": chunk})
    steps = max(arguments.steps // (worlds * chunk), 1) * worlds * chunk
    folder = arguments.out / f"{way}.run"
    trial = given.get("trials", 1)
    result = resumable.train(
        folder,
        plain.family,
        agent,
        settings=settings,
        steps=steps,
        seeds=arguments.seeds,
        eval_every=steps,
        eval_episodes=arguments.episodes * trial,
    )
    earned = after_updates if learner == "maml" else by_episode
    figures = {"way": way, "returns": earned(arguments, result), **resumable.summary(result)}
    parts.write_result(arguments.out / f"{way}.json", record(arguments, figures))
    shutil.rmtree(folder, ignore_errors=True)


def after_updates(arguments: argparse.Namespace, result: Result) -> dict[str, Any]:
    """Return the returns (S, K + 1) of each split after 0 to K gradient steps of one length."""
    env: Any = result.env
    agent: Any = dataclasses.replace(result.agent, inner_rate=arguments.inner_rate)  # type: ignore
    seeds, found = jnp.arange(arguments.seeds, dtype=jnp.uint32), {}
    for split in splits_of(result):
        tasks = env.tasks(split)
        ask = lambda count, tasks=tasks: adapted(
            env, agent, arguments.adapt_envs, count, result.state.agent, tasks, seeds, jnp.int32(0)
        )
        play = lambda given: evaluate(env, agent, Episodes(arguments.episodes), *given, seeds, jnp.int32(1)).returns
        returns = [play(ask(count)).mean(axis=(1, 2)) for count in range(arguments.updates + 1)]
        found[split] = np.round(np.float64(jnp.stack(returns, axis=1)), 3).tolist()
    return found


def by_episode(arguments: argparse.Namespace, result: Result) -> dict[str, Any]:
    """Return the returns (S, K + 1) of each split in the episodes of trials, in the last evaluation."""
    of_trial = lambda x: x[:, -1].reshape(*x.shape[:1], x.shape[2], -1, arguments.updates + 1).mean(axis=(1, 2))
    earned = {split: of_trial(result.evaluations.returns[split]) for split in splits_of(result)}
    return {split: np.round(np.float64(x), 3).tolist() for split, x in earned.items()}


def splits_of(result: Result) -> list[str]:
    """Return the splits that have tasks."""
    return [split for split, x in result.evaluations.returns.items() if x.shape[2]]


def table(out: Path) -> str:
    """Return what all ways that have finished earn by split."""
    found = parts.results_of(out, WAYS)
    count = max((len(result["returns"]["train"][0]) for result in found.values()), default=1)
    titles = ["way", "split", *(f"after {k}" for k in range(count)), "training s"]
    return markdown(titles, [line for way in found for line in lines(way, found[way])])


def lines(way: str, result: dict[str, Any]) -> list[list[str]]:
    """Return a way's lines of the table, one for each split."""
    cells = lambda returns: [f"{stats.seed_interval(x):.1f}" for x in np.array(returns).T]
    seconds = f"{result['training_seconds']:.0f}"
    return [[f"`{way}`", split, *cells(returns), seconds] for split, returns in result["returns"].items()]


if __name__ == "__main__":
    run_main(main)
