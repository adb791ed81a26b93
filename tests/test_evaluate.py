"""Scoring a finished run, and its policy in three lines."""

import csv
import dataclasses
import errno
import inspect
import os
import re
import shlex
import signal
import time
import types

import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from conftest import SHORT_RUN
from probes import Lost, Stub, Walk, one_in, pick, tasks_of
from probes import act as act_once

import mtjax
import mtjax.evaluate
import mtjax.train
from mtjax.checks import amount
from mtjax.learning import evaluation, loop
from mtjax.learning.evaluation import Episodes, Evaluations, Scores, evaluate, load_evaluations, record
from mtjax.report import films, render, scoring, waiting
from mtjax.report.tables import split_table, task_table
from mtjax.saved import checkpoint
from mtjax.saved.config_json import from_json
from mtjax.tasks import episode_task
from mtjax.training import launch
from mtjax.types import InputError

VALUES = {"train": [1.0, 1.2], "interpolation": [1.1], "extrapolation": [0.6, 0.8, 1.4, 1.6]}


@pytest.fixture(scope="module")
def policy(finished_run):
    return mtjax.load(finished_run)


@pytest.fixture(scope="module")
def multi_head_run(short_family, tmp_path_factory):
    """Ten values split as in the HiP-BMDP paper, with a head for each of the four that train."""
    runs = tmp_path_factory.mktemp("runs")
    settings = (
        "--env=finger-short --agent=multi-head --split=hip-bmdp --env.vary.size=0.95:1.4:10 "
        "--steps=40 --eval-episodes=1 --num-envs=1 --batch-size=2 --replay-size=50 --warmup-steps=1 --agent.hidden 4"
    )
    mtjax.train.main([*settings.split(), f"--runs={runs}"])
    (directory,) = runs.iterdir()
    return directory


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def score(policy, number, seeds=None):
    tasks = policy.env.tasks("all")
    seeds = policy.seeds if seeds is None else seeds
    scores = evaluate(policy.env, policy.agent, Episodes(1), policy.states, tasks, seeds, jnp.int32(number))
    return np.asarray(scores.returns)


# The policy.


def test_policy_acts_as_the_checkpoint_does(finished_run):
    """Three lines: load, reset, act; for a random action too."""
    policy = mtjax.load(finished_run)
    task = jax.tree.map(lambda x: x[1], policy.env.tasks("train"))
    action = policy(obs := jnp.linspace(-1, 1, 9), task)

    program = from_json(finished_run / "config.json")
    fixed = (program.family, program.learner, program.training, program.family.tasks("train"), jnp.arange(2))
    state = checkpoint.load(finished_run / "checkpoints", jax.eval_shape(lambda: loop.init(*fixed)))
    for seed, chosen in ((0, policy), (1, mtjax.load(finished_run, seed=1))):
        learned = jax.tree.map(lambda x, seed=seed: x[seed], state.agent)
        for key in (None, jax.random.key(3)):
            expected = act_once(program.learner, learned, obs, task, key)
            np.testing.assert_array_equal(chosen(obs, task, key), expected)
    assert action.shape == (2,) and np.all(np.abs(action) < 1)
    assert not np.array_equal(action, mtjax.load(finished_run, seed=1)(obs, task))


@pytest.mark.parametrize("seed", [2, -1])
def test_seed_that_did_not_run_is_an_input_error(finished_run, seed):
    """Rather than another seed's policy, as arrays clamp their indices."""
    with pytest.raises(InputError, match="seed"):
        mtjax.load(finished_run, seed=seed)


# Episodes.


def test_evaluation_repeats_and_its_number_draws_new_episodes(policy):
    """The same number gives the same bytes; another number, or seed, gives other episodes everywhere."""
    first = score(policy, 0)
    np.testing.assert_array_equal(score(policy, 0), first)
    assert np.all(score(policy, 1) != first)
    assert np.all(score(policy, 0, policy.seeds + 10) != first)


def test_last_evaluation_of_a_run_is_of_its_last_policy(finished_run, policy):
    """The same number, seeds and policy give the numbers on disk."""
    past = load_evaluations(finished_run / "evaluations.npz")
    again = score(policy, len(past.steps) - 1)
    everything = np.concatenate([past.returns[s][:, -1] for s in VALUES], axis=1)
    np.testing.assert_array_equal(again, everything)


