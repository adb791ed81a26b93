"""One control step with one meaning, behind three engines: MJX-JAX anywhere, MuJoCo C on the CPU, and MJX-Warp.

All advance a world by ``num_substeps`` and then bring the position and velocity sensors up to the new state, as
dm_control does; force sensors (touch) stay those of the last substep. Worlds are single: the caller maps.
"""

import contextlib
import copy
import dataclasses
import importlib.util
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

ENGINES = ("auto", "mjx", "warp", "c")
# Sensors that read more than poses and velocities of bodies: these need the whole position and velocity stages.
_INVOLVED = [getattr(mujoco.mjtSensor, f"mjSENS_{x}") for x in "TENDONPOS TENDONVEL ACTUATORPOS ACTUATORVEL".split()]
_INVOLVED += [mujoco.mjtSensor.mjSENS_CONTACT, mujoco.mjtSensor.mjSENS_CAMPROJECTION]


class World(NamedTuple):
    """The physical state of one simulated world, and what its sensors read in it."""

    qpos: Array  # (nq,) [m or rad]
    qvel: Array  # (nv,) [m/s or rad/s]
    warmstart: Array  # (nv,) last constrained acceleration, where the next solve starts
    sensors: Any  # (nsensordata,); None where the model has none
    extra: Any = None  # what the domain itself remembers of the episode; no engine touches it


