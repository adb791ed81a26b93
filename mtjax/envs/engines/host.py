"""Host functions that programs call by name, on a CPU through XLA's interface for foreign functions.

``jax.pure_callback`` puts the address of its function into the compiled program, so that neither JAX nor XLA can keep
the program for another process. A name means the same in every process that has registered it.

The structures are the beginnings of those in ``xla/ffi/api/c_api.h``, whose binary layout XLA keeps stable.
"""

import atexit
import contextlib
import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from ctypes import POINTER, c_char_p, c_int, c_int64, c_size_t, c_uint32, c_void_p
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from mtjax.names import InputError

_VERSION = (0, 1)  # of the interface, major and minor
_METADATA = 1  # the type of the extension by which XLA asks for the version
_UNKNOWN = 2  # XLA's code of an error of no other kind
_DTYPES = {4: np.int32, 6: np.uint8, 11: np.float32}  # by XLA's numbers of types
_handlers: dict[str, Any] = {}  # by name; XLA calls them for as long as the process lives
_functions: dict[str, Callable] = {}  # the same, as they were given
_raised: list[Exception] = []  # by functions, until somebody is told


class Failure(Exception):
    """What a host function could not do. The message is for the user, and the cause is what was raised there."""


class _Extension(ctypes.Structure):
    _fields_ = (("struct_size", c_size_t), ("type", c_int), ("next", c_void_p))


class _Version(ctypes.Structure):
    _fields_ = (("struct_size", c_size_t), ("extension", c_void_p), ("major", c_int), ("minor", c_int))


class _Metadata(ctypes.Structure):
    _fields_ = (("struct_size", c_size_t), ("version", _Version), ("traits", c_uint32))


class _Query(ctypes.Structure):
    _fields_ = (("extension", _Extension), ("metadata", POINTER(_Metadata)))


class _Buffer(ctypes.Structure):
    _fields_ = (
        ("struct_size", c_size_t),
        ("extension", c_void_p),
        ("dtype", c_int),
        ("data", c_void_p),
        ("rank", c_int64),
        ("dims", POINTER(c_int64)),
    )


class _Buffers(ctypes.Structure):
    _fields_ = (
        ("struct_size", c_size_t),
        ("extension", c_void_p),
        ("size", c_int64),
        ("types", c_void_p),
        ("items", POINTER(POINTER(_Buffer))),
    )


class _Error(ctypes.Structure):
    _fields_ = (("struct_size", c_size_t), ("extension", c_void_p), ("message", c_char_p), ("code", c_int))


class _Api(ctypes.Structure):
    _fields_ = (
        ("struct_size", c_size_t),
        ("extension", c_void_p),
        ("version", _Version),
        ("internal", c_void_p),
        ("create_error", ctypes.CFUNCTYPE(c_void_p, POINTER(_Error))),
    )


class _Call(ctypes.Structure):
    _fields_ = (
        ("struct_size", c_size_t),
        ("extension", POINTER(_Query)),
        ("api", POINTER(_Api)),
        ("context", c_void_p),
        ("stage", c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    )


def register(name: str, function: Callable[..., None]) -> None:
    """Give a function a name, by which programs call it with the arrays that it reads, then those that it fills in.

    They are of float32, int32 or uint8.
    """

    def handle(call: Any) -> int | None:
        frame = call.contents
        try:
            if frame.extension:
                _answer(frame.extension.contents)
            else:
                function(*_views(frame.arguments), *_views(frame.results))
        except Exception as error:  # raised again by JAX
            _raised.append(error)
            message = f"{type(error).__name__}: {error}".encode()
            given = _Error(ctypes.sizeof(_Error), None, message, _UNKNOWN)
            return frame.api.contents.create_error(ctypes.byref(given))
        return None

    _functions[name] = function
    _handlers[name] = ctypes.CFUNCTYPE(c_void_p, POINTER(_Call))(handle)
    address = ctypes.cast(_handlers[name], c_void_p).value
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")


def names() -> list[str]:
    """Return the names of all registered functions."""
    return list(_handlers)


def call(name: str, width: int, values: jax.Array) -> jax.Array:
    """Call a registered function with ``values`` (K,); return what it fills in (width,). Mapped axes lead in both."""
    return jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((width,), np.float32), vmap_method="broadcast_all")(values)


def call_once(name: str, shapes: Sequence[jax.ShapeDtypeStruct], *values: jax.Array) -> Sequence[jax.Array]:
    """Call a registered function that changes what the host holds; return what it fills in. It cannot be mapped.

    The first value, and the first thing that it fills in, are counts. Calls come in the order in which they need each
    other's results. Programs of any device can make them; those of a GPU are then not kept for other processes.
    """
    if jax.default_backend() == "cpu":
        return jax.ffi.ffi_call(name, shapes, has_side_effect=True)(*values)
    return _apart(io_callback(partial(_fill, name, shapes), shapes, *_apart(values)))


def _apart(values: Sequence[jax.Array]) -> Sequence[jax.Array]:
    """Keep what a call takes or gives apart from the stacks of a scan.

    Where a call reads from a stack or writes to one, XLA for GPUs makes a copy of it that does so in place, and then
    runs both: a world would take two steps. A choice that XLA cannot foresee is between them: no count is negative.
    """
    never = values[0].ravel()[0] < 0
    return [jnp.where(never, jnp.zeros_like(x), x) for x in values]


def _fill(name: str, shapes: Sequence[jax.ShapeDtypeStruct], *values: Any) -> list[np.ndarray]:
    """Return what a registered function fills in."""
    filled = [np.empty(x.shape, x.dtype) for x in shapes]
    try:
        _functions[name](*map(np.asarray, values), *filled)
    except Exception as error:
        _raised.append(error)
        raise
    return filled


@contextlib.contextmanager
def explaining(also: Callable[[], str] = str) -> Iterator[None]:
    """Tell what a host function could not do, where a program stops because of it.

    Args:
        also: returns a further clause of the message.

    Raises:
        InputError: a function has raised a ``Failure``.
    """
    _raised.clear()
    try:
        yield
    except jax.errors.JaxRuntimeError:
        failure = next((error for error in _raised if isinstance(error, Failure)), None)
        if failure is None:
            raise
        jax.jit(lambda: jax.debug.callback(lambda: None))()  # else JAX meets the failed program again as it exits
        told = "; ".join(text for text in (str(failure), also()) if text)
        raise InputError(told) from failure.__cause__


@atexit.register
def _finish() -> None:
    """Wait for programs that still call functions here, as they would crash a process that ends below them."""
    if _handlers:
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            jax.block_until_ready(jax.live_arrays())


def _answer(query: _Query) -> None:
    """Tell XLA which version of its interface a function expects."""
    if query.extension.type == _METADATA:
        version = query.metadata.contents.version
        version.major, version.minor = _VERSION


def _views(buffers: _Buffers) -> list[np.ndarray]:
    """Return all buffers as arrays, without copies."""
    return [_view(buffers.items[i].contents) for i in range(buffers.size)]


def _view(buffer: _Buffer) -> np.ndarray:
    """Return a buffer as an array, without a copy."""
    shape, dtype = tuple(buffer.dims[: buffer.rank]), _DTYPES[buffer.dtype]
    size = math.prod(shape)
    if not size:
        return np.zeros(shape, dtype)
    held = (ctypes.c_uint8 * (size * np.dtype(dtype).itemsize)).from_address(buffer.data)
    return np.ctypeslib.as_array(held).view(dtype).reshape(shape)
