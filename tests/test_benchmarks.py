"""What benchmarks make of their figures; what they measure is no matter of tests."""

import contextlib
import csv
import dataclasses
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from needs import needs
from probes import one_in, slow_but

import mtjax
from mtjax.agents.combinations import require_sight
from mtjax.agents.parts.knowing import Text
from mtjax.envs import BENCHMARKS
from mtjax.envs.metaworld.names import TASKS
from mtjax.learning.evaluation import Evaluations, load_evaluations, save_evaluations
from mtjax.learning.loop import Settings
from mtjax.progress import duration
from mtjax.saved.log import append_rows
from mtjax.saved.records import Records
from mtjax.training.console import Console
from mtjax.types import InputError

_OF_META_WORLD = ("physics", "steps_per_second", "metaworld_policies")
FOLDER = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture
def script(monkeypatch):
    """A benchmark as a module."""
    monkeypatch.syspath_prepend(str(FOLDER))

    def load(name):
        spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    yield load
    names = "atari", "report", "training", "returns", "update_cost", "resumable", "learning", "parts"
    for name in (*names, *_OF_META_WORLD):
        sys.modules.pop(name, None)


def rows(*milliseconds, rate=100):
    return [
        {"agent": name, "tasks": 10, "milliseconds": ms, "steps_per_second": rate, "slowest": 1}
        for name, ms in zip("abc", milliseconds, strict=False)
    ]


@pytest.mark.parametrize(
    "new, absolute, slower",
    [
        (rows(1, 2, 3), True, []),
        (rows(1.1, 2.2, 3.3), True, []),
        (rows(2, 4, 6), False, []),  # as a slower machine is
        (rows(2, 4, 6), True, ["a", "b", "c"]),
        (rows(1, 3, 3), False, ["b"]),
        (rows(2, 2, 6), False, []),  # b is faster beside the others
    ],
)
def test_what_is_slower_is_flagged(script, new, absolute, slower):
    """By the ratio to what was recorded, and beside the others unless the machine is the same and quiet."""
    lines, failed = script("compare").judge(rows(1, 2, 3), new, 1.15, absolute)
    assert [line.split("agent=")[1][0] for line in lines if line.startswith("SLOWER")] == slower
    assert failed == bool(slower) and len(lines) == 6


def test_a_rate_that_falls_is_slower(script):
    """And what is missing is no better."""
    judge = script("compare").judge
    assert "SLOWER   agent=a tasks=10: steps_per_second 2.00 x" in judge(rows(1), rows(1, rate=50), 1.15, True)[0]
    lines, failed = judge(rows(1, 2), rows(1), 1.15, False)
    assert failed and lines[0] == "MISSING  agent=b tasks=10"
    lines, failed = judge(rows(1), [{"agent": "a", "tasks": 10, "milliseconds": 1}], 1.15, False)
    assert failed and "MISSING  agent=a tasks=10: steps_per_second" in lines


@pytest.mark.parametrize("name", ["update-cost-cpu", "scaling-cpu", "time-to-return-cpu", "brax-sac-cpu"])
def test_a_recorded_report_is_as_fast_as_itself(script, name, capsys, monkeypatch):
    """And its settings are flags of the benchmark that wrote it."""
    compare, path = script("compare"), FOLDER / "results" / f"{name}.json"
    monkeypatch.setattr(sys, "argv", ["compare.py", str(path), str(path)])
    with pytest.raises(SystemExit) as end:
        compare.main()
    assert end.value.code == 0 and "same" in capsys.readouterr().out
    report = json.loads(path.read_text())
    source = (FOLDER / report["benchmark"]).read_text()
    flags = [word.split("=")[0] for word in compare.words(dict(report["settings"])) if word.startswith("--")]
    assert flags and all(f'"{flag}"' in source for flag in flags if flag != "--")


# Runs that are stopped.

PAIR = ["--preset=cpu", "--seeds=2", "--steps=2000"]  # four chunks of 500 steps
SMALL = ["num_envs=2", "chunk_steps=25", "batch_size=4", "replay_size=200", "warmup_steps=5"]
FILES = {
    "learning": ["point-mass-vary-goal/sac.csv", "point-mass-vary-goal/sac.npz", "evaluations.csv"],
    "presets": ["point-mass-vary-goal/sac-grid.csv"],
}


@pytest.fixture
def run(script, monkeypatch):
    """A function that runs a benchmark of one small pair in a folder, as its command does."""
    monkeypatch.setenv("MTJAX_CACHE", "0")
    flags = {
        "learning": ["--envs", "point-mass-vary-goal", "--agents", "sac", "--evaluations=2", "--training", *SMALL],
        "presets": ["--family=point-mass-vary-goal", "--agent=sac", "--grid", "tau=0.01,0.02", "--given", *SMALL],
    }

    def run(name, out, *more):
        monkeypatch.setattr(sys, "argv", [name, *PAIR, *flags[name], *more, f"--out={out}"])
        script(name).main()

    return run


def terminate(*_):
    os.kill(os.getpid(), signal.SIGTERM)


def die(*_):
    raise ZeroDivisionError


def in_third_chunk(act):
    """``Records.add_rows`` that acts after the third chunk, hence after the first evaluation."""
    add = Records.add_rows
    return lambda records, rows: (add(records, rows), act() if rows[0]["steps"] == 1500 else None)


def lines_of(path):
    return list(csv.DictReader(path.read_text().splitlines()))


def results(out, name):
    """What a benchmark writes, apart from clocks."""
    found = {}
    for path in (out / file for file in FILES[name]):
        if path.suffix == ".npz":
            found[path.name] = load_evaluations(path)
        else:
            found[path.name] = [
                {name: x for name, x in line.items() if not name.endswith("seconds")} for line in lines_of(path)
            ]
    return found


@pytest.fixture(scope="module")
def unstopped():
    """Results that are found once, by the name of the benchmark."""
    return {}


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(FILES, "learning", nightly=True))
@pytest.mark.parametrize("end", slow_but([terminate, die], terminate, nightly=True))
def test_a_stopped_pair_goes_on_to_the_same_results(run, unstopped, tmp_path, monkeypatch, name, end):
    """It is in no table before, and leaves nothing but results."""
    if name not in unstopped:
        run(name, tmp_path / "whole")
        unstopped[name] = results(tmp_path / "whole", name)
    out = tmp_path / "parts"
    with monkeypatch.context() as patch, pytest.raises((SystemExit, ZeroDivisionError)):
        patch.setattr(Records, "add_rows", in_third_chunk(end))
        run(name, out)
    assert not [file for file in FILES[name] if (out / file).exists()]
    trained = []
    add = Records.add_rows
    monkeypatch.setattr(Records, "add_rows", lambda *given: (trained.append(given[1][0]["steps"]), add(*given)))
    run(name, out)
    assert trained == ([2000] if end is terminate else [1500, 2000])
    jax.tree.map(np.testing.assert_array_equal, results(out, name), unstopped[name])
    assert not list(out.rglob("checkpoints"))


