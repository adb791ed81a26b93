"""Families as Gymnasium environments: MTEnv's interface, its wrappers, batches of worlds, and functional forms."""

import copy
import dataclasses
import importlib
import json
import pickle
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import require

gymnasium = require("gymnasium")
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from probes import Levers

import mtjax.gym
from mtjax import tasks as choose
from mtjax.agents import for_action
from mtjax.envs.mtenv.control import CartPole
from mtjax.envs.mtenv.tabular import Bandit, TabularMDP
from mtjax.gym import EnvToMTEnv, FamilyEnv, FamilyVectorEnv, NTasks, NTasksId, SampleRandomTask
from mtjax.gym.env import draw_seeds
from mtjax.learning.evaluation import record
from mtjax.saved.policy import Policy
from mtjax.types import InputError

MDPS = TabularMDP(num_tasks=6)  # six training tasks, six interpolation tasks, no end but the time limit
FORCES = (-10.0, -5.0, 5.0, 10.0)
POLES = CartPole(vary={"force": FORCES})  # ends within a few steps of a constant push
GRAVITIES = CartPole(vary={"gravity": "5:14"}, num_draws=16)  # a continuous range

unbounded = pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is:UserWarning")
inside = pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")


def play(env, steps, seed=0):
    """Everything that an episode of fixed actions returns."""
    env.action_space.seed(seed)
    return [env.step(env.action_space.sample()) for _ in range(steps)]


def same(one, other):
    same_shape = jax.tree.structure(one) == jax.tree.structure(other)
    return same_shape and all(map(np.array_equal, jax.tree.leaves(one), jax.tree.leaves(other)))


# Gymnasium's side.


@unbounded
def test_gymnasium_checks_a_mujoco_family():
    """The checker accepts finger-spin as Gymnasium makes it; its only remark is that observations are unbounded."""
    env = gymnasium.make("mtjax/finger-spin-vary-size", engine="c")
    check_env(env.unwrapped, skip_render_check=True)
    obs, info = env.reset(seed=0)
    assert obs["env_obs"].shape == (9,) and obs["task_obs"].tolist() == [-1.0]
    assert info == {"task_id": 0, "params": {"size": pytest.approx(0.95)}}


@unbounded
@pytest.mark.parametrize("task_obs", ["context", "id", "none"])
@pytest.mark.parametrize("family", [MDPS, POLES, GRAVITIES], ids=["tabular", "cartpole", "continuous"])
def test_gymnasium_checks_native_families(family, task_obs):
    """So it does without MuJoCo, whatever is seen of the task."""
    check_env(FamilyEnv(family, task_obs=task_obs), skip_render_check=True)


def test_discrete_actions_are_those_of_the_family():
    """One of five numbers; many worlds take one each. With scores they are vectors."""
    env, worlds = FamilyEnv(MDPS), FamilyVectorEnv(MDPS, 3)
    assert env.action_space == spaces.Discrete(5) and worlds.action_space == spaces.MultiDiscrete([5] * 3)
    assert FamilyEnv(dataclasses.replace(MDPS, scores=True)).action_space == spaces.Box(-1, 1, (5,))
    start = env.reset(seed=0)
    task, state = env.unwrapped._task, env.unwrapped._step.state
    found = [MDPS.step(task, state, jnp.int32(action)).obs for action in range(5)]
    assert start[0]["env_obs"].shape == (5,) and len(np.unique(found, axis=0)) > 1
    np.testing.assert_array_equal(env.step(3)[0]["env_obs"], found[3])


