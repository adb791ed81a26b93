"""Measure what an agent makes of sentences that it has never read, in a grid of errands.

    python benchmarks/sentences.py [--env=errands] [--ways NAME ...] [--seeds 10] [--steps N] [--evaluations 4]
                                   [--episodes 20] [--training NAME=VALUE ...] [--within SECONDS] [--devices 0 ...]
                                   [--out DIR]

Three agents are PPO with the family's preset, and differ in what they know of their task:

- ``reads``: its sentence, which scales and shifts hidden layers (FiLM);
- ``told``: the family's context, which says the same in numbers, in the same way;
- ``blind``: nothing.

Every way is a process of its own with all seeds in one program, and writes ``OUT/WAY.json`` with the returns and the
successes (S, V) of all evaluations by split, means over tasks and episodes, under drawn actions. ``reads`` is then
played once more with the sentences of all tasks shuffled: ``OUT/reads.json`` has that as "shuffled". Finished ways are
not run again; one that was stopped goes on from ``OUT/WAY.run`` if the same command is given again. The table has the
last evaluation; the share is that of what the told agent earns on the same tasks.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import parts
import resumable
from report import markdown, record, run_main, settings_of

from mtjax.compiling.programs import enable_compile_cache
from mtjax.learning.evaluation import Episodes, evaluate
from mtjax.report import stats
from mtjax.saved.result import Result
from mtjax.types import SPLITS

WAYS: dict[str, dict[str, Any]] = {
    "reads": {"conditioning": "text", "encoder": "film"},
    "told": {"conditioning": "parameters", "encoder": "film"},
    "blind": {"conditioning": "none"},
}
_SHUFFLED = "shuffled"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="errands")
    parser.add_argument("--ways", nargs="+", default=list(WAYS), choices=list(WAYS), metavar="WAY")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=parts.whole, default=20_000_000, help="of each seed, summed over tasks")
    parser.add_argument("--evaluations", type=int, default=4)
    parser.add_argument("--episodes", type=int, default=20, help="of each task in an evaluation")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    parser.add_argument("--out", type=Path, default=Path("runs") / "sentences")
    parts.add_flags(parser)
    parts.run_ways(__file__, parser.parse_args(), measure, table)


def measure(arguments: argparse.Namespace, way: str) -> None:
    """Learn the tasks, or go on with the run that was stopped, and write the scores of all evaluations."""
    enable_compile_cache()
    folder = arguments.out / f"{way}.run"
    result = resumable.train(
        folder,
        arguments.env,
        "ppo",
        seeds=arguments.seeds,
        steps=arguments.steps,
        eval_every=arguments.steps // arguments.evaluations,
        eval_episodes=arguments.episodes,
        eval_sampled=True,
        **WAYS[way],
        **settings_of(arguments.training),
    )
    found = {"returns": result.evaluations.returns, "success": result.evaluations.metrics["success"]}
    if way == "reads":
        found[_SHUFFLED] = shuffled(arguments, result)
    mean = lambda x: np.round(np.mean(x, axis=(-2, -1), dtype=np.float64), 4).tolist()
    figures = {name: {split: mean(x) for split, x in scores.items()} for name, scores in found.items()}
    parts.write_result(
        arguments.out / f"{way}.json", record(arguments, {"way": way, **figures, **resumable.summary(result)})
    )
    shutil.rmtree(folder, ignore_errors=True)


def shuffled(arguments: argparse.Namespace, result: Result) -> dict[str, np.ndarray]:
    """Return the returns (S, 1, T, episodes) of each split where every task has the sentence of another, at random."""
    env, agent, state = result.env, result.agent, result.state.agent
    tasks, known = env.tasks("all"), state.nets["tasks"]
    order = np.random.default_rng(0).permutation(len(tasks.id))
    given = jax.tree.map(lambda x: x[:, order], known.shared["given"])
    state = state.with_nets(tasks=known._replace(shared={**known.shared, "given": given}))
    seeds, played = jnp.arange(arguments.seeds, dtype=jnp.uint32), Episodes(arguments.episodes, sampled=True)
    returns = np.asarray(evaluate(env, agent, played, state, tasks, seeds, jnp.int32(1_000_000)).returns)
    ends = np.cumsum([len(env.tasks(split).id) for split in SPLITS])[:-1]
    return {split: x[:, None] for split, x in zip(SPLITS, np.split(returns, ends, axis=1), strict=True)}


def table(out: Path) -> str:
    """Return what all ways that have finished earn by split."""
    found = parts.results_of(out, WAYS)
    last = {way: {split: np.array(x)[:, -1] for split, x in each["returns"].items()} for way, each in found.items()}
    if "reads" in found:
        last[f"reads, {_SHUFFLED}"] = {split: np.array(x)[:, -1] for split, x in found["reads"][_SHUFFLED].items()}
    told = {split: x.mean() for split, x in last.get("told", {}).items()}
    cell = lambda split, x: f"{stats.seed_interval(x):.2f}" + (f", {x.mean() / told[split]:.2f}" if told else "")
    lines = [[f"`{way}`", *(cell(split, x) for split, x in scores.items())] for way, scores in last.items()]
    return markdown(["way", *(f"{split}, share" for split in SPLITS)], lines)


if __name__ == "__main__":
    run_main(main)
