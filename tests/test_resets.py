"""New episodes: of the worlds that have ended alone, each in a fresh state of its own, whatever else is reset."""

import dataclasses
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import one_in, slow_but, tiny

from mtjax import envs
from mtjax.envs import Family, Parameter
from mtjax.learning import rollout
from mtjax.learning.trials import EACH_EPISODE
from mtjax.types import Step

SHAPE = (2, 3, 40)  # S, T, E


@dataclasses.dataclass(frozen=True)
class Fall(Family):
    """Ends where the state is below 0. Its starts are uniform, and tell their task."""

    parameters: ClassVar = {"shift": Parameter("1", 0.0)}
    action_size: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 50
    counted: ClassVar[list] = []

    def reset_worlds(self, tasks, keys):
        jax.debug.callback(lambda: self.counted.append(keys.size))
        return super().reset_worlds(tasks, keys)

    def reset(self, task, key):
        start = jax.random.uniform(key) + 10 * task.goal["shift"]
        return Step(start, start[None], jnp.float32(0), jnp.bool_(False))

    def step(self, task, state, action):
        return Step(state - 0.1, state[None], jnp.float32(0), state < 0)


@dataclasses.dataclass(frozen=True)
class Timed(Fall):
    """The same, whose worlds are all reset at once."""

    @property
    def ends_early(self):
        return False


@dataclasses.dataclass(frozen=True)
class Cheap(Fall):
    """The same, whose starts cost little."""

    cheap_starts: ClassVar[bool] = True


def reset(cls, ended, seed=1, shift="1,2,3", **settings):
    """Begin new episodes where worlds have ended; return them, those before, and the worlds that were reset."""
    env, agent = cls(vary={"shift": shift}, split="none", **settings), tiny("sac")
    tasks = env.tasks()
    key = lambda seed: jax.random.split(jax.random.key(seed), SHAPE[0])
    learners = jax.vmap(lambda key: agent.init(env.spec, tasks, key))(key(5))
    before = rollout.reset_envs(
        env, agent, learners, tasks, rollout.world_keys(key(0), (SHAPE[0], len(tasks.id), SHAPE[2]))
    )
    before = before._replace(age=before.age + 7)

    def begin(worlds, ended, keys):
        ends, keys = EACH_EPISODE.ends(ended, ended, ended, None), partial(rollout.world_keys, keys, ended.shape)
        return rollout.reset_ended(env, agent, learners, tasks, worlds, ends, keys)[0]

    run = jax.jit(begin)
    Fall.counted.clear()
    after = jax.block_until_ready(run(before, ended, key(seed)))
    jax.effects_barrier()
    return before, after, sum(Fall.counted)


@pytest.mark.parametrize("share", slow_but([0, 0.01, 0.1, 1], 0.1))
@pytest.mark.parametrize("shift", ["1,2,3", "1:2"])
@pytest.mark.slow
def test_some_worlds_are_reset_to_the_states_that_all_would_have(share, shift):
    """Bit for bit, also where episodes draw their tasks; and no more worlds than had to be."""
    shape = (SHAPE[0], 3 if "," in shift else 1, SHAPE[2])
    ended = np.random.RandomState(0).uniform(size=shape) < share
    before, some, count = reset(Fall, ended, shift=shift)
    _, whole, all_of_them = reset(Timed, ended, shift=shift)
    jax.tree.map(np.testing.assert_array_equal, some, whole)
    np.testing.assert_array_equal(np.asarray(some.age), np.where(ended, 0, 7))
    np.testing.assert_array_equal(some.state[~ended], before.state[~ended])
    batch = -(-ended.size // Fall.reset_batches)
    assert count == -(-ended.sum() // batch) * batch and all_of_them == ended.size * np.any(ended)


@pytest.mark.parametrize("shift", one_in(2, ["1,2,3", "1:2"]))
def test_cheap_starts_of_a_gpu_are_those_of_all_ways(shift, monkeypatch):
    """It resets all worlds without a branch, about which the host would decide; a CPU resets those that have ended."""
    shape = (SHAPE[0], 3 if "," in shift else 1, SHAPE[2])
    ended = np.random.RandomState(0).uniform(size=shape) < 0.1
    _, some, count = reset(Cheap, ended, shift=shift)
    programs = []

    def of_a_gpu(*given, cuda, default):
        programs.append([str(jax.make_jaxpr(way)(*given)) for way in (cuda, default)])
        return cuda(*given)

    monkeypatch.setattr(jax.lax, "platform_dependent", of_a_gpu)
    _, whole, all_of_them = reset(Cheap, ended, shift=shift)
    jax.tree.map(np.testing.assert_array_equal, some, whole)
    assert count < ended.size == all_of_them
    branches = [["cond[" in program, "while[" in program] for program in programs[0]]
    assert branches == [[False, False], [True, True]]


def test_starts_are_fresh_and_follow_their_law():
    """No two worlds share a start, no start comes again, and each task's are uniform."""
    ended = np.random.RandomState(0).uniform(size=SHAPE) < 0.3
    seen = [np.asarray(reset(Fall, ended, seed)[1].state)[ended] for seed in range(3)]
    starts = np.concatenate(seen)
    assert len(np.unique(starts)) == len(starts)
    tasks = np.broadcast_to(np.arange(1, 4)[:, None], SHAPE)[ended]
    np.testing.assert_array_equal(seen[0] // 10, tasks)
    cumulative = np.sort(starts % 10)
    assert np.max(np.abs(cumulative - np.linspace(0, 1, len(cumulative)))) < 1.63 / np.sqrt(len(cumulative))


def test_families_say_whether_episodes_end_early():
    """By what they write; a family that steps itself may."""
    early = {name: envs.make(name).ends_early for name in ("walker-walk", "corridor-maze", "control-cartpole")}
    assert early == {"walker-walk": False, "corridor-maze": True, "control-cartpole": True}
