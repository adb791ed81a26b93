"""Measure how well and how fast agents learn: every agent on every family, many seeds in one program each.

    python benchmarks/learning.py [--envs NAME ...] [--agents NAME ...] [--seeds 10] [--steps N] [--split NAME]
                                  [--env NAME=VALUE ...] [--baseline NAME] [--best] [--unfinished] [--devices 0 1 ...]
                                  [--out DIR]

Without further flags it is the whole table: every agent on six families, on the splits and for the steps of
``FAMILIES``; agents whose subject is pictures are left out. Agents with a replay all have the worlds, updates a step,
batch, replay and warm-up of the baseline's preset, and other settings of their own. ``--best`` gives each its own
preset in all; then agents may differ in updates and experience. PPO has its own preset and its own number of steps.
``care-text`` is ``care`` as published: it reads a sentence that says what the task asks for.

Every pair of family and agent writes
``DIR/ENV/AGENT.csv`` (training returns over steps and seconds, one line per chunk and seed) and ``AGENT.npz`` (every
episode of every evaluation), and the policy of its first seed, ``DIR/policies/ENV/AGENT``, which ``mtjax.load`` and
``docs/make_films.py`` take. Finished pairs are not run again, so several processes can make a long table in parts. If
the command is given again with the same DIR, a pair that was stopped goes on where it was, and one that was killed goes
on from its last evaluation. Until a pair is finished its run is in ``DIR/ENV/AGENT``. Its checkpoints need room for
three training states: 0.1 GB for PPO, and 1 to 6 GB for agents with a replay (gpu presets, ten seeds). With
``--devices`` every pair is a process of its own, on one of these GPUs; ``--within`` ends the call after some seconds.
``AGENT.json`` has the settings of agent and loop, and ``origin.json`` machine, versions and commit of every call.

All results in DIR together give ``table.md``, ``differences.md``, ``conflicts.md`` (cosines between the tasks'
gradients, of the agents that log them), ``evaluations.csv`` and a figure for each family. ``--agents`` without a name
runs nothing and only makes these. ``table.md`` names unfinished pairs, and ``--unfinished`` gives them lines of their
last evaluation, marked with its steps.

Scores are interquartile means over seeds and tasks of the last evaluation (never the best one) under the mean action,
with 95% bootstrap intervals over whole seeds. "s to 900" is the seconds of training, without compiling and evaluating,
after which the training policy's mean return over tasks and seeds first reached 900. Differences are those of scores
from the baseline's, with intervals over pairs of seeds with the same number, and over the seeds of each apart. Their p
is that of a t-test of these pairs, each seed's mean over tasks, by Holm's method for all differences of the table.
Beside them is the probability that a seed of the agent earns more than one of the baseline on a task drawn at random
(Agarwal et al. 2021).
"""

import argparse
import dataclasses
import itertools
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from parts import Part, add_flags, dated, is_part, require_all, run_parts, whole, write_result
from report import markdown, note_origin, read_lines, record, run_main, settings_of, texts_of, write_lines
from resumable import train

import mtjax
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import RunConfig, configure
from mtjax.experience.replay import Replay
from mtjax.learning.evaluation import Evaluations, load_evaluations, save_evaluations
from mtjax.learning.trials import require_whole
from mtjax.report import figures as plot
from mtjax.report.stats import (
    Interval,
    Statistic,
    holm,
    iqm,
    paired_difference,
    paired_p_value,
    probability_of_improvement,
    seed_interval,
    unpaired_difference,
)
from mtjax.saved import policy_files
from mtjax.saved.result import Result
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


