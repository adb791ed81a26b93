"""Measure what it is worth to know a hidden task, and how much of it agents find out: the ladder from told to blind.

    python benchmarks/adaptation.py [--envs NAME ...] [--agents NAME ...] [--trials 2] [--seeds 10] [--steps N]
                                    [--split NAME] [--vary NAME=VALUES ...] [--training NAME=VALUE ...]
                                    [--devices 0 1 ...] [--out DIR]

All rungs are PPO with one preset, and differ in what their networks see of the task alone: ``told`` its parameters,
``blind`` nothing, ``last-steps`` an encoding of the last eight steps, ``rl2`` a recurrent memory of the trial (Duan et
al. 2016), ``varibad``, ``pearl`` and ``cadm`` a belief that is inferred by the losses of these papers (``posterior``).
A trial is ``--trials`` episodes of one task and one memory; that of ``last-steps`` is one episode, as its memory is of
the episode alone. By default families are those whose bodies differ, on
HiP-BMDP's split, for the steps of ``learning.py``. Where the family itself can tell its task, as ``hidden-bandit`` and
``grid-navi`` can, ``told`` has it do so.

``learning.py`` says what every rung writes into ``DIR/ENV``, how the command goes on where it was stopped, and what
``--devices`` does: ``AGENT.npz`` has every episode of every evaluation, those of a trial one after another.

All results in DIR give ``ladder.md``: of the last evaluation, under the mean action, the return of the first and of the
last episode of trials, and their mean; by split; means over tasks with 95% intervals over seeds. ``differences.md`` has
the last episode's differences from ``told`` and from ``blind``, over pairs of seeds of the same number.
``ENV-ladder.png`` draws the return by the episode of the trial.
"""

import argparse
import itertools
from collections.abc import Mapping
from pathlib import Path

import learning
import numpy as np
from parts import add_flags, dated, is_part, require_all, whole
from report import markdown, run_main

import mtjax
from mtjax.learning.evaluation import Evaluations
from mtjax.names import InputError
from mtjax.report import figures
from mtjax.report.stats import seed_interval
from mtjax.types import SPLITS

FAMILIES = (
    *("finger-spin-vary-size", "cheetah-run-vary-torso-length"),
    *("walker-run-vary-friction", "cartpole-swingup-vary-pole-mass"),
)
_ENDS = ("told", "blind")  # what differences are against
_FORGETFUL = ("last-steps",)  # whose memory is of one episode


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="*", default=list(FAMILIES), metavar="NAME")
    rungs = list(learning.LADDER)
    parser.add_argument("--agents", nargs="*", default=rungs, choices=rungs, metavar="NAME", help=", ".join(rungs))
    parser.add_argument("--trials", type=int, default=2, help="episodes of a trial")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=whole, help="by default those of learning.py, else the preset's")
    parser.add_argument("--preset", default="auto")
    parser.add_argument("--split", help="by default that of learning.py, else the family's")
    parser.add_argument("--evaluations", type=int, default=4)
    parser.add_argument("--eval-trials", type=int, default=5, help="trials of each task in every evaluation")
    parser.add_argument("--env", nargs="*", default=[], metavar="NAME=VALUE", help="settings of families: size=3")
    parser.add_argument("--vary", nargs="*", default=[], metavar="NAME=VALUES", help="besides what the family varies")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the loop or all rungs")
    parser.add_argument("--out", type=Path, default=dated("adaptation"))
    add_flags(parser)
    arguments = parser.parse_args()
    if min(arguments.trials, arguments.eval_trials) < 1:
        raise InputError("--trials and --eval-trials must be at least 1")
    named = [(env, agent) for env in arguments.envs for agent in arguments.agents]
    left = learning.learn_all(arguments, __file__, named, lambda env, agent: request(arguments, env, agent))
    if not is_part():
        print(tabulate(arguments.out))
    require_all(left)