@pytest.mark.slow
def test_an_unfinished_pair_is_told_and_goes_on_with_its_settings_only(run, script, tmp_path, monkeypatch):
    """Tables name it; if asked they show its last evaluation, and curves up to there."""
    with monkeypatch.context() as patch, pytest.raises(SystemExit, match=r"stopped: the run is in .*sac, and the same"):
        patch.setattr(Records, "add_rows", in_third_chunk(terminate))
        run("learning", tmp_path)
    with pytest.raises(InputError, match=r"had num_envs=\d+, not 3"):
        run("learning", tmp_path, "--training", *SMALL, "num_envs=3")
    with pytest.raises(InputError, match=r"had eval_every=\d+, not \d+"):
        run("learning", tmp_path, "--steps=4000")
    with (tmp_path / "point-mass-vary-goal" / "sac" / "metrics.csv").open("a") as file:
        file.write("0,100,20")  # as of a killed process
    learning, suite = script("learning"), script("suite")
    small = suite.Suite("", ("point-mass-vary-goal",), ("sac",), 1)
    learning.tabulate(tmp_path, 900, "sac")
    for table in ((tmp_path / "table.md").read_text(), suite.tabulate(tmp_path, small)):
        assert "| sac" not in table
        assert table.strip().endswith("\n- point-mass-vary-goal: sac, unfinished: evaluated after 1,000 of 2,000 steps")
    learning.tabulate(tmp_path, 900, "sac", unfinished=True)
    for table in ((tmp_path / "table.md").read_text(), suite.tabulate(tmp_path, small, unfinished=True)):
        assert "| point-mass-vary-goal | sac, unfinished: evaluated after 1,000 of 2,000 steps |" in table
    assert learning.curve_of(*learning.pairs(tmp_path, unfinished=True))[:, 0, 1].tolist() == [500, 1000]


@pytest.mark.slow
def test_a_pair_whose_results_were_not_written_is_not_trained_again(run, tmp_path, monkeypatch):
    """And what a process left that died before it could clean up is removed."""
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr("mtjax.learning.evaluation.save_evaluations", die)  # by which the script marks a pair as finished
        patch.setattr("mtjax.saved.records.save_evaluations", save_evaluations)
        run("learning", tmp_path)
    monkeypatch.setattr(Records, "add_rows", die)
    run("learning", tmp_path)
    assert [line["steps"] for line in lines_of(tmp_path / FILES["learning"][0])[::2]] == ["500", "1000", "1500", "2000"]
    policy = mtjax.load(tmp_path / "policies" / "point-mass-vary-goal" / "sac")
    task = jax.tree.map(lambda x: x[0], policy.env.tasks("train"))
    assert policy(np.zeros(policy.takes.shape, np.float32), task).shape == (2,)
    (tmp_path / "point-mass-vary-goal" / "sac").mkdir()
    run("learning", tmp_path)
    assert not (tmp_path / "point-mass-vary-goal" / "sac").exists()


def test_returns_are_those_of_whole_chunks(script, tmp_path):
    """A chunk that is half written is none; one in which no episode ended has no return."""
    (tmp_path / "run").mkdir()
    lines = ["seed,steps,seconds,return", "0,10,1.0,", "1,10,1.0,", "0,20,2.0,5", "1,20,2.0,7", "0,30,3.0,9"]
    (tmp_path / "run" / "metrics.csv").write_text("\n".join(lines) + "\n")
    chunks = script("time_to_return").chunks
    assert chunks(tmp_path, 2) == [(10, 1.0, None), (20, 2.0, 6.0)]
    assert chunks(tmp_path / "none", 2) == []


def test_differences_are_against_the_baseline(script):
    """A line for every other agent and split, with no pairs where the numbers of seeds differ."""
    plain, better = np.array([[1.0], [2.0], [3.0]]), np.array([[11.0], [12.0], [13.0]])
    found = {"plain": {"train": plain}, "better": {"train": better}, "more": {"train": np.tile(better, (2, 1))}}
    learning = script("learning")
    rows_of = lambda found, baseline="plain": learning.difference_rows(learning.differences_of("f", found, baseline))
    lines = rows_of(found)
    pairs = "+10.0 [+10.0, +10.0]"
    assert lines[0] == ["f", "better", "train", pairs, "0.0000", "yes", lines[0][6], "1.00 [1.00, 1.00]"]
    assert lines[0][6].startswith("+10.0 [+8")
    few = {"plain": {"train": plain[:2]}, "better": {"train": better[:2]}}
    assert rows_of(few)[0][3:] == ["+10.0", "0.0000", "yes", "+10.0", "1.00"]
    assert lines[1][:6] == ["f", "more", "train", "-", "-", "-"] and len(lines) == 2
    assert rows_of(found, "absent") == []


def test_differences_hold_by_all_of_their_table(script):
    """A p of 0.02 alone is one of 0.04 beside another difference, and of 0.06 beside two."""
    learning = script("learning")
    none = learning.Interval(0.0, 0.0, 0.0)
    of = lambda p: learning.Difference("f", "a", "train", none, p, none, none)
    found = lambda *ps: [line[4:6] for line in learning.difference_rows([of(p) for p in ps])]
    assert found(0.02) == [["0.0200", "yes"]]
    assert found(0.02, 0.9) == [["0.0400", "yes"], ["0.9000", "no"]]
    assert found(0.9, 0.02, 0.5)[1] == ["0.0600", "no"]


def test_replay_agents_learn_from_as_much_as_the_baseline(script):
    """The same worlds, updates and batches; all else, and what PPO does, is the preset's. Sentences are read."""
    learning = script("learning")
    given = {"env": [], "vary": [], "split": None, "preset": "gpu"}
    of = lambda agent, equal_to: learning.program_of(
        SimpleNamespace(**given, equal_to=equal_to), "finger-spin-vary-size", agent
    )
    loop = lambda x: (
        x.training.num_envs,
        *(getattr(x.learner.experience, name) for name in ("updates_per_step", "batch_size", "replay_size")),
    )
    assert loop(of("brc", "sac-conditioned")) == loop(of("sac-conditioned", "")) != loop(of("brc", ""))
    assert of("brc", "sac-conditioned").learner.hidden == of("brc", "").learner.hidden
    assert of("ppo", "sac-conditioned").training == of("ppo", "").training
    assert of("care-text", "sac-conditioned").learner.conditioning == Text()
    assert len(of("brc", "sac-conditioned").family.labels("train")) == 4  # HiP-BMDP's split


