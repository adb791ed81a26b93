"""Families whose worlds can be drawn as a scene of MuJoCo's shapes: steps, and pictures as observations.

An observation holds the newest picture alone, so that a replay keeps each picture once. Whoever needs the last few
stacks them: rollouts for agents, a replay when it draws a batch, and ``mtjax.stacked`` for everyone else. All repeat
the first picture where an episode is younger than the stack (``mtjax.frames``).
"""

import abc
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property, partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs import looks
from mtjax.envs.painters.base import PAINTERS, Painter, choose_painter
from mtjax.envs.painters.poses import Pose, Poses, locate
from mtjax.envs.painters.scene import LEAVES, Scene, field, observed
from mtjax.envs.painters.warp import WarpPainter
from mtjax.envs.parameters import Parameter
from mtjax.frames import PICTURES, STATE
from mtjax.names import nearest_error
from mtjax.types import Array, InputError, Spec, Step, Task

STATES = ("hidden", "also")
_LEAST, _MOST = 16, 512
_MOST_FRAMES = 16
GREY = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the brightness of grey pictures."""


class Mark(NamedTuple):
    """A geom of the scene whose place an episode decides, such as a target. A light of its name stays above it."""

    position: Array  # (3,) [m]
    size: Array | None = None  # (3,) None: the model's
    along: Array | None = None  # (3,) direction of its z axis, of unit length; None: as the model has it


@dataclasses.dataclass(frozen=True)
class Pictured(abc.ABC):
    """What a family has that can be seen. Derive from this and ``Family``: ``class Mine(Pictured, Family)``.

    The family says how a world moves, and what of it is observed, rewarded and drawn. Its observations are pictures if
    ``pixels`` is set.
    """

    repeat: int = 1
    """Take every action for so many control steps and sum their rewards. Episodes last as long as before. Agents
    discount once for all of these steps, and success is that after the last."""
    pixels: int = 0
    """Observe pictures of so many pixels a side, such as 64 or 84, in place of the state. 0 observes the state. Then
    camera-angle [deg], hue, floor-hue, sky-hue [deg] and light (a scale) can vary: --env.vary.hue=0:300:10."""
    frames: int = 3
    """How many of the last pictures an agent sees at once."""
    grey: bool = False
    """Observe brightness alone."""
    state: str = "hidden"
    """Whether the state is observed beside the pictures: hidden or also."""
    plain: bool = False
    """Draw floor and sky in one colour each."""
    painter: str = "auto"
    """What draws: caster (plain JAX, any device) or warp (MuJoCo Warp's ray tracer, NVIDIA GPUs). auto is the caster,
    which is the faster one."""

    step_seconds: ClassVar[float]  # length of a control step [s]
    look: ClassVar[looks.Look | None] = None  # camera and light; None: the model's own, or a view of all of it
    meshes: ClassVar[bool] = False  # whether the scene is of meshes, which only Warp draws
    film_speed: ClassVar[float] = 1.0  # seconds of the world in a second of a film
    hides: ClassVar[tuple[str, ...]] = ()  # geoms that films show and observations do not, such as a hidden goal

    def __post_init__(self):
        super().__post_init__()
        if self.repeat != 1 and (self.repeat < 1 or self.episode_steps % self.repeat):
            raise self._unrepeatable()
        if self.state not in STATES:
            raise nearest_error("state", self.state, STATES)
        if self.painter not in PAINTERS:
            raise nearest_error("painter", self.painter, PAINTERS)
        if self.pixels and (self.pixels % 2 or not _LEAST <= self.pixels <= _MOST):
            raise InputError(f"pixels must be 0 or an even number from {_LEAST} to {_MOST}, not {self.pixels}")
        if not 1 <= self.frames <= _MOST_FRAMES:
            raise InputError(f"frames must be from 1 to {_MOST_FRAMES}, not {self.frames}")
        self._require_pictures()

    def _unrepeatable(self) -> InputError:
        near = [n for n in range(1, self.episode_steps + 1) if self.episode_steps % n == 0]
        few = sorted(sorted(near, key=lambda n: abs(n - self.repeat))[:4])
        return InputError(
            f"repeat must divide the {self.episode_steps} steps of an episode, such as "
            f"{', '.join(map(str, few))}; not {self.repeat}"
        )

    def _require_pictures(self) -> None:
        """Refuse what only pictures show, where there are none, and a painter that cannot run here."""
        if self.pixels:
            if choose_painter(self.painter, self.meshes) is WarpPainter and looks.SKY_HUE in self.varied:
                raise InputError("painter 'warp' has one sky for all tasks; use --env.painter=caster, or no sky-hue")
            return
        shown = [name for name, _ in self.vary if self.every_parameter[name].looks]
        shown += [
            f for f, plain in (("grey", False), ("plain", False), ("state", "hidden")) if getattr(self, f) != plain
        ]
        if shown:
            raise InputError(f"{shown[0]} changes only what is seen; add --env.pixels=64")

    @property
    def films(self) -> bool:
        """Return True: its worlds are drawn from their states."""
        return True

    # What a family gives.

    @abc.abstractmethod
    def advance(self, task: Task, state: Any, action: Array) -> Any:
        """Return the state of a world after one control step under ``action`` (A,)."""

    @abc.abstractmethod
    def observe(self, task: Task, state: Any) -> Array:
        """Return the observation (O,) of a world."""

    @abc.abstractmethod
    def reward(self, task: Task, state: Any, action: Array) -> Array:
        """Return the reward () of a world after the step."""

    @abc.abstractmethod
    def compile_spec(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the editable model of what there is to see, with these parameter values."""

    # What a family may give.

    def terminates(self, task: Task, state: Any) -> Array:
        """Return whether () an episode ends in this world, with no rewards after it. By default only time ends one."""
        return jnp.bool_(False)

    def metrics(self, task: Task, state: Any, action: Array) -> dict[str, Array]:
        """Return further numbers () of a world after the step, such as success. Evaluations report them."""
        return {}

    def judge(self, task: Task, state: Any, action: Array) -> tuple[Array, dict[str, Array]]:
        """Return reward and metrics. A family that computes them together gives both here."""
        return self.reward(task, state, action), self.metrics(task, state, action)

    def joints(self, state: Any) -> Array:
        """Return the positions (nq,) of the scene's joints. By default it has none."""
        return jnp.zeros(0)

    def add_marks(self, spec: mujoco.MjSpec) -> None:  # noqa: B027
        """Add geoms and lights to the scene that the physics does not have."""

    def marks(self, task: Task, state: Any) -> Mapping[str, Mark]:
        """Return the geoms of the scene whose places this episode has decided."""
        return {}

    def seen_spec(self, values: Mapping[str, float]) -> mujoco.MjSpec:
        """Return the editable model of what is seen, before it is dressed. By default it is that of the physics."""
        return self.compile_spec(values)

    def eye(self, task: Task, state: Any) -> Pose | None:
        """Return where the camera is, if the world decides that. None: where the scene has it."""
        return None

    @property
    def scenic(self) -> tuple[str, ...]:
        """Return the parameters in which scenes of tasks may differ."""
        return tuple(name for name, parameter in self.every_parameter.items() if parameter.edit is not None)

    # Steps.

    def step(self, task: Task, state: Any, action: Array) -> Step:
        """Advance ``repeat`` control steps under ``action`` (A,) in [-1, 1]; observation and reward are those after it.

        Rewards of repeated steps are summed, up to one that terminates the episode. There the world stands still, so
        that observation and metrics are those of its end.
        """

        def once(_, carry: tuple[Any, Array, Array]) -> tuple[Any, Array, Array]:
            before, total, over = carry
            moved = self.advance(task, before, action)
            state = jax.tree.map(lambda new, old: jnp.where(over, old, new), moved, before)
            total += jnp.where(over, 0.0, self.reward(task, state, action))
            return state, total, over | self.terminates(task, state)

        if self.repeat == 1:
            return self.outcome(task, self.advance(task, state, action), action)
        state, reward, over = jax.lax.fori_loop(0, self.repeat, once, (state, jnp.float32(0), jnp.bool_(False)))
        return Step(state, self.look_at(task, state), reward, over, self.judge(task, state, action)[1])

    def outcome(self, task: Task, state: Any, action: Array) -> Step:
        """Return what a control step has led to."""
        reward, metrics = self.judge(task, state, action)
        return Step(state, self.look_at(task, state), reward, self.terminates(task, state), metrics)

    @property
    def ends_early(self) -> bool:
        """Return whether the family says where episodes end."""
        return type(self).terminates is not Pictured.terminates

    @property
    def episode_length(self) -> int:
        """Return the steps after which an episode is cut off."""
        return self.episode_steps // self.repeat

    @property
    def seconds_per_step(self) -> float:
        """Return the length of a step of the environment [s]."""
        return self.step_seconds * self.repeat

    # Scenes.

    @property
    def every_parameter(self) -> Mapping[str, Parameter]:
        """Return the parameters of the family and those of looks."""
        return {**self.parameters, **looks.LOOKS, **self.parameters}

    def compile_scene(self, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
        """Return the editable model of what is seen with these parameter values."""
        given = dict(values or {})
        spec = self.seen_spec(given)
        looks.dress(spec, self.look, self.plain)
        self.add_marks(spec)
        for name, value in given.items():
            parameter = self.every_parameter[name]
            if parameter.looks and parameter.edit is not None:
                parameter.edit(spec, float(value))
        return spec

    def scene_model(self, row: int) -> mujoco.MjModel:
        """Return the compiled model of what is seen of the task in a row of the table."""
        return self.compile_scene({name: values[row] for name, values in self.values.items()}).compile()

    def for_rows(self, make: Callable[[dict[str, float]], Any], names: Iterable[str]) -> tuple[Any, ...]:
        """Return what ``make`` returns for every row of the table. Rows with equal values of ``names`` share it."""
        used = [name for name in self.values if name in names]
        rows = list(zip(*(self.values[name].tolist() for name in used), strict=True)) or [()] * self.count
        made = {row: make(dict(zip(used, row, strict=True))) for row in dict.fromkeys(rows)}
        return tuple(made[row] for row in rows)

    def _observed(self, values: Mapping[str, float]) -> mujoco.MjModel:
        return observed(self.compile_scene(values).compile(), self.hides)

    @cached_property
    def scene(self) -> Scene:
        """Return what no task changes of the scene."""
        return Scene(observed(self.scene_model(0), self.hides))

    @cached_property
    def artist(self) -> Painter:
        """Return the painter of this family on this device."""
        return choose_painter(self.painter, self.meshes)(self.scene, self.pixels)

    @property
    def outside_painter(self) -> WarpPainter | None:
        """Return the painter if it runs outside XLA."""
        return self.artist if self.pixels and isinstance(self.artist, WarpPainter) else None

    def scene_leaves(self) -> dict[str, np.ndarray]:
        """Return the fields (R, ...) of scenes that differ between rows."""

        def fields(values: dict[str, float]) -> dict[str, np.ndarray]:  # alone, as models hold textures
            model = self._observed(values)
            return {name: field(model, name) for name in LEAVES}

        rows = self.for_rows(fields, self.scenic)
        columns = {name: np.stack([row[name] for row in rows]) for name in LEAVES}
        return {name: column for name, column in columns.items() if np.any(column != column[0])}

    def build(self) -> dict[str, dict[str, Any]]:
        """Return the leaves (R, ...) of every row of the table, with what differs between scenes if they are seen."""
        return super().build() | ({"scene": self.scene_leaves()} if self.pixels else {})

    # Observations.

    def look_at(self, task: Task, state: Any) -> Any:
        """Return what the agent observes: the state (O,), pictures, or both."""
        if not self.pixels:
            return self.observe(task, state)
        shown = {PICTURES: self.draw(task, state)}
        return shown | {STATE: self.observe(task, state)} if self.state == "also" else shown

    def scene_leaf(self, task: Task, name: str) -> Array:
        """Return a field of the task's scene by its name in MuJoCo."""
        if task.scene is not None and name in task.scene:
            return task.scene[name]
        return jnp.asarray(self.scene.field(name))

    def see(self, task: Task, state: Any) -> Poses:
        """Return the poses of all that a picture of the world shows."""
        poses = locate(self.scene.model, partial(self.scene_leaf, task), self.joints(state))
        geoms, lights, eye = poses.geoms, dict(enumerate(poses.lights)), self.eye(task, state)
        for name, mark in self.marks(task, state).items():
            i = self.scene.model.geom(name).id
            put = lambda numbers, number, i=i: numbers.at[i].set(number)
            axes = geoms.axes if mark.along is None else jax.tree.map(put, geoms.axes, _frame(mark.along))
            geoms = Pose(jax.tree.map(put, geoms.position, tuple(mark.position)), axes)
            lamp = mujoco.mj_name2id(self.scene.model, mujoco.mjtObj.mjOBJ_LIGHT, name)
            if lamp >= 0:
                (_, _, height), direction = lights[lamp]
                lights[lamp] = (*mark.position[:2], height), direction
        return Poses(geoms, poses.camera if eye is None else eye, tuple(lights.values()))

    def draw(self, task: Task, state: Any) -> Array:
        """Return a picture (H, W, 3), or grey (H, W, 1), uint8 of a world."""
        sizes = self.scene_leaf(task, "geom_size")
        for name, mark in self.marks(task, state).items():
            if mark.size is not None:
                sizes = sizes.at[self.scene.model.geom(name).id].set(mark.size)
        leaf = lambda name: sizes if name == "geom_size" else self.scene_leaf(task, name)
        picture = self.artist.paint(leaf, self.see(task, state))
        if not self.grey:
            return picture
        return jnp.round(picture @ jnp.float32(GREY))[..., None].astype(jnp.uint8)

    @property
    def spec(self) -> Spec:
        """Return the sizes of observation, action and context, and how many pictures agents should see at once."""
        return self._spec._replace(frames=self.frames) if self.pixels else self._spec


def _frame(z: Array) -> Any:
    """Return axes with a given z axis, for shapes that are round about it."""
    aside = jnp.where(jnp.abs(z[0]) < 0.9, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    x = jnp.cross(aside, z)
    x = x / jnp.linalg.norm(x)
    return tuple(x), tuple(jnp.cross(z, x)), tuple(z)
