"""Find presets by sweep: train a grid of an agent's numbers on a family, and rank the points.

    python benchmarks/presets.py --family=NAME --agent=NAME --grid lr=1e-3,3e-3 tau=0.005,0.02 [--given NAME=VALUE ...]
                                 [--steps N] [--seeds 2] [--preset gpu] [--name TEXT] [--out DIR]

The points of the grid, with all seeds, are one program (``mtjax.train(sweep=...)``). ``lr`` stands for all rates
of learning together. ``--given`` are settings of the agent or the loop that hold for all points. Families of
``returns.py`` vary what they vary there.

Each call writes ``DIR/FAMILY/AGENT-NAME.csv``: a line for each point with the mean return of the training episodes in
the last tenth of the run, over seeds, the least and the largest of a seed, the mean over the whole run (which is higher
if learning is faster), and seconds. ``DIR/FAMILY.md`` ranks the points of all files. A point with a seed that diverged
stands last. ``DIR/FAMILY/origin.json`` has the settings, machine, versions and commit of every call. If the command is
given again, a grid that was stopped goes on where it was, and one that was killed from its last checkpoint, of which
there are four; until it is finished its run is in ``DIR/FAMILY/AGENT-NAME``.
"""

import argparse
import itertools
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
from parts import whole
from report import markdown, note_origin, read_lines, run_main, settings_of, texts_of, write_lines
from resumable import train
from returns import FAMILIES

from mtjax.agents.swept import Point
from mtjax.compiling.programs import enable_compile_cache
from mtjax.config import configure, with_preset
from mtjax.names import InputError
from mtjax.saved.result import Result

_RATES = ("actor_lr", "critic_lr", "temperature_lr")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--family", required=True)
    parser.add_argument("--agent", default="sac-conditioned")
    parser.add_argument("--preset", default="gpu")
    parser.add_argument("--grid", nargs="+", required=True, metavar="NAME=VALUE,VALUE")
    parser.add_argument("--given", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--split", help="by default the family's")
    parser.add_argument("--steps", type=whole, help="of each seed; by default the preset's")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--name", default="grid", help="ends the file's name, so that an agent may have several")
    parser.add_argument("--out", type=Path, default=Path("runs") / "presets")
    arguments = parser.parse_args()
    enable_compile_cache()
    note_origin(arguments, arguments.out / arguments.family)
    sweep(arguments)
    tabulate(arguments.out / arguments.family)


def grid(words: list[str]) -> list[dict[str, float]]:
    """Return every combination of the values in words such as ``tau=0.01,0.02``."""
    texts = texts_of(words)
    try:
        axes = {name: [float(x) for x in values.split(",")] for name, values in texts.items()}
    except ValueError as error:
        raise InputError(f"--grid takes numbers: {error}") from None
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


def as_point(agent: Any, named: dict[str, float]) -> Point:
    """Return the agent's own numbers for a point whose ``lr`` stands for all its learning rates."""
    rates = [rate for rate in _RATES if hasattr(agent, rate)]
    return {own: x for name, x in named.items() for own in (rates if name == "lr" else [name])}


def sweep(arguments: argparse.Namespace) -> None:
    """Train all points of a grid, and save a line for each."""
    family, found = arguments.family, grid(arguments.grid)
    varied: dict[str, Any] = {"vary": FAMILIES[family].vary} if family in FAMILIES and FAMILIES[family].vary else {}
    varied |= {"split": arguments.split} if arguments.split else {}
    config = with_preset(family, arguments.agent, arguments.preset, engine=arguments.engine, **varied)
    agent, settings = configure(config.learner, config.training, settings_of(arguments.given))
    folder, steps = arguments.out / family / f"{arguments.agent}-{arguments.name}", arguments.steps or config.plan.steps
    last = [0.0]

    def show(row: dict[str, Any]) -> None:
        if time.monotonic() - last[0] > 10:
            last[0] = time.monotonic()
            print(f"{row['seconds']} s, {row['steps']} steps, first seed {row['return'] or '-'}", flush=True)

    result = train(
        folder,
        config.family,
        agent,
        steps=steps,
        seeds=arguments.seeds,
        eval_every=-(-steps // 4),
        eval_episodes=1,
        settings=settings,
        sweep=[as_point(agent, named) for named in found],
        on_chunk=show,
    )
    lines = rows(result, found, arguments.seeds)
    shared = {"given": " ".join(arguments.given), "wall_seconds": result.rows[-1]["wall_seconds"]}
    write_lines(folder.with_name(f"{folder.name}.csv"), [{**line, **shared} for line in lines])
    shutil.rmtree(folder)


def rows(result: Result, found: list[dict[str, float]], seeds: int) -> list[dict[str, Any]]:
    """Return a line for each point: its numbers and what its seeds earned."""
    number = lambda x: float(x) if x not in ("", None) else np.nan
    count = len(found) * seeds
    returns = np.array([number(row["return"]) for row in result.rows]).reshape(-1, len(found), seeds)
    last = result.rows[-count:]
    lines = []
    for k, named in enumerate(found):
        curve = returns[:, k]  # (V, S)
        end = curve[-max(len(curve) // 10, 1) :].mean(axis=0)
        lines.append(
            {
                "point": " ".join(f"{name}={x:g}" for name, x in named.items()),
                "return": round(float(end.mean()), 1),
                "least": round(float(end.min()), 1),
                "largest": round(float(end.max()), 1),
                "whole_run": round(float(np.nanmean(curve)), 1) if np.isfinite(curve).any() else np.nan,
                "steps": last[0]["steps"],
                "seconds": last[0]["seconds"],
                "seeds": seeds,
            }
        )
    return lines


def tabulate(folder: Path) -> None:
    """Rank the points of all files of a family."""
    lines = []
    for path in folder.glob("*.csv"):
        lines += [{"agent": path.stem, **line} for line in read_lines(path)]
    rank = lambda line: np.inf if line["return"] in ("", "nan") else -float(line["return"])
    head = ["agent", "given", "point", "return", "least", "largest", "whole_run", "steps", "seconds", "seeds"]
    table = markdown(head, [[line[name] for name in head] for line in sorted(lines, key=rank)])
    folder.with_suffix(".md").write_text(table + "\n")
    print(table)


if __name__ == "__main__":
    run_main(main)
