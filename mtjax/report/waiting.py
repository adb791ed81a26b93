"""What takes long is told while it lasts."""

import contextlib
import itertools
import threading
import time
from collections.abc import Iterator

_SOON, _OFTEN = 2.0, 15.0  # seconds until the first line, and between lines


@contextlib.contextmanager
def telling(what: str, quiet: bool = False, at_once: bool = False) -> Iterator[None]:
    """Print what is under way and for how long, if it lasts more than two seconds, and then every 15 seconds.

    Args:
        quiet: print nothing.
        at_once: begin with a line, however long it lasts.
    """
    ended, begun = threading.Event(), time.monotonic()

    def tell() -> None:
        with contextlib.suppress(BrokenPipeError):  # whoever read has seen enough
            for wait in itertools.chain([] if at_once else [_SOON], itertools.repeat(_OFTEN)):
                if ended.wait(wait):
                    return
                print(f"{what}: {time.monotonic() - begun:.0f} s", flush=True)

    if quiet:
        yield
        return
    if at_once:
        print(what, flush=True)
    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield
    finally:
        ended.set()
        teller.join()