def test_a_task_by_itself_has_the_worlds_that_it_has_among_all(script, tmp_path):
    """Where sharing is measured: by its own preset one task would have those of ten."""
    suite, learning = script("suite"), script("learning")
    hard = dataclasses.replace(suite.SUITES["hard"], together="walker-run+hopper-hop", envs=("walker-run",))
    words = {"steps_per_task": 100, "seeds": 1, "preset": "gpu", "equal_to": "", "training": [], "evaluations": 1}
    words |= {"eval_episodes": 1}
    asked = suite.request(SimpleNamespace(**words), hard, "walker-run", tmp_path)
    shared = mtjax.preset("walker-run+hopper-hop", "brc", "gpu").training.num_envs
    assert learning.program_of(asked, "walker-run", "brc").training.num_envs == shared
    assert shared < mtjax.preset("walker-run", "brc", "gpu").training.num_envs


def test_a_figure_has_few_lines_and_the_baselines_is_in_each(script):
    figures = script("learning").figures
    names = [f"agent-{k}" for k in range(10)]
    found = list(figures(Path("x/env.png"), dict.fromkeys(["plain", *names]), "plain"))
    assert [path.name for path, _ in found] == ["env.png", "env-2.png"]
    assert list(found[0][1]) == ["plain", *names[:6]] and list(found[1][1]) == ["plain", *names[6:]]
    assert [list(few) for _, few in figures(Path("env.png"), {"plain": 1}, "plain")] == [["plain"]]
    assert list(figures(Path("env.png"), {}, "plain")) == []


def test_a_grid_has_every_combination_and_lr_means_all_rates(script):
    presets = script("presets")
    found = presets.grid(["lr=1e-3,3e-3", "tau=0.01"])
    assert found == [{"lr": 1e-3, "tau": 0.01}, {"lr": 3e-3, "tau": 0.01}]
    rates = dict.fromkeys(("actor_lr", "critic_lr"), 3e-3)
    assert presets.as_point(mtjax.agent("ppo"), {"lr": 3e-3, "gamma": 0.9}) == {**rates, "gamma": 0.9}
    assert presets.as_point(mtjax.agent("sac"), found[1]) == {**rates, "temperature_lr": 3e-3, "tau": 0.01}


def test_points_are_ranked_by_the_end_of_their_runs(script, tmp_path):
    """Two points of two seeds and ten chunks: the last tenth is the last chunk."""
    presets = script("presets")
    rows = [
        {"return": 10 * point + seed + chunk, "steps": 100 * chunk, "seconds": chunk}
        for chunk in range(10)
        for point in range(2)
        for seed in range(2)
    ]
    lines = presets.rows(SimpleNamespace(rows=rows), [{"tau": 0.01}, {"tau": 0.02}], seeds=2)
    assert [line["return"] for line in lines] == [9.5, 19.5]
    assert (lines[1]["least"], lines[1]["largest"], lines[1]["whole_run"]) == (19, 20, 15)
    (tmp_path / "family").mkdir()
    append_rows(tmp_path / "family" / "sac-lr.csv", [{**line, "given": ""} for line in lines])
    presets.tabulate(tmp_path / "family")
    table = (tmp_path / "family.md").read_text().splitlines()
    assert "tau=0.02" in table[2] and "tau=0.01" in table[3]


def test_products_are_counted_with_their_loops(script):
    """Two operations for each of 3 x 4 x 4 numbers, five times; and those of an update as it is timed."""
    cost, trace = script("update_cost"), script("update_trace")
    scan = lambda x, w: jax.lax.scan(lambda x, _: (x @ w, None), x, length=5)[0]
    assert trace.matrix_flops(jax.make_jaxpr(scan)(np.ones((3, 4)), np.ones((4, 4)))) == 5 * 2 * 3 * 4 * 4
    agent, tasks, keys = mtjax.agent("sac", hidden=(8,)), cost.tasks_of(2), jax.random.split(jax.random.key(0), 1)
    state = jax.eval_shape(jax.vmap(lambda key: agent.init(cost.SPEC, tasks, key)), keys)
    update = cost.updates(agent, tasks, cost.random_window(cost.SPEC, 2, 4), 3)
    found = trace.matrix_flops(jax.make_jaxpr(update)(state, keys))
    assert found > 0 and found % 3 == 0


def test_ratios_are_named_after_the_agent_that_they_are_to(script):
    row = {"agent": "drq", "tasks": 2, "seeds": 1, "milliseconds": 1.0, "fastest": 1.0, "slowest": 1.0}
    row |= {"over_sac": 1.0, "parameters": 3, "compile_seconds": 1.0}
    assert "| over drq |" in script("update_cost").table([row])


@pytest.mark.parametrize(
    "samples, flat",
    [
        ([*range(0, 360, 3), *[360] * 100], True),  # which grows in the first minute
        ([*range(300, 520)], False),
        ([*[300] * 120, *[300] * 90, *[319] * 10], True),  # by less than 20 MB
        ([*[300] * 120, *[300] * 90, *[321] * 10], False),
        ([*[5000] * 120, *[5000] * 90, *[5090] * 10], True),  # by less than a fiftieth
        ([*[5000] * 120, *[5000] * 90, *[5110] * 10], False),
    ],
)
def test_memory_that_grows_to_the_end_is_not_flat(script, samples, flat):
    """By the medians of the first and the last of ten parts, without the first minute."""
    assert script("soak").judge(samples)[1] == flat


def evaluations_of(returns, **metrics):
    """Evaluations of training tasks (S, V, T, episodes); other splits are empty."""
    splits = lambda x: {
        "train": np.asarray(x),
        **dict.fromkeys(("interpolation", "extrapolation"), np.asarray(x)[:, :, :0]),
    }
    steps, values = (
        np.arange(np.shape(returns)[1]),
        {name: np.arange(x.shape[2]) for name, x in splits(returns).items()},
    )
    return Evaluations(steps, splits(returns), values, {name: splits(x) for name, x in metrics.items()})


