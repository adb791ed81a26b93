"""How much a page slows the run that it shows: training with ``--view`` while somebody looks, and while nobody does.

    python benchmarks/live_page.py [--pairs 15] [--span 12] [--json FILE] [-- --env=... --agent=...]

One run trains, by ``--quick`` with shorter chunks and with an evaluation every 200,000 steps unless other flags follow
``--``. For ``--span`` seconds the page is open: this program asks for its numbers every other second and reads the
pictures of the moving worlds, as a browser does, but draws nothing itself. For as long nobody looks, and so on in turn.
What else the machine does so falls on both alike. The ratio is that of the mean time of an iteration in two such
spans beside each other, without evaluations and checkpoints. The page's processor time is counted too.
"""

import argparse
import contextlib
import http.client
import os
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path

from report import publish, read_lines, run_main

HERE = Path(__file__).resolve().parent.parent
_RUN = "--quick --chunk-steps=25 --eval-every=200000 --steps=1000000000".split()
_TAKEN = "page_seconds_looked_at", "page_seconds_alone"  # of a processor
_TICKS = os.sysconf("SC_CLK_TCK")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=15)
    parser.add_argument("--span", type=float, default=12.0, help="seconds")
    parser.add_argument("--json", help="write the figures to this file")
    words = [*sys.argv[1:], "--"]
    arguments = parser.parse_args(words[: words.index("--")])
    if arguments.pairs < 2:
        parser.error("--pairs must be at least 2, as ratios have a range")
    arguments.flags = words[words.index("--") + 1 : -1] or _RUN
    with training(arguments.flags) as (metrics, port, page):
        rows = [pair(metrics, port, page, arguments.span) for _ in range(arguments.pairs)]
    ratios = [row["ratio"] for row in rows]
    quarters = statistics.quantiles(ratios, n=4)
    open_share, idle_share = (statistics.median(row[name] for row in rows) / arguments.span for name in _TAKEN)
    print(f"looked at, an iteration takes {quarters[1]:.2f} [{quarters[0]:.2f}, {quarters[2]:.2f}] times as long")
    print(f"the page takes {open_share:.1%} of a core while it is open, and {idle_share:.1%} while nobody looks")
    publish(arguments, rows)


@contextlib.contextmanager
def training(flags: Sequence[str]) -> Iterator[tuple[Path, int, int]]:
    """Give the metrics of a run that has learned for a while, and its page's port and process."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with tempfile.TemporaryDirectory() as runs:
        words = [sys.executable, "-m", "mtjax.train", f"--runs={runs}", f"--view={port}", *flags]
        environment = {**os.environ, "PYTHONPATH": str(HERE)}
        process = subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL)
        try:
            while not list(Path(runs).glob("*/checkpoints/*")) and process.poll() is None:
                time.sleep(0.1)
            if process.returncode:
                raise SystemExit(f"{' '.join(words)} failed")
            children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            yield next(Path(runs).glob("*/metrics.csv")), port, int(children[-1])
        finally:
            process.send_signal(signal.SIGINT)
            process.wait()


def pair(metrics: Path, port: int, page: int, span: float) -> dict[str, float]:
    """Return figures of a span in which the page is open, and of one in which nobody looks."""
    ended, pictures = threading.Event(), []
    readers = [threading.Thread(target=read, args=(port, ended, pictures)) for read in (ask, watch)]
    for reader in readers:
        reader.start()
    begun, looked = processor_seconds(page), milliseconds(metrics, span)
    drawing = processor_seconds(page) - begun
    ended.set()
    for reader in readers:
        reader.join()
    time.sleep(1)
    before = processor_seconds(page)
    alone = milliseconds(metrics, span)
    row = {
        "looked_at_milliseconds": looked,
        "alone_milliseconds": alone,
        "ratio": looked / alone,
        **dict(zip(_TAKEN, (drawing, processor_seconds(page) - before), strict=True)),
        "pictures_a_second": len(pictures) / span,
    }
    print(row, flush=True)
    return row


def milliseconds(metrics: Path, span: float) -> float:
    """Return the mean time of an iteration of the chunks that end in a span that begins now."""
    first = of_first_seed(metrics)[-1]
    time.sleep(span)
    last = of_first_seed(metrics)[-1]
    made = lambda name: float(last[name]) - float(first[name])
    if not made("iteration"):
        raise SystemExit("no chunk ended in a span; give shorter chunks or a longer --span")
    return 1000 * made("seconds") / made("iteration")


def of_first_seed(metrics: Path) -> list[dict[str, str]]:
    """Return the lines of metrics of a run's first seed."""
    return [line for line in read_lines(metrics) if line["seed"] == "0"]


def processor_seconds(process: int) -> float:
    """Return the processor time that a process has taken."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def ask(port: int, ended: threading.Event, _: list[float]) -> None:
    """Ask for the numbers every other second."""
    while not ended.wait(2):
        with contextlib.suppress(OSError, http.client.HTTPException):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/run.json", timeout=10).read()


def watch(port: int, ended: threading.Event, pictures: list[float]) -> None:
    """Read the stream of pictures until the span ends, and note when each of them came."""
    while not ended.wait(0.2):
        with contextlib.suppress(OSError, http.client.HTTPException):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/worlds", timeout=30) as stream:
                for line in stream:
                    pictures += [time.time()] * line.startswith(b"Content-Type")
                    if ended.is_set():
                        break


if __name__ == "__main__":
    run_main(main)
