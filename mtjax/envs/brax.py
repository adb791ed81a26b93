"""Families of tasks with Brax's own environments and physics. Brax is imported only when one of them is made.

The physical parameters reach Brax as leaves of its ``System``, which is replaced inside ``reset`` and ``step``.
"""

import contextlib
import copy
import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from importlib.util import find_spec
from operator import attrgetter
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.engines.base import mjx_module
from mtjax.envs.family import Family
from mtjax.envs.parameters import Parameter, positive
from mtjax.envs.scenery import Visible
from mtjax.names import nearest_error
from mtjax.types import Array, InputError, Key, Step, Task

BACKENDS = ("generalized", "positional", "spring", "mjx")
NAMES = (
    "ant",
    "fast",
    "halfcheetah",
    "hopper",
    "humanoid",
    "humanoidstandup",
    "inverted_double_pendulum",
    "inverted_pendulum",
    "pusher",
    "reacher",
    "walker2d",
)
_REFUSED = {
    "swimmer": "its fluid forces call jax.numpy.clip with an argument, a_min, that no jax of version 0.10 or later has",
}
_ASKS = {
    "ant": "Make the ant run to the right.",
    "fast": "Do anything.",
    "halfcheetah": "Make the half-cheetah run forwards.",
    "hopper": "Make the one-legged hopper hop forwards.",
    "humanoid": "Make the humanoid run forwards.",
    "humanoidstandup": "Make the humanoid stand up.",
    "inverted_double_pendulum": "Balance two poles on top of each other on the cart.",
    "inverted_pendulum": "Balance the pole on the cart.",
    "pusher": "Push the object to the goal with the arm.",
    "reacher": "Reach the target with the arm.",
    "walker2d": "Make the two-legged walker walk forwards.",
}
_SPEED_CONTROL_COST = 0.05
# What a step of MJX reads from the last state. It computes everything else anew.
_MJX_KEPT = ("x", "qpos", "qvel", "qacc_warmstart")


# What is seen of Brax's worlds.


def _has_sights(family: "Brax") -> bool:
    """Return whether there is anything to see."""
    return family.environment != "fast"


def _control_seconds(family: "Brax") -> float:
    """Return the length of a control step [s]."""
    return float(family.original.dt)


def _scene_model(family: "Brax", row: int) -> mujoco.MjModel:
    """Return Brax's model of MuJoCo. What can vary does not show."""
    return copy.copy(family.original.sys.mj_model)


def _visible(family: "Brax", task: Task, state: Any) -> Visible:
    """Return the joints of a world, which all backends have."""
    return Visible(state["qpos"] if family._is_mjx else state.q)


