"""The example of an own way to infer a task, in under 60 lines: what its memory holds, and that it trains."""

import runpy
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import mtjax
from mtjax.agents.parts.knowing import CONDITIONINGS
from mtjax.types import Transition

FILE = Path(__file__).parent.parent / "examples" / "own_inference.py"


@pytest.fixture
def averages(monkeypatch):
    """The example's class, registered for one test."""
    monkeypatch.setattr("mtjax.agents.parts.knowing.CONDITIONINGS", dict(CONDITIONINGS))
    before = dict(CONDITIONINGS)
    yield runpy.run_path(str(FILE), run_name="own_inference")["Averages"]
    CONDITIONINGS.clear()
    CONDITIONINGS.update(before)


def test_it_is_short():
    assert len(FILE.read_text().splitlines()) < 60


def test_the_memory_is_what_can_be_known_of_arms(averages):
    """An arm that paid s of n times pays with (s + 1) / (n + 2) (Laplace)."""
    knowing = averages()
    memory = knowing.begin(1, 2)
    for arm, reward in ((0, 1.0), (0, 1.0), (0, 0.0), (1, 0.0)):
        step = Transition(None, jnp.eye(2)[arm], jnp.float32(reward), None, None, None, None)
        memory = knowing.remember({}, memory, step)
    np.testing.assert_allclose(knowing.show({}, memory), [3 / 5, 1 / 3, 3 / 5, 1 / 5], rtol=1e-6)


@pytest.mark.slow
def test_an_agent_learns_with_it(averages):
    agent = mtjax.agent("ppo", conditioning=averages(), hidden=(8,), unroll=4, epochs=1, minibatches=1)
    plan = dict(steps=64, eval_every=64, eval_episodes=4, chunk_steps=4)
    result = mtjax.train(mtjax.make("hidden-bandit"), agent, trials=4, num_envs=8, quiet=True, **plan)
    assert np.isfinite(result.evaluations.returns["train"]).all()
