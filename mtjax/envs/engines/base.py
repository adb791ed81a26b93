"""The interface of physics engines, and the choice of one: MJX anywhere, MuJoCo C on CPUs, MuJoCo Warp on NVIDIA GPUs.

An engine advances a world by ``num_substeps``. It then updates position and velocity sensors to the new state, as
dm_control does. Force sensors (touch) keep the values of the last substep. Worlds are single: the caller maps.
"""

import contextlib
import dataclasses
import importlib.util
import io
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.types import Array, InputError, Task

ENGINES = ("auto", "mjx", "warp", "c")


class World(NamedTuple):
    """The physical state of one simulated world, and the values of its sensors."""

    qpos: Array  # (nq,) [m or rad]
    qvel: Array  # (nv,) [m/s or rad/s]
    warmstart: Array  # (nv,) last constrained acceleration, where the next solve starts
    sensors: Any  # (nsensordata,); None where the model has none
    extra: Any = None  # the domain's own memory of the episode; engines leave it alone
    act: Any = None  # (na,) activations of actuators; None where the model has none
    mocap: Any = None  # (nmocap, 7) position and quaternion of bodies that a domain moves; None where there are none


class Engine(Protocol):
    """The physics of every task of one family. ``task`` selects the model; worlds are not batched."""

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World: ...
    def place(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World: ...
    def step(self, task: Task, world: World, ctrl: Array) -> World: ...
    def touching(self, task: Task, qpos: Array) -> Array: ...
    def require_variable(self, names: Iterable[str]) -> None: ...  # raises InputError if tasks may not differ in these


@dataclasses.dataclass(frozen=True, eq=False)
class Blank:
    """An engine that computes nothing. Worlds have their shapes, and to trace it takes no time."""

    base: mujoco.MjModel

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World:
        """Return the world without forces."""
        return at_rest(self.base, qpos, qvel, extra, mocap)

    place = forward

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Return the same world."""
        return world

    def touching(self, task: Task, qpos: Array) -> Array:
        """Return that nothing touches."""
        return jnp.bool_(False)

    def require_variable(self, names: Iterable[str]) -> None:
        """Allow tasks to differ in all fields."""


def choose_engine(engine: str, preferred: str = "mjx") -> str:
    """Return the name of the engine to run. "auto" is MuJoCo C on a CPU, and ``preferred`` elsewhere.

    Args:
        preferred: "mjx" or "warp". MJX replaces Warp where Warp cannot run.

    Raises:
        InputError: this device cannot run the engine, or Warp is not installed.
    """
    device, nvidia = jax.default_backend(), is_nvidia()
    if engine == "auto" and device == "cpu":
        return "c"
    if engine == "auto":
        return "warp" if preferred == "warp" and nvidia and warp_installed() else "mjx"
    if engine == "c" and device != "cpu":
        raise InputError(f"engine 'c' needs JAX on the CPU, not on {device}; use --engine=mjx")
    if engine == "warp" and not (nvidia or device == "cpu"):
        raise InputError("engine 'warp' needs an NVIDIA GPU (or a CPU, where it is slow); use --engine=mjx")
    if engine == "warp" and not warp_installed():
        raise InputError("engine 'warp' needs Warp, which is not installed: pip install 'mtjax[warp]'; or --engine=mjx")
    return engine


def is_nvidia() -> bool:
    """Return whether JAX runs on NVIDIA GPUs."""
    return jax.default_backend() == "gpu" and "rocm" not in jax.devices()[0].client.platform_version.lower()


def warp_installed() -> bool:
    """Return whether Warp is installed."""
    return importlib.util.find_spec("warp") is not None


@lru_cache
def mjx_module() -> Any:
    """Import MJX without its message on standard output that Warp is not installed."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def some(values: Array) -> Array | None:
    """Return values, or None if there are none, because arrays of size 0 cannot be reshaped or saved."""
    return values if values.size else None


def at_rest(model: mujoco.MjModel, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World:
    """Return a world without activations and sensor values. Bodies of motion capture are where the model has them."""
    act = jnp.zeros(model.na, qpos.dtype) if model.na else None
    if mocap is None and model.nmocap:
        moved = model.body_mocapid >= 0
        order = np.argsort(model.body_mocapid[moved])
        mocap = np.float32(np.concatenate([model.body_pos[moved], model.body_quat[moved]], axis=1)[order])
    sensors = some(jnp.zeros(model.nsensordata, qpos.dtype))
    return World(qpos, qvel, jnp.zeros_like(qvel), sensors, extra, act, mocap)


def state_of(world: World) -> dict[str, Array]:
    """Return positions, velocities, activations and poses of moved bodies, by MuJoCo's names of them."""
    state = {"qpos": world.qpos, "qvel": world.qvel}
    if world.act is not None:
        state["act"] = world.act
    if world.mocap is not None:
        state |= {"mocap_pos": world.mocap[:, :3], "mocap_quat": world.mocap[:, 3:]}
    return state


def require_plain(model: mujoco.MjModel) -> None:
    """Refuse a model with more state than positions, velocities, activations and motion capture.

    Raises:
        InputError: the model has delays or a clock sensor.
    """
    if model.nhistory or mujoco.mjtSensor.mjSENS_CLOCK in model.sensor_type:
        raise InputError(
            "a model must remember nothing but positions, velocities and activations, and this one has "
            "actuators or sensors with delays, or a clock"
        )