@dataclasses.dataclass(frozen=True)
class Brax(Family):
    """Brax: an environment of Brax as it is.

    Observation (O,), after the step: Brax's own (brax.envs).
    Action (A,): in [-1, 1], Brax's own.
    Reward: Brax's own. With the action a, the velocity v [m/s] of the torso along x over the step (in humanoid that of
        the centre of mass), and places [m] after the step (in pusher those before it),
            r = v + 1 - 0.5 |a|^2  (ant)
            r = x  (fast: how far along x it is)
            r = v - 0.1 |a|^2  (halfcheetah)
            r = v + 1 - 0.001 |a|^2  (hopper, walker2d)
            r = 1.25 v + 5 - 0.016 |a|^2  (humanoid)
            r = z / 0.015 + 1 - 0.0016 |a|^2  (humanoidstandup: z is the height of the torso)
            r = 10 u - 0.01 x^2 - (z - 2)^2 - 0.001 omega_1^2 - 0.005 omega_2^2  (inverted_double_pendulum)
            u = 1 if z > 1, else 0  (its upper pole's end is at x and z, its joints turn at omega)
            r = 1  (inverted_pendulum)
            r = -|object - goal| - 0.5 |object - tip| - 0.4 |a|^2  (pusher)
            r = -|tip - target| - |a|^2  (reacher)
        Where Brax charges for the motors' commands, which are 0.4 a in both humanoids and 2 a in pusher, the weights
        here are those of a.
    Start: Brax's own, drawn anew for every episode.
    Episode: Brax's own termination, such as a fall of the ant, ends an episode for good; at 1000 steps, Brax's episode
        length, it is cut off.

    Parameters that can vary, while all others stay as Brax has them:
        mass: scale of the masses and inertias of all links; joints' armature stays.
        gravity: acceleration downwards [m/s^2]. In pusher it is nominally absent.
        friction: scale of the sliding friction of all geoms.

    Backends: generalized (joint coordinates; Brax's own default), mjx (MuJoCo's JAX port), spring and positional
        (maximal coordinates). They disagree by design: spring and positional run other time steps, gears and masses.
        They raise masses to a power of the model's choosing, to 0 for the ant, and so refuse to vary the mass.
        Over 20 steps of the half-cheetah, mjx stays within 1e-5 [m or rad] of MuJoCo's C engine, the others within 0.1
        to 1. On a CPU spring steps ant and half-cheetah twice as fast as generalized; mjx the ant twice as fast (Brax
        grants it one solver iteration) and the half-cheetah at less than a third of that speed (four).

    Differs from Brax in: matrix products are always in full float32; episodes begin in fresh random states instead of
    repeating the first; metrics are not kept. Swimmer is missing, as Brax 0.14 cannot step it with jax 0.10 or later.
    """

    environment: str = "ant"
    """Brax's name of the environment."""
    backend: str = "generalized"
    """Brax's physics: generalized, positional, spring or mjx."""

    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {"mass": positive("1", 1.0), "gravity": positive("m/s^2", 9.81), "friction": positive("1", 1.0)}
    )
    episode_steps: ClassVar[int] = 1000
    names: ClassVar[tuple[str, ...]] = NAMES

    def __post_init__(self):
        super().__post_init__()
        if self.environment in _REFUSED:
            raise InputError(f"Brax's {self.environment} does not run here: {_REFUSED[self.environment]}")
        for kind, given, allowed in (
            ("environment", self.environment, self.names),
            ("backend", self.backend, BACKENDS),
        ):
            if given not in allowed:
                raise nearest_error(f"Brax {kind}", given, allowed)
        varied = self.variation.names
        if self.environment == "fast" and varied:
            raise InputError(f"Brax's fast has no physics, so its {varied[0]} cannot vary")
        if "mass" in varied and self.backend in ("positional", "spring"):
            raise InputError(f"backend {self.backend} distorts masses; to vary the mass use generalized or mjx")
        if find_spec("brax") is None:
            raise InputError("Brax is not installed; pip install brax")

    @property
    def instruction(self) -> str:
        """Return what all tasks ask for."""
        return _ASKS[self.environment] if type(self) is Brax else super().instruction

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode of ``task`` in a fresh random state."""
        with jax.default_matmul_precision("highest"):
            start = self._edited(task).reset(key)
        return Step(self._pack(start.pipeline_state), strong(start.obs), jnp.float32(0), jnp.bool_(False))

    def step(self, task: Task, state: Any, action: Array) -> Step:
        """Advance one control step under ``action`` (A,) in [-1, 1]; observation and reward are those after it."""
        with jax.default_matmul_precision("highest"):
            new = self._edited(task).step(self._unpack(state), action)
        reward = self.reward(task, new.metrics, new.reward, action)
        return Step(self._pack(new.pipeline_state), strong(new.obs), strong(reward), strong(new.done > 0))

    def set_physics(self, task: Task, state: Any, qpos: Array, qvel: Array) -> Any:
        """Return the state with the given positions (nq,) and velocities (nv,)."""
        del state  # a world is its physical state and what follows from it
        with jax.default_matmul_precision("highest"):
            return self._pack(self._edited(task).pipeline_init(jnp.float32(qpos), jnp.float32(qvel)))

    def reward(self, task: Task, metrics: Mapping[str, Array], reward: Array, action: Array) -> Array:
        """Return the reward () of a step from Brax's ``metrics`` and its own ``reward``."""
        return reward

    def build(self) -> dict[str, dict[str, np.ndarray]]:
        """Return the leaves of the table, with the values that MuJoCo derives from each task's masses."""
        leaves = super().build()
        masses = self.variation.values.get("mass")
        if masses is not None:
            weights = [inverse_weights(self.original.sys.mj_model, mass) for mass in masses]
            leaves["model"] = {name: np.stack([w[name] for w in weights]) for name in weights[0]}
        return leaves

    @property
    def engine_name(self) -> str:
        """Return the name of Brax's backend."""
        return self.backend

    films = property(_has_sights)  # type: ignore
    seconds_per_step = property(_control_seconds)
    scene_model, visible = _scene_model, _visible

    @cached_property
    def action_size(self) -> int:  # type: ignore
        """Return the number of actions A."""
        return self.original.action_size

    @cached_property
    def original(self) -> Any:
        """Return Brax's own environment with its unedited system."""
        with _without_remarks(), jax.ensure_compile_time_eval():
            return brax_module().envs.get_environment(self.environment, backend=self.backend)

    def _edited(self, task: Task) -> Any:
        """Return Brax's environment with the system of a task. It may hold tracers, so never keep it."""
        environment = copy.copy(self.original)
        for name in task.params:
            if name in _EDITS:
                environment.sys = environment.sys.tree_replace(_EDITS[name](environment.sys, task))
        return environment

    def _pack(self, physics: Any) -> Any:
        """Return the part of Brax's physical state that the next step needs."""
        kept = {name: getattr(physics, name) for name in _MJX_KEPT} if self._is_mjx else physics
        return jax.tree.map(strong, kept)

    def _unpack(self, state: Any) -> Any:
        """Return Brax's environment state with empty reports."""
        physics = self._blank.replace(**state) if self._is_mjx else state
        zero = jnp.float32(0)
        return brax_module().envs.State(physics, obs=None, reward=zero, done=zero, metrics={}, info={})

    @property
    def _is_mjx(self) -> bool:
        return self.backend == "mjx" and self.environment != "fast"

    @cached_property
    def _blank(self) -> Any:
        """Return MJX's data with 0 in every field that a step computes anew."""
        shapes = jax.eval_shape(self.original.reset, jax.eval_shape(jax.random.key, 0)).pipeline_state
        with jax.ensure_compile_time_eval():
            return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)


