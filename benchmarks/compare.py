"""Compare two reports of one benchmark, and flag every figure that has become slower.

    python benchmarks/compare.py RECORDED.json NEW.json [--tolerance 1.15] [--absolute]
    python benchmarks/compare.py RECORDED.json --again [--tolerance 1.15] [--absolute]

With ``--again`` the benchmark of RECORDED runs again with its recorded settings. Rows are matched by everything but
figures. A ratio says how many times slower a figure is than before (1.2: a fifth more time, or a sixth less rate).
Machines differ in speed, so each ratio is divided by the median ratio of its kind of figure. A change that is common to
all is then not flagged. ``--absolute`` uses plain ratios, which suits one quiet machine. The exit code is 1 if a figure
is missing or slower by more than the tolerance.
"""

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from report import run_main

# Figures of which less is better, and those of which more is. Other entries of a row are its settings or spreads.
LESS = ("milliseconds", "compile_seconds", "first_call_seconds", "first_metrics", "training", "reached", "cost")
MORE = ("steps_per_second", "updates_per_second")
_IDENTITY = ("agent", "domain", "contestant", "axis", "value", "tasks", "seeds", "worlds", "cache", "setting", "engine")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recorded", type=Path)
    parser.add_argument("new", type=Path, nargs="?")
    parser.add_argument("--again", action="store_true", help="measure now instead of reading a second report")
    parser.add_argument("--tolerance", type=float, default=1.15)
    parser.add_argument("--absolute", action="store_true")
    arguments = parser.parse_args()
    if arguments.again == (arguments.new is not None):
        parser.error("give a second report, or --again")
    if arguments.tolerance <= 1:
        parser.error(f"--tolerance is a ratio above 1, not {arguments.tolerance}")
    recorded = read(arguments.recorded)
    new = measure(recorded) if arguments.again else read(arguments.new)
    for what in ("device", "cores", "jax"):
        then, now = recorded["machine"].get(what), new["machine"].get(what)
        if then != now:
            print(f"note: {what} was {then} and is {now}")
    lines, slower = judge(recorded["rows"], new["rows"], arguments.tolerance, arguments.absolute)
    print("\n".join(lines))
    raise SystemExit(1 if slower else 0)


def read(path: Path) -> dict[str, Any]:
    """Read a report that a benchmark wrote with ``--json``."""
    try:
        report = json.loads(path.read_text())
        return {"machine": dict(report["machine"]), **report, "rows": list(report["rows"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SystemExit(f"error: {str(path)!r} is no report of a benchmark: {error}") from None


def measure(recorded: dict[str, Any]) -> dict[str, Any]:
    """Run the benchmark of a report again with its settings, and return the new report."""
    if "benchmark" not in recorded:
        raise SystemExit("error: the report does not say which benchmark wrote it; run that, and give both reports")
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "new.json"
        script = Path(__file__).parent / Path(recorded["benchmark"]).name
        command = [sys.executable, str(script), *words(recorded["settings"]), f"--json={file}"]
        print(" ".join(command), flush=True)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return read(file)


def words(settings: dict[str, Any]) -> list[str]:
    """Return the command-line flags of a benchmark's settings."""
    found, last = [], list(settings.pop("flags", ()))
    for name, value in settings.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, list):
            found += [flag, *map(str, value)] if value else []
        elif value is True:
            found.append(flag)
        elif value not in (None, False):
            found.append(f"{flag}={value}")
    return found + (["--", *last] if last else [])


def judge(recorded: list[dict], new: list[dict], tolerance: float, absolute: bool) -> tuple[list[str], bool]:
    """Return a line for every figure, and whether any is slower or missing."""
    identity = lambda row: tuple((name, row[name]) for name in _IDENTITY if name in row)
    now = {identity(row): row for row in new}
    missing = [identity(row) for row in recorded if identity(row) not in now]
    lines = [f"MISSING  {_words(which)}" for which in missing]
    slower = bool(missing)
    for figure in (*LESS, *MORE):
        ratios = {}
        for row in recorded:
            then, after = row.get(figure), now.get(identity(row), {}).get(figure)
            if then and after:
                ratios[identity(row)] = after / then if figure in LESS else then / after
            elif then and identity(row) in now:
                lines.append(f"MISSING  {_words(identity(row))}: {figure}")
                slower = True
        common = 1.0 if absolute or not ratios else statistics.median(ratios.values())
        for which, ratio in ratios.items():
            verdict = "SLOWER" if ratio / common > tolerance else "faster" if ratio / common < 1 / tolerance else "same"
            slower |= verdict == "SLOWER"
            beside = "" if absolute else f", {ratio / common:.2f} beside the others"
            lines.append(f"{verdict:8} {_words(which)}: {figure} {ratio:.2f} x{beside}")
    return lines, slower


def _words(which: tuple) -> str:
    return " ".join(f"{name}={value}" for name, value in which)


if __name__ == "__main__":
    run_main(main)
