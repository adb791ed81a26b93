"""One control step with one meaning, behind two engines: MJX-JAX anywhere, MuJoCo C on the CPU.

Both advance a world by ``num_substeps`` and then bring the position and velocity sensors up to the new state, as
dm_control does; force sensors (touch) stay those of the last substep. Worlds are single: the caller maps.
"""

import contextlib
import dataclasses
import io
import threading
from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.types import Array, InputError, Task

ENGINES = ("auto", "mjx", "c")


class World(NamedTuple):
    """The physical state of one simulated world, and what its sensors read in it."""

    qpos: Array  # (nq,) [m or rad]
    qvel: Array  # (nv,) [m/s or rad/s]
    warmstart: Array  # (nv,) last constrained acceleration, where the next solve starts
    sensors: Array  # (nsensordata,)


class Engine(Protocol):
    """Physics of every task of one family. ``task`` selects the model; worlds are not batched."""

    def forward(self, task: Task, qpos: Array, qvel: Array) -> World: ...
    def place(self, task: Task, qpos: Array, qvel: Array) -> World: ...
    def step(self, task: Task, world: World, ctrl: Array) -> World: ...
    def touching(self, task: Task, qpos: Array) -> Array: ...


def choose_engine(engine: str) -> str:
    """Return the engine that runs for ``engine``: MuJoCo C on a CPU, MJX elsewhere.

    Raises:
        InputError: MuJoCo C is asked for while JAX runs on another device than the CPU.
    """
    on_cpu = jax.default_backend() == "cpu"
    if engine == "c" and not on_cpu:
        raise InputError(f"engine 'c' needs JAX on the CPU, not on {jax.default_backend()}; use --engine=mjx")
    return {"auto": "c" if on_cpu else "mjx"}.get(engine, engine)


