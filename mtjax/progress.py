"""What shows how far something is: a bar on a terminal, plain lines elsewhere."""

import sys

LONGEST = 15.0
"""Seconds without a plain line, at most."""


class Display:
    """Shows how far something is: a bar on a terminal, plain lines elsewhere, nothing if ``quiet``."""

    def __init__(self, total: int, quiet: bool = False, doing: str = "compiling"):
        self.total, self.quiet, self.bar = total, quiet, None
        if quiet or not sys.stdout.isatty():
            return
        from rich.progress import BarColumn, Progress, TextColumn

        self.bar = Progress(BarColumn(8), TextColumn("{task.description}", markup=False), transient=False)
        self.task = self.bar.add_task(doing, total=total)
        self.bar.start()

    def say(self, text: str) -> None:
        """Print a line."""
        if self.bar is not None:
            self.bar.console.print(text, highlight=False, markup=False, soft_wrap=True)
        elif not self.quiet:
            print(text, flush=True)

    def doing(self, what: str, done: float | None = None) -> None:
        """Show on the bar what takes time now, and how much is done if that has changed."""
        if self.bar is not None:
            self.bar.update(self.task, completed=done, description=what)

    def close(self) -> None:
        """Stop the bar."""
        if self.bar is not None:
            self.bar.stop()


def duration(seconds: float) -> str:
    """Return seconds as text: 41 s, 3 min 5 s, 2 h 4 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{seconds:.1f} s" if seconds < 10 else f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"
