"""Helpers of all benchmarks: the description of the machine, tables, lines of metrics and JSON reports."""

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import mujoco

import mtjax
from mtjax.names import InputError, NoRoomError
from mtjax.training.log import append_rows


def run_main(main: Callable[[], None]) -> None:
    """Run a benchmark. Wrong input, also a file in the place of a folder, ends it with one line, as Ctrl-C does."""
    try:
        main()
    except (InputError, FileExistsError, NotADirectoryError) as error:
        if isinstance(error, NoRoomError):
            error.place = "--out"
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def machine() -> dict[str, Any]:
    """Return the machine, the versions and the commit of the figures."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=os.path.dirname(__file__) or "."
    )
    return {
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "mtjax": mtjax.__version__,
        "commit": commit.stdout.strip() or None,
    }


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    line = lambda cells: "| " + " | ".join(cells) + " |"
    return "\n".join([line(head), "|" + "---|" * len(head), *map(line, rows)])


def read_lines(path: Path) -> list[dict[str, str]]:
    """Return the lines of a CSV file by the names of its columns, without what a killed process left half written."""
    with path.open(newline="") as file:
        return [line for line in csv.DictReader(file) if None not in line.values()]


def write_lines(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write a CSV file anew. Without rows there is none."""
    path.unlink(missing_ok=True)
    if rows:
        append_rows(path, rows)


def publish(arguments: argparse.Namespace, rows: list[dict]) -> None:
    """Print the figures as JSON, and write them to ``--json`` if that was given."""
    settings = {name: value for name, value in vars(arguments).items() if name not in ("json", "plots")}
    report = {"benchmark": os.path.basename(sys.argv[0]), "machine": machine(), "settings": settings, "rows": rows}
    print(json.dumps(report, default=str))
    if arguments.json:
        with open(arguments.json, "x") as file:
            json.dump(report, file, indent=2, default=str)
