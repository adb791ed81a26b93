"""Trained policies, read from the folder of a run."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mtjax import frames
from mtjax.agents import BaseAgent, name_of, swept
from mtjax.agents.base import judged
from mtjax.agents.swept import Point
from mtjax.agents.teacher import leave
from mtjax.checks import path, require_whole, shown
from mtjax.compiling.programs import trace
from mtjax.config import RunConfig
from mtjax.envs import name_of as env_name_of
from mtjax.envs.contexts import ranges
from mtjax.envs.family import Family
from mtjax.envs.mixtures import FamilyOrMixture
from mtjax.envs.variation import require_allowed
from mtjax.experience.ring import Ring
from mtjax.learning import loop
from mtjax.names import public
from mtjax.saved import checkpoint as checkpoints
from mtjax.saved import pretrained, standalone
from mtjax.saved.config_json import from_json
from mtjax.saved.operations import steps_of
from mtjax.tasks import SAME_CONTEXT
from mtjax.types import Array, InputError, Key, Task, Transition


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy: ``action = policy(obs, size=1.05)``, or ``policy(obs, task)``.

    Observations are (O,), or the tree of arrays that the family observes; in a batch all have a leading B. Files of
    ``mtjax.export`` are called by the same names.
    """

    env: FamilyOrMixture
    agent: BaseAgent
    state: Any  # of one seed
    states: Any  # of every seed, leading S; of a sweep, those of one point
    seeds: Array  # (S,)
    directory: Path | None = None  # of the run
    number: int = 0  # of the seed among ``seeds``
    trial: int = 1  # episodes of a trial, through which its memory lives
    entry: int = 0  # its number in S among all seeds of all points of the run

    def __repr__(self) -> str:
        names, seen = f"{name_of(self.agent)} on {env_name_of(self.env)}", jax.tree.map(lambda x: x.shape, self.takes)
        shapes = f"observation {seen}, action {self.env.spec.action}"
        return f"Policy({names}: {shapes}, one of {len(self.seeds)} seed{'s' * (len(self.seeds) > 1)})"

    @public
    def __call__(
        self, obs: Any, task: Task | None = None, key: Key | None = None, memory: Any = None, **parameters: Any
    ) -> Array:
        """Return the mean action (A,), or a sampled one if a key is given; (B, A) for a batch of observations.

        If actions are discrete, it is the likeliest, or a sampled one: a number () int32, or (B,); numbers (D,) of
        several, or (B, D).

        Args:
            obs: as the agent sees it: with pictures, the stack of the last ones, as ``mtjax.stacked`` shows them.
            task: one task of the family; else its parameters are given by name.
            memory: the agent's memory of the episode, from ``begin`` and ``remember``. Only agents that infer their
                task, or go on with an option, need it. None means that the episode has just begun. In a batch it has a
                leading B.
            parameters: the task's parameters, in their own units; in a batch each may be (B,). A policy that reads none
                takes them or leaves them out.

        Raises:
            InputError: shapes or names are others, or the task is not one task.
        """
        if task is not None and (not isinstance(task, Task) or np.ndim(task.id)):
            fix = "jax.tree.map(lambda x: x[0], tasks)" if isinstance(task, Task) else "policy(obs, NAME=VALUE)"
            raise InputError(f"policy(obs, task) takes one task, not {shown(task)}: {fix}")
        if task is not None and parameters:
            raise InputError(f"give a task, or its parameters {sorted(parameters)} by name, not both")
        if key is not None and not hasattr(key, "dtype"):
            raise InputError(f"key is one of jax.random.key, not {shown(key)}")
        if memory is not None and jax.tree.structure(memory) != self._memory_form:
            raise InputError(f"memory is what policy.begin(task) and policy.remember return, not {shown(memory)}")
        wanted = by_name(self.takes)
        given = standalone.entries(obs, wanted)
        try:
            standalone.require_numbers(given)
            size = standalone.batch_size(*({k: np.shape(x) for k, x in each.items()} for each in (wanted, given)))
            standalone.require_bytes(given)
            task, each = (task, False) if task is not None else self._task(parameters, size)
        except ValueError as error:
            stacks = "; mtjax.stacked(env) observes stacks of pictures" * frames.shown(self.takes)
            raise InputError(f"{error}{stacks}") from None
        seen = jax.tree.structure(self.takes).unflatten([jnp.asarray(given[name]) for name in wanted])
        if size is None:
            return self._act(seen, task, key, memory)
        keys = None if key is None else jax.random.split(key, size)
        axes = 0, 0 if each else None, None if key is None else 0, None if memory is None else 0
        return jax.vmap(self._act, axes)(seen, task, keys, memory)

    def _act(self, obs: Any, task: Task, key: Key | None, memory: Any) -> Array:
        memory = self.begin(task) if memory is None else memory
        return judged(self.agent).act(self.state, memory, obs, task, key).action

    def _task(self, parameters: dict[str, Any], size: int | None) -> tuple[Task, bool]:
        """Return the task with these parameters, and whether it is one for each of ``size`` observations."""
        if not isinstance(self.env, Family):
            raise InputError("a policy of a mixture takes a task: policy(obs, task)")
        names = [name for name, _, _ in ranges(self.env)]
        values = standalone.ordered(names, parameters, bool(parameters) or self._reads_parameters, size)
        for name, value in zip(names, values, strict=True):
            if parameters and name in self.env.parameters and not isinstance(value, jax.core.Tracer):
                require_allowed(name, np.ravel(value).tolist(), self.env.parameters[name])
        each = any(map(np.ndim, values))
        values = jnp.stack(jnp.broadcast_arrays(*map(jnp.float32, values)), axis=-1) if values else jnp.zeros(0)
        return (jax.vmap(self.task_of) if each else self.task_of)(values), each

    @cached_property
    def _memory_form(self) -> Any:
        task = jax.tree.map(lambda x: x[0], self.env.tasks("all")._replace(draws=None))
        return jax.tree.structure(jax.eval_shape(self.begin, task))

    @cached_property
    def _reads_parameters(self) -> bool:
        """Return whether actions depend on the task's parameters."""
        assert isinstance(self.env, Family)
        act = lambda values, obs: self._act(obs, self.task_of(values), None, None)
        program, _ = steps_of(jax.make_jaxpr(act)(jnp.zeros(len(ranges(self.env))), self.takes))
        return 0 in program["reads"]

    def task_of(self, values: Array) -> Task:
        """Return the task with the values (P,) of the family's parameters, in the order of its ranges.

        One of the family's has its number, others one beyond.
        """
        env, columns = self.env, []
        assert isinstance(env, Family)
        for i, (name, low, high) in enumerate(ranges(env)):
            if name in env.parameters and env.parameters[name].direction:
                columns += [jnp.sin(values[i]), jnp.cos(values[i])]
            else:
                columns.append((values[i] - (low + high) / 2) / ((high - low) / 2 or 1.0))
        context, listed = jnp.stack(columns) if columns else jnp.zeros(1), env.tasks("all")._replace(draws=None)
        same = jnp.all(jnp.abs(listed.context - context) <= SAME_CONTEXT, axis=1)
        number = jnp.where(jnp.any(same), jnp.argmax(same), len(listed.id)).astype(jnp.int32)
        first = jax.tree.map(lambda x: x[0], listed)
        return first._replace(id=number, context=context.astype(jnp.float32))

    def alone(self) -> "Policy":
        """Return the policy without the run's other seeds."""
        state, own = jax.tree.map(lambda x: x[None], self.state), self.seeds[self.number : self.number + 1]
        return dataclasses.replace(self, states=state, seeds=own, number=0)

    @property
    def takes(self) -> Any:
        """The shapes of an observation that it acts on: with pictures, those of the stack of the last ones."""
        return self.agent.representation.acts_on(frames.seen(self.env.spec))

    def begin(self, task: Task) -> Any:
        """Return the memory at the start of a trial, which by default is an episode."""
        return self.agent.begin(self.state, task)

    def remember(
        self, memory: Any, task: Task, obs: Any, action: Any, reward: Any, next_obs: Any, ended: Any = False
    ) -> Any:
        """Return the memory after one step; ``ended`` says whether an episode ended with it."""
        obs, action, next_obs = jax.tree.map(jnp.asarray, (obs, action, next_obs))
        reward, ended = jnp.float32(reward), jnp.bool_(ended)
        step = Transition(obs, action, reward, jnp.float32(1), next_obs, ended, jnp.bool_(False))
        return self.agent.remember(self.state, memory, step, task)


