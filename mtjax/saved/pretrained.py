"""Trained policies that come with the package: a folder with config.json, and the arrays that acting reads."""

from pathlib import Path

import numpy as np

from mtjax.names import InputError, nearest_error

FOLDER = Path(__file__).parents[1] / "pretrained"
FILE = "policy.npz"  # in the folder of such a policy, beside config.json


def names() -> list[str]:
    """Return the names of all trained policies, such as "finger-spin-vary-size/sac-conditioned"."""
    return sorted(file.parent.relative_to(FOLDER).as_posix() for file in FOLDER.glob(f"*/*/{FILE}"))


def folder(run: str | Path) -> Path:
    """Return the folder of a run, or that of a trained policy of this name if there is no such folder.

    Raises:
        InputError: there is neither, and the name is like that of a trained policy.
    """
    place = Path(run)
    if not place.is_dir() and str(run) in names():
        return FOLDER / run
    part_of_one = [name for name in names() if str(run) in name.split("/")]  # a family or an agent alone
    if not place.exists() and (part_of_one or (len(place.parts) == 2 and not place.parent.exists())):
        raise nearest_error("run or trained policy", str(run), part_of_one or names())
    return place


def is_pretrained(directory: Path) -> bool:
    """Return whether a folder holds a policy alone. A run may have one beside its checkpoints: it stays a run."""
    return (directory / FILE).is_file() and not (directory / "checkpoints").exists()


def require_learning(directory: Path | None) -> None:
    """Refuse the folder of a policy that cannot go on learning; None is of a run that wrote none.

    Raises:
        InputError: it holds a policy alone.
    """
    if directory is not None and is_pretrained(directory):
        raise not_learning(str(directory))


def not_learning(name: str) -> InputError:
    """Return an error for a trained policy that should go on learning."""
    return InputError(f"{name!r} is a policy without critics and replay, so it cannot go on learning")


def arrays(directory: Path) -> dict[int, np.ndarray]:
    """Return those leaves of the agent's state that acting reads, by their number.

    Raises:
        InputError: the file is damaged.
    """
    try:
        with open(directory / FILE, "rb") as file, np.load(file, allow_pickle=False) as found:
            return {int(name): found[name] for name in found.files}
    except Exception as error:
        raise InputError(f"{str(directory / FILE)!r} cannot be read: {type(error).__name__}: {error}") from None
