"""The lock of a run's folder: only one process at a time may write there."""

import contextlib
import fcntl
import os
import platform
import re
from collections.abc import Iterator
from pathlib import Path

from mtjax.names import notice
from mtjax.types import InputError

_NAME = "lock"
_FOLDERS = ("checkpoints", "store", "tensorboard")
_WRITTEN = re.compile(  # the files and folders of runs and sweeps, also half-written and damaged ones
    rf"({_NAME}|config|metrics|evaluations|curve|profile|wandb|sweep|diverged|run-\d+|{'|'.join(_FOLDERS)})(\..*)?"
)
_HOLDER = re.compile(r"process (\d+) on (.*)")


@contextlib.contextmanager
def hold(directory: Path) -> Iterator[Path]:
    """Hold the lock of a folder, and return the folder.

    The system releases the lock when the process ends, however it ends, so that a killed run is never in the way. On
    network file systems the lock holds between hosts if the file system has locks (NFS 4, Lustre with ``flock``, GPFS).
    Others refuse locks; then a notice says that nothing keeps two processes apart.

    Raises:
        InputError: another process holds the lock, or a file that a run writes is a link.
    """
    _require_no_links(directory)
    path = directory / _NAME
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if _lock(file, directory) and _is_at(file, path):  # else its holder has just ended and removed it
                break
        except BaseException:
            os.close(file)
            raise
        os.close(file)
    try:
        os.truncate(file, 0)
        os.pwrite(file, f"process {os.getpid()} on {platform.node()}".encode(), 0)
        yield directory
    finally:
        path.unlink(missing_ok=True)
        os.close(file)


def _require_no_links(directory: Path) -> None:
    """Refuse links in the place of what a run writes: a folder from elsewhere could have it write anywhere."""
    inside = [path for name in _FOLDERS for path in (directory / name).glob("*")]
    links = [path for path in directory.glob("*") if _WRITTEN.fullmatch(path.name)] + inside
    link = next((path for path in sorted(links) if path.is_symlink()), None)
    if link is not None:
        raise InputError(f"{str(link)!r} is a link, through which a run writes nothing; put what it points to there")


def _lock(file: int, directory: Path) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(file, 200, 0).decode(errors="replace").strip() or "another process"
        raise InputError(f"{str(directory)!r} is in use: {holder} writes there; wait for it, or stop it") from None
    except OSError as error:
        notice(f"{str(directory)!r} cannot be locked ({error.strerror}); take care that no other process writes there")
    return True


def _is_at(file: int, path: Path) -> bool:
    """Return whether an open file is still the one at its path."""
    try:
        return os.path.samestat(os.fstat(file), os.stat(path))
    except FileNotFoundError:
        return False


def is_held(directory: Path) -> bool:
    """Return whether a process holds the lock of a folder, without taking it.

    One that was killed leaves the file, and is known to be gone on its own host alone.
    """
    with contextlib.suppress(FileNotFoundError):
        holder = _HOLDER.fullmatch((directory / _NAME).read_text(errors="replace"))
        return holder is None or holder[2] != platform.node() or _is_alive(int(holder[1]))
    return False


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)  # which ends nothing
    except ProcessLookupError:
        return False
    except PermissionError:  # it is another user's
        return True
    return True
