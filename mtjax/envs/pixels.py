"""Families whose worlds can be drawn as a scene of MuJoCo's shapes: steps, and pictures as observations.

An observation holds the newest picture alone, so that a replay keeps each picture once. Whoever needs the last few
stacks them: rollouts for agents, a replay when it draws a batch, and ``mtjax.stacked`` for everyone else. All repeat
the first picture where an episode is younger than the stack (``mtjax.frames``).
"""

import abc
import dataclasses
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mtjax.envs.looks import LOOKS, SKY_HUE, Look, dress
from mtjax.envs.painters.base import PAINTERS, choose_painter
from mtjax.envs.painters.caster import Caster
from mtjax.envs.painters.scene import LEAVES, Scene, field, observed
from mtjax.envs.painters.warp import WarpPainter
from mtjax.envs.parameters import Parameter
from mtjax.envs.scenery import Mark, Scenery, Visible
from mtjax.frames import PICTURES, STATE
from mtjax.names import nearest_error
from mtjax.types import Array, InputError, Step, Task

STATES = ("hidden", "also")
_LEAST, _MOST = 16, 512
_MOST_FRAMES = 16


@runtime_checkable
class Drawable(Protocol):
    """What a family has that MuJoCo draws in films: a scene for each task, and what it shows of a world.

    It has ``film_speed`` and ``seconds_per_step`` too, as every family that can be filmed.
    """

    def scene_model(self, row: int) -> mujoco.MjModel:
        """Return the compiled model of what is seen of the task in a row of the table. The caller may change it."""
        ...

    def visible(self, task: Task, state: Any) -> Visible:
        """Return what a picture shows of a world."""
        ...


def _scene_model(family: "Pictured", row: int) -> mujoco.MjModel:
    """Return the compiled model of what is seen of the task in a row of the table."""
    return compile_scene(family, {name: values[row] for name, values in family.variation.values.items()}).compile()


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
    look: ClassVar[Look | None] = None  # camera and light; None: the model's own, or a view of all of it
    looks: ClassVar[Mapping[str, Parameter]] = LOOKS  # the parameters that change only what is seen
    scenic: ClassVar[tuple[str, ...]] = ()  # parameters without an edit in which the scenes of tasks differ
    meshes: ClassVar[bool] = False  # whether the scene is of meshes, which only Warp draws
    caster: ClassVar[type[Caster]] = Caster  # what painter=auto is
    films: ClassVar[bool] = True
    hides: ClassVar[tuple[str, ...]] = ()  # geoms that films show and observations do not, such as a hidden goal

    def __post_init__(self):
        super().__post_init__()
        _check(self)

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

    def marks(self, task: Task, state: Any) -> Mapping[str, Mark]:
        """Return the geoms of the scene whose places this episode has decided."""
        return {}

    def visible(self, task: Task, state: Any) -> Visible:
        """Return what a picture shows of a world: by default ``marks``, and the joints of a state that has ``qpos``."""
        return Visible(getattr(state, "qpos", jnp.zeros(0)), self.marks(task, state))

    def seen_spec(self, values: Mapping[str, float]) -> mujoco.MjSpec:
        """Return the editable model of what is seen, with all that marks need. By default it is that of the physics."""
        return self.compile_spec(values)

    # What every family does.

    scene_model = _scene_model

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
            return outcome(self, task, self.advance(task, state, action), action)
        state, reward, over = jax.lax.fori_loop(0, self.repeat, once, (state, jnp.float32(0), jnp.bool_(False)))
        return Step(state, self.look_at(task, state), reward, over, self.metrics(task, state, action))

    def look_at(self, task: Task, state: Any) -> Any:
        """Return what the agent observes: the state (O,), pictures, or both."""
        if self.scenery is None:
            return self.observe(task, state)
        shown = {PICTURES: self.scenery.draw(task, self.visible(task, state))}
        return shown | {STATE: self.observe(task, state)} if self.state == "also" else shown

    @cached_property
    def scenery(self) -> Scenery | None:  # type: ignore[override]
        """Return what draws observations; None where they are states."""
        return make_scenery(self) if self.pixels else None

    @property
    def ends_early(self) -> bool:  # type: ignore[override]
        """Return whether the family says where episodes end."""
        return type(self).terminates is not Pictured.terminates

    @property
    def seconds_per_step(self) -> float:
        """Return the length of a step of the environment [s]."""
        return self.step_seconds * self.repeat


