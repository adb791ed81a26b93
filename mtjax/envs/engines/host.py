"""Host functions that programs of a CPU call by name, through XLA's interface for foreign functions.

``jax.pure_callback`` puts the address of its function into the compiled program, so that neither JAX nor XLA can keep
the program for another process. A name means the same in every process that has registered it.

The structures are the beginnings of those in ``xla/ffi/api/c_api.h``, whose binary layout XLA keeps stable.
"""

import ctypes
import math
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_int, c_int64, c_size_t, c_uint32, c_void_p
from typing import Any

import jax
import numpy as np

_VERSION = (0, 1)  # of the interface, major and minor
_METADATA = 1  # the type of the extension by which XLA asks for the version
_UNKNOWN = 2  # XLA's code of an error of no other kind
_handlers: dict[str, Any] = {}  # by name; XLA calls them for as long as the process lives


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


def register(name: str, function: Callable[[np.ndarray, np.ndarray], None]) -> None:
    """Give a function a name, by which programs call it with one array and the array to fill, both of float32."""

    def handle(call: Any) -> int | None:
        frame = call.contents
        try:
            if frame.extension:
                _answer(frame.extension.contents)
            else:
                function(_view(frame.arguments), _view(frame.results))
        except Exception as error:  # raised again by JAX
            message = f"{type(error).__name__}: {error}".encode()
            given = _Error(ctypes.sizeof(_Error), None, message, _UNKNOWN)
            return frame.api.contents.create_error(ctypes.byref(given))
        return None

    _handlers[name] = ctypes.CFUNCTYPE(c_void_p, POINTER(_Call))(handle)
    address = ctypes.cast(_handlers[name], c_void_p).value
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")


def names() -> list[str]:
    """Return the names of all registered functions."""
    return list(_handlers)


def call(name: str, width: int, values: jax.Array) -> jax.Array:
    """Call a registered function with ``values`` (K,); return what it fills in (width,). Mapped axes lead in both."""
    return jax.ffi.ffi_call(name, jax.ShapeDtypeStruct((width,), np.float32), vmap_method="broadcast_all")(values)


def _answer(query: _Query) -> None:
    """Tell XLA which version of its interface a function expects."""
    if query.extension.type == _METADATA:
        version = query.metadata.contents.version
        version.major, version.minor = _VERSION


def _view(buffers: _Buffers) -> np.ndarray:
    """Return the only buffer as an array, without a copy."""
    buffer = buffers.items[0].contents
    shape = buffer.dims[: buffer.rank]
    size = math.prod(shape)
    if not size:
        return np.zeros(shape, np.float32)
    return np.ctypeslib.as_array((ctypes.c_float * size).from_address(buffer.data)).reshape(shape)
