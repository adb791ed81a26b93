"""Warp's kernels, compiled several at a time. Warp itself compiles each one when it is first launched."""

import contextlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

_MOST_THREADS = 16
Kernels = Iterable[tuple[Any, int]]  # modules, and the sizes of blocks for which they are compiled


def note_kernels(device: Any, launch: Callable[[], Any]) -> Kernels:
    """Return the kernels that ``launch`` launches on a device of Warp. It computes nothing meanwhile.

    Warp's choice of a device holds for all threads, so only one thread at a time may do this.
    """
    import warp

    with warp.ScopedDevice(device), _only_noting(warp) as noted:
        launch()
    return noted


def compile_kernels(device: Any, kernels: Kernels) -> None:
    """Compile or load kernels for a device of Warp. No other thread may do so for that device meanwhile."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with ThreadPoolExecutor(min(_MOST_THREADS, cores)) as pool:
        for done in [pool.submit(module.load, device, block_dim) for module, block_dim in kernels]:
            done.result()


@contextlib.contextmanager
def _only_noting(warp: Any) -> Iterator[dict[tuple[Any, int], None]]:
    """Note the modules of this thread's launches. Warp skips a launch whose module it did not get.

    What depends on data that nothing computes is launched once: bodies of loops, both sides of branches.
    """
    noted, thread, load = {}, threading.get_ident(), warp.Module.load

    def note(module: Any, device: Any, block_dim: Any = None) -> Any:
        if block_dim is None:  # no launch: Warp asks what the device can run
            return load(module, device)
        noted[module, block_dim] = None
        return None

    def loop(condition: Any, while_body: Callable, stream: Any = None, **more: Any) -> None:
        while_body(**more)

    def branch(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **more: Any) -> None:
        for side in filter(None, (on_true, on_false)):
            side(**more)

    places = [(warp.Module, "load", note), (warp, "capture_while", loop), (warp, "capture_if", branch)]
    own = [getattr(owner, name) for owner, name, _ in places]
    for (owner, name, ours), theirs in zip(places, own, strict=True):
        here = lambda *given, ours=ours, theirs=theirs, **more: (ours if threading.get_ident() == thread else theirs)(
            *given, **more
        )
        setattr(owner, name, here)
    try:
        yield noted
    finally:
        for (owner, name, _), theirs in zip(places, own, strict=True):
            setattr(owner, name, theirs)
