"""Pictures as observations: stacks, repeated actions, looks as parameters, and what is refused."""

import dataclasses
from functools import lru_cache

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import needs
from probes import METAWORLD, slow_but

import mtjax
from mtjax.envs import ENVS
from mtjax.envs.domain import Domain
from mtjax.envs.pixels import Pictured
from mtjax.types import InputError

SIZE = 16


@lru_cache
def pictured(name="pendulum-swingup", **settings):
    settings = {key: dict(x) if key == "vary" else x for key, x in settings.items()}
    return mtjax.make(name, pixels=SIZE, engine="c", **settings)


def first(env):
    return jax.tree.map(lambda x: x[0], env.tasks())


def play(env, actions, task=None):
    """The steps of an episode from one seed, compiled once for reset and once for step."""
    task = first(env) if task is None else task
    steps = [jax.jit(env.reset)(task, jax.random.key(0))]
    advance = jax.jit(env.step)
    for action in actions:
        steps.append(advance(task, steps[-1].state, jnp.float32([action])))
    return steps


ACTIONS = (1.0, -1.0, 0.5, 1.0, 1.0, -0.5)


@pytest.mark.slow
def test_observation_is_the_newest_picture_and_the_state_family_s_own():
    env, plain = pictured(state="also"), mtjax.make("pendulum-swingup", engine="c")
    assert env.spec.obs["pixels"] == jax.ShapeDtypeStruct((SIZE, SIZE, 3), jnp.uint8) and env.spec.frames == 3
    assert set(pictured().spec.obs) == {"pixels"}
    for ours, theirs in zip(play(env, ACTIONS[:3]), play(plain, ACTIONS[:3]), strict=True):
        np.testing.assert_allclose(ours.obs["state"], theirs.obs, atol=1e-6)
        np.testing.assert_allclose(ours.reward, theirs.reward, atol=1e-6)


@pytest.mark.slow
def test_stacks_repeat_the_first_picture_and_then_move_on():
    env = pictured()
    single, stacks = play(env, ACTIONS), play(mtjax.stacked(env), ACTIONS)
    pictures = [np.asarray(step.obs["pixels"]) for step in single]
    assert len({picture.tobytes() for picture in pictures}) == len(pictures)
    newest = [np.asarray(step.obs["pixels"])[..., -3:] for step in stacks]
    for i, step in enumerate(stacks):
        shown = [newest[max(i - back, 0)] for back in (2, 1, 0)]
        np.testing.assert_array_equal(step.obs["pixels"], np.concatenate(shown, axis=-1))
        np.testing.assert_allclose(newest[i], pictures[i], atol=1)  # two programs may round a pixel differently
    assert mtjax.stacked(env).spec.obs["pixels"].shape == (SIZE, SIZE, 9)


def test_repeated_actions_sum_rewards_and_keep_the_limit_in_seconds():
    once, twice = (mtjax.make("cartpole-balance", engine="c", repeat=n) for n in (1, 2))
    singles = play(once, [a for a in ACTIONS for _ in range(2)])
    doubles = play(twice, ACTIONS)
    for i, step in enumerate(doubles[1:]):
        np.testing.assert_allclose(step.obs, singles[2 * i + 2].obs, atol=1e-6)
        np.testing.assert_allclose(step.reward, singles[2 * i + 1].reward + singles[2 * i + 2].reward, atol=1e-6)
    assert doubles[1].reward > 1.5
    assert (once.episode_length, twice.episode_length) == (1000, 500) == (1000, int(first(twice).horizon))
    assert twice.seconds_per_step == 2 * once.seconds_per_step


