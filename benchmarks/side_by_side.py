"""Compare the speed of training and of compiling of two checkouts, run in turn on one machine.

    python benchmarks/side_by_side.py OTHER [--agents sac-conditioned care] [--seeds 1 10] [--repeats 3]
        [--ours=--no-stagger] [--cold] -- --env=finger-spin-vary-size --preset=cpu --steps=128000 ...

OTHER is the root of another checkout, say of an older commit. What follows ``--`` goes to ``mtjax.train`` of both;
``--ours`` goes to this checkout alone, for flags that the older one lacks. Each run is a process of its own with the
same Python. Milliseconds are of one iteration: the median over chunks, without the first one and those of the warm-up,
then the least over repeats, as whatever else a machine does only adds to them. ``--cold`` gives every run an empty
cache, so that seconds of compiling are those of a first run; otherwise each checkout keeps a cache of its own.

``--curves DIR`` also compares what they learn, with an ``--eval-every`` and several seeds: mean returns on the training
tasks at every evaluation, differences over pairs of seeds of one number with 95% intervals, and whether all returns
are the same to the bit. It keeps both files of returns in DIR.
"""

import argparse
import csv
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from report import markdown, publish, run_main

from mtjax.report.stats import paired_difference

HERE = Path(__file__).resolve().parent.parent
HEAD = ["agent", "seeds", "steps of each", "other", "this", "this less other"]


class Timing(NamedTuple):
    """Holds the figures of one run."""

    milliseconds: float  # of an iteration
    compile_seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path)
    parser.add_argument("--agents", nargs="+", default=["sac-conditioned", "care"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--ours", nargs="*", default=[], help="flags for this checkout alone")
    parser.add_argument("--cold", action="store_true", help="begin each run with an empty cache")
    parser.add_argument("--curves", type=Path, help="compare returns too, and keep them in this folder")
    parser.add_argument("--json", help="write the figures to this file")
    words = [*sys.argv[1:], "--"]
    own, flags = words[: words.index("--")], words[words.index("--") + 1 : -1]
    arguments = parser.parse_args(own)
    arguments.flags = flags
    if arguments.curves:
        arguments.curves.mkdir(parents=True, exist_ok=True)
    if not (arguments.other / "mtjax" / "train.py").exists():
        parser.error(f"{str(arguments.other)!r} is no checkout of mtjax")
    rows = [row for agent in arguments.agents for seeds in arguments.seeds for row in compare(arguments, agent, seeds)]
    head = ["agent", "seeds", "checkout", "ms an iteration", "all repeats", "compile s", "all repeats"]
    shown = [
        [
            row["agent"],
            str(row["seeds"]),
            row["setting"],
            f"{row['milliseconds']:.3f}",
            ", ".join(f"{x:.3f}" for x in row["all_milliseconds"]),
            f"{row['compile_seconds']:.1f}",
            ", ".join(f"{x:.1f}" for x in row["all_compile_seconds"]),
        ]
        for row in rows
    ]
    print(markdown(head, shown))
    publish(arguments, rows)


def compare(arguments: argparse.Namespace, agent: str, seeds: int) -> list[dict]:
    """Run both checkouts in turn, and return a row for each."""
    flags = [f"--agent={agent}", f"--seeds={seeds}", *arguments.flags]
    checkouts = {"other": (arguments.other.resolve(), flags), "this": (HERE, flags + arguments.ours)}
    found: dict[str, list[Timing]] = {name: [] for name in checkouts}
    with tempfile.TemporaryDirectory() as place:
        for repeat in range(arguments.repeats):
            for name, (root, given) in checkouts.items():
                cache = Path(place) / f"{name}-{repeat if arguments.cold else 0}"
                found[name].append(run(root, given, Path(place) / f"{name}-runs-{repeat}", cache))
                print(agent, seeds, name, found[name][-1], flush=True)
        if arguments.curves:
            print(markdown(HEAD, curves(agent, *(keep(arguments.curves, agent, name, place) for name in checkouts))))
    return [row(agent, seeds, name, timings) for name, timings in found.items()]


def keep(folder: Path, agent: str, name: str, place: str) -> Path:
    """Copy the returns of a checkout's first run into ``folder``, and return the file."""
    (file,) = Path(place).glob(f"{name}-runs-0/*/evaluations.npz")
    return Path(shutil.copyfile(file, folder / f"{agent}-{name}.npz"))


def curves(agent: str, other: Path, this: Path) -> list[list[str]]:
    """Return a line for each evaluation: mean returns on the training tasks, and differences over pairs of seeds.

    Checkouts may differ in how they round steps to whole chunks. Evaluations after other steps are left out.
    """
    before, after = (of_steps(file) for file in (other, this))
    lines = []
    for step in sorted(before.keys() & after.keys()):
        gap = paired_difference(after[step], before[step])
        same = np.array_equal(after[step], before[step])
        shown = "the same bits" if same else f"{gap:+.2f}"
        means = [f"{x[step].mean():.2f}" for x in (before, after)]
        lines.append([agent, str(len(after[step])), f"{step:,}", *means, shown])
    if not lines:
        raise SystemExit(f"no evaluation of {agent} came after as many steps in both; give --steps of whole chunks")
    return lines


def of_steps(file: Path) -> dict[int, np.ndarray]:
    """Return the returns (S, T, episodes) on the training tasks of every evaluation, by its steps."""
    with np.load(file) as found:
        return dict(zip(found["steps"].tolist(), np.moveaxis(found["train"], 1, 0), strict=True))


def row(agent: str, seeds: int, name: str, timings: list[Timing]) -> dict:
    """Return the row of one checkout."""
    milliseconds, compiled = zip(*timings, strict=True)
    best = {"milliseconds": min(milliseconds), "compile_seconds": min(compiled)}
    every = {"all_milliseconds": list(milliseconds), "all_compile_seconds": list(compiled)}
    return {"agent": agent, "seeds": seeds, "setting": name, **best, **every}


def run(root: Path, flags: list[str], runs: Path, cache: Path) -> Timing:
    """Train once with the code of ``root``."""
    search = os.pathsep.join([str(root), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-m", "mtjax.train", f"--runs={runs}", *flags]
    environment = {**os.environ, "PYTHONPATH": search, "MTJAX_CACHE": str(cache)}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed in {root}:\n{done.stderr[-2000:]}")
    (file,) = runs.glob("*/metrics.csv")
    return Timing(milliseconds(file), seconds_of_compiling(done.stdout))


def seconds_of_compiling(output: str) -> float:
    """Return what a run tells of the time that it compiled for, such as 41 s or 1 min 3 s."""
    told = re.search(r"compiled in (?:(\d+) min )?([\d.]+) s", output)
    return 60 * float(told[1] or 0) + float(told[2]) if told else float("nan")


def milliseconds(file: Path) -> float:
    """Return the median time of an iteration over the chunks in which the agent learned."""
    with file.open() as lines:
        rows = [row for row in csv.DictReader(lines) if row["seed"] == "0"]
    learned = [i for i in range(1, len(rows)) if float(rows[i - 1]["critic_loss"] or 0)]
    if not learned:
        raise SystemExit("no chunk came after the warm-up; train for more steps or with shorter chunks")
    elapsed = lambda i: float(rows[i]["seconds"]) - float(rows[i - 1]["seconds"])
    count = lambda i: int(rows[i]["iteration"]) - int(rows[i - 1]["iteration"])
    return 1000 * statistics.median(elapsed(i) / count(i) for i in learned)


if __name__ == "__main__":
    run_main(main)