def by_name(obs: Any) -> dict[str, Any]:
    """Return the arrays of an observation, or their shapes, by their paths. An array alone is called obs."""
    name = lambda path: jax.tree_util.keystr(path, simple=True, separator="/") or "obs"
    return {name(path): x for path, x in jax.tree.leaves_with_path(obs)}


@public
def load(directory: str | Path, seed: int = 0, checkpoint: int = 0) -> Policy:
    """Load the trained policy of a run.

    Args:
        directory: the run's folder, or the name of a policy that comes with the package, such as
            "finger-spin-vary-size/sac-conditioned"; ``python -m mtjax.train --list`` shows them.
        seed: which of the run's seeds, counted from 0. A run of a sweep has all its seeds for each of its points:
            number ``k`` is seed ``k % seeds`` of point ``k // seeds``. The policy then has the agent of that point. Of
            a population it is a member, which comes alone, with its latest numbers.
        checkpoint: the iteration of a checkpoint that the run keeps; 0 takes the newest.

    Raises:
        InputError: the folder is not a run, the run has no such seed, or its checkpoint is missing or damaged.
    """
    require_whole("checkpoint", checkpoint, 0)
    directory = pretrained.folder(path(directory))
    config = from_json(directory / "config.json")
    _require_seed(seed, config.plan.seeds, len(config.points))
    if pretrained.is_pretrained(directory):
        if checkpoint:
            raise InputError(f"{str(directory)!r} is a policy alone, without checkpoints; leave out checkpoint")
        states = _filled(directory, state_shapes(config).agent)
    else:
        states = checkpoints.load_agent(directory / "checkpoints", state_shapes(config), checkpoint)
    seeds = jnp.asarray(config.plan.all_seeds, jnp.int32)
    among = bool(config.plan.population)
    found = policy_of(config.family, config.learner, config.points, seeds, states, seed, directory, among)
    return dataclasses.replace(found, trial=config.training.trials, entry=seed)


