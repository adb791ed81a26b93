"""Measure how well and how fast agents learn: every agent on every family, many seeds in one program each.

    python benchmarks/learning.py [--envs NAME ...] [--agents NAME ...] [--seeds 10] [--steps N] [--split NAME]
                                  [--env NAME=VALUE ...] [--baseline NAME] [--unfinished] [--out DIR]

Without further flags it is the whole table: every agent on six families with its preset, on the splits and for the
steps of ``FAMILIES``; agents whose subject is pictures are left out. Every pair of family and agent writes
``DIR/ENV/AGENT.csv`` (training returns over steps and seconds, one line per chunk and seed) and ``AGENT.npz`` (every
episode of every evaluation), and the policy of its first seed, ``DIR/policies/ENV/AGENT``, which ``mtjax.load`` and
``docs/make_films.py`` take. Finished pairs are not run again, so several processes can make a long table in parts. If
the command is given again with the same DIR, a pair that was stopped goes on where it was, and one that was killed goes
on from its last evaluation. Until a pair is finished its run is in ``DIR/ENV/AGENT``. Its checkpoints need room for
three training states: 0.1 GB for PPO, and 1 to 6 GB for agents with a replay (gpu presets, ten seeds).

All results in DIR together give ``table.md``, ``differences.md``, ``conflicts.md`` (cosines between the tasks'
gradients, of the agents that log them), ``evaluations.csv`` and a figure for each family. ``--agents`` without a name
runs nothing and only makes these. ``table.md`` names unfinished pairs, and ``--unfinished`` gives them lines of their
last evaluation, marked with its steps.

Scores are interquartile means over seeds and tasks of the last evaluation (never the best one) under the mean action,
with 95% bootstrap intervals over whole seeds. "s to 900" is the seconds of training, without compiling and evaluating,
after which the training policy's mean return over tasks and seeds first reached 900. Differences are those of
scores against the baseline's, with the seeds of both in pairs and without; beside them is the probability that a seed
of the agent earns more than one of the baseline on a task drawn at random (Agarwal et al. 2021).
"""

import argparse
import itertools
import json
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from report import markdown, read_lines, run_main, write_lines
from resumable import train
from returns import value

import mtjax
from mtjax.evaluation import Evaluations, load_evaluations, save_evaluations
from mtjax.experience.replay import Replay
from mtjax.report import figures as plot
from mtjax.report.stats import (
    Interval,
    iqm,
    paired_difference,
    probability_of_improvement,
    seed_interval,
    unpaired_difference,
)
from mtjax.training import ship
from mtjax.training.programs import enable_compile_cache
from mtjax.training.run import Result
from mtjax.types import SPLITS


class Pair(NamedTuple):
    """Holds the results of an agent on a family."""

    env: str
    agent: str  # says so, with its steps, if the pair is not finished
    metrics: Path
    evaluations: Evaluations
    finished: bool = True


class Trial(NamedTuple):
    """Holds a family's split and the steps of each seed, by the kind of experience; None is the preset's."""

    split: str | None = None
    replay_steps: int | None = None
    rollout_steps: int | None = None


