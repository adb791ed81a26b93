"""Environments outside of JAX: the same steps as the original's, in the loop, evaluations and films."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs, require
from probes import param, slow_but, tiny, train

import mtjax
import mtjax.train
from mtjax.envs.engines import host
from mtjax.envs.engines.host import explaining
from mtjax.envs.hosted.envpool import EnvPool
from mtjax.envs.hosted.gymnasium import Separate
from mtjax.envs.hosted.stepping import _known
from mtjax.evaluate import main as evaluate_main
from mtjax.learning import evaluation, rollout
from mtjax.saved.records import Records
from mtjax.types import Acted, Continuous, Discrete, InputError, MultiDiscrete

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
        return np.full((30, 40, 3), 10 * self.age % 256, np.uint8)


class Seen(Walk):
    """Pictures of a walk, with the channels first."""

    observation_space = spaces.Box(0, 255, (3, 20, 24), np.uint8)
    action_space = spaces.Discrete(3, start=-1)

    def _move(self, action):
        return super()._move(np.float32([action, 0]))

    def _look(self):
        return np.full((3, 20, 24), self.age, np.uint8) + np.arange(3, dtype=np.uint8)[:, None, None]


class Levers(Walk):
    """A walk that two levers move."""

    action_space = spaces.MultiDiscrete([[3], [5]], start=[[-1], [0]])

    def _move(self, action):
        assert action.shape == (2, 1) and action.dtype == np.int64
        return super()._move(np.ravel(action))


class Switches(Walk):
    """A walk that six switches move."""

    action_space = spaces.MultiBinary((3, 2))

    def _move(self, action):
        assert action.shape == (3, 2) and action.dtype == np.int8
        return super()._move(np.float32(action.sum(axis=0)))


@pytest.fixture(scope="module", autouse=True)
def registered():
    """Gives the walks names in Gymnasium's registry."""
    walks = {"Walk": Walk, "Seen": Seen, "Levers": Levers, "Switches": Switches}
    for name, walk in walks.items():
        gymnasium.register(name, walk, max_episode_steps=7)
    yield
    for name in walks:
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
        begun, _ = rollout.reset_ended(family, agent, learners, tasks, worlds, env_step.ends, fresh)
        return begun, (env_step.transition, env_step.ends.terminal, worlds.state)

    @jax.jit
    def whole(key):
        worlds = rollout.reset_envs(family, agent, learners, tasks, keys(key))
        return jax.lax.scan(step, worlds, jax.random.split(key, steps))[1]

    with explaining():
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
        param(("Walk", {"time_limit": 30, "end": 20}, 1), slow=True),  # it truncates by itself
        ("Walk", {"vary": {"scale": "1:4"}, "num_draws": 5, "split": "none"}, 2),  # every episode draws its own
        param(("Seen", {"end": 3}, 2), slow=True),
        ("Levers", {"end": 3}, 2),
        ("Switches", {}, 2),
        param(("CartPole-v1", {"time_limit": 25}, 2), slow=True),
        ("Pendulum-v1", {"vary": {"g": "5,10"}, "split": "none"}, 1),
        param(("MountainCarContinuous-v0", {"time_limit": 50}, 1), slow=True),
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
            np.testing.assert_array_equal(ours, family.reader.read_each(original))
        np.testing.assert_array_equal(own(transition.reward), np.float32(theirs[2]))
        np.testing.assert_array_equal(own(terminal), theirs[3])
        np.testing.assert_array_equal(own(transition.ended), theirs[4])
        np.testing.assert_array_equal(own(transition.discount), 1.0 - theirs[3])
    ended = transition.ended
    assert ended.any() and len({bool(x) for x in terminal[ended]}) == kinds
    assert all(len(episodes) > 2 for episodes in begun.values()) or family.episode_length > 150


# In the loop.

PLAYED = {"num_envs": 4, "chunk_steps": 32, "unroll": 16, "minibatches": 2, "epochs": 1, "hidden": (8,)}
SHORT = [f"--{flag}" for flag in ("num-envs=4", "chunk-steps=32", "eval-episodes=2", "eval-every=256", "steps=512")]
SHORT += ["--agent=ppo", "--agent.unroll=16", "--agent.hidden=8"]


LONG = ["--env.time-limit=150", '--env.arguments={"end": 1000, "patience": 1000}']


