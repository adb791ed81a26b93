"""The data that flows between environments, agents and the loop, and the two protocols they meet in.

Axes, used in every docstring: ``S`` seeds, ``T`` tasks, ``E`` environments per task, ``B`` batch per task,
``O`` observation, ``A`` action, ``C`` context, ``K`` experts, ``N`` critics, ``H`` steps.
"""

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from mtjax.names import InputError as InputError  # everyone's, found here by most

Array = jax.Array
Key = jax.Array
Metrics = dict[str, Array]

SPLITS = ("train", "interpolation", "extrapolation")


class Task(NamedTuple):
    """One task as data; a table of tasks has a leading ``T`` on every leaf."""

    id: Array  # () int32, its number among the family's tasks: who it is to an agent
    row: Array  # () int32, row of the family's table: what it is to the physics
    context: Array  # (C,) parameters scaled so that the training range is [-1, 1]
    params: dict[str, Array]  # raw values in SI units, for logs and rewards
    model: dict[str, Array]  # the model leaves that differ between tasks, nothing else
    goal: dict[str, Array]  # reward and reset parameters
    horizon: Array  # () int32, steps after which an episode is cut off
    draws: Any = None  # a Task with leaves (P, ...) of which each episode takes one; None: every episode is this task
    action_mask: Array | None = None  # (A,) 1 for actions that the task has, 0 for padding; None: it has all
    blocks: Any = None  # of a mixture: which tasks belong to which family; static, without leaves


class Step(NamedTuple):
    """What an environment returns, before any automatic reset."""

    state: Any
    obs: Any  # (O,), or a tree of arrays as in ``Spec.obs``
    reward: Array  # ()
    terminated: Array  # () bool: the episode is over for good; a time limit is not this
    metrics: dict[str, Array] = {}  # () each, such as success  # noqa: RUF012


class Transition(NamedTuple):
    """One environment step as the learner sees it; time limits leave ``discount`` at 1."""

    obs: Any  # (O,)
    action: Array  # (A,)
    reward: Array  # ()
    discount: Array  # () = 1 - terminated
    next_obs: Any  # (O,) from before any reset
    ended: Any = None  # () bool: the episode is over, by whatever cause
    context: Array | None = None  # (C,) of the episode's own task where episodes draw theirs
    extras: Any = None  # what the agent noted when it acted


class Acted(NamedTuple):
    """What an agent does in one world."""

    action: Array  # (A,) in [-1, 1]
    extras: Any  # what its learning needs of the moment, stored with the transition; None for nothing
    memory: Any  # what it remembers of the episode from here on


class Outcome(NamedTuple):
    """What one step of every environment brought; leaves (T, E)."""

    reward: Array
    total: Array  # sum of the episode's rewards so far
    ended: Array  # bool: the episode is over, by whatever cause
    terminated: Array  # bool: it is over for good, and not by its time limit
    age: Array  # int32, steps of the episode so far
    memory: Any = None  # what the agent remembers of the episode, this step included


class Spec(NamedTuple):
    """The shapes an agent must know before it can build its networks."""

    obs: Any  # a tree of jax.ShapeDtypeStruct; of most families one vector (O,)
    action_size: int
    context_size: int
    mixed: bool = False  # observations of one task mean other things than those of another

    @staticmethod
    def vector(obs_size: int, action_size: int, context_size: int) -> "Spec":
        """The spec of a family that observes vectors (O,)."""
        return Spec(jax.ShapeDtypeStruct((obs_size,), jnp.float32), action_size, context_size)

    @property
    def obs_size(self) -> int:
        """The size O of observations.

        Raises:
            InputError: they are no vectors.
        """
        if not isinstance(self.obs, jax.ShapeDtypeStruct) or len(self.obs.shape) != 1:
            raise InputError(f"observations must be vectors here, not {self.obs}")
        return self.obs.shape[0]


class Env(Protocol):
    """A family of tasks. Frozen and hashable, so that it is static under ``jit``.

    ``reset`` and ``step`` are of one world and are what a family writes. The methods that end in ``worlds`` are of all
    worlds at once, leaves (S, T, E, ...); ``mtjax.maps.Flat`` makes them by mapping the former over one flat batch.
    """

    @property
    def spec(self) -> Spec: ...
    @property
    def episode_length(self) -> int: ...  # the longest horizon
    def tasks(self, split: str = "train") -> Task: ...
    def task_values(self, split: str) -> Any: ...
    def reset(self, task: Task, key: Key) -> Step: ...
    def step(self, task: Task, state: Any, action: Array) -> Step: ...
    def reset_worlds(self, tasks: Task, keys: Key) -> Step: ...
    def step_worlds(self, tasks: Task, states: Any, actions: Array) -> Step: ...
    def where_worlds(self, mask: Array, new: Any, old: Any) -> Any: ...  # states; mask (S, T, E)


class Experience(Protocol):
    """What a learner learns from. A frozen dataclass whose fields are flags of the agent that has it.

    Its data lies in the training state, leaves (S, ...).
    """

    @property
    def steps(self) -> int: ...  # of every environment between two calls of ``Agent.learn``
    @property
    def sharding(self) -> Any: ...  # the data's, as a tree of PartitionSpec
    def check(self, env: Env, num_envs: int) -> None: ...  # raises InputError
    def describe(self, num_envs: int) -> str: ...
    def init(self, item: Transition, num_tasks: int, num_envs: int, keys: Key) -> Any: ...  # keys (S,)
    def explore(self, data: Any, action: Array) -> Array: ...  # (S, T, E, A): the actions to take
    def add(self, data: Any, steps: Transition) -> Any: ...  # leaves (S, T, H, E, ...)
    def keep(self, data: Any) -> Any: ...  # what of it the next iteration needs


class Agent(Protocol):
    """A learner. A frozen dataclass whose fields are its hyper-parameters and its command-line flags."""

    @property
    def experience(self) -> Experience: ...
    @property
    def watches(self) -> bool: ...  # whether ``observe`` wants to be called
    def init(self, spec: Spec, tasks: Task, key: Key) -> Any: ...
    def begin(self, state: Any, task: Task) -> Any: ...  # the memory with which an episode begins; () for none
    def act(self, state: Any, memory: Any, obs: Any, task: Task, key: Key | None) -> Acted: ...
    def remember(self, state: Any, memory: Any, transition: Transition, task: Task) -> Any: ...  # after a step
    def observe(self, state: Any, outcome: Outcome) -> Any: ...
    def learn(self, env: Env, states: Any, data: Any, tasks: Task, keys: Key) -> tuple[Any, Metrics]: ...  # all seeds