def test_a_suite_reports_success_and_what_sharing_is_worth(script, tmp_path):
    """Of the last evaluation, over tasks and episodes, with intervals over seeds."""
    suite = script("suite")
    tasks = "walker-walk", "walker-run"
    together, shape = "+".join(tasks), (3, 2, 2, 4)
    returns = np.zeros(shape)
    returns[:, 1] = np.array([10.0, 30.0])[:, None]
    success = np.zeros(shape)
    success[:, 1, 1, :2] = 1
    found = {together: evaluations_of(returns, success=success, success_ever=np.ones(shape))}
    unseen = found["walker-stand+walker-walk"] = evaluations_of(np.ones(shape), success=np.ones(shape))
    unseen.values["interpolation"] = unseen.values["train"]
    for scores in (unseen.returns, unseen.metrics["success"]):
        scores["interpolation"] = np.full(shape, 0.5)
    found[together] = found[together]._replace(steps=np.array([100, 200]))
    found |= {name: evaluations_of(np.full((3, 2, 1, 4), 25.0))._replace(steps=np.array([50, 100])) for name in tasks}
    for env, evaluations in found.items():
        (tmp_path / env).mkdir()
        save_evaluations(tmp_path / env / "brc.npz", evaluations)
    table = suite.tabulate(tmp_path, suite.Suite("", (together,), ("brc",), 1, together=together))
    assert "| 2 families | brc | 3 | 20 [20, 20] | - | - | 0.250 [0.250, 0.250] | 1.000 [1.000, 1.000] |" in table
    assert "| walker-run | brc | 3 | 25 [25, 25] | - | - | - | - | - | - | 100 |" in table
    assert "| 1.000 [1.000, 1.000] | - | 0.500 [0.500, 0.500] | - |" in table
    sharing = (tmp_path / "sharing.md").read_text()
    assert "| walker-walk | brc | 100 | 10 [10, 10] | 25 [25, 25] | -15 [-15, -15] |" in sharing
    assert "| walker-run | brc | 100 | 30 [30, 30] | 25 [25, 25] | +5 [+5, +5] |" in sharing
    assert len((tmp_path / "tasks.csv").read_text().splitlines()) == 1 + 3 * 6
    for env, evaluations in found.items():  # of an agent that the suite does not have by itself
        save_evaluations(tmp_path / env / "sac.npz", evaluations)
    suite.tabulate(tmp_path, suite.Suite("", (together,), ("brc",), 1, together=together))
    assert "| walker-run | sac | 100 | 30 [30, 30] |" in (tmp_path / "sharing.md").read_text()


def test_sharing_is_compared_after_as_many_steps_a_task(script, tmp_path):
    """A task's own agent was evaluated more often, one was stopped before the first evaluation of the shared one."""
    suite = script("suite")
    together = "walker-walk+walker-run"
    both = evaluations_of(np.array([[10.0, 20.0], [30.0, 40.0]])[None, ..., None])._replace(steps=[160, 240])
    own = evaluations_of(np.array([1.0, 2.0, 3.0])[None, :, None, None])._replace(steps=[40, 110, 200])
    early = evaluations_of(np.full((1, 1, 1, 1), 5.0))._replace(steps=[40])
    for env, evaluations in {together: both, "walker-walk": own, "walker-run": early}.items():
        (tmp_path / env).mkdir()
        save_evaluations(tmp_path / env / "brc.npz", evaluations._replace(steps=np.array(evaluations.steps)))
    suite.tabulate(tmp_path, suite.Suite("", (together,), ("brc",), 1, together=together))
    sharing = (tmp_path / "sharing.md").read_text()
    assert "| walker-walk | brc | 120 | 30 | 2 | +28 |" in sharing
    assert "| walker-run | brc | 40 | - | - | - |" in sharing


GIVEN = SimpleNamespace(
    steps_per_task=100, seeds=None, env=[], training=["gamma=0.9"], evaluations=None, eval_episodes=50
)


def test_suites_name_only_what_there_is(script):
    suite = script("suite")
    for each in suite.SUITES.values():
        assert {*each.agents, each.equal_to or "brc"} <= {*mtjax.AGENTS, *script("learning").VARIANTS}
        names = {name for env in each.envs for name in env.split("+")}
        assert all(name in mtjax.ENVS or name in BENCHMARKS for name in names)


def test_scores_on_atari_are_in_units_of_a_persons(script, tmp_path):
    """0 is a random policy, 1 a person; with the medians over games of one agent for all, and of one for each."""
    suite, atari = script("suite"), script("atari")
    assert len(atari.known()) == 57 and {*atari.FIVE, *atari.TWENTY_SIX} <= set(atari.known())
    assert all(random < human for random, human in atari.known().values())
    shares = {"Pong": [0.5, 0.7, 0.9], "Breakout": [2.0, 2.0, 2.0], "Qbert": [0.0, 0.1, 0.2]}
    raw = {game: np.interp(of, [0, 1], atari.known()[game]) for game, of in shares.items() if game != "Breakout"}
    raw["Breakout"] = np.full(3, 2 * 30.5 - 1.7)
    as_scores = lambda names: evaluations_of(np.stack([raw[x] for x in names], axis=1)[:, None, :, None])
    both = "envpool:Breakout-v5+envpool:Pong-v5"
    found = {f"envpool:{game}-v5": as_scores([game]) for game in raw} | {both: as_scores(["Breakout", "Pong"])}
    for env, evaluations in found.items():
        (tmp_path / env).mkdir()
        save_evaluations(tmp_path / env / "ppo.npz", evaluations)
    table = suite.human_scores(tmp_path)
    assert "| envpool:Pong-v5 | ppo | alone | 3 | 4.0 [-3.1, 11.1] | 0.700 [0.500, 0.900] |" in table
    assert "| envpool:Pong-v5 | ppo | with others | 3 | 4.0 [-3.1, 11.1] | 0.700 [0.500, 0.900] |" in table
    assert "| ppo | alone | 3 | 0.700 [0.500, 0.900] |" in table and "| 0.933 [0.833, 1.033] |" in table
    assert "| ppo | with others | 2 | 1.350 [1.250, 1.450] |" in table
    (tmp_path / "none").mkdir()
    assert not suite.human_scores(tmp_path / "none")


@needs("envpool")
def test_ataris_protocol_is_envpools(script):
    """Whole games of at most 108,000 frames, with actions that stick, all 18 of them, and their own scores."""
    suite, atari = script("suite"), script("atari")
    family = suite.family_of(suite.SUITES["atari5"], "+".join(map(atari.name, ("Pong", "Breakout"))))
    assert family.spec.action.size == 18 and family.spec.frames == 4 and family.train_count == 2
    assert [part.name for part in family.parts] == ["envpool:Pong-v5", "envpool:Breakout-v5"]
    pool = family.parts[1].family.make(0, 2, 0)
    told = pool.spec.config._asdict()
    assert {name: told[name] for name in atari.PROTOCOL} == atari.PROTOCOL
    assert told["max_episode_steps"] == 27_000 and told["frame_skip"] == 4 and told["stack_num"] == 1


