"""Every agent learns to reach goals that differ, on a CPU, in seconds. Few by default; ``-m nightly`` runs the rest."""

from functools import cache

import numpy as np
import pytest
from probes import OFF_POLICY, slow_but

import mtjax

# The goal is not seen: three places on one circle, of which a policy that is not told which can serve but one.
GOALS = {"goal-x": "-0.2,0.2,0.0", "goal-y": "0.0,0.0,0.2"}
SETTINGS = {"num_envs": 16, "batch_size": 32, "replay_size": 16_000, "warmup_steps": 100, "chunk_steps": 500}
QUICK = {
    "hidden": (64, 64),
    "actor_lr": 2e-3,
    "critic_lr": 2e-3,
    "temperature_lr": 2e-3,
    "tau": 0.02,
    "initial_temperature": 0.02,
    "gamma": 0.95,
    "normalize_observations": True,
}
LONGER = {"distral": 2500}  # whose tasks share no experience
USUAL = ("sac-conditioned", "multi-head")
TOLD = [name for name in OFF_POLICY if name != "sac"]
EVERY = [
    *slow_but(USUAL),
    *(pytest.param(x, marks=pytest.mark.nightly) for x in TOLD if x not in USUAL),
]


@cache
def env():
    return mtjax.make("point-mass-vary-goal", vary=GOALS, combine="paired", split="none")


def returns_of(name, **settings):
    """The last evaluation (T,), of at most 100 an episode, after 1500 steps or more of 16 environments a goal."""
    agent = mtjax.agent(name, **{**QUICK, **settings})
    steps = LONGER.get(name, 1500) * 16 * 3
    result = mtjax.train(env(), agent, steps=steps, eval_every=steps, eval_episodes=1, **SETTINGS)
    return result.evaluations.returns["train"][0, -1].mean(axis=-1)


@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("name", EVERY)
def test_every_agent_reaches_every_goal(name):
    """At least 75 of some 95 on each."""
    found = returns_of(name)
    assert np.all(found > 75), found


@pytest.mark.nightly
def test_an_agent_that_is_not_told_its_task_does_not():
    """So that the other tests say something of the telling."""
    assert np.min(returns_of("sac")) < 75
