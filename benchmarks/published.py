"""Say which families a run has learned: by the share of the best published return that it reached.

    python benchmarks/published.py FILE.csv ...

FILE has lines of family, seconds, steps and return, as that of ``families.py`` has, or ``results/cpu-families.csv``.
A run's return is the mean of its lines in the last tenth of its seconds. A family is learned from ``SHARE`` of the best
published return on its nominal task on, and where none is known, of 1000, which is the most that dm_control pays.
"""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from report import markdown, read_lines, run_main

from mtjax.names import InputError

SHARE = 0.6
_MOST = 1000.0  # of dm_control's episodes
_COLUMNS = ("family", "seconds", "return")


class Best(NamedTuple):
    """Holds the best published mean return on a task, and where it is from."""

    value: float
    source: str


_SIMBA = "after 1M steps, results/baseline of SimbaV2's code, 14fafb2"
_XQC = "after 1M steps, results of XQC's code, 9a6832b"
_SLM = "PPO after 100M steps on Playground, SLM-Lab 96be393, docs/BENCHMARKS.md"
PUBLISHED = {
    "finger-spin": Best(989, f"BRO {_SIMBA}"),
    "cheetah-run": Best(920, f"SimbaV2 {_SIMBA}"),
    "walker-run": Best(842, f"TD-MPC2 {_SIMBA}"),
    "walker-walk": Best(980, f"TD-MPC2 {_SIMBA}"),
    "cartpole-swingup": Best(880, f"BRO and SimbaV2 {_SIMBA}"),
    "hopper-hop": Best(338, f"TD-MPC2 {_SIMBA}"),
    "acrobot-swingup": Best(567, f"MR.Q {_SIMBA}"),
    "reacher-hard": Best(981, f"TD-MPC2 {_SIMBA}"),
    "humanoid-walk": Best(713, f"XQC {_XQC}"),
    "humanoid-run": Best(216, f"XQC {_XQC}"),
    "dog-run": Best(645, f"XQC {_XQC}"),
    "ball-in-cup-catch": Best(942, _SLM),
    "reacher-easy": Best(955, _SLM),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE.csv")
    for file in parser.parse_args().files:
        print(tabulate(last_returns(read(file))))


def read(file: Path) -> list[dict[str, str]]:
    """Return the lines of a file of curves.

    Raises:
        InputError: there is no such file, or it has other columns.
    """
    lines = read_lines(file) if file.is_file() else []
    if not lines or not set(_COLUMNS) <= set(lines[0]):
        raise InputError(f"{str(file)!r} is no file with lines of {', '.join(_COLUMNS)}")
    return lines


def nominal(family: str) -> str:
    """Return the task of which a family's tasks are variants."""
    return family.split("-vary-")[0]


def best_of(family: str) -> Best:
    """Return the best published return on a family's nominal task, or the most that there is."""
    return PUBLISHED.get(nominal(family), Best(_MOST, "none known; the most of an episode"))


def is_learned(family: str, value: float) -> bool:
    return value >= SHARE * best_of(family).value


def last_returns(lines: list[dict[str, str]]) -> dict[str, float]:
    """Return the mean return of each family in the last tenth of its seconds."""
    found: dict[str, list[tuple[float, float]]] = {}
    for line in (line for line in lines if line["return"] not in ("", "nan")):
        found.setdefault(line["family"], []).append((float(line["seconds"]), float(line["return"])))
    ends = {family: [x for seconds, x in of if seconds >= 0.9 * of[-1][0]] for family, of in found.items()}
    return {family: sum(end) / len(end) for family, end in ends.items()}


def tabulate(returns: Mapping[str, float]) -> str:
    """Return a table of families with their shares, the largest first, and how many are learned."""
    share = lambda family: returns[family] / best_of(family).value
    lines = [
        [
            family,
            f"{returns[family]:.0f}",
            f"{best_of(family).value:.0f}",
            f"{share(family):.2f}",
            best_of(family).source,
        ]
        for family in sorted(returns, key=share, reverse=True)
    ]
    learned = sum(is_learned(family, x) for family, x in returns.items())
    head = ["family", "return", "best published", "share", "by"]
    return f"{markdown(head, lines)}\n\n{learned} of {len(returns)} are learned: their share is at least {SHARE}."


if __name__ == "__main__":
    run_main(main)