@unbounded
def test_several_choices_are_those_of_the_family():
    """Of one world and of many; Gymnasium's checker accepts them, and a number beyond its size is refused."""
    levers = Levers(vary={"turn": "0,1"}, split="none")
    env, worlds = FamilyEnv(levers), FamilyVectorEnv(levers, 2)
    check_env(env, skip_render_check=True)
    assert env.action_space == spaces.MultiDiscrete([3, 5])
    assert worlds.action_space == spaces.Box(0, np.array([[2, 4]] * 2), dtype=np.int64)  # as Gymnasium batches it
    light = int(np.argmax(env.reset(seed=0)[0]["env_obs"]))
    best = np.asarray(levers.best(env.unwrapped._task, light))
    assert env.step(best)[1] == 1 and env.step(best)[1] == 0  # the next light is another
    lights = np.argmax(worlds.reset(seed=0)[0]["env_obs"], axis=1)
    rewards = worlds.step(np.array([lights % 3, 2 * lights % 5]).T)[1]
    assert rewards.tolist() == [1, 0]  # the second world's levers are turned by 1
    for action in ([3, 0], [0, 5], [-1, 0], [0.0, 1.0]):
        with pytest.raises(InputError, match=r"an action is one of MultiDiscrete\(\[3 5\]\), not"):
            env.step(np.array(action))
    with pytest.raises(InputError, match=r"an action has the shape \(2,\), not \(\)"):
        env.step(1)
    with pytest.raises(InputError, match="an action is one of Box"):
        worlds.step(np.array([[0, 0], [0, 5]]))


@unbounded
@inside
@pytest.mark.parametrize("wrap", [lambda env: NTasks(env, 3), lambda env: NTasksId(env, 3)])
def test_gymnasium_checks_wrapped_families(wrap):
    """A bag of tasks keeps to the interface."""
    check_env(wrap(FamilyEnv(MDPS)), skip_render_check=True)


def test_steps_are_those_of_the_family():
    """Observations, rewards and ends are the functional interface's own, from the same key."""
    env = FamilyEnv(POLES)
    env.set_task_state(1)
    obs, _ = env.reset(seed=3)
    key = jax.random.wrap_key_data(draw_seeds(np.random.default_rng(3)), impl="threefry2x32")
    task = jax.tree.map(lambda x: x[1], POLES.tasks())
    step, family_step = POLES.reset(task, key), jax.jit(POLES.step)
    np.testing.assert_allclose(obs["env_obs"], step.obs, rtol=1e-6)
    for _ in range(15):
        step = family_step(task, step.state, np.ones(1, np.float32))
        obs, reward, terminated, truncated, info = env.step(np.ones(1))
        np.testing.assert_allclose(obs["env_obs"], step.obs, rtol=1e-5)
        assert reward == step.reward and terminated == bool(step.terminated) and truncated is False
        assert info == {"task_id": 1, "params": {"force": -5.0}}
    assert terminated is True


def test_time_limits_truncate_and_do_not_terminate():
    """The hundredth step of a tabular MDP is cut off, and no earlier one."""
    env = FamilyEnv(MDPS)
    env.reset()
    ends = [(terminated, truncated) for _, _, terminated, truncated, _ in play(env, 100)]
    assert ends == [(False, False)] * 99 + [(False, True)]
    env.reset()
    assert not play(env, 1)[0][3]


def test_programs_are_compiled_once_for_all_environments_of_a_family():
    """Neither another instance nor another task of equal settings traces the family again."""
    traces = []

    @dataclasses.dataclass(frozen=True)
    class Counted(Bandit):
        def step(self, task, state, action):
            traces.append(self)
            return super().step(task, state, action)

    for _ in range(2):
        env = FamilyEnv(Counted(num_tasks=3))
        for state in range(3):
            env.set_task_state(state)
            env.reset()
            play(env, 2)
    assert len(traces) == 1