def test_scores_are_of_episodes_that_the_run_never_saw(finished_run, policy):
    """Though policy and tasks are those of its last evaluation."""
    past = load_evaluations(finished_run / "evaluations.npz")
    for split, (returns, _) in scoring.score(policy, Episodes(1)).items():
        assert returns.shape == (2, len(VALUES[split]), 1)
        assert not np.intersect1d(returns, past.returns[split]).size


@dataclasses.dataclass(frozen=True)
class Fatal(Walk):
    """A walk paid by its action too, which counts its steps; what would follow a termination is not a number."""

    episode_length: int = 6

    def step(self, task, state, action):
        step = super().step(task, state, action)
        over = (state.obs[0] % 1 < 0.5) & (state.age > 2)
        reward = jnp.where(over, jnp.nan, step.reward + action[0])
        return step._replace(reward=reward, metrics={"steps": step.state.age, "success": step.state.age == 2.0})


class Leaning(Stub):
    """Acts by its state and by the observation."""

    def choose(self, state, obs, task, key):
        return jnp.tanh(state - obs)


@pytest.mark.parametrize("asked", [100, 4])
def test_evaluation_is_a_plain_loop_over_single_worlds(monkeypatch, asked):
    """Episodes that terminate, or are cut off at their task's limit, count up to there and no further."""
    monkeypatch.setattr(evaluation, "_ASKED", asked)
    evaluate.clear_cache()
    env, agent, episodes = Fatal(), Leaning(), 4
    tasks = tasks_of("one-step", (1.0, -0.5, 2.0))._replace(horizon=jnp.int32([6, 4, 2]))
    states, seeds = jnp.float32([[0.3], [1.7]]), (3, 8)
    found = evaluate(env, agent, Episodes(episodes), states, tasks, jnp.asarray(seeds), jnp.int32(5))
    reset, step, lengths = jax.jit(env.reset), jax.jit(env.step), set()
    for s, seed in enumerate(seeds):
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 0x7E57), 5)
        keys = jax.random.split(key, (3, episodes))
        for i in range(3):
            task = pick(tasks, i)
            for e in range(episodes):
                world, total, age = reset(task, keys[i, e]), 0.0, 0
                ever = False
                while not world.terminated and age < task.horizon:
                    action = agent.act(states[s], (), world.obs, task, None).action
                    world, age = step(task, world.state, action), age + 1
                    total += float(world.reward)
                    ever |= bool(world.metrics["success"])
                np.testing.assert_allclose(found.returns[s, i, e], total, rtol=1e-5)
                assert found.metrics["steps"][s, i, e] == age
                assert (
                    found.metrics["success"][s, i, e] == (age == 2) and found.metrics["success_ever"][s, i, e] == ever
                )
                lengths.add(age)
    assert lengths == {2, 3, 4, 6}  # both ways to end, in one batch


@pytest.mark.parametrize(("early", "length", "played"), [(True, 100, 8), (False, 100, 100), (True, 3, 3)])
def test_nothing_is_played_long_after_all_episodes_have_ended(monkeypatch, early, length, played):
    """Here they end with the sixth step, and every fourth one is asked."""
    monkeypatch.setattr(evaluation, "_ASKED", 4)
    step = lambda carry, time: ((carry[0] + 1, carry[1] & (time < 5)), None)
    count, _ = evaluation._play(step, (jnp.int32(0), jnp.ones(2, bool)), length, early)
    assert count == played


