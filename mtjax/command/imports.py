"""The user's own files, which ``--import=FILE.py`` runs."""

import ast
import importlib.util
import re
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path

from mtjax.names import InputError, is_imported


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
    except Exception as error:
        del sys.modules[path.stem]
        line, kind = _line_of(error, path), "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        raise InputError(f"{str(path)!r}{f', line {line}' * bool(line)}: {kind}{error}") from error


def _line_of(error: BaseException, path: Path) -> int:
    """Return the line of a file in which an error arose; 0 if it is unknown.

    Of a class that is refused it is the line of its method that failed, or of the name that the message begins with,
    and not that of the call that registers it.
    """
    if error.__context__ is not None and (line := _line_of(error.__context__, path)):
        return line
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    lines += [error.lineno] if isinstance(error, SyntaxError) and error.filename == str(path) else []
    named = re.match(r"(\w+)(?:\.(\w+))?", str(error)) if isinstance(error, InputError) and lines else None
    return (named and _line_of_name(path, *named.groups())) or (lines or [0])[-1] or 0


def _line_of_name(path: Path, cls: str, name: str | None) -> int:
    """Return the line of a class of a file, or of what it defines by a name; 0 if there is none."""
    found = [node for node in ast.parse(path.read_bytes()).body if isinstance(node, ast.ClassDef) and node.name == cls]
    inside = [node for each in found for node in each.body if name and name in _names_of(node)]
    return next((node.lineno for node in (*inside, *found)), 0)


def _names_of(node: ast.stmt) -> list[str | None]:
    """Return the names that a statement of a class defines."""
    targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
    return [getattr(node, "name", None), *(getattr(target, "id", None) for target in targets)]