def test_drawing_shows_the_task_or_names_what_to_install():
    """render() is the renderer's own frame of the present world; without a mode or a model it is refused."""
    env = mtjax.gym.make("finger-spin", engine="c", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.metadata["render_fps"] == 50
    try:
        frame = env.render()
    except InputError as error:
        assert "apt install" in str(error)
    else:
        assert frame.shape == (240, 320, 3) and frame.std() > 10
    with pytest.raises(InputError, match="render_mode='rgb_array'"):
        FamilyEnv(MDPS).render()
    with pytest.raises(InputError, match="render_mode must be one of"):
        FamilyEnv(MDPS, render_mode="rgb_array")


# Tasks and streams.


def test_task_states_enter_the_task_again_exactly():
    """A state survives JSON and enters the same task in another environment: parameters, context and episode."""
    env, other = FamilyEnv(GRAVITIES), FamilyEnv(GRAVITIES)
    env.seed_task(0)
    for _ in range(5):
        env.reset_task_state()
        state = env.get_task_state()
        other.set_task_state(json.loads(json.dumps(state)))
        assert other.get_task_state() == state and same(env.get_task_obs(), other.get_task_obs())
        assert same(env.reset(seed=1), other.reset(seed=1)) and same(play(env, 5), play(other, 5))


def test_every_task_of_every_split_can_be_entered():
    """States are rows of the family's table, whichever split is sampled; numbers and contexts are theirs."""
    env, tasks = FamilyEnv(MDPS, task_obs="id"), MDPS.tasks("all")
    assert env.observation_space["task_obs"] == spaces.Discrete(12)
    contexts = FamilyEnv(MDPS)
    for row in range(12):
        env.set_task_state(row)
        contexts.set_task_state(row)
        assert env.get_task_obs() == row and env.reset()[1]["task_id"] == row
        np.testing.assert_array_equal(contexts.get_task_obs(), tasks.context[row])
    sampled = {FamilyEnv(MDPS, "interpolation").sample_task_state() for _ in range(60)}
    assert sampled <= set(range(6, 12)) and len(sampled) > 3


def test_continuous_ranges_are_sampled_afresh():
    """Samples are many different values of the range, each with its own context, under the task's one number."""
    env = FamilyEnv(GRAVITIES)
    env.seed_task(0)
    seen = set()
    for _ in range(30):
        env.reset_task_state()
        info = env.reset()[1]
        gravity = info["params"]["gravity"]
        assert 5 <= gravity <= 14 and info["task_id"] == 0
        np.testing.assert_allclose(env.get_task_obs(), [(gravity - 9.5) / 4.5], atol=1e-5)
        seen.add(gravity)
    assert len(seen) > 8
    listed = len(GRAVITIES.tasks("all").id)
    assert min(env.sample_task_state() for _ in range(200)) >= listed  # the middle of the range only stands for it


def test_reset_keeps_the_task_and_sampling_does_not_enter_one():
    """Only set_task_state and reset_task_state change the task."""
    env = FamilyEnv(MDPS)
    env.set_task_state(4)
    for _ in range(5):
        env.sample_task_state()
        assert env.reset()[1]["task_id"] == env.get_task_state() == 4


def test_environment_and_task_streams_are_apart():
    """Each seed fixes its own stream and leaves the other alone; equal seeds make unequal streams."""
    env = FamilyEnv(MDPS)
    draw = lambda: [env.sample_task_state() for _ in range(10)]
    env.seed_task(5)
    tasks = draw()
    env.seed_task(5)
    env.reset(seed=5)
    assert draw() == tasks
    starts = [env.reset()[0]["env_obs"] for _ in range(10)]
    env.reset(seed=5, options={"task_seed": 6})
    draw()
    assert same(starts, [env.reset()[0]["env_obs"] for _ in range(10)])
    env.reset(options={"task_seed": 5})
    assert draw() == tasks
    env.seed_task(5)
    assert not np.array_equal(seeding.np_random(5)[0].random(4), env.np_random_task.random(4))


def test_unseeded_environments_start_from_fresh_entropy():
    """Nothing needs a seed, and no two environments agree by chance."""
    pairs = [(FamilyEnv(POLES), FamilyEnv(POLES)) for _ in range(2)]
    assert not any(same(one.reset(), other.reset()) for one, other in pairs)
    one, other = ([env.sample_task_state() for _ in range(20)] for env in pairs[0])
    assert one != other


def test_a_new_task_needs_a_reset():
    """The world of one task is never stepped under another."""
    env, worlds = FamilyEnv(MDPS), FamilyVectorEnv(MDPS, 2)
    for act in (lambda: None, env.reset_task_state):
        act()
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(0)
        env.reset()
        play(env, 1)
    worlds.reset()
    worlds.set_task_state([1, 1])
    with pytest.raises(gymnasium.error.ResetNeeded):
        worlds.step(np.zeros(2, int))


# Names and errors.


def test_mtenvs_names_are_understood():
    """MTEnv's finger family is the one of touch sizes, which it calls "size"."""
    env = mtjax.gym.make("MT-HiPBMDP-Finger-Spin-vary-size-v0", engine="c", pixels=0, repeat=1)
    assert env.reset()[1]["params"] == {"touch-size": pytest.approx(0.025)}
    known = {name for name in mtjax.gym.MTENV_IDS.values() if name in mtjax.ENVS}
    assert "finger-spin-vary-touch-size" in known and len(mtjax.gym.MTENV_IDS) == 8


@pytest.mark.slow
def test_families_of_hip_bmdp_are_seen_as_mtenv_shows_them():
    """Three pictures of 84 x 84 pixels, and 500 steps of two control steps; without pictures the same steps."""
    env = mtjax.gym.make("MT-HiPBMDP-Walker-Walk-vary-len-v0")
    assert env.observation_space["env_obs"].shape == (84, 84, 9)
    assert (env.family.repeat, env.family.episode_length) == (2, 500)
    plain = mtjax.gym.make("MT-HiPBMDP-Walker-Walk-vary-len-v0", pixels=0)
    assert plain.observation_space["env_obs"].shape == (24,) and plain.family.repeat == 2


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("MT-MetaWorld-MT10-v0", {}, "each task of Meta-World is an environment here, such as 'metaworld-reach'"),
        ("MT-Acrobot-v0", {}, "did you mean 'MT-Acrobat-v0'"),
        ("finger-spn", {}, "did you mean 'finger-spin'"),
        ("finger-spin", {"sizes": 3}, "unknown setting of finger-spin 'sizes'"),
        ("finger-spin", {"tasks": "interpolation"}, "this family has no interpolation tasks"),
        ("finger-spin", {"tasks": "test"}, "unknown split 'test'"),
        ("finger-spin", {"task_obs": "ids"}, "unknown task_obs 'ids'; did you mean 'id'"),
    ],
)
def test_wrong_names_are_refused(name, settings, message):
    """The error says what was given and what is allowed."""
    with pytest.raises(InputError, match=message):
        mtjax.gym.make(name, **settings)