@pytest.mark.parametrize("name, env", [("dynamics", "finger-spin-vary-size"), ("looks", "finger-spin")])
def test_a_suites_steps_are_those_of_the_tasks_that_its_split_trains_on(script, name, env, tmp_path):
    """Four of the ten sizes, and of the ten angles, of HiP-BMDP's split."""
    suite = script("suite")
    found = suite.request(GIVEN, suite.SUITES[name], env, tmp_path)
    assert found.evaluations == 4 and found.eval_episodes == 50 and found.training == ["gamma=0.9"]
    assert found.steps == 400 and found.split == "hip-bmdp" and found.vary == [*suite.SUITES[name].vary]
    assert len(suite.family_of(suite.SUITES[name], env).labels("train")) == 4


@needs("metaworld")
@pytest.mark.parametrize("name, tasks, tests", [("ml1", 1, 1), ("ml10", 10, 5), ("ml45", 45, 5)])
def test_a_suite_of_meta_learning_adapts_before_the_episode_that_counts(script, name, tasks, tests, tmp_path):
    """Ten episodes, in a trial for each of the 50 goals, which agents do not see; test tasks are not trained on."""
    suite = script("suite")
    protocol = suite.SUITES[name]
    found = suite.request(GIVEN, protocol, protocol.envs[0], tmp_path)
    assert found.training == ["gamma=0.9", "trials=11"] and found.eval_episodes == 50 * 11 and found.evaluations == 1
    assert found.steps == 100 * tasks
    env = suite.family_of(protocol, protocol.envs[0])
    assert env.counts == {"train": tasks, "interpolation": 0, "extrapolation": tests}
    assert all(part.family.goal_hidden and part.family.num_draws == 50 for part in env.parts)


def test_what_counts_is_the_last_episode_of_a_trial(script, tmp_path):
    """Success at its end and at any of its steps, of training and of test tasks; the first and all stand beside it."""
    suite = script("suite")
    protocol = dataclasses.replace(suite.SUITES["goals"], adapt=2)
    trials = np.array([[1.0, 2.0, 6.0], [3.0, 4.0, 8.0]]).reshape(1, 1, 1, 6)  # two trials of three episodes
    ended, ever = np.array([0, 1, 0.0] * 2).reshape(trials.shape), np.array([0, 1, 1, 0, 0, 0.0]).reshape(trials.shape)
    found = evaluations_of(np.tile(trials, (3, 2, 10, 1)), success=np.tile(ended, (3, 2, 10, 1)))
    found.metrics["success_ever"] = {split: np.tile(ever, (3, 2, 10, 1)) for split in ("train", "extrapolation")}
    found.metrics["success_ever"]["interpolation"] = found.returns["interpolation"]
    found.metrics["success"]["extrapolation"] = found.metrics["success"]["train"]
    returns = {**found.returns, "extrapolation": 10 * found.returns["train"]}
    values = {**found.values, "extrapolation": found.values["train"]}
    found = found._replace(returns=returns, values=values, trial=3)
    (tmp_path / "point-mass-vary-goal").mkdir()
    save_evaluations(tmp_path / "point-mass-vary-goal" / "rl2.npz", found)
    table = suite.tabulate(tmp_path, protocol)
    assert "| rl2 | 3 | 7 [7, 7] | - | 70 [70, 70] | 0.000 [0.000, 0.000] | 0.500 [0.500, 0.500] |" in table
    lines = (tmp_path / "episodes.md").read_text().splitlines()[2:]
    cells = [[cell.strip().split(" [")[0] for cell in line.split("|")[4:-1]] for line in lines]
    assert cells == [
        ["train", "10", "return", "2", "7", "4"],
        ["train", "10", "success at the end", "0", "0", "0.333"],
        ["train", "10", "success at any step", "0", "0.5", "0.333"],
        ["extrapolation", "10", "return", "20", "70", "40"],
        ["extrapolation", "10", "success at the end", "0", "0", "0.333"],
        ["extrapolation", "10", "success at any step", "0", "0.5", "0.333"],
    ]


def test_episodes_of_adaptation_are_those_of_suites_that_adapt(script, monkeypatch):
    suite = script("suite")
    for words in (["goals", "--adapt=3"], ["ml10", "--adapt=0"]):
        monkeypatch.setattr(sys, "argv", ["suite", *words])
        with pytest.raises(InputError, match="--adapt is a number of episodes"):
            suite.main()


def test_a_suite_counts_the_tasks_that_its_flags_ask_for(script, tmp_path, monkeypatch):
    """Three goals in place of ten: in the steps of a run and in the tables. Settings may be words."""
    suite, asked = script("suite"), []
    words = ["--agents", "sac", "--seeds=2", "--steps-per-task=100", "--env", "num_tasks=3", "combine=random"]
    small = ["--training", "tau=0.1", "conditioning=none", f"--out={tmp_path}"]
    monkeypatch.setattr(sys, "argv", ["suite", "goals", "--envs", "point-mass-vary-goal", *words, *small])

    def trained(folder, family, agent, **given):
        asked.append((given["steps"], family.train_count, given["tau"], given["conditioning"]))
        folder.mkdir(parents=True)
        (folder / "config.json").write_text("{}")
        evaluations = evaluations_of(np.arange(24.0).reshape(2, 1, 3, 4))
        return SimpleNamespace(rows=lines, evaluations=evaluations, seconds=1.0, compile_seconds=2.0)

    lines = [{"seed": 0, "steps": 300, "seconds": 1, "wall_seconds": 1, "return": 1.0}]
    monkeypatch.setattr(sys.modules["learning"], "train", trained)
    monkeypatch.setattr(sys.modules["learning"], "keep_policy", lambda *_: None)
    suite.main()
    assert asked == [(300, 3, 0.1, "none")]
    made = json.loads((tmp_path / "point-mass-vary-goal" / "sac.json").read_text())
    assert made["machine"]["jax"] == jax.__version__ and made["settings"]["steps"] == 300
    assert len((tmp_path / "tasks.csv").read_text().splitlines()) == 1 + 2 * 3


@pytest.mark.parametrize("agent", one_in(3, ["drq", "sac-ae", "deepmdp", "ppo", "hip-bmdp", "care"]))
def test_a_suites_agents_see_its_pictures(script, agent):
    """Agents whose subject is something else encode the pictures."""
    suite, learning = script("suite"), script("learning")
    pixels = suite.SUITES["pixels"]
    settings = script("report").settings_of(pixels.settings)
    program = mtjax.preset(pixels.envs[0], agent, "gpu", learning.seeing(agent, settings), **settings)
    require_sight(program.learner, program.family.spec)
    assert program.learner.representation.sees_pictures


def test_agents_that_are_timed_see_numbers_or_pictures(script):
    cost = script("update_cost")
    assert cost.seeing(None) is cost.SPEC
    assert {name: x.shape for name, x in cost.seeing(16).obs.items()} == {"pixels": (16, 16, 3)}


