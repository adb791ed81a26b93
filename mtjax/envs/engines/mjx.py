"""MJX, MuJoCo's JAX port, which runs on any device."""

import dataclasses
from collections.abc import Iterable, Iterator
from functools import cached_property
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.engines.base import World, at_rest, mjx_module, require_plain, state_of
from mtjax.types import Array, InputError, Task

# Sensors that read more than poses and velocities of bodies: these need the whole position and velocity stages.
INVOLVED = [getattr(mujoco.mjtSensor, f"mjSENS_{x}") for x in "TENDONPOS TENDONVEL ACTUATORPOS ACTUATORVEL".split()]
INVOLVED += [mujoco.mjtSensor.mjSENS_CONTACT, mujoco.mjtSensor.mjSENS_CAMPROJECTION]

_RANGEFINDER, _TACTILE = mujoco.mjtSensor.mjSENS_RANGEFINDER, mujoco.mjtSensor.mjSENS_TACTILE
# What MJX leaves out without a word, and the fields that are not 0 where a model has it.
_LEFT_OUT = {
    "fluid forces on ellipsoids (fluidshape)": ("geom_fluid",),
    "nonlinear stiffness of joints or tendons": ("jnt_stiffnesspoly", "tendon_stiffnesspoly"),
    "nonlinear damping": ("dof_dampingpoly", "tendon_dampingpoly", "actuator_dampingpoly"),
    "damping or armature of actuators": ("actuator_damping", "actuator_armature"),
    "actuators that act early (actearly)": ("actuator_actearly",),
    "actuators of a disabled group": ("opt.disableactuator",),
    "velocities of surfaces": ("flg_surfacevel",),
    "adhesion of geoms": ("flg_adhesion",),
    "iterations against slip (noslip_iterations)": ("opt.noslip_iterations",),
    "plugins": ("nplugin",),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Mjx:
    """MJX: pure JAX, and the reference on every device."""

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

    def require_runnable(self) -> None:
        """Refuse a model that MJX cannot run, or would run only in part.

        Raises:
            InputError: the message says what it is, and which engines have it.
        """
        wrong = next(left_out(self.base), None)
        try:
            _ = self._constants
        except (NotImplementedError, ValueError) as error:
            wrong = str(error).split("\n")[0].rstrip(".")
        if wrong is not None:
            raise InputError(f"engine 'mjx' cannot run this model: {wrong}; use --engine=c or --engine=warp")

    @cached_property
    def _feels(self) -> bool:
        return mujoco.mjtStage.mjSTAGE_ACC in self.base.sensor_needstage

    def _bind(self, task: Task, world: World) -> tuple[Any, Any]:
        """Return the task's model, and its data in the given state."""
        model, data = self._constants
        leaves = {name: leaf for name, leaf in task.model.items() if name != "site_size"}
        return model.tree_replace(leaves), data.replace(**state_of(world))

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World:
        """Put a world in a state without controls, and solve for its forces."""
        if not self._feels:
            return self.place(task, qpos, qvel, extra, mocap)
        world = at_rest(self.base, qpos, qvel, extra, mocap)
        model, data = self._bind(task, world)
        with jax.default_matmul_precision("highest"):
            data = self._feel(task, model, mjx_module().forward(model, data))
        return world._replace(sensors=data.sensordata)

    def place(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World:
        """Put a world in a state in which no force sensor is touched. It compiles much faster than ``forward``."""
        return self.sense(task, at_rest(self.base, qpos, qvel, extra, mocap))

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        model, data = self._bind(task, world)

        def substep(_, world: World) -> World:
            now = data.replace(qpos=world.qpos, qvel=world.qvel, qacc_warmstart=world.warmstart, ctrl=ctrl)
            now = now if world.act is None else now.replace(act=world.act)
            new = self._feel(task, model, mjx_module().step(model, now))
            sensors = new.sensordata if self._feels else world.sensors  # unread, they are never computed
            act = None if world.act is None else new.act
            return World(new.qpos, new.qvel, new.qacc_warmstart, sensors, world.extra, act, world.mocap)

        with jax.default_matmul_precision("highest"):
            world = jax.lax.fori_loop(0, self.num_substeps, substep, world)
        return self.sense(task, world)

    def require_variable(self, names: Iterable[str]) -> None:
        """Do nothing, as tasks may differ in all fields that vary."""

    def touching(self, task: Task, qpos: Array) -> Array:
        """Return whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        mjx = mjx_module()
        model, data = self._bind(task, at_rest(self.base, qpos, jnp.zeros(self.base.nv, qpos.dtype)))
        with jax.default_matmul_precision("highest"):
            data = mjx.collision(model, mjx.com_pos(model, mjx.kinematics(model, data)))
        return jnp.any(data._impl.contact.dist < 0)

    def sense(self, task: Task, world: World) -> World:
        """Update position and velocity sensors to the world's state. Force sensors stay as they are."""
        if np.all(self.base.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC):
            return world
        mjx = mjx_module()
        model, data = self._bind(task, world)
        involved = np.any(np.isin(self.base.sensor_type, INVOLVED))
        positions = mjx.fwd_position if involved else lambda m, d: mjx.com_pos(m, mjx.kinematics(m, d))
        velocities = mjx.fwd_velocity if involved else mjx.com_vel
        with jax.default_matmul_precision("highest"):
            data = mjx.sensor_pos(model, positions(model, data.replace(sensordata=world.sensors)))
            data = mjx.sensor_vel(model, velocities(model, data))
        return world._replace(sensors=data.sensordata)

    def _feel(self, task: Task, model: Any, data: Any) -> Any:
        """Compute the force sensors that MJX does not compute, or not with the task's own sites."""
        if "site_size" in task.model:  # static to MJX, so that it cannot differ between tasks in the model itself
            return mjx_module().sensor_acc(model.replace(site_size=task.model["site_size"]), data)
        if self._feels and data._impl.efc_J.size == 0:  # MJX returns early where nothing constrains the motion
            return mjx_module().sensor_acc(model, data)
        return data


def left_out(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what a model has and MJX would leave out."""
    for what, fields in _LEFT_OUT.items():
        if any(np.any(attrgetter(field)(model)) for field in fields):
            yield what
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:
        yield "the discrete integrator"
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        yield "sleeping bodies"
    if np.any(model.actuator_ctrlnum != 1) or np.any(model.actuator_outnum != 1):
        yield "actuators of several controls or forces"
    of_cameras = (model.sensor_type == _RANGEFINDER) & (model.sensor_objtype != mujoco.mjtObj.mjOBJ_SITE)
    if np.any(of_cameras) or np.any(model.sensor_type == _TACTILE):
        yield "tactile sensors and range finders of cameras"