@lru_cache
def mjx_module() -> Any:
    """Import MJX, without its remark on standard output that Warp is not installed."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


@dataclasses.dataclass(frozen=True, eq=False)
class Mjx:
    """MuJoCo's JAX port: pure, and the reference on every device."""

    base: mujoco.MjModel
    num_substeps: int

    @cached_property
    def _constants(self) -> tuple[Any, Any]:
        mjx = mjx_module()
        with jax.ensure_compile_time_eval():
            return mjx.put_model(self.base, impl="jax"), mjx.make_data(self.base, impl="jax")

    def _bind(self, task: Task, qpos: Array, qvel: Array | None = None) -> tuple[Any, Any]:
        """The task's model, and data in the given state."""
        model, data = self._constants
        leaves = {name: leaf for name, leaf in task.model.items() if name != "site_size"}
        return model.tree_replace(leaves), data.replace(qpos=qpos, qvel=data.qvel if qvel is None else qvel)

    def forward(self, task: Task, qpos: Array, qvel: Array) -> World:
        """Put a world in a state without controls, and solve for the forces in it."""
        model, data = self._bind(task, qpos, qvel)
        with jax.default_matmul_precision("highest"):
            data = mjx_module().forward(model, data)
        return World(qpos, qvel, jnp.zeros_like(qvel), self._touch(task, model, data).sensordata)

    def place(self, task: Task, qpos: Array, qvel: Array) -> World:
        """Put a world in a state in which no force sensor is touched; far cheaper to compile than ``forward``."""
        model, data = self._bind(task, qpos, qvel)
        world = World(qpos, qvel, jnp.zeros_like(qvel), jnp.zeros_like(data.sensordata))
        return self._sense(model, data, world)

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        model, data = self._bind(task, world.qpos, world.qvel)

        def substep(_, world: World) -> World:
            now = data.replace(qpos=world.qpos, qvel=world.qvel, qacc_warmstart=world.warmstart, ctrl=ctrl)
            new = self._touch(task, model, mjx_module().step(model, now))
            return World(new.qpos, new.qvel, new.qacc_warmstart, new.sensordata)

        with jax.default_matmul_precision("highest"):
            world = jax.lax.fori_loop(0, self.num_substeps, substep, world)
        return self._sense(model, data, world)

    def touching(self, task: Task, qpos: Array) -> Array:
        """Whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        model, data = self._bind(task, qpos)
        with jax.default_matmul_precision("highest"):
            data = mjx_module().collision(model, self._positions(model, data))
        return jnp.any(data._impl.contact.dist < 0)

    def _positions(self, model: Any, data: Any) -> Any:
        mjx = mjx_module()
        return mjx.com_pos(model, mjx.kinematics(model, data))

    def _sense(self, model: Any, data: Any, world: World) -> World:
        """Bring position and velocity sensors to the world's state; force sensors stay those of the last substep."""
        mjx = mjx_module()
        with jax.default_matmul_precision("highest"):
            data = data.replace(qpos=world.qpos, qvel=world.qvel, sensordata=world.sensors)
            data = mjx.sensor_pos(model, self._positions(model, data))
            data = mjx.sensor_vel(model, mjx.com_vel(model, data))
        return world._replace(sensors=data.sensordata)

    def _touch(self, task: Task, model: Any, data: Any) -> Any:
        """Read the force sensors again where tasks differ in the size of the sites that feel (static to MJX)."""
        if "site_size" not in task.model:
            return data
        return mjx_module().sensor_acc(model.replace(site_size=task.model["site_size"]), data)


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoC:
    """The C engine, threaded over worlds, as a pure function through a callback: for CPUs.

    The host flattens every mapped axis into one batch with one model a world, picked by ``task.id``.
    """

    models: Sequence[mujoco.MjModel]
    num_substeps: int
    _batches: dict[int, tuple[Any, np.ndarray]] = dataclasses.field(default_factory=dict)
    _lock: Any = dataclasses.field(default_factory=threading.Lock)

    def forward(self, task: Task, qpos: Array, qvel: Array) -> World:
        """Put a world in a state without controls, and solve for the forces in it."""
        model, zeros = self.models[0], jnp.zeros_like(qvel)
        world = World(qpos, qvel, zeros, jnp.zeros(model.nsensordata, qpos.dtype))
        return self._call(_solve, world, task, world, jnp.zeros(model.nu, qpos.dtype))._replace(warmstart=zeros)

    place = forward

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        return self._call(partial(_advance, self.num_substeps), world, task, world, ctrl)

    def touching(self, task: Task, qpos: Array) -> Array:
        """Whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        model = self.models[0]
        zeros = jnp.zeros(model.nv, qpos.dtype)
        world = World(qpos, zeros, zeros, jnp.zeros(model.nsensordata, qpos.dtype))
        return self._call(_count_contacts, jnp.int32(0), task, world, jnp.zeros(model.nu, qpos.dtype)) > 0

    def _call(self, act: Callable, like: Any, task: Task, world: World, ctrl: Array) -> Any:
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), like)
        host = partial(self._host, act, shapes)
        return jax.pure_callback(host, shapes, task.id, world, ctrl, vmap_method="broadcast_all")

    def _host(self, act: Callable, shapes: Any, task_id: Array, world: World, ctrl: Array) -> Any:
        """Write the worlds into the batch, act, and read what ``shapes`` asks for."""
        ids = np.asarray(task_id)
        rows = {"qpos": world.qpos, "qvel": world.qvel, "qacc_warmstart": world.warmstart, "ctrl": ctrl}
        with self._lock:  # a batch serves one call at a time, and MuJoCo lets other threads run while it steps
            worlds = self._batch(ids.reshape(-1))
            for name, value in rows.items():
                target = worlds.bind(name)
                target[:] = np.asarray(value).reshape(target.shape)
            result = act(worlds)
            return jax.tree.map(lambda x, s: x.astype(s.dtype).reshape(ids.shape + s.shape), result, shapes)

    def _batch(self, ids: np.ndarray) -> Any:
        """The batch for these worlds, told of its models only when they change."""
        from mujoco import batch

        worlds, known = self._batches.get(len(ids), (None, None))
        if worlds is None:
            worlds = batch.Batch(self.models[0], len(ids))
        if known is None or not np.array_equal(known, ids):
            worlds.set_models([self.models[i] for i in ids])
            self._batches[len(ids)] = worlds, ids.copy()
        return worlds


def _advance(num_substeps: int, worlds: Any) -> World:
    result = _read(worlds)
    worlds.step(nstep=num_substeps, stage=mujoco.mjtStage.mjSTAGE_VEL)
    return result


def _solve(worlds: Any) -> World:
    result = _read(worlds)
    worlds.forward()
    return result


def _count_contacts(worlds: Any) -> np.ndarray:
    contacts = worlds.bind("ncon")
    worlds.forward(stage=mujoco.mjtStage.mjSTAGE_POS)
    return contacts


def _read(worlds: Any) -> World:
    """Live views of the worlds, asked for before the call that fills them."""
    return World(*(worlds.bind(name) for name in ("qpos", "qvel", "qacc_warmstart", "sensordata")))