@pytest.mark.slow
def test_looks_change_what_is_seen_and_nothing_of_the_physics():
    """Beside a parameter of the physics, whose models stay those of the family without pictures."""
    vary = (("hue", "0,120"), ("camera-angle", "-20,20"), ("floor-hue", "0,60"), ("light", "0.5,1"), ("mass", "1,2"))
    env = mtjax.make("pendulum-swingup", vary=dict(vary), combine="paired", split="none", pixels=SIZE, engine="c")
    plain = mtjax.make("pendulum-swingup", vary={"mass": "1,2"}, split="none", engine="c")
    saved = lambda model: (
        mujoco.mj_saveModel(model, None, buffer := np.empty(mujoco.mj_sizeModel(model), np.uint8)) or buffer
    )
    for ours, theirs in zip(env.models, plain.models, strict=True):
        np.testing.assert_array_equal(saved(ours), saved(theirs))
    tasks = env.tasks()
    assert set(tasks.model) == set(plain.tasks().model)
    assert {"geom_rgba", "cam_pos", "cam_quat", "light_diffuse"} <= set(tasks.scene)
    world = jax.tree.map(jnp.asarray, play(plain, ())[0].state)
    pictures = np.asarray(jax.jit(jax.vmap(env.look_at, (0, None)))(tasks, world)["pixels"])
    assert np.mean(np.any(pictures[0] != pictures[1], axis=-1)) > 0.5
    assert env.varied == tuple(name for name, _ in vary) and tasks.context.shape == (2, 5)


@pytest.mark.parametrize("name", ["hue", "camera-angle", "floor-hue", "sky-hue", "light"])
def test_every_look_is_seen(name):
    env = pictured(vary=((name, "0.2:0.9:2" if name == "light" else "10:60:2"),), split="none")
    seen = dict(zip(env.tasks().scene, env.tasks().scene.values(), strict=True))
    changed = {"camera-angle": "cam_quat", "sky-hue": "sky", "light": "light_diffuse"}
    assert changed.get(name, "geom_rgba") in seen and not env.tasks().model
    assert ("sky" in seen) == (name == "sky-hue")
    floor = env.scenery.scene.model.geom("ground").id
    if changed.get(name) is None:
        rgba = np.asarray(seen["geom_rgba"])
        moved = np.any(rgba[0] != rgba[1], axis=-1)
        assert moved[floor] == (name == "floor-hue") and np.any(np.delete(moved, floor)) == (name == "hue")


def test_ranges_of_looks_are_drawn_by_episodes_and_split_like_others():
    env = pictured(vary=(("hue", "0:300"),), num_draws=4)
    tasks = env.tasks()
    assert tasks.draws.scene["geom_rgba"].shape[:2] == (1, 4)
    assert len(env.tasks("interpolation").id) == 5 and len(env.tasks("extrapolation").id) == 4


@pytest.mark.slow
def test_grey_and_plain_pictures():
    grey = play(pictured(grey=True), ())[0].obs["pixels"]
    assert grey.shape == (SIZE, SIZE, 1) and np.std(grey) > 1
    assert not pictured(plain=True).scenery.scene.tiles and pictured().scenery.scene.tiles


def test_painter_warp_has_one_sky(monkeypatch):
    """And a sky of another colour than the model's, if it is the same for all tasks."""
    for name in ("is_nvidia", "warp_installed"):
        monkeypatch.setattr(f"mtjax.envs.painters.base.{name}", lambda: True)
    with pytest.raises(InputError, match=r"one sky for all tasks; use painter='caster'"):
        pictured(painter="warp", vary=(("sky-hue", "0,90"),))
    assert pictured(painter="warp", vary=(("sky-hue", "90"),)).variation.values["sky-hue"][0] == 90


def test_hidden_goals_are_not_drawn():
    for name, seen in (("reacher-easy", True), ("reacher-vary-goal", False), ("finger-turn-vary-target", False)):
        scene = mtjax.make(name, pixels=SIZE, engine="c").scenery.scene
        assert (scene.model.geom("target").id in scene.shown) == seen


class Box(Domain):
    """A model without camera, light or floor."""

    model_file = """<mujoco><worldbody><body pos="1 2 3"><joint type="slide"/><geom type="box" size=".1 .1 .1"/></body>
      </worldbody><actuator><motor joint="0"/></actuator></mujoco>"""
    model_file = model_file.replace("joint type", 'joint name="0" type')
    parameters = {}  # noqa: RUF012
    num_substeps, episode_steps, default_iterations, starts_untouched = 1, 10, 1, True

    def start(self, task, key):
        return jnp.zeros(1), jnp.zeros(1)

    def observe(self, task, world):
        return world.qpos

    def reward(self, task, world, action):
        return world.qpos[0]


