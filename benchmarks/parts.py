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
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

STARTED = "BENCHMARK_STARTED"  # the clock when the process of a part was started
_OF_RUNNING = ("seconds", "within", "devices")  # flags of ``add_flags``
_GRACE = 60.0  # seconds between asking a process to stop and ending it
_POLL = 0.05  # seconds between two looks at what runs


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


def add_peer_flags(parser: argparse.ArgumentParser, name: str, words: tuple[str, ...], **given: Any) -> None:
    """Add the flags of a comparison called ``name``: where results go, a part by its ``words``, and ``add_flags``'s."""
    parser.add_argument("--out", type=Path, default=dated(name))
    parser.add_argument("--part", nargs=len(words), metavar=words, help="run this part in this process")
    add_flags(parser, **given)


def dated(name: str) -> Path:
    """Return a folder for the results of a benchmark that begins now."""
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"


def run_ways(
    script: str,
    arguments: argparse.Namespace,
    measure: Callable[[argparse.Namespace, str], None],
    table: Callable[[Path], str],
    last: Collection[str] = (),
) -> None:
    """Measure a way if this process is its part. Else run all ways that have no result yet, and write the table.

    Args:
        arguments: ``ways``, those of ``add_flags``, and others, which every part is given too.
        last: ways that need results of others, and begin only once all others are done.
    """
    if is_part():
        return measure(arguments, arguments.ways[0])
    left: list[str] = []
    for late in (False, True):
        ways = [way for way in arguments.ways if (way in last) == late]
        left = left or run_parts(script, [_of_way(arguments, way) for way in ways], arguments.out, arguments)
    end(table(arguments.out), arguments.out, left)


def run_pairs(
    script: str,
    arguments: argparse.Namespace,
    pairs: Sequence[tuple[Any, Any]],
    play: Callable[..., None],
    table: Callable[[Path], str],
) -> None:
    """Play a pair if ``--part`` names it. Else run all that have no result yet, and write the table.

    Args:
        pairs: of two words each, whose parts are given all flags of this call too.
        play: of the arguments and the two words of a pair.
    """
    if arguments.part:
        return play(arguments, *arguments.part)
    words = lambda pair: [*sys.argv[1:], "--out", str(arguments.out), "--part", *map(str, pair)]
    named = [Part("-".join(map(str, pair)), words(pair)) for pair in pairs]
    left = run_parts(script, named, arguments.out, arguments)
    end(table(arguments.out), arguments.out, left)


def _of_way(arguments: argparse.Namespace, way: str) -> Part:
    """Return the part of a way, with all that was given to its benchmark but how to run parts."""
    words = ["--ways", way]
    for name, value in vars(arguments).items():
        if name in ("ways", *_OF_RUNNING) or value is None:
            continue
        flag = f"--{name.replace('_', '-')}"
        words += [flag, *map(str, value)] if isinstance(value, list) else [f"{flag}={value}"]
    return Part(way, words)


def whole(text: str) -> int:
    """Return a number of steps, which may be written as 2e7."""
    return int(float(text))


def run_parts(script: str, parts: Sequence[Part], out: Path, arguments: argparse.Namespace) -> list[str]:
    """Run the parts that have no result yet, in their order, and return the names of those that wrote none.

    A process that is running when the time is over, or ``_GRACE`` after its own ``--seconds``, is asked to stop by
    SIGTERM, and so are all if this process is; what they have saved by then is their own matter.
    """
    out.mkdir(parents=True, exist_ok=True)
    runner = _Runner(script, out, time.monotonic() + arguments.within, getattr(arguments, "seconds", float("inf")))
    for part in parts:
        if not result_of(out, part).exists():
            runner.waiting.put(part)
    threads = [threading.Thread(target=runner.play_all, args=(device,)) for device in arguments.devices]
    before = signal.signal(signal.SIGTERM, runner.stop)
    try:
        for thread in threads:
            thread.start()
        while any(thread.is_alive() for thread in threads):
            time.sleep(_POLL)  # ``join`` would not wake for a signal that comes just before it blocks
        if not runner.end:
            sys.exit(128 + signal.SIGTERM)
    finally:
        runner.stop()
        signal.signal(signal.SIGTERM, before)
    return [part.name for part in parts if not result_of(out, part).exists()]


class _Runner:
    """Runs waiting parts, on each device one after another.

    Args:
        end: when, by the monotonic clock, the time is over.
        seconds: after which a part should have ended by itself.
    """

    def __init__(self, script: str, out: Path, end: float, seconds: float):
        self.script, self.out, self.end, self.seconds = script, out, end, seconds
        self.waiting: queue.SimpleQueue[Part] = queue.SimpleQueue()

    def stop(self, *_: Any) -> None:
        """Begin no further part, and have those that run asked to stop. It may handle a signal."""
        self.end = 0.0

    def play_all(self, device: str) -> None:
        """Run parts on one device until none is left or the time is over."""
        while time.monotonic() < self.end:
            try:
                part = self.waiting.get_nowait()
            except queue.Empty:
                return
            self.play(part, device)

    def play(self, part: Part, device: str) -> None:
        log, before = self.out / f"{part.name}.log", time.time()
        log.parent.mkdir(parents=True, exist_ok=True)
        chosen = {"CUDA_VISIBLE_DEVICES": device} if device else {}
        environment = {**os.environ, **chosen, **part.environment, STARTED: str(before)}
        with log.open("w") as file:
            words = [sys.executable, self.script, *part.words]
            process = subprocess.Popen(words, env=environment, stdout=file, stderr=file)
            self.wait(process)
        done = result_of(self.out, part).exists()
        state = f"{'done' if done else 'no result'} after {time.time() - before:.0f} s"
        print(f"{part.name}: {state}" + ("" if done else f", see {log}{end_of(log)}"), flush=True)

    def wait(self, process: subprocess.Popen) -> None:
        """Wait for a process. Ask it to stop when the time is over, and end it if it does not."""
        latest = time.monotonic() + self.seconds + _GRACE
        while process.poll() is None and time.monotonic() < min(self.end, latest):
            time.sleep(_POLL)
        process.terminate()  # which does nothing to one that has ended
        try:
            process.wait(_GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def end_of(log: Path) -> str:
    """Return the last line of a log, which says how the process ended; empty if there is none."""
    lines = log.read_text(errors="replace").split("\n")
    return next((f": {line}" for line in reversed(lines) if line.strip()), "")


def end(table: str, out: Path, left: list[str]) -> None:
    """Print the table of the results in a folder, and write it there. End the program if some parts have no result."""
    print(table)
    (out / "table.md").write_text(table + "\n")
    require_all(left)


def require_all(left: list[str]) -> None:
    """End the program if some parts have no result."""
    if left:
        raise SystemExit(f"left: {' '.join(left)}; the same command goes on with them")


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


def results_of(out: Path, ways: Collection[str]) -> dict[str, dict[str, Any]]:
    """Return the results of those ways that have finished, by way."""
    files = {way: out / f"{way}.json" for way in ways}
    return {way: json.loads(file.read_text()) for way, file in files.items() if file.exists()}


def read_results(out: Path) -> Iterator[dict[str, Any]]:
    """Return the results of all finished parts, by name."""
    for path in sorted(out.rglob("*.json")):
        yield json.loads(path.read_text())
