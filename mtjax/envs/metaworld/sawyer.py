"""What Meta-World's fifty tasks share: a Sawyer arm whose hand follows a moved body, and starts that have settled."""

import abc
import dataclasses
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar

import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.compiled import stack_differing
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World, choose_engine
from mtjax.envs.metaworld import observables, scene, starts
from mtjax.envs.metaworld.host import SUBSTEPS, Host
from mtjax.envs.metaworld.names import listed_with
from mtjax.envs.metaworld.observables import HALF, HALF_HIGH, HALF_LOW, Observables
from mtjax.envs.pixels import Mark
from mtjax.envs.scenery import Visible
from mtjax.envs.variation import Variation
from mtjax.types import SPLITS, Array, InputError, Key, Step, Task

_STEP = 0.01  # [m] that an action of 1 moves the hand's target
_DOWN = (1.0, 0.0, 1.0, 0.0)
_NOT_MJX = (
    "engine 'mjx' cannot compute Meta-World's cylinders on boxes; use --engine=c on a CPU, or warp on an NVIDIA GPU "
    "(pip install 'mtjax[warp]')"
)
_GOAL = "mtjax-goal"  # a geom of pictures


@dataclasses.dataclass(frozen=True)
class Sawyer(Domain):
    """A task of Meta-World. Subclasses give a scene, goals, the arrangement of things, and the reward.

    Observation (39,): the hand (3) [m], how far the gripper is open (1, from 0 to 1), the task's things (14: position
        [m] and orientation of each, then zeros), all of these once more as of the step before, and the goal (3) [m];
        clipped to Meta-World's ranges.
    Action (4,): in [-1, 1], the way of the hand's target in x, y and z, of 0.01 m at most, inside the task's box; and
        the force that closes the gripper.
    Reward: Meta-World's second version, from 0 to 10. Where a task has several formulas, the first counts whose
        condition holds. Distances are in m. In all of them t is the tool centre, e how far the gripper is open, f the
        action's closing force in [-1, 1], q an orientation, and an index 0 stands for an episode's start. A distance d
        within R counts 1, and beyond it less: 0.1 at a margin m from there, or 0 everywhere if m is not positive.
            near(d, R, m) = 1 / (1 + (3 max(d - R, 0) / m)^2)
            gauss(d, R, m) = 0.1^((max(d - R, 0) / m)^2)
            H(a, b) = a b / (a + b - a b)  (Hamacher's product, an "and")
            funnel(rho, R, k, z) = k log(rho - R) + z if rho > R, else 0  (height of a funnel at rho from its axis)
        C tells how well the gripper cages a thing. With its place o = (x, y, z), the left and the right pad at y_1 and
        y_2, and O, P, X, D and E as the task has them (E is 1 where it names none),
            C = H(K, G)  (plain)
            C = (H(K, G) + K) / 2  (dense)
            C = (H(K, G) + near(|o - t|, D, ||o_0 - t_0| - D|)) / 2  (medium)
            K = H(H(B(s_1, P), B(s_2, P)), near(|o - t|_xz, X, |o_0 - t_0|_xz - X))  (how well it is around the thing)
            G = clip(f / E, 0, 1) if K > 0.97, else 0  (how firmly it closes)
            B(s_i, u) = 1 / (1 + (3 max(O - s_i, s_i - u, 0) / m_i)^2)  (a pad is between O and u from the thing)
            s_i = |y_i - y|,  m_i = ||y_i - y_0| - P|
        In some tasks pads count otherwise, with P = 0.05, and pinch the thing, with the task's W:
            s_1 = y_1 - y,  s_2 = y - y_2,  m_i = ||s_i| - P|
            C = (K + N) / 2  (pinching)
            N = H(B(s_1, O + W), B(s_2, O + W)) if K > 0.95, else 0
    Metrics: success (0 or 1) after the step.
    Start: the settled hand, and the things as one of ``num_draws`` goals has them; each episode draws a goal. With 50
        they are the goals of Meta-World's benchmark of the seed ``task_seed``, number for number.
    Episode: 500 steps of 0.0125 s (five substeps); it never terminates.
    """

    num_draws: int = 50
    """Number of goals. Each episode draws one of them."""
    benchmark: str = ""
    """The benchmark whose goals these are: mt10, mt25, mt50, cw10, ml10 or ml45. Each has other goals of the same seed.
    Without a name they are those of Meta-World's MT1, and of ML1's training."""
    goal_hidden: bool = False
    """Observe zeros in place of the goal, as in the benchmarks of meta-learning."""
    held_out: bool = False
    """Do not train on this task: it is in the split extrapolation."""
    test_goals: bool = False
    """Hold out as many goals of the next seed in the split extrapolation: those of ML1's test."""

    scene_file: ClassVar[str]  # a file in the package's assets/sawyer_xyz, without .xml
    observes: ClassVar[str] = "hand, two things and goal"
    meshes: ClassVar[bool] = True
    unites: ClassVar[bool] = True
    hides: ClassVar = (_GOAL,)
    hand_low: ClassVar[tuple[float, ...]] = (-0.5, 0.4, 0.05)  # [m] the box of the hand's target
    hand_high: ClassVar[tuple[float, ...]] = (0.5, 1.0, 0.5)
    hand_start: ClassVar[tuple[float, ...]] = (0.0, 0.6, 0.2)
    drawn: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]]  # least and greatest vector of an episode's goal
    apart: ClassVar[float] = 0.0  # [m] along x and y, from a drawn place (3,) to the goal that is drawn after it
    goal_box: ClassVar[tuple[tuple[float, ...], ...]] = ()  # of goals in observations; empty: that of drawn goals
    # Short name -> "body:NAME", "site:NAME" or "geom:NAME". Tasks of a scene that watch the same can step together.
    watched: ClassVar[Mapping[str, str]] = MappingProxyType({})
    pressed: ClassVar[str] = ""  # a geom, if success needs that both pads press on it

    parameters: ClassVar = MappingProxyType({})
    action_size: ClassVar[int] = 4  # type: ignore
    num_substeps: ClassVar[int] = SUBSTEPS
    episode_steps: ClassVar[int] = 500
    default_iterations: ClassVar[int] = 50

    def __post_init__(self):
        scene.folder()
        if self.vary:
            raise InputError(f"Meta-World's tasks vary in their goals only, not in {next(iter(dict(self.vary)))}")
        if self.benchmark:
            listed_with(self.benchmark, starts.name_in_metaworld(self))
        if self.held_out and self.test_goals:
            raise InputError("a task that is held out trains on no goals; leave out test-goals")
        super().__post_init__()
        if self.engine == "mjx":
            raise InputError(_NOT_MJX)

    @property
    def engine_name(self) -> str:
        """Return the name of the engine that runs this family on this device.

        Raises:
            InputError: only MJX could run here.
        """
        chosen = choose_engine(self.engine, "warp")
        if chosen == "mjx":
            raise InputError(_NOT_MJX)
        return chosen

    # What a task gives.

    def allowed(self, vec: np.ndarray) -> bool:
        """Return whether a drawn vector is a goal. Another is drawn if not. It runs on the host."""
        return not self.apart or bool(np.linalg.norm(vec[:2] - vec[3:5]) >= self.apart)

    @abc.abstractmethod
    def arrange(self, host: Host, vec: np.ndarray) -> dict[str, Any]:
        """Put the things of an episode in place, after the hand has settled. It runs on the host, twice a goal.

        Returns:
            What the reward compares with, by name: "target" (3,), "obj_init" (3,) for ``caging``, and whatever else.
            "init_tcp" (3,) is added if it is not given. Meta-World's ``init_left_pad`` and ``init_right_pad`` are
            views that move with the pads: read ``at.left_pad`` in their place. So is any result of its
            ``get_body_com`` that it does not copy.
        """

    @abc.abstractmethod
    def objects(self, at: Observables) -> tuple[Array, ...]:
        """Return what fills the observation's entries for objects: position (3,), orientation (4,), position, ..."""

    @abc.abstractmethod
    def evaluate(self, at: Observables, began: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return reward () and success () bool of a world after a step. ``began`` is what ``arrange`` returned."""

    # Starts.

    @cached_property
    def variation(self) -> Variation:
        """Return the one task, and room for the goals that its episodes draw; with ``test_goals`` once more."""
        counts = {"train": not self.held_out, "extrapolation": self.held_out or self.test_goals}
        rows = {name: np.zeros((int(counts.get(name, False)), 0)) for name in SPLITS}
        return Variation((), rows, np.zeros((sum(counts.values()), self.num_draws, 0)), np.zeros(0), np.zeros(0))

    vectors = starts.vectors  # (P, K)
    starts_of_goals = cached_property(starts.starts_of_goals)

    @cached_property
    def models(self) -> tuple[mujoco.MjModel, ...]:
        """Return the model of every row of the table: first the tasks' (of their first goals)."""
        return tuple(start.model for start in starts.of_rows(self))

    def build(self) -> dict[str, dict[str, Any]]:
        found = starts.of_rows(self)
        stacked = lambda trees: {name: np.float32(np.stack([tree[name] for tree in trees])) for name in trees[0]}
        states = {f"start_{name}": x for name, x in stacked([start.state for start in found]).items()}
        model = {name: np.float32(leaf) for name, leaf in stack_differing(self.models).items()}
        return {"model": model, "goal": stacked([start.began for start in found]) | states}

    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        return scene.read(self.scene_file, self.watched, self.pressed)

    # Pictures.

    def seen_spec(self, values: Mapping[str, float]) -> mujoco.MjSpec:
        spec = scene.pictured(self.scene_file)
        spec.worldbody.add_geom(name=_GOAL, size=[0.02, 0, 0], rgba=[0, 0.8, 0, 0.6], contype=0, conaffinity=0)
        return spec

    def visible(self, task: Task, state: World) -> Visible:
        moved = {"body_pos": self.leaf(task, "body_pos")}  # bodies are where the goal has them
        return super().visible(task, state)._replace(fields=moved)

    def marks(self, task: Task, world: World) -> Mapping[str, Mark]:
        return {_GOAL: Mark(task.goal["target"])}

    # Steps.

    def start(self, task: Task, key: Key) -> tuple[Array, ...]:
        began = task.goal
        return began["start_qpos"], began["start_qvel"], jnp.zeros(HALF), began["start_mocap"]

    def reset(self, task: Task, key: Key) -> Step:
        """Begin an episode at the goal's settled start. Nothing is simulated."""
        names = ("qpos", "qvel", "warmstart", "sensors", "mocap")
        world = World(extra=None, **{name: task.goal[f"start_{name}"] for name in names})
        world = world._replace(extra=observables.half(self, world))
        seen = self.look_at(task, world) if self.pixels else observables.unclipped(self, task, world)
        return Step(world, seen, jnp.float32(0), jnp.bool_(False), {"success": jnp.float32(0)})

    def control(self, task: Task, world: World, action: Array) -> tuple[World, Array]:
        """Return the world with the hand's target moved and its observation kept, and the forces on the fingers."""
        way = jnp.clip(action[:3], -1.0, 1.0) * _STEP
        target = jnp.clip(world.mocap[0, :3] + way, jnp.array(self.hand_low), jnp.array(self.hand_high))
        mocap = jnp.concatenate([target, jnp.array(_DOWN)])[None]
        return world._replace(mocap=mocap, extra=observables.half(self, world)), jnp.stack([action[3], -action[3]])

    def observe(self, task: Task, world: World) -> Array:
        goals = np.array(self.goal_box or [vec[3:] for vec in self.drawn], np.float32)
        low = jnp.concatenate([HALF_LOW, HALF_LOW, goals[0]])
        high = jnp.concatenate([HALF_HIGH, HALF_HIGH, goals[1]])
        seen = jnp.clip(observables.unclipped(self, task, world), low, high)
        return seen.at[36:].set(0) if self.goal_hidden else seen

    def reward(self, task: Task, world: World, action: Array) -> Array:
        return self.evaluate(observables.at(self, task, world, action), task.goal)[0]

    def metrics(self, task: Task, world: World, action: Array) -> dict[str, Array]:
        return {"success": self.evaluate(observables.at(self, task, world, action), task.goal)[1].astype(jnp.float32)}
