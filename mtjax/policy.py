"""Trained policies, read back from the folder of a run."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mtjax import checkpoint, cli, loop
from mtjax.agents import SAC
from mtjax.envs import Family
from mtjax.history import History, forget, remember
from mtjax.replay import Replay
from mtjax.types import Array, InputError, Key, Task


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """What a run learned: ``action = policy(obs, task)``, for single observations (O,); map it for many."""

    env: Family | History  # what the agent acts in: the family, showing past steps if the agent looks at any
    agent: SAC
    state: Any  # of one seed
    states: Any  # of every seed, leading S
    seeds: Array  # (S,)

    def __call__(self, obs: Array, task: Task, key: Key | None = None) -> Array:
        """Return the mean action (A,), or a random one if a key is given."""
        return self.agent.act(self.state, obs, task, key)

    @property
    def family(self) -> Family:
        """The family that the run trained on."""
        return forget(self.env)


def load(directory: str | Path, seed: int = 0) -> Policy:
    """Read the policy that a run learned.

    Args:
        directory: the run's folder.
        seed: which of the run's seeds, counted from 0.

    Raises:
        InputError: the folder is not a run, it has no such seed, or its checkpoint is missing or damaged.
    """
    directory = Path(directory)
    program = cli.from_json(directory / "config.json")
    if not 0 <= seed < program.plan.seeds:
        raise InputError(f"seed must be from 0 to {program.plan.seeds - 1}, counted from the run's first, not {seed}")
    seeds = program.plan.seed + jnp.arange(program.plan.seeds)
    states = checkpoint.load_agent(directory / "checkpoints", _shapes(program, seeds))
    env = remember(program.family, program.learner.history)
    return Policy(env, program.learner, jax.tree.map(lambda x: x[seed], states), states, seeds)


def load_experience(directory: str | Path) -> tuple[Replay, int]:
    """Read what a run learned from: the replay of its last checkpoint, and the size of its batches.

    Raises:
        InputError: as for ``load``.
    """
    program = cli.from_json(Path(directory) / "config.json")
    seeds = program.plan.seed + jnp.arange(program.plan.seeds)
    replay = checkpoint.load_replay(Path(directory) / "checkpoints", _shapes(program, seeds))
    return replay, program.training.batch_size


def _shapes(program: cli.Program, seeds: Array) -> loop.TrainState:
    env = remember(program.family, program.learner.history)
    return jax.eval_shape(lambda: loop.init(env, program.learner, program.training, env.tasks("train"), seeds))
