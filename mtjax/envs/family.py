"""A family of MuJoCo tasks: one model, one varying parameter, and a table with a row for every task.

Tasks are built on the host by editing an ``MjSpec`` and compiling it, so that every derived field is MuJoCo's own;
then only the leaves that differ between tasks are stacked. Nothing here loops over tasks once a program runs.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from importlib import resources
from typing import Annotated, Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from mtjax.envs.physics import ENGINES, Engine, Mjx, MujocoC, World, choose_engine, mjx_module
from mtjax.types import SPLITS, Array, InputError, Key, Spec, Step, Task

SCHEMES = ("dense", "hip-bmdp")
_HIP_BMDP = {"train": (3, 4, 7, 8), "interpolation": (5, 6), "extrapolation": (2, 9)}
# Fields of the model that never reach the dynamics: statistics, and what only a renderer reads.
_UNUSED = ("stat", "cam_", "light_", "mat_", "tex_", "name", "_", "signature", "geom_rgba")


class Parameter(NamedTuple):
    """A physical quantity that may differ between tasks."""

    unit: str
    nominal: float  # the value in the unedited model
    minimum: float  # values must be greater than this
    edit: Callable[[mujoco.MjSpec, float], None]  # writes the value into a spec, before it is compiled


class Table(NamedTuple):
    """Every task of a family: training tasks first, then interpolation, then extrapolation."""

    tasks: Task  # leading axis: all rows; on the host
    rows: Mapping[str, np.ndarray]  # split -> row numbers
    models: tuple[mujoco.MjModel, ...]  # one a row


@dataclasses.dataclass(frozen=True)
class Family(abc.ABC):
    """Tasks that differ in one parameter of one MuJoCo model. Subclasses give the model, observation and reward."""

    vary: str = "size"
    """The parameter that differs between tasks."""
    low: float = 1.0
    """Its value in the first training task."""
    high: float = 1.0
    """Its value in the last training task."""
    num_tasks: int = 1
    """Training tasks, evenly spaced from low to high."""
    values: tuple[float, ...] = ()
    """The parameter's values, increasing, instead of low, high and num-tasks."""
    split: Annotated[str, tyro.conf.arg(name="split", prefix_name=False)] = "dense"
    """Which tasks train and which are held out: dense (train on all values; test between and beyond them) or hip-bmdp
    (of ten values train on numbers 3, 4, 7 and 8 counted from 0; interpolation 5, 6; extrapolation 2, 9)."""
    engine: Annotated[str, tyro.conf.arg(name="engine", prefix_name=False)] = "auto"
    """Physics engine: auto, mjx (any device) or c (MuJoCo's C engine, threaded; CPU only). Auto is c on a CPU."""
    solver_iterations: int = 0
    """Constraint solver iterations of MJX, and twice as many line-search steps; 0 is the domain's own choice."""

    parameters: ClassVar[Mapping[str, Parameter]]
    model_file: ClassVar[str]
    num_substeps: ClassVar[int]
    episode_steps: ClassVar[int]
    default_iterations: ClassVar[int]
    starts_untouched: ClassVar[bool] = False  # no force sensor feels anything when an episode begins

    def __post_init__(self):
        if self.vary not in self.parameters:
            raise InputError(f"unknown parameter {self.vary!r}; this domain can vary {', '.join(self.parameters)}")
        if self.split not in SCHEMES:
            raise InputError(f"unknown split {self.split!r}; choose from {', '.join(SCHEMES)}")
        if self.engine not in ENGINES:
            raise InputError(f"unknown engine {self.engine!r}; choose from {', '.join(ENGINES)}")
        if self.num_tasks < 1 or self.solver_iterations < 0:
            raise InputError("num-tasks must be at least 1 and solver-iterations at least 0")
        if not self.values and self.num_tasks > 1 and not self.low < self.high:
            raise InputError(f"low ({self.low}) must be less than high ({self.high}) where there are several tasks")
        values = self.listed_values
        if values[0] <= self.parameters[self.vary].minimum or not np.all(np.isfinite(values)):
            raise InputError(f"{self.vary} must be greater than {self.parameters[self.vary].minimum}, not {values[0]}")
        if np.any(np.diff(values) <= 0):
            raise InputError(f"the values of {self.vary} must increase, and these do not: {self.values}")
        if self.split == "hip-bmdp" and len(values) != 10:
            raise InputError(f"split hip-bmdp numbers ten tasks, and this family has {len(values)}; use --split=dense")

    # What a domain gives.

    def prepare(self, spec: mujoco.MjSpec) -> None:  # noqa: B027 - most domains share nothing more
        """Edit the model in the way that all tasks share."""

    @abc.abstractmethod
    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        """Draw the positions (nq,) and velocities (nv,) in which an episode begins."""

    @abc.abstractmethod
    def observe(self, task: Task, world: World) -> Array:
        """Return the observation (O,) of a world."""

    @abc.abstractmethod
    def reward(self, task: Task, world: World, action: Array) -> Array:
        """Return the reward () of having arrived in a world."""

    # What every domain does.

    def tasks(self, split: str = "train") -> Task:
        """Return the tasks of a split: "train", "interpolation", "extrapolation", or "all" rows of the table."""
        rows = {**self.table.rows, "all": slice(None)}
        if split not in rows:
            raise InputError(f"unknown split {split!r}; choose from {', '.join(rows)}")
        return jax.tree.map(lambda x: jnp.asarray(x[rows[split]]), self.table.tasks)

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a fresh random state."""
        put = self.simulator.place if self.starts_untouched else self.simulator.forward
        world = put(task, *self.start(task, key))
        return Step(world, self.observe(task, world), jnp.float32(0), jnp.bool_(False))

    def step(self, task: Task, state: World, action: Array) -> Step:
        """Advance one control step under ``action`` (A,) in [-1, 1]; observation and reward are those after it."""
        world = self.simulator.step(task, state, action)
        return Step(world, self.observe(task, world), self.reward(task, world, action), jnp.bool_(False))

    def set_physics(self, task: Task, state: World, qpos: Array, qvel: Array) -> World:
        """Return the same state with the given positions (nq,) and velocities (nv,)."""
        del state  # a world is its physical state and what follows from it
        return self.simulator.forward(task, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))

    @property
    def episode_length(self) -> int:
        """Steps after which an episode is cut off."""
        return self.episode_steps

    @property
    def spec(self) -> Spec:
        """Sizes of observation, action and context."""
        return self._spec

    @cached_property
    def _spec(self) -> Spec:
        task = jax.tree.map(lambda x: x[0], self.table.tasks)
        step = jax.eval_shape(self.reset, task, jax.eval_shape(jax.random.key, 0))
        return Spec(step.obs.shape[0], self.table.models[0].nu, task.context.shape[0])

    @cached_property
    def listed_values(self) -> np.ndarray:
        """The parameter's values as listed, before the split decides which of them train."""
        return np.asarray(self.values or np.linspace(self.low, self.high, self.num_tasks), np.float64)

    @cached_property
    def table(self) -> Table:
        """Compile every task of every split."""
        parameter = self.parameters[self.vary]
        values = split_values(self.split, self.listed_values, parameter.minimum)
        everything = np.concatenate([values[s] for s in SPLITS])
        models = tuple(self._compile(value) for value in everything)
        leaves: dict[str, Any] = {
            "id": np.arange(len(everything), dtype=np.int32),
            "context": np.float32(scale(everything, values["train"])[:, None]),
            "params": {self.vary: np.float32(everything)},
            "model": {name: np.float32(leaf) for name, leaf in stack_differing(models).items()},
            "goal": {},
        }
        ends = np.cumsum([len(values[s]) for s in SPLITS])
        rows = {s: np.arange(end - len(values[s]), end) for s, end in zip(SPLITS, ends, strict=True)}
        return Table(Task(**leaves), rows, models)

    def compile_spec(self, value: float) -> mujoco.MjSpec:
        """Return the editable model of the task with this parameter value."""
        file = resources.files("mtjax.envs") / "models" / self.model_file
        spec = mujoco.MjSpec.from_string(file.read_text())
        self.prepare(spec)
        self.parameters[self.vary].edit(spec, float(value))
        return spec

    def _compile(self, value: float) -> mujoco.MjModel:
        return self.compile_spec(value).compile()

    @cached_property
    def simulator(self) -> Engine:
        """The engine that runs this family; MuJoCo C keeps the model's own solver settings."""
        if choose_engine(self.engine) == "c":
            return MujocoC(self.table.models, self.num_substeps)
        return self.mjx

    @cached_property
    def mjx(self) -> Mjx:
        """The MJX engine of this family, which also answers questions of geometry for the other one."""
        base = self._compile(self.listed_values[0])
        base.opt.iterations = self.solver_iterations or self.default_iterations
        base.opt.ls_iterations = 2 * base.opt.iterations
        return Mjx(base, self.num_substeps)