# Ten seeds of plain conditioning then train for half a minute on an H200; on walker-run for longer. On-policy steps
# cost less, so there are more. Most agents then make 12,000 to 31,000 updates.
FAMILIES = {
    "finger-spin-vary-size": Trial("hip-bmdp", 2_560_000, 20_000_000),
    "cheetah-run-vary-torso-length": Trial("hip-bmdp", 1_000_000, 20_000_000),
    "walker-run-vary-friction": Trial("hip-bmdp", 1_000_000, 5_000_000),
    "cartpole-swingup-vary-pole-mass": Trial("hip-bmdp", 1_000_000, 20_000_000),
    "cheetah-vary-direction": Trial(None, 500_000, 10_000_000),
    "reacher-vary-goal": Trial(None, 1_000_000, 20_000_000),
}
UNFINISHED = "show the last evaluation of unfinished pairs too, marked with its steps"
_FROM_PICTURES = ("drq", "sac-ae")  # from vectors they are plain conditioning
_KEPT = ("seed", "steps", "seconds", "wall_seconds", "return")
_CONFLICTS = ("critic_cosine", "critic_conflict", "actor_cosine", "actor_conflict")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="*", default=list(FAMILIES), metavar="NAME")
    agents = [name for name in mtjax.AGENTS if name not in _FROM_PICTURES]
    parser.add_argument("--agents", nargs="*", default=agents, choices=list(mtjax.AGENTS), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, help="by default those of FAMILIES, else the preset's")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--split", help="by default that of FAMILIES, else the family's")
    parser.add_argument("--evaluations", type=int, default=4)
    parser.add_argument("--eval-episodes", type=int, default=10)
    parser.add_argument("--env", nargs="*", default=[], metavar="NAME=VALUE", help="settings of families: pixels=64")
    parser.add_argument("--vary", nargs="*", default=[], metavar="NAME=VALUES", help="besides what the family varies")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the loop or all agents")
    parser.add_argument("--mark", type=float, default=900.0, help="the return whose time is told")
    parser.add_argument("--baseline", default="sac-conditioned", metavar="NAME", help="what differences are against")
    parser.add_argument("--unfinished", action="store_true", help=UNFINISHED)
    parser.add_argument("--out", type=Path, default=Path("runs") / f"learning-{time.strftime('%Y%m%d-%H%M%S')}")
    arguments = parser.parse_args()
    enable_compile_cache()
    for env in arguments.envs:
        for agent in arguments.agents:
            learn(arguments, env, agent)
    tabulate(arguments.out, arguments.mark, arguments.baseline, arguments.unfinished)


def learn(arguments: argparse.Namespace, env: str, agent: str) -> None:
    """Write the results of one agent on one family, unless they are there already. Then remove its run."""
    folder = arguments.out / env / agent
    if not (arguments.out / env / f"{agent}.npz").exists():
        save(arguments.out / env, agent, trained(arguments, env, agent, folder))
    if (folder / "config.json").exists():
        keep_policy(folder, arguments.out / "policies" / env / agent)
    shutil.rmtree(folder, ignore_errors=True)


def keep_policy(run: Path, place: Path) -> None:
    """Write the policy of the first seed, in place of one that a killed process may have half written."""
    shutil.rmtree(place, ignore_errors=True)
    ship.write(run, place)


