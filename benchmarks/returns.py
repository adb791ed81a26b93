"""Measure which returns agents reach on families of dm_control within minutes of training on one GPU.

    python benchmarks/returns.py [--family=NAME] ... [--agent=NAME] [--steps=N] [--seeds=3] [NAME=VALUE ...]

Every family is trained in one program with all seeds, and writes ``OUT/NAME.csv`` (one line of metrics per chunk and
seed), ``NAME.npz`` (every episode of every evaluation) and ``NAME.json`` (the row of the table below). A family with a
``NAME.json`` is not run again, so the families can be run in parts, in any order. If the command is given again, a
family that was stopped goes on where it was, and one that was killed from its last evaluation; until it is finished its
run is in ``OUT/NAME.run``. Further words replace settings of the preset, for the agent or the loop: ``epochs=8
num_envs=512 hidden=[256,256]``.

Steps are of each seed, summed over its ten tasks; steps a second are of all seeds, without compiling and evaluating.
The return is the mean of the last evaluation under the mean action, over tasks and episodes; its interval is the 95%
bootstrap interval over whole seeds, which of three seeds is from the worst to the best one. "Limited" is extrapolation
by the same policies with ``context_limit=1``, which shows them a task beyond the range as the end of the range.
"""

import argparse
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
from parts import whole
from report import markdown, record, run_main, settings_of, write_lines
from resumable import train

from mtjax.agents.hyperparameters import replace
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.learning.evaluation import Episodes, evaluate, save_evaluations
from mtjax.names import replacing
from mtjax.report.stats import Interval, seed_interval
from mtjax.saved.result import Result
from mtjax.types import SPLITS, Agent

_GEAR = {"gear": "0.8:1.2:10"}


class Aim(NamedTuple):
    """Holds a family's parameters, its agent, the steps of each seed and the return that is aimed at."""

    vary: dict[str, str]
    agent: str
    steps: int
    least: float


