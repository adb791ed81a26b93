"""Measure how well and how fast agents learn: every agent on every family, many seeds in one program each.

    python benchmarks/learning.py [--envs NAME ...] [--agents NAME ...] [--seeds 10] [--steps N] [--split NAME]
                                  [--env NAME=VALUE ...] [--baseline NAME] [--out DIR]

Without further flags it is the whole table: every agent on six families with its preset, on the splits and for the
steps of ``FAMILIES``; agents whose subject is pictures are left out. Every pair of family and agent writes
``DIR/ENV/AGENT.csv`` (training returns over steps and seconds, one line per chunk and seed) and ``AGENT.npz`` (every
episode of every evaluation). Finished pairs are not run again, so several processes can make a long table in parts. All
results in DIR together give ``table.md``, ``differences.md``, ``conflicts.md`` (cosines between the tasks' gradients,
of the agents that log them), ``evaluations.csv`` and a figure for each family. ``--agents`` without a name runs nothing
and only makes these.

Scores are interquartile means over seeds and tasks of the last evaluation (never the best one) under the mean action,
with 95% bootstrap intervals over whole seeds. "s to 900" is the seconds of training, without compiling and evaluating,
after which the training policy's mean return over tasks and seeds first reached 900. Differences are those of
scores against the baseline's, with the seeds of both in pairs and without; beside them is the probability that a seed
of the agent earns more than one of the baseline on a task drawn at random (Agarwal et al. 2021).
"""

import argparse
import csv
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from report import markdown
from returns import value

import mtjax
from mtjax.evaluation import load_evaluations, save_evaluations
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
from mtjax.training.log import append_rows
from mtjax.training.programs import enable_compile_cache
from mtjax.training.run import Result
from mtjax.types import SPLITS, InputError


class Trial(NamedTuple):
    """Holds a family's split and the steps of each seed, by the kind of experience; None is the preset's."""

    split: str | None = None
    replay_steps: int | None = None
    rollout_steps: int | None = None


# Ten seeds of four tasks then train for about half a minute on an H200. On-policy steps cost less, so there are more.
# Most agents then make 12,000 to 31,000 updates.
FAMILIES = {
    "finger-spin-vary-size": Trial("hip-bmdp", 2_560_000, 20_000_000),
    "cheetah-run-vary-torso-length": Trial("hip-bmdp", 1_000_000, 20_000_000),
    "walker-run-vary-friction": Trial("hip-bmdp", 1_000_000, 5_000_000),
    "cartpole-swingup-vary-pole-mass": Trial("hip-bmdp", 1_000_000, 20_000_000),
    "cheetah-vary-direction": Trial(None, 500_000, 10_000_000),
    "reacher-vary-goal": Trial(None, 1_000_000, 20_000_000),
}
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
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=N", help="such as num_envs=64")
    parser.add_argument("--mark", type=float, default=900.0, help="the return whose time is told")
    parser.add_argument("--baseline", default="sac-conditioned", metavar="NAME", help="what differences are against")
    parser.add_argument("--out", type=Path, default=Path("runs") / f"learning-{time.strftime('%Y%m%d-%H%M%S')}")
    arguments = parser.parse_args()
    enable_compile_cache()
    for env in arguments.envs:
        for agent in arguments.agents:
            if not (arguments.out / env / f"{agent}.npz").exists():
                learn(arguments, env, agent)
    tabulate(arguments.out, arguments.mark, arguments.baseline)