def request(arguments: argparse.Namespace, env: str, agent: str) -> argparse.Namespace:
    """Return what ``learning.learn`` reads. Whole trials are evaluated, and a family tells its task if it must."""
    words = list(arguments.env)
    if agent == "told" and hasattr(mtjax.make(env, **learning.family_settings(words, [], None)), "told"):
        words.append("told=true")
    given = {"env": words, "eval_episodes": arguments.eval_trials * arguments.trials, "equal_to": ""}
    given["training"] = [*arguments.training, f"trials={1 if agent in _FORGETFUL else arguments.trials}"]
    return argparse.Namespace(**{**vars(arguments), **given})


def scores_of(evaluations: Evaluations) -> dict[str, np.ndarray]:
    """Return the last evaluation's returns (S, T, episodes of a trial), means over trials, without empty splits."""
    splits = (split for split, x in evaluations.returns.items() if x.size)
    return {split: learning.by_episode(evaluations.returns[split], evaluations.trial) for split in splits}


def tabulate(out: Path) -> str:
    """Write tables and figures of all finished rungs, and return the ladder."""
    lines, differences = [], []
    for env, of_env in itertools.groupby(learning.pairs(out), lambda pair: pair.env):
        found = {pair.agent: scores_of(pair.evaluations) for pair in of_env}
        found = {rung: found[rung] for rung in learning.LADDER if rung in found}
        lines += [line(env, rung, split, x) for rung, scores in found.items() for split, x in scores.items()]
        last = {rung: {split: x[..., -1] for split, x in scores.items()} for rung, scores in found.items()}
        differences += [(end, x) for end in _ENDS for x in learning.differences_of(env, last, end, np.mean)]
        draw(out / f"{env}-ladder.png", env, found)
    head = ["family", "rung", "seeds", "split", "tasks", "first episode", "last episode", "mean"]
    table = markdown(head, lines) + learning.list_stopped(out)
    (out / "ladder.md").write_text(table + "\n")
    rows = learning.difference_rows([x for _, x in differences])
    rows = [[*cells[:3], end, *cells[3:6]] for (end, _), cells in zip(differences, rows, strict=True)]
    head = [
        "family",
        "rung",
        "split",
        "against",
        "last episode's difference, over pairs of seeds",
        "p by Holm",
        "holds",
    ]
    (out / "differences.md").write_text(markdown(head, rows) + "\n")
    return table


def line(env: str, rung: str, split: str, returns: np.ndarray) -> list[str]:
    """Return the cells of a rung's returns (S, T, episodes of a trial) on a split."""
    form = ".3g" if np.abs(returns).max() < 100 else ".0f"
    cells = [format(seed_interval(x), form) for x in (returns[..., 0], returns[..., -1], returns.mean(axis=-1))]
    return [env, rung, str(len(returns)), split, str(returns.shape[1]), *cells]


def draw(path: Path, env: str, found: Mapping[str, Mapping[str, np.ndarray]]) -> None:
    """Draw the return of every rung by the episode of the trial, one panel for each split.

    A rung whose trials are single episodes has one return for all.
    """
    from matplotlib.figure import Figure

    splits = [split for split in SPLITS if any(split in scores for scores in found.values())]
    figure = Figure(figsize=(1.5 + 4 * len(splits), 4), dpi=figures.DOTS_PER_INCH, layout="constrained")
    most = max(x.shape[-1] for scores in found.values() for x in scores.values())
    panels = figure.subplots(1, len(splits), sharey=True, squeeze=False)[0]
    for axes, split in zip(panels, splits, strict=True):
        figures.style(axes)
        for rung, returns in ((rung, scores[split]) for rung, scores in found.items() if split in scores):
            index, means = list(learning.LADDER).index(rung), returns.mean(axis=1)
            figures.draw_line(axes, 1 + np.arange(most), np.broadcast_to(means, (len(means), most)), rung, index)
        axes.set(xlabel="episode of the trial", title=split, xticks=range(1, most + 1, -(-most // 10)))
        figures.show_from_zero(axes)
    for axes in panels[1:]:
        axes.set_ylabel("")
    figure.suptitle(env)
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside right center", frameon=False)
    figure.savefig(path)


if __name__ == "__main__":
    run_main(main)