@pytest.mark.parametrize("parts", [1, 3, 100])
@pytest.mark.parametrize("episodes", one_in(3, [(Episodes(6, 3),), (Episodes(3),), (Episodes(3, sampled=True),)]))
def test_an_evaluation_in_parts_is_one_as_a_whole(monkeypatch, parts, episodes):
    """Bit by bit, and it tells before each part how far it is; where all trials have ended it stops."""
    tasks = tasks_of("one-step", (1.0, -0.5, 2.0))._replace(horizon=jnp.int32([5, 4, 2]))
    monkeypatch.setattr(evaluation, "_PARTS", parts)
    monkeypatch.setattr(Fatal, "tasks", lambda self, split: tasks)
    evaluation.play_on.clear_cache()
    env, agent, seeds, shares = Fatal(), Doubtful() if episodes.sampled else Leaning(), jnp.asarray([3, 8]), []
    policy = types.SimpleNamespace(env=env, agent=agent, states=jnp.float32([[0.3], [1.7]]), seeds=seeds)
    found = scoring.score(policy, episodes, 2, tasks, "train", shares.append)["train"]  # type: ignore
    whole = evaluate(env, agent, episodes, policy.states, tasks, seeds, jnp.int32(scoring._FIRST_NUMBER + 2))
    jax.tree.map(np.testing.assert_array_equal, found, whole)

    length = env.episode_length * episodes.trial
    longest = found.metrics["steps"].reshape(2, 3, -1, episodes.trial).sum(axis=-1).max()
    times = np.arange(0, longest, -(-length // parts))
    assert shares == [*times / length, 1.0] and longest < length


@dataclasses.dataclass(frozen=True)
class Counting(Lost):
    """A walk that may be lost, and counts its steps."""

    def step(self, task, state, action):
        step = super().step(task, state, action)
        return step._replace(metrics={"steps": step.state.age})


class Doubtful(Stub):
    """Draws -1 or 1, and takes 1 without a key."""

    def choose(self, state, obs, task, key):
        return jnp.ones(1) if key is None else 2.0 * jax.random.bernoulli(key, shape=(1,)) - 1


@dataclasses.dataclass(frozen=True)
class Paid(Walk):
    """A walk that earns the action."""

    def rules(self, task, state, action):
        return jnp.sum(action), state.obs[0], False


def test_drawn_actions_are_fresh_in_every_step_and_episode():
    """Sums of five draws of -1 or 1 are of all kinds; the likeliest action earns 5 in every episode."""
    tasks = tasks_of("one-step", (1.0,))._replace(horizon=jnp.int32([5]))
    play = lambda sampled: evaluate(
        Paid(), Doubtful(), Episodes(200, sampled=sampled), jnp.zeros(1), tasks, jnp.asarray([3]), jnp.int32(0)
    )
    likeliest, drawn = (np.asarray(play(sampled).returns)[0, 0] for sampled in (False, True))
    assert np.all(likeliest == 5)
    assert set(drawn) == {-5, -3, -1, 1, 3, 5} and abs(drawn.mean()) < 4 * np.sqrt(5 / 200)


def test_a_recorded_episode_may_be_of_drawn_actions():
    """Episodes of 200 tasks are of all kinds, as above; without drawing all earn 5."""
    tasks = tasks_of("one-step", (1.0,) * 200)._replace(horizon=jnp.int32([5] * 200))
    play = lambda sampled: record(Paid(), Doubtful(), jnp.float32(0), tasks, jnp.int32(8), sampled=sampled)
    assert np.all(np.asarray(play(False).returns) == 5)
    assert set(np.asarray(play(True).returns).ravel()) == {-5, -3, -1, 1, 3, 5}


def test_an_episode_whose_world_is_lost_keeps_what_it_had():
    """Return and metrics are those of before; others go on."""
    tasks, episodes = tasks_of("one-step", (1.0, -1.0))._replace(horizon=jnp.int32([5, 5])), 12
    found = evaluate(
        Counting(), Leaning(), Episodes(episodes), jnp.float32([0.3]), tasks, jnp.asarray([3]), jnp.int32(0)
    )
    returns, steps = np.asarray(found.returns)[0], np.asarray(found.metrics["steps"])[0]
    lost = steps == 1
    assert np.all(np.isin(steps, [1, 5])) and not lost[0].any() and 0 < lost[1].sum() < episodes
    starts = np.where(lost, 0, (np.abs(returns) - 15) / 5)  # an episode earns five times its start, and 1 + ... + 5
    np.testing.assert_array_less(starts, 1)
    assert np.all(starts[1][~lost[1]] >= Lost.share) and np.all(returns[1][lost[1]] > -1 - Lost.share)


def test_a_recorded_episode_is_that_of_a_plain_loop():
    """Its return and length are those up to its end; the states of all steps are there."""
    env, agent, state = Fatal(), Leaning(), jnp.float32([0.3])
    tasks = tasks_of("one-step", (1.0, -0.5, 2.0, 0.5) * 3)._replace(horizon=jnp.int32([6, 4, 2, 6] * 3))
    found, lengths = record(env, agent, state, tasks, jnp.int32(8)), set()
    keys = jax.random.split(jax.random.fold_in(jax.random.key(8), 0xF11), (1, 12, 1))[0, :, 0]
    for i in range(12):
        task = pick(tasks, i)
        world, total, age = env.reset(task, keys[i]), 0.0, 0
        while not world.terminated and age < task.horizon:
            action = agent.act(state, (), world.obs, task, None).action
            world = env.step(task, world.state, action)
            np.testing.assert_allclose(found.kept.obs[i, age], world.state.obs, rtol=1e-6)
            total, age = total + float(world.reward), age + 1
        np.testing.assert_allclose(found.returns[i, 0], total, rtol=1e-5)
        assert (found.lengths[i, 0], found.rows[i]) == (age, tasks.row[i])
        lengths.add(age)
    assert lengths == {2, 3, 4, 6}


def test_a_recorded_trial_is_that_of_a_plain_loop():
    """Its episodes follow each other, each from a fresh start, as often as the trial has them."""
    env, agent, state, trial = Fatal(), Leaning(), jnp.float32([0.3]), 3
    tasks = tasks_of("one-step", (1.0, -0.5, 2.0, 0.5))._replace(horizon=jnp.int32([6, 4, 2, 6]))
    found = record(env, agent, state, tasks, jnp.int32(8), trial)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(8), 0xF11), (1, 4, 1))[0, :, 0]
    for i in range(4):
        task, key, time = pick(tasks, i), keys[i], 0
        for episode in range(trial):
            world, total, age = env.reset(task, key), 0.0, 0
            while not world.terminated and age < task.horizon:
                action = agent.act(state, (), world.obs, task, None).action
                world = env.step(task, world.state, action)
                np.testing.assert_allclose(found.kept.obs[i, time + age], world.state.obs, rtol=1e-6)
                total, age = total + float(world.reward), age + 1
            np.testing.assert_allclose(found.returns[i, episode], total, rtol=1e-5)
            assert found.lengths[i, episode] == age
            time += age
            key = jax.random.fold_in(keys[i], time - 1)
    assert len(set(np.asarray(found.lengths).ravel().tolist())) > 2