def test_wrong_states_and_options_are_refused():
    """A row that does not exist, a bag without tasks, an option that nobody reads."""
    env = FamilyEnv(MDPS)
    for state in (12, -1, "1", 0.5, None):
        with pytest.raises(InputError, match="a task state is a row from 0 to 11"):
            env.set_task_state(state)
    with pytest.raises(InputError, match="did you mean 'task_seed'"):
        env.reset(options={"task_sed": 1})
    for steppable, shape in ((env, "()"), (FamilyVectorEnv(MDPS, 2), "(2,)")):
        steppable.reset()
        with pytest.raises(InputError, match=re.escape(f"an action has the shape {shape}, not (4,)")):
            steppable.step(np.zeros(4))
        for action in (5, -1, 0.0):
            with pytest.raises(InputError, match=r"an action is one of .*Discrete\(.*5.*\), not"):
                steppable.step(np.full(steppable.action_space.shape, action))
    with pytest.raises(InputError, match="at least 1"):
        NTasks(env, 0)
    with pytest.raises(InputError, match="only 6 different tasks for a bag of 7"):
        NTasks(env, 7).sample_task_state()
    with pytest.raises(InputError, match="each of the 3 worlds"):
        FamilyVectorEnv(MDPS, 3).set_task_state([0])
    with pytest.raises(InputError, match="num_envs must be at least 1"):
        FamilyVectorEnv(MDPS, 0)
    with pytest.raises(InputError, match="reset_mask must be 2 bools"):
        FamilyVectorEnv(MDPS, 2).reset(options={"reset_mask": np.ones(3, bool)})


