"""The cheetah domain of dm_control: a planar runner on two legs."""

import dataclasses
from collections.abc import Sequence
from types import MappingProxyType
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.dm_control.rewards import tolerance
from mtjax.envs.domain import Domain, rewarded
from mtjax.envs.engines.base import World
from mtjax.envs.looks import Look
from mtjax.envs.parameters import DAMPING, FRICTION, GEAR, GRAVITY, MASS, Parameter, body_mass, positive
from mtjax.envs.planar import forward_velocity, planar
from mtjax.types import Array, Key, Task, Transition

_TOTAL_MASS = 14.0  # [kg]
_LEGS = ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot")
_BACK_FOOT_GAP = 0.003  # [m] from the ankle to the upper end of the back foot's axis
_STANDING = 0.45  # [m] height of the centre of mass of one that stands still
_SETTLING_STEPS = 200
_POOL = 1024  # start states of all models together, as far as each has between 8 and 64


def _weigh(spec: mujoco.MjSpec) -> None:
    """Set the density of all geoms so that the whole body has the domain's mass."""
    _set_density(spec, 1.0)
    _set_density(spec, _TOTAL_MASS / np.sum(spec.compile().body_mass))


def _set_density(spec: mujoco.MjSpec, value: float) -> None:
    for geom in spec.geoms:
        geom.density = value


def _set_torso_length(spec: mujoco.MjSpec, length: float) -> None:
    spec.geom("torso").fromto = [-length, 0, 0, length, 0, 0]
    _weigh(spec)


def _set_foot_size(spec: mujoco.MjSpec, radius: float) -> None:
    for name in _LEGS:
        geom = spec.geom(name)
        geom.size = [radius, *geom.size[1:]]
    _weigh(spec)


def _set_foot_position(spec: mujoco.MjSpec, distance: float) -> None:
    spec.body("bthigh").pos = [-distance, 0, 0]
    spec.body("fthigh").pos = [distance, 0, 0]


def _set_back_foot_length(spec: mujoco.MjSpec, length: float) -> None:
    geom = spec.geom("bfoot")
    geom.size = [geom.size[0], length, 0]
    geom.pos = [*geom.pos[:2], -_BACK_FOOT_GAP - length]
    _weigh(spec)


_BODY = {
    "torso-length": positive("m", 0.5, _set_torso_length),
    "foot-size": positive("m", 0.046, _set_foot_size),
    "foot-position": positive("m", 0.5, _set_foot_position),
    "back-foot-length": positive("m", 0.094, _set_back_foot_length),
    "torso-mass": body_mass("torso"),
    "mass": MASS,
    "gravity": GRAVITY,
    "friction": FRICTION,
    "damping": DAMPING,
    "gear": GEAR,
}


