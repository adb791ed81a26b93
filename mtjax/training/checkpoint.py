"""Checkpoints of the whole training state by orbax. A resumed run continues bit for bit, but on MuJoCo Warp."""

import json
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax

from mtjax.experience.ring import Ring
from mtjax.loop import TrainState
from mtjax.types import InputError

_KEPT = 2
_SIZES = "sizes.json"  # sizes of a checkpoint's files, by which damage is found before orbax reads them


def save(directory: Path, state: TrainState) -> None:
    """Write the state under its iteration, and keep the last two checkpoints."""
    from orbax.checkpoint import v1 as ocp

    iteration = int(state.iteration)
    with ocp.training.Checkpointer(
        str(directory.absolute()),
        save_decision_policy=ocp.training.save_decision_policies.FixedIntervalPolicy(1),  # type: ignore
        preservation_policy=ocp.training.preservation_policies.LatestN(_KEPT),  # type: ignore
    ) as checkpointer:
        known = checkpointer.latest
        if known is None or known.step != iteration:
            checkpointer.save_checkpointables(iteration, {"agent": state.agent, "loop": state._replace(agent=None)})
    folder = directory / str(iteration)
    if jax.process_index() == 0:
        (folder / _SIZES).write_text(json.dumps(_sizes(folder)))


def load(directory: Path, like: TrainState) -> TrainState:
    """Read the newest checkpoint into the structure of ``like``, whose leaves may be shapes alone.

    Arrays go to the devices that ``like`` names, by default to the first one. Their number may differ from that of
    the devices that saved the checkpoint.
    """
    found = _load(directory, {"agent": like.agent, "loop": like._replace(agent=None)})
    return found["loop"]._replace(agent=found["agent"])


def load_agent(directory: Path, like: TrainState, iteration: int = 0) -> Any:
    """Read only the agent's state, which suffices for acting: the newest, or that of an iteration."""
    if iteration and not (directory / str(iteration)).is_dir():
        kept = ", ".join(sorted((path.name for path in directory.glob("*") if path.name.isdigit()), key=int))
        raise InputError(f"{str(directory)!r} has no checkpoint {iteration}; it has {kept or 'none'}")
    return _load(directory, {"agent": like.agent}, iteration=iteration)["agent"]


def load_ring(directory: Path, like: TrainState) -> Ring:
    """Read only the replay's ring buffer, without the worlds and the agent."""
    return _load(directory, {"loop": {"data": {"ring": like.data.ring}}}, partial=True)["loop"]["data"]["ring"]


def _sizes(folder: Path) -> dict[str, int]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != _SIZES)
    return {str(path.relative_to(folder)): path.stat().st_size for path in files}


def _newest(directory: Path) -> Path:
    """Return the folder of the newest checkpoint. Folders that are still being written have longer names."""
    folders = [path for path in directory.glob("*") if path.name.isdigit()]
    if not folders:
        raise InputError(f"{str(directory)!r} holds no checkpoint; the run stopped before its first one")
    return max(folders, key=lambda path: int(path.name))


def _require_whole(folder: Path, parts: Iterable[str]) -> None:
    """Refuse a damaged checkpoint with one line, where orbax would print pages of tracebacks."""
    if not (folder / _SIZES).exists():  # the run was killed just before it wrote them
        return
    try:
        expected, found = json.loads((folder / _SIZES).read_text()), _sizes(folder)
        needed = [name for name in expected if "/" not in name or name.split("/")[0] in parts]
        damaged = next((name for name in needed if found.get(name) != expected[name]), None)
    except (ValueError, AttributeError):
        damaged = _SIZES
    if damaged is not None:
        raise InputError(
            f"the checkpoint {str(folder)!r} is damaged: {damaged} is missing or has changed; "
            "without this folder, the one before it is the newest"
        )


def _load(directory: Path, like: dict[str, Any], partial: bool = False, iteration: int = 0) -> dict[str, Any]:
    from orbax.checkpoint import v1 as ocp

    first = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    place = lambda x: getattr(x, "sharding", None) or first
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place(x)), like)
    newest = directory / str(iteration) if iteration else _newest(directory)
    _require_whole(newest, like)
    context = ocp.Context()
    context.pytree.loading.partial_load = partial
    try:
        with context, ocp.training.Checkpointer(str(directory.absolute())) as checkpointer:
            return checkpointer.load_checkpointables(int(newest.name), like)
    except (ValueError, KeyError, OSError, json.JSONDecodeError) as error:
        reason = str(error).strip().splitlines()[0][:150]
        raise InputError(f"the checkpoint in {str(directory)!r} cannot be read: {reason}") from None


def size_of(state: Any) -> int:
    """Return the bytes that a state, or its shapes, takes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))


def require_space(directory: Path, state: Any) -> None:
    """Check that the disk has room for the checkpoints of a run.

    Raises:
        InputError: it has too little.
    """
    needed, free = (_KEPT + 1) * size_of(state), shutil.disk_usage(directory).free
    if needed > free:
        raise InputError(
            f"checkpoints need {needed / 1e6:.0f} MB and {str(directory)!r} has {free / 1e6:.0f} MB free; "
            "lower --replay-size or choose another place with --runs"
        )
