"""Environments of other JAX packages: the same steps as the originals', and parameters that vary as tasks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs, require

import mtjax
import mtjax.gym
from mtjax import envs
from mtjax.agents.parts.representations import Encoded
from mtjax.command.run_config import parse
from mtjax.envs.adapters.family import AdaptedState
from mtjax.envs.adapters.xminigrid import XMiniGrid
from mtjax.types import InputError


def play(family, task, original, steps=1000):
    """Random steps of a world, and of the original from the same states by the same keys; leaves (H, ...).

    Args:
        original: a function of the state and the action that returns observation, reward and both kinds of end.
    """

    def step(state: AdaptedState, key):
        action_key, reset_key = jax.random.split(key)
        action = family.spec.action.random(action_key)
        ours, theirs = family.step(task, state, action), original(state, action)
        over = ours.terminated | ours.truncated
        fresh = family.reset(task, reset_key).state
        state = jax.tree.map(lambda x, y: jnp.where(over, x, y), fresh, ours.state)
        return state, ((ours.obs, ours.reward, ours.terminated, ours.truncated), theirs)

    begin, *keys = jax.random.split(jax.random.key(0), steps + 1)
    whole = jax.jit(lambda: jax.lax.scan(step, family.reset(task, begin).state, jnp.stack(keys))[1])
    return jax.device_get(whole())


def own_params(nominal, task, **limit):
    """A package's parameters of a task, in the types of its nominal ones."""
    values = {name.replace("-", "_"): x for name, x in task.params.items()}
    return nominal.replace(**{name: type(getattr(nominal, name))(x) for name, x in values.items()}, **limit)


@needs("gymnax")
@pytest.mark.parametrize(
    ("name", "settings", "kinds"),
    [
        ("CartPole-v1", {"vary": {"length": "0.25,1"}, "split": "none", "time_limit": 25}, (True, True)),
        ("Breakout-MinAtar", {}, (True, False)),
        ("Seaquest-MinAtar", {"pictures": True}, (True, False)),
        ("Asterix-MinAtar", {"vary": {"shot-cool-down": "3,7"}, "split": "none"}, (True, False)),
        ("Pendulum-v1", {"vary": {"g": "5:15:2"}, "split": "none"}, (False, True)),
        ("FourRooms-misc", {"time_limit": 40}, (False, True)),
    ],
)
def test_steps_of_gymnax_are_the_originals(name, settings, kinds):
    """A thousand of them, for each task, with terminations and time limits apart; the package resets none of them."""
    import gymnax

    family = mtjax.make(f"gymnax:{name}", **settings)
    environment, nominal = gymnax.make(name)
    low, high = (getattr(environment.action_space(nominal), end, 0) for end in ("low", "high"))
    for row in range(family.train_count):
        task = jax.tree.map(lambda x, row=row: x[row], family.tasks("train"))
        params = own_params(nominal, task, max_steps_in_episode=family.episode_length)

        def original(state, action, params=params):
            given = action if family.discrete else low + (action + 1) / 2 * (high - low)
            _, _, reward, terminated, truncated, info = environment.step(state.step_key, state.world, given, params)
            return info["final_observation"].astype(jnp.float32), reward, terminated, truncated

        ours, theirs = play(family, task, original)
        if family.pixels:
            np.testing.assert_array_equal(ours[0]["pixels"], 255 * theirs[0])
            assert ours[0]["pixels"].dtype == np.uint8 and set(np.unique(theirs[0])) == {0, 1}
        else:
            np.testing.assert_allclose(ours[0], theirs[0].reshape(len(theirs[0]), -1), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(ours[2], theirs[2])
        np.testing.assert_array_equal(ours[3], theirs[3])
        assert (ours[2].any(), ours[3].any()) == kinds


@needs("craftax")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("Craftax-Classic-Symbolic-v1", {"vary": {"spawn-zombie-base-chance": "0.02,0.9", "day-length": "60"}}),
        ("Craftax-Symbolic-v1", {"vary": {"god-mode": "0,1"}, "time_limit": 600}),
        ("Craftax-Classic-Pixels-v1", {}),
    ],
)
def test_steps_of_craftax_are_the_originals(name, settings):
    """Whoever dies has terminated; a picture of bytes is nearest to the original's."""
    from craftax.craftax_env import make_craftax_env_from_name

    family = mtjax.make(f"craftax:{name}", **{"split": "none", "time_limit": 150, **settings})
    environment = make_craftax_env_from_name(name, auto_reset=False)
    nominal, ends = environment.default_params, np.zeros(2)
    for row in range(family.train_count):
        task = jax.tree.map(lambda x, row=row: x[row], family.tasks("train"))
        params = own_params(nominal, task, max_timesteps=family.episode_length)

        def original(state, action, params=params):
            obs, world, reward, over, _ = environment.step(state.step_key, state.world, action, params)
            return obs, reward, over, _is_dead(world)

        ours, theirs = play(family, task, original)
        seen = ours[0]["pixels"] / 255 if "Pixels" in name else ours[0]
        np.testing.assert_allclose(seen, theirs[0], rtol=1e-6, atol=0.5 / 255 + 1e-6 if "Pixels" in name else 1e-6)
        np.testing.assert_allclose(ours[1], theirs[1], rtol=1e-6, atol=1e-6)
        np.testing.assert_array_equal(ours[2] | ours[3], theirs[2])
        np.testing.assert_array_equal(ours[2], theirs[3])
        ends += ours[2].sum(), ours[3].sum()
    assert ends.all()