def test_a_recorded_episode_names_the_task_that_it_drew():
    """And begins by a key of its own: where it begins does not depend on what was drawn."""
    env, tasks = Walk(), Walk().tasks()
    rows = 100 * jnp.arange(len(tasks.id))[:, None] + jnp.arange(50)
    draws = jax.tree.map(lambda x: jnp.broadcast_to(x[:, None], (*rows.shape, *x.shape[1:])), tasks)
    draws = draws._replace(row=rows, goal={"scale": jnp.float32(rows + 1)})
    tasks = tasks._replace(draws=draws)
    found = record(env, Leaning(), jnp.float32([0.3]), tasks, jnp.int32(8))
    keys = jax.random.split(jax.random.fold_in(jax.random.key(8), 0xF11), (1, len(rows), 1))[0, :, 0]
    for i, length in enumerate(found.lengths[:, 0]):
        task_key, key = jax.random.split(keys[i])
        before = found.kept.obs[i, :length, 0] - 1
        np.testing.assert_allclose(before[0], env.reset(pick(tasks, i), key).obs[0], rtol=1e-5)
        np.testing.assert_allclose(found.returns[i, 0], (found.rows[i] + 1) * np.sum(before), rtol=1e-5)
        assert found.rows[i] == episode_task(pick(tasks, i), task_key).row
    assert np.all(found.rows // 100 == tasks.id)


# The program.


def test_evaluate_prints_every_task_and_leaves_a_folder(copied_run, capsys):
    """Table, returns and plot agree; a second call writes beside the first."""
    mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1"])
    lines = capsys.readouterr().out.splitlines()
    folder = copied_run / "evaluation-1"
    assert lines[0].startswith("playing ")
    assert lines[-1] == f"written to {folder}" and "unseen" not in "".join(lines)
    assert {path.name for path in folder.iterdir()} == {"returns.csv", "return_by_size.png"}
    assert matplotlib.image.imread(folder / "return_by_size.png").std() > 0

    rows = rows_of(folder / "returns.csv")
    assert list(rows[0]) == ["split", "size", "seed", "episode", "return"]
    names = [(r["split"], float(r["size"]), r["seed"], r["episode"]) for r in rows]
    assert sorted(names) == sorted((s, v, seed, "0") for s, of in VALUES.items() for v in of for seed in "01")
    for split, values in VALUES.items():
        for value in values:
            (line,) = (x for x in lines if x.split()[:2] == [split, f"{value:g}"])
            returns = [float(r["return"]) for r in rows if (r["split"], float(r["size"])) == (split, value)]
            assert line.split()[2] == amount(np.mean(returns))
        assert any(x.split()[:2] == [split, "all"] for x in lines)

    before = (folder / "returns.csv").read_bytes()
    mtjax.evaluate.main(["--run", str(copied_run), "--episodes", "1", "--seed", "7"])
    assert capsys.readouterr().out.splitlines()[-1] == f"written to {copied_run / 'evaluation-2'}"
    assert (folder / "returns.csv").read_bytes() == before
    other = rows_of(copied_run / "evaluation-2" / "returns.csv")
    assert not {r["return"] for r in rows} & {r["return"] for r in other}


@pytest.mark.slow
def test_hip_bmdp_run_is_scored_with_its_nearest_heads(multi_head_run, capsys):
    """Eight of ten values have a split, and the output says what stands for those that did not train."""
    mtjax.evaluate.main([f"--run={multi_head_run}", "--episodes=1"])
    out = capsys.readouterr().out
    assert "unseen tasks: each uses the head of the nearest training task" in out
    names = {(r["split"], round(float(r["size"]), 4)) for r in rows_of(multi_head_run / "evaluation-1" / "returns.csv")}
    assert names == {
        *(("train", x) for x in (1.1, 1.15, 1.3, 1.35)),
        *(("interpolation", x) for x in (1.2, 1.25)),
        *(("extrapolation", x) for x in (1.05, 1.4)),
    }


@pytest.fixture
def filmed(monkeypatch):
    """The films that are written, and the tasks that are drawn, without OpenGL."""
    found = {"drawn": [], "joints": []}

    def film(env, row, states, width, height):
        found["drawn"].append((row, states.qpos.shape))
        found["joints"].append(np.asarray(states.qpos))
        return np.full((len(states.qpos), height, width, 3), 10 + row, np.uint8)

    def write(path, frames, fps):
        found[path.name] = (frames, fps)
        return types.SimpleNamespace(name=path.name)

    monkeypatch.setattr(render, "choose_backend", lambda: None)
    monkeypatch.setattr(render, "film", film)
    monkeypatch.setattr(render, "write_video", write)
    return found


@pytest.mark.slow
def test_video_films_some_tasks_of_each_split_in_one_grid(copied_run, capsys, filmed):
    """The first, the middle and the last; each tile names its task."""
    mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1", "--video", "--video-seconds=0.2"])
    frames, fps = filmed["film"]
    high = 180 + 2 * 17  # two lines above each picture
    assert fps == 25 and frames.shape == (5, 2 * high, 3 * 240, 3)
    assert filmed["drawn"] == [(row, (5, 3)) for row in (0, 1, 2, 3, 5, 6)]
    assert [int(frames[0, 34 + high * i, 120 + 240 * j, 0]) for i in range(2) for j in range(3)] == [
        10,
        11,
        12,
        13,
        15,
        16,
    ]
    assert np.any(frames[0, :15, :240] > 200)  # the caption
    out = capsys.readouterr().out
    assert re.search(r"filming 1 of 6: train, return \d+, size=1\n", out)
    assert re.search(r"writing the film of \d+ pictures\nfilmed film: 6 tasks", out)


@pytest.mark.slow
def test_a_trial_is_filmed_episode_by_episode(copied_run, filmed, tmp_path, capsys):
    """Side by side, a line for each task; of a long trial the first ones and the last."""
    policy = dataclasses.replace(mtjax.load(copied_run), trial=2)
    tasks = policy.env.tasks("all")
    chosen = films.choose(policy.env, ["train"], [0, 1])
    films.write(policy, tasks, chosen, 0.2, 0, tmp_path / "film", {})
    high = 240 + 2 * 22
    assert filmed["film"][0].shape == (5, 2 * high, 2 * 320, 3)
    assert [row for row, _ in filmed["drawn"]] == [0, 0, 1, 1]
    played = record(policy.env, policy.agent, policy.state, tasks, jnp.int32(0), 2)
    for shown, (place, first) in zip(filmed["joints"], [(0, 0), (0, 1), (1, 0), (1, 1)], strict=True):
        begun = first * int(played.lengths[place, 0])
        np.testing.assert_allclose(shown[0], played.kept.qpos[place, begun], rtol=1e-6)
    out = capsys.readouterr().out
    assert re.search(r"filming 2 of 4: train, episode 2 of 2, return \d+, size=1\n", out)
    assert "filmed film: 2 tasks by 2 episodes" in out
    one, of_trial = (
        films.choose(policy.env, ["train"], [0]),
        lambda count: played._replace(returns=np.zeros((1, count))),
    )
    filmed = {count: films._episodes(one, of_trial(count)) for count in (1, 3, 4, 9)}
    assert {count: [x.episode for x in found] for count, (found, _) in filmed.items()} == {
        **{1: [0], 3: [0, 1, 2], 4: [0, 1, 2, 3]},
        9: [0, 1, 2, 8],
    }
    assert [columns for _, columns in filmed.values()] == [0, 3, 4, 4]


def test_a_caption_covers_nothing_and_needs_no_more_width_than_its_picture():
    """It goes on in the next line, after a space or a comma; tiles beside each other stay equally high."""
    tiles = [np.full((frames, 90, 120, 3), 128, np.uint8) for frames in (1, 2)]
    captions = ("train", "size=1"), ("train, return 998", "size=1,mass=2.25,friction=0.125")
    short, long = films.captioned(tiles, captions)
    assert short.shape == (1, 39 + 90, 120, 3) and long.shape == (2, 39 + 90, 120, 3)
    assert all(np.all(tile[:, 39:] == 128) and not np.any(tile[:, :39, -3:]) for tile in (short, long))
    assert np.any(short[0, 13:26] > 200) and not np.any(short[0, 26:39]) and np.any(long[0, 26:39] > 200)


def test_chosen_tasks_are_filmed(copied_run, filmed):
    """By split and number."""
    words = ["--video", "--video-splits", "extrapolation", "--video-tasks", "3", "1"]
    mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1", *words])
    assert [row for row, _ in filmed["drawn"]] == [6, 4]
    for wrong, said in (
        (["--video", "--video-tasks=9"], "there is no task 9 to film"),
        (["--video-tasks=1"], "give --video as well"),
        (["--video", "--video-splits=test"], "unknown split 'test'"),
        (["--video", "--video-seconds=0"], "video-seconds must be greater than 0"),
    ):
        with pytest.raises(InputError, match=said):
            mtjax.evaluate.main([f"--run={copied_run}", *wrong])


def test_a_film_that_ends_stands_still():
    """Until the longest one ends; the grid is as square as can be."""
    short, long = np.full((1, 2, 2, 3), 1, np.uint8), np.full((3, 2, 2, 3), 2, np.uint8)
    whole = films.grid([short, long, long])
    assert whole.shape == (3, 4, 4, 3)
    assert np.all(whole[:, :2, :2] == 1) and np.all(whole[:, 2:, 2:] == 0) and np.all(whole[2, :2, 2:] == 2)


@pytest.mark.slow
def test_other_values_are_scored_as_the_run_scores_them(copied_run, capsys):
    """A value that trained keeps its number; contexts are scaled as in the run."""
    words = [f"--run={copied_run}", "--episodes=1", "--env.vary.size=0.9:1.2:4"]
    mtjax.evaluate.main(words)
    out = capsys.readouterr().out
    assert "trained on size 1 to 1.2; scored on size 0.9 to 1.2" in out
    rows = rows_of(copied_run / "evaluation-1" / "returns.csv")
    assert {(row["split"], row["size"]) for row in rows} == {("given", x) for x in ("0.9", "1", "1.1", "1.2")}
    policy = mtjax.load(copied_run)
    family = scoring.on_values(policy.env, {"size": "0.9,1,1.2"})
    tasks = scoring.as_unseen(family.tasks("all"), policy.env)
    assert np.asarray(tasks.id).tolist() == [len(policy.env.tasks("all").id), 0, 1]
    np.testing.assert_allclose(tasks.context[:, 0], [-2, -1, 1], atol=1e-5)


@pytest.mark.parametrize(
    "words, said",
    [
        (["--env.vary.siez=1,2"], "unknown parameter 'siez'; did you mean 'size'"),
        (["--env.vary.size=-1,2"], "size must be greater than 0"),
        (["--env.vary.size"], "--env.vary.size needs values"),
        (["--env.vary.size=1,2", "--diagnostics"], "diagnostics are of the run's own tasks"),
        (["--checkpoint=7"], "has no checkpoint 7; it has 100, 150"),
        (["--checkpoint=-7"], "checkpoint must be at least 0"),
        (["--task-seed=-2"], "task-seed must be at least 0"),
        (["--task-seed=2", "--env.vary.size=1,2"], "leave out --env.vary"),
    ],
)
def test_wrong_values_and_checkpoints_are_refused(copied_run, words, said):
    """In a line, and without a new folder."""
    with pytest.raises(InputError, match=said):
        mtjax.evaluate.main([f"--run={copied_run}", *words])
    assert not list(copied_run.glob("evaluation-*"))


def test_an_earlier_checkpoint_is_evaluated(copied_run):
    """As in Python."""
    old, new = mtjax.load(copied_run, checkpoint=100), mtjax.load(copied_run)
    same = jax.tree.map(lambda x, y: np.array_equal(x, y), old.state.nets["actor"], new.state.nets["actor"])
    assert not all(jax.tree.leaves(same))
    mtjax.evaluate.main([f"--run={copied_run}", "--checkpoint=100", "--episodes=1"])
    assert (copied_run / "evaluation-1" / "returns.csv").exists()


def test_run_without_a_checkpoint_is_refused(copied_run):
    """And no folder is left in it."""
    for path in (copied_run / "checkpoints").iterdir():
        path.rename(copied_run / path.name)
    with pytest.raises(InputError, match="holds no checkpoint"):
        mtjax.evaluate.main([f"--run={copied_run}"])
    assert not list(copied_run.glob("evaluation-*"))


def test_table_of_a_run_shows_splits_and_the_worst_task():
    """With intervals over seeds only where there are several; a split without tasks is left out."""
    returns = {"train": np.zeros((1, 2, 2, 3)), "interpolation": np.zeros((1, 2, 0, 3))}
    returns["train"][0, -1] = [[10, 20, 30], [100, 200, 300]]
    one = split_table(Evaluations(np.arange(2), returns, {}))
    assert [line.split() for line in one.splitlines()[1:]] == [["train", "2", "110", "20"]]
    two = {"train": np.concatenate([returns["train"], returns["train"] + 10])}
    assert split_table(Evaluations(np.arange(2), two, {})).splitlines()[1].split() == ["train", "2", "115", "25"]
    three = {"train": np.concatenate([two["train"], returns["train"] + 20])}
    assert "120  [110, 130]" in split_table(Evaluations(np.arange(2), three, {}))


def test_tasks_of_several_parameters_are_told_by_their_values():
    """In the table and in the file, not by numbers alone."""
    env = mtjax.make("finger-spin", vary={"size": [1.0, 1.1], "mass": [0.5, 2.0]}, split="none")
    scores = {"train": Scores(np.arange(4.0).reshape(1, 4, 1), {})}
    head, *lines = task_table(types.SimpleNamespace(env=env, trial=1), scores).splitlines()  # type: ignore
    assert head.split()[:2] == ["split", "task"]
    assert [line.split()[1:3] for line in lines[:2]] == [["size=1,mass=0.5", "0"], ["size=1,mass=2", "1"]]
    assert lines[-1].split() == ["train", "all", "1.5"]
    assert scoring._columns(env, "train")[2] == {"task": "2", "size": "1.1", "mass": "0.5"}
    assert scoring._columns(mtjax.make("finger-spin", vary={"size": [1.0, 1.1]}), "train")[1] == {"size": "1.1"}


def test_success_is_told_beside_returns():
    """At the end of episodes and at any step, by task and over all; not for tasks that do not tell it."""
    env = mtjax.make("finger-spin", vary={"size": [1.0, 1.1]}, split="none")
    returns, end = np.arange(4.0).reshape(1, 2, 2), np.array([[[0.0, 0.0], [0.0, 1.0]]])
    scores = {"train": Scores(returns, {"success": end, "success_ever": np.maximum(end, [1, 0])})}
    head, *lines = task_table(types.SimpleNamespace(env=env, trial=1), scores).splitlines()  # type: ignore
    assert head.split()[2:7] == ["return", "success,", "at", "any", "step"]
    shown = [line.split()[3:] for line in lines]
    assert shown == [["0.00", "0.50", "0,", "1"], ["0.50", "1.00", "2,", "3"], ["0.25", "0.75"]]
    scores = {"train": Scores(returns, {"success": np.full((1, 2, 2), np.nan)})}
    assert "success" not in task_table(types.SimpleNamespace(env=env, trial=1), scores)  # type: ignore


def test_evaluate_says_how_far_it_is(copied_run, capsys, monkeypatch):
    """Where that takes longer than two seconds, before the table."""

    def play(policy, episodes, seed, tasks, *, tell):
        tell(0.0)
        tell(0.25)
        time.sleep(0.5)
        return {split: Scores(np.ones((2, len(x), 1)), {}) for split, x in VALUES.items()}

    monkeypatch.setattr(scoring, "score", play)
    monkeypatch.setattr(waiting, "_SOON", 0.2)  # long after the share is told
    mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1"])
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "playing 14 episodes"  # seven tasks and two seeds
    assert re.fullmatch(r"playing 14 episodes: 25% done  0\.\d s, 0\.\d s left", second)


def test_scores_are_printed_where_they_cannot_be_written(copied_run, capsys, monkeypatch):
    """As in the run of a colleague."""

    def refuse(run):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(run))

    monkeypatch.setattr(scoring, "_new_folder", refuse)
    scores = {split: Scores(np.ones((2, len(x), 1)), {}) for split, x in VALUES.items()}
    monkeypatch.setattr(scoring, "score", lambda *_, tell: scores)
    with pytest.raises(PermissionError):
        mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1"])
    assert "train" in capsys.readouterr().out


