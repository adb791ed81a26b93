"""Measure what scales of rewards do: tasks whose rewards differ by .01, 1 and 100, with and without PopArt.

    python benchmarks/scales.py goals|tables|games [--agents NAME ...] [--seeds 10] [--steps N] [--evaluations 10]
                                [--episodes 20] [--scales .01 1 100] [--training NAME=VALUE ...] [--within SECONDS]
                                [--devices 0 ...] [--out DIR]

``goals`` are three goals of a point mass, a third of a circle apart and equally far from the start, whose tasks differ
by goal and scale. ``tables`` are three small decision processes with discrete actions. ``games`` are three of
MinAtar's, which gymnax brings. Each agent learns the tasks twice: with the scales, and as its own control with all
scales 1. ``impala`` and ``distral`` learn from rewards as they are; ``impala-popart`` and ``distral-popart`` have
PopArt in the units of each task (Hessel et al. 2019); and ``impala-clipped`` clips rewards to [-1, 1], as was usual
before.

Every run is a process of its own with all seeds in one program, and writes ``OUT/AGENT.json`` or
``OUT/AGENT-control.json`` with the returns (S, V, T) of all evaluations, under the mean action, each divided by its
task's scale. Finished runs are not run again; a run that was stopped goes on from ``OUT/RUN.run`` if the same command
is given again.

The table has a line for each agent and scale: the return in the last evaluation and the mean over all, that is the area
under the curve, with intervals over seeds, and the paired differences of both from the control, whose seeds are the
same.
"""

import argparse
import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import parts
import resumable
from report import difference, markdown, record, run_main, settings_of

from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.report import stats

AGENTS: dict[str, tuple[str, dict[str, Any]]] = {
    "impala": ("impala", {"value_normalization": "none"}),
    "impala-clipped": ("impala", {"value_normalization": "none", "reward_clip": 1.0}),
    "impala-popart": ("impala", {"value_normalization": "popart"}),
    "distral": ("distral", {"scaling": "none"}),
    # The published rate of the estimates, 3e-4, is one of longer runs.
    "distral-popart": ("distral", {"scaling": "popart", "target_rate": 0.01}),
}
CONTROL = "control"
_ANGLES = [2 * math.pi * i / 3 for i in range(3)]
_GOALS = {"goal-x": [0.2 * math.cos(x) for x in _ANGLES], "goal-y": [0.2 * math.sin(x) for x in _ANGLES]}

_GAMES = [f"gymnax:{game}-MinAtar" for game in ("Breakout", "SpaceInvaders", "Freeway")]


class Protocol(NamedTuple):
    """Holds the tasks, the agents, and how these learn unless other settings are given."""

    env: str
    agents: tuple[str, ...]
    steps: int  # of every environment, of which each task has ``num_envs``
    family: dict[str, Any]
    settings: dict[str, dict[str, Any]]  # by the learner


