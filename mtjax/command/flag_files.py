"""Flags of a command line from a TOML file: ``--config=FILE.toml``, or ``--quick`` for the file of this package."""

import contextlib
import itertools
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mtjax.names import InputError

_QUICK = Path(__file__).parent / "quick.toml"
_LEFT_OUT = {
    "import": "a file of settings runs no code; give --import on the command line",
    "resume": "--resume goes on with a run as it was",
    "config": "a file of settings names no other",
}


def expand(argv: Sequence[str]) -> list[str]:
    """Put the flags of --quick and of every --config=FILE.toml before the other words, which override them.

    A key is a flag without its dashes. Tables hold those with a dot: ``num-experts`` in the table ``agent`` is
    ``--agent.num-experts``. ``name`` in the tables ``env`` and ``agent`` is ``--env`` and ``--agent``.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    given, rest = _apart(argv)
    return [*itertools.chain(*given.values()), *rest]


@contextlib.contextmanager
def naming(argv: Sequence[str]) -> Iterator[None]:
    """Name the file in errors about a flag or value that comes from a file of a command line."""
    try:
        yield
    except InputError as error:
        (given, rest), message = _apart(argv), str(error)
        file = next((file for file, words in given.items() if _is_about(message, words)), None)
        if file is not None and not _is_about(message, rest):
            error.args = (f"{file}: {error.args[0]}",)
        raise


def _is_about(message: str, words: Sequence[str]) -> bool:
    """Return whether a message names a flag of a command line with its dashes, or its value, or begins with it."""
    for flag, _, value in (word.partition("=") for word in words if word.startswith("--")):
        begins = message.startswith(f"{flag.removeprefix('--').rpartition('.')[2]} ")
        if begins or re.search(rf"{re.escape(flag)}(?![\w.-])", message) or (value and repr(value) in message):
            return True
    return False


def _apart(argv: Sequence[str]) -> tuple[dict[str, list[str]], list[str]]:
    """Return the flags of every file, by how a message calls the file, and the other words of a command line."""
    given, rest, words = {}, [], iter(argv)
    for word in words:
        flag, equals, value = word.partition("=")
        if word == "--quick":
            given[word] = _read(str(_QUICK))
        elif flag == "--config":
            file = value if equals else next(words, "")
            given[repr(file)] = _read(file)
        else:
            rest.append(word)
    return given, rest


def _read(file: str) -> list[str]:
    path = Path(file)
    if path.suffix != ".toml" or not path.is_file():
        raise InputError(f"--config needs a TOML file, and {file!r} is none")
    try:
        flags = list(_flat(tomllib.loads(path.read_text(encoding="utf-8"))))
    except (ValueError, RecursionError) as error:  # also a number of thousands of digits
        raise InputError(f"{file!r} cannot be read as TOML: {error}") from None
    words = []
    for flag, value in flags:
        if flag in _LEFT_OUT:
            raise InputError(f"{file!r} gives {flag}: {_LEFT_OUT[flag]}")
        words += _words(flag, value, file)
    return words


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every flag, without dashes, and its value."""
    for key, value in table.items():
        name = prefix[:-1] if prefix in ("env.", "agent.") and key == "name" else f"{prefix}{key}".replace("_", "-")
        if isinstance(value, Mapping):
            yield from _flat(value, f"{name}.")
        else:
            yield name, value


def _words(flag: str, value: Any, file: str) -> list[str]:
    match value:
        case bool():
            group, dot, name = flag.rpartition(".")
            return [f"--{flag}" if value else f"--{group}{dot}no-{name}"]
        case list() if flag.startswith("env.vary."):
            return [f"--{flag}={','.join(map(str, value))}"]
        case list():
            return [f"--{flag}", *map(str, value)]
        case str() | int() | float():
            return [f"--{flag}={value}"]
    raise InputError(f"{file!r} gives {flag} a value that no flag takes: {value!r}")
