"""Parts of a benchmark, each in a process of its own: finished ones are skipped, and a device runs one at a time.

A part is a command line that ends by writing ``OUT/NAME.json``, or a file with another ending. One that was stopped or
failed has no such file, and is started again by the next call. This module imports no JAX, so that the process of a
part alone holds the device.
"""

import argparse
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

STARTED = "BENCHMARK_STARTED"  # the clock when the process of a part was started
_GRACE = 60.0  # seconds between asking a process to stop and ending it


class Part(NamedTuple):
    """Holds a part's name, the words after ``python SCRIPT``, and the ending of its result's file."""

    name: str
    words: Sequence[str]
    environment: Mapping[str, str] = {}
    ending: str = ".json"


def add_flags(parser: argparse.ArgumentParser, seconds: float | None = None) -> None:
    """Add the flags of every benchmark that runs in parts."""
    if seconds:
        parser.add_argument("--seconds", type=float, default=seconds, help="after which a part ends by itself")
    parser.add_argument("--within", type=float, default=float("inf"), help="seconds after which no part is begun")
    parser.add_argument(
        "--devices",
        nargs="+",
        default=[""],
        metavar="NUMBER",
        help="GPUs, each with one part at a time, by CUDA_VISIBLE_DEVICES; by default one part with all that are seen",
    )


def run_parts(script: str, parts: Sequence[Part], out: Path, arguments: argparse.Namespace) -> list[str]:
    """Run the parts that have no result yet, in their order, and return the names of those that wrote none.

    A process that is running when the time is over, or ``_GRACE`` after its own ``--seconds``, is asked to stop by
    SIGTERM; what it has saved by then is its own matter.
    """
    out.mkdir(parents=True, exist_ok=True)
    waiting: queue.SimpleQueue[Part] = queue.SimpleQueue()
    for part in parts:
        if not result_of(out, part).exists():
            waiting.put(part)
    end = time.monotonic() + arguments.within
    play = lambda device: _play_all(script, waiting, out, device, end, getattr(arguments, "seconds", float("inf")))
    threads = [threading.Thread(target=play, args=(device,)) for device in arguments.devices]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [part.name for part in parts if not result_of(out, part).exists()]


def _play_all(script: str, waiting: queue.SimpleQueue, out: Path, device: str, end: float, seconds: float) -> None:
    """Run waiting parts on one device until none is left or the time is over."""
    while time.monotonic() < end:
        try:
            part = waiting.get_nowait()
        except queue.Empty:
            return
        _play(script, part, out, device, min(end, time.monotonic() + seconds + _GRACE))


def _play(script: str, part: Part, out: Path, device: str, end: float) -> None:
    log = out / f"{part.name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    chosen = {"CUDA_VISIBLE_DEVICES": device} if device else {}
    before = time.time()
    environment = {**os.environ, **chosen, **part.environment, STARTED: str(before)}
    with log.open("w") as file:
        process = subprocess.Popen([sys.executable, script, *part.words], env=environment, stdout=file, stderr=file)
        _wait(process, end)
    state = "done" if result_of(out, part).exists() else f"no result, see {log}"
    print(f"{part.name}: {state} after {time.time() - before:.0f} s", flush=True)


def _wait(process: subprocess.Popen, end: float) -> None:
    """Wait for a process. Ask it to stop at ``end``, and end it if it does not."""
    for limit, order in ((max(end - time.monotonic(), 0), signal.SIGTERM), (_GRACE, signal.SIGKILL)):
        try:
            process.wait(None if limit == float("inf") else limit)
            return
        except subprocess.TimeoutExpired:
            process.send_signal(order)
    process.wait()


def require_all(left: list[str]) -> None:
    """End the program if some parts have no result."""
    if left:
        raise SystemExit(f"{len(left)} parts are left, which the same command runs: {' '.join(left)}")


def is_part() -> bool:
    """Return whether this process was started as a part."""
    return STARTED in os.environ


def since_start() -> float:
    """Return the seconds since this process was started as a part."""
    return time.time() - float(os.environ[STARTED])


def result_of(out: Path, part: Part) -> Path:
    return out / f"{part.name}{part.ending}"


def write_result(path: Path, result: Mapping[str, Any]) -> None:
    """Write a part's result at once, which marks the part as finished."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_suffix(".new")
    new.write_text(json.dumps(result, indent=1, default=str) + "\n")
    new.replace(path)


def read_results(out: Path) -> Iterator[dict[str, Any]]:
    """Return the results of all finished parts, by name."""
    for path in sorted(out.rglob("*.json")):
        yield json.loads(path.read_text())