# A family of any number of tasks has 640 worlds on a GPU, the finger 2,560, and 8 updates after each of their steps: so
# 8M steps are 100,000 updates, where the cheetahs' curves should be flat. On-policy steps cost less, so there are more.
FAMILIES = {
    "finger-spin-vary-size": Trial("hip-bmdp", 20_480_000, 20_000_000),
    "cheetah-run-vary-torso-length": Trial("hip-bmdp", 8_000_000, 20_000_000),
    "walker-run-vary-friction": Trial("hip-bmdp", 4_000_000, 5_000_000),
    "cartpole-swingup-vary-pole-mass": Trial("hip-bmdp", 2_560_000, 20_000_000),
    "cheetah-vary-direction": Trial(None, 8_000_000, 10_000_000),
    "reacher-vary-goal": Trial(None, 1_000_000, 20_000_000),
}
# What PPO's networks see of the task, from all to nothing, by name: the agent, and its settings.
LADDER: dict[str, tuple[str, dict[str, Any]]] = {
    "told": ("ppo", {"conditioning": "parameters"}),
    "blind": ("ppo", {"conditioning": "none"}),
    "last-steps": ("ppo", {"conditioning": "inferred"}),
    "rl2": ("ppo", {"conditioning": "recurrent"}),
    **{name: ("ppo", {"conditioning": "posterior", "inference": name}) for name in ("varibad", "pearl", "cadm")},
}
VARIANTS = {"care-text": ("care", {"conditioning": "text"}), **LADDER}
_SHARED = ("num_envs", "chunk_steps", "updates_per_step", "batch_size", "replay_size", "warmup_steps")
_MOST_LINES = 7  # of a figure
UNFINISHED = "show the last evaluation of unfinished pairs too, marked with its steps"
_FROM_PICTURES = ("drq", "sac-ae")  # from vectors they are plain conditioning
_KEPT = ("seed", "steps", "seconds", "wall_seconds", "return")
_DIAGNOSES = ("success", "entropy", "kl", "clip_fraction", "explained_variance", "critic_loss")
_CONFLICTS = ("critic_cosine", "critic_conflict", "actor_cosine", "actor_conflict")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="*", default=list(FAMILIES), metavar="NAME")
    agents = [name for name in mtjax.AGENTS if name not in _FROM_PICTURES]
    parser.add_argument("--agents", nargs="*", default=agents, choices=[*mtjax.AGENTS, *VARIANTS], metavar="NAME")
    parser.add_argument("--best", action="store_true", help="every agent with its own preset")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=whole, help="by default those of FAMILIES, else the preset's")
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
    parser.add_argument("--out", type=Path, default=dated("learning"))
    add_flags(parser)
    arguments = parser.parse_args()
    arguments.equal_to = "" if arguments.best else arguments.baseline
    named = [(env, agent) for env in arguments.envs for agent in arguments.agents]
    left = learn_all(arguments, __file__, named, lambda *_: arguments)
    if not is_part():
        tabulate(arguments.out, arguments.mark, arguments.baseline, arguments.unfinished)
    require_all(left)


def learn_all(
    arguments: argparse.Namespace,
    script: str,
    named: Sequence[tuple[str, str]],
    request: Callable[[str, str], argparse.Namespace],
) -> list[str]:
    """Write the results of pairs of family and agent, here or each in a process of its own, and return what is left.

    Args:
        request: the arguments of ``learn`` for a family and an agent.
    """
    if arguments.devices == [""]:
        enable_compile_cache()
        for env, agent in named:
            learn(request(env, agent), env, agent)
        return []
    words = [*sys.argv[1:], "--devices", "", "--out", str(arguments.out)]  # the folder may be named after the clock
    of_all = [Part(f"{env}/{agent}", [*words, "--envs", env, "--agents", agent], ending=".npz") for env, agent in named]
    return run_parts(script, of_all, arguments.out, arguments)


def learn(arguments: argparse.Namespace, env: str, agent: str) -> None:
    """Write the results of one agent on one family, unless they are there already. Then remove its run."""
    folder = arguments.out / env / agent
    if not (arguments.out / env / f"{agent}.npz").exists():
        note_origin(arguments, arguments.out)
        result = trained(arguments, env, agent, folder)
        (arguments.out / env).mkdir(parents=True, exist_ok=True)
        write_result(arguments.out / env / f"{agent}.json", record(arguments, settings_used(result, folder)))
        save(arguments.out / env, agent, result)
    if (folder / "config.json").exists():
        keep_policy(folder, arguments.out / "policies" / env / agent)
    shutil.rmtree(folder, ignore_errors=True)


