"""Flags as the source of this package's classes has them, because importing the classes would import JAX."""

import ast
import functools
import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

from mtjax.names import CHOICES

_PACKAGE = Path(__file__).parents[1]
OF_EVERY_RUN = (  # titles, and the classes whose fields are flags of every run
    ("what runs", "config.py", "RunConfig"),
    ("for how long (a preset may say otherwise)", "config.py", "Plan"),
    ("how worlds are played (a preset may say otherwise)", "learning/loop.py", "Settings"),
)
_SETTING = re.compile(  # the name and type of a class's setting, which has a default and a documentation
    r'^    ([a-z]\w*): (?!ClassVar|.*Suppress)(.+) = .+\n    """', re.MULTILINE
)
_HOMES = {"config.py": "--", "learning/loop.py": "--", "envs": "--env."}
_HOMES |= {"agents": "--agent.", "experience": "--agent."}
_UNPREFIXED = ("prefix_name=False", "_FLAG")  # in the types of settings whose flags are in no group


@functools.cache
def all_flags() -> Mapping[str, bool]:
    """Return every flag that some family or agent has, and whether it is a switch of any.

    They are read from the classes' source, because importing the classes would import JAX.
    """
    found = {"--help": False, "--import": False, **{f"--agent.{kind}": False for kind in CHOICES}}
    for home, group in _HOMES.items():
        place = _PACKAGE / home
        for file in [place] if place.is_file() else place.rglob("*.py"):
            for name, kind in _SETTING.findall(file.read_text(encoding="utf-8")):
                prefix = "--" if any(mark in kind for mark in _UNPREFIXED) else group
                flag = prefix + as_flag(name)
                found[flag] = found.get(flag, False) or kind == "bool"
    return found


@functools.cache
def whole_flags() -> frozenset[str]:
    """Return the flags of every run, without dashes, that take whole numbers."""
    fields = itertools.chain.from_iterable(documented_fields(file, cls) for _, file, cls in OF_EVERY_RUN)
    return frozenset(flag for flag, kind, *_ in fields if kind == "int")


def documented_fields(file: str, cls: str) -> Iterator[tuple[str, str, str, str]]:
    """Yield flag, type, default and documentation of every documented field of a class of this package."""
    tree = ast.parse((_PACKAGE / file).read_text(encoding="utf-8"))
    body = next(node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == cls)
    for field, text in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            flag = as_flag(ast.unparse(field.target))
            default = ast.literal_eval(field.value) if field.value is not None else ""
            plain = isinstance(default, bool) or default in ("", ())
            says = " ".join(str(text.value.value).split())
            yield flag, ast.unparse(field.annotation), "" if plain else f"={default}", says


def as_flag(name: str) -> str:
    """Return the flag, without dashes and group, of a field."""
    return "from" if name == "start" else name.replace("_", "-")
