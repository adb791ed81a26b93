"""Parsing by tyro, with its framed messages in one line."""

import contextlib
import io
import itertools
import re
from collections.abc import Sequence
from typing import TypeVar

from mtjax.command.flags import switched_off
from mtjax.names import InputError

P = TypeVar("P")


def parse_with_tyro(cls: type[P], argv: Sequence[str], default: P, name: str) -> P:
    """Parse with tyro, and turn its framed error message into one line.

    Raises:
        InputError: tyro refused the command line.
    """
    import tyro  # only here: names are checked without it

    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            return tyro.cli(cls, args=list(argv), default=default, prog=name)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        message = re.sub(r"^Error parsing ((plan|training|family|learner)[.\w]*: )?", "", _unframed(output.getvalue()))
        negated = r"^Unrecognized options: (--(\w+\.)*)no-(\S+).*"
        message = re.sub(negated, r"\1\3 is no switch that could be off; give it a value", message)
        single = r"^Unrecognized options: (-[^-]\S*).*"
        message = re.sub(single, r"'\1' has one dash, and flags have two: -\1", message)
        message = re.sub(r"^Unrecognized options: (?!-)(\S+?),?( .*)?$", lambda found: _unread(found[1], argv), message)
        spaced = r"\1 takes values with spaces between them, such as \1 8 8"
        message = re.sub(r"^(--\S+): Could not find valid parse for arguments: \['[\d\s,]*'\]$", spaced, message)
        raise InputError(message or "the command line cannot be read; --help lists the flags") from None


def _unread(value: str, argv: Sequence[str]) -> str:
    """Return what is wrong with a word that belongs to no flag: a switch came with a value, or there is no flag."""
    switch = next((word.split("=")[0] for word in argv if word.startswith("--") and word.endswith(f"={value}")), None)
    if switch is not None:
        return f"{switch} is a switch and takes no value: {switch} is on, and {switched_off(switch)} off"
    return f"{value!r} belongs to no flag; write --NAME=VALUE, and --help lists the names"


def _unframed(text: str) -> str:
    """Return the lines inside tyro's frame. The frame has no corners where output is not UTF-8."""
    is_rule = lambda line: line.startswith("╭") or not line.strip(" │─╰╯-")
    below = itertools.dropwhile(lambda line: not is_rule(line), text.splitlines())
    next(below, None)
    return " ".join(line.strip(" │") for line in itertools.takewhile(lambda line: not is_rule(line), below))
