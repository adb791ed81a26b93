"""Words of a command line that are refused before JAX is imported: unknown names, flags and runs, and wrong numbers."""

import contextlib
import dataclasses
import difflib
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from mtjax.agents import AGENTS, preset_of
from mtjax.checks import require_run
from mtjax.command.class_sources import all_flags, as_flag, whole_flags
from mtjax.command.flags import VARY, flag_value, is_whole, switched_off, switched_on, with_port
from mtjax.envs import ENVS, members, unknown_name
from mtjax.names import ELSEWHERE, PRESETS, InputError, nearest_error
from mtjax.saved import pretrained

_MAY_CHANGE = {  # the only flags beside --resume
    *("--resume", "--steps", "--import", "--distributed", "--profile", "--view"),
    *("--tensorboard", "--trackio", "--wandb"),
}
_SETTING = re.compile(r"(?<![\w.'-])([a-z][\w-]*)=(?=\w)")  # in quotes stands what was given, which stays


def check_names(argv: Sequence[str]) -> None:
    """Refuse an unknown environment, agent, preset or run, and numbers that are none, before JAX is imported.

    Raises:
        InputError: there is no such name or folder, or --resume came with flags that change the run.
    """
    argv = with_port(argv)
    if (env := flag_value(argv, "env", None)) is not None:
        wrong = next((name for name, _ in members(env) if name not in ENVS), None)  # a mixture has several
        if wrong is not None:
            raise unknown_name(wrong)
    if (agent := flag_value(argv, "agent", None)) is not None:
        preset_of(agent)
    if (preset := flag_value(argv, "preset", "auto")) not in PRESETS:
        raise nearest_error("preset", preset, PRESETS)
    _check_numbers(argv)
    given = {word.split("=", 1)[0] for word in argv if word.startswith("--")}
    other = ", ".join(sorted(given - _MAY_CHANGE))
    if "--resume" in given and "--sweep" not in given and other:
        raise InputError(f"--resume goes on with a run as it was; only --steps may change, not {other}")
    for flag in () if {"--resume", "--sweep"} <= given else ("resume", "from"):
        folder = flag_value(argv, flag, None)
        if folder in pretrained.names() and not Path(folder).is_dir():
            raise pretrained.not_learning(folder)
        if folder is not None and not (flag == "resume" and any(Path(folder).glob("run-*"))):  # of a sweep or search
            several = flag == "from" and not Path(folder).is_dir()
            for each in folder.split(",") if several else [folder]:
                require_run(Path(each))


def _check_numbers(argv: Sequence[str]) -> None:
    """Refuse a value that is no whole number where a flag of every run takes one."""
    for flag in whole_flags():
        value = flag_value(argv, flag, None)
        if value is not None and not is_whole(value):
            raise InputError(f"--{flag} must be a whole number, not {value!r}")


def check_flags(argv: Sequence[str]) -> None:
    """Refuse a flag that no family and no agent has.

    Whether the chosen ones have it is checked later, by the full parser.

    Raises:
        InputError: there is no such flag.
    """
    places = (*(place for place, _ in ENVS.data.values()), *(preset.place for preset in AGENTS.values()))
    if not all(isinstance(place, str) for place in places):  # the user's own classes have further settings
        return
    known = all_flags()
    for word in argv:
        flag = word.split("=", 1)[0].replace("_", "-")
        if flag.startswith("--") and not flag.startswith(VARY) and not {flag, switched_on(flag)} & known.keys():
            raise unknown_flag(flag, known)


def check_flags_of(cls: type, argv: Sequence[str]) -> None:
    """Refuse a flag that is no field of a dataclass, which holds all flags of a command but --help and --import.

    Raises:
        InputError: there is no such flag.
    """
    known = {f"--{as_flag(field.name)}": isinstance(field.default, bool) for field in dataclasses.fields(cls)}
    known |= {"--help": False, "--import": False}
    allowed = {*known, *map(switched_off, known), "-h"}
    for word in argv:
        flag = word.split("=", 1)[0].replace("_", "-")
        if flag.startswith("-") and flag not in allowed and not re.match(r"-\.?\d", flag):
            raise unknown_flag(flag, known)


@contextlib.contextmanager
def settings_as_flags() -> Iterator[None]:
    """Write settings in errors as flags: ``scaling=none``, as Python has it, is ``--agent.scaling=none``."""
    try:
        yield
    except InputError as error:
        error.args = (_SETTING.sub(_flag_of, str(error)),)
        raise


def _flag_of(setting: re.Match) -> str:
    flags = (f"{prefix}{as_flag(setting[1])}" for prefix in ("--agent.", "--"))
    flag = next((flag for flag in flags if flag in all_flags()), setting[1])
    return f"{flag}="


def unknown_flag(flag: str, known: Mapping[str, bool]) -> InputError:
    """Return an error for an unknown flag. It names the nearest flag and points to --help for the rest.

    Args:
        known: all flags, and whether each is a switch.
    """
    if flag == VARY.removesuffix("."):
        return InputError(f"{flag} needs the name of a parameter: {VARY}NAME=VALUES; --list says what varies")
    if flag.startswith("--vary."):
        return InputError(f"unknown flag {flag!r}; did you mean {flag.replace('--vary.', VARY)!r}?")
    near = _nearest_flag(flag, [*known, *(switched_off(other) for other, is_switch in known.items() if is_switch)])
    hint = f"did you mean {near!r}? " if near else ""
    return InputError(f"unknown flag {flag!r}; {hint}--help lists the flags")


def _nearest_flag(flag: str, known: Sequence[str]) -> str | None:
    """Return the flag that was meant: by its name in other libraries, its letters, its end, or some of its letters."""
    name = flag.rpartition(".")[2].lstrip("-")
    meant = as_flag(ELSEWHERE.get(name.replace("-", "_"), ""))
    if meant:
        return next((full for full in (f"--agent.{meant}", f"--{meant}") if full in known), None)
    words = {other.lstrip("-"): other for other in sorted(known)}
    same_end = [word for word in words if f"-{word}".replace(".", "-").endswith(f"-{name}")]
    close = functools.partial(difflib.get_close_matches, flag.lstrip("-"), n=1)
    near = close(words, cutoff=0.85) or close(same_end, cutoff=0) or close(words, cutoff=0.65)
    return words[near[0]] if near else None
