"""Families of one MuJoCo model: parameters give models, and models give the leaves that differ.

Tasks are built on the host. An ``MjSpec`` is edited and compiled, so that MuJoCo computes every derived field. Then
only the leaves that differ between tasks are stacked.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro

from mtjax.checks import require_not_negative
from mtjax.envs import physics
from mtjax.envs.compiled import compile_model, read_model, stack_differing
from mtjax.envs.contexts import goals
from mtjax.envs.engines.base import ENGINES, Engine, World, choose_engine
from mtjax.envs.family import Family, draw_until
from mtjax.envs.pixels import Pictured
from mtjax.names import nearest_error
from mtjax.types import Array, Key, Step, Task, Transition

INTEGRATORS = ("model", "euler")


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

    # A file beside the class's own, else in mtjax/envs/models; a path; the MJCF itself; or a function that returns it.
    model_file: ClassVar[str | Callable[[], mujoco.MjSpec]]
    num_substeps: ClassVar[int] = 1  # steps of the physics in a control step
    default_iterations: ClassVar[int] = 8  # of MJX, where each costs about as much as the rest of a step
    warp_iterations: ClassVar[int] = 10  # of Warp, where they are cheap
    gpu_engine: ClassVar[str] = "warp"  # what "auto" is on an NVIDIA GPU, as measured: mjx or warp
    unites: ClassVar[bool] = False  # its scene may be part of a union of scenes (``union.compose``)
    simplify: ClassVar[Callable[[mujoco.MjModel], None] | None] = None  # edits the model of MJX and Warp alone
    starts_untouched: ClassVar[bool] = False  # no force sensor feels anything at a start: it need not be solved for

    def __post_init__(self):
        super().__post_init__()
        if self.engine not in ENGINES:
            raise nearest_error("engine", self.engine, ENGINES)
        if self.integrator not in INTEGRATORS:
            raise nearest_error("integrator", self.integrator, INTEGRATORS)
        require_not_negative(self, "solver_iterations")

    # What a domain gives.

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Edit the model for all tasks alike, before the parameters edit it."""

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

    def leaf(self, task: Task, name: str) -> Array:
        """Return a field of the task's compiled model by its name in MJX, such as "geom_size" (ngeom, 3)."""
        if name in task.model:
            return task.model[name]
        return jnp.asarray(getattr(self.models[0], name), jnp.float32)

    # Models.

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the editable model with these parameter values. Other parameters keep the model's own."""
        spec = read_model(self)
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
        return self.variation.for_rows(partial(compile_model, self), names)

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the "model" and "goal" leaves (R, ...) of every row of the table."""
        leaves = {name: np.float32(leaf) for name, leaf in stack_differing(self.models).items()}
        return {"model": leaves, "goal": goals(self)}

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
    def simulator(self) -> Engine:  # type: ignore[override]
        """Return the engine that runs this family.

        Raises:
            InputError: the engine cannot run the model.
        """
        return physics.make_engine(self)

    without_physics = physics.without_physics


def start_apart(domain: Domain, task: Task, key: Key, draw: Callable[[Key], Array]) -> Array:
    """Draw positions (nq,) again and again until nothing touches."""
    return draw_until(lambda qpos: ~domain.simulator.touching(task, qpos), draw, key)


def rewarded(domain: Domain, task: Task, transition: Transition, world: World) -> Transition:
    """Return a transition with the reward of ``task``, as ``Domain.relabel`` may where observations show no goal.

    Args:
        world: one that ``transition.next_obs`` shows, exact in all that the reward reads.
    """
    return transition._replace(reward=domain.reward(task, world, transition.action))


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
