"""Trained policies, read back from the folder of a run."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mtjax import loop
from mtjax.agents import BaseAgent
from mtjax.config import RunConfig, from_json
from mtjax.envs.family import Tabled
from mtjax.experience import Replay
from mtjax.experience.ring import Ring
from mtjax.training import checkpoint, points
from mtjax.types import Array, InputError, Key, Task, Transition


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """What a run learned: ``action = policy(obs, task)``, for single observations (O,); map it for many."""

    env: Tabled
    agent: BaseAgent
    state: Any  # of one seed
    states: Any  # of every seed, leading S; of a sweep, those of one point
    seeds: Array  # (S,)

    def __call__(self, obs: Array, task: Task, key: Key | None = None, memory: Any = None) -> Array:
        """Return the mean action (A,), or a random one if a key is given.

        Args:
            memory: what the agent remembers of the episode, from ``begin`` and ``remember``. Only an agent that infers
                its task needs it; without it, the episode counts as just begun.
        """
        memory = self.begin(task) if memory is None else memory
        return self.agent.act(self.state, memory, obs, task, key).action

    def begin(self, task: Task) -> Any:
        """Return the memory with which an episode begins."""
        return self.agent.begin(self.state, task)

    def remember(self, memory: Any, task: Task, obs: Array, action: Array, reward: Array, next_obs: Array) -> Any:
        """Return the memory after a step."""
        step = Transition(obs, action, reward, jnp.float32(1), next_obs)
        return self.agent.remember(self.state, memory, step, task)


def load(directory: str | Path, seed: int = 0) -> Policy:
    """Read the policy that a run learned.

    Args:
        directory: the run's folder.
        seed: which of the run's seeds, counted from 0. A run of a sweep has all its seeds for each of its points:
            number ``k`` is seed ``k % seeds`` of point ``k // seeds``, and the policy's agent is the one at that point.

    Raises:
        InputError: the folder is not a run, it has no such seed, or its checkpoint is missing or damaged.
    """
    directory = Path(directory)
    config = from_json(directory / "config.json")
    count = config.plan.seeds
    last = count * max(len(config.points), 1) - 1
    if not 0 <= seed <= last:
        raise InputError(f"seed must be from 0 to {last}, counted from the run's first, not {seed}")
    states = checkpoint.load_agent(directory / "checkpoints", state_shapes(config))
    agent = config.learner
    if config.points:
        rows = _point_rows(config, seed)
        agent = points.agent_at(agent, config.points[seed // count])
        states = jax.tree.map(lambda x: x[rows], states.learner)
    seeds = config.plan.seed + jnp.arange(count)
    return Policy(config.family, agent, jax.tree.map(lambda x: x[seed % count], states), states, seeds)


def _point_rows(config: RunConfig, seed: int) -> slice:
    """The rows of S that belong to one number's point."""
    first = seed - seed % config.plan.seeds
    return slice(first, first + config.plan.seeds)


def load_experience(directory: str | Path, seed: int = 0) -> tuple[Ring, int]:
    """Read what a run learned from: the replay of its last checkpoint, and the size of its batches.

    Of a run of a sweep it is what the seeds of one point learned from, by ``seed`` as for ``load``.

    Raises:
        InputError: as for ``load``; or the run has no replay.
    """
    config = from_json(Path(directory) / "config.json")
    if not isinstance(config.learner.experience, Replay):
        raise InputError(f"{config.agent} keeps no replay, so that there is nothing to look at")
    ring = checkpoint.load_ring(Path(directory) / "checkpoints", state_shapes(config))
    rows = _point_rows(config, seed)
    return ring._replace(rows=jax.tree.map(lambda x: x[rows], ring.rows)), config.learner.experience.batch_size


def state_shapes(config: RunConfig) -> loop.TrainState:
    """The shapes of a run's training state."""
    env, agent = config.family, points.SweptAgent(config.learner) if config.points else config.learner
    axis = points.seed_axis(config.points, config.plan.seed + jnp.arange(config.plan.seeds))
    return jax.eval_shape(lambda: loop.init(env, agent, config.training, env.tasks("train"), *axis))  # type: ignore
