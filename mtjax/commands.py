"""Helpers of all commands, and checks that need no JAX: the list of names, wrong names, missing runs."""

import ast
import contextlib
import dataclasses
import difflib
import functools
import gc
import importlib.util
import io
import itertools
import os
import re
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from mtjax import shipped, xla_flags
from mtjax.agents import AGENTS, CHOICES
from mtjax.envs import BENCHMARKS, ENVS, members, outline, varied
from mtjax.names import InputError, NoRoomError, Notice, nearest_error

# Python looks for garbage after so many allocations, and after so many of these looks among older objects too. By its
# defaults a quarter of a start with Warp goes there, for nothing: imports and programs make objects that stay.
_ALLOCATIONS, _LOOKS = 10_000, 100
PRESETS = ("auto", "cpu", "gpu")
_KNOWN = (("environment", "env", ENVS), ("agent", "agent", AGENTS), ("preset", "preset", PRESETS))
_OVERVIEW = (  # titles, and the classes whose fields are flags of every run
    ("what runs", "config.py", "RunConfig"),
    ("for how long (a preset may say otherwise)", "config.py", "Plan"),
    ("how worlds are played (a preset may say otherwise)", "loop.py", "Settings"),
)
_MAY_CHANGE = {  # the only flags beside --resume
    *("--resume", "--steps", "--import", "--distributed", "--profile", "--tensorboard", "--wandb")
}
_VARY = "--env.vary."
_LONGEST = 600  # letters of a message
_SETTING = re.compile(  # the name and type of a class's setting, which has a default and a documentation
    r'^    ([a-z]\w*): (?!ClassVar|.*Suppress)(.+) = .+\n    """', re.MULTILINE
)
_HOMES = {"config.py": "--", "loop.py": "--", "envs": "--env.", "agents": "--agent.", "experience": "--agent."}
_WHOLE = re.compile(r"[+-]?\d+(_\d+)*")
_UNPREFIXED = ("prefix_name=False", "_FLAG")  # in the types of settings whose flags are in no group
P = TypeVar("P")


def main(run: Any) -> None:
    """Run a command's entry point. A mistake of the user prints one line and exits with code 2."""
    gc.set_threshold(_ALLOCATIONS, _LOOKS)
    xla_flags.try_few_tilings()
    try:
        with _plain_notices():
            run(sys.argv[1:])
    except InputError as error:
        if isinstance(error, NoRoomError):
            error.place = "--runs"
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


def catalogue() -> str:
    """Return a list of families and agents, each with the first sentence of its documentation."""
    lines = ["environments, and what varies between their tasks (more by --env.vary.NAME=VALUES):"]
    for name in ENVS:
        tasks, says = outline(name)
        varies = varied(name)
        lines.append(f"  {name:36} {tasks:3} task{'s' if tasks > 1 else ' '}  {says}{f' [{varies}]' * bool(varies)}")
    lines.append("benchmarks, which are mixtures of the above:")
    for name, (says, families) in BENCHMARKS.items():
        lines.append(f"  {name:36} {sum('held_out' not in s for s in families.values()):3} tasks  {says}")
    lines += ["agents:", *(f"  {name:36} {preset.says}" for name, preset in AGENTS.items())]
    lines += ["trained policies (python -m mtjax.evaluate --run=NAME, or mtjax.load(NAME)):"]
    return "\n".join(lines + [f"  {name}" for name in shipped.names()])


def overview() -> str:
    """Return what ``--help`` alone says: the flags of every run, read from the classes' source as JAX is not needed."""
    lines = [
        "usage: python -m mtjax.train [--env=NAME] [--agent=NAME] [FLAGS]",
        "       python -m mtjax.train --env=NAME --agent=NAME --help    all flags of these, with defaults",
        "       python -m mtjax.train --list                            all families and agents",
        "       python -m mtjax.train --import=FILE.py ...              first run a file that registers your own",
        "       python -m mtjax.train --resume=RUN                      go on with a run",
    ]
    for title, file, cls in _OVERVIEW:
        lines += ["", f"{title}:"]
        for flag, _, default, text in _fields(file, cls):
            lines.append(f"  --{flag + default}")
            lines += textwrap.wrap(text, 110, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)