def keep_policy(run: Path, place: Path) -> None:
    """Write the policy of the first seed, in place of one that a killed process may have half written."""
    shutil.rmtree(place, ignore_errors=True)
    policy_files.write(run, place)


def trained(arguments: argparse.Namespace, env: str, agent: str, folder: Path) -> Result:
    """Train one agent on one family, or go on with the run that was stopped in the folder."""
    program = program_of(arguments, env, agent)
    trial = FAMILIES.get(env, Trial())
    given = trial.replay_steps if isinstance(program.learner.experience, Replay) else trial.rollout_steps
    steps = arguments.steps or given or program.plan.steps
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
        **settings_of(arguments.training),
        quiet=False,
    )


def program_of(arguments: argparse.Namespace, env: str, agent: str) -> RunConfig:
    """Return an agent's preset on a family, and for one with a replay the loop and replay that it shares with others.

    These are the preset's of the agent ``equal_to``, if given, and on the environment ``as_in``, if given, such as that
    of all tasks where the family is one of them: each task has as many worlds as there.
    """
    settings = family_settings(arguments.env, arguments.vary, arguments.split or FAMILIES.get(env, Trial()).split)
    name, own = VARIANTS.get(agent, (agent, {}))
    program = mtjax.preset(env, name, arguments.preset, {**seeing(name, settings), **own}, **settings)
    as_in = getattr(arguments, "as_in", "") or env
    if not (arguments.equal_to or as_in != env) or not isinstance(program.learner.experience, Replay):
        return program
    family = program.family if as_in == env else mtjax.make(as_in, **settings)
    other = mtjax.preset(as_in, arguments.equal_to or name, arguments.preset, family=family)
    held = {**dataclasses.asdict(other.training), **dataclasses.asdict(other.learner.experience)}
    learner, training = configure(program.learner, program.training, {name: held[name] for name in _SHARED})
    return dataclasses.replace(program, learner=learner, training=training)


def settings_used(result: Result, folder: Path) -> dict[str, Any]:
    """Return the settings of a run's agent and loop, and its clocks."""
    config = json.loads((folder / "config.json").read_text())
    clocks = {"training_seconds": result.seconds, "compile_seconds": result.compile_seconds}
    return {"config": config, **clocks, "wall_seconds": result.rows[-1]["wall_seconds"]}


def family_settings(given: Sequence[str], vary: Sequence[str], split: str | None) -> dict[str, Any]:
    """Return the settings of a family from words such as pixels=64, from what it varies, and from its split."""
    settings: dict[str, Any] = {"vary": texts_of(vary)} | ({"split": split} if split else {})
    return settings | settings_of(given)


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
    kept = [name for name in (*_KEPT, *_DIAGNOSES, *_CONFLICTS) if name in result.rows[-1]]
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
    """Return all finished pairs by family, the best agent first; if asked, also others that were evaluated."""
    found = [Pair(x.parent.name, x.stem, x.with_suffix(".csv"), load_evaluations(x)) for x in out.glob("*/*.npz")]
    for folder, agent in stopped(out) if unfinished else ():
        if (evaluated := folder / "evaluations.npz").exists():
            evaluations = load_evaluations(evaluated)
            found.append(Pair(folder.parent.name, agent, folder / "metrics.csv", evaluations, finished=False))
    return sorted(found, key=lambda pair: (pair.env, -train_score(pair.evaluations), pair.agent))


