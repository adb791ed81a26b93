"""Checkpoints of the whole training state, written by orbax beside training, and their checksums.

A run's ``checkpoints`` folder holds the newest two, each in a folder named after its iteration. A checkpoint is written
under another name, and gets its own name last: whatever ends a run, a folder with a number for a name is whole. Disks
and copies damage files later. The checksums tell, and then the checkpoint before is used. Every checkpoint holds a copy
of the run's config.json, which tells whether that was edited or damaged, and the number of its format, which tells
of other versions. A resumed run continues bit for bit, but on MuJoCo Warp.
"""

import errno
import hashlib
import os
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax

from mtjax.experience.ring import Ring
from mtjax.learning.loop import TrainState
from mtjax.names import notice
from mtjax.parallel import hosts
from mtjax.saved import arrays
from mtjax.saved.folder import tell_edits
from mtjax.types import InputError

_KEPT = 2
_RECORD = "config.json"  # beside the folder of checkpoints
_FORMAT = 5  # counts the changes of the training state's structure
_FORMAT_FILE = "format.txt"  # checkpoints without one are of format 1
_SUMS = "checksums.txt"  # as of sha256sum, by which users can check them too
_LINE = re.compile(r"([0-9a-f]{64})  (.+)")
_UNFINISHED = ("*.new", "*.orbax-checkpoint-tmp")  # what a killed process leaves
_UNKNOWN = (errno.EOPNOTSUPP, errno.EINVAL)  # of a file system that reserves no room

# Writing.


class Writer:
    """Writes checkpoints into a folder, one at a time, while training goes on.

    The state is copied to the host before ``save`` returns, so that the next chunk may overwrite it. Copies of the
    run's config.json are as it was when the run began, whatever happens to the file meanwhile.
    """

    def __init__(self, directory: Path):
        self.directory, self.pending = directory, None
        record = directory.parent / _RECORD
        self.record = record.read_bytes() if record.is_file() else None
        self.thread = ThreadPoolExecutor(1, "checkpoint")

    def save(self, state: TrainState) -> None:
        """Begin to write the state under its iteration, once the checkpoint before is written.

        Raises:
            OSError: that checkpoint could not be written, or this one cannot be begun.
        """
        self.wait()
        self.pending = _begin(self.directory / str(int(state.iteration)), state, self.record, self.thread)

    def wait(self) -> None:
        """Wait until the last checkpoint is written.

        Raises:
            OSError: it could not be written. Those before it are still there.
        """
        pending, self.pending = self.pending, None
        if pending is not None:
            pending.result()


def save(directory: Path, state: TrainState) -> None:
    """Write the state under its iteration, and keep the last two checkpoints."""
    writer = Writer(directory)
    writer.save(state)
    writer.wait()


def _begin(folder: Path, state: TrainState, record: bytes | None, thread: ThreadPoolExecutor) -> Future[None] | None:
    """Copy the state to the host, and let the thread write it. Every process writes what its devices hold."""
    if folder.exists():
        return None
    new = folder.with_suffix(".new")
    shortage = hosts.largest(_shortage(folder, size_of(state)) if hosts.is_first() else 0)
    if shortage:
        raise _not_written(OSError(shortage, os.strerror(shortage)), folder)
    parts = _parts(state)
    try:
        written = arrays.write(new, parts)
    except OSError as error:
        raise _not_written(error, folder) from None
    return thread.submit(_finish, written, record, new, folder, _shapes(parts))


def _shortage(folder: Path, size: int) -> int:
    """Return the system's error number if it has no room for a new folder of so many bytes, else 0.

    Asked beforehand, because orbax meets a full disk in many threads, of which each reports it at length.
    """
    room = folder.with_suffix(".new")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with room.open("wb") as file:
            if hasattr(os, "posix_fallocate"):  # which knows of quotas and limits too
                os.posix_fallocate(file.fileno(), 0, size)
            elif shutil.disk_usage(folder.parent).free < size:
                return errno.ENOSPC
    except OSError as error:
        return 0 if error.errno in _UNKNOWN else error.errno or errno.EIO
    finally:
        room.unlink(missing_ok=True)
    return 0


