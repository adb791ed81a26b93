"""Measure the time from the start of ``mtjax.train`` to a return, with a cold and a warm compile cache.

    python benchmarks/time_to_return.py [--mark 900] [--tasks 10 200] [--agents NAME ...] [--seeds N] [--json FILE]
                                        [-- FLAGS OF mtjax.train ...]

Each setting is started twice, by ``python -m mtjax.train`` in a process of its own: with an empty compile cache, then
with what the first run left there. Times are read off the run's metrics as they appear; once the mean return of
training episodes over tasks and seeds has reached the mark the run is ended. "first metrics" and "reached" count from
the start of the process; "training" counts chunks alone, without compiling and evaluating. Returns are known when
episodes end.
"""

import argparse
import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
from parts import end_of
from report import markdown, publish, run_main, texts_of

_ON_CPU = jax.default_backend() == "cpu"
# Tasks that are many have few environments and small batches each, so that the whole stays the same.
MANY = ["--num-envs=16", "--batch-size=8", "--replay-size=20000"]
FIGURES = ("first_metrics", "training", "reached", "best", "steps_per_second")
_POLL = 0.05  # seconds between two looks at the metrics


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="finger-spin-vary-size")
    parser.add_argument("--parameter", default="size=0.95:1.13", help="what tasks differ in, and from where to where")
    parser.add_argument("--agents", nargs="+", default=["sac-conditioned"])
    parser.add_argument("--tasks", type=int, nargs="+", default=[10] if _ON_CPU else [10, 200])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--mark", type=float, default=800.0 if _ON_CPU else 900.0)
    parser.add_argument("--patience", type=float, default=900.0, help="seconds after which a run is given up")
    parser.add_argument("--caches", nargs="+", default=["cold", "warm"], choices=["cold", "warm"])
    parser.add_argument("--json", help="write the figures to this file too")
    parser.add_argument("flags", nargs="*", help="after --: further flags of mtjax.train")
    arguments = parser.parse_args()
    rows = []
    for agent in arguments.agents:
        for num_tasks in arguments.tasks:
            rows += measure(agent, num_tasks, arguments)
    print(table(rows, arguments.mark), flush=True)
    publish(arguments, rows)


def measure(agent: str, num_tasks: int, arguments: argparse.Namespace) -> list[dict]:
    """Run one setting with a cold and a warm cache."""
    ((name, span),) = texts_of([arguments.parameter]).items()
    words = [f"--env={arguments.env}", f"--agent={agent}", f"--env.vary.{name}={span}:{num_tasks}"]
    words += [f"--seeds={arguments.seeds}", "--eval-every=1000000000", "--eval-episodes=1"]
    words += (MANY if num_tasks >= 100 else []) + arguments.flags
    rows = []
    with tempfile.TemporaryDirectory() as place:
        for cache in arguments.caches:
            found = watch(words, Path(place), cache, arguments)
            rows.append({"agent": agent, "tasks": num_tasks, "seeds": arguments.seeds, "cache": cache, **found})
            print(f"{agent}, {num_tasks} tasks, {cache} cache: {found}", flush=True)
    return rows


def watch(words: list[str], place: Path, cache: str, arguments: argparse.Namespace) -> dict:
    """Start a run, follow its metrics until the mark is reached, and end it."""
    runs = place / f"runs-{cache}"
    command = [sys.executable, "-m", "mtjax.train", *words, f"--runs={runs}"]
    log = place / f"{cache}.log"
    before = time.monotonic()
    environment = {**os.environ, "MTJAX_CACHE": str(place / "cache")}
    with log.open("w") as file:
        process = subprocess.Popen(command, env=environment, stdout=file, stderr=subprocess.STDOUT)
        try:
            found = follow(process, runs, before, arguments)
        finally:
            process.send_signal(signal.SIGTERM)  # it ends after the chunk it is in, as it would for a user
            process.wait()
    if found["first_metrics"] is None:
        raise SystemExit(f"no metrics came from mtjax.train {' '.join(words)}{end_of(log)}")
    return found


def follow(process: subprocess.Popen, runs: Path, before: float, arguments: argparse.Namespace) -> dict:
    """Return the times in a run's metrics, up to the mark or the end."""
    found: dict[str, Any] = dict.fromkeys(FIGURES)
    while process.poll() is None and time.monotonic() - before < arguments.patience and found["reached"] is None:
        time.sleep(_POLL)
        lines = chunks(runs, arguments.seeds)
        if not lines:
            continue
        now = round(time.monotonic() - before, 2)
        found["first_metrics"] = found["first_metrics"] or now
        steps, seconds, _ = lines[-1]
        if len(lines) > 1:  # the first chunk warms up
            found["steps_per_second"] = round((steps - lines[0][0]) * arguments.seeds / (seconds - lines[0][1]))
        known = [(seconds, total) for _, seconds, total in lines if total is not None]
        if known:
            found["best"] = round(max(total for _, total in known), 1)
        reached = [seconds for seconds, total in known if total >= arguments.mark]
        if reached:
            found |= {"training": round(reached[0], 2), "reached": now}
    return found


def chunks(runs: Path, seeds: int) -> list[tuple[int, float, float | None]]:
    """Return steps of a seed, training seconds and mean return of every chunk so far; None if no episode ended."""
    files = list(runs.glob("*/metrics.csv"))
    if not files:
        return []
    with files[0].open(newline="") as file:
        lines = list(csv.DictReader(file))
    whole = [lines[i : i + seeds] for i in range(0, len(lines) - seeds + 1, seeds)]
    mean = lambda rows: None if any(row["return"] in ("", None, "nan") for row in rows) else _mean(rows)
    return [(int(rows[0]["steps"]), float(rows[0]["seconds"]), mean(rows)) for rows in whole]


def _mean(rows: list[dict]) -> float:
    return sum(float(row["return"]) for row in rows) / len(rows)


def table(rows: list[dict], mark: float) -> str:
    settings = ("agent", "tasks", "seeds", "cache")
    head = [*settings, "first metrics s", f"training s to {mark:g}", f"process s to {mark:g}"]
    show = lambda x: "-" if x is None else f"{x:,}"
    cells = lambda row: [*(str(row[name]) for name in settings), *(show(row[name]) for name in FIGURES)]
    return markdown([*head, "best return", "env-steps/s, all seeds"], [cells(row) for row in rows])


if __name__ == "__main__":
    run_main(main)
