"""MJX-Warp: MuJoCo on NVIDIA GPUs, with kernels of its own that XLA calls; on a CPU it runs, slowly."""

import dataclasses
import importlib
from functools import cached_property, lru_cache, partial
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from mtjax.envs.engines.base import World, mjx_module, some
from mtjax.envs.engines.mjx import Mjx
from mtjax.types import Array, InputError, Task

# Fields that no stage of a step reads, so that tasks may differ in them though Warp has room for one value only.
_UNREAD = ("dof_M0",)
_DOUBLED = 8  # pairs that may touch in two points where MJX-JAX finds one, at the same time in one world


class _Flat(NamedTuple):
    """Everything one step reads, of worlds along one leading axis."""

    leaves: dict[str, Array]
    qpos: Array
    qvel: Array
    warmstart: Array
    ctrl: Array


def _own_device() -> Any:
    """A device of this process; MJX would take the first of all, which may be another's."""
    return jax.local_devices()[0]


@dataclasses.dataclass(frozen=True, eq=False)
class Warp:
    """Steps by MJX-Warp; start states, contacts and the sensors of positions and velocities by MJX-JAX.

    Warp picks a world's model by the world's number along one axis, so that maps, however they are nested, are
    flattened into one before it is called.

    Raises:
        InputError: tasks differ in a field of the model of which Warp can hold one value only.
    """

    base: mujoco.MjModel
    num_substeps: int

    def __post_init__(self):
        warp = importlib.import_module("warp")
        warp.config.log_level = warp.LOG_WARNING  # before it first runs, and says so on standard output

    @cached_property
    def mjx(self) -> Mjx:
        """The engine of all that is not a step."""
        return Mjx(self.base, self.num_substeps)

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World:
        """Put a world in a state without controls, and solve for the forces in it."""
        return self.mjx.forward(task, qpos, qvel, extra)

    def place(self, task: Task, qpos: Array, qvel: Array, extra: Any = None) -> World:
        """Put a world in a state in which no force sensor is touched."""
        return self.mjx.place(task, qpos, qvel, extra)

    def touching(self, task: Task, qpos: Array) -> Array:
        """Whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        return self.mjx.touching(task, qpos)

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        leaves = {name: leaf for name, leaf in task.model.items() if self._varies(name)}
        single = _Flat(leaves, world.qpos, world.qvel, world.warmstart, ctrl)
        new = self._advance(jax.tree.map(lambda x: x[None], single))
        qpos, qvel, warmstart, sensors = jax.tree.map(lambda x: x[0], new)
        return self.mjx.sense(task, World(qpos, qvel, warmstart, some(sensors), world.extra))

    def _varies(self, name: str) -> bool:
        """Whether Warp must be told of a field that differs between tasks."""
        from mujoco.mjx.warp.types import _BATCH_DIM

        if name in _UNREAD:
            return False
        if not _BATCH_DIM["Model"].get(name.replace(".", "__")):
            raise InputError(f"engine 'warp' cannot vary {name} between tasks; use --engine=mjx")
        return True

    @cached_property
    def _model(self) -> Any:
        from mujoco.mjx.third_party.mujoco_warp import OverflowType

        with jax.ensure_compile_time_eval():
            model = mjx_module().put_model(self.base, _own_device(), "warp")
        options = model.opt._impl
        # To stop after the iterations that are asked for is no fault to print; to run out of room would be.
        warned = options.warn_overflow & ~(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS)
        return model.replace(opt=model.opt.replace(_impl=options.replace(warn_overflow=int(warned))))

    @cached_property
    def _make_data(self) -> Any:
        """Data (by ``lru_cache``) for so many worlds, with room for every contact that they can have."""
        mjx = mjx_module()
        like = jax.eval_shape(partial(mjx.make_data, self.base, _own_device(), "jax"))._impl

        @lru_cache(maxsize=8)
        def make(count: int) -> Any:
            # MJX-JAX's arrays hold all that is possible, but that some pairs of shapes touch in twice as many points
            # here. Room costs time: it is filled anew at each step.
            slots = like.contact.dist.shape[0]
            doubled = min(slots, _DOUBLED)
            contacts, rows = slots + doubled, like.efc_J.shape[0] + 4 * doubled
            with jax.ensure_compile_time_eval():
                return mjx.make_data(
                    self.base, _own_device(), "warp", naconmax=max(count * contacts, 1), njmax=max(rows, 1)
                )

        return make

    @cached_property
    def _advance(self) -> Any:
        """Step worlds along one leading axis; a map over it adds to that axis."""
        step = mjx_module().step

        def one(data: Any, flat: _Flat) -> tuple[Array, ...]:
            model = self._model
            leaves = {name: leaf.reshape(attrgetter(name)(model).shape) for name, leaf in flat.leaves.items()}
            model = model.tree_replace(leaves)
            data = data.replace(qpos=flat.qpos, qvel=flat.qvel, qacc_warmstart=flat.warmstart, ctrl=flat.ctrl)
            data = jax.lax.fori_loop(0, self.num_substeps, lambda _, data: step(model, data), data)
            return data.qpos, data.qvel, data.qacc_warmstart, data.sensordata

        @jax.custom_batching.custom_vmap
        def advance(flat: _Flat) -> tuple[Array, ...]:
            return jax.vmap(partial(one, self._make_data(len(flat.qpos))))(flat)

        @advance.def_vmap
        def _(count: int, mapped: Any, flat: _Flat) -> tuple[Any, Any]:
            full = jax.tree.map(lambda x, m: x if m else jnp.broadcast_to(x, (count, *x.shape)), flat, mapped[0])
            new = advance(jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), full))
            return jax.tree.map(lambda x: x.reshape(count, len(x) // count, *x.shape[1:]), new), (True,) * 4

        return advance