def scale(values: np.ndarray, train: np.ndarray) -> np.ndarray:
    """Map values so that the training range becomes [-1, 1]; a range of one value becomes 0."""
    centre, half = (train[0] + train[-1]) / 2, (train[-1] - train[0]) / 2
    return (values - centre) / half if half else values - centre


def split_values(scheme: str, values: np.ndarray, minimum: float) -> dict[str, np.ndarray]:
    """Choose the parameter values of each split.

    ``dense``: train on all values; interpolation is the midpoints between neighbours; extrapolation one and two steps
    beyond each end, where a step is that end's spacing. Steps that leave the parameter's range are left out.
    ``hip-bmdp`` (Zhang et al. 2021, by the indices of MTRL's configuration): of ten values.
    """
    if scheme == "hip-bmdp":
        return {name: values[list(indices)] for name, indices in _HIP_BMDP.items()}
    gaps = np.diff(values)
    beyond = np.zeros(0)
    if len(gaps):
        first, last = gaps[0], gaps[-1]
        beyond = np.array([values[0] - 2 * first, values[0] - first, values[-1] + last, values[-1] + 2 * last])
        beyond = beyond[beyond > minimum + 1e-9]
    return {"train": values, "interpolation": values[:-1] + gaps / 2, "extrapolation": beyond}


