"""The exchange of steps between the replay on the devices and its store on the host, between chunks.

While a chunk runs, a thread fetches what the chunk before it has taken, writes it to the run's folder, and collects the
segments that go back to the devices after this chunk. So a draw knows the steps up to one chunk before. It depends on
the seed and on the step alone, and a resumed run draws what it would have drawn.

The thread puts nothing on the devices: a copy waits for XLA's stream, and MuJoCo Warp fails if that happens while it
records a CUDA graph on it.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding

from mtjax.experience.replay import newest, recall, segments_of
from mtjax.experience.store import Store, recalled_rows
from mtjax.learning.loop import Settings, TrainState
from mtjax.names import notice, replacing
from mtjax.types import Agent, Env


class Exchange:
    """Moves steps between devices and host after every chunk, if the agent's experience keeps steps on the host."""

    def __init__(self, env: Env, agent: Agent, settings: Settings, mesh: Mesh | None, directory: Path | None):
        self.experience: Any = agent.experience
        self.num_slots = self.experience.host_slots(settings.num_envs)
        self.chunk, self.mesh = settings.chunk_steps, mesh
        self.files = None if directory is None else Files(directory / "store")
        if self.num_slots:
            count, self.length = segments_of(self.experience, env.spec, settings.num_envs)
            self.latest = self.experience.capacity(settings.num_envs) // settings.num_envs - count * self.length
            self.number = recalled_rows(self.chunk, count, self.length)
            self.thread = ThreadPoolExecutor(1, "exchange")

    def begin(self, state: TrainState) -> None:
        """Make the store of a run that begins, or read that of one that goes on."""
        if not self.num_slots:
            return
        steps = int(state.iteration)
        self.keys = np.asarray(jax.random.key_data(state.data.key))
        self.store = Store(state.data.ring.rows, self.num_slots, steps)
        self.saved = steps
        if self.files is not None:
            self.files.read(self.store)
        self.pending: Future[Any] = self.thread.submit(self._collect)

    def after_chunk(self, state: TrainState) -> TrainState:
        """Exchange steps once the devices have done a chunk, for which this does not wait."""
        if not self.num_slots:
            return state
        latest, segments = self._newest(state.data), self.pending.result()
        for x in jax.tree.leaves(latest):
            x.copy_to_host_async()
        self.pending = self.thread.submit(self._keep, latest)
        return state if segments is None else state._replace(data=self._recall(state.data, self._put(segments)))

    def finish(self, iteration: int) -> None:
        """Wait until all steps up to a checkpoint are in the run's folder, and drop those that none needs any more.

        Raises:
            OSError: they could not be written.
        """
        if not self.num_slots or self.files is None:
            return
        self.pending.result()
        self.files.drop(self.saved - self.num_slots)  # the checkpoint before this one needs those after that
        self.saved = iteration

    def close(self) -> None:
        """End the thread."""
        if self.num_slots:
            self.thread.shutdown()

    def _keep(self, latest: Any) -> Any:
        items = jax.device_get(latest)
        self.store.add(items)
        if self.files is not None:
            self.files.write(self.store.count, items)
        return self._collect()

    def _collect(self) -> Any:
        """Return segments for the end of the next chunk; None if there are too few steps."""
        return self.store.draw(self.keys, self.chunk, self.latest, self.number, self.length)

    def _put(self, segments: Any) -> Any:
        rows = self.experience.storage.sharding.ring.rows
        return jax.device_put(segments, None if self.mesh is None else NamedSharding(self.mesh, rows))

    @cached_property
    def _newest(self) -> Callable:
        """Return the program that takes a chunk's steps out of the replay."""
        return jax.jit(self._split(lambda data: newest(data, self.chunk), 0, out=1))

    @cached_property
    def _recall(self) -> Callable:
        """Return the program that writes segments into the replay, in place. One for both would copy the replay."""
        return jax.jit(self._split(recall, 0, 1, out=0), donate_argnums=0)

    def _split(self, program: Callable, *inputs: int, out: int) -> Callable:
        """Let each device run a program on what it holds of arguments and result: 0 for the replay, 1 for steps."""
        if self.mesh is None:
            return program
        specs = self.experience.storage.sharding, self.experience.storage.sharding.ring.rows
        places = tuple(specs[i] for i in inputs)
        return jax.shard_map(program, mesh=self.mesh, in_specs=places, out_specs=specs[out], check_vma=False)


class Files:
    """Keeps the steps of each chunk in a file, named after the last of them. Each has checksums inside."""

    def __init__(self, folder: Path):
        self.folder = folder

    def write(self, count: int, items: Any) -> None:
        """Write the steps, leaves (S, T, H, E, ...), up to number ``count``."""
        self.folder.mkdir(exist_ok=True)
        with replacing(self.folder / f"{count}.npz") as new, new.open("wb") as file:
            np.savez(file, *jax.tree.leaves(items))

    def read(self, store: Store) -> None:
        """Fill a store with the steps before its first, as far back as there are whole files.

        Files of later steps are left from a run that did not reach its next checkpoint; this one writes them anew.
        """
        form, oldest = jax.tree.structure(store.rows), max(store.count - store.num_slots, 0)
        shapes = lambda leaves: [(*x.shape[:2], *x.shape[3:]) for x in leaves]
        while store.begun > oldest:
            leaves = self._leaves(store.begun)
            if leaves is None or shapes(leaves) != shapes(jax.tree.leaves(store.rows)):
                what = f"{str(self._path(store.begun))!r} is missing or damaged"
                notice(f"{what}; the run goes on without the steps that the host kept up to it")
                return
            store.add_before(jax.tree.unflatten(form, leaves))

    def drop(self, count: int) -> None:
        """Remove the files with no step after number ``count``."""
        for path in self.folder.glob("*.npz"):
            if path.stem.isdigit() and int(path.stem) <= count:
                path.unlink(missing_ok=True)

    def _leaves(self, count: int) -> list[np.ndarray] | None:
        """Return what a file holds; None if it is missing or damaged."""
        try:
            with np.load(self._path(count), allow_pickle=False) as file:
                return [file[f"arr_{i}"] for i in range(len(file.files))]
        except Exception:  # a damaged archive may raise anything
            return None

    def _path(self, count: int) -> Path:
        return self.folder / f"{count}.npz"
