"""Whether a long run keeps its memory: the resident memory of a training process over minutes.

    python benchmarks/soak.py [--minutes N] [--json FILE] [-- --env=... --agent=...]

One process trains with many evaluations and checkpoints, and with whatever flags follow ``--``. Memory is read twice a
second. It may grow while programs compile and the replay fills. It is flat if the median of the run's last third is at
most 2 % (and at least 20 MB) above that of its second third. Otherwise the exit code is 1.
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

from report import machine, markdown

_PAGE = os.sysconf("SC_PAGE_SIZE")
_RUN = (
    "--env=finger-spin-vary-size --agent=sac-conditioned --num-envs=4 --replay-size=2000 --chunk-steps=50 "
    "--eval-every=4000 --eval-episodes=1 --steps=1000000000 --agent.hidden 64 64"
).split()
_SHARE, _LEAST = 0.02, 20  # of growth that passes for flat: a share, or MB


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("flags", nargs="*", metavar="-- FLAGS", help="flags of the run")
    arguments = parser.parse_args()
    samples, saved = soak(arguments.minutes * 60, [*_RUN, *arguments.flags])
    medians, flat = judge(samples)
    growth = medians[2] - medians[1]
    thirds = [[name, f"{x:.0f}"] for name, x in zip(("first", "second", "last"), medians, strict=True)]
    print(markdown(["third of the run", "median of resident memory, MB"], thirds))
    print(f"{'flat' if flat else 'NOT FLAT'}: {growth:+.1f} MB from the second third to the last; checkpoints: {saved}")
    if arguments.json:
        report = {"machine": machine(), "rows": [{"thirds": medians, "flat": flat, "samples": samples[::20]}]}
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
            time.sleep(0.5)
        process.send_signal(signal.SIGTERM)
        if process.wait(300) != 128 + signal.SIGTERM:
            sys.exit(f"the run ended by itself with code {process.returncode}")
    return samples, len(seen)


def judge(samples: list[float]) -> tuple[list[float], bool]:
    """Return the median of each third of the samples, and whether memory is flat after the first."""
    third = len(samples) // 3
    medians = [statistics.median(samples[i * third : (i + 1) * third]) for i in range(3)]
    return medians, medians[2] <= medians[1] + max(_SHARE * medians[1], _LEAST)


if __name__ == "__main__":
    main()
