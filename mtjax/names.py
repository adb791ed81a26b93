"""Errors that name the nearest match, and imports that wait until they are needed."""

import contextlib
import difflib
import functools
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextvars import ContextVar
from importlib import import_module
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

SPLITS = ("train", "interpolation", "extrapolation")
CHOICES = (
    "conditioning",
    "representation",
    "encoder",
    "gradients",
    "value",
    "target",
    "scaling",
    "sampler",
    "continual",
    "plasticity",
)
"""The kinds of parts that a user chooses by name, as --agent.KIND=NAME."""
PRESETS = ("auto", "cpu", "gpu")
"""The kinds of devices for which settings were tuned, as --preset=NAME."""
BEGAN = time.time()
"""When this process began to import the package, in seconds since 1970."""
_MANY = 20
_IN_COMMAND = ContextVar("in_command", default=False)
_VARY = re.compile(r"--env\.vary\.([\w.-]+)=([^\s;)]+)")
_FLAG = re.compile(r"(?<![\w-])--(?:env\.|agent\.)?([a-z][a-z-]*[a-z])(?:=([^\s,;:)]*[^\s,;:).]))?(?![\w-]|\.\w)")
_OTHER_NAMES = {"from": "start", "distributed": "jax.distributed", "runs": "directory"}  # flag -> argument
_ONLY_FLAGS = ("config", "help", "import", "list", "no-deps", "resume", "run", "sweep", "video", "view")
P = ParamSpec("P")
R = TypeVar("R")


class InputError(ValueError):
    """The user gave something that cannot be used. The message says what was given and what is allowed."""


class Notice(UserWarning):
    """Something was amiss, and the command went on. The message says how."""


def notice(text: str) -> None:
    """Warn the user in one line; commands print it without the place in the code."""
    warnings.warn(text, Notice, stacklevel=3)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Name a file in errors of the system that leave it out, as those of a full disk do."""
    try:
        yield
    except OSError as error:
        if error.filename is not None or error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from None


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path at which to write a file anew. It takes the place of ``path`` once it is whole, and never before."""
    new = path.with_name(f"{path.name}.new")
    try:
        with naming(path):
            new.unlink(missing_ok=True)  # it may be a link
            yield new
            os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)


ELSEWHERE = {  # names of settings and agents in Stable-Baselines3, CleanRL and Brax, and ours or our nearest
    **dict.fromkeys(("total_timesteps", "num_timesteps", "timesteps"), "steps"),
    **dict.fromkeys(("algo", "algorithm", "policy"), "agent"),
    **{"env_id": "env", "n_envs": "num_envs", "n_eval_episodes": "eval_episodes"},
    **{"learning_rate": "actor_lr", "discounting": "gamma", "buffer_size": "replay_size"},
    **dict.fromkeys(("td3", "ddpg"), "sac"),
    **dict.fromkeys(("a2c", "trpo"), "ppo"),
    **{"dqn": "pqn"},
}


def nearest_error(kind: str, given: str, allowed: Iterable[str], own: str = "") -> InputError:
    """Return an error for an unknown name, with the nearest match and the allowed names.

    Of more than 20 allowed names the message lists only similar ones: those written alike, whatever the capitals, or
    else those that end with what was given.

    Args:
        own: what to say of the user's own classes, as ``describe_unnamed`` does.
    """
    allowed = list(allowed)
    plain = {_plain(name): name for name in allowed}
    near = difflib.get_close_matches(_plain(given), plain, n=6, cutoff=0.5)
    near = [plain[name] for name in near or plain if near or name.endswith(f"-{_plain(given)}")]
    near = [meant] if (meant := ELSEWHERE.get(given)) in allowed else near
    hint = f"did you mean {near[0]!r}? " if near else ""
    few = len(allowed) <= _MANY
    shown = ", ".join(allowed if few else near or allowed[:6]) + ("" if few else f", ... ({len(allowed)} in all)")
    return InputError(f"unknown {kind} {given!r}; {hint}choose from: {shown}{own}")