@pytest.fixture(scope="module")
def run(registered, tmp_path_factory):
    """The folder of a run on two walks, and what it printed. Only to be read."""
    runs = tmp_path_factory.mktemp("runs")
    mtjax.train.main(
        [
            *SHORT,
            "--env=gymnasium:Walk",
            "--env.vary.scale=0.5,1.5",
            "--split=none",
            "--no-stagger",
            *LONG,
            f"--runs={runs}",
        ]
    )
    return next(runs.iterdir())


@pytest.mark.slow
def test_a_run_has_evaluations_and_a_film(run, capsys):
    """A film shows the environment's own pictures, which are as grey as the walk is old."""
    found = mtjax.evaluate(str(run), episodes=3)
    assert found.returns["train"].shape == (1, 2, 3) and np.isfinite(found.returns["train"]).all()
    evaluate_main([f"--run={run}", "--episodes=1", "--video", "--video-seconds=1"])
    assert "filming 2 of 2: train, return" in capsys.readouterr().out
    (film,) = run.glob("evaluation-*/film.*")
    assert film.stat().st_size > 0


def test_a_film_shows_each_step(monkeypatch):
    """Pictures are those of the states that are asked for, and of the world's own."""
    family = mtjax.hosted("Walk", vary={"scale": "0.5,1.5"}, split="none", end=50)
    with family.filmed():
        states = play(family, 6, num_envs=1)[2]
    one = jax.tree.map(lambda x: x[[0, 3, 4], 0, 1, 0], states)
    pictures = family.pictures(one, 32, 24)
    assert pictures.shape == (3, 24, 32, 3) and [int(x[12, 16, 0]) for x in pictures] == [10, 40, 50]


@pytest.mark.slow
def test_evaluations_play_whole_episodes_of_the_original(begun):
    """Returns are those of the original under the agent's mean actions; worlds that have ended stand still."""
    family = mtjax.hosted("Walk", end=4)
    result = mtjax.train(family, "ppo", steps=128, eval_episodes=3, quiet=True, **PLAYED)
    begun.clear()
    agent, learners = result.agent, result.state.agent
    scores = evaluation.evaluate(
        family, agent, evaluation.Episodes(3), learners, family.tasks(), jnp.arange(1), jnp.int32(5)
    )
    returns = np.asarray(scores.returns)[0, 0]
    one, task = jax.tree.map(lambda x: x[0], (learners, family.tasks()))
    act = jax.jit(lambda obs: agent.act(one, agent.begin(one, task), obs, task, None).action)
    for place in range(3):
        ((row, seed),) = begun[place]
        original = gymnasium.make("Walk", **family.arguments_of(row))
        obs, total, over = original.reset(seed=seed)[0], 0.0, False
        while not over:
            action = family.actor.read(np.asarray(act(family.reader.read_each([obs])[0])))
            obs, reward, terminated, truncated, _ = original.step(action)
            total, over = total + reward, terminated or truncated
        np.testing.assert_allclose(returns[place], total, rtol=1e-4)


@pytest.mark.slow
def test_what_an_environment_raises_ends_the_run_after_its_checkpoint(tmp_path, capsys):
    """The message names environment, error and place; the last checkpoint stays."""
    gymnasium.register("Broken", Walk, max_episode_steps=400, kwargs={"raises": 70, "end": 1000, "patience": 1000})
    flags = [*SHORT, "--env=gymnasium:Broken", f"--runs={tmp_path}", "--no-stagger"]
    with pytest.raises(InputError, match=r"Broken raised ZeroDivisionError: the walk broke .*hosted.py, line") as told:
        mtjax.train.main(flags)
    (folder,) = tmp_path.iterdir()
    last = folder / "checkpoints" / "64"  # of the chunk before
    assert last.is_dir() and str(last) in str(told.value) and isinstance(told.value.__cause__, ZeroDivisionError)


@pytest.mark.slow
def test_a_resumed_run_begins_new_episodes_and_says_so(run, tmp_path, capsys, monkeypatch):
    """As another process does, which knows none of the worlds. Episodes that were cut off do not count."""
    copy = shutil.copytree(run, tmp_path / "copy")
    for known in _known.values():
        known.sets.clear()
    rows = []
    monkeypatch.setattr(Records, "add_rows", lambda self, new: rows.extend(new))
    mtjax.train.main([f"--resume={copy}", "--steps=1024"])
    assert "worlds of gymnasium:Walk cannot be saved: new episodes begin" in capsys.readouterr().out
    assert len(rows) == 2 and all(float(row[name]) == 0 for row in rows for name in ("episodes", "lost"))


