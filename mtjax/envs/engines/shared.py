"""Engines that equal families share, and that live as long as a program that calls them.

A compiled program calls another library by a name and knows nothing of Python's objects. So the engine behind a call is
attached to the program, as JAX attaches the functions of its own callbacks.
"""

import threading
import weakref
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

T = TypeVar("T")
_living: "weakref.WeakValueDictionary[str, Any]" = weakref.WeakValueDictionary()
_calls: dict[str, dict[Any, Any]] = {}  # for good, as libraries keep them too
_LOCK = threading.RLock()  # garbage may be collected at any time, also in a thread that has it


def first_of(name: str, engine: T, forget: Callable[[Any], None] = lambda call: None) -> T:
    """Return the living engine of this name, a hash of all that it does. ``engine`` becomes it if there is none.

    Args:
        forget: makes a call of the name drop what would refer to the engine's memory after the engine is gone.
    """
    with _LOCK:
        first = _living.get(name)
        if first is not None:
            return first
        _living[name] = engine
        weakref.finalize(engine, _forget, name, forget).atexit = False
        return engine


def _forget(name: str, forget: Callable[[Any], None]) -> None:
    for call in list(_calls.get(name, {}).values()):
        forget(call)


def living(name: str) -> Any:
    """Return the engine of this name, which a running program calls."""
    return _living[name]


def call_of(name: str, about: Any, make: Callable[[], T]) -> T:
    """Return the call of the engines of this name with these arguments, which is made once.

    A library would give another one another name in programs.
    """
    with _LOCK:
        calls = _calls.setdefault(name, {})
        if about not in calls:
            calls[about] = make()
        return calls[about]


_keep = Primitive("keep")
_keep.def_impl(lambda x, *, engine: x)
_keep.def_abstract_eval(lambda x, *, engine: x)
batching.defvectorized(_keep)


def _lower(ctx: Any, x: Any, *, engine: Any) -> list[Any]:
    if not ctx.module_context.lowering_parameters.for_export:  # a file cannot hold objects of this process
        ctx.module_context.add_keepalive(engine)
    return [x]


mlir.register_lowering(_keep, _lower)


def keep(engine: Any, results: T) -> T:
    """Return results of an engine. The program that computes them keeps it, unless it is exported to a file."""
    return jax.tree.map(lambda x: _keep.bind(x, engine=engine), results)
