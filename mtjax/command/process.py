"""The process of a command: its errors become one line and an exit code, and its garbage is collected seldom."""

import contextlib
import gc
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Any

from mtjax.command import xla_flags
from mtjax.names import InputError, Notice

# Python looks for garbage after so many allocations, and after so many of these looks among older objects too. By its
# defaults a quarter of a start with Warp goes there, for nothing: imports and programs make objects that stay.
_ALLOCATIONS, _LOOKS = 10_000, 100
_LONGEST = 600  # letters of a message


def main(run: Any) -> None:
    """Run a command's entry point. A mistake of the user prints one line and exits with code 2."""
    gc.set_threshold(_ALLOCATIONS, _LOOKS)
    xla_flags.try_few_tilings()
    try:
        with _plain_notices():
            run(sys.argv[1:])
    except InputError as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
    except FloatingPointError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # whoever read has seen enough, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else Python complains as it ends
        sys.exit(1)
    except OSError as error:
        print(f"error: {error.strerror or error}: {error.filename or ''}".rstrip(": "), file=sys.stderr)
        sys.exit(2)


def one_line(error: Exception) -> str:
    """Return the message of an error in one line, without the middle of what is overlong, such as a value of a book."""
    text = " ".join(str(error).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"


@contextlib.contextmanager
def _plain_notices() -> Iterator[None]:
    """Print notices in one line each, without the place in the code."""
    with warnings.catch_warnings():
        others = warnings.showwarning

        def show(message, category, *place) -> None:
            if issubclass(category, Notice):
                print(f"warning: {message}", file=sys.stderr, flush=True)
            else:
                others(message, category, *place)

        warnings.showwarning = show
        warnings.simplefilter("always", Notice)
        yield
