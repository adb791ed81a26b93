"""The published families of HiP-BMDP (Zhang et al. 2021): every task is dm_control's file with one attribute edited."""

import re

import numpy as np
import pytest
from needs import require

from mtjax import envs

LEG = r'(<geom name="[bf](?:thigh|shin|foot)".*? size=")0.046'
FOOT_SIZES = [0.046, 0.0552, 0.0598, 0.0644, 0.069, 0.0736, 0.0782, 0.0828, 0.0874, 0.092]
# Family -> file, pattern in it, and what takes the pattern's place in task i = 0 ... 9.
PUBLISHED = {
    "cheetah-run-vary-torso-length": (
        "cheetah.xml",
        r"-\.5 0 0 \.5 0 0",
        lambda i: f"-{0.5 + 0.1 * i:.1f} 0 0 {0.5 + 0.1 * i:.1f} 0 0",
    ),
    "cheetah-run-vary-foot-size": ("cheetah.xml", LEG, lambda i: rf"\g<1>{FOOT_SIZES[i]}"),
    "cheetah-run-vary-foot-position": (
        "cheetah.xml",
        r'(body name="[bf]thigh" pos="-?)\.5',
        lambda i: rf"\g<1>{0.5 - 0.02 * i:.2f}",
    ),
    "cheetah-run-vary-back-foot-length": (
        "cheetah.xml",
        r'-\.097" euler="0 -15 0" size="0.046 \.094',
        lambda i: f'-{0.097 + 0.01 * i:.3f}" euler="0 -15 0" size="0.046 {0.094 + 0.01 * i:.3f}',
    ),
    "walker-walk-vary-friction": ("walker.xml", r'friction="\.7', lambda i: f'friction="{0.7 + 0.1 * i:.1f}'),
    "walker-run-vary-friction": ("walker.xml", r'friction="\.7', lambda i: f'friction="{0.7 + 0.1 * i:.1f}'),
    "walker-walk-vary-foot-length": (
        "walker.xml",
        r'(name="left_foot" zaxis="1 0 0" size="0.05 )0.1',
        lambda i: rf"\g<1>{0.08 + 0.01 * i:.2f}",
    ),
    "walker-run-vary-foot-length": (
        "walker.xml",
        r'(name="left_foot" zaxis="1 0 0" size="0.05 )0.1',
        lambda i: rf"\g<1>{0.08 + 0.01 * i:.2f}",
    ),
}
DYNAMICS = ("body_", "jnt_", "dof_", "geom_", "actuator_", "qpos")
NOT_DYNAMICS = ("bvh", "rgba", "matid", "contype", "conaffinity")


def differing(ours, theirs):
    fields = [f for f in dir(ours) if f.startswith(DYNAMICS) and not any(word in f for word in NOT_DYNAMICS)]
    assert len(fields) > 90
    return {f for f in fields if not np.allclose(getattr(ours, f), getattr(theirs, f), rtol=1e-9, atol=1e-12)}


@pytest.mark.parametrize("name", PUBLISHED)
def test_tasks_are_the_published_ones_in_their_order(name):
    """The compiled models of the first, second, sixth and last task agree in every field of the dynamics."""
    file, pattern, edited = PUBLISHED[name]
    common, wrapper = require("dm_control.suite.common"), require("dm_control.mujoco.wrapper")
    models, original = envs.make(name, split="none").models, common.read_model(file).decode()
    assert len(models) == 10
    for i in (0, 1, 5, 9):
        xml, count = re.subn(pattern, edited(i), original)
        assert count == {LEG: 6}.get(pattern, 2 if "thigh" in pattern else 1)
        assert differing(models[i], wrapper.MjModel.from_xml_string(xml, common.ASSETS).ptr) == set()


def test_agents_of_the_published_split_meet_the_published_tasks():
    """Numbers 3, 4, 7 and 8 train, counted from 0 in the order of the files, whichever way the values run."""
    env = envs.make("cheetah-run-vary-foot-position", split="hip-bmdp")
    values = {split: env.tasks(split).params["foot-position"] for split in env.table.rows}
    np.testing.assert_allclose(values["train"], [0.44, 0.42, 0.36, 0.34], atol=1e-6)
    np.testing.assert_allclose(values["interpolation"], [0.4, 0.38], atol=1e-6)
    np.testing.assert_allclose(values["extrapolation"], [0.46, 0.32], atol=1e-6)
