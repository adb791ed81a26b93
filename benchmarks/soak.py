"""Whether a long run keeps its memory: the resident memory of a training process over minutes.

    python benchmarks/soak.py [--minutes N] [--json FILE] [-- --env=... --agent=...]

One process trains with many evaluations and checkpoints, and with whatever flags follow ``--``. Memory is read twice a
second. In the first minute it may grow, while programs compile and the replay fills. The time after that is cut into
ten equal parts. Memory is flat if the median of the last part is at most 2 % (and at least 20 MB) above that of the
first part. Otherwise the exit code is 1.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from report import machine, markdown, run_main

_PAGE = os.sysconf("SC_PAGE_SIZE")
_RUN = (
    "--env=finger-spin-vary-size --agent=sac-conditioned --num-envs=4 --replay-size=2000 --chunk-steps=50 "
    "--eval-every=4000 --eval-episodes=1 --steps=1000000000 --agent.hidden 64 64"
).split()
_RATE, _WARM_UP, _PARTS = 2, 60, 10  # readings a second, seconds that do not count, parts of the time after them
_SHARE, _LEAST = 0.02, 20  # of growth that passes for flat: a share, or MB


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("flags", nargs="*", metavar="-- FLAGS", help="flags of the run")
    arguments = parser.parse_args()
    if arguments.minutes < 2:
        parser.error("--minutes must be at least 2, as the first one does not count")
    flags = [*_RUN, *arguments.flags]
    samples, saved = soak(arguments.minutes * 60, flags)
    medians, flat = judge(samples)
    growth = medians[-1] - medians[0]
    part = (len(samples) / _RATE - _WARM_UP) / _PARTS
    minutes = [f"{(_WARM_UP + i * part) / 60:.1f} to {(_WARM_UP + (i + 1) * part) / 60:.1f}" for i in range(_PARTS)]
    table = [[span, f"{median:.0f}"] for span, median in zip(minutes, medians, strict=True)]
    print(markdown(["minutes", "median of resident memory, MB"], table))
    print(f"{'flat' if flat else 'NOT FLAT'}: {growth:+.1f} MB from the first part to the last; checkpoints: {saved}")
    if arguments.json:
        rows = [{"medians": medians, "flat": flat, "checkpoints": saved, "samples": samples[:: 10 * _RATE]}]
        report = {"benchmark": "soak.py", "machine": machine(), "flags": flags, "rows": rows}
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    sys.exit(0 if flat else 1)


def soak(seconds: float, flags: list[str]) -> tuple[list[float], int]:
    """Train for so many seconds. Return the resident memory (MB) twice a second, and the number of checkpoints."""
    seen: set[str] = set()
    with tempfile.TemporaryDirectory() as runs:
        command = [sys.executable, "-m", "mtjax.train", *flags, f"--runs={runs}"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        samples, end = [], time.monotonic() + seconds
        while time.monotonic() < end and process.poll() is None:
            samples.append(int(Path(f"/proc/{process.pid}/statm").read_text().split()[1]) * _PAGE / 1e6)
            seen |= {str(path) for path in Path(runs).glob("*/checkpoints/*") if path.name.isdigit()}
            time.sleep(1 / _RATE)
        process.send_signal(signal.SIGTERM)
        if process.wait(300) == -signal.SIGTERM:  # which it did not yet handle
            sys.exit("the run was still compiling when the time was over; give more --minutes")
        if process.returncode != 128 + signal.SIGTERM:
            sys.exit(f"the run ended by itself with code {process.returncode}")
    return samples, len(seen)


def judge(samples: list[float]) -> tuple[list[float], bool]:
    """Return the medians of ten equal parts of the readings after the first minute, and whether memory stays flat."""
    counted = samples[_WARM_UP * _RATE :]
    size = len(counted) // _PARTS
    medians = [statistics.median(counted[i * size : (i + 1) * size]) for i in range(_PARTS)]
    return medians, medians[-1] <= medians[0] + max(_SHARE * medians[0], _LEAST)


if __name__ == "__main__":
    run_main(main)
