"""MuJoCo Warp: MuJoCo on NVIDIA GPUs, with its own kernels that XLA calls. On a CPU it runs slowly."""

import dataclasses
import hashlib
import importlib
import inspect
import itertools
import threading
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from operator import attrgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.engines.base import World, mjx_module, state_of
from mtjax.envs.engines.kernels import compile_kernels, note_kernels
from mtjax.envs.engines.mjx import INVOLVED, Mjx
from mtjax.envs.engines.shared import call_of, first_of, keep, living
from mtjax.types import Array, InputError, Task

# Fields that no stage of a step reads, so that tasks may differ in them though Warp has room for one value only.
_UNREAD = ("dof_M0",)
_ROOM = (96, 384)  # contacts and constraint rows of a world, where MJX cannot count them: Meta-World's have 54 and 221
_SPARE = 6  # rows of a weld, which Warp drops unless more than these are free
_DOUBLED = 8  # pairs that may touch in two points where MJX-JAX finds one, at the same time in one world
_MOVED = ("mocap_pos", "mocap_quat")  # poses that a domain sets
ALONE = threading.Lock()  # Warp's choice of a device holds for all threads


class _Flat(NamedTuple):
    """All arrays that a step reads, with worlds along one leading axis."""

    leaves: dict[str, Array]
    given: dict[str, Array]  # state and controls, by Warp's names


class _Call(NamedTuple):
    """A call of Warp in JAX's programs."""

    target: Any  # Warp's, by whose name programs call it
    function: Callable
    leaves: list[jax.ShapeDtypeStruct]  # the shapes of the differing leaves in Warp


class _Place(NamedTuple):
    """The memory of Warp on one device, for a number of worlds."""

    model: Any
    data: Any
    all_move: Any  # (nbody,) a body's number of what it is fixed to, as if no body were fixed to the world


def keep_streams(warp: Any) -> None:
    """Keep Warp's references to XLA's CUDA streams for as long as the process lives.

    Warp makes a ``Stream`` of the same CUDA stream for each graph that it captures, and forgets the CUDA stream when
    any of them is collected. If Python collects an older one while a younger one captures, Warp 1.18 fails with
    "unknown stream".
    """
    release = warp.Stream.__del__
    if not hasattr(release, "keeps_streams"):

        def keep(stream: Any) -> None:
            if stream.owner:
                release(stream)

        keep.keeps_streams = True
        warp.Stream.__del__ = keep