def test_without_gymnasium_the_error_names_the_extra(monkeypatch):
    """The message is the command that mends it."""
    for name in [name for name in sys.modules if name.startswith("mtjax.gym")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(InputError, match=re.escape("pip install 'mtjax[gym]'")):
        importlib.import_module("mtjax.gym")


def test_only_the_adapters_import_gymnasium():
    """Everything else works without it."""
    package = Path(mtjax.__file__).parent
    importers = {f for f in package.rglob("*.py") if re.search(r"^\s*(from|import) gymnasium", f.read_text(), re.M)}
    homes = (package / "gym", package / "envs" / "hosted")
    assert importers and all(f.parent in homes for f in importers)


# Wrappers.


def test_n_tasks_samples_from_one_bag():
    """Three different tasks, fixed until the stream is seeded again, and the same for the same seed."""
    env = NTasks(FamilyEnv(MDPS), 3)
    env.seed_task(0)
    assert env.get_task_state() == env.tasks[0]
    bag = env.tasks
    assert len(set(bag)) == 3 and {env.sample_task_state() for _ in range(60)} == set(bag)
    env.reset(seed=1)
    assert env.tasks == bag
    bags_seen = set()
    for seed in range(5):
        env.reset(options={"task_seed": seed})
        bags_seen.add(tuple(env.tasks))
    assert len(bags_seen) > 1 and tuple(bag) in bags_seen


def test_n_tasks_id_numbers_the_tasks_of_its_bag():
    """State and observation are the place in the bag; setting it works before anything is sampled."""
    inner = FamilyEnv(MDPS)
    env = NTasksId(inner, 4)
    assert env.observation_space["task_obs"] == spaces.Discrete(4)
    for place in (2, 0, 3):
        env.set_task_state(place)
        obs, info = env.reset()
        assert obs["task_obs"] == env.get_task_obs() == env.get_task_state() == place
        assert info["task_id"] == inner.get_task_state() == env.tasks[place]
        assert obs in env.observation_space and play(env, 1)[0][0] in env.observation_space
    assert {env.sample_task_state() for _ in range(60)} == set(range(4))
    for state in (4, -1, 1.0):
        with pytest.raises(InputError, match="a place in the bag from 0 to 3"):
            env.set_task_state(state)


def test_n_tasks_id_leaves_the_observations_inside_alone():
    """The environment's own dictionary keeps its own task observation."""

    class Keeper(gymnasium.Wrapper):
        def reset(self, **kwargs):
            self.kept, info = super().reset(**kwargs)
            return self.kept, info

    keeper = Keeper(FamilyEnv(MDPS))
    obs, _ = NTasksId(keeper, 2).reset()
    assert obs["task_obs"].shape == () and keeper.kept["task_obs"].shape == (100,)


def test_bags_of_continuous_tasks_hold_different_draws():
    """One listed task gives as many as are asked for."""
    env = NTasksId(FamilyEnv(GRAVITIES), 5)
    gravities = set()
    for place in range(5):
        env.set_task_state(place)
        gravities.add(env.reset()[1]["params"]["gravity"])
    assert len(gravities) == 5


def test_sample_random_task_draws_at_each_reset():
    """Every reset has a task of its own, from the tasks' stream, also of a bag inside."""
    env = SampleRandomTask(FamilyEnv(MDPS))
    seen = lambda: [env.reset(seed=i)[1]["task_id"] for i in range(20)]
    env.seed_task(1)
    ids = seen()
    env.seed_task(1)
    assert len(set(ids)) > 3 and seen() == ids
    env = SampleRandomTask(NTasksId(FamilyEnv(MDPS), 2))
    assert {int(env.reset()[0]["task_obs"]) for _ in range(30)} == {0, 1}


def test_methods_reach_through_wrappers_that_do_not_know_them():
    """Gymnasium's own wrappers may lie between."""
    env = NTasks(gymnasium.wrappers.TimeLimit(FamilyEnv(MDPS), 3), 2)
    env.reset_task_state()
    env.reset()
    assert env.get_task_state() in env.tasks and same(env.get_task_obs(), env.unwrapped.get_task_obs())
    assert [step[3] for step in play(env, 3)] == [False, False, True]


@unbounded
@inside
def test_any_environment_gets_the_interface():
    """Gymnasium's cart-pole with a gravity for a task, which takes effect, and which is what is seen of it."""

    def apply(env, gravity):
        env.gravity = float(gravity[0])

    inner = gymnasium.make("CartPole-v1")
    space = spaces.Box(5, 15, (1,), np.float32)
    env = EnvToMTEnv(inner, space, apply)
    check_env(env, skip_render_check=True)
    env.seed_task(0)
    env.reset_task_state()
    obs, _ = env.reset(seed=0)
    state = env.get_task_state()
    assert obs in env.observation_space and same(obs["task_obs"], state) and inner.unwrapped.gravity == state[0]
    env.set_task_state(np.float32([7]))
    assert inner.unwrapped.gravity == 7 and env.get_task_obs() == [7] and state in space
    env.seed_task(0)
    assert same(env.sample_task_state(), state)
    for held in (np.float32([8]), env.get_task_state()):
        env.set_task_state(held)
        held[:] = 0
        assert env.get_task_state() > 5
    bag = NTasksId(env, 3)
    assert bag.reset()[0]["task_obs"] == 0 and len({float(x[0]) for x in bag.tasks}) == 3


# Many worlds.


def test_worlds_hold_tasks_in_equal_blocks():
    """Task-major: an array over worlds reshapes to tasks and worlds of a task."""
    worlds = FamilyVectorEnv(MDPS, 12)
    assert worlds.get_task_state() == np.repeat(range(6), 2).tolist()
    obs, info = worlds.reset(seed=0)
    assert obs in worlds.observation_space and info["task_id"].tolist() == worlds.get_task_state()
    np.testing.assert_array_equal(obs["task_obs"].reshape(6, 2, -1)[:, 1], MDPS.tasks().context)
    counts = np.bincount(FamilyVectorEnv(MDPS, 15).get_task_state())
    assert len(counts) == 6 and np.ptp(counts) == 1
    assert FamilyVectorEnv(MDPS, 2, "interpolation", "id").get_task_obs().tolist() == [6, 9]


def test_worlds_step_as_single_ones_do():
    """Every world follows its own task; an ended one rests a step, in which its action and reward are nothing."""
    worlds = FamilyVectorEnv(POLES, 4)
    obs, info = worlds.reset(seed=0)
    np.testing.assert_array_equal(info["params"]["force"], FORCES)
    step, tasks = jax.jit(POLES.step), POLES.tasks()
    task = [jax.tree.map(lambda x, i=i: x[i], tasks) for i in range(4)]
    state = [jax.tree.map(lambda x, i=i: x[i], worlds._step.state) for i in range(4)]
    ended, restarts = np.zeros(4, bool), 0
    for _ in range(60):
        obs, reward, terminated, truncated, info = worlds.step(np.ones((4, 1)))
        assert obs in worlds.observation_space and not truncated.any()
        for i in range(4):
            if ended[i]:
                restarts += 1
                assert reward[i] == 0 and not terminated[i] and np.all(np.abs(obs["env_obs"][i]) <= 0.05)
                state[i] = jax.tree.map(lambda x, i=i: x[i], worlds._step.state)
                continue
            single = step(task[i], state[i], np.ones(1, np.float32))
            np.testing.assert_allclose(obs["env_obs"][i], single.obs, rtol=1e-5, atol=1e-6)
            assert reward[i] == 1 and terminated[i] == bool(single.terminated)
            state[i] = single.state
        ended = terminated
    assert restarts >= 8


@dataclasses.dataclass(frozen=True)
class Telling(CartPole):
    """A pole that tells how far its cart is."""

    def step(self, task, state, action):
        step = super().step(task, state, action)
        return step._replace(metrics={"success": jnp.abs(step.obs[0])})


def test_info_tells_a_familys_metrics_after_every_step():
    """Of a world that begins anew they are 0, though a reset has none."""
    family = Telling(vary={"force": FORCES})
    env, worlds = FamilyEnv(family), FamilyVectorEnv(family, 4)
    assert "success" not in env.reset(seed=0)[1] and "success" not in worlds.reset(seed=0)[1]
    obs, *_, info = env.step(np.ones(1))
    assert info["success"] == abs(obs["env_obs"][0]) and isinstance(info["success"], float)
    ended, restarts = np.zeros(4, bool), 0
    for _ in range(30):
        obs, _, terminated, _, info = worlds.step(np.ones((4, 1)))
        np.testing.assert_array_equal(info["success"], np.where(ended, 0, np.abs(obs["env_obs"][:, 0])))
        restarts, ended = restarts + ended.sum(), terminated
    assert restarts >= 4


def test_worlds_are_cut_off_by_the_time_limit_and_begin_again():
    """After the last step of an episode the next one counts from its start."""
    worlds = FamilyVectorEnv(MDPS, 3)
    worlds.reset()
    flags = np.array([truncated for _, _, _, truncated, _ in play(worlds, 202)])
    assert flags.shape == (202, 3) and np.flatnonzero(flags.all(axis=1)).tolist() == [99, 200]
    assert flags.sum() == 6


def test_worlds_follow_from_their_seeds():
    """Equal seeds repeat everything; worlds of one task differ."""
    one, other = FamilyVectorEnv(POLES, 8), FamilyVectorEnv(POLES, 8)
    starts = one.reset(seed=4)
    assert same(starts, other.reset(seed=4)) and same(play(one, 30), play(other, 30))
    assert len(np.unique(starts[0]["env_obs"], axis=0)) == 8
    assert not same(one.reset(seed=5), other.reset())
    assert not same(FamilyVectorEnv(POLES, 8).reset(), FamilyVectorEnv(POLES, 8).reset())


def test_some_worlds_can_be_reset_alone():
    """A mask leaves the other worlds where they are."""
    worlds = FamilyVectorEnv(POLES, 4)
    worlds.reset()
    before = worlds.step(np.ones((4, 1)))[0]["env_obs"]
    after = worlds.reset(options={"reset_mask": np.array([True, False, False, True])})[0]["env_obs"]
    np.testing.assert_array_equal(np.all(before == after, axis=1), [False, True, True, False])


def test_worlds_can_draw_a_task_for_every_episode():
    """With resample_tasks each restart has a new task, of a continuous range a new value; other worlds keep theirs."""
    worlds = FamilyVectorEnv(GRAVITIES, 6, resample_tasks=True)
    worlds.seed_task(0)
    _, info = worlds.reset(seed=0)
    assert len(np.unique(info["params"]["gravity"])) > 2
    gravity, ended, changes = info["params"]["gravity"], np.zeros(6, bool), 0
    for _ in range(40):
        obs, _, terminated, _, info = worlds.step(np.ones((6, 1)))
        new = info["params"]["gravity"]
        np.testing.assert_array_equal(new[~ended], gravity[~ended])
        np.testing.assert_allclose(obs["task_obs"][:, 0], (new - 9.5) / 4.5, atol=1e-5)
        changes += np.sum(new != gravity)
        gravity, ended = new, terminated
    assert changes > 5


@unbounded
def test_gymnasium_makes_and_wraps_worlds():
    """make_vec takes the batch instead of copies, and Gymnasium's wrappers understand when it resets."""
    worlds = gymnasium.make_vec("mtjax/finger-spin-vary-size", num_envs=4, engine="c")
    assert isinstance(worlds, FamilyVectorEnv) and worlds.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    obs, infos = DictInfoToList(worlds).reset(seed=0)
    assert obs in worlds.observation_space
    np.testing.assert_allclose([info["params"]["size"] for info in infos], [0.95, 0.99, 1.05, 1.09], rtol=1e-5)
    assert play(worlds, 1)[0][0]["env_obs"].shape == (4, 9)
    counted = RecordEpisodeStatistics(FamilyVectorEnv(MDPS, 2))
    counted.reset()
    infos = [info for *_, info in play(counted, 201)]
    assert [i for i, info in enumerate(infos) if "episode" in info] == [99, 200]
    assert infos[200]["episode"]["l"].tolist() == [100, 100]


def test_what_is_returned_is_the_callers_own():
    """Nothing that an environment returned changes later, nor does changing it change the environment."""
    for env in (FamilyEnv(MDPS), FamilyVectorEnv(MDPS, 2)):
        obs, info = env.reset(seed=0)
        kept = copy.deepcopy((obs, info))
        later, *_ = play(env, 1)[0]
        assert same((obs, info), kept)
        later["task_obs"][:] = 7
        assert not np.any(env.get_task_obs() == 7)


# Inside programs.

n_tasks = jax.jit(choose.n_tasks, static_argnums=(0, 1, 3))


def test_functional_bags_hold_different_tasks():
    """n_tasks draws whole rows without repetition, by its key alone; with_ids changes nothing but numbers."""
    bag = n_tasks(MDPS, 4, jax.random.key(0))
    assert len(np.unique(bag.row)) == 4 and set(np.asarray(bag.row)) <= set(range(6))
    for leaf, column in zip(jax.tree.leaves(bag), jax.tree.leaves(MDPS.tasks()), strict=True):
        np.testing.assert_array_equal(leaf, column[bag.row])
    assert same(bag, n_tasks(MDPS, 4, jax.random.key(0)))
    assert any(not same(bag, n_tasks(MDPS, 4, jax.random.key(i))) for i in range(1, 5))
    numbered = choose.with_ids(bag)
    assert numbered.id.tolist() == [0, 1, 2, 3] and same(numbered._replace(id=bag.id), bag)
    assert set(np.asarray(n_tasks(MDPS, 6, jax.random.key(1), "interpolation").row)) == set(range(6, 12))
    with pytest.raises(InputError, match="cannot draw 7 different tasks from the 6"):
        choose.n_tasks(MDPS, 7, jax.random.key(0))


def test_functional_bags_of_continuous_tasks_are_fresh_draws():
    """More tasks than the table has, each with a context that is its own."""
    bag = n_tasks(GRAVITIES, 12, jax.random.key(0))
    assert bag.draws is None and len(np.unique(bag.params["gravity"])) > 4
    np.testing.assert_allclose(bag.context[:, 0], (bag.params["gravity"] - 9.5) / 4.5, atol=1e-5)


def test_random_tasks_are_drawn_inside_a_program():
    """sample_random_task maps over keys under jit; every task comes up, and one step runs on what it draws."""

    @jax.jit
    @jax.vmap
    def start(key):
        task_key, reset_key = jax.random.split(key)
        task = choose.sample_random_task(MDPS.tasks(), task_key)
        return task.row, MDPS.reset(task, reset_key).obs

    rows, obs = start(jax.random.split(jax.random.key(0), 60))
    assert set(np.asarray(rows)) == set(range(6)) and obs.shape == (60, 5)


@pytest.mark.parametrize(
    "made", [lambda: gymnasium.make("mtjax/bandit"), lambda: mtjax.gym.make_vec("point-mass-vary-goal", 2)]
)
def test_environments_are_copied_between_processes(made):
    """A pickled one goes on from where it was, with streams of its own."""
    env = made()
    env.action_space.seed(0)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    other = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        action = env.action_space.sample()
        ours, theirs = env.step(action), other.step(action)
        np.testing.assert_array_equal(ours[0]["env_obs"], theirs[0]["env_obs"])
        np.testing.assert_array_equal(ours[1], theirs[1])
    np.testing.assert_array_equal(env.reset()[0]["env_obs"], other.reset()[0]["env_obs"])


@pytest.mark.parametrize("made", [lambda: gymnasium.make("mtjax/bandit"), lambda: mtjax.gym.make_vec("bandit", 2)])
def test_a_forked_process_is_refused_with_the_fix(made, monkeypatch):
    """JAX's threads are missing there, as in the workers of Gymnasium's asynchronous vectors: a call would hang."""
    env = made()
    monkeypatch.setattr("os.getpid", lambda: -1)
    for use in (made, env.reset):
        with pytest.raises(InputError, match=r"vector_kwargs=\{'context': 'spawn'\}"):
            use()


@pytest.mark.slow
def test_a_policy_with_a_memory_plays_a_trial_here_as_in_an_evaluation():
    """``reset`` keeps the task, and the memory goes on over the ends of episodes: the same actions."""
    family, agent = (
        mtjax.make("grid-navi", size=3, steps=4, scores=True),
        mtjax.agent("rl2", hidden=(8,), recurrent_size=4),
    )
    agent = for_action(agent, family.action)
    state = agent.init(family.spec, family.tasks(), jax.random.key(0))
    moved = jax.tree.map(lambda x: x + 0.5 * jax.random.normal(jax.random.key(1), x.shape), state.nets["actor"])
    state = state.with_nets(actor=moved)
    policy = Policy(family, agent, state, None, jnp.asarray([0]), trial=3)
    played = record(family, agent, state, family.tasks(), jnp.int32(0), 3, lambda _, transition: transition.action)
    env, task = FamilyEnv(family), jax.tree.map(lambda x: x[0], family.tasks()._replace(draws=None))
    env.set_task_state(int(played.rows[0]))
    memory, actions = policy.begin(task), []
    for _ in range(policy.trial):
        seen, ended = env.reset()[0]["env_obs"], False
        while not ended:
            actions.append(policy(seen, task, memory=memory))
            after, reward, terminated, truncated, _ = env.step(np.asarray(actions[-1]))
            ended = terminated or truncated
            memory = policy.remember(memory, task, seen, actions[-1], reward, after["env_obs"], ended)
            seen = after["env_obs"]
    np.testing.assert_allclose(actions, played.kept[0], rtol=1e-4, atol=1e-5)
    first = np.asarray(actions)[::4]  # of episodes, which begin in the same cell: what differs is the memory
    assert np.ptp(first, axis=0).max() > 1e-2
