"""Parsing by tyro, with its framed messages in one line."""

import contextlib
import inspect
import io
import itertools
import re
from collections.abc import Sequence
from typing import TypeVar

from mtjax.command.flags import switched_off
from mtjax.names import InputError

P = TypeVar("P")
_PLAINER = {
    r"^Error parsing ((plan|training|family|learner)[.\w]*: )?": "",
    r"^Unrecognized options: (--(\w+\.)*)no-(\S+).*": r"\1\3 is no switch that could be off; give it a value",
    r"^Unrecognized options: (-[^-]\S*).*": r"'\1' has one dash, and flags have two: -\1",
    r"^(--\S+): Could not find valid parse for arguments: \['[\d\s,]*'\]$": (
        r"\1 takes values with spaces between them, such as \1 8 8"
    ),
    r"^(--\S+): Could not find valid parse for arguments: \[(.*)\]$": r"\1 cannot take \2; --help says what it takes",
    r"^(--\S+): could not convert string to float: (.*)$": r"\1 must be a number, not \2",
    r"^(--\S+): invalid literal for int\(\) with base 10: (.*)$": r"\1 must be a whole number, not \2",
    r"^Missing value for argument '(--\S+)'.*": r"\1 needs a value",
}


def parse_with_tyro(cls: type[P], argv: Sequence[str], default: P, name: str) -> P:
    """Parse with tyro, and turn its framed error message into one line.

    Raises:
        InputError: tyro refused the command line.
    """
    import tyro  # only here: names are checked without it

    output = io.StringIO()
    try:
        with contextlib.redirect_stderr(output):
            said = (inspect.getdoc(cls) or "").replace("``", "")
            return tyro.cli(cls, args=list(argv), default=default, prog=name, description=said)
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        message = _plain(_unframed(output.getvalue()), argv)
        raise InputError(message or "the command line cannot be read; --help lists the flags") from None


def _plain(message: str, argv: Sequence[str]) -> str:
    """Return tyro's message in the words of the other errors."""
    for pattern, words in _PLAINER.items():
        message = re.sub(pattern, words, message)
    return re.sub(r"^Unrecognized options: (?!-)(\S+?),?( .*)?$", lambda found: _unread(found[1], argv), message)


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