def describe_unnamed(base: str, given: str, named: Collection[Any]) -> str:
    """Return how to name the user's own classes that nothing has registered; an empty string if there are none.

    Args:
        base: "module:Class", from which they derive.
        given: the name that was asked for.
        named: the classes that have names, and places of others.
    """
    if base.partition(":")[0] not in sys.modules:
        return ""
    classes: list[type] = [load(base)]
    for cls in classes:
        classes += cls.__subclasses__()
    own = [c for c in classes if not (c.__module__.startswith("mtjax.") or c.__subclasses__() or c in named)]
    alike = lambda cls: difflib.SequenceMatcher(None, _plain(cls.__name__), _plain(given)).ratio()
    name = max(own, key=alike).__name__ if own else ""
    return f"; your {name} has no name: call mtjax.register({given!r}, {name})" if own else ""


def _plain(name: Any) -> str:
    return str(name).lower().replace("_", "-")


def first_sentence(text: str | None) -> str:
    """Return the first sentence of a documentation, without its full stop. One goes on behind "et al."."""
    words = " ".join((text or "").split("\n\n")[0].split())
    return re.split(r"(?<! al)\. (?=[^a-z]|mtjax)", words, maxsplit=1)[0].removesuffix(".")


def frozen(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings with tuples in place of lists, because static arguments of ``jit`` must be hashable."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()}


def load(place: Any) -> Any:
    """Import and return the object called "module:name". Return anything but a string as it is."""
    if not isinstance(place, str):
        return place
    module, name = place.split(":")
    return getattr(import_module(module), name)


def is_imported(path: Path) -> bool:
    """Return whether a Python file was imported by this process, as a module or by --import."""
    known = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    return any(file and Path(file).resolve() == path.resolve() for file in known)


def lazily(module: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` for a module that imports each name when it is first used.

    Completion shows the names of its ``__all__``.

    Args:
        homes: name -> the module that defines it, or "module:other" if it has another name there.
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        home = homes[name]
        found = load(home if ":" in home else f"{home}:{name}")
        setattr(sys.modules[module], name, found)
        return found

    return find, lambda: sorted(vars(sys.modules[module])["__all__"])


def become(module: str, place: str) -> None:
    """Let ``import mtjax.NAME`` give the function ``mtjax.NAME``, where a command's module has a function's name.

    The function gets what the module defines as attributes.

    Args:
        module: the module, which is imported and not run.
        place: the function, as for ``load``.
    """
    held, function = vars(sys.modules[module]), load(place)
    kept = ("__spec__", "__file__")  # by which Python finds the source of what is defined there
    vars(function).update({name: held[name] for name in held if not name.startswith("_") or name in kept})
    sys.modules[module] = function


def command(main: Callable[P, R]) -> Callable[P, R]:
    """Let the messages of a command name flags, though it calls what is public in Python."""

    @functools.wraps(main)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        before = _IN_COMMAND.set(True)
        try:
            return main(*args, **kwargs)
        finally:
            _IN_COMMAND.reset(before)

    return called


def in_python(message: str) -> str:
    """Return a message in which flags are written as the arguments of Python, such as engine='mjx' for --engine=mjx."""
    vary = _VARY.sub(r"vary={'\1': '\2'}", message)
    return _FLAG.sub(lambda flag: _as_argument(flag[0], flag[1], flag[2]), vary)


def _as_argument(flag: str, name: str, value: str | None) -> str:
    if name in _ONLY_FLAGS:
        return flag
    name = _OTHER_NAMES.get(name, name.replace("-", "_"))
    if value is None:
        return name
    if value in ("true", "false"):
        return f"{name}={value.capitalize()}"
    as_is = value.isupper() or re.fullmatch(r"[\d.e-]+", value)  # a word to fill in, or a number
    return f"{name}={value}" if as_is else f"{name}={value!r}"


def public(function: Callable[P, R]) -> Callable[P, R]:
    """Let a user's mistake end at the user's own line: an InputError passes without the frames of this package.

    ``MTJAX_TRACEBACK=full`` keeps them. Outside commands its message names arguments, not flags.
    """

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        __tracebackhide__ = True  # which IPython and pytest read
        try:
            return function(*args, **kwargs)
        except InputError as error:
            if not _IN_COMMAND.get():
                error.args = (in_python(error.args[0]), *error.args[1:])
            if os.environ.get("MTJAX_TRACEBACK") == "full":
                raise
            raise error.with_traceback(None) from error.__cause__

    return called
