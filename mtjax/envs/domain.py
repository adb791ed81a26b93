"""Families of one MuJoCo model: parameters give models, and models give the leaves that differ.

Tasks are built on the host. An ``MjSpec`` is edited and compiled, so that MuJoCo computes every derived field. Then
only the leaves that differ between tasks are stacked.
"""

import abc
import copy
import dataclasses
import hashlib
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from importlib import resources
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from mtjax.envs.contexts import goals
from mtjax.envs.engines.base import ENGINES, Blank, Engine, World, choose_engine
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.mjx import Mjx
from mtjax.envs.engines.warp import Warp
from mtjax.envs.family import Family, draw_until
from mtjax.envs.fields import FIXED, VARIABLE
from mtjax.envs.pixels import Pictured
from mtjax.envs.planar import Planar, is_planar, locate
from mtjax.envs.scenery import Visible
from mtjax.names import nearest_error
from mtjax.types import Array, InputError, Key, Spec, Step, Task, Transition

INTEGRATORS = ("model", "euler")
_RESISTANCES = ("damping", "frictionloss", "armature")
_UNSIGNED = ("body_mass", "geom_friction", "pair_friction", "jnt_stiffness", "tendon_stiffness", "opt.density")
_UNSIGNED += ("opt.viscosity", *(f"{part}_{x}" for part in ("dof", "tendon") for x in _RESISTANCES))
"""Fields in which MuJoCo takes negative numbers, and physics does not."""
_DECIDING = ("dof_frictionloss", "tendon_frictionloss", "opt.density", "opt.viscosity")
"""Fields that decide by being 0 what MJX and Warp make programs of."""


