"""The ladder from told to blind: what every rung plays, and what tables make of trials."""

import argparse
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

import mtjax
from mtjax.learning.evaluation import Evaluations, save_evaluations

FOLDER = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def ladder(monkeypatch):
    """The benchmark's module."""
    monkeypatch.syspath_prepend(str(FOLDER))
    before = set(sys.modules)
    yield importlib.import_module("adaptation")
    for name in set(sys.modules) - before:
        if str(FOLDER) in str(getattr(sys.modules[name], "__file__", None)):
            sys.modules.pop(name)


def evaluations_of(returns, trial):
    """Evaluations whose training tasks earn (S, V, T, episodes)."""
    none = np.zeros((*returns.shape[:2], 0, returns.shape[3]))
    splits = {"train": returns, "interpolation": none, "extrapolation": none}
    values = {split: np.arange(x.shape[2]) for split, x in splits.items()}
    return Evaluations(np.arange(returns.shape[1]), splits, values, trial=trial)


def test_returns_are_means_over_trials_by_their_episodes(ladder):
    """Of the last evaluation; the episodes of a trial stand one after another."""
    returns = np.zeros((1, 2, 1, 4))
    returns[0, 1, 0] = [1, 10, 3, 20]
    assert ladder.scores_of(evaluations_of(returns, 2)).keys() == {"train"}
    np.testing.assert_array_equal(ladder.scores_of(evaluations_of(returns, 2))["train"], [[[2, 15]]])
    np.testing.assert_array_equal(ladder.scores_of(evaluations_of(returns, 1))["train"], [[[8.5]]])


def test_the_ladder_tells_first_and_last_episode_and_paired_differences(ladder, tmp_path):
    """A rung without a trial of several episodes has one return for all of them."""
    (tmp_path / "grid-navi").mkdir()
    of_seeds = np.array([0.0, 1.0, 2.0])[:, None, None, None]
    earned = {
        "told": ([40.0, 40.0], 2),
        "rl2": ([20.0, 38.0], 2),
        "blind": ([10.0, 10.0], 2),
        "last-steps": ([12.0] * 2, 1),
    }
    for rung, (episodes, trial) in earned.items():
        evaluations = evaluations_of(of_seeds + np.array(episodes), trial)
        save_evaluations(tmp_path / "grid-navi" / f"{rung}.npz", evaluations)
    table = ladder.tabulate(tmp_path).splitlines()
    assert [line.split("|")[2].strip() for line in table[2:]] == ["told", "blind", "last-steps", "rl2"]
    assert table[5] == "| grid-navi | rl2 | 3 | train | 1 | 21 [20, 22] | 39 [38, 40] | 30 [29, 31] |"
    assert "| last-steps | 3 | train | 1 | 13 [12, 14] | 13 [12, 14] |" in table[4]
    differences = (tmp_path / "differences.md").read_text()
    assert "| grid-navi | rl2 | train | told | -2.0 [-2.0, -2.0] |" in differences
    assert "| grid-navi | rl2 | train | blind | +28.0 [+28.0, +28.0] |" in differences
    assert (tmp_path / "grid-navi-ladder.png").stat().st_size > 0


def given(**more):
    return argparse.Namespace(env=["size=3"], training=["unroll=18"], eval_trials=5, trials=3, split=None, **more)


@pytest.mark.parametrize(
    ("rung", "words", "trials"),
    [("told", ["size=3", "told=true"], 3), ("rl2", ["size=3"], 3), ("last-steps", ["size=3"], 1)],
)
def test_every_rung_plays_as_many_episodes_and_only_one_is_told(ladder, rung, words, trials):
    found = ladder.request(given(), "grid-navi", rung)
    assert found.env == words and found.training == ["unroll=18", f"trials={trials}"] and found.eval_episodes == 15


def test_a_family_whose_context_tells_the_task_is_not_asked_to(ladder):
    found = ladder.request(argparse.Namespace(**{**vars(given()), "env": []}), "point-mass-vary-goal", "told")
    assert found.env == []


def test_rungs_differ_in_what_they_see_alone(ladder):
    """All have PPO's preset, and ``rl2`` has it too where it is chosen by its name."""
    settings = lambda agent, **own: mtjax.agents.settings(mtjax.preset("grid-navi", agent, "cpu", own).learner)
    plain, seeing = settings("ppo"), {"conditioning", "inference"}
    for agent, own in ladder.learning.LADDER.values():
        found = settings(agent, **own)
        assert all(found[name] == x for name, x in plain.items() if name in found and name not in seeing)
    assert settings("rl2") == settings(*ladder.learning.LADDER["rl2"][:1], **ladder.learning.LADDER["rl2"][1])
    loops = [mtjax.preset("grid-navi", agent, "cpu").training for agent in ("ppo", "rl2", "impala")]
    assert loops[0] == loops[1] != loops[2]
