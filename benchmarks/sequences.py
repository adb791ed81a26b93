"""Measure ways to remember tasks that are learned one after another: performance, forgetting and forward transfer.

    python benchmarks/sequences.py goals|slippery|cw10|cw20 [--methods NAME ...] [--seeds 10] [--each STEPS]
                                   [--evaluations N] [--training NAME=VALUE ...] [--within SECONDS]
                                   [--devices 0 ...] [--out DIR]

``goals`` are four goals of a point mass. ``slippery`` is a walker that is blind to the friction of its ground, which
changes: its score while learning tells whether networks stay able to learn (as in Dohare et al. 2024). ``cw10`` is
Continual World's order of ten tasks, on this Meta-World with its second rewards, and ``cw20`` the same twice; in the
second round tasks have the output layers of the first. Every method is a process of its own with all seeds in one
program. ``scratch`` begins the agent anew where a task ends, so that each task is learned alone: transfer is measured
by it. Seeds are those of the environment too, so that methods are paired.

A method is NAME of --agent.continual or --agent.plasticity, or NAME:SETTING=VALUE:..., such as
ewc:ewc_coefficient=100 or redo:redo_every=500. Each writes ``OUT/METHOD.json`` with the scores (S, V, N) of every
evaluation of all tasks; in its name colons and equals signs are dashes. Finished methods are not run again. One that
was stopped, also by ``--within``, goes on where it was if the same command is given again; until it is finished its run
is in ``OUT/METHOD.run``. ``--training`` replaces settings of the agent or the loop.

Scores are shares of episodes with success at any step, or returns divided by the length of an episode. The table has
performance, forgetting and forward transfer (``mtjax.report.sequences``) with intervals over seeds, and the paired
difference of performance from ``none``. ``OUT/curves.csv`` has the mean score of every task at every evaluation, and
``OUT/curves.png`` shows it, with the part of the sequence in which the task is learned in grey.
"""

import argparse
import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import parts
import resumable
from matplotlib.figure import Figure
from report import markdown, record, run_main, settings_of, write_lines

from mtjax.agents.parts.plasticity import PLASTICITY
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.report import figures, sequences, stats


class Protocol(NamedTuple):
    """Holds what is played in which order, and how it is learned unless other settings are given."""

    env: str
    agent: str
    tasks: int
    each: int  # steps of every environment for each task
    evaluations: int  # during each task
    episodes: int  # of each task in an evaluation
    rounds: int = 1
    best: float = 0.0  # return that is the score 1; 0 takes success
    settings: dict[str, Any] = {}  # of the agent and the loop  # noqa: RUF012
    methods: tuple[str, ...] = ()
    family: dict[str, Any] = {}  # settings of the environment  # noqa: RUF012
    curriculum: str = "sequence"