@dataclasses.dataclass(frozen=True)
class Domain(Pictured, Family):
    """A family of tasks of one MuJoCo model. Subclasses give model, start of an episode, observation and reward."""

    engine: Annotated[str, tyro.conf.arg(name="engine", prefix_name=False)] = "auto"
    """Physics engine: auto, mjx (any device), warp (NVIDIA GPUs) or c (MuJoCo's C engine, threaded; CPU only). auto is
    c on a CPU, warp on an NVIDIA GPU if it is installed and faster there, and mjx elsewhere. Runs on c and mjx repeat
    bit for bit; runs on warp do not."""
    solver_iterations: int = 0
    """Iterations of the constraint solver in MJX and Warp, with twice as many line-search steps. 0 takes the domain's
    own choice for the engine."""
    integrator: str = "model"
    """Integrator of MJX and Warp: that of the model (rk4 for cartpole and acrobot), or the faster, less exact euler."""

    model_file: ClassVar[str]  # a file beside the class's own, else in mtjax/envs/models; a path; or the MJCF itself
    num_substeps: ClassVar[int] = 1  # steps of the physics in a control step
    default_iterations: ClassVar[int] = 8  # of MJX, where each costs about as much as the rest of a step
    warp_iterations: ClassVar[int] = 10  # of Warp, where they are cheap
    gpu_engine: ClassVar[str] = "warp"  # what "auto" is on an NVIDIA GPU, as measured: mjx or warp
    unites: ClassVar[bool] = False  # its scene may be part of a union of scenes (``union.compose``)
    starts_untouched: ClassVar[bool] = False  # no force sensor feels anything at a start: it need not be solved for

    def __post_init__(self):
        super().__post_init__()
        if self.engine not in ENGINES:
            raise nearest_error("engine", self.engine, ENGINES)
        if self.integrator not in INTEGRATORS:
            raise nearest_error("integrator", self.integrator, INTEGRATORS)
        if self.solver_iterations < 0:
            raise InputError(f"solver-iterations must be at least 0, not {self.solver_iterations}")

    # What a domain gives.

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Edit the model for all tasks alike, before the parameters edit it."""

    def starts(self, models: Sequence[mujoco.MjModel], random: np.random.Generator) -> np.ndarray | None:
        """Return pools of start states (R, P, nq + nv) for the models, or None if ``start`` draws them itself."""

    @abc.abstractmethod
    def start(self, task: Task, key: Key) -> tuple[Array, ...]:
        """Draw start positions (nq,) and velocities (nv,) of an episode.

        A domain with memory of the episode returns it too, and then, if it moves bodies, their poses (nmocap, 7).
        """

    def control(self, task: Task, world: World, action: Array) -> tuple[World, Array]:
        """Return the world with what an action (A,) sets in it, and the controls (nu,) of the step.

        By default [-1, 1] spans each actuator's ctrlrange. An actuator without one receives the action as it is.
        """
        limited = self.models[0].actuator_ctrllimited[:, None] == 1
        if "actuator_ctrlrange" not in task.model and np.all(~limited | (self.models[0].actuator_ctrlrange == [-1, 1])):
            return world, action
        low, high = jnp.where(limited, self.leaf(task, "actuator_ctrlrange"), jnp.array([-1.0, 1.0])).T
        return world, (low + high) / 2 + (high - low) / 2 * action

    def recall(self, task: Task, obs: Array) -> World:
        """Return a world with the observation ``obs``, exact in all that the reward reads. ``relabel`` needs it."""
        raise NotImplementedError(f"{type(self).__name__} does not say which world an observation shows")

    # What every domain does.

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a fresh random state."""
        put = self.simulator.place if self.starts_untouched else self.simulator.forward
        return self.first_step(task, put(task, *self.start(task, key)), key)

    def first_step(self, task: Task, world: World, key: Key) -> Step:
        """Return the first step of an episode, from a start whose sensors are known and the key of ``reset``."""
        return Step(world, self.look_at(task, world), jnp.float32(0), jnp.bool_(False))

    def advance(self, task: Task, state: World, action: Array) -> World:
        """Return the world after one control step under ``action`` (A,)."""
        return self.simulator.step(task, *self.control(task, state, action))

    def visible(self, task: Task, state: World) -> Visible:
        """Return what a picture shows of a world."""
        return super().visible(task, state)._replace(joints=state.qpos)

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        """Return another task's transition with the reward of ``task``. Observations must not show the goal."""
        world = self.recall(task, transition.next_obs)
        return transition._replace(reward=self.reward(task, world, transition.action))

    def set_physics(self, task: Task, state: World, qpos: Array, qvel: Array) -> World:
        """Return the same state with the given positions (nq,) and velocities (nv,)."""
        as_float = lambda x: jnp.asarray(x, jnp.float32)
        kept = () if state is None else (state.extra, state.mocap)
        return self.simulator.forward(task, as_float(qpos), as_float(qvel), *kept)

    def leaf(self, task: Task, name: str) -> Array:
        """Return a field of the task's compiled model by its name in MJX, such as "geom_size" (ngeom, 3)."""
        if name in task.model:
            return task.model[name]
        return jnp.asarray(getattr(self.models[0], name), jnp.float32)

    def planar(self, task: Task, world: World) -> Planar:
        """Return places and velocities of all bodies of a model that moves in the x-z plane."""
        if not is_planar(self.models[0]):
            raise InputError(f"the model of {type(self).__name__} leaves the x-z plane; declare sensors instead")
        return locate(self.models[0], partial(self.leaf, task), world.qpos, world.qvel)

    def forward_velocity(self, task: Task, world: World) -> Array:
        """Return the velocity () [m/s] along x of the whole model's centre of mass."""
        mass = self.leaf(task, "body_mass")
        return jnp.dot(mass, self.planar(task, world).velocity[:, 0], precision="highest") / jnp.sum(mass)

    def start_apart(self, task: Task, key: Key, draw: Callable[[Key], Array]) -> Array:
        """Draw positions (nq,) again and again until nothing touches."""
        return draw_until(lambda qpos: ~self.simulator.touching(task, qpos), draw, key)

    # Models.

    def _read_model(self) -> mujoco.MjSpec:
        if self.model_file.lstrip().startswith("<"):
            return mujoco.MjSpec.from_string(self.model_file)
        folders = [_folder_of(type(self)), Path(str(resources.files("mtjax.envs") / "models"))]
        paths = [folder / self.model_file for folder in folders]  # an absolute path stands alone
        found = next((path for path in paths if path.is_file()), None)
        if found is None:
            raise InputError(f"there is no model file {str(paths[0])!r}")
        return mujoco.MjSpec.from_file(str(found))

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the editable model with these parameter values. Other parameters keep the model's own."""
        spec = self._read_model()
        self.prepare(spec)
        given = values or {}
        for name, parameter in self.parameters.items():
            if parameter.edit is not None and name in given:
                parameter.edit(spec, float(given[name]))
        return spec

    @cached_property
    def models(self) -> tuple[mujoco.MjModel, ...]:
        """Return the compiled model of every row of the table. Rows that differ only in goals share one."""
        names = [name for name, parameter in self.parameters.items() if parameter.edit is not None]
        return self.variation.for_rows(self._compile, names)

    def _compile(self, values: Mapping[str, float]) -> mujoco.MjModel:
        """Return the compiled model with these parameter values.

        Raises:
            InputError: MuJoCo refuses them, or the model has numbers beyond 32 bits or ones that nature does not have.
        """
        given = ", ".join(f"{name}={value:g}" for name, value in values.items()) or "its own values"
        try:
            model = self.compile_spec(values).compile()
        except ValueError as error:
            reason = str(error).strip().splitlines()[0][:150] if str(error).strip() else "no reason given"
            raise InputError(f"MuJoCo cannot build {type(self).__name__} with {given}: {reason}") from None
        for name in VARIABLE:
            field = np.asarray(attrgetter(name)(model))
            if np.any(np.isfinite(field) & (np.abs(field) > np.finfo(np.float32).max)) or np.any(np.isnan(field)):
                raise InputError(f"{type(self).__name__} with {given} has a {name} beyond 32-bit numbers")
        negative = next((name for name in _UNSIGNED if np.any(np.asarray(attrgetter(name)(model)) < 0)), None)
        if negative is not None:
            told = "give the parameter minimum=0.0, or leave such values out (of held-out tasks by --split=none)"
            raise InputError(f"{type(self).__name__} with {given} has a {negative} below 0; {told}")
        return model

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the "model" and "goal" leaves (R, ...) of every row of the table."""
        leaves = {name: np.float32(leaf) for name, leaf in stack_differing(self.models).items()}
        goal, starts = goals(self), self.starts(self.models, np.random.default_rng(self.task_seed))
        return {"model": leaves, "goal": goal if starts is None else goal | {"starts": np.float32(starts)}}

    @property
    def action_size(self) -> int:  # type: ignore
        """Return the number of motors."""
        return self.models[0].nu

    @property
    def step_seconds(self) -> float:  # type: ignore
        """Return the length of a control step [s]."""
        return self.models[0].opt.timestep * self.num_substeps

    @property
    def engine_name(self) -> str:
        """Return the name of the engine that runs this family on this device."""
        sized = "site_size" in self.table.tasks.model  # which Warp cannot vary
        return choose_engine(self.engine, "mjx" if sized else self.gpu_engine)

    @cached_property
    def simulator(self) -> Engine:
        """Return the engine that runs this family. MuJoCo C keeps the model's own solver settings.

        Raises:
            InputError: the engine cannot run the model.
        """
        if self.engine_name == "c":
            return MujocoC(self.models, self.num_substeps)
        if self.engine_name == "warp":
            return Warp(self._base(self.warp_iterations), self.num_substeps)
        self.mjx.require_runnable()
        return self.mjx

    @cached_property
    def structure(self) -> tuple[Any, ...] | None:
        """Return what domains must have in common for one engine to step all of them; None to stay alone.

        Their models may differ in numbers only, as those of tasks.
        """
        plain = type(self).step is Domain.step and type(self).advance is Domain.advance
        if self.repeat != 1 or not plain:  # more than control, physics and outcome
            return None
        model = self.models[0] if isinstance(self.simulator, MujocoC) else self.simulator.base
        fixed = hashlib.sha256()
        for name in FIXED:
            field = np.asarray(attrgetter(name)(model))
            fixed.update(repr((name, field.shape)).encode() + field.tobytes())
        if not isinstance(self.simulator, MujocoC):
            fixed.update(repr([np.asarray(attrgetter(path)(model) > 0).tolist() for path in _DECIDING]).encode())
        return self.engine_name, self.num_substeps, fixed.digest()

    def join_simulator(self, models: Sequence[mujoco.MjModel]) -> Engine:
        """Return the engine of several domains of this structure, with the models of all their rows; this one's first.

        MuJoCo C holds the models. MJX and Warp receive the fields in which they differ with every step.
        """
        return MujocoC(models, self.num_substeps) if self.engine_name == "c" else self.simulator

    @cached_property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context. To trace the engine for them would take seconds."""
        blank = without_physics(self)
        return super(Domain, blank).spec

    @property
    def outside(self) -> Warp | MujocoC | None:
        """Return the engine if it runs outside XLA, as all but MJX do."""
        return self.simulator if isinstance(self.simulator, Warp | MujocoC) else None

    @cached_property
    def mjx(self) -> Mjx:
        """Return the MJX engine of this family."""
        return Mjx(self._base(self.default_iterations), self.num_substeps)

    def _base(self, iterations: int) -> mujoco.MjModel:
        """Return the first task's model with the solver settings of MJX or Warp.

        What they leave out of a program if the model has none of it is there if any task has it.
        """
        base = copy.copy(self.models[0])
        for path in _DECIDING:
            largest = np.max([attrgetter(path)(model) for model in self.models], axis=0)
            *owner, field = path.split(".")
            setattr(attrgetter(*owner)(base) if owner else base, field, largest)
        base.opt.iterations = self.solver_iterations or iterations
        base.opt.ls_iterations = 2 * base.opt.iterations
        if self.integrator == "euler":
            base.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
        return base


