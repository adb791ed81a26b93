"""MuJoCo's C engine, threaded, for CPUs."""

import copy
import dataclasses
import threading
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch

from mtjax.envs.engines.base import World, require_plain, some
from mtjax.types import Array, Task


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoC:
    """MuJoCo's C engine for CPUs: a pure function through a callback, threaded over worlds.

    The host flattens every mapped axis into one batch with one model per world, picked by ``task.row``. A batch keeps
    its computed data, and continues from there if it receives the very state that it returned last.
    """

    models: Sequence[mujoco.MjModel]
    num_substeps: int
    _batches: dict[int, tuple[Any, np.ndarray]] = dataclasses.field(default_factory=dict)
    _lock: Any = dataclasses.field(default_factory=threading.Lock)

    def __post_init__(self):
        require_plain(self.models[0])

    @cached_property
    def _models(self) -> list[mujoco.MjModel]:
        """Return the models without MuJoCo's automatic reset, so that a diverged world stays visible."""
        copies = {id(model): copy.copy(model) for model in self.models}
        for model in copies.values():
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        return [copies[id(model)] for model in self.models]

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World:
        """Put a world in a state without controls, and solve for its forces."""
        zeros = jnp.zeros_like(qvel)
        if not self.models[0].nsensor:
            return World(qpos, qvel, zeros, None, extra)
        sensors = self._call(_solve, self.models[0].nsensordata, task, qpos, qvel, zeros)
        return World(qpos, qvel, zeros, sensors, extra)

    place = forward

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        model = self.models[0]
        size = model.nq + 2 * model.nv
        act = partial(_advance, self.num_substeps, size)
        new = self._call(act, size + model.nsensordata, task, world.qpos, world.qvel, world.warmstart, ctrl)
        qpos, qvel, warmstart, sensors = jnp.split(new, (model.nq, model.nq + model.nv, size))
        return World(qpos, qvel, warmstart, some(sensors), world.extra)

    def touching(self, task: Task, qpos: Array) -> Array:
        """Return whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        zeros = jnp.zeros(self.models[0].nv, qpos.dtype)
        return self._call(_count_contacts, 1, task, qpos, zeros, zeros)[0] > 0

    def _call(self, act: Callable, width: int, task: Task, *state: Array) -> Array:
        """Call the host with one array and return one array (width,). Each further array costs as much as a world."""
        if len(state) == 3:
            state = (*state, jnp.zeros(self.models[0].nu))
        packed = jnp.concatenate([jnp.float32(task.row)[None], *(jnp.float32(x) for x in state)])
        result = jax.ShapeDtypeStruct((width,), jnp.float32)
        return jax.pure_callback(partial(self._host, act), result, packed, vmap_method="broadcast_all")

    def _host(self, act: Callable, packed: Array) -> np.ndarray:
        rows = np.asarray(packed).reshape(-1, packed.shape[-1])
        with self._lock:  # a batch serves one call at a time, and MuJoCo lets other threads run while it steps
            worlds = self._batch(rows[:, 0].astype(np.int32))
            _state(worlds, rows.shape[1] - 1)[:] = rows[:, 1:]
            result = act(worlds)
        return result.reshape(*packed.shape[:-1], -1)

    def _batch(self, rows: np.ndarray) -> Any:
        """Return the batch for these worlds. Its models are set only when they change."""
        worlds, known = self._batches.get(len(rows), (None, None))
        if worlds is None:
            worlds = batch.Batch(self._models[0], len(rows), persistent=True)
        if known is None or not np.array_equal(known, rows):
            worlds.set_models([self._models[i] for i in rows])
            self._batches[len(rows)] = worlds, rows
        return worlds


def _state(worlds: Any, size: int) -> np.ndarray:
    """Return the first ``size`` of qpos, qvel, qacc_warmstart and ctrl (n, size), which follow the time in a state."""
    return worlds.state[:, 1 : 1 + size]


def _advance(num_substeps: int, size: int, worlds: Any) -> np.ndarray:
    """Step, and compute the sensors from the new state in float32, as the caller receives it."""
    sensors = worlds.bind("sensordata") if worlds.model.nsensor else np.zeros((worlds.nsim, 0))
    worlds.step(nstep=num_substeps)
    result = np.empty((worlds.nsim, size + sensors.shape[1]), np.float32)
    result[:, :size] = _state(worlds, size)
    if worlds.model.nsensor:
        _state(worlds, size)[:] = result[:, :size]
        worlds.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)  # where the next step begins, so this is done once
        result[:, size:] = sensors
    return result


def _solve(worlds: Any) -> np.ndarray:
    sensors = worlds.bind("sensordata")  # a live view, asked for before the call that fills it
    worlds.forward()
    return sensors.astype(np.float32)


def _count_contacts(worlds: Any) -> np.ndarray:
    contacts = worlds.bind("ncon")
    worlds.forward(stage=mujoco.mjtStage.mjSTAGE_POS)
    return contacts.astype(np.float32)