@dataclasses.dataclass(frozen=True)
class BraxAntDirection(Brax):
    """Brax's ant must run in a given direction.

    As Brax's ant in everything but the reward. An episode ends where the torso is lower than 0.2 m or higher than 1 m.

    Reward: with the torso's velocity v over the step [m/s], the direction theta and the action a,
            r = v_x cos theta + v_y sin theta + 1 - 0.5 |a|^2
        Survival and control are those of Brax's ant, which direction 0 gives back.

    Parameters that can vary beside those of Brax:
        direction: angle [rad] of the direction to run in, from the x axis, in (-pi, pi].

    Differs from "ant-dir" of PEARL (Rakelly et al. 2019) in: no cost of contact, and steps of 1000 an episode instead
    of 200; there directions are uniform on the circle. MAML (Finn et al. 2017) only runs forwards or backwards, with
    other weights: survival 0.05, control 0.005.
    """

    asks: ClassVar[str] = "Make the ant run in the given direction."
    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType(
        {**Brax.parameters, "direction": Parameter("rad", 0.0, minimum=-np.pi, maximum=np.pi)}
    )
    names: ClassVar[tuple[str, ...]] = ("ant",)

    def reward(self, task: Task, metrics: Mapping[str, Array], reward: Array, action: Array) -> Array:
        angle = task.goal["direction"]
        along = jnp.cos(angle) * metrics["x_velocity"] + jnp.sin(angle) * metrics["y_velocity"]
        return along + metrics["reward_survive"] + metrics["reward_ctrl"]