def outcome(family: Pictured, task: Task, state: Any, action: Array) -> Step:
    """Return what a control step has led to."""
    return Step(
        state,
        family.look_at(task, state),
        family.reward(task, state, action),
        family.terminates(task, state),
        family.metrics(task, state, action),
    )


# Scenes.


def compile_scene(family: Pictured, values: Mapping[str, float]) -> mujoco.MjSpec:
    """Return the editable model of what is seen of a family with these parameter values."""
    spec = family.seen_spec(values)
    dress(spec, family.look, family.plain)
    for name, value in values.items():
        parameter = family.every_parameter[name]
        if parameter.looks and parameter.edit is not None:
            parameter.edit(spec, float(value))
    return spec


def make_scenery(family: Pictured) -> Scenery:
    """Return what draws the worlds of a family on this device."""
    scene = Scene(observed(family.scene_model(0), family.hides))
    painter = choose_painter(family.painter, family.meshes, family.caster)(scene, family.pixels)
    return Scenery(scene, _scene_leaves(family), painter, family.grey)


def _scene_leaves(family: Pictured) -> dict[str, np.ndarray]:
    """Return the fields (R, ...) of scenes that differ between rows."""

    def fields(values: dict[str, float]) -> dict[str, np.ndarray]:  # alone, as models hold textures
        model = observed(compile_scene(family, values).compile(), family.hides)
        return {name: field(model, name) for name in LEAVES}

    edited = [name for name, parameter in family.every_parameter.items() if parameter.edit is not None]
    rows = family.variation.for_rows(fields, (*family.scenic, *edited))
    columns = {name: np.stack([row[name] for row in rows]) for name in LEAVES}
    return {name: column for name, column in columns.items() if np.any(column != column[0])}


# Settings.


def _check(family: Pictured) -> None:
    """Raise InputError unless the settings of steps and pictures fit each other, and this device."""
    if family.repeat != 1 and (family.repeat < 1 or family.episode_steps % family.repeat):
        raise _unrepeatable(family.repeat, family.episode_steps)
    if family.state not in STATES:
        raise nearest_error("state", family.state, STATES)
    if family.painter not in PAINTERS:
        raise nearest_error("painter", family.painter, PAINTERS)
    if family.pixels and (family.pixels % 2 or not _LEAST <= family.pixels <= _MOST):
        raise InputError(f"pixels must be 0 or an even number from {_LEAST} to {_MOST}, not {family.pixels}")
    if not 1 <= family.frames <= _MOST_FRAMES:
        raise InputError(f"frames must be from 1 to {_MOST_FRAMES}, not {family.frames}")
    if not family.pixels:
        _refuse_looks(family)
    elif choose_painter(family.painter, family.meshes) is WarpPainter and SKY_HUE in family.varied:
        raise InputError("painter 'warp' has one sky for all tasks; use --env.painter=caster, or no sky-hue")


def _unrepeatable(repeat: int, steps: int) -> InputError:
    near = [n for n in range(1, steps + 1) if steps % n == 0]
    few = ", ".join(map(str, sorted(sorted(near, key=lambda n: abs(n - repeat))[:4])))
    return InputError(f"repeat must divide the {steps} steps of an episode, such as {few}; not {repeat}")


def _refuse_looks(family: Pictured) -> None:
    """Raise InputError for what only pictures show."""
    shown = [name for name, _ in family.vary if family.every_parameter[name].looks]
    plain = {"grey": False, "plain": False, "state": "hidden"}
    shown += [name for name, value in plain.items() if getattr(family, name) != value]
    if shown:
        raise InputError(f"{shown[0]} changes only what is seen; add --env.pixels=64")