def test_worlds_go_on_from_their_last_state_alone():
    """Another state is refused, where it would give the steps of another world."""
    family = mtjax.hosted("Walk")
    task = jax.tree.map(lambda x: x[0], family.tasks())
    start = family.reset(task, jax.random.key(0))
    then = family.step(task, start.state, jnp.zeros(2))
    assert not then.terminated and family.step(task, then.state, jnp.zeros(2)).obs.shape == (2,)
    with pytest.raises(InputError, match="from its last state alone"), explaining():
        jax.block_until_ready(family.step(task, start.state, jnp.zeros(2)))


@pytest.mark.slow
def test_mixtures_with_families_of_jax():
    """Each family's episodes end by its own rules."""
    env = mtjax.mixture([mtjax.hosted("Walk"), "bandit"])
    with pytest.raises(InputError, match="act alike"):
        _ = env.spec
    env = mtjax.mixture([mtjax.hosted("CartPole-v1", time_limit=30), mtjax.make("bandit", num_tasks=2, split="none")])
    result = mtjax.train(env, "ppo", steps=768, eval_episodes=2, quiet=True, **PLAYED)
    returns = result.evaluations.returns["train"]
    assert returns.shape[2] == 3 and 1 <= returns[0, -1, 0].min() and returns[0, -1, 0].max() <= 30


@pytest.mark.slow
def test_ppo_learns_to_balance():
    """The return rises in some thousand steps."""
    family = mtjax.hosted("CartPole-v1")
    settings = {"num_envs": 8, "eval_every": 10_240, "eval_episodes": 5, "quiet": True}
    result = mtjax.train("gymnasium:CartPole-v1", "ppo", steps=20_480, **settings)
    returns = result.evaluations.returns["train"].mean(axis=(0, 2, 3))
    assert family.episode_length == 500 and returns[-1] > 250


# Observations of other spaces than one Box.


class Nested(Walk):
    """A walk that tells of itself in arrays of several kinds."""

    observation_space = spaces.Dict({
        "walk": spaces.Box(-100, 100, (2,), np.float64),
        "signs": spaces.Tuple((spaces.Discrete(3, start=-1), spaces.MultiBinary(2))),
        "map": spaces.Box(0, 255, (3, 4), np.uint8),
        "ages": spaces.MultiDiscrete([[100, 100]]),
        "old": spaces.Box(0, 1, (1,), bool),
    })  # fmt: skip

    def _look(self):
        age = self.age
        signs = (np.int64(np.sign(self.place)), np.array([age > 2, self.place > 0], np.int8))
        grid, ages = np.full((3, 4), 20 * age, np.uint8), np.array([[age, 2 * age]])
        walk = np.array([self.place, age])
        return {"old": np.array([age > 3]), "map": grid, "signs": signs, "ages": ages, "walk": walk}


class Joined(Nested):
    """The same walk, which tells the vector that networks are to see of it."""

    observation_space = spaces.Box(-1e6, 1e6, (20,), np.float64)

    def _look(self):
        return np.concatenate([np.ravel(x) for x in jax.tree.leaves(super()._look())]).astype(np.float64)


class Turned(gymnasium.Env):
    """A number from 0 to 3, which an action moves on."""

    observation_space, action_space = spaces.Discrete(4), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = int(self.np_random.integers(4))
        return self.place, {}

    def step(self, action):
        self.place = (self.place + int(action)) % 4
        return self.place, float(self.place == 3), False, False, {}


def test_spaces_of_spaces_are_trees_of_arrays():
    """Of the environment's own numbers and types; those of 64 bits become those of 32."""
    env = mtjax.hosted(Nested, time_limit=5)
    told = jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", env.spec.obs)
    assert told == {
        "walk": "float32[2]",
        "signs": ("int32[]", "int8[2]"),
        "map": "uint8[3, 4]",
        "ages": "int32[1, 2]",
        "old": "bool[1]",
    }
    task = jax.tree.map(lambda x: x[0], env.tasks())
    begun = jax.jit(env.reset)(task, jax.random.key(0))
    seen = jax.jit(env.step)(task, begun.state, jnp.ones(2)).obs
    place, age = seen["walk"].tolist()
    assert age == 1 and seen["signs"][0] == np.sign(place) and seen["signs"][1].tolist() == [0, place > 0]
    assert np.all(seen["map"] == 20) and seen["ages"].tolist() == [[1, 2]] and not seen["old"][0]
    assert mtjax.hosted(Turned, time_limit=5).spec.obs == jax.ShapeDtypeStruct((), jnp.int32)


