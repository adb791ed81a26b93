"""The C library's allocator, so that a process does not keep memory that nothing uses."""

import contextlib
import ctypes
import os

_M_ARENA_MAX, _ARENAS = -8, 2  # of glibc's mallopt


def share_arenas() -> None:
    """Let all threads of this process share two arenas of glibc's allocator.

    By default each of XLA's and orbax's threads may have an arena of its own, which keeps its free pages. Then a run's
    memory grows for half an hour, to twice the size. $MALLOC_ARENA_MAX, which glibc reads itself, holds if it is set.
    """
    if "MALLOC_ARENA_MAX" not in os.environ:
        _ask_glibc("mallopt", _M_ARENA_MAX, _ARENAS)


def give_back_pages() -> None:
    """Give the allocator's free pages back to the system. Compiling leaves hundreds of megabytes of them."""
    _ask_glibc("malloc_trim", 0)


def _ask_glibc(function: str, *arguments: int) -> None:
    """Call a function of glibc; do nothing under another C library."""
    with contextlib.suppress(OSError, AttributeError):
        getattr(ctypes.CDLL(None), function)(*arguments)