@dataclasses.dataclass(frozen=True)
class CheetahRun(Domain):
    """Run: move forwards, the faster the better, up to 10 m/s.

    Observation (17,), all after the step: height of the torso relative to its initial 0.7 m [m], its pitch [rad], the
        angles of back thigh, shin and foot and of front thigh, shin and foot [rad]; then the torso's velocity along x
        [m/s] and the velocities of all the former in their order [m/s or rad/s].
    Action (6,): motor commands of the six joints in that order in [-1, 1]; gears of 120, 90, 60, 90, 60 and 30 N m.
    Reward: the forward velocity v of the centre of mass over 10 m/s,
            r = clip(v / 10, 0, 1)
        Returns lie in [0, 1000].
    Start: the six joints uniform in their range, then 200 steps without control in which the body falls and settles;
        where and as fast as that leaves it, from a pool of such states drawn when the family is made.
    Episode: 1000 steps of 0.01 s (one substep); it never terminates.

    Parameters that can vary; the shapes' masses are by density, scaled so that all together have 14 kg:
        torso-length: half-length [m] of the torso's capsule. Head and legs stay where they are. HiP-BMDP's ten tasks
            have 0.5, 0.6, ..., 1.4.
        foot-size: radius [m] of the six capsules of both legs; HiP-BMDP's 0.046 times 1, 1.2, 1.3, ..., 2.
        foot-position: distance [m] of both hips from the torso's middle; HiP-BMDP's 0.50, 0.48, ..., 0.32.
        back-foot-length: half-length [m] of the back foot, which grows downwards from the ankle; HiP-BMDP's 0.094,
            0.104, ..., 0.184.
        torso-mass: scale of the mass of torso and head, which adds to the total.
        mass, friction, damping, gear: scale of all masses, of the sliding friction of all geoms, of the damping of
            all joints, of the strength of all motors. gravity [m/s^2].
        speed: velocity [m/s] from which the reward is 1 and below which it falls linearly to 0 at rest.

    Differs from dm_control in: episodes begin in one of a pool of settled states (8 to 64 of each model) instead of a
    new one; under MJX the constraint solver stops after ``solver_iterations``, and limbs whose axes cross push each
    other apart in an arbitrary direction, where MuJoCo C lets them pass.
    """

    asks: ClassVar[str] = "Make the cheetah run forwards as fast as it can."
    parameters: ClassVar = MappingProxyType({**_BODY, "speed": positive("m/s", 10.0)})
    model_file: ClassVar[str] = "cheetah.xml"
    num_substeps: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 1000
    default_iterations: ClassVar[int] = 4
    warp_iterations: ClassVar[int] = 4
    starts_untouched: ClassVar[bool] = True  # it has no force sensors
    relabels: ClassVar[tuple[str, ...]] = ("speed", "direction", "height")
    heading: ClassVar[float] = 1.0  # -1 backwards
    look: ClassVar = Look((0, -3, 0), 90, follow="torso")

    def prepare(self, spec: mujoco.MjSpec) -> None:
        _weigh(spec)

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the leaves (R, ...) of every row of the table, with pools of settled starts (R, P, nq + nv)."""
        built, distinct = super().build(), {id(model): model for model in self.models}
        size = int(np.clip(_POOL // len(distinct), 8, 64))
        random = np.random.default_rng(self.task_seed)
        states = _settle([model for model in distinct.values() for _ in range(size)], random)
        pools = dict(zip(distinct, states.reshape(len(distinct), size, -1), strict=True))
        starts = np.float32(np.stack([pools[id(model)] for model in self.models]))
        return built | {"goal": built["goal"] | {"starts": starts}}

    def start(self, task: Task, key: Key) -> tuple[Array, Array]:
        state = jax.random.choice(key, task.goal["starts"])
        return state[: self.models[0].nq], state[self.models[0].nq :]

    def observe(self, task: Task, world: World) -> Array:
        return jnp.concatenate([world.qpos[1:], world.qvel])

    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition:
        obs, qvel = transition.next_obs, transition.next_obs[self.models[0].nq - 1 :]
        world = World(jnp.pad(obs[: -len(qvel)], (1, 0)), qvel, jnp.zeros_like(qvel), None)  # wherever along x
        return rewarded(self, task, transition, world)

    def reward(self, task: Task, world: World, action: Array) -> Array:
        speed, velocity = task.goal["speed"], self.heading * forward_velocity(self, task, world)
        return tolerance(velocity, speed, jnp.inf, speed, "linear", value_at_margin=0)


@dataclasses.dataclass(frozen=True)
class CheetahRunBackward(CheetahRun):
    """Run backwards, the faster the better, up to 10 m/s.

    As CheetahRun, but velocities backwards count. Not a task of dm_control: it has the same model, starts and episodes.

    Reward: with the forward velocity v of the centre of mass,
            r = clip(-v / speed, 0, 1)
        where ``speed`` is 10 m/s. Returns lie in [0, 1000].
    """

    heading: ClassVar[float] = -1.0


@dataclasses.dataclass(frozen=True)
class CheetahJump(CheetahRun):
    """Jump: have the body high over the ground.

    As CheetahRun, but for the reward. Not a task of dm_control: it has the same model, starts and episodes.

    Reward: with the height h of the whole body's centre of mass over the ground, which is 0.45 m in a cheetah that
        stands still,
            r = clip((h - 0.45) / (height - 0.45), 0, 1)
        Returns lie in [0, 1000].

    Further parameter, in place of speed: height [m].
    """

    parameters: ClassVar = MappingProxyType({**_BODY, "height": Parameter("m", 1.0, minimum=_STANDING)})

    def reward(self, task: Task, world: World, action: Array) -> Array:
        asked, mass = task.goal["height"], self.leaf(task, "body_mass")
        heights = planar(self, task, world).centre[:, 1]
        height = jnp.dot(mass, heights, precision="highest") / jnp.sum(mass)
        return tolerance(height, asked, jnp.inf, asked - _STANDING, "linear", value_at_margin=0)


@dataclasses.dataclass(frozen=True)
class CheetahSpeed(CheetahRun):
    """Speed: move forwards at the task's velocity, neither slower nor faster.

    As CheetahRun, but for the reward. MAML's velocity tasks (Finn et al. 2017) mean the same and reward minus the
    distance from the velocity asked for; here every task has the same range of rewards. The observation does not show
    the velocity asked for: the task's context does.

    Reward: with the forward velocity v of the centre of mass [m/s],
            r = max(1 - |v - speed| / speed, 0)
        Up to ``speed`` it is CheetahRun's own; it falls to 0 at twice that. Returns lie in [0, 1000].
    """

    asks: ClassVar[str] = "Make the cheetah run at the given speed."

    def reward(self, task: Task, world: World, action: Array) -> Array:
        speed = task.goal["speed"]
        return tolerance(forward_velocity(self, task, world), speed, speed, speed, "linear", value_at_margin=0)


@dataclasses.dataclass(frozen=True)
class CheetahDirection(CheetahRun):
    """Direction: run forwards or backwards, as the task says.

    As CheetahRun, but for the reward. The observation does not show the direction: the task's context does.

    Reward: with the forward velocity v of the centre of mass [m/s], and the task's direction, 1 forwards and -1
        backwards,
            r = clip(direction v / speed, 0, 1)
        where ``speed`` is 10 m/s. Returns lie in [0, 1000].
    """

    asks: ClassVar[str] = "Make the cheetah run in the given direction."
    parameters: ClassVar = MappingProxyType(
        {**CheetahRun.parameters, "direction": Parameter("1", 1.0, minimum=-2.0, maximum=1.0)}
    )

    def reward(self, task: Task, world: World, action: Array) -> Array:
        speed = task.goal["speed"]
        forwards = jnp.sign(task.goal["direction"]) * forward_velocity(self, task, world)
        return tolerance(forwards, speed, jnp.inf, speed, "linear", value_at_margin=0)


def _settle(models: Sequence[mujoco.MjModel], random: np.random.Generator) -> np.ndarray:
    """Drop one body of each model from a random pose, and return its settled state (N, nq + nv)."""
    from mujoco import batch

    limited = models[0].jnt_limited.astype(bool)
    worlds = batch.Batch(models[0], len(models))
    worlds.set_models(models)
    worlds.reset()
    qpos, qvel = worlds.bind("qpos"), worlds.bind("qvel")
    worlds.step()  # dm_control's first step also moves as the undisturbed pose would: its forces are not yet renewed
    low, high = models[0].jnt_range[limited].T
    qpos[:, limited] += random.uniform(low, high, (len(models), len(low)))
    worlds.step(nstep=_SETTLING_STEPS - 1)
    return np.concatenate([qpos, qvel], axis=1)
