"""Helpers of all benchmarks: settings, the description of the machine, tables, lines of metrics and JSON reports.

This module imports no JAX until it describes the machine, as some benchmarks leave the device to other processes.
"""

import argparse
import csv
import datetime
import importlib.metadata
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import mtjax
from mtjax.names import InputError
from mtjax.report import stats
from mtjax.saved.log import append_rows

_LIBRARIES = ("jax", "jaxlib", "flax", "optax", "numpy", "mujoco", "mujoco-mjx", "warp-lang", "brax", "playground")
_FLAGS = ("XLA_FLAGS", "CUDA_VISIBLE_DEVICES", "JAX_PLATFORMS", "JAX_DEFAULT_MATMUL_PRECISION", "NVIDIA_TF32_OVERRIDE")


def run_main(main: Callable[[], None]) -> None:
    """Run a benchmark. Wrong input, also a file in the place of a folder, ends it with one line, as Ctrl-C does."""
    try:
        main()
    except (InputError, FileExistsError, NotADirectoryError) as error:
        message = re.sub(r"(choose another place with) \S+$", r"\1 --out", str(error))
        raise SystemExit(f"error: {message}") from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None


def texts_of(words: Sequence[str]) -> dict[str, str]:
    """Return the values of words such as ``tau=0.01`` by their names, as they are written.

    Raises:
        InputError: a word has no equals sign.
    """
    for word in words:
        if "=" not in word:
            raise InputError(f"{word!r} is no setting; write NAME=VALUE")
    return dict(word.split("=", 1) for word in words)


def settings_of(words: Sequence[str]) -> dict[str, Any]:
    """Return the values of words such as ``hidden=[64,64]`` by their names, each read as JSON or else as a word."""
    return {name: value(text) for name, text in texts_of(words).items()}


def value(word: str) -> Any:
    """Read a setting as JSON, or else as a word."""
    try:
        found = json.loads(word)
    except json.JSONDecodeError:
        return word
    return tuple(found) if isinstance(found, list) else found


def machine() -> dict[str, Any]:
    """Return the machine, the versions, the commit and the date of figures.

    ``MTJAX_COMMIT`` names the commit where a copy without its history runs. "+" marks changes beyond the commit.
    """
    import jax

    devices = jax.devices()
    return {
        "device": devices[0].device_kind,
        "devices": len(devices),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name.replace("-", "_"): version(name) for name in _LIBRARIES},
        "mtjax": mtjax.__version__,
        "commit": os.environ.get("MTJAX_COMMIT") or commit(),
        "date": datetime.date.today().isoformat(),
        "flags": {name: os.environ[name] for name in _FLAGS if name in os.environ},
    }


def version(library: str) -> str | None:
    """Return the version of a library, or None if it is not installed."""
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


def commit() -> str | None:
    """Return the commit of this copy, with "+" if tracked files differ from it; None without a history."""
    git = lambda *words: subprocess.run(["git", *words], capture_output=True, text=True, cwd=Path(__file__).parent)
    head = git("rev-parse", "--short", "HEAD").stdout.strip()
    return head + "+" * bool(git("status", "--porcelain", "--untracked-files=no").stdout.strip()) if head else None


def record(arguments: argparse.Namespace, figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return figures with what made them: the benchmark, its settings, the machine, the versions and the commit."""
    settings = {name: value for name, value in vars(arguments).items() if name not in ("json", "plots")}
    made = {"benchmark": os.path.basename(sys.argv[0]), "machine": machine(), "settings": settings}
    return {**made, **figures}


def note_origin(arguments: argparse.Namespace, out: Path) -> None:
    """Write what makes the figures in a folder to ``OUT/origin.json``: a line for each call that differs in it."""
    out.mkdir(parents=True, exist_ok=True)
    file, made = out / "origin.json", json.dumps(record(arguments, {}), default=str)
    known = file.read_text().splitlines() if file.exists() else []
    if made not in known:
        with file.open("a") as lines:  # in one write, as other processes may add theirs now
            lines.write(made + "\n")


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    line = lambda cells: "| " + " | ".join(cells) + " |"
    return "\n".join([line(head), "|" + "---|" * len(head), *map(line, rows)])


def difference(own: np.ndarray, other: np.ndarray | None) -> str:
    """Return the paired difference of two ways' scores (S,), if both have finished with as many seeds."""
    return "-" if other is None or len(own) != len(other) else f"{stats.paired_difference(own, other):+.1f}"


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
    report = record(arguments, {"rows": rows})
    print(json.dumps(report, default=str))
    if arguments.json:
        with open(arguments.json, "x") as file:
            json.dump(report, file, indent=2, default=str)