def _is_dead(world):
    """Whether a player of Craftax has no health, or has walked into the classic world's lava."""
    x, y = world.player_position
    return (world.player_health <= 0) | (world.map[x, y] == 14 if world.map.ndim == 2 else False)


@pytest.fixture(scope="module")
def rulesets(tmp_path_factory):
    """A file of four rulesets in XLand-MiniGrid's format: the goal is to hold a ball of one of four colours."""
    benchmarks = require("xminigrid.benchmarks")
    held = np.array([[1, 3, colour, 0, 0] for colour in (1, 2, 3, 4)], np.uint8)
    tiles = np.array([[[3, colour], [4, 1]] for colour in (1, 2, 3, 4)], np.uint8)
    file, none = tmp_path_factory.mktemp("rulesets") / "four", np.zeros((4, 1, 7), np.uint8)
    content = {"goals": held, "rules": none, "init_tiles": tiles, "num_rules": np.zeros(4, np.uint8)}
    benchmarks.save_bz2_pickle(jax.tree.map(jnp.asarray, content), str(file))
    return str(file)


@needs("xminigrid")
@pytest.mark.parametrize(
    ("name", "settings", "kinds"),
    [
        ("MiniGrid-Empty-5x5", {"time_limit": 60}, (True, True)),
        ("XLand-MiniGrid-R1-9x9", {"vary": {"ruleset": "0,2"}, "split": "none", "time_limit": 40}, (True, True)),
    ],
)
def test_steps_of_xland_are_the_originals(name, settings, kinds, rulesets):
    """A ruleset is a task; tiles that are seen are one-hot."""
    import xminigrid
    from xminigrid.benchmarks import load_benchmark_from_path

    family = mtjax.make(f"xminigrid:{name}", **settings | ({"rulesets": rulesets} if "XLand" in name else {}))
    environment, nominal = xminigrid.make(name)
    for row in range(family.train_count):
        task = jax.tree.map(lambda x, row=row: x[row], family.tasks("train"))
        params = nominal.replace(max_steps=family.episode_length)
        if "XLand" in name:
            params = params.replace(ruleset=load_benchmark_from_path(rulesets).get_ruleset(int(task.params["ruleset"])))

        def original(state, action, params=params):
            new = environment.step(params, state.world, action)
            seen = new.observation.astype(jnp.int32)
            terminated = new.last() & (new.discount == 0)
            return seen, new.reward, terminated, new.last() & (new.discount == 1)

        ours, theirs = play(family, task, original)
        tiles = ours[0].reshape(*theirs[0].shape[:3], -1)
        np.testing.assert_array_equal(np.stack([tiles[..., :13].argmax(-1), tiles[..., 13:].argmax(-1)], -1), theirs[0])
        assert np.all(tiles.sum(axis=-1) == 2)
        for mine, own in zip(ours[1:], theirs[1:], strict=True):
            np.testing.assert_array_equal(mine, own)
        assert (ours[2].any(), ours[3].any()) == kinds


