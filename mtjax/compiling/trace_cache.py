"""A cache of traced programs, so that a second run does not trace and lower its programs again.

Tracing an environment's physics takes seconds of Python in every process. ``jax.export`` writes a traced program as
StableHLO. When another process calls it, XLA receives the same program, and has it compiled in its own cache.

The name of a file is a hash of everything that decides a program: all files of this package, the names and versions of
all installed packages, JAX's configuration, the device, the program's static arguments and the shapes of the others.
Programs are traced as ever where this hash could miss something or where a program cannot be kept:

- the process has imported a file that is neither of this package nor installed, such as a user's own family;
- the package's files or the installed packages changed after the process began;
- a program holds an address of this process, as those of ``jax.pure_callback`` do. Engines outside XLA are called by
  names instead (``Outside.targets``);
- several devices share the program.

A file holds StableHLO, and in JSON the containers of the program's result. Python runs nothing of it. A checksum tells
damaged files, which are replaced.
"""

import dataclasses
import hashlib
import json
import os
import site
import sys
import sysconfig
import tempfile
from collections.abc import Mapping
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax import export

from mtjax.envs.engines.shared import keep
from mtjax.names import BEGAN

LIMIT = 500_000_000
"""The most bytes of all files together. Those that were not used for longest are dropped."""
_ENVIRONMENT = ("JAX_", "MJX_", "MUJOCO_", "WARP_", "XLA_")  # variables that a library may read while it traces
_PACKAGE = Path(__file__).parents[1]
_folder: list[Path] = []  # where the files are; empty while there is no cache


class Unkept(Exception):
    """A program cannot be kept, or its hash could miss something that decides it."""


class _Kept(NamedTuple):
    """A traced program, and the containers of its result around the numbers of its leaves."""

    exported: export.Exported
    result: Any
    targets: dict[str, Any]  # its calls out of XLA, by name: the arguments of the environment's ``provide``


def use_folder(folder: Path | None) -> None:
    """Keep traced programs in a folder from now on, or nowhere."""
    _folder[:] = [] if folder is None else [folder]


def trace(env: Any, program: Any, donated: tuple[int, ...], static: tuple, arguments: tuple) -> jax.stages.Traced:
    """Trace a jitted program, or read it from the cache if it was traced before.

    Args:
        env: the environment, which makes calls out of XLA in this process (``Outside.provide``).
        donated: which of ``arguments`` the program donates.
        static: its static arguments, which come first.
        arguments: arrays or shapes.
    """
    kept = _kept(env, program, static, arguments)
    if kept is None:
        return program.trace(*static, *arguments)

    def call(*arguments):
        leaves = kept.exported.call(*jax.tree.leaves(arguments))
        leaves = keep(env, leaves) if kept.targets else leaves
        return jax.tree.map(lambda number: leaves[number], kept.result)

    call.__name__ = program.__name__
    return jax.jit(call, donate_argnums=donated).trace(*arguments)


def _kept(env: Any, program: Any, static: tuple, arguments: tuple) -> _Kept | None:
    """Return a program from the cache, or as it is put there. Return None if it cannot be kept."""
    try:
        file = _file_of(program, static, arguments)
        kept = _read(file) or _export(file, env, program, static, arguments)
        for name, about in kept.targets.items():
            if env.calls.provide(*about) != name:
                raise Unkept(f"this process has another {name}")
    except (Unkept, OSError):
        return None
    return kept


# What decides a program.


def _file_of(program: Any, static: tuple, arguments: tuple) -> Path:
    """Return the file of a program; it may not exist."""
    if not _folder:
        raise Unkept("there is no cache")
    leaves, tree = jax.tree.flatten(arguments)
    shapes = [(x.shape, str(x.dtype), bool(getattr(x, "weak_type", False))) for x in leaves]
    name = f"{program.__module__}.{program.__qualname__}"
    decides = (name, *map(_describe, static), str(tree), shapes, _surroundings(), _code())
    return _folder[0] / f"{program.__name__}-{hashlib.sha256(repr(decides).encode()).hexdigest()[:40]}"


def _describe(value: Any) -> Any:
    """Return an object of plain values that tells a static argument from any other. Files count by what they hold."""
    match value:
        case None | bool() | int() | float():
            return value
        case str():
            held = Path(value).read_bytes() if value and len(value) < 4096 and Path(value).is_file() else b""
            return value, held and hashlib.sha256(held).hexdigest()
        case tuple() | list():
            return type(value).__qualname__, *map(_describe, value)
        case Mapping():
            return "mapping", *((_describe(key), _describe(value[key])) for key in value)
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        raise Unkept(f"{value!r} may hold anything")
    fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    return type(value).__module__, type(value).__qualname__, _describe(fields)


def _surroundings() -> Any:
    """Return the devices, and the settings of JAX and of other libraries."""
    if jax.process_count() > 1:
        raise Unkept("processes trace programs together")
    device = jax.devices()[0]
    of_libraries = [item for item in sorted(os.environ.items()) if item[0].startswith(_ENVIRONMENT)]
    names = (device.platform, device.device_kind, device.client.platform_version, jax.device_count())
    return names, sorted((name, repr(value)) for name, value in jax.config.values.items()), of_libraries


