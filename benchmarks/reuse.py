"""Measure what options that some tasks taught are worth in tasks that were held out.

    python benchmarks/reuse.py [--env=craft] [--tasks plank ...] [--held-out rope ...] [--steps=N] [--new-steps=N]
                               [--seeds=10] [--out DIR] [NAME=VALUE ...]

First ``options`` and ``ppo`` learn some tasks of a family. Both see a task by its context, and follow no sketch. Then
the held-out tasks, made of the same parts in other orders, are learned in five ways:

- ``kept``: the policy over options learns, and the options stay as they are;
- ``tuned``: all of ``options`` goes on to learn;
- ``scratch``: ``options`` begins anew;
- ``ppo-tuned``, ``ppo``: the same two of PPO.

Seeds are paired: each way begins from the networks of its own seed. ``OUT/reuse.json`` has the returns (S, V) of every
evaluation, means over tasks and episodes. The table has the return before, at the end, and on average over the
evaluations. Further words replace settings of both agents, the loop and the family, such as ``num_envs=32``.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import parts
from report import markdown, record, run_main, settings_of

import mtjax
from mtjax.compiling.programs import enable_compile_cache
from mtjax.report import stats

_COMMON = {"num_envs": 64, "unroll": 32, "epochs": 2, "minibatches": 4, "gamma": 0.95, "chunk_steps": 3200}
_COMMON |= {"eval_episodes": 16, "split": "none"}
_OF_OPTIONS = {"sampler": "by-length", "least_weight": 0.1}
WAYS = {
    "kept": ("options", True, {"keep_options": True}),
    "tuned": ("options", True, {}),
    "scratch": ("options", False, {}),
    "ppo-tuned": ("ppo", True, {}),
    "ppo": ("ppo", False, {}),
}
"""The agent of each way, whether it begins from what it has learned on other tasks, and its settings."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="craft")
    parser.add_argument("--tasks", nargs="+", default=["plank", "stick", "cloth", "bridge"])
    parser.add_argument("--held-out", nargs="+", default=["rope", "bed"])
    parser.add_argument("--steps", type=int, default=15_000_000, help="of each seed on the training tasks")
    parser.add_argument("--new-steps", type=int, default=4_000_000, help="of each seed on the held-out tasks")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("runs") / "reuse")
    parser.add_argument("given", nargs="*", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    enable_compile_cache()
    given = _COMMON | {"seeds": arguments.seeds, "quiet": True} | settings_of(arguments.given)
    found: dict[str, Any] = {}
    for agent in ("options", "ppo"):
        settings = given | (_OF_OPTIONS if agent == "options" else {})
        folder, steps = arguments.out / agent, arguments.steps
        found[agent] = run(arguments.env, agent, arguments.tasks, **settings, steps=steps, directory=folder)
        write(arguments, found)
    for way, (agent, taught, more) in WAYS.items():
        begun = {"start": arguments.out / agent} if taught else {}
        settings = given | (_OF_OPTIONS if agent == "options" else {}) | more | begun
        found[way] = run(arguments.env, agent, arguments.held_out, **settings, steps=arguments.new_steps)
        write(arguments, found)
    print(table(found))


def run(env: str, agent: str, goals: list[str], **given: Any) -> dict[str, Any]:
    """Train on the tasks with these names, and return returns (S, V) and steps (V,) of all evaluations."""
    result = mtjax.train(env, agent, vary={"goal": ",".join(goals)}, **given)
    scores = np.float64(result.evaluations.returns["train"]).mean(axis=(2, 3))
    print(f"{agent} on {', '.join(goals)}: {np.round(scores.mean(axis=0), 3)}", flush=True)
    seconds = round(result.total_seconds, 1)
    steps = result.evaluations.steps.tolist()
    return {"returns": np.round(scores, 4).tolist(), "steps": steps, "seconds": seconds, "learner": str(result.agent)}


def write(arguments: argparse.Namespace, found: dict[str, Any]) -> None:
    """Write what has been found so far."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    parts.write_result(arguments.out / "reuse.json", record(arguments, found))


def table(found: dict[str, Any]) -> str:
    """Return the returns of each way, with intervals over seeds, and what it gains on average over ``scratch``."""
    plain, rows = np.array(found["scratch"]["returns"]), []
    for way in WAYS:
        scores = np.array(found[way]["returns"])
        parts = scores[:, 0], scores[:, -1], scores.mean(axis=1)
        gained = stats.paired_difference(scores.mean(axis=1), plain.mean(axis=1))
        rows.append([way, *(f"{stats.seed_interval(x):.2f}" for x in parts), f"{gained:+.2f}"])
    return markdown(["way", "before", "at the end", "on average", "on average, less scratch"], rows)


if __name__ == "__main__":
    run_main(main)