@pytest.mark.nightly
@pytest.mark.parametrize("name", slow_but(("sac", "ppo"), "ppo"))
def test_networks_learn_from_spaces_of_spaces_what_they_learn_from_one(name):
    """Bit for bit, with the arrays in the replay as the environment has them."""
    loop = {"num_envs": 2, "chunk_steps": 10}
    own = {"sac": {"batch_size": 4, "replay_size": 40, "warmup_steps": 4}, "ppo": {"unroll": 5, "minibatches": 2}}
    agent = tiny(name, **own[name])
    (tree, metrics), (flat, wanted) = (
        train(mtjax.hosted(env, time_limit=5), agent, loop, chunks=2) for env in (Nested, Joined)
    )
    jax.tree.map(np.testing.assert_array_equal, metrics, wanted)
    jax.tree.map(np.testing.assert_array_equal, tree.agent.nets["actor"], flat.agent.nets["actor"])
    if name == "sac":
        assert tree.data.ring.rows.obs["map"].dtype == np.uint8


# What is refused.


class Odd(Walk):
    """A walk with spaces that agents cannot carry."""

    def __init__(self, obs="ok", action="ok", **rest):
        super().__init__(**rest)
        odd = {"dict": spaces.Dict({"x": spaces.Text(2)}), "many": spaces.Tuple([spaces.Discrete(2)] * 2)}
        odd["endless"] = spaces.Box(-np.inf, np.inf, (1,))
        self.observation_space = odd.get(obs, self.observation_space)
        self.action_space = odd.get(action, self.action_space)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: mtjax.hosted("CartPol-v1"), "did you mean 'CartPole-v1'"),
        (lambda: mtjax.hosted("CartPole-v1", vary={"gravity": "5:10:3"}), "unknown parameter 'gravity'"),
        (lambda: mtjax.hosted("Walk", vary={"scales": "1,2"}), "did you mean 'scale'"),
        (lambda: mtjax.hosted("Walk", vary={"scale": "1,6"}, split="none"), "scale=6.* scale is of no walk"),
        (lambda: mtjax.hosted("Walk", vary={"end": "3,4"}), "end of Walk is a whole number, not 3.5; .*split"),
        (lambda: mtjax.hosted(Odd), "no time limit; give one"),
        (
            lambda: mtjax.hosted(Odd, time_limit=9, obs="dict"),
            "observes a Dict, and agents take numbers: .*FilterObservation",
        ),
        (lambda: mtjax.hosted(Odd, time_limit=9, action="many"), "takes Tuple.*, and agents give a Discrete, MultiDis"),
        (lambda: mtjax.hosted(Odd, time_limit=9, action="endless"), "without bounds"),
        (lambda: mtjax.hosted("Walk", unheard_of=3), "unheard_of=3: TypeError"),
        (lambda: mtjax.hosted(3), "hosted takes a name"),
        (lambda: mtjax.make("gymnasium:Walk", arguments="[1]"), "arguments are JSON"),
        (lambda: mtjax.make("gymnasia:Walk"), "unknown environment 'gymnasia:Walk'"),
        (lambda: mtjax.make("gymnasium:Walk", time_limit=-1), "time-limit must be"),
    ],
)
def test_mistakes_are_told_before_anything_runs(make, told):
    """In a line that says what was given and what to do."""
    with pytest.raises(InputError, match=told):
        _ = make().spec


def test_spaces_become_those_of_agents():
    """Actions span the environment's Box, and channels come last."""
    walk, seen = mtjax.hosted("Walk"), mtjax.make("gymnasium:Seen", frames=2)
    assert walk.spec.action == Continuous(2) and walk.spec.obs.shape == (2,)
    np.testing.assert_array_equal(walk.actor.read(np.float32([-1, 1])), np.float32([-1, 10]))
    assert seen.spec.action == Discrete(3) and seen.actor.read(np.int32(0)) == -1
    assert seen.spec.obs["pixels"].shape == (20, 24, 3) and seen.spec.frames == 2
    levers, switches = mtjax.hosted("Levers"), mtjax.hosted("Switches")
    assert levers.spec.action == MultiDiscrete((3, 5)) and switches.spec.action == MultiDiscrete((2,) * 6)
    np.testing.assert_array_equal(levers.actor.read(np.int32([0, 4])), [[-1], [4]])


