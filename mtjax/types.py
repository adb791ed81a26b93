"""Types of the data between environments, agents and the loop, and the protocols of these.

Axes, used in every docstring: ``S`` seeds, ``T`` tasks, ``E`` environments per task, ``B`` batch per task,
``O`` observation, ``A`` action, ``C`` context, ``K`` experts, ``N`` critics, ``H`` steps.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from mtjax.names import SPLITS as SPLITS  # re-exported for convenience, as is the next
from mtjax.names import InputError as InputError

Array = jax.Array
Key = jax.Array
Metrics = dict[str, Array]


class Kind:
    """What all kinds of actions have in common: the action is one array."""

    shape: Any  # of an action
    dtype: ClassVar[Any] = jnp.int32  # of its numbers

    def blank(self) -> Array:
        """Return an action that is all zero."""
        return jnp.zeros(self.shape, self.dtype)

    def masked(self, action: Array, mask: Array | None) -> Array:
        """Return actions with 0 for what a task does not have. Choices stay: policies draw only those that it has."""
        return action

    def narrow(self, action: Array) -> Array:
        """Return this family's part of the actions of a mixture, which are as wide as its widest family's."""
        return action


@dataclasses.dataclass(frozen=True)
class Continuous(Kind):
    """Actions are vectors (A,) in [-1, 1]."""

    size: int  # A
    kind: ClassVar[str] = "continuous"
    dtype: ClassVar[Any] = jnp.float32

    def __str__(self) -> str:
        return str(self.shape)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of an action."""
        return (self.size,)

    def random(self, key: Key, shape: tuple[int, ...] = ()) -> Array:
        """Draw actions (*shape, A), each entry uniform in [-1, 1)."""
        return jax.random.uniform(key, (*shape, self.size), minval=-1.0)

    def encode(self, action: Array) -> Array:
        """Return actions as the vectors (..., A) that networks take: themselves."""
        return action

    def masked(self, action: Array, mask: Array | None) -> Array:
        """Set the entries of actions (..., A) to 0 that a task does not have."""
        return action if mask is None else action * mask

    def narrow(self, action: Array) -> Array:
        """Return this family's part of the actions of a mixture, which are as wide as its widest family's."""
        return action[..., : self.size]


@dataclasses.dataclass(frozen=True)
class Discrete(Kind):
    """Actions are whole numbers () int32 from 0 to A - 1."""

    size: int  # A
    kind: ClassVar[str] = "discrete"
    shape: ClassVar[tuple[int, ...]] = ()

    def __str__(self) -> str:
        return f"0 to {self.size - 1}"

    def random(self, key: Key, shape: tuple[int, ...] = ()) -> Array:
        """Draw actions (*shape,), all as likely."""
        return _below(key, shape, jnp.uint32(self.size))

    def encode(self, action: Array) -> Array:
        """Return actions as the vectors (..., A) that networks take: 1 at the action, else 0."""
        return jax.nn.one_hot(action, self.size)


def _below(key: Key, shape: tuple[int, ...], size: Array) -> Array:
    """Draw whole numbers int32 below ``size``, all as likely but for a share of size / 2^32.

    Every world draws one in every step. jax.random.randint hashes its key five times for it, and this once.
    """
    return jnp.int32(jax.random.bits(key, shape, jnp.uint32) % size)


