"""Trees of arrays in a folder, as orbax writes and reads them."""

import errno
import glob
import json
import logging
import os
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mtjax.types import InputError

_HEADER = re.compile(rb"(?:(.*)/)?zarr\.json")  # the entry of every array, by its name; a tree may be one array


class Written:
    """Trees that are being written into a folder."""

    def __init__(self, response: Any, folder: Path):
        self._response, self._folder = response, folder

    def wait(self) -> None:
        """Wait until all is written.

        Raises:
            OSError: it could not be written.
        """
        try:
            self._response.result()
        except (OSError, ValueError) as error:
            raise _as_oserror(error, self._folder) from None


def write(folder: Path, parts: Mapping[str, Any]) -> Written:
    """Copy trees to the host, and begin to write them into a new folder.

    Every process writes what its devices hold.

    Raises:
        InputError: the path can hold no arrays.
        OSError: the folder cannot be written.
    """
    from orbax.checkpoint import v1 as ocp

    place = _place(folder)
    _silence()
    try:
        with _context():
            return Written(ocp.save_checkpointables_async(place, dict(parts)), folder)
    except (OSError, ValueError) as error:
        raise _as_oserror(error, folder) from None


def read(folder: Path, like: Mapping[str, Any], partial: bool = False) -> dict[str, Any]:
    """Read trees into the structure of ``like``, whose leaves may be shapes alone.

    Arrays go to the devices that ``like`` names, by default to the first one. Every process must call this.

    Args:
        partial: leave out what the folder has and ``like`` has not.

    Raises:
        InputError: the trees in the folder are others, or cannot be read.
    """
    from orbax.checkpoint import v1 as ocp

    first = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    place = lambda x: getattr(x, "sharding", None) or first
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place(x)), dict(like))
    if not partial and (difference := _difference(folder, like)):
        raise InputError(f"the checkpoint {str(folder)!r} is of another run: {difference}")
    _silence()
    try:
        with _context(partial):
            return ocp.load_checkpointables(_place(folder), shapes)
    except (ValueError, KeyError, OSError) as error:
        raise InputError(f"the checkpoint {str(folder)!r} cannot be read: {_first_line(error)}") from None


def _difference(folder: Path, parts: Mapping[str, Any]) -> str:
    """Return in which array of some trees a folder differs from them; empty if in none, or if it cannot be read."""
    shape = lambda x: jax.eval_shape(jax.random.key_data, x).shape if _is_key(x) else x.shape
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator=".")
    for part, tree in parts.items():
        try:
            entries, names = _entries(folder, part)
            found = [match for match in map(_HEADER.fullmatch, names) if match]
            headers = {(x[1] or b"").decode(): entries.read(x[0]).result().value for x in found}
            there = {array: tuple(json.loads(header)["shape"]) for array, header in headers.items()}
        except ValueError:
            return ""
        here = {name(path): shape(x) for path, x in jax.tree.leaves_with_path(tree)}
        different = [array for array in {**here, **there} if here.get(array) != there.get(array)]
        if different:
            told = lambda shapes, array: f"of shape {shapes[array]}" if array in shapes else "missing"
            first = f"{part}.{different[0]} is {told(there, different[0])} there, and {told(here, different[0])} here"
            return first + f"; {len(different) - 1} more differ" * (len(different) > 1)
    return ""


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def _entries(folder: Path, part: str) -> tuple[Any, list[bytes]]:
    """Return what is stored of a tree, and the names in it. A folder without arrays has none."""
    import tensorstore

    base = {"driver": "file", "path": f"{_place(folder)}/{part}/"}
    entries = tensorstore.KvStore.open({"driver": "ocdbt", "base": base}).result()
    return entries, entries.list().result()


def require_readable(folder: Path, parts: Mapping[str, Any]) -> None:
    """Read all that was written of trees once, without keeping it: a writer that found no error may have lost it.

    Raises:
        OSError: an array is missing, or one cannot be read.
    """
    for part, tree in parts.items():
        try:
            entries, names = _entries(folder, part)
            for name in names:
                entries.read(name).result()
        except ValueError as error:
            raise _as_oserror(error, folder) from None
        found, expected = sum(map(bool, map(_HEADER.fullmatch, names))), len(jax.tree.leaves(tree))
        if found != expected:
            raise OSError(errno.EIO, f"{found} of {expected} arrays of {part} can be read back", str(folder))


def require_place(folder: Path) -> None:
    """Refuse a path that cannot hold arrays.

    Raises:
        InputError: it holds a backslash, which the writer takes for a slash, or bytes that are no UTF-8.
    """
    place = str(folder.absolute())
    if "\\" in place or place.encode(errors="ignore") != os.fsencode(place):
        raise InputError(f"a run's folder must be UTF-8 without backslashes, and {place!r} is not; choose another one")


def _as_oserror(error: Exception, folder: Path) -> OSError:
    """Return an error of orbax as one of the system."""
    known = re.search(r"os_error_code='(\d+)'", str(error))
    number = int(known[1]) if known else getattr(error, "errno", None) or errno.EIO
    return OSError(number, os.strerror(number) if number != errno.EIO else _first_line(error), str(folder))


def _first_line(error: Exception) -> str:
    return str(error).strip().split("\n")[0][:150]


def _place(folder: Path) -> str:
    require_place(folder)
    return str(folder.absolute())


def _context(partial: bool = False) -> Any:
    from orbax.checkpoint import v1 as ocp

    context = ocp.Context(file_options=ocp.options.FileOptions(path_class=_path_class()))
    context.pytree.loading.partial_load = partial
    return context


@cache
def _path_class() -> type:
    """Return the class of orbax's paths, whose own characters are no patterns: a folder may be called lr[1]."""
    from etils import epath

    class LiteralPath(type(epath.Path("/"))):
        def glob(self, pattern: str) -> Iterator[Any]:
            return (self / found for found in glob.iglob(pattern, root_dir=self))

    return LiteralPath


def _silence() -> None:
    """Keep orbax from logging pages about what it also raises."""
    logger = logging.getLogger("absl")
    if not any(each is _not_of_orbax for each in logger.filters):
        logger.addFilter(_not_of_orbax)


def _not_of_orbax(record: logging.LogRecord) -> bool:
    return "orbax" not in record.pathname