def _fields(file: str, cls: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield flag, type, default and documentation of every documented field of a class of this package."""
    tree = ast.parse((Path(__file__).parent / file).read_text(encoding="utf-8"))
    body = next(node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == cls)
    for field, text in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            flag = _as_flag(ast.unparse(field.target))
            default = ast.literal_eval(field.value) if field.value is not None else ""
            plain = isinstance(default, bool) or default in ("", ())
            says = " ".join(str(text.value.value).split())
            yield flag, ast.unparse(field.annotation), "" if plain else f"={default}", says


def check_names(argv: Sequence[str]) -> None:
    """Refuse an unknown environment, agent, preset or run, and numbers that are none, before JAX is imported.

    Raises:
        InputError: there is no such name or folder, or --resume came with flags that change the run.
    """
    for kind, flag, known in _KNOWN:
        given = flag_value(argv, flag, None)
        if given is None:
            continue
        names = [name for name, _ in members(given)] if flag == "env" else [given]  # a mixture has several
        wrong = next((name for name in names if name not in known), None)
        if wrong is not None:
            raise nearest_error(kind, wrong, (*known, *BENCHMARKS) if flag == "env" else known)
    _check_numbers(argv)
    given = {word.split("=", 1)[0] for word in argv if word.startswith("--")}
    other = ", ".join(sorted(given - _MAY_CHANGE))
    if "--resume" in given and "--sweep" not in given and other:
        raise InputError(f"--resume goes on with a run as it was; only --steps may change, not {other}")
    for flag in () if {"--resume", "--sweep"} <= given else ("resume", "from"):
        folder = flag_value(argv, flag, None)
        if folder in shipped.names() and not Path(folder).is_dir():
            raise shipped.not_learning(folder)
        if folder is not None and not (flag == "resume" and any(Path(folder).glob("run-*"))):  # the runs of a sweep
            require_run(Path(folder))


def _check_numbers(argv: Sequence[str]) -> None:
    """Refuse a value that is no whole number where a flag of every run takes one."""
    for flag in _whole_flags():
        value = flag_value(argv, flag, None)
        if value is not None and not _WHOLE.fullmatch(_in_digits(value)):
            raise InputError(f"--{flag} must be a whole number, not {value!r}")


@functools.cache
def _whole_flags() -> frozenset[str]:
    """Return the flags of every run, without dashes, that take whole numbers."""
    fields = itertools.chain.from_iterable(_fields(file, cls) for _, file, cls in _OVERVIEW)
    return frozenset(flag for flag, kind, *_ in fields if kind == "int")


def _in_digits(value: str) -> str:
    """Return a whole number such as 1e6 in digits, and other text as it is."""
    real = re.fullmatch(r"\d+(\.\d*)?([eE]\+?\d\d?)?", value)
    if _WHOLE.fullmatch(value) or not real or not float(value).is_integer():
        return value
    return str(int(float(value)))


def plain_values(argv: Sequence[str]) -> list[str]:
    """Return a command line in which --SWITCH=true, --SWITCH=false and whole numbers such as 1e6 are as tyro has them.

    Switches of the user's own classes stay as they are.
    """
    switches, whole = all_flags(), {f"--{flag}" for flag in _whole_flags()}
    words, before = [], ""
    for word in argv:
        flag, _, value = word.partition("=")
        name, truth = flag.replace("_", "-"), value.lower()
        if truth in ("true", "false") and switches.get(name):
            word = name if truth == "true" else switched_off(name)
        elif name in whole and value:
            word = f"{flag}={_in_digits(value)}"
        elif before in whole:
            word = _in_digits(word)
        words.append(word)
        before = name
    return words


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
        if flag.startswith("--") and not flag.startswith(_VARY) and not {flag, switched_on(flag)} & known.keys():
            raise unknown_flag(flag, known)


@functools.cache
def all_flags() -> Mapping[str, bool]:
    """Return every flag that some family or agent has, and whether it is a switch.

    They are read from the classes' source, because importing the classes would import JAX.
    """
    found = {"--help": False, "--import": False, **{f"--agent.{kind}": False for kind in CHOICES}}
    for home, group in _HOMES.items():
        place = Path(__file__).parent / home
        for file in [place] if place.is_file() else place.rglob("*.py"):
            for name, kind in _SETTING.findall(file.read_text(encoding="utf-8")):
                prefix = "--" if any(mark in kind for mark in _UNPREFIXED) else group
                found[prefix + _as_flag(name)] = kind == "bool"
    return found


def check_flags_of(cls: type, argv: Sequence[str]) -> None:
    """Refuse a flag that is no field of a dataclass, which holds all flags of a command but --help and --import.

    Raises:
        InputError: there is no such flag.
    """
    known = {f"--{_as_flag(field.name)}": isinstance(field.default, bool) for field in dataclasses.fields(cls)}
    known |= {"--help": False, "--import": False}
    allowed = {*known, *map(switched_off, known), "-h"}
    for word in argv:
        flag = word.split("=", 1)[0].replace("_", "-")
        if flag.startswith("-") and flag not in allowed and not re.match(r"-\.?\d", flag):
            raise unknown_flag(flag, known)


def _as_flag(name: str) -> str:
    """Return the flag, without dashes and group, of a field."""
    return "from" if name == "start" else name.replace("_", "-")


def switched_on(flag: str) -> str:
    """Return the flag that --no-NAME or --GROUP.no-NAME switches off."""
    return re.sub(r"^(--(?:[\w-]+\.)*)no-", r"\1", flag)


def switched_off(flag: str) -> str:
    """Return the flag that switches off --NAME or --GROUP.NAME."""
    return re.sub(r"^(--(?:[\w-]+\.)*)", r"\1no-", flag)


def unknown_flag(flag: str, known: Mapping[str, bool]) -> InputError:
    """Return an error for an unknown flag. It names the nearest flag and points to --help for the rest.

    Args:
        known: all flags, and whether each is a switch.
    """
    if flag == _VARY.removesuffix("."):
        return InputError(f"{flag} needs the name of a parameter: {_VARY}NAME=VALUES; --list says what varies")
    every = sorted([*known, *(switched_off(other) for other, is_switch in known.items() if is_switch)])
    end = re.sub(r"^--([\w-]+\.)*", "-", flag)
    same_end = [other for other in every if other.replace(".", "-").endswith(end)]  # the name is right, or its end
    near = difflib.get_close_matches(flag, same_end, 1, 0) or difflib.get_close_matches(flag, every, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return InputError(f"unknown flag {flag!r}; {hint}--help lists the flags")


def require_run(folder: Path) -> None:
    """Raise InputError unless a folder holds a run. The message names the newest of the runs inside it, if any."""
    if (folder / "config.json").is_file():
        return
    if not folder.is_dir():
        raise InputError(f"{str(folder)!r} is not a run: there is no such folder")
    inside = max(folder.glob("*/config.json"), key=lambda file: file.stat().st_mtime, default=None)
    hint = "" if inside is None else f"; it holds runs, the newest is {str(inside.parent)!r}"
    raise InputError(f"{str(folder)!r} is not a run: it has no config.json{hint}")


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


def vary_flags(argv: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """Take --env.vary.NAME=VALUES out of a command line, because only the family knows the names."""
    needed = "values; give lo:hi:n, lo:hi or a list a,b,c"
    given, rest = split_flags(argv, lambda flag: flag.startswith(_VARY), needed)
    return {flag.removeprefix(_VARY): value for flag, value in given.items()}, rest


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


def import_files(argv: Sequence[str]) -> list[str]:
    """Run the file of every --import=FILE.py, and return the other words of the command line.

    Such a file calls ``mtjax.register`` for the user's own classes.

    Raises:
        InputError: there is no such file, or it fails. The message names the line.
    """
    files, rest = imports_of(argv)
    for file in files:
        _import(Path(file))
    return rest


def imports_of(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the files of every --import, as absolute paths, and the other words of a command line."""
    files, rest, words = [], [], iter(argv)
    for word in words:
        if word == "--import":
            files.append(next(words, ""))
        elif word.startswith("--import="):
            files.append(word.split("=", 1)[1])
        else:
            rest.append(word)
    if "" in files:
        raise InputError("--import needs a Python file")
    return [str(Path(file).resolve()) for file in dict.fromkeys(files)], rest


def is_imported(path: Path) -> bool:
    """Return whether a Python file was imported by this process, as a module or by --import."""
    known = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    return any(file and Path(file).resolve() == path.resolve() for file in known)


def _import(path: Path) -> None:
    if not path.is_file() or path.suffix != ".py":
        raise InputError(f"--import needs a Python file, and {str(path)!r} is none")
    if is_imported(path):
        return
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except InputError as error:
        del sys.modules[path.stem]
        raise InputError(f"{str(path)!r}{_line_of(error, path)}: {error}") from error
    except Exception as error:  # of the user's own code
        del sys.modules[path.stem]
        raise InputError(f"{str(path)!r}{_line_of(error, path)}: {type(error).__name__}: {error}") from error


def _line_of(error: Exception, path: Path) -> str:
    """Return the line of a file in which an error arose, as ", line 3"; empty if it is unknown."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    lines += [error.lineno] if isinstance(error, SyntaxError) and error.filename == str(path) else []
    return f", line {lines[-1]}" if lines else ""


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
    if switch is not None and value.lower() == "false":
        return f"{switch} is a switch and takes no value; write {switched_off(switch)}"
    if switch is not None:
        return f"{switch} is a switch and takes no value; leave out {'=' + value!r}"
    return f"{value!r} belongs to no flag; write --NAME=VALUE, and --help lists the names"


def _unframed(text: str) -> str:
    """Return the lines inside tyro's frame. The frame has no corners where output is not UTF-8."""
    is_rule = lambda line: line.startswith("╭") or not line.strip(" │─╰╯-")
    below = itertools.dropwhile(lambda line: not is_rule(line), text.splitlines())
    next(below, None)
    return " ".join(line.strip(" │") for line in itertools.takewhile(lambda line: not is_rule(line), below))
