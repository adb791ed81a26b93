"""The data that flows between environments, agents and the loop, and the two protocols they meet in.

Axes, used in every docstring: ``S`` seeds, ``T`` tasks, ``E`` environments per task, ``B`` batch per task,
``O`` observation, ``A`` action, ``C`` context, ``K`` experts, ``N`` critics, ``H`` steps.
"""

from typing import Any, NamedTuple, Protocol

import jax

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
    draws: Any = None  # a Task with leaves (P, ...) of which each episode takes one; None: every episode is this task


class Step(NamedTuple):
    """What an environment returns, before any automatic reset."""

    state: Any
    obs: Array  # (O,)
    reward: Array  # ()
    terminated: Array  # () bool: the episode is over for good; a time limit is not this


class Transition(NamedTuple):
    """One environment step as the learner stores it; time limits leave ``discount`` at 1."""

    obs: Array  # (O,)
    action: Array  # (A,)
    reward: Array  # ()
    discount: Array  # () = 1 - terminated
    next_obs: Array  # (O,) from before any reset
    context: Array | None = None  # (C,) of the episode's own task where episodes draw theirs


class Outcome(NamedTuple):
    """What one step of every environment brought; leaves (T, E)."""

    reward: Array
    discounted: Array  # sum of the episode's rewards so far, each discounted once more at every later step
    total: Array  # sum of the episode's rewards so far
    ended: Array  # bool: the episode is over, by whatever cause
    terminated: Array  # bool: it is over for good, and not by its time limit
    age: Array  # int32, steps of the episode so far


class Spec(NamedTuple):
    """The sizes an agent must know before it can build its networks."""

    obs_size: int
    action_size: int
    context_size: int
    history: int = 0  # past steps that each observation shows as well (mtjax.history)


class Env(Protocol):
    """A family of tasks. Frozen and hashable, so that it is static under ``jit``."""

    @property
    def spec(self) -> Spec: ...
    @property
    def episode_length(self) -> int: ...
    def tasks(self, split: str = "train") -> Task: ...
    def task_values(self, split: str) -> Any: ...
    def reset(self, task: Task, key: Key) -> Step: ...
    def step(self, task: Task, state: Any, action: Array) -> Step: ...


class Agent(Protocol):
    """A learner. A frozen dataclass whose fields are its hyper-parameters and its command-line flags."""

    @property
    def gamma(self) -> float: ...
    @property
    def watches(self) -> bool: ...  # whether ``observe`` wants to be called
    @property
    def history(self) -> int: ...  # past steps that observations must show
    def init(self, spec: Spec, tasks: Task, key: Key) -> Any: ...
    def act(self, state: Any, obs: Array, task: Task, key: Key | None) -> Array: ...
    def update(self, state: Any, batch: Transition, tasks: Task, key: Key) -> tuple[Any, Metrics]: ...
    def observe(self, state: Any, outcome: Outcome) -> Any: ...
    def reset(self, state: Any, spec: Spec, tasks: Task, key: Key) -> Any: ...  # networks begin anew