def train_score(evaluations: Evaluations) -> float:
    """Return the interquartile mean on training tasks of the last evaluation, by which tables are sorted."""
    return float(iqm(last_scores(evaluations)["train"]))


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
        differences += differences_of(env, found, baseline)
        for path, few in figures(out / f"{env}.png", curves, baseline):
            plot.compare(path, few, f"return on training tasks of {env}")
    table = markdown(head, lines) + list_stopped(out)
    (out / "table.md").write_text(table + "\n")
    head = ["family", "agent", "split", f"IQM less {baseline}'s, over pairs of seeds", "p by Holm", "holds"]
    head += ["over the seeds of each", "probability of improvement"]
    (out / "differences.md").write_text(markdown(head, difference_rows(differences)) + "\n")
    head = ["family", "agent", *(name.replace("_", " ") for name in _CONFLICTS)]
    (out / "conflicts.md").write_text(markdown(head, conflict_rows(out)) + "\n")
    write_lines(out / "evaluations.csv", rows)
    print(table)


def row(env: str, agent: str, curve: np.ndarray, evaluations, mark: float) -> list[str]:
    """Return the cells of one run's line: last evaluation by split, times, rate."""
    scores = last_scores(evaluations)
    cells = [env, agent]
    cells += [f"{seed_interval(scores[split], iqm):.0f}" if split in scores else "-" for split in SPLITS]
    cells.append(f"{scores['train'].mean(axis=0).min():.0f}")
    steps, seconds, wall, returns = np.moveaxis(curve[:, :, 1:], -1, 0).mean(axis=-1)
    reached = np.flatnonzero(returns >= mark)
    cells.append(f"{seconds[reached[0]]:.1f}" if len(reached) else "-")
    rate = steps[-1] * curve.shape[1] / seconds[-1]
    return [*cells, f"{seconds[-1]:.1f}", f"{wall[-1]:.0f}", f"{rate:,.0f}"]


def figures(path: Path, curves: dict[str, Any], baseline: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Return files and their curves, with few lines each: the baseline's, and those of others in their order."""
    others, common = [name for name in curves if name != baseline], {baseline} & set(curves)
    size = _MOST_LINES - len(common)
    for k in range(0, max(len(others), len(common)), size):
        shown = {*others[k : k + size], *common}
        numbered = path if k == 0 else path.with_stem(f"{path.stem}-{k // size + 1}")
        yield numbered, {name: curve for name, curve in curves.items() if name in shown}


class Difference(NamedTuple):
    """Holds the difference of an agent's scores from the baseline's on a split."""

    env: str
    agent: str
    split: str
    paired: Interval | None  # None if the numbers of seeds differ
    p: float  # of a paired t-test over seeds; nan without pairs
    unpaired: Interval
    improvement: Interval


def differences_of(
    env: str, found: dict[str, dict[str, np.ndarray]], baseline: str, statistic: Statistic = iqm
) -> list[Difference]:
    """Return each agent's differences from the baseline, one for each split."""
    differences = []
    for agent, scores in found.items():
        for split in scores if agent != baseline and baseline in found else ():
            pair = scores[split], found[baseline][split]
            paired = paired_difference(*pair, statistic) if len(pair[0]) == len(pair[1]) else None
            p = paired_p_value(*pair) if paired else np.nan
            apart = unpaired_difference(*pair, statistic), probability_of_improvement(*pair)
            differences.append(Difference(env, agent, split, paired, p, *apart))
    return differences


def difference_rows(differences: Sequence[Difference]) -> list[list[str]]:
    """Return a table's lines of differences, with p by Holm's method for all of them."""
    adjusted = holm(np.array([x.p for x in differences]))
    lines = []
    for x, p in zip(differences, adjusted, strict=True):
        paired = f"{x.paired:+.1f}" if x.paired else "-"
        tested = ["-", "-"] if np.isnan(p) else [f"{p:.4f}", "yes" if p < 0.05 else "no"]
        lines.append([x.env, x.agent, x.split, paired, *tested, f"{x.unpaired:+.1f}", f"{x.improvement:.2f}"])
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


def by_episode(scores: np.ndarray, trial: int) -> np.ndarray:
    """Return the last of scores (S, V, T, episodes) by the episode of the trial (S, T, trial), means over trials."""
    require_whole(scores.shape[-1], trial)
    return scores[:, -1].reshape(len(scores), scores.shape[2], -1, trial).mean(axis=2)


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