@dataclasses.dataclass(frozen=True)
class MultiDiscrete(Kind):
    """Actions are several whole numbers (D,) int32 at once: number d is from 0 to sizes[d] - 1.

    Networks take them as vectors (A,): a one-hot of each number, one after another.

    Raises:
        InputError: a size is not a whole number of at least 1, or there are none.
    """

    sizes: tuple[int, ...]  # (D,)

    def __post_init__(self):
        sizes = np.asarray(self.sizes)
        if sizes.ndim != 1 or not sizes.size or sizes.dtype.kind not in "iu" or sizes.min() < 1:
            raise InputError(f"MultiDiscrete takes the number of choices of each action, such as (3, 5), not {sizes}")
        object.__setattr__(self, "sizes", tuple(sizes.tolist()))

    def __str__(self) -> str:
        return f"{self.shape} below {self.sizes}"

    @property
    def kind(self) -> str:
        """What one policy can draw, in words."""
        return f"multi-discrete {self.sizes}"

    @property
    def size(self) -> int:
        """The size A of actions as the vectors that networks take."""
        return sum(self.sizes)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of an action."""
        return (len(self.sizes),)

    def random(self, key: Key, shape: tuple[int, ...] = ()) -> Array:
        """Draw actions (*shape, D), all as likely."""
        return _below(key, (*shape, len(self.sizes)), jnp.array(self.sizes, jnp.uint32))

    def encode(self, action: Array) -> Array:
        """Return actions as the vectors (..., A) that networks take: 1 at the choices, else 0."""
        one_hot = [jax.nn.one_hot(x, size) for (size, _), x in zip(self.runs, self.split(action), strict=True)]
        return jnp.concatenate([x.reshape(*x.shape[:-2], -1) for x in one_hot], axis=-1)

    @property
    def runs(self) -> list[tuple[int, int]]:
        """Each size, and how many numbers in a row have it: these are computed together."""
        return [(size, len(list(alike))) for size, alike in itertools.groupby(self.sizes)]

    def split(self, action: Array) -> list[Array]:
        """Return the numbers of actions (..., D) as arrays (..., d), one for each run."""
        return jnp.split(action, np.cumsum([count for _, count in self.runs])[:-1], axis=-1)

    def split_vectors(self, vectors: Array) -> list[Array]:
        """Return vectors (..., A), such as logits, as arrays (..., d, size), one for each run."""
        parts = jnp.split(vectors, np.cumsum([size * count for size, count in self.runs])[:-1], axis=-1)
        return [x.reshape(*x.shape[:-1], *run[::-1]) for run, x in zip(self.runs, parts, strict=True)]


Action = Continuous | Discrete | MultiDiscrete


class Task(NamedTuple):
    """Holds one task as data; a table of tasks has a leading ``T`` on every leaf."""

    id: Array  # () int32, number of the task for agents
    row: Array  # () int32, row of the family's table, which selects its physics
    context: Array  # (C,) parameters, scaled so that the training range is [-1, 1]
    params: dict[str, Array]  # parameters in SI units, for logs and rewards
    model: dict[str, Array]  # only those leaves of the physics model that differ between tasks
    goal: dict[str, Array]  # reward and reset parameters
    horizon: Array  # () int32, time limit of an episode in steps
    draws: Any = None  # a Task with leaves (P, ...); each trial draws one of them; None: every trial is of this task;
    # the draws have no context (None) where all have the task's own
    action_mask: Array | None = None  # (A,) 1 for actions, or choices, that the task has, else 0; None: it has all
    blocks: Any = None  # in a mixture, which tasks belong to which family; static, without leaves
    scene: dict[str, Array] | None = None  # only what differs between tasks in what is seen; None without pixels
    finite_horizon: Array | None = None  # () bool, where a mixture's families differ in it; None: as the environment's

    def __repr__(self) -> str:
        """Return a line: the number of tasks, and the values of their parameters where they are known."""
        shape, params = np.shape(self.id), self.params if isinstance(self.params, dict) else {}
        count = f"{shape[0]} task{'s' * (shape[0] != 1)}" if shape else "one task"
        told = ", ".join(_range(name, values) for name, values in params.items())
        return f"Task({count}{': ' * bool(told)}{told})"


def _range(name: str, values: Any) -> str:
    """Return a parameter's name with its value, or its least and greatest value, unless they are traced."""
    if isinstance(values, jax.core.Tracer) or not isinstance(values, np.ndarray | np.generic | jax.Array):
        return name
    if not np.size(values):
        return name
    low, high = np.min(values), np.max(values)
    return f"{name} {low:.4g}" if low == high else f"{name} {low:.4g} to {high:.4g}"


class Step(NamedTuple):
    """Holds what an environment returns, before any automatic reset."""

    state: Any
    obs: Any  # (O,), or a tree of arrays as in ``Spec.obs``
    reward: Array  # ()
    terminated: Array  # () bool: the episode reached a terminal state; not by its time limit
    metrics: dict[str, Array] = {}  # () each, such as success  # noqa: RUF012
    truncated: Any = None  # () bool: the episode is cut off here, though nothing is terminal; None: only by its horizon


class Transition(NamedTuple):
    """Holds one step of a trial for learning. ``mtjax.learning.trials`` says what a trial is: by default, an episode.

    A window holds consecutive steps of one environment, leaves (..., L, ...).
    """

    obs: Any  # (O,)
    action: Array  # (A,); of discrete actions () int32, or (D,) int32 of several
    reward: Array  # ()
    discount: Array  # () 0 if nothing can be earned after this step, else 1; a time limit alone leaves it at 1
    next_obs: Any  # (O,) what follows in the trial: the next episode's first, or from before any reset if sums end
    ended: Any = None  # () bool: the episode ended, terminated or by its time limit, or because its world was lost
    closed: Any = None  # () bool: the trial ended, and with it the agent's memory
    cut: Any = None  # () bool: sums of rewards end: the trial does, or a limit of time stopped the episode
    context: Array | None = None  # (C,) of the trial's task, if trials draw tasks of other contexts
    extras: Any = None  # data that the agent stores when it acts, or adds when it assesses the step
    memory: Any = None  # what the agent remembered of the trial before the step