def test_own_models_are_seen_whole():
    picture = np.asarray(play(Box(pixels=SIZE, engine="c", plain=True), ())[0].obs["pixels"], np.int32)
    sky = picture[0, 0]
    box = np.any(np.abs(picture - sky) > 8, axis=-1)
    rows, columns = np.nonzero(box)
    assert 0 < box.mean() < 0.5
    assert abs(rows.mean() - 7.5) < 2 and abs(columns.mean() - 7.5) < 2


UNSEEN = {*METAWORLD, *(name for name in ENVS if name.startswith("dog-"))}  # refused in words, which others test
SEEN = {family for name in ENVS if issubclass((family := ENVS[name][0]), Pictured) and name not in UNSEEN}
SCENES = sorted(SEEN, key=lambda f: f.__name__)
FIRST = [*{family.__module__: family for family in reversed(SCENES)}.values()]  # one of each body


@pytest.mark.parametrize("family", slow_but(SCENES, *FIRST[::4]), ids=lambda f: f.__name__)
def test_every_family_that_can_be_seen_has_a_scene(family):
    env = family(pixels=SIZE, **({"engine": "c"} if issubclass(family, Domain) else {}))
    model = env.scenery.scene.model
    assert model.ncam and model.nlight and len(env.scenery.scene.shown) > 1
    task = jax.tree.map(lambda x: x[0], env.table.tasks)
    obs = jax.eval_shape(env.reset, task, jax.eval_shape(jax.random.key, 0)).obs
    assert obs["pixels"].shape == (SIZE, SIZE, 3)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("brax-ant", {"pixels": 64}, "no scene to draw, which pixels needs; take a family such as cheetah-run"),
        ("tabular-mdp", {"repeat": 2}, "no scene to draw, which repeat needs"),
        pytest.param("metaworld-reach", {"pixels": 64}, "leave out pixels", marks=needs("metaworld")),
        ("finger-spin", {"pixels": 63}, "an even number from 16 to 512, not 63"),
        ("finger-spin", {"pixels": 8}, "an even number from 16"),
        ("finger-spin", {"frames": 0}, "frames must be from 1 to 16"),
        ("finger-spin", {"repeat": 3}, "must divide the 1000 steps of an episode, such as 1, 2, 4, 5; not 3"),
        ("finger-spin", {"vary": {"hue": "0,90"}}, "hue changes only what is seen; add pixels=64"),
        ("finger-spin", {"grey": True}, "grey changes only what is seen"),
        ("finger-spin", {"pixels": 64, "state": "too"}, "unknown state 'too'"),
        ("finger-spin", {"pixels": 64, "painter": "oil"}, "unknown painter 'oil'"),
        ("finger-spin", {"pixels": 64, "painter": "warp"}, "needs an NVIDIA GPU; use painter='caster'"),
    ],
)
def test_what_cannot_be_is_refused(name, settings, message):
    with pytest.raises(InputError, match=message):
        mtjax.make(name, **settings)


def test_agents_of_vectors_and_hindsight_refuse_pictures():
    with pytest.raises(InputError, match=r"must be vectors here.*leave out --env.pixels"):
        _ = pictured().spec.obs_size
    with pytest.raises(InputError, match="nothing to stack"):
        mtjax.stacked(mtjax.make("pendulum-swingup"))


@pytest.mark.slow
@needs("gymnasium")
def test_gymnasium_shows_stacks():
    import mtjax.gym as gym

    env = gym.make("pendulum-swingup", pixels=SIZE, engine="c", repeat=4)
    obs, _ = env.reset(seed=0)
    assert obs["env_obs"].shape == (SIZE, SIZE, 9) and env.observation_space.contains(obs)
    later, *_ = env.step(np.ones(1))
    np.testing.assert_array_equal(later["env_obs"][..., :6], np.tile(obs["env_obs"][..., 6:], 2))
    assert np.any(later["env_obs"][..., 6:] != obs["env_obs"][..., 6:])
    both = gym.make_vec("pendulum-swingup", num_envs=2, pixels=SIZE, engine="c", state="also", grey=True, frames=2)
    obs, _ = both.reset(seed=0)
    assert {name: x.shape for name, x in obs["env_obs"].items()} == {"pixels": (2, SIZE, SIZE, 2), "state": (2, 3)}
    assert both.observation_space.contains(obs)


def test_equal_families_are_one_program():
    assert dataclasses.replace(pictured()) == pictured() and hash(dataclasses.replace(pictured())) == hash(pictured())