def _finish(written: arrays.Written, record: bytes | None, new: Path, folder: Path, parts: dict[str, Any]) -> None:
    """Seal a written checkpoint: add config.json and checksums, give it its name, and drop all but the last two.

    Before, it is read back, given the shapes of its parts.
    """
    try:
        written.wait()
        if not hosts.is_first():
            return
        arrays.require_readable(new, parts)
        if record is not None:
            (new / _RECORD).write_bytes(record)
        (new / _FORMAT_FILE).write_text(f"{_FORMAT}\n")
        names = sorted(_files(new))
        (new / _SUMS).write_text("".join(f"{digest}  {name}\n" for name, digest in _digests(new, names).items()))
        new.rename(folder)
    except OSError as error:
        remove_unfinished(folder.parent)
        raise _not_written(error, folder) from None
    for old in _folders(folder.parent)[_KEPT:]:
        shutil.rmtree(old, ignore_errors=True)


def _parts(state: TrainState) -> dict[str, Any]:
    """Return a state as it is written: the agents, and all else by name, without what only some runs have."""
    loop = state._replace(agent=None)._asdict()
    own = {name: x for name, x in loop.items() if name not in ("origins", "heard", "begun") or x is not None}
    return {"agent": state.agent, "loop": own}


def _shapes(tree: Any) -> Any:
    """Return a tree without its numbers, which the next chunk overwrites."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)


def _not_written(error: OSError, folder: Path) -> OSError:
    """Return an error of a checkpoint as one that says what is left."""
    return OSError(error.errno, f"checkpoint not written ({error.strerror}); the one before it stays", str(folder))


def remove_unfinished(directory: Path) -> None:
    """Remove what is left of checkpoints that were never finished."""
    for pattern in _UNFINISHED:
        for path in directory.glob(pattern):
            shutil.rmtree(path, ignore_errors=True)


# Reading.


def newest(directory: Path) -> Path | None:
    """Return the folder of the newest checkpoint, whole or damaged; None if there is none."""
    return next(iter(_folders(directory)), None)


def load(directory: Path, like: TrainState) -> TrainState:
    """Read the newest whole checkpoint into the structure of ``like``, whose leaves may be shapes alone.

    Arrays go to the devices that ``like`` names, by default to the first one. Their number may differ from that of
    the devices that saved the checkpoint. Every process must call this.

    Raises:
        InputError: there is no whole checkpoint, or it is of another agent or family.
    """
    like_parts = _parts(like)
    folder = hosts.by_first(_newest_whole)(directory, like_parts)
    if hosts.is_first():
        tell_edits(directory.parent / _RECORD, folder / _RECORD)
    read = _read(folder, like_parts)
    return TrainState(**read["loop"] | {"agent": read["agent"]})


def load_agent(directory: Path, like: TrainState, iteration: int = 0) -> Any:
    """Read only the agent's state, which suffices for acting: the newest whole one, or that of an iteration.

    Raises:
        InputError: there is no such checkpoint, or it is damaged or of another agent.
    """
    parts = {"agent": like.agent}
    folder = _of_iteration(directory, iteration, parts) if iteration else _newest_whole(directory, parts)
    tell_edits(directory.parent / _RECORD, folder / _RECORD)
    return _read(folder, parts)["agent"]


def _of_iteration(directory: Path, iteration: int, parts: Iterable[str]) -> Path:
    folder = directory / str(iteration)
    if folder not in _folders(directory):
        kept = ", ".join(path.name for path in reversed(_folders(directory)))
        raise InputError(f"{str(directory)!r} has no checkpoint {iteration}; it has {kept or 'none'}")
    reason = _damage(folder, parts)
    if reason:
        raise InputError(f"the checkpoint {str(folder)!r} is damaged: {reason}")
    return folder


def load_ring(directory: Path, like: TrainState) -> Ring:
    """Read only the replay's ring buffer, without the worlds and the agent."""
    parts = {"loop": {"data": {"ring": like.data.ring}}}
    return _read(_newest_whole(directory, parts), parts, partial=True)["loop"]["data"]["ring"]


def _read(folder: Path, parts: Mapping[str, Any], partial: bool = False) -> dict[str, Any]:
    """Read parts of a whole checkpoint. One that does not fit is told to be of another version if it is."""
    try:
        return arrays.read(folder, parts, partial)
    except InputError:
        file = folder / _FORMAT_FILE
        number = int(file.read_text()) if file.is_file() else 1
        if number == _FORMAT:
            raise
        version = "an earlier" if number < _FORMAT else "a later"
        raise InputError(
            f"the checkpoint {str(folder)!r} was made by {version} version of mtjax (format {number}, this one reads "
            f"{_FORMAT})"
        ) from None


