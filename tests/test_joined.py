"""Families of a mixture that share a simulator: every one steps as it does alone."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs

import mtjax
from mtjax.envs.mixtures import Mixture
from mtjax.envs.shared_simulator import Alone, Joined
from mtjax.learning.rollout import broadcast_tasks

STEPS, WORLDS = 3, 2
PENDULUMS = {"pendulum-swingup": {"mass": "0.8,1.2"}, "pendulum-spin": {"mass": "1.5", "damping": "0.2"}}


def members(env: Mixture) -> list[list[str]]:
    """The names of the families of each group."""
    return [[env.names[i].removeprefix("metaworld-") for i in group.members] for group in env.groups]


def played(env, split, places=None):
    """Observations, rewards and metrics of a few steps of a whole split. A part is given its places in the mixture."""
    tasks = env.tasks(split)
    places = np.arange(len(tasks.id)) if places is None else places
    keys = jax.random.split(jax.random.key(0), (1, 20, WORLDS))[:, places]
    actions = jax.random.uniform(jax.random.key(1), (STEPS, 1, 20, WORLDS, 8), minval=-1.0)[:, :, places]
    each = broadcast_tasks(tasks, keys.shape)._replace(blocks=tasks.blocks)

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    def play(each, keys, actions):
        def step(state, action):
            after = env.step_worlds(each, state, action[..., : env.spec.action_size])
            return after.state, (after.obs, after.reward, after.metrics)

        first = env.reset_worlds(each, keys)
        obs, *rest = jax.lax.scan(step, first.state, actions)[1]
        return jnp.concatenate([first.obs[None], obs]), *rest

    return play(each, keys, actions)


def require_as_alone(env: Mixture, split="train", atol=0.0):
    """Compare every family's steps in the mixture with those of the family alone. Rewards may be rounded otherwise."""
    obs, rewards, metrics = played(env, split)
    for part in env.parts:
        places = part.places[split]
        if not len(places):
            continue
        own_obs, own_rewards, own_metrics = played(part.family, split, places)
        np.testing.assert_allclose(obs[:, :, places, :, : own_obs.shape[-1]], own_obs, rtol=0, atol=atol)
        np.testing.assert_allclose(rewards[:, :, places], own_rewards, atol=max(10 * atol, 1e-6))
        for name, own in own_metrics.items():
            np.testing.assert_array_equal(metrics[name][:, :, places], own)


@pytest.mark.slow
def test_families_of_one_structure_share_a_simulator():
    """Masses differ, and so do the rows of each family; a family of another structure stays alone."""
    families = [mtjax.make(name, vary, engine="c") for name, vary in PENDULUMS.items()]
    env = mtjax.mixture([*families, mtjax.make("acrobot-swingup", engine="c")])
    assert members(env) == [["pendulum-swingup", "pendulum-spin"], ["acrobot-swingup"]]
    assert [type(group) for group in env.groups] == [Joined, Alone]
    require_as_alone(env)
    calls = {name: about for name, about in env.calls.targets().items() if name.startswith("mujoco_advance")}
    assert len(calls) == 2 + 2  # the mixture's, and those of joined families alone
    again = mtjax.mixture([*families, mtjax.make("acrobot-swingup", engine="c")])
    assert all(again.calls.provide(*about) == name for name, about in calls.items())  # as another process does


@pytest.mark.slow
def test_starts_of_one_structure_are_solved_for_together():
    """In one call, which feels the weight of each dog; a start of its own remains the family's."""
    dogs = [mtjax.make(name, {"mass": mass}, engine="c") for name, mass in (("dog-stand", "0.8,1.2"), ("dog-run", "1"))]
    env = mtjax.mixture(dogs)
    require_as_alone(env)
    shape = (1, len(env.tasks().id), WORLDS)
    each = broadcast_tasks(env.tasks(), shape)._replace(blocks=env.tasks().blocks)
    program = str(jax.make_jaxpr(env.reset_worlds)(each, jax.random.split(jax.random.key(0), shape)))
    assert len(re.findall("mujoco_solve", program)) == 1


def test_settings_of_physics_keep_families_apart():
    make = partial(mtjax.make, engine="c")
    assert len(mtjax.mixture([make("pendulum-swingup"), make("pendulum-spin", repeat=2)]).groups) == 2
    mjx = partial(mtjax.make, engine="mjx")
    few = mjx("pendulum-spin", solver_iterations=7)
    assert members(mtjax.mixture([mjx("pendulum-swingup"), few, mjx("pendulum-swingup", {"mass": "1:2:2"})])) == [
        ["pendulum-swingup", "pendulum-swingup#2"],
        ["pendulum-spin"],
    ]


@pytest.mark.slow
@needs("metaworld")
def test_meta_worlds_tasks_of_one_scene_step_together():
    """Goals move the window in both. One split has a task of the second family alone."""
    settings = {"num_draws": 2, "engine": "c"}
    windows = [mtjax.make(f"metaworld-window-{what}", **settings) for what in ("open", "close")]
    require_as_alone(mtjax.mixture(windows))
    held = mtjax.make("metaworld-window-close", held_out=True, **settings)
    require_as_alone(mtjax.mixture([windows[0], held]), "extrapolation")


@needs("metaworld")
def test_ten_tasks_of_meta_world_are_six_simulators():
    assert members(mtjax.make("mt10", num_draws=1, engine="c")) == [
        ["reach", "push", "pick-place"],
        ["door-open"],
        ["drawer-open", "drawer-close"],
        ["button-press-topdown"],
        ["peg-insert-side"],
        ["window-open", "window-close"],
    ]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["mjx", pytest.param("warp", marks=needs("warp"))])
def test_families_step_together_on_every_engine(engine):
    env = mtjax.mixture([mtjax.make(name, vary, engine=engine) for name, vary in PENDULUMS.items()])
    assert len(env.groups) == 1
    require_as_alone(env, atol=1e-5)


@needs("metaworld")
@pytest.mark.slow
@needs("warp")
def test_meta_world_steps_together_on_warp():
    settings = {"num_draws": 2, "engine": "warp"}
    env = mtjax.mixture([mtjax.make(f"metaworld-{name}", **settings) for name in ("reach", "push", "pick-place")])
    assert len(env.groups) == 1 and jnp.size(env.tasks().id) == 3
    require_as_alone(env, atol=1e-4)