@needs("metaworld")
def test_scripted_policies_need_numpy_alone(script, monkeypatch):
    """The package's own imports, such as Gymnasium's environments, stay out."""
    policies = script("metaworld_policies")
    for name in [name for name in sys.modules if name.split(".")[0] == "metaworld"]:
        monkeypatch.delitem(sys.modules, name)
    before = set(sys.modules)
    found = policies.load()
    assert set(found) == set(TASKS)
    new = {name for name in set(sys.modules) - before if not name.startswith("metaworld")}
    assert not new & {"gymnasium", "metaworld.sawyer_xyz_env", "scipy"}
    obs = np.zeros((2, 3, 39))
    obs[..., 36:39] = [0.1, 0.0, 0.0]  # reach goes to the goal, five times as fast as it is far
    np.testing.assert_allclose(policies.actions(found["reach"], obs)[1, 2, :3], [0.5, 0, 0], atol=1e-6)
    for name in [name for name in sys.modules if name.split(".")[0] == "metaworld"]:
        del sys.modules[name]


@needs("metaworld")
def test_tasks_with_a_line_are_not_played_again(script, tmp_path, monkeypatch):
    parity = script("metaworld_parity")
    played = []

    def play(names, engine, goals, player):
        played.append(names)
        return [(name, np.ones((goals, 2)), np.zeros((goals, 3))) for name in names]

    monkeypatch.setattr(parity, "play", play)
    monkeypatch.setattr(parity, "scripted", lambda: (list(TASKS), None))
    given = SimpleNamespace(out=tmp_path / "x.csv", engine="c", goals=4, together=2, run=None)
    for tasks in (["reach"], ["drawer-open", "reach", "soccer", "drawer-close"]):
        parity.compare(None, SimpleNamespace(**vars(given), tasks=tasks))
    assert played == [["reach"], ["drawer-open", "drawer-close"], ["soccer"]]  # tasks of a scene side by side
    assert parity.read(given.out) == {"reach", "drawer-open", "drawer-close", "soccer"}
    assert given.out.read_text().splitlines()[1] == "reach,c,4,1,1,,,"
    assert parity.read(FOLDER / "results" / "metaworld-policies.csv") == set(TASKS)


def test_a_policy_sees_and_steps_the_originals_worlds(script):
    """Two goals: one is reached at the end, the other before it and lost again."""
    parity = script("metaworld_parity")
    asked, steps = [], iter(range(1, 501))

    def ask(do, **given):
        asked.append((do, given))
        if do == "begin":
            return [[0.0] * 39, [1.0] * 39]
        i = next(steps)
        return [[float(i)] * 39] * 2, [i == 500, i == 7]

    found = parity.play_original(
        SimpleNamespace(ask=ask), "reach", np.zeros((2, 6)), lambda names, obs: obs[..., :4] / 500
    )
    assert found.tolist() == [[True, True], [False, True]] and len(asked) == 501
    assert asked[0] == ("begin", {"task": "reach", "vectors": [[0.0] * 6] * 2})
    assert asked[1] == ("step", {"actions": [[0.0] * 4, [1 / 500] * 4]})
    assert asked[-1] == ("step", {"actions": [[499 / 500] * 4] * 2})


def test_a_policy_of_other_tasks_does_not_play_meta_world(script):
    parity = script("metaworld_parity")
    with pytest.raises(SystemExit, match="finger-spin-vary-size/sac-conditioned is not of a mixture of Meta-World"):
        parity.trained("finger-spin-vary-size/sac-conditioned")


@needs("metaworld")
def test_a_policy_plays_only_what_it_was_trained_on(script, tmp_path, monkeypatch):
    parity = script("metaworld_parity")
    monkeypatch.setattr(parity, "trained", lambda run: (["reach"], None))
    given = SimpleNamespace(run="mine", tasks=["reach", "push"], out=tmp_path / "x.csv", engine="c")
    with pytest.raises(SystemExit, match="mine has not trained on push"):
        parity.compare(None, given)


@needs("metaworld")
@pytest.mark.nightly
def test_a_trained_policy_plays_meta_world_as_it_acts(script, tmp_path):
    env = mtjax.make("metaworld-window-open+metaworld-reach", num_draws=2)
    settings = {"num_envs": 1, "batch_size": 2, "replay_size": 100, "warmup_steps": 2, "chunk_steps": 5}
    agent = mtjax.agent("sac-conditioned", hidden=(8, 8))
    mtjax.train(env, agent, steps=10, eval_episodes=1, directory=tmp_path / "run", **settings)
    names, player = script("metaworld_parity").trained(str(tmp_path / "run"))
    assert names == ["window-open", "reach"]
    policy, task = mtjax.load(tmp_path / "run"), jax.tree.map(lambda x: x[1], env.tasks())
    obs = np.random.default_rng(0).normal(size=(2, 3, 39))
    np.testing.assert_allclose(player(names, obs)[1, 2], policy(np.float32(obs[1, 2]), task), atol=1e-6)
    np.testing.assert_array_equal(player(["reach"], obs[1:])[0], player(names, obs)[1])


def test_a_curve_is_thinned_to_its_last_line(script):
    """Lines in which no episode ended are left out."""
    metrics = [{"seconds": k, "steps": 10 * k, "return": "" if k < 3 else f"{k}.04"} for k in range(100)]
    found = script("families").curve("pendulum-swingup", "ppo", metrics)
    assert [x["seconds"] for x in found] == list(range(3, 100, 3))
    assert found[-1] == dict(family="pendulum-swingup", agent="ppo", seconds=99, steps=990, **{"return": "99.0"})


def test_a_full_disk_is_told_with_the_flag_of_benchmarks(script):
    """Their folders are those of --out."""

    def main():
        raise InputError("too little is free; lower --replay-size or choose another place with --runs")

    with pytest.raises(SystemExit, match=r"error: too little is free; lower --replay-size or .* place with --out$"):
        script("report").run_main(main)


@pytest.mark.slow
def test_a_family_leaves_a_policy_and_is_not_run_again(script, tmp_path, monkeypatch):
    """Its run ends with its time, and is removed."""
    families = script("families")
    monkeypatch.setattr(sys, "argv", ["families.py", "point-mass-easy", "--seconds=4", f"--out={tmp_path}"])
    families.main()
    assert sorted(x.name for x in (tmp_path / "point-mass-easy").iterdir()) == ["curve.csv", "policy"]
    assert mtjax.load(tmp_path / "point-mass-easy" / "policy").env.spec.action_size == 2
    monkeypatch.setattr(families, "learn", None)
    families.main()