_IMPALA = {"conditioning": "one-hot", "hidden": (64, 64), "num_envs": 16, "gamma": 0.97}
_DISTRAL = {"hidden": (64, 64), "num_envs": 8, "batch_size": 64, "replay_size": 40_000, "warmup_steps": 100}
# What the regulariser adds to targets is in their units too: if it outweighs rewards, these units stay too large.
_DISTRAL |= {"initial_temperature": 0.01, "gamma": 0.97}
PROTOCOLS = {
    "goals": Protocol(
        "point-mass-vary-goal",
        ("impala", "impala-popart", "distral", "distral-popart"),
        10_000,
        {"vary": _GOALS, "combine": "paired", "split": "none"},
        {"impala": _IMPALA, "distral": _DISTRAL},
    ),
    "tables": Protocol(
        "tabular-mdp",
        ("impala", "impala-popart"),
        5000,
        {"num_tasks": 3, "split": "none"},
        {"impala": {**_IMPALA, "gamma": 0.9}},
    ),
    "games": Protocol(
        "+".join(_GAMES),
        ("impala", "impala-clipped", "impala-popart"),
        25_000,
        {},
        {"impala": {"conditioning": "one-hot", "hidden": (128, 128), "num_envs": 64, "entropy_cost": 0.01}},
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", choices=list(PROTOCOLS))
    parser.add_argument(
        "--agents", nargs="+", choices=list(AGENTS), metavar="NAME", help="by default those of the tasks"
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, help="of every environment; by default those of the tasks")
    parser.add_argument("--evaluations", type=int, default=10)
    parser.add_argument("--episodes", type=int, default=20, help="of each task in an evaluation")
    parser.add_argument("--scales", type=float, nargs=3, default=[0.01, 1.0, 100.0], help="of the three tasks")
    parser.add_argument("--training", nargs="*", default=[], metavar="NAME=VALUE", help="of the agent or the loop")
    parser.add_argument("--out", type=Path, help="by default runs/scales-TASKS")
    parts.add_flags(parser)
    arguments = parser.parse_args()
    arguments.out = arguments.out or Path("runs") / f"scales-{arguments.tasks}"
    arguments.agents = arguments.agents or PROTOCOLS[arguments.tasks].agents
    if parts.is_part():
        return measure(arguments, arguments.agents[0])
    todo = [part(arguments, agent, scaled) for agent in arguments.agents for scaled in (True, False)]
    left = parts.run_parts(__file__, todo, arguments.out, arguments)
    parts.end(table(arguments.out), arguments.out, left)


def part(arguments: argparse.Namespace, agent: str, scaled: bool) -> parts.Part:
    """Return the part of an agent, with the scales or as its control."""
    scales = arguments.scales if scaled else [1.0] * len(arguments.scales)
    options = [f"--{name}={getattr(arguments, name)}" for name in ("seeds", "evaluations", "episodes", "out")]
    options += [f"--steps={arguments.steps}"] * bool(arguments.steps)
    lists = ["--scales", *map(str, scales), "--agents", agent, "--training", *arguments.training]
    return parts.Part(agent if scaled else f"{agent}-{CONTROL}", [arguments.tasks, *options, *lists])


def measure(arguments: argparse.Namespace, agent: str) -> None:
    """Learn the tasks, or go on with the run that was stopped, and write the returns of all evaluations."""
    enable_compile_cache()
    protocol, (learner, own), scales = PROTOCOLS[arguments.tasks], AGENTS[agent], np.array(arguments.scales)
    given = {**protocol.settings[learner], **own}
    given |= settings_of(arguments.training)
    plain = with_preset(protocol.env, learner, **varied(protocol, arguments.scales))
    iterations = arguments.steps or protocol.steps
    chunk = iterations // arguments.evaluations
    made, settings = configure(plain.learner, plain.training, {**given, "chunk_steps": chunk})
    is_control = len(set(arguments.scales)) == 1
    name = f"{agent}-{CONTROL}" if is_control else agent
    folder, worlds = arguments.out / f"{name}.run", len(scales) * settings.num_envs
    result = resumable.train(
        folder,
        plain.family,
        made,
        settings=settings,
        steps=iterations * worlds,
        seeds=arguments.seeds,
        eval_every=chunk * worlds,
        eval_episodes=arguments.episodes,
    )
    found = result.evaluations
    returns = found.returns["train"].mean(axis=-1, dtype=np.float64) / scales
    figures = {
        "agent": agent,
        "control": is_control,
        "scales": arguments.scales,
        "tasks": list(result.env.labels("train")),
        "returns": np.round(returns, 4).tolist(),
        "loop": str(settings),
        **resumable.summary(result),
    }
    parts.write_result(arguments.out / f"{name}.json", record(arguments, figures))
    shutil.rmtree(folder, ignore_errors=True)


def varied(protocol: Protocol, scales: list[float]) -> dict[str, Any]:
    """Return the settings of a family whose tasks have these scales, or of games; of equal ones, nothing scales."""
    if len(set(scales)) == 1:
        return protocol.family
    games = protocol.env.split("+")
    several = {f"{game}.reward-scale": scale for game, scale in zip(games, scales, strict=False)}
    scaled = {"reward-scale": scales} if len(games) == 1 else several
    return protocol.family | {"vary": protocol.family.get("vary", {}) | scaled}


def table(out: Path) -> str:
    """Return the returns of all agents that have finished."""
    found = {path.stem: json.loads(path.read_text()) for path in sorted(out.glob("*.json"))}
    titles = ["agent", "scale", "last return", "less the control's", "mean return", "less the control's", "seconds"]
    return markdown(titles, [line for name in AGENTS if name in found for line in lines(found, name)])


def lines(found: dict[str, Any], agent: str) -> Iterator[list[str]]:
    """Return an agent's lines of the table, one for each scale."""
    result, control = found[agent], found.get(f"{agent}-{CONTROL}")
    for task, scale in enumerate(result["scales"]):
        pairs = zip(scores_of(result), scores_of(control) if control else (None, None), strict=True)
        cells = [x for own, alone in pairs for x in compared(own[:, task], None if alone is None else alone[:, task])]
        yield [f"`{agent}`", f"{scale:g}", *cells, f"{result['wall_seconds']:.0f}"]


def compared(own: np.ndarray, alone: np.ndarray | None) -> list[str]:
    """Return the cells of scores (S,), and of what they have less than the control's, if it has as many seeds."""
    return [f"{stats.seed_interval(own):.1f}", difference(own, alone)]


def scores_of(result: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the last and the mean returns (S, T) of a run, in units of each task's scale."""
    returns = np.array(result["returns"])
    return returns[:, -1], returns.mean(axis=1)


if __name__ == "__main__":
    run_main(main)
