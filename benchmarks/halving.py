"""Measure what halving saves: a search whose rounds end early beside the same trials, all trained to the end.

    python benchmarks/halving.py [--trials 64] [--rungs 5] [--searches 5] [--seeds 1] [--steps 49152]
                                 [--env tabular-mdp] [--agent ppo] [--ranges NAME=LOW..HIGH ...]
                                 [--flags NAME=VALUE ...] [--within SECONDS] [--devices 0 ...] [--out DIR]

Each search is one round of ``mtjax.train --search``, once with ``--search-rungs=1``, where every trial goes to the end,
and once with ``--rungs``. Both have the same trials and the same seed, so that what halving keeps is the same run in
both; another search has other trials and another seed. Every search is a process of its own, and writes
``OUT/NUMBER-RUNGS.json`` with the values and returns of its trials and the steps they took. Finished searches are not
run again; one that was stopped goes on if the same command is given again.

The table has a line for each search: the return at the end of the best of all trials, and of the one that halving
found; its rank among all, by their returns where all went to the end; and the share of steps that halving took. Its
last line has means, with intervals over searches.
"""

import argparse
import json
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import parts
from report import markdown, record, run_main

from mtjax.command import search as command
from mtjax.names import InputError
from mtjax.report import stats
from mtjax.training import search as searching

RANGES = ("actor-lr=1e-6..1", "critic-lr=1e-6..1", "entropy-cost=1e-4..1", "gae-lambda=0..1")
FLAGS = ("num-envs=8", "env.num-tasks=3", "split=none", "agent.gamma=0.9", "eval-episodes=20")
FLAGS += ("agent.epochs=4", "agent.minibatches=4")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=64)
    parser.add_argument("--rungs", type=int, default=5)
    parser.add_argument("--searches", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=1, help="of each trial")
    parser.add_argument("--steps", type=int, default=49_152, help="of each seed of a trial that goes to the end")
    parser.add_argument("--env", default="tabular-mdp")
    parser.add_argument("--agent", default="ppo")
    parser.add_argument("--ranges", nargs="+", default=list(RANGES), metavar="NAME=LOW..HIGH", help="of the agent")
    parser.add_argument("--flags", nargs="*", default=list(FLAGS), metavar="NAME=VALUE", help="of mtjax.train")
    parser.add_argument("--number", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, default=Path("runs") / "halving")
    parts.add_flags(parser)
    arguments = parser.parse_args()
    if parts.is_part():
        return measure(arguments)
    todo = [part(arguments, i, rungs) for i in range(arguments.searches) for rungs in (1, arguments.rungs)]
    left = parts.run_parts(__file__, todo, arguments.out, arguments)
    parts.end(table(arguments.out, arguments.rungs), arguments.out, left)


def part(arguments: argparse.Namespace, number: int, rungs: int) -> parts.Part:
    """Return the part of a search with so many rungs."""
    names = ("trials", "seeds", "steps", "env", "agent", "out")
    options = [f"--{name}={getattr(arguments, name)}" for name in names]
    flags = [f"--rungs={rungs}", f"--number={number}", "--ranges", *arguments.ranges, "--flags"]
    return parts.Part(f"{number}-{rungs}", [*options, *flags, *arguments.flags])


def measure(arguments: argparse.Namespace) -> None:
    """Search, or go on with the search that was stopped, and write what became of its trials."""
    folder, begun = arguments.out / f"{arguments.number}-{arguments.rungs}.run", time.monotonic()
    known = list(folder.glob(f"*/{searching.FILE}"))
    command.main([f"--resume={known[0].parent}"] if known else words(arguments, folder))
    search = searching.read(next(folder.glob(f"*/{searching.FILE}")).parent)
    if search.best is None:
        raise InputError("no trial of the search has finished")
    figures = {
        "number": arguments.number,
        "rungs": search.rungs,
        "steps_taken": searching.taken(search),
        "best": search.best.number,
        "trials": [{"values": x.values, "returns": x.returns, "state": x.state} for x in search.trials],
        "wall_seconds": round(time.monotonic() - begun, 1),  # of the last call, where one was stopped
    }
    name = f"{arguments.number}-{arguments.rungs}.json"
    parts.write_result(arguments.out / name, record(arguments, figures))
    shutil.rmtree(folder, ignore_errors=True)


def words(arguments: argparse.Namespace, folder: Path) -> list[str]:
    """Return the command line of a search of one round."""
    size = [f"--search={arguments.trials}", f"--search-batch={arguments.trials}", f"--search-rungs={arguments.rungs}"]
    plan = [f"--{name}={getattr(arguments, name)}" for name in ("env", "agent", "steps", "seeds")]
    given = [*(f"--agent.{each}" for each in arguments.ranges), *(f"--{each}" for each in arguments.flags)]
    return [*plan, f"--seed={arguments.number * arguments.seeds}", *size, *given, f"--runs={folder}"]


def table(out: Path, rungs: int) -> str:
    """Return a line for each search that has finished both ways, and their means."""
    read = lambda file: json.loads(file.read_text())
    whole = {each["number"]: each for each in map(read, out.glob("*-1.json"))}
    halved = {each["number"]: each for each in map(read, out.glob(f"*-{rungs}.json"))}
    found = [compared(whole[i], halved[i]) for i in sorted(whole.keys() & halved.keys())]
    titles = ["search", "best of all", "found by halving", "its rank", "share of steps", "seconds, all", "halving"]
    rows = [[str(i), *(f"{x:.4g}" for x in line)] for i, line in enumerate(found)]
    means = [f"{stats.seed_interval(np.array(column)):.4g}" for column in zip(*found, strict=True)]
    return markdown(titles, rows + ([["mean", *means]] if found else []))


def compared(whole: dict[str, Any], halved: dict[str, Any]) -> list[float]:
    """Return the figures of a search whose trials all went to the end, and with halving.

    Raises:
        InputError: they had other trials.
    """
    if [x["values"] for x in whole["trials"]] != [x["values"] for x in halved["trials"]]:
        raise InputError(f"search {whole['number']} had other trials with halving; choose another --out")
    ends = np.array([list(x["returns"].values())[-1] if x["returns"] else -np.inf for x in whole["trials"]])
    chosen = halved["best"]
    found = list(halved["trials"][chosen]["returns"].values())[-1]
    rank = 1 + int(np.sum(ends > ends[chosen]))
    share = halved["steps_taken"] / whole["steps_taken"]
    return [float(ends.max()), found, rank, share, whole["wall_seconds"], halved["wall_seconds"]]


if __name__ == "__main__":
    run_main(main)