def _filled(directory: Path, like: Any) -> Any:
    """Return an agent's state with the arrays that acting reads from a folder, and zeros elsewhere."""
    found, (leaves, form) = pretrained.arrays(directory), jax.tree.flatten(like)
    if any(i >= len(leaves) or leaves[i].shape[1:] != x.shape for i, x in found.items()):
        raise InputError(f"{str(directory / pretrained.FILE)!r} is of another agent than its config.json")
    filled = [jnp.zeros(x.shape, x.dtype) if i not in found else found[i][None] for i, x in enumerate(leaves)]
    return jax.tree.unflatten(form, map(jnp.asarray, filled))


def policy_of(
    env: FamilyOrMixture,
    agent: BaseAgent,
    found: Sequence[Point],
    seeds: Array,
    states: Any,
    seed: int,
    directory: Path | None,
    member: bool = False,
) -> Policy:
    """Return the policy of one seed from the agent's states, leaves (S, ...), of all seeds of all points of a run.

    Args:
        member: the seed is a member of a population, whose numbers are those of its state, and of no other seed.

    Raises:
        InputError: the run has no such seed.
    """
    count = len(seeds)
    _require_seed(seed, count, len(found))
    if found:
        latest = {name: float(x[seed]) for name, x in states.numbers.items()}
        agent = swept.agent_at(agent, latest if member else found[seed // count])
        states = states._replace(numbers={})
    rows = slice(seed, seed + 1) if member else _point_rows(count, seed)
    if agent.taught:
        agent, states = leave(agent, states)
    own, seeds = (0, seeds[seed % count][None]) if member else (seed % count, seeds)
    states = _rows(states, np.arange(len(jax.tree.leaves(states)[0]))[rows])
    return Policy(env, agent, _rows(states, own), states, seeds, directory, own)


@jax.jit
def _rows(states: Any, index: Array | int) -> Any:
    """Pick one row of every leaf, or several. Outside of one program every shape of a leaf would be compiled for."""
    return jax.tree.map(lambda x: x[index], states)


def _require_seed(seed: int, seeds: int, num_points: int) -> None:
    last = seeds * max(num_points, 1) - 1
    if not isinstance(seed, int | np.integer) or not 0 <= seed <= last:
        raise InputError(f"seed must be from 0 to {last}, counted from the run's first, not {shown(seed)}")


def _point_rows(count: int, seed: int) -> slice:
    """Return the slice of S with all ``count`` seeds of one point: that of entry ``seed``."""
    first = seed - seed % count
    return slice(first, first + count)


def load_experience(directory: str | Path, seed: int = 0) -> tuple[Ring, int]:
    """Load the replay of a run's last checkpoint, and the size of its batches.

    For a run of a sweep, return the replay of all seeds of one point. ``seed`` chooses the point as in ``load``.

    Raises:
        InputError: as for ``load``.
    """
    config = from_json(Path(directory) / "config.json")
    ring = checkpoints.load_ring(Path(directory) / "checkpoints", state_shapes(config))
    rows = slice(seed, seed + 1) if config.plan.rule else _point_rows(config.plan.seeds, seed)
    return ring._replace(rows=jax.tree.map(lambda x: x[rows], ring.rows)), config.learner.experience.batch_size


def state_shapes(config: RunConfig) -> loop.TrainState:
    """Return the shapes of a run's training state."""
    env, agent = config.family, config.learner
    axis = swept.seed_axis(config.points, np.asarray(config.plan.all_seeds, np.int32))
    return trace(loop.init, env, agent, config.training, env.tasks("train"), *axis).out_info  # type: ignore