@dataclasses.dataclass(frozen=True, eq=False)
class Warp:
    """An engine that steps by MuJoCo Warp. MJX computes start states.

    XLA passes positions, velocities, warm starts, controls and the differing leaves of tasks to one call. This call
    takes all substeps in Warp's own memory. MJX would pass all of Warp's arrays through XLA at every substep. That is
    slower, and wrong on GPUs if several such arrays start equal, because XLA 0.11 gives them one piece of memory.

    Warp picks a world's model by the world's number along one axis. Nested maps are therefore flattened into one axis.

    Equal engines use the memory of the first of them, and programs keep that one when Python has no other reference.

    Raises:
        InputError: tasks differ in a model field for which Warp holds only one value.
    """

    base: mujoco.MjModel
    num_substeps: int

    def __post_init__(self):
        warp = importlib.import_module("warp")
        warp.config.log_level = warp.LOG_WARNING  # before it first runs, and says so on standard output
        keep_streams(warp)

    @cached_property
    def mjx(self) -> Mjx:
        """Return the MJX engine, for contacts of start states."""
        return Mjx(self.base, self.num_substeps)

    @cached_property
    def _unhindered(self) -> Mjx:
        """Return the MJX engine of the model without collisions. It also places bodies whose contacts MJX refuses."""
        model = self.base.__copy__()
        model.geom_contype[:] = model.geom_conaffinity[:] = 0
        return Mjx(model, self.num_substeps)

    def forward(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World:
        """Put a world in a state without controls, and solve for its forces if sensors feel them.

        If MJX refuses the model's contacts, its force sensors read 0 until the next step.
        """
        feels = mujoco.mjtStage.mjSTAGE_ACC in self.base.sensor_needstage
        put = self.mjx.forward if feels and self._like is not None else self.place
        return put(task, qpos, qvel, extra, mocap)

    def place(self, task: Task, qpos: Array, qvel: Array, extra: Any = None, mocap: Any = None) -> World:
        """Put a world in a state in which no force sensor is touched."""
        return self._unhindered.place(task, qpos, qvel, extra, mocap)

    def touching(self, task: Task, qpos: Array) -> Array:
        """Return whether any two colliding geoms overlap in the positions ``qpos`` (nq,)."""
        return self.mjx.touching(task, qpos)

    def step(self, task: Task, world: World, ctrl: Array) -> World:
        """Advance one control step under ``ctrl`` (nu,)."""
        leaves = {name: leaf for name, leaf in task.model.items() if self._varies(name)}
        given = state_of(world) | {"qacc_warmstart": world.warmstart, "ctrl": ctrl}
        new = self._advance(jax.tree.map(lambda x: x[None], _Flat(leaves, given)))
        new = jax.tree.map(lambda x: x[0], new)
        return World(
            new["qpos"],
            new["qvel"],
            new["qacc_warmstart"],
            new.get("sensordata"),
            world.extra,
            new.get("act"),
            world.mocap,
        )

    def require_variable(self, names: Iterable[str]) -> None:
        """Check that Warp can hold a value of each task in these fields.

        Raises:
            InputError: it holds only one value of a field.
        """
        for name in names:
            self._varies(name)

    def _varies(self, name: str) -> bool:
        """Return whether Warp needs the tasks' values of a field."""
        from mujoco.mjx.warp.types import _BATCH_DIM

        if name in _UNREAD:
            return False
        if not _BATCH_DIM["Model"].get(_plain(name)):
            raise InputError(f"engine 'warp' cannot vary {name} between tasks; use --engine=mjx")
        return True

    @cached_property
    def _advance(self) -> Any:
        """Return the function that steps worlds along one leading axis. ``vmap`` extends that axis."""

        @jax.custom_batching.custom_vmap
        def advance(flat: _Flat) -> dict[str, Array]:
            return self._call(flat)

        @advance.def_vmap
        def _(count: int, mapped: Any, flat: _Flat) -> tuple[Any, Any]:
            full = jax.tree.map(lambda x, m: x if m else jnp.broadcast_to(x, (count, *x.shape)), flat, mapped[0])
            new = advance(jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), full))
            apart = {name: x.reshape(count, len(x) // count, *x.shape[1:]) for name, x in new.items()}
            return apart, dict.fromkeys(apart, True)

        return advance

    # What Warp runs.

    @cached_property
    def _first(self) -> "Warp":
        """Return the engine whose memory all equal engines use."""
        return first_of(self._digest, self, lambda call: clear_graphs(call.target))

    @cached_property
    def _calls(self) -> dict[Any, _Call]:
        return {}

    @cached_property
    def _models(self) -> dict[str, Any]:
        return {}

    @cached_property
    def _places(self) -> dict[Any, _Place]:
        return {}

    @cached_property
    def _given(self) -> tuple[str, ...]:
        """Return Warp's names of what a step begins with."""
        return (
            "qpos",
            "qvel",
            "qacc_warmstart",
            "ctrl",
            *["act"] * bool(self.base.na),
            *_MOVED * bool(self.base.nmocap),
        )

    @cached_property
    def _found(self) -> dict[str, int]:
        """Return Warp's names of what a step ends with, and their sizes."""
        model = self.base
        sizes = {"qpos": model.nq, "qvel": model.nv, "qacc_warmstart": model.nv}
        return sizes | {name: n for name, n in (("act", model.na), ("sensordata", model.nsensordata)) if n}

    def _call(self, flat: _Flat) -> dict[str, Array]:
        """Take all substeps of worlds (W, ...); return their new state and sensors by Warp's names."""
        count, names = len(flat.given["qpos"]), tuple(flat.leaves)
        self.provide(count, names)
        call = self._calls[count, names]
        leaves = [leaf.reshape(like.shape) for leaf, like in zip(flat.leaves.values(), call.leaves, strict=True)]
        found = keep(self._first, call.function(*(flat.given[name] for name in self._given), *leaves))
        return dict(zip(self._found, found, strict=True))

    def targets(self) -> dict[str, Any]:
        """Return the arguments of ``provide`` for every call until now, by the call's name in programs."""
        return {call.target.name: [count, list(names)] for (count, names), call in list(self._calls.items())}

    def provide(self, count: int, names: Sequence[str]) -> str:
        """Make the call that steps a number of worlds with these differing leaves; return its name in programs.

        A program that was traced in another process can then run in this one.
        """
        key = count, tuple(names)
        if key not in self._calls:  # else another thread may be noting kernels
            with ALONE:
                model = self._first._make_places(count)
                self._calls[key] = call_of(self._digest, key, partial(self._make_call, model, *key))
        return self._calls[key].target.name

    def load_kernels(self) -> bool:
        """Compile or load all kernels of a step, before programs run that would wait for them.

        Returns:
            whether programs record CUDA graphs when they first run. XLA must then compile nothing at the same time: it
            tries kernels out on the device, and both fail.
        """
        from mujoco.mjx.third_party import mujoco_warp

        counts = sorted({count for count, _ in list(self._calls)})[:1]
        for count, device in itertools.product(counts, own_devices()):
            with ALONE:
                place = self._first._places[device.alias, count]
                kernels = note_kernels(device, partial(mujoco_warp.step, place.model, place.data))
            compile_kernels(device, kernels)  # meanwhile other threads make places and trace, which launches none
        return jax.default_backend() != "cpu"

    def _make_places(self, count: int) -> Any:
        """Make room for a number of worlds on every device; return the model of the first one.

        This is not done when a program runs: Warp then records a graph, and cannot make room.
        """
        devices = own_devices()
        for device in devices:
            if (device.alias, count) not in self._places:
                self._places[device.alias, count] = self._make_place(device, count)
        return self._places[devices[0].alias, count].model

    def _make_place(self, device: Any, count: int) -> _Place:
        """Allocate Warp's memory for a number of worlds, with room for every possible contact."""
        import warp
        from mujoco.mjx.third_party import mujoco_warp

        contacts, rows = self._room
        with warp.ScopedDevice(device):
            if device.alias not in self._models:
                self._models[device.alias] = self._make_model()
            shared = self._models[device.alias]
            model = dataclasses.replace(shared, opt=dataclasses.replace(shared.opt))  # its fields will be of its worlds
            room = {"naconmax": max(count * contacts, 1), "njmax": max(rows, 1)}
            all_move = warp.full(self.base.nbody, 1, dtype=int)
            return _Place(model, mujoco_warp.make_data(self.base, nworld=count, **room), all_move)

    def _make_model(self) -> Any:
        from mujoco.mjx.third_party import mujoco_warp

        model = mujoco_warp.put_model(self.base)
        # To stop after the iterations that are asked for is no fault to print; to run out of room would be.
        unwarned = mujoco_warp.OverflowType.ITERATIONS | mujoco_warp.OverflowType.LS_ITERATIONS
        model.opt.warn_overflow = int(model.opt.warn_overflow & ~unwarned)
        return model

    @cached_property
    def _like(self) -> Any:
        """Return the shapes of MJX's data of the model; None if MJX refuses it."""
        try:
            return jax.eval_shape(partial(mjx_module().make_data, self.base, jax.local_devices()[0], "jax"))._impl
        except (NotImplementedError, ValueError):
            return None

    @cached_property
    def _room(self) -> tuple[int, int]:
        """Return the most contacts and constraint rows that one world can have.

        They are the sizes of MJX's arrays, but some pairs of shapes touch in twice as many points in Warp.
        """
        like = self._like
        if like is None:
            return _ROOM
        slots = like.contact.dist.shape[0]
        doubled = min(slots, _DOUBLED)
        return slots + doubled, like.efc_J.shape[0] + 4 * doubled + (_SPARE if self.base.neq else 0)

    def _make_call(self, model: Any, count: int, names: tuple[str, ...]) -> _Call:
        """Return the JAX function that steps a number of worlds in Warp."""
        import warp

        vectors = {"mocap_pos": warp.vec3, "mocap_quat": warp.quat}
        kinds = {name: warp.array(dtype=vectors.get(name, float), ndim=2) for name in self._given}
        kinds |= {_plain(name): warp.array(dtype=(x := attrgetter(name)(model)).dtype, ndim=x.ndim) for name in names}
        kinds |= {f"new_{name}": warp.array(dtype=float, ndim=2) for name in self._found}
        on_gpu = jax.default_backend() != "cpu"
        mode = warp.JaxCallableGraphMode.WARP if on_gpu else warp.JaxCallableGraphMode.NONE
        step = _stepper(self._digest, count, names)
        step.__qualname__ = f"step_{short_hash(self._digest, count, names)}"  # the call's name is made of it
        target = warp.jax_callable(
            annotated(step, kinds),
            num_outputs=len(self._found),
            graph_mode=mode,
            output_dims={f"new_{name}": (count, size) for name, size in self._found.items()},
        )
        leaves = [_as_warp(count, attrgetter(name)(model)) for name in names]
        shapes = {name: (size,) for name, size in self._found.items()} | {"ctrl": (self.base.nu,)}
        shapes |= {"mocap_pos": (self.base.nmocap, 3), "mocap_quat": (self.base.nmocap, 4)}
        given = [jax.ShapeDtypeStruct((count, *shapes[name]), jnp.float32) for name in self._given]

        def function(*arrays: Array) -> Any:
            target.call_id = 0  # Warp's number of a trace, part of the program: each trace makes the same call
            return target(*arrays)

        jax.eval_shape(function, *given, *leaves)  # so that Warp knows the call if no program is traced
        return _Call(target, function, leaves)

    @cached_property
    def _digest(self) -> str:
        """Return a short hash of all that decides a step, so that calls have the same names in every process."""
        return short_hash("step", saved(self.base), self.num_substeps)


def saved(model: mujoco.MjModel) -> bytes:
    """Return a model as MuJoCo saves it."""
    content = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return content.tobytes()


def short_hash(*about: Any) -> str:
    """Return a hash of plain values, the same in every process."""
    return hashlib.sha256(repr(about).encode()).hexdigest()[:16]


def clear_graphs(target: Any) -> None:
    """Drop the CUDA graphs that Warp has recorded of a call. They use memory of an engine that is gone."""
    target.captures.clear()


def own_devices() -> list[Any]:
    """Return Warp's names of this process's devices."""
    import warp

    return [warp.device_from_jax(device) for device in jax.local_devices()]


def _stepper(engine: str, count: int, names: tuple[str, ...]) -> Callable:
    """Return the function that Warp runs in a call: copy the state in, step, and copy the new state out.

    It finds the engine by its name. Warp keeps such functions for good, but an engine's memory must be freed.
    """
    import warp
    from mujoco.mjx.third_party import mujoco_warp

    fixed = not {"body_pos", "body_quat", "geom_pos", "geom_quat"}.isdisjoint(names)

    def step(*arrays: Any) -> None:
        own = living(engine)
        given, found = own._given, own._found
        model, data, all_move = own._places[arrays[0].device.alias, count]
        for name, array in zip(names, arrays[len(given) :], strict=False):
            *path, field = name.split(".")
            setattr(attrgetter(*path)(model) if path else model, field, array)
        for name, array in zip(given, arrays, strict=False):
            warp.copy(getattr(data, name), array)
        if fixed or own.base.neq:
            mujoco_warp.kinematics(model, data)
        if fixed:
            _place_geoms(model, data, all_move)
        if own.base.neq:  # before Warp computes velocities of bodies, its welds read those of the step before
            mujoco_warp.com_pos(model, data)
            mujoco_warp.com_vel(model, data)
        for _ in range(own.num_substeps):
            mujoco_warp.step(model, data)
        _sense(own.base, model, data)
        for name, array in zip(found, arrays[len(arrays) - len(found) :], strict=True):
            warp.copy(array, getattr(data, name))

    return step


def _sense(base: mujoco.MjModel, model: Any, data: Any) -> None:
    """Update position and velocity sensors to the state after the last substep. Force sensors stay as they are."""
    from mujoco.mjx.third_party.mujoco_warp._src import forward, sensor, smooth

    if np.all(base.sensor_needstage == mujoco.mjtStage.mjSTAGE_ACC):
        return
    involved = np.any(np.isin(base.sensor_type, INVOLVED))
    forward.fwd_kinematics(model, data)
    if involved:
        smooth.transmission(model, data)
    sensor.sensor_pos(model, data)
    (forward.fwd_velocity if involved else smooth.com_vel)(model, data)
    sensor.sensor_vel(model, data)


def _place_geoms(model: Any, data: Any, all_move: Any) -> None:
    """Put all geoms where their bodies are. Warp's kinematics leave those of bodies fixed to the world as they were."""
    import warp
    from mujoco.mjx.third_party.mujoco_warp._src import smooth

    bodies = (model.body_rootid, all_move, model.body_mocapid, model.geom_bodyid, model.geom_pos, model.geom_quat)
    warp.launch(
        smooth._geom_local_to_global,
        dim=(data.nworld, model.ngeom),
        inputs=[*bodies, data.xpos, data.xquat],
        outputs=[data.geom_xpos, data.geom_xmat],
    )


def annotated(function: Callable, kinds: dict[str, Any]) -> Callable:
    """Set the signature of a function of many arrays, from which Warp derives their types for JAX."""
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    parameters = [inspect.Parameter(name, kind, annotation=annotation) for name, annotation in kinds.items()]
    function.__signature__ = inspect.Signature(parameters)  # type: ignore
    function.__annotations__ = dict(kinds)
    return function


def _as_warp(count: int, field: Any) -> jax.ShapeDtypeStruct:
    """Return the shape of a model field of all worlds, which holds Warp's vectors and matrices as further axes."""
    shape = (count, *field.shape[1:], *getattr(field.dtype, "_shape_", ()))
    return jax.ShapeDtypeStruct(shape, jnp.float32)


def _plain(name: str) -> str:
    return name.replace(".", "__")
