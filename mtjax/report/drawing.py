"""The command ``python -m mtjax.plot``: draw figures of runs into files."""

from collections.abc import Sequence
from pathlib import Path

from mtjax.names import InputError
from mtjax.report import collect, plots


def draw(runs: Sequence[str], figure: str, split: str, metric: str, baseline: str, out: str) -> None:
    """Draw a figure of runs, or all that these runs allow, and print the files.

    Args:
        figure: a name of ``plots.FIGURES``, or "all".
        metric: "return", or another score of evaluations.
        out: the file to write; of all figures, the ending counts and the names follow from the stem.
    """
    found = collect.learned(runs) if metric == "return" else collect.of_metric(runs, metric)
    names = list(plots.FIGURES) if figure == "all" else [figure]
    path = Path(out or ("runs.png" if figure == "all" else f"{figure}.png"))
    drawn = 0
    for name in names:
        file = path if figure != "all" else path.with_name(f"{path.stem}-{name}{path.suffix}")
        try:
            axes = _draw(name, found, split, baseline)
        except InputError as error:
            if figure != "all":
                raise
            print(f"{name}: left out, as {error}")
            continue
        print(f"written to {plots.save(axes, file)}")
        drawn += 1
    if not drawn:
        raise InputError("there was nothing to draw")


def _draw(name: str, found: list[collect.Learned], split: str, baseline: str):
    given = {} if name == "parameter" else {"split": split}
    given |= {"baseline": baseline} if name == "improvement" and baseline else {}
    return plots.FIGURES[name](found, **given)
