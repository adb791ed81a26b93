"""``python -m mtjax.train --view``: a page of the run, which ``python -m mtjax.evaluate --view`` serves beside it.

It is another process, on the CPU and with a lower priority: it reads what the run writes, and takes no time between
chunks.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mtjax.checks import HOME
from mtjax.names import InputError

_NICE = 10  # by how much its priority is lower
_PATIENCE = 5.0  # seconds that it has to end


def require_none(asked: Any) -> None:
    """Raise InputError if a page is asked for where many runs are made."""
    if asked:
        raise InputError(
            "--view shows one run, and this makes several; leave it out, and look at each by its folder: "
            "python -m mtjax.evaluate --run=FOLDER/run-1 --view"
        )


@contextlib.contextmanager
def page(port: int, directory: Path, imports: Sequence[str]) -> Iterator[None]:
    """Serve the page of a run in a folder, if a port is given, until the context ends.

    The process's input is a pipe, so that it ends even if this one is killed.

    Args:
        imports: the flags with the user's own files.
    """
    if not port:
        yield
        return
    words = [sys.executable, "-m", "mtjax.evaluate", f"--run={directory}", *imports, f"--view={port}"]
    process = subprocess.Popen(
        words,
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
        process_group=0,  # Ctrl-C is for the run alone; in a session of its own Linux would not heed the priority
    )
    try:
        own = os.getpriority(os.PRIO_PROCESS, 0)  # below which only the superuser may set another's
        os.setpriority(os.PRIO_PROCESS, process.pid, own + _NICE)
        print(f"see it live at http://{HOME}:{port}", flush=True)
        yield
    finally:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.communicate(timeout=_PATIENCE)  # which closes its input: an open page gets the last numbers
        process.kill()
        process.wait()
