"""Every agent learns to reach goals that differ, on a CPU, in seconds. Few by default; ``-m nightly`` runs the rest."""

import pytest

from mtjax.agents import AGENTS
from mtjax.loop import Settings

GOALS = "0.02,0.1,0.2"  # places of one arc, so that one policy serves none of them well
SETTINGS = Settings(
    num_envs=16, batch_size=32, replay_size=20_000, warmup_steps=200, chunk_steps=500, updates_per_step=1
)
QUICK = {
    "hidden": (64, 64),
    "actor_lr": 2e-3,
    "critic_lr": 2e-3,
    "temperature_lr": 2e-3,
    "tau": 0.02,
    "initial_temperature": 0.02,
    "gamma": 0.98,
}
USUAL = ("sac-conditioned", "multi-head", "soft-modularization", "hip-bmdp")
EVERY = [pytest.param(name, marks=[] if name in USUAL else pytest.mark.nightly) for name in AGENTS if name != "sac"]