class Weighted(NamedTuple):
    """Holds a metric of an update that counts by a weight in means over updates, as not all updates have it."""

    value: Any  # 0 where the update does not have it
    weight: Any  # 1 where the update has it, else 0; of the same shape

    @property
    def mean(self) -> Array:
        """The mean over updates, given means of value and weight; NaN if none has the metric."""
        return self.value / self.weight


class Acted(NamedTuple):
    """Holds an agent's action in one world."""

    action: Array  # (A,) in [-1, 1]; of discrete actions () int32, or (D,) int32 of several
    extras: Any = None  # data that learning needs, stored with the transition; None for none
    outputs: Any = None  # (P,) from which the agent's policy draws it, for those whom it teaches; None: it tells none


class Spec(NamedTuple):
    """Holds the shapes from which an agent builds its networks."""

    obs: Any  # a tree of jax.ShapeDtypeStruct; for most families one vector (O,)
    action: Action
    context_size: int
    mixed: bool = False  # whether tasks' observations are scaled each by itself, as their entries differ in meaning
    frames: int = 1  # how many of the last images an agent should see at once; observations hold the newest
    sentences: tuple[str, ...] = ()  # what the tasks of all splits ask for, by their numbers; for agents that read
    symbols: int = 0  # how many last entries of observations are the symbol of the sketch that is due, one-hot

    @staticmethod
    def vector(obs_size: int, action_size: int, context_size: int) -> "Spec":
        """Return the spec of a family whose observations are vectors (O,) and whose actions are continuous."""
        return Spec(jax.ShapeDtypeStruct((obs_size,), jnp.float32), Continuous(action_size), context_size)

    @property
    def action_size(self) -> int:
        """The size A of actions as the vectors that networks take."""
        return self.action.size

    @property
    def obs_size(self) -> int:
        """The size O of observations.

        Raises:
            InputError: observations are not vectors.
        """
        if not isinstance(self.obs, jax.ShapeDtypeStruct) or len(self.obs.shape) != 1:
            shapes = jax.tree.map(lambda x: x.shape, self.obs)
            raise InputError(f"observations must be vectors here, not {shapes}; leave out --env.pixels")
        return self.obs.shape[0]


class Env(Protocol):
    """An environment is a family of tasks. It is frozen and hashable, so that it is static under ``jit``.

    It implements ``reset`` and ``step`` for one world. The methods that end in ``worlds`` are for all worlds at once,
    leaves (S, T, E, ...); those of ``mtjax.parallel.axes`` map the former over one flat batch.
    """

    @property
    def spec(self) -> Spec: ...
    @property
    def episode_length(self) -> int: ...  # the longest horizon
    @property
    def ends_early(self) -> bool: ...  # whether episodes may end before their limit; it decides how resets are computed
    @property
    def reset_batches(self) -> int: ...  # in how many batches all worlds are reset, where episodes end early
    @property
    def cheap_starts(self) -> bool: ...  # whether to begin an episode costs a GPU less than to ask whether one ended
    @property
    def finite_horizon(self) -> bool: ...  # whether the limit of time is part of the problem, so that its end is one
    def tasks(self, split: str = "train") -> Task: ...
    def task_values(self, split: str) -> Any: ...
    def reset(self, task: Task, key: Key) -> Step: ...
    def step(self, task: Task, state: Any, action: Array) -> Step: ...
    def reset_worlds(self, tasks: Task, keys: Key) -> Step: ...
    def step_worlds(self, tasks: Task, states: Any, actions: Array) -> Step: ...
    def renew_worlds(self, tasks: Task, keys: Key, mask: Array, states: Any) -> Step: ...  # resets those of (S, T, E)


class Lasting(Env, Protocol):
    """An environment whose worlds can go on with another task, as ``--reset-free`` asks."""

    def observe_worlds(self, tasks: Task, states: Any) -> Any: ...  # what agents see of states, leaves (S, T, E, ...)


@runtime_checkable
class Returning(Lasting, Protocol):
    """An environment that has a task of going back to the start, as the curriculum forward-backward asks."""

    def returning(self, task: Task) -> Task: ...  # whose end is where worlds of ``task`` begin
    def distance(self, task: Task, state: Any) -> Array: ...  # of a state to the task's end, which has at most 1


