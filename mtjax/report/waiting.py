"""What takes long is told while it lasts."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

from mtjax.progress import LONGEST, Display, duration

_SOON, _OFTEN = 2.0, 1.0  # seconds until the first line or the bar, and between changes of the bar


class _Share:
    """Says how much of something is done."""

    def __init__(self, what: str):
        self.what, self.begun, self.done = what, time.monotonic(), 0.0
        self.since = self.reached = self.begun  # when its first part began, and when the last one ended

    def reach(self, done: float) -> None:
        """Note the share that is done, which is 0 where its first part begins."""
        self.reached = time.monotonic()
        self.since, self.done = self.since if done else self.reached, done

    def __str__(self) -> str:
        """Return what is under way, its seconds, and once a share is done that and the seconds that are left."""
        done, now = self.done, time.monotonic()
        taken = duration(now - self.begun)
        if not done:
            return f"{self.what}: {taken}"
        left = (self.reached - self.since) / done - (now - self.since)
        return f"{self.what}: {done:.0%} done  {taken}, {duration(max(left, 0.0))} left"


@contextlib.contextmanager
def telling(what: str, quiet: bool = False, at_once: bool = False) -> Iterator[Callable[[float], None]]:
    """Show what is under way and for how long, if it lasts more than two seconds: by a bar on a terminal.

    Elsewhere lines do, which come ever more rarely, and at last every 15 seconds.

    Args:
        quiet: print nothing.
        at_once: begin with a line, however long it lasts.

    Returns:
        a function to call with the share that is done: it and the time that is left are told too.
    """
    share, ended = _Share(what), threading.Event()

    def tell() -> None:
        if ended.wait(_SOON):
            return
        display = Display(1, doing=str(share))
        show = lambda: display.doing(str(share), share.done) if display.bar else display.say(str(share))
        with contextlib.closing(display), contextlib.suppress(BrokenPipeError):  # whoever read has seen enough
            show()
            while not ended.wait(_OFTEN if display.bar else min(time.monotonic() - share.begun, LONGEST)):
                show()
            display.doing(str(share), share.done)

    if quiet:
        yield share.reach
        return
    if at_once:
        print(what, flush=True)
    teller = threading.Thread(target=tell, daemon=True)
    teller.start()
    try:
        yield share.reach
    finally:
        ended.set()
        teller.join()
