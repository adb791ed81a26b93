"""How much its page slows a run: seconds of training with ``--view`` beside those without.

    python benchmarks/live_page.py [--repeats 5] [--pages without closed open] [--json FILE] [-- --env=... --agent=...]

Without flags after ``--`` it trains by ``--quick``. Each repeat trains once without a page, once with a page that
nobody looks at, and once with one that is open: then this program asks for the numbers every other second and reads the
pictures of the moving worlds, as a browser does. Only a browser's own drawing is left out. The order changes from
repeat to repeat, and a ratio is to the run without a page of the same repeat. Seconds are those of all chunks but the
first, without compiling, evaluations and checkpoints; the ratio by the clock has these too, but what compiles before
the first line of metrics.
"""

import argparse
import contextlib
import http.client
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

from report import markdown, publish, read_lines, run_main

HERE = Path(__file__).resolve().parent.parent
PAGES = ("without", "closed", "open")
_CLOCKS = ("seconds", "wall_seconds")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pages", nargs="+", choices=PAGES, default=PAGES)
    parser.add_argument("--json", help="write the figures to this file")
    words = [*sys.argv[1:], "--"]
    arguments = parser.parse_args(words[: words.index("--")])
    arguments.flags = words[words.index("--") + 1 : -1] or ["--quick"]
    rows = []
    with tempfile.TemporaryDirectory() as place:
        train(arguments.flags, "without", Path(place) / "first", Path(place))  # fills the cache of programs
        for repeat in range(arguments.repeats):
            for page in turned(arguments.pages, repeat):
                runs = Path(place) / f"{page}-{repeat}"
                rows.append({"repeat": repeat, "page": page, **train(arguments.flags, page, runs, Path(place))})
                print(rows[-1], flush=True)
    print(table(rows))
    publish(arguments, rows)


def turned(pages: list[str], repeat: int) -> list[str]:
    """Return the pages in an order that begins with another one in each repeat."""
    first = repeat % len(pages)
    return [*pages[first:], *pages[:first]]


def train(flags: list[str], page: str, runs: Path, place: Path) -> dict[str, float]:
    """Train once, and return the seconds of the chunks after the first, and how many pictures were read."""
    port, ended, pictures = free_port(), threading.Event(), []
    words = [sys.executable, "-m", "mtjax.train", f"--runs={runs}", *flags]
    words += [f"--view={port}"] * (page != "without")
    environment = {**os.environ, "PYTHONPATH": str(HERE), "MTJAX_CACHE": str(place / "cache")}
    readers = [threading.Thread(target=look, args=(port, ended, pictures)) for look in (ask, watch)]
    readers *= page == "open"
    with subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL) as process:
        for reader in readers:
            reader.start()
        process.wait()
    ended.set()
    for reader in readers:
        reader.join()
    if process.returncode:
        raise SystemExit(f"{' '.join(words)} failed")
    (file,) = runs.glob("*/metrics.csv")
    lines = read_lines(file)
    return {name: float(lines[-1][name]) - float(lines[0][name]) for name in _CLOCKS} | {"pictures": len(pictures)}


def free_port() -> int:
    """Return a port that no program has."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def ask(port: int, ended: threading.Event, _: list[float]) -> None:
    """Ask for the numbers every other second."""
    while not ended.wait(2):
        with contextlib.suppress(OSError, http.client.HTTPException):
            urllib.request.urlopen(f"http://127.0.0.1:{port}/run.json", timeout=10).read()


def watch(port: int, ended: threading.Event, pictures: list[float]) -> None:
    """Read the stream of pictures, and note when each of them came."""
    while not ended.wait(0.2):
        with contextlib.suppress(OSError, http.client.HTTPException):
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/worlds", timeout=30) as stream:
                pictures += (time.time() for line in stream if line == b"Content-Type: image/jpeg\r\n")


def table(rows: list[dict]) -> str:
    """Return the ratios to the run without a page of the same repeat: the median and the range."""
    found = []
    for page in dict.fromkeys(row["page"] for row in rows):
        mine = [row for row in rows if row["page"] == page]
        cells = [shown([row[clock] / base(rows, row)[clock] for row in mine]) for clock in _CLOCKS]
        seconds = statistics.median(row["seconds"] for row in mine)
        found.append([page, f"{seconds:.1f}", *cells, str(statistics.median(row["pictures"] for row in mine))])
    head = ["page", "seconds of training", "ratio", "ratio by the clock, with evaluations", "pictures"]
    return markdown(head, found)


def base(rows: list[dict], row: dict) -> dict:
    """Return the row without a page of the same repeat."""
    return next(other for other in rows if (other["page"], other["repeat"]) == ("without", row["repeat"]))


def shown(ratios: list[float]) -> str:
    """Return the median of ratios, and their range."""
    return f"{statistics.median(ratios):.2f} [{min(ratios):.2f}, {max(ratios):.2f}]"


if __name__ == "__main__":
    run_main(main)