def stack_differing(models: Sequence[mujoco.MjModel]) -> dict[str, np.ndarray]:
    """Stack the fields that differ between compiled models into arrays (T, ...), by MJX name ("opt.gravity").

    Raises:
        InputError: a field differs that one program cannot hold in several versions; it names field and task.
    """
    mjx = mjx_module()
    differing = {}
    for owner, prefix, read in ((mjx.Model, "", lambda m: m), (mjx.Option, "opt.", lambda m: m.opt)):
        for field in dataclasses.fields(owner):
            if not hasattr(read(models[0]), field.name) or field.name.startswith(_UNUSED) or field.name == "opt":
                continue
            column = [np.asarray(getattr(read(m), field.name)) for m in models]
            odd = next((i for i, x in enumerate(column) if not np.array_equal(x, column[0])), None)
            if odd is None:
                continue
            # MJX keeps site sizes out of its traced leaves but reads them as values only (touch sensors).
            if "Array" not in str(field.type) and field.name != "site_size":
                raise InputError(f"task {odd} changes {prefix}{field.name}, which must be the same in every task")
            differing[prefix + field.name] = np.stack(column)
    loss = differing.get("dof_frictionloss")
    if loss is not None:  # MJX solves a friction row of exactly 0 as a rigid joint
        differing["dof_frictionloss"] = np.where(np.any(loss > 0, axis=0), np.maximum(loss, 1e-8), loss)
    return differing


def start_joints(model: mujoco.MjModel, key: Key) -> Array:
    """Draw joint positions as dm_control does: limited joints in their range, free hinges in [-pi, pi] (nq,)."""
    limited = model.jnt_limited.astype(bool)
    hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    default = np.stack([model.qpos0, model.qpos0], axis=-1)
    ends = np.where(limited[:, None], model.jnt_range, np.where(hinge[:, None], [-np.pi, np.pi], default))
    return jax.random.uniform(key, (model.nq,), jnp.float32, *jnp.asarray(ends.T, jnp.float32))
