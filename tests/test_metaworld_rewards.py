"""Meta-World's tasks, against recorded episodes of the original (tests/record_metaworld.py).

What is observed, rewarded and called success follows from recorded poses; starts are played again with the real scenes.
"""

from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs

from mtjax.envs.compiled import compile_model
from mtjax.envs.engines.base import World
from mtjax.envs.metaworld import names
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.observables import Observables, shown
from mtjax.envs.metaworld.starts import begin

FOLDER = Path(__file__).parent / "data" / "metaworld"
QUICK = ("assembly", "bin-picking", "coffee-pull", "door-open", "reach")
LOOSE = ("bin-picking", "door-close")  # a cube begins inside a wall, which throws it out; the hand still swings


def find(place):
    """Return the class at "module:Class"."""
    module, _, name = place.partition(":")
    return getattr(import_module(f"mtjax.envs.metaworld.{module}"), name)


TASKS = {name: find(place) for name, place in names.TASKS.items()}
quick_or_slow = pytest.mark.parametrize(
    "name", [pytest.param(x, marks=() if x in QUICK else pytest.mark.slow) for x in sorted(TASKS)]
)


def load(name):
    """Return the recorded arrays of a task, by name."""
    with np.load(FOLDER / f"{name}.npz") as file:
        return dict(file)


def seen(recorded, task):
    """Return what rewards read of the recorded steps (K, ...), and the constants of their episodes."""
    column = {place: i for i, place in enumerate(recorded["watched"])}
    read = {short: place for short, place in task.watched.items() if place in column}  # others are of its scene
    poses = {short: recorded["pose"][:, column[place]] for short, place in read.items()}
    position, quat = ({short: pose[:, part] for short, pose in poses.items()} for part in (np.s_[:3], np.s_[3:]))
    obs = np.insert(recorded["obs"], [18] * 18, 0, axis=1)  # rewards do not read the step before
    places = (recorded[key] for key in ("tcp", "left_pad", "right_pad"))
    began = {key[6:]: x[recorded["episode"]] for key, x in recorded.items() if key.startswith("const_")}
    press = recorded.get("press", np.zeros((len(obs), 0)))
    return Observables(obs, recorded["action"], *places, position, quat, recorded["qpos"], press), began


@quick_or_slow
def test_observations_rewards_and_success_are_those_of_the_original(name):
    """From the poses of things, along scripted episodes with and without noise."""
    task, recorded = object.__new__(TASKS[name]), load(name)
    at, began = seen(recorded, task)
    both = jax.jit(jax.vmap(lambda at, began: (jnp.concatenate(task.objects(at)), *task.evaluate(at, began))))
    objects, reward, success = both(at, began)
    expected = np.zeros_like(recorded["obs"][:, 4:18])
    expected[:, : objects.shape[1]] = objects
    np.testing.assert_allclose(expected, recorded["obs"][:, 4:18], atol=1e-5)
    np.testing.assert_allclose(reward, recorded["reward"], atol=1e-4)
    np.testing.assert_array_equal(success, recorded["success"])
    assert success.any() and not success.all() and np.ptp(reward) > 0.5


@pytest.mark.parametrize("name", sorted(TASKS))
def test_goals_are_drawn_and_the_hand_moves_in_the_boxes_of_the_original(name):
    task, recorded = object.__new__(TASKS[name]), load(name)
    goals = task.goal_box or [vec[3:] for vec in task.drawn]
    ends = zip((task.hand_low, task.hand_high), goals, task.drawn, strict=True)
    for ours, theirs in zip(ends, recorded["boxes"], strict=True):
        np.testing.assert_allclose(np.concatenate(ours), theirs, atol=1e-12)
    np.testing.assert_allclose(recorded["start_mocap"][:, :3], [task.hand_start] * 2, atol=1e-6)
    assert all(task.allowed(vec) for vec in recorded["rand_vec"])


@needs("metaworld")
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
def test_episodes_begin_as_those_of_the_original(name):
    """Things lie and are seen as they did, and rewards compare with the same, within what MuJoCo's versions differ."""
    task, recorded = TASKS[name](), load(name)
    settled, off = Host(compile_model(task, {})).settle(task.hand_start), 4e-3 if name in LOOSE else 1e-3
    for episode, vec in enumerate(recorded["rand_vec"]):
        start = begin(task, settled, settled.content(), vec)
        began = {key: recorded[f"const_{key}"][episode] for key in start.began}
        jax.tree.map(lambda ours, theirs: np.testing.assert_allclose(ours, theirs, atol=off), start.began, began)
        state = {key: np.float32(x) for key, x in start.state.items()}
        objects = np.concatenate(task.objects(shown(World(extra=None, **state), task.watched)))
        np.testing.assert_allclose(objects, recorded["start_obs"][episode, 4 : 4 + objects.size], atol=off)
        arm = start.model.joint("right_j0").qposadr[0] + np.arange(7)
        qpos = np.abs(state["qpos"] - recorded["start_qpos"][episode])
        assert np.delete(qpos, arm).max() < 1e-3 and qpos[arm].max() < 0.05