@runtime_checkable
class Relabelling(Protocol):
    """An environment some of whose tasks may differ in goals alone, so that steps of one can be another's."""

    @property
    def parameters(self) -> Mapping[str, Any]: ...
    @property
    def varied(self) -> tuple[str, ...]: ...  # the parameters that differ between tasks
    @property
    def relabels(self) -> tuple[str, ...]: ...  # the goals, which ``relabel`` can exchange
    @property
    def fresh_goals(self) -> bool: ...  # whether every episode draws a goal of its own, whatever its task
    @property
    def pixels(self) -> int: ...  # on each side of the pictures that agents observe; 0 if they see none
    @property
    def repeat(self) -> int: ...  # control steps in a step
    def relabel(self, task: Task, transition: Transition, key: Key) -> Transition: ...


class Storage(NamedTuple):
    """Says how the data of an experience lies."""

    axes: Any  # of the data under a map over seeds
    sharding: Any  # of the data, as a tree of PartitionSpec
    kept: bool  # whether the next iteration needs it
    flags: tuple[str, ...]  # which say how much there is


class Experience(Protocol):
    """An experience collects what an agent learns from. It is a frozen dataclass whose fields are flags of the agent.

    Its data is in the training state, leaves (S, ...).
    """

    storage: ClassVar[Storage]

    @property
    def steps(self) -> int: ...  # of every environment that are collected before the agent learns
    @property
    def adaptations(self) -> int: ...  # how often the agent adapts meanwhile: between as many rollouts and one more
    @property
    def updates(self) -> int: ...  # U, each time that the agent learns
    @property
    def warmup_steps(self) -> int: ...  # of every environment under random actions before learning starts
    @property
    def reset_every(self) -> int: ...  # steps of every environment between two resets of networks; 0 for never
    def check(self, env: Env, num_envs: int, chunk_steps: int = 0, unroll: int = 0) -> None: ...  # raises InputError
    def host_slots(self, num_envs: int) -> int: ...  # steps of every environment that the host keeps beside the data
    def rollout_bytes(self, spec: Spec, num_envs: int) -> int: ...  # of a task's steps that are learned from, not kept
    def describe(self, spec: Spec, num_envs: int) -> str: ...
    def init(self, item: Transition, spec: Spec, num_tasks: int, num_envs: int, keys: Key) -> Any: ...  # keys (S,)
    def explore(self, data: Any, action: Array, step: Array) -> Array: ...  # actions (S, T, E, ...) to take at a step
    def add(self, data: Any, steps: Transition) -> Any: ...  # leaves (S, T, H, E, ...)
    def batches(  # leaves (U, ...)
        self, env: Env, agent: Any, tasks: Task, data: Any, key: Key, state: Any = None
    ) -> Any: ...
    def window(self, data: Any, batch: Any) -> Transition: ...  # windows (T, B, L, ...) of one of the batches
    def draw(self, spec: Spec, agent: Any, steps: Any, key: Key, count: int) -> Transition: ...  # as many windows


class Agent(Protocol):
    """An agent acts and learns. It is a frozen dataclass; its fields are hyper-parameters and command-line flags."""

    continual: ClassVar[Any]  # the part that remembers tasks learned one after another: ``agents.parts.continual``
    plasticity: ClassVar[Any]  # the part that keeps networks able to learn: ``agents.parts.plasticity``
    goes_on: ClassVar[bool]  # whether its memory holds an option that runs, ``memory.running.option``
    taught: ClassVar[bool]  # whether it learns from the policies of other runs

    @property
    def experience(self) -> Experience: ...
    @property
    def unroll(self) -> int: ...  # steps L of the windows that it learns through, with burn-in; 0 if it needs none
    def init(self, spec: Spec, tasks: Task, key: Key) -> Any: ...
    def begin(self, state: Any, task: Task) -> Any: ...  # the memory with which a trial begins; () for none
    def act(self, state: Any, memory: Any, obs: Any, task: Task, key: Key | None) -> Acted: ...
    # After a step, whose next observation is here the one from before any reset:
    def remember(self, state: Any, memory: Any, transition: Transition, task: Task) -> Any: ...
    def assess(self, state: Any, steps: Transition, tasks: Task) -> tuple[Any, Transition]: ...  # (T, H, E, ...), once
    # One gradient step. Its metrics are (T,) each, or ``Weighted`` if only some updates have them:
    def update(self, state: Any, window: Transition, tasks: Task, key: Key, number: Array) -> tuple[Any, Metrics]: ...
    def observe(self, state: Any, steps: Transition, tasks: Task) -> Any: ...  # (T, H, E, ...), once, after learning


class Adapting(Agent, Protocol):
    """An agent that adapts to its tasks between the rollouts of its experience."""

    def adapt(self, state: Any, steps: Transition, tasks: Task) -> Any: ...  # to a rollout (T, H, E, ...) of them
