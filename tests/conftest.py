"""What several test files share. Compiled programs live for the whole session: an MJX step costs ten seconds."""

from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np
import pytest


class Worlds(NamedTuple):
    """States of the nominal finger: the first half in contact, every second one with a fast hinge."""

    qpos: np.ndarray  # (100, 3)
    qvel: np.ndarray  # (100, 3)
    action: np.ndarray  # (100, 2)


class Programs(NamedTuple):
    """An environment's functions, mapped over a flat batch and compiled once for each batch size."""

    reset: object
    put: object  # tasks, qpos, qvel -> World
    step: object


@lru_cache
def compiled(env) -> Programs:
    put = jax.vmap(lambda task, qpos, qvel: env.set_physics(task, None, qpos, qvel))
    return Programs(jax.jit(jax.vmap(env.reset)), jax.jit(put), jax.jit(jax.vmap(env.step)))


@pytest.fixture(scope="session")
def programs():
    return compiled


@pytest.fixture(scope="session")
def suite_finger():
    """dm_control's own finger-spin environment, after the reset that sets the hinge's damping."""
    from dm_control import suite

    environment = suite.load("finger", "spin", task_kwargs={"random": 0})
    environment.reset()
    return environment


@pytest.fixture(scope="session")
def worlds(suite_finger) -> Worlds:
    """States that random play reaches: overlaps that no motion leads to amplify rounding beyond any use."""
    random = np.random.RandomState(1)
    touching, free = [], []
    while len(touching) < 50 or len(free) < 50:
        suite_finger.reset()
        for _ in range(10):
            action = random.uniform(-1, 1, 2)
            for _ in range(10):
                suite_finger.step(action)
            data = suite_finger.physics.data
            (touching if data.ncon else free).append((data.qpos.copy(), data.qvel.copy()))
    states = np.float32(touching[:50] + free[:50])
    states[::2, 1, 2] = random.uniform(-40, 25, 50)
    return Worlds(states[:, 0], states[:, 1], np.float32(random.uniform(-1, 1, (100, 2))))