def trained(arguments: argparse.Namespace, env: str, agent: str, folder: Path) -> Result:
    """Train one agent on one family with its preset, or go on with the run that was stopped in the folder."""
    trial = FAMILIES.get(env, Trial())
    split = arguments.split or trial.split
    settings = family_settings(arguments.env, arguments.vary, split)
    program = mtjax.preset(env, agent, arguments.preset, seeing(agent, settings), **settings)
    given = trial.replay_steps if isinstance(program.learner.experience, Replay) else trial.rollout_steps
    steps = arguments.steps or given or program.plan.steps
    training = {name: value(x) for name, x in (pair.split("=", 1) for pair in arguments.training)}
    return train(
        folder,
        program.family,
        program.learner,
        steps=steps,
        seeds=arguments.seeds,
        seed=arguments.seed,
        eval_every=-(-steps // arguments.evaluations),
        eval_episodes=arguments.eval_episodes,
        settings=program.training,
        **training,
        quiet=False,
    )


def family_settings(given: Sequence[str], vary: Sequence[str], split: str | None) -> dict[str, Any]:
    """Return the settings of a family from words such as pixels=64, from what it varies, and from its split."""
    settings: dict[str, Any] = {"vary": dict(pair.split("=", 1) for pair in vary)} | ({"split": split} if split else {})
    return settings | {name: value(x) for name, x in (pair.split("=", 1) for pair in given)}


def seeing(agent: str, settings: dict) -> dict[str, Any]:
    """Return the settings by which an agent learns from pictures as ``drq`` does, if it has none of its own."""
    own, drq = mtjax.agents.settings(mtjax.agent(agent)), mtjax.AGENTS["drq"].defaults
    if "pixels" not in settings or own["representation"] != "plain":
        return {}
    names = ("representation", "encoder_tau", "n_step") if "n_step" in own else ("representation",)
    return {name: drq[name] for name in names}


def save(folder: Path, agent: str, result: Result) -> None:
    """Save one run. The evaluations come last, because they mark it as complete."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = [name for name in (*_KEPT, *_CONFLICTS) if name in result.rows[-1]]
    write_lines(folder / f"{agent}.csv", [{name: row[name] for name in kept} for row in result.rows])
    save_evaluations(folder / f"{agent}.npz", result.evaluations)


def stopped(out: Path) -> Iterator[tuple[Path, str]]:
    """Return the folders of unfinished pairs, and their agents with the steps of their last evaluations."""
    for file in sorted(out.glob("*/*/config.json")):
        folder, evaluated = file.parent, file.with_name("evaluations.npz")
        if not folder.with_name(f"{folder.name}.npz").exists():
            steps = load_evaluations(evaluated).steps[-1] if evaluated.exists() else 0
            planned = json.loads(file.read_text())["plan"]["steps"]
            yield folder, f"{folder.name}, unfinished: evaluated after {steps:,} of {planned:,} steps"


def list_stopped(out: Path) -> str:
    """Return a list of the unfinished pairs, for the end of a table; empty if there are none."""
    found = [f"\n- {folder.parent.name}: {agent}" for folder, agent in stopped(out)]
    return "\n" * bool(found) + "".join(found)


def pairs(out: Path, unfinished: bool = False) -> list[Pair]:
    """Return all finished pairs by family, in the order of agents; if asked, also others that were evaluated."""
    found = [Pair(x.parent.name, x.stem, x.with_suffix(".csv"), load_evaluations(x)) for x in out.glob("*/*.npz")]
    for folder, agent in stopped(out) if unfinished else ():
        if (evaluated := folder / "evaluations.npz").exists():
            evaluations = load_evaluations(evaluated)
            found.append(Pair(folder.parent.name, agent, folder / "metrics.csv", evaluations, finished=False))
    known = {name: place for place, name in enumerate(mtjax.AGENTS)}
    return sorted(found, key=lambda pair: (pair.env, known.get(pair.agent.split(",")[0], len(known)), pair.agent))


def curve_of(pair: Pair) -> np.ndarray:
    """Return the lines (V, S) of ``_KEPT`` up to the last evaluation of a pair."""
    found = np.array([[float(line[name] or "nan") for name in _KEPT] for line in read_lines(pair.metrics)])
    found = found[found[:, 1] <= pair.evaluations.steps[-1]]
    return found.reshape(-1, len(pair.evaluations.returns["train"]), len(_KEPT))


def tabulate(out: Path, mark: float, baseline: str, unfinished: bool = False) -> None:
    """Make tables and figures of all runs in a folder."""
    head = ["family", "agent", *(f"{split}, IQM" for split in SPLITS), "worst task", f"s to {mark:.0f}"]
    head += ["training s", "wall s", "steps/s, all seeds"]
    lines, rows, differences = [], [], []
    for env, of_env in itertools.groupby(pairs(out, unfinished), lambda pair: pair.env):
        curves, found = {}, {}
        for pair in of_env:
            agent, evaluations, curve = pair.agent, pair.evaluations, curve_of(pair)
            found |= {agent: last_scores(evaluations)} if pair.finished else {}
            known = curve[np.all(np.isfinite(curve[:, :, -1]), axis=1)]  # chunks in which episodes ended
            if len(known):
                label = agent.split(":")[0]  # without the steps of an unfinished one
                curves[label] = (known[:, 0, 1], known[:, :, -1].T[:, :, None, None])
            lines.append(row(env, agent, curve, evaluations, mark))
            rows += evaluation_rows(env, agent, evaluations)
        differences += difference_rows(env, found, baseline)
        if curves:
            plot.compare(out / f"{env}.png", curves, f"return on training tasks of {env}")
    table = markdown(head, lines) + list_stopped(out)
    (out / "table.md").write_text(table + "\n")
    head = ["family", "agent", "split", f"IQM less {baseline}'s, seeds in pairs", "seeds not in pairs"]
    (out / "differences.md").write_text(markdown([*head, "probability of improvement"], differences) + "\n")
    head = ["family", "agent", *(name.replace("_", " ") for name in _CONFLICTS)]
    (out / "conflicts.md").write_text(markdown(head, conflict_rows(out)) + "\n")
    write_lines(out / "evaluations.csv", rows)
    print(table)


def row(env: str, agent: str, curve: np.ndarray, evaluations, mark: float) -> list[str]:
    """Return the cells of one run's line: last evaluation by split, times, rate."""
    scores = last_scores(evaluations)
    cells = [env, agent]
    cells += [cell(seed_interval(scores[split], iqm)) if split in scores else "-" for split in SPLITS]
    cells.append(f"{scores['train'].mean(axis=0).min():.0f}")
    steps, seconds, wall, returns = np.moveaxis(curve[:, :, 1:], -1, 0).mean(axis=-1)
    reached = np.flatnonzero(returns >= mark)
    cells.append(f"{seconds[reached[0]]:.1f}" if len(reached) else "-")
    rate = steps[-1] * curve.shape[1] / seconds[-1]
    return [*cells, f"{seconds[-1]:.1f}", f"{wall[-1]:.0f}", f"{rate:,.0f}"]


def difference_rows(env: str, found: dict[str, dict[str, np.ndarray]], baseline: str) -> list[list[str]]:
    """Return each agent's differences from the baseline, one line per split. Pairs need equal numbers of seeds."""
    lines = []
    for agent, scores in found.items():
        for split in scores if agent != baseline and baseline in found else ():
            pair = scores[split], found[baseline][split]
            paired = cell(paired_difference(*pair, iqm), "+.1f") if len(pair[0]) == len(pair[1]) else "-"
            improvement = cell(probability_of_improvement(*pair), ".2f")
            lines.append([env, agent, split, paired, cell(unpaired_difference(*pair, iqm), "+.1f"), improvement])
    return lines


def conflict_rows(out: Path) -> list[list[str]]:
    """Return the mean cosine and share of conflicting pairs of every agent that logs them, over its run and seeds."""
    lines = []
    for path in sorted(out.glob("*/*.csv")):
        rows = [line for line in read_lines(path) if line.get(_CONFLICTS[0])]
        means = [np.nanmean([float(line[name]) for line in rows]) for name in _CONFLICTS] if rows else []
        lines += [[path.parent.name, path.stem, *(f"{x:.2f}" for x in means)]] if rows else []
    return lines


def last_scores(evaluations) -> dict[str, np.ndarray]:
    """Return the mean returns (S, T) of the last evaluation by split, without empty splits."""
    return {split: x[:, -1].mean(axis=-1) for split, x in evaluations.returns.items() if x.size}


def cell(interval: Interval, form: str = ".0f") -> str:
    """Return an estimate with its interval, if it has one."""
    point, low, high = (format(x, form) for x in interval)
    return f"{point} [{low}, {high}]" if np.isfinite(interval.low) else point


def evaluation_rows(env: str, agent: str, evaluations) -> list[dict]:
    """Return a line for each split, evaluation, seed and task: the mean over episodes."""
    return [
        {"env": env, "agent": agent, "split": split, "steps": int(steps), "seed": s, "task": t, "return": f"{x:.1f}"}
        for split, returns in evaluations.returns.items()
        for s, of_seed in enumerate(returns.mean(axis=-1))
        for steps, of_step in zip(evaluations.steps, of_seed, strict=True)
        for t, x in enumerate(of_step)
    ]


if __name__ == "__main__":
    run_main(main)