@pytest.mark.slow
def test_a_signal_of_the_user_is_not_the_end_of_a_familys_time(script, tmp_path, monkeypatch):
    """The program ends; its run stays, to go on with."""
    families = script("families")
    monkeypatch.setattr(Console, "progress", lambda *_: os.kill(os.getpid(), signal.SIGINT))
    monkeypatch.setattr(sys, "argv", ["families.py", "point-mass-easy", f"--out={tmp_path}"])
    with pytest.raises(SystemExit, match="the same command with the same --out goes on"):
        families.main()
    assert [x.name for x in (tmp_path / "point-mass-easy").iterdir()] == ["run"]


@pytest.mark.slow
def test_a_signal_of_the_user_when_a_familys_time_is_over_ends_the_program(script, tmp_path, monkeypatch):
    """As it does at another time, whichever of the two comes first."""
    families = script("families")
    folder = tmp_path / "point-mass-easy"
    for method in (Console.progress, Records.save):  # before the time is known to be over, and after that

        def interrupt(self, *arguments, method=method):
            method(self, *arguments)
            os.kill(os.getpid(), signal.SIGINT)

        with monkeypatch.context() as patch:
            patch.setattr(Console if method is Console.progress else Records, method.__name__, interrupt)
            patch.setattr(sys, "argv", ["families.py", "point-mass-easy", "--seconds=0.01", f"--out={tmp_path}"])
            with pytest.raises(SystemExit, match="the same command with the same --out goes on"):
                families.main()
        assert [x.name for x in folder.iterdir()] == ["run"] and (folder / "run" / "checkpoints").is_dir()
        shutil.rmtree(folder)


def test_an_interrupted_benchmark_ends_without_a_traceback(script, capsys):
    """Where no run is to be saved."""

    def main():
        raise KeyboardInterrupt

    with pytest.raises((SystemExit, KeyboardInterrupt)) as stop:  # an interrupt let through would end pytest
        script("report").run_main(main)
    assert getattr(stop.value, "code", None) == 130 and capsys.readouterr().err == "interrupted\n"


def test_wrong_input_ends_every_benchmark_with_one_line():
    """All commands are run by what turns an error of input into a line."""
    commands = {file.name: file.read_text() for file in FOLDER.glob("*.py") if "ArgumentParser(" in file.read_text()}
    assert len(commands) > 25 and not [name for name, text in commands.items() if "    run_main(main)\n" not in text]


def test_a_policy_that_is_shown_no_parameter_has_no_return_with_these_limited(script):
    """Though it is tried on tasks beyond the range, as brc is, which knows tasks by embeddings."""
    config = mtjax.preset("walker-run-vary-friction", "brc", "gpu")
    assert len(config.family.tasks("extrapolation").id)
    given = SimpleNamespace(seed=0, seeds=1, eval_episodes=1)
    assert script("returns").limited(config.family, config.learner, None, given) is None


def test_settings_are_words_with_an_equals_sign(script):
    """What is behind it is read as JSON if it is some."""
    settings_of, found = script("report").settings_of, {"hidden": (8, 8), "tau": 0.1, "engine": "c", "arguments": "a=b"}
    assert settings_of(["hidden=[8,8]", "tau=0.1", "engine=c", "arguments=a=b"]) == found
    with pytest.raises(InputError, match="'tau' is no setting; write NAME=VALUE"):
        settings_of(["engine=c", "tau"])
    with pytest.raises(InputError, match=r"--grid takes numbers: .*'x'"):
        script("presets").grid(["tau=0.1,x"])


@pytest.mark.parametrize("unfinished, begun", [([], [["a"], ["b"]]), (["a"], [["a"]])])
def test_ways_that_need_others_begin_once_these_are_done(script, tmp_path, monkeypatch, unfinished, begun):
    """And not at all if one has no result."""
    parts, stages = script("parts"), []
    run = lambda script, ways, *_: (stages.append([way.name for way in ways]), unfinished)[1]
    monkeypatch.setattr(parts, "run_parts", run)
    arguments = SimpleNamespace(ways=["b", "a"], out=tmp_path)
    with pytest.raises(SystemExit, match="left: a") if unfinished else contextlib.nullcontext():
        parts.run_ways("script", arguments, lambda *_: None, lambda out: "| way |", last=["b"])
    assert stages == begun and (tmp_path / "table.md").read_text() == "| way |\n"