@needs("xminigrid")
def test_rulesets_are_whole_numbers_of_a_file(rulesets):
    """What lies between two of them is held out where it is one too."""
    make = lambda **settings: mtjax.make("xminigrid:XLand-MiniGrid-R1-9x9", rulesets=rulesets, **settings)
    with pytest.raises(InputError, match=r"whole number from 0 to 3, not 0.5; --split=none"):
        _ = make(vary={"ruleset": "0:2:3"}).spec
    assert make(vary={"ruleset": "0,2"}, split="none").train_count == 2
    for settings in ({"environment": "XLand-MiniGrid-R1-9x9"}, {"environment": "MiniGrid-Empty-5x5", "rulesets": "x"}):
        with pytest.raises(InputError, match=r"needs rulesets|has no rulesets"):
            _ = XMiniGrid(**settings).spec


def require_one_form(name):
    """Require that a state has one form, which a scan carries, and return the family."""
    family = mtjax.make(name)
    task = jax.tree.map(lambda x: x[0], family.tasks())
    begun = jax.eval_shape(family.reset, task, jax.random.key(0))
    action = jax.ShapeDtypeStruct(family.spec.action.shape, family.spec.action.dtype)
    step = jax.eval_shape(family.step, task, begun.state, action)
    form = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), tree)
    assert form(step) == form(begun), name
    return family


def test_packages_may_compute_as_they_are_traced():
    """JAX then compiles one program in the midst of lowering another."""
    with jax.ensure_compile_time_eval():
        assert jax.random.bernoulli(jax.random.key(0), shape=(7, 11, 3)).shape == (7, 11, 3)


@needs("gymnax")
def test_every_environment_of_gymnax_that_needs_no_download_can_be_stepped():
    import gymnax

    for name in sorted(set(gymnax.registered_envs) - {"MNISTBandit-bsuite"}):
        require_one_form(f"gymnax:{name}")


@needs("craftax")
@pytest.mark.parametrize(
    ("name", "shape", "actions"),
    [
        ("Craftax-Classic-Symbolic-v1", (1345,), 17),
        ("Craftax-Classic-Pixels-v1", (63, 63, 3), 17),
        ("Craftax-Symbolic-v1", (8268,), 43),
        ("Craftax-Pixels-v1", (130, 110, 3), 43),
    ],
)
def test_every_environment_of_craftax_can_be_stepped(name, shape, actions):
    """Pictures are bytes."""
    spec = require_one_form(f"craftax:{name}").spec
    obs = spec.obs["pixels"] if "Pixels" in name else spec.obs
    assert (obs.shape, obs.dtype) == (shape, np.uint8 if "Pixels" in name else np.float32)
    assert spec.action.size == actions


@needs("gymnax")
def test_ppo_balances_poles_of_gymnax():
    """Of four lengths, to the maximum."""
    settings = {"vary": {"length": "0.25:1:4"}, "num_envs": 8, "eval_episodes": 4, "quiet": True}
    result = mtjax.train("gymnax:CartPole-v1", "ppo", steps=200_000, eval_every=100_000, **settings)
    assert result.evaluations.returns["train"][0, -1].mean() > 480


