"""Environments outside of JAX: the same steps as the original's, in the loop, evaluations and films."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import require

import mtjax
import mtjax.train
from mtjax import rollout
from mtjax.envs.hosted.gymnasium import Separate
from mtjax.types import Acted

gymnasium = require("gymnasium")
spaces = gymnasium.spaces


class Walk(gymnasium.Env):
    """A walk on a line. It terminates at its ends, truncates by itself, and raises where it is told to."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 25}  # noqa: RUF012
    observation_space = spaces.Box(-100, 100, (2,), np.float64)
    action_space = spaces.Box(np.float32([-1, 0]), np.float32([3, 10]), (2,), np.float32)

    def __init__(self, scale: float = 1.0, end: int = 6, patience: int = 9, raises: int = 0, render_mode=None):
        if not 0 < scale < 5:
            raise ValueError("scale is of no walk")
        self.scale, self.end, self.patience, self.raises, self.render_mode = scale, end, patience, raises, render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.age, self.over = self.np_random.uniform(-1, 1), 0, False
        return self._look(), {}

    def step(self, action):
        assert not self.over and self.action_space.contains(action), "a step after the end, or out of bounds"
        return self._move(action)

    def _move(self, action):
        self.place, self.age = self.place + self.scale * action[0] + 0.01 * self.np_random.normal(), self.age + 1
        if self.age == self.raises:
            raise ZeroDivisionError("the walk broke")
        terminated, truncated = abs(self.place) > self.end, self.age >= self.patience
        self.over = terminated or truncated
        return self._look(), float(self.place - action[1]), bool(terminated), bool(truncated), {}

    def _look(self):
        return np.array([self.place, self.age])

    def render(self):
        return np.full((30, 40, 3), 10 * self.age, np.uint8)


class Seen(Walk):
    """Pictures of a walk, with the channels first."""

    observation_space = spaces.Box(0, 255, (3, 20, 24), np.uint8)
    action_space = spaces.Discrete(3, start=-1)

    def _move(self, action):
        return super()._move(np.float32([action, 0]))

    def _look(self):
        return np.full((3, 20, 24), self.age, np.uint8) + np.arange(3, dtype=np.uint8)[:, None, None]


PLAYED = {"num_envs": 4, "chunk_steps": 32, "unroll": 16, "minibatches": 2, "epochs": 1, "hidden": (8,)}
QUIET = {"quiet": True, "eval_episodes": 2}


@pytest.fixture(scope="module", autouse=True)
def registered():
    """Gives the walks names in Gymnasium's registry."""
    gymnasium.register("Walk", Walk, max_episode_steps=7)
    gymnasium.register("Seen", Seen, max_episode_steps=7)
    yield
    for name in ("Walk", "Seen"):
        gymnasium.registry.pop(name)


class Random:
    """An agent that acts at random and learns nothing."""

    def __init__(self, spec):
        self.spec = spec

    def begin(self, state, task):
        return ()

    def act(self, state, memory, obs, task, key):
        return Acted(self.spec.action.random(key))


def play(family, steps, num_envs=3):
    """Play all tasks by random actions as training does. Return the steps, leaves (H, S, T, E, ...)."""
    agent, learners, tasks = Random(family.spec), jnp.zeros(1), family.tasks("train")
    keys = lambda key: jax.random.split(key, (1, len(tasks.id), num_envs))

    def step(worlds, key):
        worlds, env_step = rollout.step_envs(family, agent, learners, tasks, worlds, keys(key))
        fresh = lambda: keys(jax.random.fold_in(key, 1))
        begun = rollout.reset_ended(family, agent, learners, tasks, worlds, env_step.ends, fresh)
        return begun, (env_step.transition, env_step.ends.terminal, worlds.state)

    @jax.jit
    def whole(key):
        worlds = rollout.reset_envs(family, agent, learners, tasks, keys(key))
        return jax.lax.scan(step, worlds, jax.random.split(key, steps))[1]

    return jax.device_get(whole(jax.random.key(3)))


@pytest.fixture
def begun(monkeypatch):
    """The row and the seeds of all episodes that begin in this test, by the place of their world."""
    found, begin = {}, Separate.begin

    def noted(self, places, rows, seeds):
        for place, row, seed in zip(places.tolist(), rows.tolist(), seeds.tolist(), strict=True):
            found.setdefault(place, []).append((row, seed))
        return begin(self, places, rows, seeds)

    monkeypatch.setattr(Separate, "begin", noted)
    return found


def original_steps(family, episodes, actions):
    """The steps of the original environment with its own time limit, by the rows and seeds of its episodes."""
    episodes, found, over = iter(episodes), [], True
    for action in actions:
        if over:
            row, seed = next(episodes)
            limit = {"max_episode_steps": family.time_limit} if family.time_limit else {}
            original = gymnasium.make(family.environment, **limit, **family.arguments_of(row))
            obs, _ = original.reset(seed=seed)
        before = obs
        obs, reward, terminated, truncated, _ = original.step(family.actor.read(action))
        over = terminated or truncated
        found.append((before, obs, reward, terminated, over))
    return [np.array(x) for x in zip(*found, strict=True)]


@pytest.mark.parametrize(
    ("name", "settings", "kinds"),
    [
        ("Walk", {"vary": {"scale": "0.5:1.5:2"}, "split": "none"}, 2),
        ("Walk", {"time_limit": 30, "end": 20}, 1),  # it truncates by itself
        ("Walk", {"vary": {"scale": "1:4"}, "num_draws": 5, "split": "none"}, 2),  # every episode draws its own
        ("Seen", {"end": 3}, 2),
        ("CartPole-v1", {"time_limit": 25}, 2),
        ("Pendulum-v1", {"vary": {"g": "5,10"}, "split": "none"}, 1),
        ("MountainCarContinuous-v0", {"time_limit": 50}, 1),
    ],
)
def test_steps_are_the_originals(name, settings, kinds, begun):
    """Observations, rewards and ends of 400 steps, across episodes that terminate and that time cuts off."""
    family = mtjax.hosted(name, **settings)
    transition, terminal, _ = play(family, 400)
    obs, next_obs = ((x["pixels"] if family.pixels else x) for x in (transition.obs, transition.next_obs))
    num_tasks = family.train_count
    if family.pixels:
        obs = obs[..., -family.spec.obs["pixels"].shape[-1] :]
        next_obs = next_obs[..., -family.spec.obs["pixels"].shape[-1] :]
    for place, (task, world) in enumerate(np.ndindex(num_tasks, 3)):
        own = lambda x, task=task, world=world: x[:, 0, task, world]
        theirs = original_steps(family, begun[place], own(transition.action))
        for ours, original in zip((own(obs), own(next_obs)), theirs[:2], strict=True):
            np.testing.assert_array_equal(ours, np.stack([family.reader.read(x) for x in original]))
        np.testing.assert_array_equal(own(transition.reward), np.float32(theirs[2]))
        np.testing.assert_array_equal(own(terminal), theirs[3])
        np.testing.assert_array_equal(own(transition.ended), theirs[4])
        np.testing.assert_array_equal(own(transition.discount), 1.0 - theirs[3])
    ended = transition.ended
    assert ended.any() and len({bool(x) for x in terminal[ended]}) == kinds
    assert all(len(episodes) > 2 for episodes in begun.values()) or family.episode_length > 150
