"""Meta-World's tasks, against recorded episodes of the original (tests/record_metaworld.py).

What is observed, rewarded and called success follows from recorded poses; starts are played again with the real scenes.
"""

import importlib.util
import pkgutil
import re
from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mtjax.envs.metaworld
from mtjax.envs.metaworld.at import At
from mtjax.envs.metaworld.host import Host
from mtjax.envs.metaworld.sawyer import Sawyer

FOLDER = Path(__file__).parent / "data" / "metaworld"
QUICK = ("assembly", "bin-picking", "coffee-pull", "door-open", "reach")
INSTALLED = importlib.util.find_spec("metaworld") is not None


def every_task(cls=Sawyer):
    """Return the classes of all tasks by Meta-World's names, such as "door-open"."""
    for module in pkgutil.iter_modules(mtjax.envs.metaworld.__path__):
        import_module(f"mtjax.envs.metaworld.{module.name}")
    below = [task for child in cls.__subclasses__() for task in every_task(child).values()]
    classes = [x for x in (cls, *below) if not x.__abstractmethods__]
    return {re.sub(r"(?<=[a-z])(?=[A-Z])", "-", x.__name__).lower(): x for x in classes}


TASKS = every_task()
quick_or_slow = pytest.mark.parametrize(
    "name", [pytest.param(x, marks=() if x in QUICK else pytest.mark.slow) for x in sorted(TASKS)]
)
with_scenes = pytest.mark.skipif(not INSTALLED, reason="Meta-World's scenes are not installed")


def load(name):
    """Return the recorded arrays of a task, by name."""
    with np.load(FOLDER / f"{name}.npz") as file:
        return dict(file)


def seen(recorded, task):
    """Return what rewards read of the recorded steps (K, ...), and the constants of their episodes."""
    column = {place: i for i, place in enumerate(recorded["watched"])}
    poses = {short: recorded["pose"][:, column[place]] for short, place in task.watched.items()}
    position, quat = ({short: pose[:, part] for short, pose in poses.items()} for part in (np.s_[:3], np.s_[3:]))
    obs = np.insert(recorded["obs"], [18] * 18, 0, axis=1)  # rewards do not read the step before
    places = (recorded[key] for key in ("tcp", "left_pad", "right_pad"))
    began = {key[6:]: x[recorded["episode"]] for key, x in recorded.items() if key.startswith("const_")}
    return At(obs, recorded["action"], *places, position, quat, recorded["qpos"]), began


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
    for ours, theirs in zip(
        ((task.hand_low, task.goal_low, task.drawn[0]), (task.hand_high, task.goal_high, task.drawn[1])),
        recorded["boxes"],
        strict=True,
    ):
        np.testing.assert_allclose(np.concatenate(ours), theirs, atol=1e-12)
    np.testing.assert_allclose(recorded["start_mocap"][:, :3], [task.hand_start] * 2, atol=1e-6)
    assert all(task.allowed(vec) for vec in recorded["rand_vec"])


@with_scenes
@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TASKS))
def test_episodes_begin_as_those_of_the_original(name):
    """Things lie where they did, and rewards compare with the same, but for what MuJoCo's versions do unalike."""
    task, recorded = TASKS[name](), load(name)
    settled = Host(task._compile({})).settle(task.hand_start)
    for episode, vec in enumerate(recorded["rand_vec"]):
        start = task.begin(settled, settled.content(), vec)
        for key, value in start.began.items():
            np.testing.assert_allclose(value, recorded[f"const_{key}"][episode], atol=2e-4, err_msg=key)
        arm = start.model.joint("right_j0").qposadr[0] + np.arange(7)
        off = np.abs(start.state["qpos"] - recorded["start_qpos"][episode])
        assert np.delete(off, arm).max() < 1e-4 and off[arm].max() < 0.05
        np.testing.assert_allclose(start.state["mocap"][0], recorded["start_mocap"][episode], atol=1e-6)