_COMMON = {"conditioning": "one-hot", "normalize_observations": False}
_GOALS = {"num_envs": 8, "batch_size": 32, "hidden": (128, 128), "replay_size": 100_000, "warmup_steps": 200}
# Those of mt10's preset for a GPU, but for smaller critics, as they fit one task at a time.
_CW = {"num_envs": 256, "batch_size": 128, "replay_size": 400_000, "updates_per_step": 8, "warmup_steps": 40}
_CW |= {"n_step": 8, "gamma": 0.97, "initial_temperature": 0.001, "temperature_lr": 1e-3, "shared_temperature": False}
_CW |= {"actor_hidden": (256, 256), "critic_hidden": (512, 512), "heads": "per-task", "reset_optimizer": True}
_OF_GOALS = ("ewc:ewc_coefficient=100", "l2:l2_coefficient=1", "mas:mas_coefficient=10", "clone")
_OF_GOALS = ("scratch", "none", "packnet:retrain_updates=2000", *_OF_GOALS)
# Coefficients are a hundredth of Continual World's, as brc's values are at most 10 and those there some hundreds.
_OF_CW = ("ewc:ewc_coefficient=200", "l2:l2_coefficient=2000", "mas:mas_coefficient=200", "clone")
_OF_CW = ("scratch", "none", "packnet:retrain_updates=5000", *_OF_CW)
# With 0.02, worlds blow up with the default iterations of MJX and Warp: docs/results/sequences.md.
_FRICTIONS = {"vary": {"friction": "0.1,0.15,0.2,0.3,0.4,0.6,0.8,1.2,1.6,2"}, "split": "none"}
_BLIND = {"conditioning": "none", "normalize_observations": True, "num_envs": 1024}
_OF_FRICTIONS = ("scratch", "none", "redo", "continual-backprop", "shrink-and-perturb")
PROTOCOLS = {
    "goals": Protocol(
        *("point-mass-vary-goal", "sac", 4, 2000, 4, 4, 1, 100.0, _GOALS, _OF_GOALS),
        family={"num_tasks": 4, "split": "none"},
    ),
    "slippery": Protocol(
        *("walker-walk", "ppo", 10, 3200, 2, 4, 1, 1000.0, _BLIND, _OF_FRICTIONS, _FRICTIONS, "shuffled")
    ),
    "cw10": Protocol("cw10", "brc", 10, 3000, 4, 10, 1, 0.0, _CW, _OF_CW),
    "cw20": Protocol("cw10", "brc", 10, 3000, 2, 10, 2, 0.0, _CW, _OF_CW),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", choices=list(PROTOCOLS))
    parser.add_argument("--methods", nargs="+", help="by default those of the sequence")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--agent", help="by default that of the sequence")
    parser.add_argument("--env", help="the tasks, by default those of the sequence; there must be as many")
    for name in ("tasks", "each", "evaluations", "episodes", "rounds"):
        parser.add_argument(f"--{name}", type=int, help="by default that of the sequence")
    parser.add_argument("--out", type=Path, help="by default runs/SEQUENCE")
    parts.add_flags(parser)
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    arguments = parser.parse_args()
    protocol = PROTOCOLS[arguments.sequence]
    asked = {name: x for name, x in vars(arguments).items() if name in Protocol._fields and x is not None}
    protocol, out = protocol._replace(**asked), arguments.out or Path("runs") / arguments.sequence
    if parts.is_part():
        return measure(arguments, protocol, out, arguments.methods[0])
    todo = [part(arguments, protocol, out, method) for method in protocol.methods]
    left = parts.run_parts(__file__, todo, out, arguments)
    parts.end(table(out), out, left)


def part(arguments: argparse.Namespace, protocol: Protocol, out: Path, method: str) -> parts.Part:
    """Return the part of a method."""
    numbers = ("env", "agent", "tasks", "each", "evaluations", "episodes", "rounds")
    options = [f"--{name}={getattr(protocol, name)}" for name in numbers]
    options += [f"--seeds={arguments.seeds}", f"--out={out}", f"--methods={method}"]
    return parts.Part(name_of(method), [arguments.sequence, *options, "--training", *arguments.training])


def name_of(method: str) -> str:
    """Return the name of a method's part, which is that of a file."""
    return method.replace(":", "-").replace("=", "-")


def measure(arguments: argparse.Namespace, protocol: Protocol, out: Path, method: str) -> None:
    """Learn the tasks by a method, or go on with the run that was stopped, and write the scores of all evaluations."""
    enable_compile_cache()
    name, *words = method.split(":")
    chunk, played = protocol.each // protocol.evaluations, protocol.tasks * protocol.rounds
    kind = "plasticity" if name in PLASTICITY and name != "none" else "continual"
    given = {**_COMMON, **protocol.settings, kind: name, **settings_of([*arguments.training, *words])}
    given |= {"curriculum": f"{protocol.curriculum}:{protocol.each}", "chunk_steps": chunk}
    plain = with_preset(protocol.env, protocol.agent, **protocol.family)
    agent, settings = configure(plain.learner, plain.training, given)
    folder = out / f"{name_of(method)}.run"
    result = resumable.train(
        folder,
        plain.family,
        agent,
        settings=settings,
        steps=played * protocol.each * settings.num_envs,
        seeds=arguments.seeds,
        eval_every=chunk * settings.num_envs,
        eval_episodes=protocol.episodes,
    )
    found = result.evaluations
    scores = found.returns["train"] / protocol.best if protocol.best else found.metrics["success_ever"]["train"]
    figures = {
        "method": method,
        "scores": rounded(scores),
        "success_at_end": rounded(found.metrics["success"]["train"]) if "success" in found.metrics else None,
        "returns": rounded(found.returns["train"], 2),
        "tasks": plain.family.labels("train"),
        "order": [int(settings.plays.rows(jnp.int32(i * protocol.each), protocol.tasks)[0]) for i in range(played)],
        **resumable.summary(result),
    }
    parts.write_result(out / f"{name_of(method)}.json", record(arguments, figures))
    shutil.rmtree(folder, ignore_errors=True)


def rounded(scores: np.ndarray, digits: int = 5) -> list[Any]:
    """Return the means over episodes of scores (S, V, N, episodes)."""
    return np.asarray(np.round(np.float64(scores.mean(axis=-1)), digits)).tolist()


class Measures(NamedTuple):
    """Holds what is measured of one method."""

    performance: np.ndarray  # (S,)
    forgetting: np.ndarray  # (S,) without that of the last task, which is 0
    areas: np.ndarray  # (S, P) of all parts of the sequence


def measures(result: dict[str, Any]) -> Measures:
    """Return the measures of a method's scores. In a second round tasks count once more."""
    scores = np.array(result["scores"])[:, :, result["order"]]
    spans = sequences.spans_of(scores.shape[1], scores.shape[2])
    lost = sequences.forgetting(scores, spans)[:, :-1].mean(axis=1)
    return Measures(sequences.performance(scores), lost, sequences.areas(scores, spans))


def table(out: Path) -> str:
    """Return the measures of all methods that have finished, and write the curves of all."""
    results = [json.loads(path.read_text()) for path in sorted(out.glob("*.json"))]
    write_lines(out / "curves.csv", [line for result in results for line in curves(result)])
    draw(out / "curves.png", results)
    found = {result["method"]: measures(result) for result in results}
    titles = ["performance", "forgetting", "score while learning", "forward transfer", "performance less none's"]
    return markdown(["method", *titles], [row(method, found) for method in found])


def row(method: str, found: dict[str, Measures]) -> list[str]:
    """Return a method's line of the table."""
    own, transfer, against = found[method], "-", "-"
    alone, plain = (None if method == name else found.get(name) for name in ("scratch", "none"))
    if alone is not None:
        gained = sequences.forward_transfer(own.areas, alone.areas.mean(axis=0))
        transfer = f"{stats.seed_interval(np.nanmean(gained, axis=1)):.2f}"
    if plain is not None and len(plain.performance) == len(own.performance):
        against = f"{stats.paired_difference(own.performance, plain.performance):.2f}"
    shown = (own.performance, own.forgetting, own.areas.mean(axis=1))
    return [method, *(f"{stats.seed_interval(x):.2f}" for x in shown), transfer, against]


def curves(result: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the mean scores over seeds of all tasks, a line for each evaluation."""
    means = np.array(result["scores"]).mean(axis=0)
    lines = zip(result["steps"], means, strict=True)
    named = lambda scores: {task: round(float(x), 3) for task, x in zip(result["tasks"], scores, strict=True)}
    return [{"method": result["method"], "steps": steps, **named(scores)} for steps, scores in lines]


def draw(path: Path, results: list[dict[str, Any]]) -> None:
    """Draw the scores of every task over the steps of the sequence, a line for each method."""
    if not results:
        return
    order, tasks, steps = results[0]["order"], results[0]["tasks"], np.array(results[0]["steps"])
    figure = Figure(figsize=(8, 1 + 1.1 * len(tasks)), dpi=figures.DOTS_PER_INCH, layout="constrained")
    each = steps[-1] / len(order)
    for i, axes in enumerate(figure.subplots(len(tasks), sharex=True, sharey=True, squeeze=False)[:, 0]):
        for part in (part for part, task in enumerate(order) if task == i):
            axes.axvspan(part * each, (part + 1) * each, color="0.9", zorder=0)
        for index, result in enumerate(results):
            scores = np.array(result["scores"])[:, :, i]
            figures.draw_line(axes, np.array(result["steps"]), scores, result["method"].split(":")[0], index)
        axes.set_title(tasks[i].removeprefix("metaworld-"), fontsize=8, loc="left")
    figures.label_steps(axes)
    axes.set_ylabel("score")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", frameon=False)
    figure.savefig(path)


if __name__ == "__main__":
    run_main(main)