def learn(arguments: argparse.Namespace, env: str, agent: str) -> None:
    """Train one agent on one family with its preset, and save the run."""
    print(f"{agent} on {env}", flush=True)
    trial = FAMILIES.get(env, Trial())
    split = arguments.split or trial.split
    settings = {"vary": dict(pair.split("=", 1) for pair in arguments.vary)} | ({"split": split} if split else {})
    settings |= {name: value(x) for name, x in (pair.split("=", 1) for pair in arguments.env)}
    program = mtjax.preset(env, agent, arguments.preset, seeing(agent, settings), **settings)
    given = trial.replay_steps if isinstance(program.learner.experience, Replay) else trial.rollout_steps
    steps = arguments.steps or given or program.plan.steps
    training = {name: int(value) for name, value in (pair.split("=", 1) for pair in arguments.training)}
    result = mtjax.train(
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
    if not result.finished:
        raise SystemExit(f"stopped before {agent} on {env} was finished; the same command goes on with it")
    save(arguments.out / env, agent, result)


def seeing(agent: str, settings: dict) -> dict[str, str]:
    """Return the settings by which an agent learns from pictures, if it has to and does not by itself."""
    plain = mtjax.agent(agent).representation == mtjax.agent("sac").representation
    return {"representation": "encoded"} if "pixels" in settings and plain else {}


def save(folder: Path, agent: str, result: Result) -> None:
    """Save one run. The evaluations come last, because they mark it as complete."""
    folder.mkdir(parents=True, exist_ok=True)
    kept = [name for name in (*_KEPT, *_CONFLICTS) if name in result.rows[-1]]
    (folder / f"{agent}.csv").unlink(missing_ok=True)
    append_rows(folder / f"{agent}.csv", [{name: row[name] for name in kept} for row in result.rows])
    save_evaluations(folder / f"{agent}.npz", result.evaluations)


def tabulate(out: Path, mark: float, baseline: str) -> None:
    """Make tables and figures of all runs in a folder."""
    head = ["family", "agent", *(f"{split}, IQM" for split in SPLITS), "worst task", f"s to {mark:.0f}"]
    head += ["training s", "wall s", "steps/s, all seeds"]
    lines, rows, differences = [], [], []
    for env in sorted({path.parent.name for path in out.glob("*/*.npz")}):
        curves, found = {}, {}
        for agent, curve, evaluations in runs(out / env):
            found[agent] = last_scores(evaluations)
            known = curve[np.all(np.isfinite(curve[:, :, -1]), axis=1)]  # chunks in which episodes ended
            if len(known):
                curves[agent] = (known[:, 0, 1], known[:, :, -1].T[:, :, None, None])
            lines.append(row(env, agent, curve, evaluations, mark))
            rows += evaluation_rows(env, agent, evaluations)
        differences += difference_rows(env, found, baseline)
        if curves:
            plot.compare(out / f"{env}.png", curves, f"return on training tasks of {env}")
    table = markdown(head, lines)
    (out / "table.md").write_text(table + "\n")
    head = ["family", "agent", "split", f"IQM less {baseline}'s, seeds in pairs", "seeds not in pairs"]
    (out / "differences.md").write_text(markdown([*head, "probability of improvement"], differences) + "\n")
    head = ["family", "agent", *(name.replace("_", " ") for name in _CONFLICTS)]
    (out / "conflicts.md").write_text(markdown(head, conflict_rows(out)) + "\n")
    (out / "evaluations.csv").unlink(missing_ok=True)
    append_rows(out / "evaluations.csv", rows)
    print(table)


def runs(folder: Path) -> Iterator[tuple]:
    """Return the runs of a family: agent, curve (lines (V, S) of ``_KEPT``) and evaluations."""
    known = list(mtjax.AGENTS)
    order = lambda path: known.index(path.stem) if path.stem in known else len(known)
    for path in sorted(folder.glob("*.npz"), key=order):
        with path.with_suffix(".csv").open(newline="") as file:
            lines = [[float(line[name] or "nan") for name in _KEPT] for line in csv.DictReader(file)]
        curve = np.array(lines)
        seeds = len(np.unique(curve[:, 0]))
        yield path.stem, curve.reshape(-1, seeds, len(_KEPT)), load_evaluations(path)


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
        with path.open(newline="") as file:
            rows = [line for line in csv.DictReader(file) if line.get(_CONFLICTS[0])]
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
    try:
        main()
    except (InputError, FileExistsError) as error:
        raise SystemExit(f"error: {error}") from None