# Training by the program.


@pytest.mark.slow
def test_train_prints_where_the_run_is_and_how_it_scored(short_family, tmp_path, capsys):
    """What, where, progress, evaluations, the table, and where again."""
    mtjax.train.main([*SHORT_RUN, f"--runs={tmp_path}"])
    (directory,) = tmp_path.iterdir()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == (
        "sac-conditioned on finger-short: 2 training tasks, size 1 to 1.2, split dense, engine c, seeds 0 to 1"
    )
    assert lines[1] == "worlds: 2 a task, 4 in all; transitions in a batch: 4 a task, 8 in all"
    assert lines[2] == f"run: {directory}" and lines[3] == "random actions until step 20; learning begins there"
    assert lines[4].startswith("memory: ")
    assert [x.split()[0] for x in lines if " of 600 steps" in x] == ["100", "200", "300", "400", "500", "600"]
    assert [x.split()[2] for x in lines if x.startswith("evaluation at")] == ["200", "400", "600"]
    assert [x.split()[0] for x in lines[-6:-2]] == ["split", "train", "interpolation", "extrapolation"]
    assert lines[-2].startswith("done in ") and lines[-2].endswith(f"run: {directory}")
    assert lines[-1].startswith(f"look at it: python -m mtjax.evaluate --run={directory} --import=")
    assert lines[-1].endswith("conftest.py --video    # or --view: on a page")