@dataclasses.dataclass(frozen=True)
class BraxHalfcheetahSpeed(Brax):
    """Brax's half-cheetah must run at a given speed.

    As Brax's halfcheetah in everything but the reward.

    Reward: with the torso's velocity v along x over the step [m/s] and the action a,
            r = -|v - speed| - 0.05 |a|^2
        as in MAML (Finn et al. 2017) and PEARL (Rakelly et al. 2019). Brax's own half-cheetah pays 0.1 |a|^2.

    Parameters that can vary beside those of Brax:
        speed: velocity of the torso to run at [m/s], forwards.

    Differs from "half-cheetah-vel" of MAML and PEARL in: 1000 steps an episode instead of 200; MAML takes the velocity
    of the centre of mass. Their speeds are uniform in [0, 2] (MAML) and [0, 3] (PEARL).
    """

    environment: str = "halfcheetah"

    asks: ClassVar[str] = "Make the half-cheetah run at the given speed."
    parameters: ClassVar[Mapping[str, Parameter]] = MappingProxyType({**Brax.parameters, "speed": positive("m/s", 1.0)})
    names: ClassVar[tuple[str, ...]] = ("halfcheetah",)

    def reward(self, task: Task, metrics: Mapping[str, Array], reward: Array, action: Array) -> Array:
        miss = jnp.abs(metrics["x_velocity"] - task.goal["speed"])
        return -miss - _SPEED_CONTROL_COST * jnp.sum(action**2)


def brax_module() -> Any:
    """Import Brax.

    Raises:
        InputError: Brax is installed but cannot be imported.
    """
    mjx_module()  # so that its remark on standard output is not printed
    try:
        import brax.envs
    except ImportError as error:
        raise InputError(f"Brax cannot be imported ({error}); pip install brax") from error
    return brax


@contextlib.contextmanager
def _without_remarks() -> Iterator[None]:
    """Suppress the known remarks of loading a Brax model, and nothing else."""

    def note(text: str) -> None:  # without this, MuJoCo also writes a file into the working directory
        if "settotalmass" not in text:
            warnings.warn(text, stacklevel=2)

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(note)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Brax System, piplines and environments are not", UserWarning)
            yield
    finally:
        mujoco.set_mju_user_warning(before)


def inverse_weights(model: mujoco.MjModel, mass: float) -> dict[str, np.ndarray]:
    """Return the inverse weights of ``model``, with all masses and inertias scaled by ``mass``.

    MuJoCo regularises constraints by them.
    """
    scaled = copy.copy(model)
    scaled.body_mass *= mass
    scaled.body_inertia *= mass
    mujoco.mj_setConst(scaled, mujoco.MjData(scaled))
    return {name: np.array(getattr(scaled, name), np.float32) for name in ("body_invweight0", "dof_invweight0")}


def strong(x: Any) -> Array:
    """Return the array with a dtype that is not weak, because the carry of a scan needs one."""
    return jax.lax.convert_element_type(x, jnp.asarray(x).dtype)


# Each edit returns leaves of a System by name. Brax's pipelines read its own fields, MJX reads MuJoCo's.


def _scale_mass(system: Any, task: Task) -> dict[str, Array]:
    own = ("link.inertia.mass", "link.inertia.i", "body_mass", "body_inertia", "body_subtreemass")
    bodies, dofs = task.model["body_invweight0"], task.model["dof_invweight0"]
    weights = {
        "body_invweight0": bodies,
        "dof_invweight0": dofs,
        "link.invweight": bodies[1:, 0],
        "dof.invweight": dofs,
    }
    return {name: task.params["mass"] * attrgetter(name)(system) for name in own} | weights


def _set_gravity(system: Any, task: Task) -> dict[str, Array]:
    gravity = -task.params["gravity"] * jnp.array([0.0, 0.0, 1.0])
    return {"gravity": gravity, "opt.gravity": gravity}


def _scale_friction(system: Any, task: Task) -> dict[str, Array]:
    return {"geom_friction": system.geom_friction.at[:, 0].multiply(task.params["friction"])}


_EDITS: dict[str, Callable[[Any, Task], dict[str, Array]]] = {
    "mass": _scale_mass,
    "gravity": _set_gravity,
    "friction": _scale_friction,
}
