"""MuJoCo's C engine, threaded, for CPUs."""

import copy
import dataclasses
import hashlib
import threading
from collections.abc import Iterable, Sequence
from functools import cached_property, partial
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import batch

from mtjax.envs.engines import host
from mtjax.envs.engines.base import World, at_rest, require_plain, some
from mtjax.types import Array, Task

_MOST_BATCHES = 64  # kept of all engines (mt50 steps 32); those that were not used for longest are dropped


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoC:
    """MuJoCo's C engine for CPUs: a pure function on the host that programs call by name, threaded over worlds.

    The host flattens every mapped axis into one batch with one model per world, picked by ``task.row``.
    """

    models: Sequence[mujoco.MjModel]
    num_substeps: int
    _names: dict[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        require_plain(self.models[0])

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World:
        """Put a world in a state without controls, and solve for its forces."""
        world = at_rest(self.models[0], qpos, qvel, extra, mocap)
        if not self.models[0].nsensor:
            return world
        return world._replace(sensors=self._call("solve", self.models[0].nsensordata, task, world))

    place = forward

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        model = self.models[0]
        ends = np.cumsum([model.nq, model.nv, model.na, model.nv])
        new = self._call("advance", int(ends[-1]) + model.nsensordata, task, world, ctrl)
        qpos, qvel, act, warmstart, sensors = jnp.split(new, ends)
        return World(qpos, qvel, warmstart, some(sensors), world.extra, some(act), world.mocap)

    def require_variable(self, names: Iterable[str]) -> None:
        """Do nothing, as tasks may differ in all fields that vary."""

    def touching(self, task: Task, qpos: Array) -> Array:
        """Return whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        world = at_rest(self.models[0], qpos, jnp.zeros(self.models[0].nv, qpos.dtype))
        return self._call("count", 1, task, world)[0] > 0

    # Calls of programs.

    def targets(self) -> dict[str, list[str]]:
        """Return the arguments of ``provide`` for every call until now, by the call's name in programs."""
        return {name: [act] for act, name in list(self._names.items())}

    def provide(self, act: str) -> str:
        """Give the host's function for ``act`` a name in programs, and return it. It is the same in every process."""
        name = f"mujoco_{act}_{self._digest}"
        with _LOCK:
            if self._digest not in _known:
                _known[self._digest] = _Worlds(self.models, self.num_substeps)
            if name not in host.names():
                host.register(name, partial(_known[self._digest].run, act))
            self._names[act] = name
        return name

    def load_kernels(self) -> bool:
        """Do nothing, as MuJoCo is compiled. Return False, as programs record nothing."""
        return False

    @cached_property
    def _digest(self) -> str:
        """Return a short hash of the models and the number of substeps."""
        content = hashlib.sha256(repr(self.num_substeps).encode())
        rows: dict[int, int] = {}  # many tasks may share a model
        for model in self.models:
            if id(model) not in rows:
                saved = np.empty(mujoco.mj_sizeModel(model), np.uint8)
                mujoco.mj_saveModel(model, None, saved)
                content.update(saved.tobytes())
            content.update(repr(rows.setdefault(id(model), len(rows))).encode())
        return content.hexdigest()[:16]

    def _call(self, act: str, width: int, task: Task, world: World, ctrl: Array | None = None) -> Array:
        """Call the host with one array and return one array (width,). Each further array costs as much as a world."""
        ctrl = jnp.zeros(self.models[0].nu) if ctrl is None else ctrl
        state = [x for x in (world.qpos, world.qvel, world.act, world.warmstart, ctrl) if x is not None]
        moved = [] if world.mocap is None else [jnp.ravel(world.mocap)]
        packed = jnp.concatenate([jnp.float32(x) for x in (jnp.float32(task.row)[None], *state, *moved)])
        return host.call(self.provide(act), width, packed)


class _Worlds:
    """Worlds on the host, for all engines with the same models.

    Programs call it by name, and may do so after every engine is gone. So it is kept for good, without its batches.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], num_substeps: int):
        self.models, self.lock = _without_reset(models), threading.Lock()
        advance = partial(_advance, num_substeps, models[0].nq + 2 * models[0].nv + models[0].na)
        self.acts = {"solve": _solve, "advance": advance, "count": _count_contacts}

    def run(self, act: str, packed: np.ndarray, result: np.ndarray) -> None:
        """Fill in the result of ``act`` on worlds (..., K)."""
        rows = packed.reshape(-1, packed.shape[-1])
        with self.lock:  # a batch serves one call at a time, and MuJoCo lets other threads run while it steps
            worlds = self.batch(rows[:, 0].astype(np.int32))
            _set_state(worlds, rows[:, 1:])
            result[:] = self.acts[act](worlds).reshape(result.shape)

    def batch(self, rows: np.ndarray) -> Any:
        """Return the batch for these worlds. Its models are set only when they change."""
        worlds, known = _batches.pop((self, len(rows)), (None, None))
        if worlds is None:
            worlds = batch.Batch(self.models[0], len(rows), persistent=_keeps_data(self.models[0]))
        if known is None or not np.array_equal(known, rows):
            worlds.set_models([self.models[i] for i in rows])
        with _LOCK:
            _batches[self, len(rows)] = worlds, rows  # at the end, as the latest
            if len(_batches) > _MOST_BATCHES:
                _batches.pop(next(iter(_batches)))
        return worlds


_known: dict[str, _Worlds] = {}  # by the hash of their models and substeps
_batches: dict[tuple[_Worlds, int], tuple[Any, np.ndarray]] = {}
_LOCK = threading.Lock()  # of both tables


def _without_reset(models: Sequence[mujoco.MjModel]) -> list[mujoco.MjModel]:
    """Return the models without MuJoCo's automatic reset, so that a diverged world stays visible."""
    copies = {id(model): copy.copy(model) for model in models}
    for model in copies.values():
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return [copies[id(model)] for model in models]


def _keeps_data(model: mujoco.MjModel) -> bool:
    """Return whether each world keeps its own computed data, and continues from there if its state is the same.

    That pays where sensors need those data before the next step. Else the data of a thread serve all worlds: those of
    a thousand fit into no cache. MuJoCo asks for it where bodies sleep, and for its IPC.
    """
    asks = mujoco.mjtEnableBit.mjENBL_SLEEP | mujoco.mjtEnableBit.mjENBL_IPC
    return bool(model.nsensor or model.opt.enableflags & asks)


def _state(worlds: Any, size: int) -> np.ndarray:
    """Return the first ``size`` of qpos, qvel, act, warm start and ctrl (n, size), which follow the time in a state."""
    return worlds.state[:, 1 : 1 + size]


def _set_state(worlds: Any, values: np.ndarray) -> None:
    """Set all that ``_state`` holds, and the poses of bodies of motion capture, which come last (n, 7 nmocap)."""
    moved = worlds.model.nmocap
    _state(worlds, values.shape[1] - 7 * moved)[:] = values[:, : values.shape[1] - 7 * moved]
    if moved:
        poses = values[:, -7 * moved :].reshape(-1, moved, 7)
        worlds.bind("mocap_pos")[:], worlds.bind("mocap_quat")[:] = poses[..., :3], poses[..., 3:]


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