class Engine(Protocol):
    """Physics of every task of one family. ``task`` selects the model; worlds are not batched."""

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World: ...
    def place(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World: ...
    def step(self, task: Task, world: World, ctrl: Array) -> World: ...
    def touching(self, task: Task, qpos: Array) -> Array: ...


def choose_engine(engine: str, preferred: str = "mjx") -> str:
    """Return the engine that runs for ``engine``: where that is "auto", MuJoCo C on a CPU.

    Args:
        preferred: what "auto" is elsewhere, "mjx" or "warp"; MJX where Warp cannot run.

    Raises:
        InputError: the engine that is asked for cannot run on this device, or Warp is not installed.
    """
    device = jax.default_backend()
    nvidia = device == "gpu" and "rocm" not in jax.devices()[0].client.platform_version.lower()
    if engine == "auto" and device == "cpu":
        return "c"
    if engine == "auto":
        return "warp" if preferred == "warp" and nvidia and _warp_installed() else "mjx"
    if engine == "c" and device != "cpu":
        raise InputError(f"engine 'c' needs JAX on the CPU, not on {device}; use --engine=mjx")
    if engine == "warp" and not (nvidia or device == "cpu"):
        raise InputError("engine 'warp' needs an NVIDIA GPU (or a CPU, where it is slow); use --engine=mjx")
    if engine == "warp" and not _warp_installed():
        raise InputError("engine 'warp' needs Warp, which is not installed: pip install 'mtjax[warp]'; or --engine=mjx")
    return engine


def _warp_installed() -> bool:
    return importlib.util.find_spec("warp") is not None


@lru_cache
def mjx_module() -> Any:
    """Import MJX, without its remark on standard output that Warp is not installed."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def some(values: Array) -> Array | None:
    """Return values, or None where there are none: arrays of size 0 can be neither reshaped by halves nor saved."""
    return values if values.size else None


def require_plain(model: mujoco.MjModel) -> None:
    """Refuse a model whose state is more than positions and velocities.

    Raises:
        InputError: actuators with activations, delays, or a clock among the sensors.
    """
    if model.na or model.nhistory or mujoco.mjtSensor.mjSENS_CLOCK in model.sensor_type:
        raise InputError(
            "a model must have no state but positions and velocities, and this one has actuators with activations or "
            "delays, sensors with delays or a clock"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Mjx:
    """MuJoCo's JAX port: pure, and the reference on every device."""

    base: mujoco.MjModel
    num_substeps: int

    def __post_init__(self):
        require_plain(self.base)

    @cached_property
    def _constants(self) -> tuple[Any, Any]:
        mjx = mjx_module()
        with jax.ensure_compile_time_eval():
            own = jax.local_devices()[0]  # the first of all may be another process's
            return mjx.put_model(self.base, own, "jax"), mjx.make_data(self.base, own, "jax")

    @cached_property
    def _feels(self) -> bool:
        return mujoco.mjtStage.mjSTAGE_ACC in self.base.sensor_needstage

    def _bind(self, task: Task, qpos: Array, qvel: Array | None = None) -> tuple[Any, Any]:
        """The task's model, and data in the given state."""
        model, data = self._constants
        leaves = {name: leaf for name, leaf in task.model.items() if name != "site_size"}
        return model.tree_replace(leaves), data.replace(qpos=qpos, qvel=data.qvel if qvel is None else qvel)

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World:
        """Put a world in a state without controls, and solve for the forces in it."""
        if not self._feels:
            return self.place(task, qpos, qvel, extra)
        model, data = self._bind(task, qpos, qvel)
        with jax.default_matmul_precision("highest"):
            data = self._feel(task, model, mjx_module().forward(model, data))
        return World(qpos, qvel, jnp.zeros_like(qvel), data.sensordata, extra)

    def place(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World:
        """Put a world in a state in which no force sensor is touched; far cheaper to compile than ``forward``."""
        sensors = some(jnp.zeros(self.base.nsensordata, qpos.dtype))
        return self.sense(task, World(qpos, qvel, jnp.zeros_like(qvel), sensors, extra))

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        model, data = self._bind(task, world.qpos, world.qvel)

        def substep(_, world: World) -> World:
            now = data.replace(qpos=world.qpos, qvel=world.qvel, qacc_warmstart=world.warmstart, ctrl=ctrl)
            new = self._feel(task, model, mjx_module().step(model, now))
            sensors = new.sensordata if self._feels else world.sensors  # unread, they are never computed
            return World(new.qpos, new.qvel, new.qacc_warmstart, sensors, world.extra)

        with jax.default_matmul_precision("highest"):
            world = jax.lax.fori_loop(0, self.num_substeps, substep, world)
        return self.sense(task, world)

    def touching(self, task: Task, qpos: Array) -> Array:
        """Whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        mjx = mjx_module()
        model, data = self._bind(task, qpos)
        with jax.default_matmul_precision("highest"):
            data = mjx.collision(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        return jnp.any(data._impl.contact.dist < 0)

    def sense(self, task: Task, world: World) -> World:
        """Bring position and velocity sensors to the world's state; force sensors stay as they are."""
        if np.all(self.base.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC):
            return world
        mjx = mjx_module()
        model, data = self._bind(task, world.qpos, world.qvel)
        involved = np.any(np.isin(self.base.sensor_type, _INVOLVED))
        positions = mjx.fwd_position if involved else lambda m, d: mjx.com_pos(m, mjx.kinematics(m, d))
        velocities = mjx.fwd_velocity if involved else mjx.com_vel
        with jax.default_matmul_precision("highest"):
            data = mjx.sensor_pos(model, positions(model, data.replace(sensordata=world.sensors)))
            data = mjx.sensor_vel(model, velocities(model, data))
        return world._replace(sensors=data.sensordata)

    def _feel(self, task: Task, model: Any, data: Any) -> Any:
        """Read the force sensors where MJX has not, or not with the task's own sizes of the sites that feel."""
        if "site_size" in task.model:  # static to MJX, so that it cannot differ between tasks in the model itself
            return mjx_module().sensor_acc(model.replace(site_size=task.model["site_size"]), data)
        if self._feels and data._impl.efc_J.size == 0:  # MJX returns early where nothing constrains the motion
            return mjx_module().sensor_acc(model, data)
        return data


@dataclasses.dataclass(frozen=True, eq=False)
class MujocoC:
    """The C engine, threaded over worlds, as a pure function through a callback: for CPUs.

    The host flattens every mapped axis into one batch with one model a world, picked by ``task.row``. A batch keeps
    what it computed in the state it hands out, and goes on from there if it is given that very state back.
    """

    models: Sequence[mujoco.MjModel]
    num_substeps: int
    _batches: dict[int, tuple[Any, np.ndarray]] = dataclasses.field(default_factory=dict)
    _lock: Any = dataclasses.field(default_factory=threading.Lock)

    def __post_init__(self):
        require_plain(self.models[0])

    @cached_property
    def _models(self) -> list[mujoco.MjModel]:
        """The models, of which a world that diverges shows it: MuJoCo would put it back to its first pose."""
        copies = {id(model): copy.copy(model) for model in self.models}
        for model in copies.values():
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        return [copies[id(model)] for model in self.models]

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World:
        """Put a world in a state without controls, and solve for the forces in it."""
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
        """Whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        zeros = jnp.zeros(self.models[0].nv, qpos.dtype)
        return self._call(_count_contacts, 1, task, qpos, zeros, zeros)[0] > 0

    def _call(self, act: Callable, width: int, task: Task, *state: Array) -> Array:
        """Act on worlds on the host: one array there and one back (width,), as each array costs as much as a world."""
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
        """The batch for these worlds, told of its models only when they change."""
        from mujoco import batch

        worlds, known = self._batches.get(len(rows), (None, None))
        if worlds is None:
            worlds = batch.Batch(self._models[0], len(rows), persistent=True)
        if known is None or not np.array_equal(known, rows):
            worlds.set_models([self._models[i] for i in rows])
            self._batches[len(rows)] = worlds, rows
        return worlds


def _state(worlds: Any, size: int) -> np.ndarray:
    """The first ``size`` of qpos, qvel, qacc_warmstart and ctrl (n, size), which follow the time in a plain state."""
    return worlds.state[:, 1 : 1 + size]


def _advance(num_substeps: int, size: int, worlds: Any) -> np.ndarray:
    """Step, and sense in the new state as the caller will know it: in float32."""
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