def _code() -> Any:
    """Return the hash of this package's files, and the names and versions of installed packages."""
    places = (_PACKAGE, *_installed_places())
    known = tuple(f"{place}{os.sep}" for place in places)
    for module in list(sys.modules.values()):
        file = getattr(module, "__dict__", {}).get("__file__")
        if file is None and module is not sys.modules["__main__"]:
            continue  # part of Python itself
        if not str(file).startswith(known):
            raise Unkept(f"{file or 'an interactive session'} may change anything")
    return _versions(places)


@lru_cache
def _versions(places: tuple[Path, ...]) -> Any:
    content = hashlib.sha256()
    for file in sorted(_PACKAGE.rglob("*")):
        if file.is_file() and "__pycache__" not in file.parts:
            content.update(f"{file.relative_to(_PACKAGE)} {file.stat().st_size} ".encode() + file.read_bytes())
            _require_older(file)
    for place in places[1:]:
        _require_older(place)
    return sys.version, content.hexdigest(), sorted(info.name for place in places for info in place.glob("*.dist-info"))


def _installed_places() -> list[Path]:
    """Return the folders of Python's own modules, of commands and of packages that have a version."""
    own = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "scripts")]
    others = [*sys.path, site.getusersitepackages()]
    return sorted({Path(p) for p in own} | {Path(p) for p in others if p and any(Path(p).glob("*.dist-info"))})


def _require_older(path: Path) -> None:
    """Refuse a file or folder that changed after this process began, which may have imported what it was before."""
    found = path.stat()
    if max(found.st_mtime, found.st_ctime) > BEGAN - 1:  # clocks of file systems are coarse
        raise Unkept(f"{path} has just changed")


# Files.


def _export(file: Path, env: Any, program: Any, static: tuple, arguments: tuple) -> _Kept:
    """Trace a program and write it to a file."""
    traced = program.trace(*static, *arguments)
    leaves, tree = jax.tree.flatten(arguments)
    result = jax.tree.structure(traced.out_info)
    flat = jax.jit(lambda *leaves: jax.tree.leaves(program(*static, *jax.tree.unflatten(tree, leaves))))
    targets = env.calls.targets()
    checks = [export.DisabledSafetyCheck.custom_call(name) for name in targets]
    try:
        exported = export.export(flat, disabled_checks=checks)(*leaves).serialize()
        containers = _encode(jax.tree.unflatten(result, range(result.num_leaves)))
        header = {"result": containers, "targets": targets}
    except (Unkept, ValueError, NotImplementedError, ImportError) as error:
        exported, header = b"", {"unkept": str(error).split("\n")[0]}  # known from now on
    content = json.dumps(header).encode() + b"\n" + exported
    _write(file, hashlib.sha256(content).hexdigest().encode() + b"\n" + content)
    return _parse(content)  # not what was exported, as files lose weak types


def _read(file: Path) -> _Kept | None:
    """Read a program from its file. Return None if there is none, or if it is damaged."""
    if not file.exists():
        return None
    checksum, _, content = file.read_bytes().partition(b"\n")
    try:
        if checksum.decode() != hashlib.sha256(content).hexdigest():
            raise ValueError("its checksum is wrong")
        kept = _parse(content)
    except Unkept:
        raise
    except Exception as error:  # whatever another program has written there
        print(f"cannot read {file}: {error}; tracing the program again", file=sys.stderr)
        return None
    os.utime(file)
    return kept


def _parse(content: bytes) -> _Kept:
    line, _, exported = content.partition(b"\n")
    header = json.loads(line)
    if "unkept" in header:
        raise Unkept(header["unkept"])
    return _Kept(export.deserialize(bytearray(exported)), _decode(header["result"]), header["targets"])


def _write(file: Path, content: bytes) -> None:
    """Write a file at once, and drop the files that were not used for longest."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as new:
        new.write(content)
    os.replace(new.name, file)
    found = sorted(((x.stat().st_mtime, x.stat().st_size, x) for x in file.parent.iterdir()), reverse=True)
    for total, (_, _, each) in zip(accumulate(size for _, size, _ in found), found, strict=True):
        if total > LIMIT:
            each.unlink(missing_ok=True)


# The containers of a program's result.


def _encode(tree: Any) -> Any:
    """Return containers around numbers as JSON has them. Classes are written by name."""
    match tree:
        case None | int():
            return tree
        case list():
            return [_encode(x) for x in tree]
        case dict() if all(isinstance(key, str) for key in tree):
            return {"dict": {key: _encode(x) for key, x in tree.items()}}
        case tuple() if hasattr(tree, "_fields"):
            fields = tree._asdict()  # type: ignore
        case tuple():
            return {"tuple": [_encode(x) for x in tree]}
        case _ if dataclasses.is_dataclass(tree):
            fields = {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree)}
        case _:
            raise Unkept(f"{type(tree).__name__} is no container that can be written")
    cls = type(tree)
    return {"class": [cls.__module__, cls.__qualname__], "fields": {name: _encode(x) for name, x in fields.items()}}


def _decode(found: Any) -> Any:
    """Return the containers that ``_encode`` has written. Their classes must have been imported."""
    match found:
        case list():
            return [_decode(x) for x in found]
        case {"dict": items}:
            return {key: _decode(x) for key, x in items.items()}
        case {"tuple": items}:
            return tuple(_decode(x) for x in items)
        case {"class": [module, name], "fields": fields}:
            cls = vars(sys.modules[module])[name]
            if not (isinstance(cls, type) and (hasattr(cls, "_fields") or dataclasses.is_dataclass(cls))):
                raise ValueError(f"{name} is no container")
            return cls(**{key: _decode(x) for key, x in fields.items()})
    return found
