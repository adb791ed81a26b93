"""The words of a command line: the values of flags, and words taken out or written as tyro has them."""

import re
from collections.abc import Callable, Sequence
from typing import TypeVar

from mtjax.command.class_sources import all_flags, whole_flags
from mtjax.names import InputError

VARY = "--env.vary."
VIEW = 8008
"""The port of the page that --view alone serves."""
_WHOLE = re.compile(r"[+-]?\d+(_\d+)*")
P = TypeVar("P")


def flag_value(argv: Sequence[str], name: str, default: P) -> str | P:
    """Return the value of --name=VALUE or --name VALUE. The last one counts."""
    value = default
    for i, word in enumerate(argv):
        if word.startswith(f"--{name}="):
            value = word.split("=", 1)[1]
        elif word == f"--{name}":
            if i + 1 == len(argv):
                raise InputError(f"--{name} needs a value")
            value = argv[i + 1]
    return value


def split_flags(argv: Sequence[str], mine: Callable[[str], bool], needed: str) -> tuple[dict[str, str], list[str]]:
    """Return the flags for which ``mine`` is true, with their values, and the other words of a command line."""
    given, rest, words = {}, [], iter(argv)
    for word in words:
        flag, equals, value = word.partition("=")
        if not mine(flag):
            rest.append(word)
            continue
        given[flag] = value if equals else next(words, "")
        if not given[flag]:
            raise InputError(f"{flag} needs {needed}")
    return given, rest


def last_given(argv: Sequence[str]) -> list[str]:
    """Return a command line in which each flag stands once, with the value that counts. ``--import`` may repeat."""
    flags: dict[str, list[str]] = {}
    flag = ""
    for word in argv:
        if word.startswith("--"):
            flag = word if word.startswith("--import") else word.partition("=")[0].replace("_", "-")
            flags[flag] = []
        flags.setdefault(flag, []).append(word)
    return [word for words in flags.values() for word in words]


def vary_flags(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --env.vary.NAME=VALUES out of a command line, because only the family knows the names."""
    needed = "values; give lo:hi:n, lo:hi or a list a,b,c"
    given, rest = split_flags(argv, lambda flag: flag.startswith(VARY), needed)
    return {flag.removeprefix(VARY): value for flag, value in given.items()}, rest


def with_port(argv: Sequence[str]) -> list[str]:
    """Return a command line in which --view alone has a port."""
    after = [*argv[1:], ""]
    alone = lambda word, then: word == "--view" and not is_whole(then)
    return [f"--view={VIEW}" if alone(*pair) else pair[0] for pair in zip(argv, after, strict=False)]


def plain_values(argv: Sequence[str]) -> list[str]:
    """Return a command line whose flags have hyphens, and values such as --SWITCH=true and 1e6 as tyro has them.

    Parameters that vary keep their names, and switches of the user's own classes their values.
    """
    switches, whole = all_flags(), {f"--{flag}" for flag in whole_flags()}
    words, before = [], ""
    for word in argv:
        flag, equals, value = word.partition("=")
        name, truth = flag if flag.startswith(VARY) else flag.replace("_", "-"), value.lower()
        if truth in ("true", "false") and switches.get(name):
            word = name if truth == "true" else switched_off(name)
        elif name in whole and value:
            word = f"{name}={_in_digits(value)}"
        elif flag.startswith("--"):
            word = f"{name}{equals}{value}"
        elif before in whole:
            word = _in_digits(word)
        words.append(word)
        before = name
    return words


def is_whole(text: str) -> bool:
    """Return whether a text is a whole number, such as 1000, 1e3 or -1_000."""
    return _WHOLE.fullmatch(_in_digits(text)) is not None


def _in_digits(value: str) -> str:
    """Return a whole number such as 1e6 in digits, and other text as it is."""
    real = re.fullmatch(r"\d+(\.\d*)?([eE]\+?\d\d?)?", value)
    if _WHOLE.fullmatch(value) or not real or not float(value).is_integer():
        return value
    return str(int(float(value)))


def switched_on(flag: str) -> str:
    """Return the flag that --no-NAME or --GROUP.no-NAME switches off."""
    return re.sub(r"^(--(?:[\w-]+\.)*)no-", r"\1", flag)


def switched_off(flag: str) -> str:
    """Return the flag that switches off --NAME or --GROUP.NAME."""
    return re.sub(r"^(--(?:[\w-]+\.)*)", r"\1no-", flag)