FAMILIES = {
    "finger-spin-vary-size": Aim({}, "ppo", 100_000_000, 960),
    "cheetah-run-vary-torso-length": Aim({}, "ppo", 150_000_000, 890),
    "cartpole-swingup-vary-pole-mass": Aim({}, "ppo", 100_000_000, 850),
    "walker-walk-vary-friction": Aim({}, "ppo", 45_000_000, 970),
    "walker-run-vary-friction": Aim({}, "brc", 4_300_000, 800),
    "hopper-hop": Aim(_GEAR, "brc", 5_000_000, 250),
    "acrobot-swingup": Aim(_GEAR, "brc", 8_000_000, 350),
    "reacher-hard": Aim(_GEAR, "ppo", 60_000_000, 960),
    "finger-turn-hard": Aim(_GEAR, "ppo", 180_000_000, 900),
    "ball-in-cup-catch": Aim(_GEAR, "brc", 1_600_000, 970),
    "pendulum-swingup": Aim(_GEAR, "brc", 5_200_000, 800),
}
_SHOWN = ("kl", "clip_fraction", "entropy", "explained_variance")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", action="append", choices=list(FAMILIES), metavar="NAME", help="by default all")
    parser.add_argument("--agent", help="by default the family's, of the table above")
    parser.add_argument("--preset", default="gpu")
    parser.add_argument("--engine", default="auto", help="of the physics; auto is the family's own choice for a GPU")
    parser.add_argument("--steps", type=whole, help="of each seed; by default the family's")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--evaluations", type=int, default=4)
    parser.add_argument("--eval-episodes", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("runs") / "returns")
    parser.add_argument("given", nargs="*", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    enable_compile_cache()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for family in arguments.family or FAMILIES:
        if not (arguments.out / f"{family}.json").exists():
            learn(arguments, family)
        shutil.rmtree(arguments.out / f"{family}.run", ignore_errors=True)
    tabulate(arguments.out)


def learn(arguments: argparse.Namespace, family: str) -> None:
    """Train on one family, and save the results."""
    aim = FAMILIES[family]
    varied = {"vary": aim.vary} if aim.vary else {}
    config = with_preset(family, arguments.agent or aim.agent, arguments.preset, engine=arguments.engine, **varied)
    agent, settings = configure(config.learner, config.training, settings_of(arguments.given))
    steps = arguments.steps or aim.steps
    print(f"{family}: {steps:,} steps of {arguments.seeds} seeds\n{agent}\n{settings}", flush=True)
    file, last = arguments.out / f"{family}.csv", [0.0]

    def show(row: dict[str, Any]) -> None:
        if float(row["seconds"]) >= last[0] + 5:
            last[0] = float(row["seconds"])
            rest = ", ".join(f"{name} {float(row[name]):.3g}" for name in _SHOWN if name in row)
            print(f"{last[0]:7.1f} s  {int(row['steps']):12,} steps  return {row['return'] or '-'}, {rest}", flush=True)

    result = train(
        arguments.out / f"{family}.run",
        config.family,
        agent,
        steps=steps,
        seeds=arguments.seeds,
        seed=arguments.seed,
        eval_every=-(-steps // arguments.evaluations),
        eval_episodes=arguments.eval_episodes,
        settings=settings,
        on_chunk=show,
    )
    write_lines(file, result.rows)
    save_evaluations(file.with_suffix(".npz"), result.evaluations)
    found = row(family, result, arguments.seeds) | {"limited": limited(config.family, agent, result, arguments)}
    found |= {"aim": aim.least, "wall_seconds": round(float(result.rows[-1]["wall_seconds"]), 1)}
    made = record(arguments, {**found, "agent": str(agent), "loop": dataclasses.asdict(settings)})
    with replacing(file.with_suffix(".json")) as new:  # which marks the family as finished
        new.write_text(json.dumps(made, indent=2, default=str) + "\n")
    print({**found}, flush=True)


def limited(family: FamilyOrMixture, agent: Agent, result: Result, arguments: argparse.Namespace) -> float | None:
    """Return the mean return of extrapolation with ``context_limit=1``; None without, or if no parameter is shown."""
    tasks, seeds = family.tasks("extrapolation"), arguments.seed + jnp.arange(arguments.seeds)
    if not len(tasks.id) or not agent.conditioning.by_parameters:
        return None
    agent = replace(agent, {"context_limit": 1.0})
    episodes = Episodes(arguments.eval_episodes)
    scores = evaluate(family, agent, episodes, result.state.agent, tasks, seeds, jnp.int32(0))
    return round(float(scores.returns.mean()), 1)


def row(family: str, result: Result, seeds: int) -> dict[str, Any]:
    """Return the table's row of a run."""
    evaluations = result.evaluations
    scores = {split: x[:, -1].mean(axis=(-2, -1)) for split, x in evaluations.returns.items() if x.size}  # (S,)
    steps = int(result.rows[-1]["steps"])
    _, low, high = seed_interval(scores["train"])
    return {
        "family": family,
        "steps": steps,
        "seconds": round(result.seconds, 1),
        "compile_seconds": round(result.compile_seconds, 1),
        "steps_per_second": round(steps * seeds / result.seconds),
        **{split: round(float(scores[split].mean()), 1) if split in scores else None for split in SPLITS},
        "low": round(low, 1),
        "high": round(high, 1),
        "seeds": [round(float(x), 1) for x in scores["train"]],
        "worst_task": round(float(evaluations.returns["train"][:, -1].mean(axis=(0, -1)).min()), 1),
        "over_time": [round(float(x), 1) for x in evaluations.returns["train"].mean(axis=(0, 2, 3))],
    }


def tabulate(out: Path) -> None:
    """Print and save a table of all finished families."""
    head = [
        "family",
        "agent",
        "steps of a seed",
        "training s",
        "steps/s, all seeds",
        "train",
        "interpolation",
        "extrapolation",
    ]
    head += ["limited", "worst task", "aim"]
    found = [json.loads(path.read_text()) for path in sorted(out.glob("*.json"))]
    show = lambda x: "-" if x is None else f"{x:.0f}"
    lines = [
        [
            x["family"],
            x["agent"].split("(")[0],
            f"{x['steps']:,}",
            f"{x['seconds']:.0f}",
            f"{x['steps_per_second']:,}",
            f"{Interval(x['train'], x['low'], x['high']):.0f}",
            *(show(x[split]) for split in SPLITS[1:]),
            show(x["limited"]),
            show(x["worst_task"]),
            show(x["aim"]),
        ]
        for x in found
    ]
    table = markdown(head, lines)
    (out / "table.md").write_text(table + "\n")
    print(table)


if __name__ == "__main__":
    run_main(main)