def test_packages_that_are_missing_are_named_with_the_command(monkeypatch):
    """For each of them, before anything else is done."""
    missing = lambda name: (_ for _ in ()).throw(ImportError(f"No module named {name!r}"))
    monkeypatch.setattr("mtjax.envs.adapters.family.importlib.import_module", missing)
    adapted = [name for name, place in envs.SUITES.items() if ".adapters." in place]
    assert adapted
    for name in adapted:
        with pytest.raises(InputError, match=r"cannot be imported \(No module named .*; pip install "):
            _ = mtjax.make(f"{name}:CartPole-v1").spec


@needs("gymnax")
def test_scales_multiply_the_rewards_of_games():
    """And nothing else: the same actions lead to the same observations, and to scaled rewards."""
    family = mtjax.make("gymnax:Breakout-MinAtar", vary={"reward-scale": "0.01,1,100"}, split="none")
    tasks, nothing = family.tasks("train"), lambda state, action: ()
    each = [play(family, jax.tree.map(lambda x, row=row: x[row], tasks), nothing)[0] for row in range(3)]
    (small, *_), (plain, *_), (large, *_) = each
    np.testing.assert_array_equal(small, plain)
    np.testing.assert_array_equal(large, plain)
    small, plain, large = (rewards for _, rewards, *_ in each)
    assert plain.max() == 1
    np.testing.assert_allclose([small, large], [0.01 * plain, 100 * plain], rtol=1e-6)


@needs("gymnax")
def test_grids_are_shown_as_pictures_where_they_are_grids():
    """To Gymnasium's view too. Arrays of other shapes, and of other numbers as Pong's, are none."""
    shown = mtjax.make("gymnax:Freeway-MinAtar", pictures=True)
    assert (shown.pixels, shown.spec.frames) == (10, 1)
    assert shown.spec.obs == {"pixels": jax.ShapeDtypeStruct((10, 10, 7), np.uint8)}
    assert mtjax.make("gymnax:Freeway-MinAtar").spec.obs_size == 700
    env = mtjax.gym.make("gymnax:Freeway-MinAtar", pictures=True)
    seen, space = env.reset(seed=0)[0]["env_obs"], env.observation_space["env_obs"]
    assert (space.shape, space.dtype) == ((10, 10, 7), np.uint8) and seen in space and seen.max() == 255
    for name in ("CartPole-v1", "Catch-bsuite", "Pong-misc"):
        with pytest.raises(InputError, match=rf"{name} observes no picture \(H, W, C\) .*; leave out pictures"):
            mtjax.make(f"gymnax:{name}", pictures=True)


@needs("gymnax")
def test_pictures_of_games_choose_the_network_of_their_paper():
    """By the preset, on either device and from a command line; vectors keep their layers."""
    for device in ("cpu", "gpu"):
        flags = ["--env=gymnax:Asterix-MinAtar", "--agent=pqn", f"--preset={device}"]
        seeing, plain = parse([*flags, "--env.pictures"]), parse(flags)
        assert parse([*flags, "--env.pictures", "--env.no-pictures"]) == plain
        learner = mtjax.preset("gymnax:Asterix-MinAtar", "pqn", device, pictures=True).learner
        assert seeing.family.pictures and seeing.learner == learner and not plain.family.pictures
        assert learner.representation == Encoded(latent_widths=(), vision="grid") and learner.hidden == (128,)
        assert not plain.learner.representation.learns and plain.learner.hidden == (128, 128)
        assert seeing.learner.experience == plain.learner.experience and seeing.training == plain.training


@needs("gymnax")
def test_mistakes_are_told():
    """Unknown names and parameters, with the nearest of the package."""
    with pytest.raises(InputError, match="did you mean 'CartPole-v1'"):
        mtjax.make("gymnax:CartPol-v1")
    with pytest.raises(InputError, match="unknown parameter 'lenght'; did you mean 'length'"):
        mtjax.make("gymnax:CartPole-v1", vary={"lenght": "1,2"})