@pytest.mark.parametrize("name", ["compare", "parts", "ppo_peer", "pqn_peer", "rejax_peer", "scaling"])
def test_benchmarks_whose_parts_hold_the_device_import_no_jax(name):
    code = f"import sys; sys.path.insert(0, {str(FOLDER)!r}); import {name}; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_brax_sac_says_what_it_lacks_before_it_measures(script, monkeypatch):
    brax_sac = script("brax_sac")
    monkeypatch.setattr(sys, "argv", ["brax_sac.py"])
    monkeypatch.setattr(brax_sac.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install playground"):
        brax_sac.main()


@pytest.mark.parametrize("seconds", [3.6, 41.0, 63.0])
def test_seconds_of_compiling_are_read_as_a_run_tells_them(script, seconds):
    told = f"compiling\ncompiled in {duration(seconds)}\n"
    assert script("side_by_side").seconds_of_compiling(told) == seconds


@pytest.mark.slow
def test_updates_are_timed_as_the_loop_makes_them(script, monkeypatch, capsys):
    flags = ["--agents", "sac", "care", "--tasks", "2", "--batch", "4", "--hidden", "8", "--repeats", "1"]
    monkeypatch.setattr(sys, "argv", ["update_cost.py", *flags])
    script("update_cost").main()
    assert [line.split(" | ")[0] for line in capsys.readouterr().out.splitlines()[2:4]] == ["| sac", "| care"]


def test_pqn_is_beside_its_authors(script, tmp_path):
    """A line for each game and side, with the mean and the range of seeds; numbers of their settings are numbers."""
    pqn_peer, parts = script("pqn_peer"), script("parts")
    assert "| game | side |" in pqn_peer.tabulate(tmp_path)
    of = {"game": "Breakout", "steps": 10_000, "seconds": 9.6, "compile_seconds": 2}
    for side, scores in ("mtjax", [4.0, 4.5, 5.0]), ("purejaxql", [2.0, 2.5, 3.0]):
        parts.write_result(tmp_path / f"Breakout-{side}.json", of | {"side": side, "scores": scores})
    lines = pqn_peer.tabulate(tmp_path).splitlines()
    assert lines[2] == "| Breakout | mtjax | 3 | 10,000 | 4.5 [4.0, 5.0] | 4.0 to 5.0 | 10 | 2 |"
    assert "| 2.5 [2.0, 3.0] | 2.0 to 3.0 |" in lines[3]
    file = tmp_path / "pqn.yaml"
    file.write_text("TOTAL_TIMESTEPS: 1e7\nLR: 0.0005\nNUM_ENVS: 128\nNORM_TYPE: layer_norm\n")
    assert pqn_peer.authors_settings(file) == {
        "TOTAL_TIMESTEPS": 1e7, "LR": 0.0005, "NUM_ENVS": 128, "NORM_TYPE": "layer_norm"
    }  # fmt: skip


# Scales and halving.


def test_scores_of_scales_are_beside_their_controls(script, tmp_path):
    """A line for each agent and scale: the last and the mean return, and the same less those of the control's seeds."""
    random = np.random.default_rng(0)
    alone = random.uniform(size=(4, 5, 3))  # (S, V, T)
    found = {"agent": "impala", "scales": [0.01, 1.0, 100.0], "wall_seconds": 7}
    for name, returns in (("impala", alone + np.array([3, 0, -2])), ("impala-control", alone)):
        (tmp_path / f"{name}.json").write_text(json.dumps({**found, "returns": returns.tolist()}))
    cells = [line.split(" | ") for line in script("scales").table(tmp_path).splitlines()[2:]]
    assert [line[1] for line in cells] == ["0.01", "1", "100"]
    assert [line[3] for line in cells] == [line[5] for line in cells]
    assert [line[5].split()[0] for line in cells] == ["+3.0", "+0.0", "-2.0"]
    assert cells[1][2].split()[0] == f"{alone[:, -1, 1].mean():.1f}"
    assert cells[1][4].split()[0] == f"{alone[:, :, 1].mean():.1f}"


def test_ways_of_hindsight_are_compared_in_pairs_of_seeds(script, tmp_path):
    """Areas less those of the same seeds without hindsight, and with uniform choice; nothing beside other seeds."""
    none = np.random.default_rng(0).uniform(size=(4, 5))  # (S, V)
    found = {"none": none, "uniform": none[:2] + 1, "inverse": none + 3}
    for way, returns in found.items():
        (tmp_path / f"{way}.json").write_text(json.dumps({"returns": returns.tolist(), "training_seconds": 7}))
    cells = [line.strip("| ").split(" | ") for line in script("hindsight").table(tmp_path).splitlines()[2:]]
    assert [line[0] for line in cells] == ["`none`", "`uniform`", "`inverse`"]
    assert [[x.split()[0] for x in line[3:5]] for line in cells] == [["-", "-"], ["-", "-"], ["+3.0", "-"]]


def test_curricula_have_as_many_worlds_and_are_compared_in_pairs_of_seeds(script, tmp_path):
    """At the end and on average, with all tasks at once and with random ones; nothing beside other seeds."""
    curricula = script("curricula")
    arguments = SimpleNamespace(family="sailing", played=4, every=640)
    for way in curricula.WAYS:
        settings = Settings(**curricula.plays(arguments, way))
        assert settings.plays.count(curricula.TASKS) * settings.num_envs == curricula.WORLDS
    returns = np.random.default_rng(0).uniform(size=(4, 5))  # (S, V)
    rising = returns + np.arange(5)
    for way, found in {"all": returns, "random": rising, "hardest": rising[:2]}.items():
        result = {"worlds": "4 x 5", "returns": found.tolist(), "last": [[1, 2], [5, 0]], "training_seconds": 7}
        (tmp_path / f"{way}.json").write_text(json.dumps(result))
    cells = [line.strip("| ").split(" | ") for line in curricula.table(tmp_path).splitlines()[2:]]
    shown = [[x.split()[0] for x in (*line[3:5], *line[6:8])] for line in cells]
    assert shown == [["-", "-4.0", "-", "-2.0"], ["+4.0", "-", "+2.0", "-"], ["-"] * 4]
    assert [line[8] for line in cells] == ["1.0"] * 3


def test_returns_after_few_steps_have_a_line_for_each_split(script, tmp_path):
    """And a column for each number of updates, or of episodes."""
    returns = {"train": [[1, 2], [3, 4]], "extrapolation": [[5, 6], [7, 8]]}  # (S, K + 1)
    (tmp_path / "plain.json").write_text(json.dumps({"returns": returns, "training_seconds": 7}))
    lines = script("few_steps").table(tmp_path).splitlines()
    assert lines[0] == "| way | split | after 0 | after 1 | training s |"
    cells = [[x.split()[0] for x in line.strip("| ").split(" | ")] for line in lines[2:]]
    assert cells == [["`plain`", "train", "2.0", "3.0", "7"], ["`plain`", "extrapolation", "6.0", "7.0", "7"]]


def test_sentences_are_compared_with_being_told(script, tmp_path):
    """On the same tasks; shuffled ones have a line of their own."""
    scores = lambda x: {"train": [[0.0, x]], "interpolation": [[0.0, x / 2]], "extrapolation": [[0.0, x]]}  # (S, V)
    found = {"reads": {"returns": scores(0.6), "shuffled": scores(0.1)}, "told": {"returns": scores(0.8)}}
    for way, result in found.items():
        (tmp_path / f"{way}.json").write_text(json.dumps(result))
    cells = [line.strip("| ").split(" | ") for line in script("sentences").table(tmp_path).splitlines()[2:]]
    assert [line[0] for line in cells] == ["`reads`", "`told`", "`reads, shuffled`"]
    assert [line[1] for line in cells] == ["0.60, 0.75", "0.80, 1.00", "0.10, 0.12"]
    assert [line[2] for line in cells] == ["0.30, 0.75", "0.40, 1.00", "0.05, 0.12"]


def test_halving_is_compared_on_the_same_trials(script):
    """The rank of what it found among all that went to the end, one that diverged among them; or a refusal."""
    trial = lambda lr, *returns: {"values": {"lr": lr}, "returns": dict(zip("abc", returns, strict=False))}
    about = {"number": 0, "wall_seconds": 2}
    whole = {**about, "steps_taken": 400, "trials": [trial(1, 3.0), trial(2, 9.0), trial(3, 8.0), trial(4)]}
    halved = {**about, "steps_taken": 100, "best": 2, "trials": [trial(1, 1.0), trial(2, 2.0), trial(3, 4.0, 8.0)]}
    with pytest.raises(InputError, match="other trials"):
        script("halving").compared(whole, halved)
    halved["trials"].append(trial(4))
    assert script("halving").compared(whole, halved) == [9.0, 8.0, 2, 0.25, 2, 2]


@pytest.mark.nightly
def test_updates_are_timed_with_their_numbers_as_data(script, monkeypatch, capsys):
    numbers = script("traced_numbers")
    for name, small in {"TASKS": 2, "BATCH": 4, "UPDATES": 2, "ROUNDS": 1}.items():
        monkeypatch.setattr(numbers, name, small)
    monkeypatch.setattr(sys, "argv", ["traced_numbers.py", "--agents", "sac"])
    numbers.main()
    assert capsys.readouterr().out.splitlines()[2].startswith("| sac | ")
