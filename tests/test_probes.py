"""Learning on problems of which every Q-value is known, through the whole loop."""

import numpy as np
import pytest
from probes import LEARNING, OFF_POLICY, Probe, mean_actions, one_in, only_seed, slow_but, tasks_of, tiny, train, values

from mtjax.envs.probes import EITHER_SIGN

GAMMA = 0.9
SCALES = (1.0, -0.5)
# The temperature stays negligible, so that the soft Q-value is the plain one.
PLAIN = {"gamma": GAMMA, "initial_temperature": 1e-6, "temperature_lr": 1e-9}
# Values are compared in the units of rewards, at observations as they are. Two experts are too few for four signs of
# observation and scale. Weights of length 1 turn far in a step.
SLOWER = {"critic_lr": 3e-3, "actor_lr": 1e-3}
OF_AGENT = {
    "brc": {"scaling": "none"},
    "simba-v2": {"scaling": "none", "normalize_observations": False, "hidden": (64,), **SLOWER},
    "xqc": {"scaling": "none", "hidden": (64, 64), **SLOWER},
    "moe": {"num_experts": 4},
}
LARGE = {"brc", "simba-v2", "xqc"}
RATES = {"tau": 0.3, "actor_lr": 3e-3, "critic_lr": 1e-2}

# Q(scale, obs, action), and how far a critic may be from it: at least half as far again as the worst of five seeds.
ENDLESS = lambda scale, obs, action: scale * np.where(obs > 0.5, 1, GAMMA) / (1 - GAMMA)
EXPECTED = {
    "one-step": (lambda scale, obs, action: scale + 0 * obs, 0.05),
    "by-observation": (lambda scale, obs, action: scale * obs, 0.08),
    "delayed": (lambda scale, obs, action: scale * np.where(obs > 0.5, 1, GAMMA), 0.08),
    "by-action": (lambda scale, obs, action: -np.square(action - scale), 0.15),
    "by-both": (lambda scale, obs, action: -np.square(action - scale * obs), 0.3),
    "endless": (ENDLESS, 0.15),
}


def learned(name, kind, scales=SCALES, **given):
    """Train, and return the agent, its state and the tasks."""
    agent, tasks = tiny(name, **{**PLAIN, **RATES, **OF_AGENT.get(name, {})}), tasks_of(kind, scales)
    plan = dict(chunks=1 + (kind == "by-both"), level=int(name in LARGE))
    state, _ = train(Probe(), agent, LEARNING | given, tasks=tasks, **plan)
    return agent, only_seed(state.agent), tasks


def places(kind):
    """Observations (B,) of the probe, each with three actions (B,)."""
    seen = {"delayed": (0.0, 1.0), "endless": (0.0, 1.0)}.get(kind, (-1.0, 1.0) if kind in EITHER_SIGN else (0.0,))
    return np.repeat(seen, 3), np.tile([-0.8, 0.0, 0.8], len(seen))


def assert_known_values(agent, state, tasks, kind, scales=SCALES):
    (expected, tolerance), (obs, action) = EXPECTED[kind], places(kind)
    for found, scale in zip(values(agent, state, tasks, obs, action), scales, strict=True):
        for critic in found:
            np.testing.assert_allclose(critic, expected(scale, obs, action), rtol=0, atol=tolerance)


@pytest.mark.parametrize("kind", one_in(5, EXPECTED))
def test_every_critic_learns_the_known_value_of_every_task(kind):
    """Both critics, on every task, at on-policy and off-policy actions."""
    assert_known_values(*learned("sac-conditioned", kind), kind)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["delayed", "endless"])
def test_joined_steps_lead_to_the_same_values(kind):
    """Beyond the end of an episode nothing counts, and at a time limit the value does; the actor may lag behind."""
    assert_known_values(*learned("sac-conditioned", kind, n_step=3, policy_delay=2, update_every=2), kind)


@pytest.mark.parametrize("kind", one_in(2, ["delayed", "endless"]))
@pytest.mark.slow
def test_retrace_leads_to_the_same_values(kind):
    """From windows of three steps, with ends inside: a termination ends the bootstrap, a time limit the sum alone."""
    given = {"target": "retrace", "retrace_steps": 3, "batch_size": 12}
    assert_known_values(*learned("sac-conditioned", kind, **given), kind)


def test_the_policy_finds_the_best_action_of_each_task():
    """The best action is the scale, whose sign the tasks differ in."""
    actions = mean_actions(*learned("sac-conditioned", "by-action"), [0.0])
    np.testing.assert_allclose(actions[1], -0.5, atol=0.35)
    assert actions[0] > 0.85  # 1 is the edge of what tanh reaches


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(OFF_POLICY, "pcgrad", nightly=True))
def test_every_agent_learns_values_and_actions(name):
    """On the probe that needs observation, action and task; an agent that is not told its task gets two alike."""
    scales = (0.7, 0.7) if name == "sac" else SCALES
    agent, state, tasks = learned(name, "by-both", scales)
    assert_known_values(agent, state, tasks, "by-both", scales)
    best = np.outer(scales, [-1.0, 1.0])
    np.testing.assert_allclose(mean_actions(agent, state, tasks, [-1.0, 1.0]), best, atol=0.35)