def set_aside(directory: Path, iteration: int) -> None:
    """Rename the damaged checkpoints after an iteration, so that a run that goes on from there can write its own."""
    for folder in _folders(directory):
        if int(folder.name) > iteration:
            aside = folder.with_suffix(".damaged")
            shutil.rmtree(aside, ignore_errors=True)
            folder.rename(aside)


def _folders(directory: Path) -> list[Path]:
    """Return the folders of all checkpoints, the newest first. Empty folders are none."""
    named = [path for path in directory.glob("*") if path.name.isascii() and path.name.isdigit() and path.is_dir()]
    return sorted((path for path in named if any(path.iterdir())), key=lambda path: int(path.name), reverse=True)


def _newest_whole(directory: Path, parts: Iterable[str]) -> Path:
    """Return the folder of the newest checkpoint whose ``parts`` are whole, and tell of damaged ones.

    Raises:
        InputError: there is none.
    """
    folders = _folders(directory)
    if not folders:
        raise InputError(f"{str(directory)!r} holds no checkpoint; the run stopped before its first one")
    reasons = []
    for folder in folders:
        reason = _damage(folder, parts)
        if not reason:
            for text in reasons:
                notice(f"{text}; the checkpoint before it is used, of iteration {folder.name}")
            return folder
        reasons.append(f"the checkpoint {str(folder)!r} is damaged: {reason}")
    raise InputError(f"{reasons[0]}; there is no whole one before it. Remove {str(directory)!r} to start over")


def _damage(folder: Path, parts: Iterable[str]) -> str:
    """Return which file of a checkpoint has changed, of those of its ``parts``; an empty string if none has."""
    try:
        lines = [_LINE.fullmatch(line) for line in (folder / _SUMS).read_text().splitlines()]
        expected = {line[2]: line[1] for line in lines if line}
        wanted = lambda name: "/" not in name or name.split("/")[0] in parts
        names = sorted({name for name in (*expected, *_files(folder)) if wanted(name)})
        digests = _digests(folder, names)
    except (OSError, UnicodeDecodeError):
        return f"{_SUMS} is missing or has changed"
    return next((f"{name} is missing or has changed" for name in names if digests[name] != expected.get(name)), "")


def _files(folder: Path) -> list[str]:
    """List the files of a checkpoint, by their places in it. Hidden files are the system's."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return [str(path.relative_to(folder)) for path in files if path.name != _SUMS]


def _digests(folder: Path, names: list[str]) -> Mapping[str, str]:
    """Return the SHA-256 of files; an empty string where there is none."""

    def digest(name: str) -> str:
        if not (folder / name).is_file():
            return ""
        with (folder / name).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    with ThreadPoolExecutor(4) as pool:
        return dict(zip(names, pool.map(digest, names), strict=True))


# Sizes.


def size_of(state: Any) -> int:
    """Return the bytes that a state, or its shapes, takes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state))


def require_space(directory: Path, state: Any, beside: int = 0, larger: Sequence[str] = ("replay-size",)) -> None:
    """Check that the disk has room for the checkpoints of a run, and for so many bytes ``beside`` them.

    Args:
        directory: the run's folder. What a run to resume has there already needs no further room.
        larger: the settings that make a run's state large.

    Raises:
        InputError: it has too little, or the folder's path can hold none.
    """
    arrays.require_place(directory)
    files = (file for part in ("checkpoints", "store") for file in (directory / part).rglob("*"))
    held = sum(file.stat().st_size for file in files if file.is_file())
    needed, free = (_KEPT + 1) * size_of(state) + beside - held, shutil.disk_usage(directory).free
    if needed <= free:
        return
    told = f"checkpoints need {needed / 1e6:,.1f} MB and {str(directory)!r} has {free / 1e6:,.1f} MB free; "
    if held:
        raise InputError(f"{told}make room there, as the run goes on with the settings it had")
    lower = " and ".join(f"--{name}" for name in larger)
    raise InputError(f"{told}lower {lower} or choose another place with --runs")