@pytest.mark.slow
def test_resume_extends_and_the_hint_goes_on(finished_run, copied_run, capsys, monkeypatch):
    """A run that is extended and stopped says how to go on, and the command that it prints does so."""
    train = launch.train

    def stops(config, hooks):
        return train(config, hooks._replace(on_chunk=lambda _: os.kill(os.getpid(), signal.SIGINT)))

    monkeypatch.setattr(launch, "train", stops)
    with pytest.raises(SystemExit) as stop:
        mtjax.train.main(["--resume", str(copied_run), "--steps=1000"])
    assert stop.value.code == 130
    hint = capsys.readouterr().out.splitlines()[-1]
    assert hint.startswith("  python -m mtjax.train ")
    monkeypatch.undo()
    mtjax.train.main(shlex.split(hint)[3:])
    rows = rows_of(copied_run / "metrics.csv")
    assert rows[-1]["steps"] == "1000" and len(rows) == 20
    assert rows[:12] == rows_of(finished_run / "metrics.csv")
    recorded = from_json(copied_run / "config.json")
    assert recorded.plan == dataclasses.replace(from_json(finished_run / "config.json").plan, steps=1000)


# Public names.


def test_public_names_exist():
    """Each has documentation, or is a table or a type that needs none."""
    for name in mtjax.__all__:
        assert hasattr(mtjax, name), name
    assert all(getattr(mtjax, name).__doc__ for name in ("train", "load", "make", "agent", "Result", "Settings"))


def test_train_is_a_function_and_a_module():
    """Importing the program does not take the function's name away."""
    import mtjax.train as module

    assert callable(mtjax.train) and module is mtjax.train and inspect.isfunction(module.main)
    with pytest.raises(InputError, match="steps must be at least 1"):
        mtjax.train(mtjax.make("finger-spin"), mtjax.agent("sac"), steps=0)