def without_physics(domain: Domain) -> Domain:
    """Return the same domain, with the same table, on an engine whose worlds stand still: for shapes alone."""
    blank = copy.copy(domain)
    vars(blank).update(table=domain.table, models=domain.models, simulator=Blank(domain.models[0]))
    return blank


def _folder_of(family: type) -> Path:
    """Return the folder of the file in which a class gives its model; in a notebook the working directory."""
    cls = next(cls for cls in family.__mro__ if "model_file" in vars(cls))
    file = getattr(sys.modules.get(cls.__module__), "__file__", None)
    return Path(file).parent if file else Path.cwd()


def stack_differing(models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
    """Stack the fields that differ between compiled models into arrays (R, ...), by MJX name ("opt.gravity").

    Raises:
        InputError: a field differs that must be the same in all tasks. The message names field and task.
    """
    first = {}  # model -> the first task that has it; many tasks may share one
    for task, model in enumerate(models):
        first.setdefault(id(model), task)
    unique = [models[task] for task in first.values()]
    place = {identity: i for i, identity in enumerate(first)}
    places = [place[id(model)] for model in models]
    differing = {}
    for name in (*FIXED, *VARIABLE):
        column = [attrgetter(name)(model) for model in unique]
        odd = _first_unlike(column)
        if odd is None:
            continue
        if name in FIXED:
            task = first[id(unique[odd])]
            raise InputError(f"task {task} changes {name}, which must be the same in every task")
        differing[name] = np.stack(column)[places]
    for name in {"dof_frictionloss", "tendon_frictionloss"} & set(differing):
        loss = differing[name]  # MJX solves a friction row of exactly 0 as a rigid joint
        differing[name] = np.where(np.any(loss > 0, axis=0), np.maximum(loss, 1e-8), loss)
    return differing


def _first_unlike(column: Sequence[Any]) -> int | None:
    """Return the index of the first value or array that differs from the first one."""
    if not isinstance(column[0], np.ndarray):
        return next((i for i, x in enumerate(column) if x != column[0]), None)
    reshaped = next((i for i, x in enumerate(column) if x.shape != column[0].shape), None)
    if reshaped is not None:
        return reshaped
    unlike = np.any((np.stack(column) != column[0]).reshape(len(column), -1), axis=1)
    return int(np.argmax(unlike)) if np.any(unlike) else None


def start_joints(model: mujoco.MjModel, key: Key) -> Array:
    """Draw joint positions (nq,) as dm_control does: limited joints in their range, free hinges in [-pi, pi].

    Free joints stay in their place, turned by a quaternion of four numbers in [0, 1].
    """
    kinds = mujoco.mjtJoint
    ends, turned = np.stack([model.qpos0, model.qpos0], axis=-1), []
    for place, kind, limited, limits in zip(
        model.jnt_qposadr, model.jnt_type, model.jnt_limited, model.jnt_range, strict=True
    ):
        if kind == kinds.mjJNT_FREE:
            turned.append(slice(place + 3, place + 7))
            ends[turned[-1]] = [0, 1]
        elif limited or kind == kinds.mjJNT_HINGE:
            ends[place] = limits if limited else [-np.pi, np.pi]
    qpos = jax.random.uniform(key, (model.nq,), jnp.float32, *jnp.asarray(ends.T, jnp.float32))
    for quat in turned:
        qpos = qpos.at[quat].divide(jnp.linalg.norm(qpos[quat]))
    return qpos
