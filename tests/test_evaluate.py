"""Scoring a finished run, and its policy in three lines."""

import csv
import dataclasses
import os
import shlex
import signal
import types

import jax
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import pytest
from conftest import SHORT_RUN
from probes import Stub, Walk, pick, tasks_of
from probes import act as act_once

import mtjax
import mtjax.evaluate
import mtjax.train
from mtjax import loop
from mtjax.config import from_json
from mtjax.evaluation import Evaluations, evaluate, load_evaluations
from mtjax.report import render, scoring
from mtjax.report.tables import split_table
from mtjax.training import checkpoint, launch
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
    scores = evaluate(policy.env, policy.agent, 1, policy.states, tasks, seeds, jnp.int32(number))
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
    for split, returns in scoring.score(policy, 1).items():
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
        return step._replace(reward=reward, metrics={"steps": step.state.age})


class Leaning(Stub):
    """Acts by its state and by the observation."""

    def choose(self, state, obs, task, key):
        return jnp.tanh(state - obs)


def test_evaluation_is_a_plain_loop_over_single_worlds():
    """Episodes that terminate, or are cut off at their task's limit, count up to there and no further."""
    env, agent, episodes = Fatal(), Leaning(), 4
    tasks = tasks_of("one-step", (1.0, -0.5, 2.0))._replace(horizon=jnp.int32([6, 4, 2]))
    states, seeds = jnp.float32([[0.3], [1.7]]), (3, 8)
    found = evaluate(env, agent, episodes, states, tasks, jnp.asarray(seeds), jnp.int32(5))
    reset, step, lengths = jax.jit(env.reset), jax.jit(env.step), set()
    for s, seed in enumerate(seeds):
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 0x7E57), 5)
        keys = jax.random.split(key, (3, episodes))
        for i in range(3):
            task = pick(tasks, i)
            for e in range(episodes):
                world, total, age = reset(task, keys[i, e]), 0.0, 0
                while not world.terminated and age < task.horizon:
                    action = agent.act(states[s], (), world.obs, task, None).action
                    world, age = step(task, world.state, action), age + 1
                    total += float(world.reward)
                np.testing.assert_allclose(found.returns[s, i, e], total, rtol=1e-5)
                assert found.metrics["steps"][s, i, e] == age
                lengths.add(age)
    assert lengths == {2, 3, 4, 6}  # both ways to end, in one batch


# The program.


def test_evaluate_prints_every_task_and_leaves_a_folder(copied_run, capsys):
    """Table, returns and plot agree; a second call writes beside the first."""
    mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1"])
    lines = capsys.readouterr().out.splitlines()
    folder = copied_run / "evaluation-1"
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
            assert line.split()[2] == f"{np.mean(returns):.0f}"
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


def test_video_films_each_task(copied_run, capsys, monkeypatch):
    """Under a name with split, parameter and value, from every second state of an episode of its own row."""
    filmed = {}

    def write(path, frames, fps):
        filmed[path.name] = (*frames, fps)
        return types.SimpleNamespace(name=path.name)

    monkeypatch.setattr(render, "choose_backend", lambda: None)
    monkeypatch.setattr(render, "film", lambda env, row, states: (row, states.qpos.shape))
    monkeypatch.setattr(render, "write_video", write)
    mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1", "--video"])
    names = [f"{split}-size-{value:g}" for split, values in VALUES.items() for value in values]
    assert filmed == {name: (row, (10, 3), 25) for row, name in enumerate(names)}
    out = capsys.readouterr().out
    assert all(f"filmed {name}: return " in out for name in names)


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
    assert "115  [110, 120]" in split_table(Evaluations(np.arange(2), two, {}))


# Training by the program.


def test_train_prints_where_the_run_is_and_how_it_scored(short_family, tmp_path, capsys):
    """What, where, progress, evaluations, the table, and where again."""
    mtjax.train.main([*SHORT_RUN, f"--runs={tmp_path}"])
    (directory,) = tmp_path.iterdir()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == (
        "sac-conditioned on finger-short: 2 training tasks, size 1 to 1.2, split dense, engine c, seeds 0 to 1"
    )
    assert lines[1] == f"run: {directory}" and lines[2].startswith("memory: ")
    assert [x.split()[0] for x in lines if " of 600 steps" in x] == ["100", "200", "300", "400", "500", "600"]
    assert [x.split()[2] for x in lines if x.startswith("evaluation at")] == ["200", "400", "600"]
    assert [x.split()[0] for x in lines[-5:-1]] == ["split", "train", "interpolation", "extrapolation"]
    assert lines[-1].endswith(f"run: {directory}")


def test_resume_extends_and_the_hint_goes_on(finished_run, copied_run, capsys, monkeypatch):
    """A run that is extended and stopped says how to go on, and the command that it prints does so."""
    train = launch.train

    def stops(*arguments, **settings):
        return train(*arguments, **settings, on_chunk=lambda _: os.kill(os.getpid(), signal.SIGINT))

    monkeypatch.setattr(launch, "train", stops)
    mtjax.train.main(["--resume", str(copied_run), "--steps=1000"])
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

    assert callable(mtjax.train) and module is mtjax.train
    with pytest.raises(InputError, match="steps must be at least 1"):
        mtjax.train(mtjax.make("finger-spin"), mtjax.agent("sac"), steps=0)