def test_a_class_is_registered_under_its_name():
    """So that a run's folder and the command line know it too; one that is defined again takes its place."""

    class Mine(Walk):
        pass

    first = mtjax.hosted(Mine, time_limit=5)
    assert first.name == "gymnasium:Mine" and mtjax.make("gymnasium:Mine", time_limit=5) == first
    play(first, 2, num_envs=1)

    class Mine(Walk):
        def _look(self):
            return np.array([7.0, 7.0])

    assert play(mtjax.hosted(Mine, time_limit=5), 2, num_envs=1)[0].obs.min() == 7


@needs("envpool")
@pytest.mark.filterwarnings("ignore:.*precision lowered by casting")
@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1"])
def test_steps_of_envpool_are_its_own(name, monkeypatch):
    """With EnvPool's automatic reset, whose step between two episodes is left out here."""
    import envpool

    seeds, make = [], EnvPool.make
    monkeypatch.setattr(
        EnvPool, "make", lambda self, row, count, seed: seeds.append(seed) or make(self, row, count, seed)
    )
    family = mtjax.make(f"envpool:{name}", time_limit=20)
    transition, terminal, _ = play(family, 100)
    original = envpool.make(name, env_type="gymnasium", num_envs=3, seed=seeds[0], max_episode_steps=20)
    obs = original.reset()[0]
    for world in range(3):
        before, ids = obs[world], np.array([world])
        for step in range(100):
            own = jax.tree.map(lambda x, step=step, world=world: x[step, 0, 0, world], transition)
            np.testing.assert_array_equal(own.obs, np.float32(before))
            after, reward, terminated, truncated, _ = original.step(family.actor.read_all(own.action[None]), ids)
            np.testing.assert_array_equal(own.next_obs, np.float32(after[0]))
            assert own.reward == np.float32(reward[0]) and own.ended == (terminated | truncated)[0]
            assert terminal[step, 0, 0, world] == terminated[0]
            before = original.step(family.actor.read_all(own.action[None]), ids)[0][0] if own.ended else after[0]
    assert transition.ended.sum() > 10


@needs("envpool")
def test_pictures_of_envpool_are_single_and_settings_are_tasks():
    """Agents see the last four; each task has a pool with its settings."""
    family = mtjax.make("envpool:Pong-v5", vary={"repeat-action-probability": "0,0.25"}, split="none", time_limit=30)
    assert (
        family.spec.obs["pixels"].shape == (84, 84, 1) and family.spec.frames == 4 and family.spec.action == Discrete(6)
    )
    transition = play(family, 40, num_envs=2)[0]
    assert transition.obs["pixels"].shape == (40, 1, 2, 2, 84, 84, 4) and transition.ended.sum() == 4
    with pytest.raises(InputError, match="give lists"):
        mtjax.make("envpool:Pong-v5", vary={"repeat-action-probability": "0:0.25"})
    with pytest.raises(InputError, match="did you mean 'Pong-v5'"):
        mtjax.make("envpool:Pongg-v5")


@pytest.mark.slow
def test_programs_of_a_gpu_call_the_host_too(monkeypatch):
    """By JAX's own callbacks, which give the same steps, and tell what the environment raised."""
    family = mtjax.hosted("Walk")
    before = play(family, 30)[0]
    monkeypatch.setattr(host.jax, "default_backend", lambda: "gpu")
    after = play(family, 30)[0]
    jax.tree.map(np.testing.assert_array_equal, before, after)
    with pytest.raises(InputError, match="Walk raised ZeroDivisionError: the walk broke"):
        play(mtjax.hosted("Walk", raises=3), 10)


@needs("envpool")
@pytest.mark.slow
@pytest.mark.parametrize("agent", ["ppo", "impala"])
def test_games_that_are_seen_have_a_preset(agent, tmp_path, monkeypatch):
    """By which agents learn from four pictures, with PopArt; rewards may be clipped in learning alone."""
    rows = []
    monkeypatch.setattr(Records, "add_rows", lambda self, new: rows.extend(new))
    program = mtjax.preset("envpool:Pong-v5", agent, "gpu")
    assert program.learner.representation.vision == "impala" and program.learner.value_normalization == "popart"
    short = ["--num-envs=2", "--agent.unroll=8", "--agent.minibatches=2", "--chunk-steps=16", "--env.time-limit=20"]
    flags = ["--env=envpool:Pong-v5", f"--agent={agent}", "--preset=gpu", "--steps=64", "--eval-episodes=1", *short]
    mtjax.train.main([*flags, "--agent.reward-clip=1", f"--runs={tmp_path}"])
    assert len(rows) == 2 and all(np.isfinite(float(row["critic_loss"])) for row in rows)
