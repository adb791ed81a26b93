"""The user's own files, which ``--import=FILE.py`` runs."""

import importlib.util
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
