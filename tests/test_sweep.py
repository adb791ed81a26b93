"""Sweeps: a point of one program is the run with those values, and one command lays out all of them."""

import csv
import dataclasses
import itertools
import shutil
import signal
import types

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from conftest import SHORT_RUN
from probes import QUICK, Walk, one_in, random_batch, tasks_of, tiny, train_objects

import mtjax
import mtjax.evaluate
import mtjax.train
from mtjax.agents import PARTS
from mtjax.agents import settings as settings_of
from mtjax.agents import swept as points
from mtjax.agents.fit import reset_networks
from mtjax.command import run_config, sweep
from mtjax.command.keywords import from_keywords
from mtjax.config import configure
from mtjax.learning import loop
from mtjax.learning.evaluation import Scores, load_evaluations, save_evaluations
from mtjax.learning.loop import Settings, TrainState
from mtjax.names import Notice
from mtjax.saved.config_json import from_json, to_flags, to_json
from mtjax.saved.folder import evaluations_before
from mtjax.training import entries, memory, stops
from mtjax.training.journal import Hooks
from mtjax.training.run import _Progress, _Run, adopted
from mtjax.types import InputError, Spec

SMALL = {"num_envs": 4, "batch_size": 8, "replay_size": 200, "warmup_steps": 5, "chunk_steps": 20}


# Points.


def test_points_are_every_combination_in_order():
    """The last name's values change fastest; a list of points is taken as it is."""
    found = points.grid({"actor_lr": [1e-4, 1e-3], "gamma": [0.9, 0.99]})
    assert [tuple(point.values()) for point in found] == [(1e-4, 0.9), (1e-4, 0.99), (1e-3, 0.9), (1e-3, 0.99)]
    assert points.grid([{"tau": 1}, {"tau": 0.5}]) == ({"tau": 1.0}, {"tau": 0.5})
    assert points.grid({}) == points.grid(()) == ()


def test_seeds_lie_side_by_side_in_each_point():
    """Number k is seed k % seeds of point k // seeds."""
    seeds, numbers = points.seed_axis(points.grid({"tau": [0.1, 0.2]}), jnp.arange(3) + 7)
    np.testing.assert_array_equal(seeds, [7, 8, 9, 7, 8, 9])
    np.testing.assert_array_equal(numbers["tau"], np.float32([0.1, 0.1, 0.1, 0.2, 0.2, 0.2]))
    seeds, numbers = points.seed_axis((), jnp.arange(2))
    assert len(seeds) == 2 and numbers == {}


@pytest.mark.parametrize(
    "given, said",
    [
        ({"actor_lr": [1e-3, -1.0]}, "actor-lr must be greater than 0, not -1.0"),
        ({"gamma": [0.9, 1.5]}, "gamma must be in [0, 1]"),
        ({"num_critics": [1, 2]}, "num_critics cannot vary inside one program"),
        ({"actor_l": [1e-3]}, "did you mean 'actor_lr'?"),
        ({"cagrad_radius": [0.5, 2.0]}, "cagrad-radius must be in (0, 1), not 2.0"),
        ({"tau": []}, "no values to tau"),
        ([{"tau": 0.1}, {"gamma": 0.9}], "the same names"),
    ],
)
def test_values_are_refused_by_name_before_anything_compiles(given, said):
    """By the constructors that refuse them when they are given plainly."""
    with pytest.raises(InputError) as error:
        train_objects(Walk(), tiny("cagrad"), steps=100, sweep=given)
    assert said in str(error.value)


def test_a_point_is_the_agent_with_its_values():
    """Those of parts too; whatever is not named stays."""
    agent = tiny("cagrad", tau=0.1)
    found = points.agent_at(agent, {"cagrad_radius": 0.25, "gamma": 0.5})
    assert found == tiny("cagrad", tau=0.1, cagrad_radius=0.25, gamma=0.5)
    assert agent == tiny("cagrad", tau=0.1)


def _variants():
    """Agents that have every part between them, and every class of agent."""
    kinds = {kind: [n for n in table if n not in ("popart", "input-map")] for kind, table in PARTS.items()}
    columns = [kinds[kind] for kind in ("gradients", "value", "scaling", "sampler")]
    for row in zip(*(itertools.islice(itertools.cycle(c), max(map(len, columns))) for c in columns), strict=True):
        chosen = dict(zip(("gradients", "value", "scaling", "sampler"), row, strict=True))
        yield "sac", chosen | ({"reset_every": 100} if chosen["scaling"] == "ars" else {})
    yield "sac", {"scaling": "popart", "heads": "per-task", "weight_decay": 0.1, "max_gradient_norm": 1.0}
    yield from ((name, {}) for name in ("distral", "brc", "simba-v2", "xqc", "deepmdp", "hip-bmdp"))


@pytest.mark.parametrize("name, settings", one_in(2, _variants()))
def test_every_number_can_vary(name, settings):
    """All at once, in every method: none decides what is compiled, and none is left out of what is."""
    agent = tiny(name, **settings)
    tasks, spec = tasks_of("one-step"), Spec.vector(obs_size=1, action_size=1, context_size=1)
    values = points.sweepable(agent)
    assert set(values) <= set(settings_of(agent)) and {"actor_lr", "gamma"} <= set(values)

    def everything(numbers):
        varied, key = points.with_numbers(agent, numbers), jax.random.key(0)
        state = varied.init(spec, tasks, key)
        state, _ = probes.update(varied, state, probes.with_memory(agent, random_batch(0, 2, 4)), tasks, key)
        task = jax.tree.map(lambda x: x[0], tasks)
        memory = varied.begin(state, task)
        everywhere = jax.tree.map(lambda x: jnp.broadcast_to(x, (2, 1, 3, *x.shape)), memory)
        steps = jax.tree.map(lambda x: x.reshape(2, 1, 3, *x.shape[2:]), random_batch(0, 2, 3))
        state = varied.observe(
            state, steps._replace(closed=steps.discount == 0, cut=steps.discount == 0, memory=everywhere), tasks
        )
        state = reset_networks(varied, state, spec, tasks, key)
        return varied.act(state, memory, jnp.zeros(1), task, key).action

    assert jax.eval_shape(everything, {name: jnp.float32(x) for name, x in values.items()}).shape == (1,)


def _run(env, agent, seeds, numbers=None, chunks=2):
    agent, settings = configure(agent, Settings(), SMALL)
    tasks = env.tasks()
    init = loop.init.lower(env, agent, settings, tasks, seeds, numbers).compile(QUICK)
    state = init(tasks, seeds, numbers)
    run_chunk = loop.run_chunk.lower(env, agent, settings, tasks, state).compile(QUICK)
    for _ in range(chunks):
        state, metrics = run_chunk(tasks, state)
    return state, metrics


_COMPARED = ("actor", "critic", "representation", "temperature", "scaling")
_NAMES = ("actor_lr", "critic_lr", "temperature_lr", "gamma", "tau", "initial_temperature", "target_entropy")
_NAMES = (*_NAMES, "weight_decay", "max_gradient_norm", "return_range", "lr_final", "context_limit")
_NAMES = (*_NAMES, "temperature_momentum")
POINTS = (
    dict(zip(_NAMES, (1e-3, 2e-3, 1e-3, 0.9, 0.01, 0.1, -0.5, 0.0, 0.0, 10.0, 1.0, 0.0, 0.9), strict=True)),
    dict(zip(_NAMES, (1e-2, 1e-3, 3e-3, 0.5, 0.1, 1.0, 0.5, 0.1, 0.1, 5.0, 0.2, 0.5, 0.5), strict=True)),
)


@pytest.mark.slow
def test_a_point_trains_as_the_run_with_its_values():
    """Both seeds of two points, one with clipping and decay and one without, against plain runs of the same seeds."""
    agent = tiny("sac-conditioned", scaling="return", lr_schedule="linear", lr_updates=20)
    assert set(_NAMES) == set(points.sweepable(agent))
    env, seeds = Walk(), jnp.arange(2, dtype=jnp.uint32)
    state, metrics = _run(env, agent, *points.seed_axis(POINTS, seeds))
    learned = jax.device_get(state.agent)
    plain = [_run(env, points.agent_at(agent, point), seeds) for point in POINTS]
    for p, (alone, its_metrics) in enumerate(plain):
        rows = slice(2 * p, 2 * p + 2)
        compared = lambda state: ([state.nets[name] for name in _COMPARED], state.slow)
        same = lambda x, y, rows=rows: np.testing.assert_allclose(x[rows], y, rtol=2e-3, atol=2e-4)
        jax.tree.map(same, compared(learned), compared(alone.agent))
        discounted, of_alone = (x.worlds.memory.scaling.discounted for x in (state, alone))
        np.testing.assert_allclose(discounted[rows], of_alone, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(metrics["return"][rows], its_metrics["return"], rtol=1e-4)
    first, second = (plain[p][0].agent.nets["critic"] for p in range(2))
    apart = jax.tree.map(lambda x, y: float(jnp.max(jnp.abs(x - y))), first, second)
    assert max(jax.tree.leaves(apart)) > 0.02  # the values matter by far more than the tolerance


@pytest.mark.slow
def test_one_point_that_diverges_does_not_end_the_others():
    """Its returns are none; those of the others, whose numbers are apart, are there. Rows say which point they are."""
    settings = SMALL | {"chunk_steps": 15}
    result = train_objects(
        Walk(), tiny("sac"), steps=240, seeds=2, eval_episodes=2, **settings, sweep={"actor_lr": [1e-3, 1e38]}
    )
    assert result.finished and result.points == ({"actor_lr": 1e-3}, {"actor_lr": 1e38})
    assert [(row["seed"], row["actor_lr"]) for row in result.rows[:4]] == [(0, 1e-3), (1, 1e-3), (0, 1e38), (1, 1e38)]
    returns = result.evaluations.returns["train"]
    assert returns.shape[0] == 4
    assert np.isfinite(returns[:2]).all() and np.isnan(returns[2:, -1]).all()


def of_three_points(**plan):
    """A configuration whose sweep has one seed of each of three points."""
    sweep = {"tau": [0.1, 0.2, 0.3]}
    return from_keywords(Walk(), tiny("sac"), SMALL, plan=plan, sweep=sweep)


def test_a_seed_that_diverged_stays_given_up(capsys):
    """It is told once, also if later numbers are finite; the run ends when every seed has diverged at some time."""
    run = _Run(of_three_points())
    now = _Progress(None, 0, 0.0, 0.0, None, np.zeros(3, bool))
    seen = lambda bad: {"bad_step": bad, "bad_reward": bad, "lost": 0 * bad}
    chunk = lambda bad: lambda state: (state, seen(np.array(bad)[:, None]))
    for bad in ([-1, 4, -1], [-1, -1, -1], [-1, 4, -1]):
        now, _ = run._play(chunk(bad), now, 0)
        assert now.diverged.tolist() == [False, True, False]
    assert capsys.readouterr().out.splitlines() == ["seed 0 of tau=0.2 diverged and is given up"]
    with pytest.raises(FloatingPointError, match="number 0 of the run's seeds"):
        run._play(chunk([4, -1, 4]), now, 0)


def test_the_evaluation_that_is_told_is_of_the_seeds_that_go_on(capsys):
    """If none does, nothing is told."""
    run = _Run(of_three_points(eval_episodes=1))
    scores = lambda agent, number: Scores(np.full((3, len(Walk().tasks("all").id), 1), 7.0), {})
    now = _Progress(
        TrainState(*[None] * len(TrainState._fields)),
        20,
        0.0,
        0.0,
        evaluations_before(run.config),
        np.zeros(3, bool),
    )
    for diverged in ([False, True, False], [True, True, True]):
        found = run._evaluate(scores, now._replace(diverged=np.array(diverged)))
        np.testing.assert_array_equal(np.isnan(found.returns["train"][:, 0, 0, 0]), diverged)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("evaluation at 20 steps: train 7 (worst task 7)")


# The command line.


@pytest.mark.parametrize(
    "words, found, rest",
    [
        (["--sweep", "agent.tau=0.1,1", "--seeds=2"], [("agent.tau", ("0.1", "1"))], ["--seeds=2"]),
        (["--sweep=num_envs=2,4"], [("num-envs", ("2", "4"))], []),
        (
            ["--seeds", "2", "--sweep", "agent.hidden=8 8,16", "agent=sac,care", "--env=x"],
            [("agent.hidden", ("8 8", "16")), ("agent", ("sac", "care"))],
            ["--seeds", "2", "--env=x"],
        ),
    ],
)
def test_sweeps_are_read_out_of_a_command_line(words, found, rest):
    """Until the next flag."""
    axes, others = sweep.read_axes(words)
    assert [tuple(axis) for axis in axes] == found and others == rest


@pytest.mark.parametrize(
    "words, said",
    [
        (["--sweep"], "--sweep needs flags and values"),
        (["--sweep", "agent.tau"], "--sweep needs values, not 'agent.tau'"),
        (["--sweep", "agent.tau=0.1,"], "--sweep needs values"),
        (["--sweep", "agent.tau=0.1,0.1"], "a value of agent.tau twice"),
        (["--sweep", "agent.actor-lr=1e-3,0.001"], "a value of agent.actor-lr twice"),
        (["--sweep", "agent.tau=0.1", "agent.tau=0.2"], "gives agent.tau twice"),
        (["--sweep", "seed=0,1"], "cannot vary seed"),
        (["--sweep", "agent.tau=0.1,big"], "agent.tau is a number, and 'big' is none"),
        (["--sweep", "agent.tau=0.1,2"], "tau must be in (0, 1]"),
        (["--sweep", "agent.num-critics=1,0"], "num-critics must be greater than 0, not 0"),
        (["--sweep", "agent.cagrad-radius=0.1,0.2"], "unknown number of this agent 'cagrad_radius'"),
        (["--sweep", "agent.nonsense=1,2"], "unknown flag"),
        (["--agent.discounting=horizon", "--sweep", "agent.gamma=0.9,0.99"], "gamma changes nothing; leave it out"),
        (["--sweep", "agent.encoder=film,flim"], "did you mean 'film'?"),
        (["--sweep", "agent.tau=0.1", "--resume=x"], "leave out --sweep"),
    ],
)
def test_wrong_sweeps_are_refused(words, said, monkeypatch, tmp_path):
    """Before any folder is made."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        mtjax.train.main(words)
    assert said in str(error.value)
    assert not list(tmp_path.iterdir())


def test_numbers_vary_inside_a_program_and_the_rest_between_programs():
    """Switches, names of parts and widths too; a part's own setting may come with the part."""
    axes = ["agent.gradients=mean,cagrad", "agent.tau=0.1,1", "agent.critic-layer-norm=true,false", "agent.gamma=0.5"]
    found = sweep.configurations(["--agent=sac", "--sweep", *axes, "--agent.hidden", "8"])
    told = [(type(p.learner.gradients).__name__, p.learner.critic_layer_norm) for p in found]
    assert told == [("Mean", True), ("Mean", False), ("CAGrad", True), ("CAGrad", False)]
    for program in found:
        assert program.points == ({"tau": 0.1, "gamma": 0.5}, {"tau": 1.0, "gamma": 0.5})
        assert program.learner.hidden == (8,) and program.learner.tau != 0.1
    assert found[1].sweep == (
        "agent.gradients=mean",
        "agent.critic-layer-norm=false",
        "agent.tau=0.1,1",
        "agent.gamma=0.5",
    )
    widths = sweep.configurations(["--agent=sac", "--sweep", "agent.hidden=8 8,16"])
    assert [p.learner.hidden for p in widths] == [(8, 8), (16,)] and not widths[0].points


def test_the_command_of_a_run_repeats_its_part_of_the_sweep(tmp_path):
    """And its record is read back as it was."""
    (program,) = sweep.configurations(["--sweep", "agent.tau=0.1,1", "agent.num-critics=3"])
    (again,) = sweep.configurations(to_flags(program))
    assert again == program
    (tmp_path / "config.json").write_text(to_json(program, {}))
    assert from_json(tmp_path / "config.json") == program


def test_points_that_do_not_fit_into_memory_are_run_in_rounds(monkeypatch):
    """As even as can be. $MTJAX_MEMORY is in GB."""
    (program,) = sweep.configurations(["--sweep", "agent.tau=0.1,0.2,0.3,0.4,0.5", "--seeds=2", "--replay-size=1000"])
    one, two = (memory.required_bytes(with_seeds(program, n)) for n in (1, 2))
    assert 1.9 < two / one < 2.1
    count = lambda limit: [len(part.points) for part in memory.split_to_fit(program, limit)]
    assert count(1e15) == [5] and count(2.5 * two / 0.9) == [2, 2, 1] and count(1.1 * two / 0.9) == [1] * 5
    assert sum((part.points for part in memory.split_to_fit(program, 2.5 * two)), ()) == program.points
    monkeypatch.setenv("MTJAX_MEMORY", "0.5")
    assert memory.available_bytes() == 0.5e9
    monkeypatch.setenv("MTJAX_MEMORY", "much")
    with pytest.raises(InputError, match="a number of GB, not 'much'"):
        memory.available_bytes()
    monkeypatch.delenv("MTJAX_MEMORY")
    assert memory.available_bytes() > 1e8


def test_seeds_that_do_not_fit_into_memory_are_run_in_rounds(monkeypatch):
    """Those of each point by themselves; a single seed is tried whatever it takes."""
    (program,) = sweep.configurations(["--sweep", "agent.tau=0.1,0.2", "--seeds=5", "--seed=3", "--replay-size=1000"])
    one = memory.required_bytes(program) / 5
    parts = lambda program, limit: [
        (part.points, part.plan.seed, part.plan.seeds) for part in memory.split_to_fit(program, limit)
    ]
    first, second = (({"tau": tau},) for tau in (0.1, 0.2))
    assert parts(program, 2.5 * one / 0.9) == [
        *((first, seed, count) for seed, count in ((3, 2), (5, 2), (7, 1))),
        *((second, seed, count) for seed, count in ((3, 2), (5, 2), (7, 1))),
    ]
    alone = dataclasses.replace(program, points=())
    assert parts(alone, 1.0) == [((), seed, 1) for seed in range(3, 8)]
    for limit, too_many in ((5.5 * one / 0.9, False), (4.5 * one / 0.9, True)):
        monkeypatch.setenv("MTJAX_MEMORY", f"{limit / 1e9:.12f}")
        assert memory.seeds_exceed_memory(alone) == too_many
    monkeypatch.setenv("MTJAX_MEMORY", "1e-9")
    assert not memory.seeds_exceed_memory(with_seeds(alone, 1))


def with_seeds(program, count):
    return dataclasses.replace(program, plan=dataclasses.replace(program.plan, seeds=count))


@pytest.mark.slow
def test_a_run_of_too_many_seeds_is_run_in_rounds(tmp_path, monkeypatch, capsys):
    """By the same command, with a table of all seeds, and gone on with by its folder."""
    small = "--num-envs=2 --batch-size=2 --replay-size=20 --warmup-steps=1 --eval-episodes=1 --agent.hidden 4".split()
    env = ["--env=bandit", "--env.scores"]
    words = [*env, "--agent=sac-conditioned", "--seeds=3", "--steps=40", f"--runs={tmp_path}", *small]
    program = run_config.parse(words)
    monkeypatch.setenv("MTJAX_MEMORY", f"{2.5 * memory.required_bytes(program) / 3 / 0.9 / 1e9:.12f}")
    mtjax.train.main(words)
    (folder,) = tmp_path.iterdir()
    assert "2 rounds" in capsys.readouterr().out and "-rounds-" in folder.name
    runs = sweep._run_folders(folder)
    assert [from_json(run / "config.json").plan.seeds for run in runs] == [2, 1]
    (row,) = sweep.rows(runs)
    returns = [load_evaluations(run / "evaluations.npz").returns["train"][:, -1] for run in runs]
    assert row["run"] == "run-1 run-2" and row["seeds"] == 3 and row["diverged"] == 0
    assert float(row["train"]) == pytest.approx(np.concatenate(returns).mean(), rel=1e-5)
    mtjax.train.main([f"--resume={folder}"])
    assert "compiled" not in capsys.readouterr().out


@pytest.fixture(scope="module")
def swept(short_family, tmp_path_factory):
    """A sweep of two rounds, stopped before its second and gone on with: its folder, and what was said of the rest."""
    root = tmp_path_factory.mktemp("sweep")
    words = [
        *SHORT_RUN,
        f"--runs={root}",
        "--steps=200",
        "--sweep",
        "agent.actor-lr=1e-3,1e-4,1e38",
        "agent.num-critics=1",
    ]
    (program,) = sweep.configurations(words)
    real = sweep.launch

    def stop(program, hooks):
        if hooks.directory.name == "run-2":
            (hooks.directory / "checkpoints").mkdir()  # as a run that is killed before its first checkpoint leaves it
            raise KeyboardInterrupt
        return real(program, hooks)

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MTJAX_MEMORY", f"{2.5 * memory.required_bytes(program) / 0.9 / 1e9:.12f}")
        patch.setattr(sweep, "launch", stop)
        with pytest.raises(KeyboardInterrupt):
            mtjax.train.main(words)
    (folder,) = root.iterdir()
    (folder / "sweep.csv").rename(folder / "stopped.csv")
    mtjax.train.main([f"--resume={folder}"])
    return folder


@pytest.mark.slow
def test_a_sweep_leaves_a_table_of_all_settings(swept):
    """A row for each, of all its runs, with its values and its last evaluation."""
    with (swept / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["run"], r["number"], r["actor-lr"], r["num-critics"]) for r in rows] == [
        ("run-1", "0", "0.001", "1"),
        ("run-1", "1", "0.0001", "1"),
        ("run-2", "0", "1e+38", "1"),
    ]
    assert [r["diverged"] for r in rows] == ["0", "0", "2"]
    with np.load(swept / "run-1" / "evaluations.npz") as file:
        returns = file["train"][:, -1]
    for p, row in enumerate(rows[:2]):
        assert float(row["train"]) == pytest.approx(returns[2 * p : 2 * p + 2].mean(), rel=1e-5)
        assert row["train_low"] == row["train_high"] == ""  # of two seeds
    assert rows[2]["train"] == "" and (swept / "run-2" / "diverged.txt").exists()
    assert (swept / "run-1" / "curve.png").exists()
    header = (swept / "run-1" / "metrics.csv").read_text().splitlines()[0]
    assert header.startswith("seed,actor_lr,iteration,")
    text = sweep.table(sweep.rows(sweep._run_folders(swept)))
    assert "2 of 2 seeds diverged" in text and "highest on training tasks" in text and len(text.splitlines()) == 5


ALL_FOUR = [
    ("bandit", "sac", "10"),
    ("bandit", "care", "20"),
    ("walker-walk", "sac", "900"),
    ("walker-walk", "care", "1"),
]


def test_environments_are_no_contest():
    """Each has a highest setting of its own, if it has several."""
    row = {"run": "run-1", "number": 0, "seeds": 1, "diverged": 0, "train_low": "", "train_high": ""}
    made = [row | {"env": env, "agent": agent, "train": x} for env, agent, x in ALL_FOUR]
    names = ("run", "number", "env", "agent", "seeds", "diverged", "train", "train_low", "train_high")
    lines = sweep.table([{name: each[name] for name in names} for each in made]).splitlines()
    assert [line.split(" (")[0] for line in lines[-2:]] == [
        "highest on training tasks of bandit: agent care",
        "highest on training tasks of walker-walk: agent sac",
    ]
    (line,) = sweep.table([{name: made[0][name] for name in names}]).splitlines()[1:]
    assert line.split() == ["run-1", "bandit", "sac", "10"]


@pytest.mark.slow
def test_the_table_is_there_when_a_sweep_is_stopped(swept):
    """With what was evaluated until then."""
    with (swept / "stopped.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(r["steps"], r["train"] != "") for r in rows] == [("200", True), ("200", True), ("0", False)]


@pytest.mark.slow
def test_the_table_grows_with_every_evaluation(swept, tmp_path, monkeypatch):
    """Also of a run that is not finished."""
    run = shutil.copytree(swept / "run-1", tmp_path / "run-1")
    past = load_evaluations(run / "evaluations.npz")
    config = from_json(run / "config.json")
    longer = dataclasses.replace(config, plan=dataclasses.replace(config.plan, steps=10_000))
    (run / "config.json").write_text(to_json(longer, {"command": ""}))
    assert sweep.final_evaluations(longer, run) is None
    sweep._write_table(tmp_path, [run])
    with (tmp_path / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [r["steps"] for r in rows] == ["200", "200"]
    assert float(rows[0]["train"]) == pytest.approx(past.returns["train"][:2, -1].mean(), rel=1e-5)
    assert {path.name for path in tmp_path.iterdir()} == {"run-1", "sweep.csv"}


def test_a_sweeps_folder_is_named_after_all_it_holds():
    """Or after their number, if they are many."""
    two = sweep.configurations(["--sweep", "agent=sac,care", "--env=finger-spin"])
    assert sweep._folder_name(two, "sweep") == "finger-spin-sac+care-sweep"
    many = [dataclasses.replace(two[0], agent=f"{name}-of-a-long-name") for name in "abcdefgh"]
    assert sweep._folder_name(many, "sweep") == "finger-spin-8-agents-sweep"


@pytest.mark.slow
def test_a_finished_sweep_has_nothing_left_to_do(swept, capsys):
    """Going on with it lays out its table again."""
    mtjax.train.main([f"--resume={swept}"])
    said = capsys.readouterr().out
    assert "compiled" not in said and "actor-lr" in said


@pytest.mark.slow
def test_a_signal_in_a_runs_last_chunk_stops_the_sweep_before_the_next(swept, tmp_path, monkeypatch, capsys):
    """But not after the last run, when all is done."""
    folder = shutil.copytree(swept, tmp_path / "sweep")
    for file in ("run-1/evaluations.npz", "run-2/diverged.txt"):
        (folder / file).unlink()
    done = []

    def finish(config, hooks):
        run = hooks.directory
        done.append(run.name)
        count, made = config.plan.seeds * max(len(config.points), 1), load_evaluations(swept / "run-1/evaluations.npz")
        first = lambda scores: {name: x[:count] for name, x in scores.items()}
        metrics = {name: first(splits) for name, splits in made.metrics.items()}
        made = made._replace(returns=first(made.returns), metrics=metrics, seeds=made.seeds[:count])
        save_evaluations(run / "evaluations.npz", made)
        return types.SimpleNamespace(finished=True, signal=signal.SIGINT)

    monkeypatch.setattr(sweep, "launch", finish)
    with pytest.raises(SystemExit) as stop:
        sweep.run_unfinished(folder)
    assert stop.value.code == 130 and done == ["run-1"] and (folder / "run-1" / "curve.png").exists()
    assert f"--resume={folder}" in capsys.readouterr().out
    sweep.run_unfinished(folder)
    assert done == ["run-1", "run-2"]


@pytest.mark.slow
def test_damaged_evaluations_do_not_stop_a_sweep(swept, tmp_path, capsys):
    """Those of a finished run are made again from its last state, and the file is kept."""
    folder = shutil.copytree(swept, tmp_path / "sweep")
    (folder / "run-1" / "evaluations.npz").write_bytes(b"half")
    with pytest.warns(Notice, match=r"run-1/evaluations\.npz', which is damaged: .* kept as 'evaluations.damaged.npz'"):
        mtjax.train.main([f"--resume={folder}"])
    assert (folder / "run-1" / "evaluations.damaged.npz").read_bytes() == b"half"
    assert (folder / "sweep.csv").read_bytes() == (swept / "sweep.csv").read_bytes()
    capsys.readouterr()
    mtjax.train.main([f"--resume={folder}"])
    assert "compiled" not in capsys.readouterr().out


def test_a_seed_that_the_last_update_spoiled_is_given_up(capsys):
    """Its losses were still finite. It scores nothing, and the others go on; without any other, nothing is saved."""
    watch = _Run(of_three_points()).watch

    def given_up(actor, *before):
        return watch.before_saving({"actor": jnp.asarray(actor)[:, None]}, 120, np.array(before)).tolist()

    assert given_up([0.0, np.nan, 1.0], False, False, True) == [False, True, True]
    assert capsys.readouterr().out.splitlines() == ["seed 0 of tau=0.2 diverged and is given up"]
    with pytest.raises(FloatingPointError, match=r"parameters stopped being finite in the update before step"):
        given_up([np.inf, np.nan, 1.0], False, False, True)


@pytest.mark.slow
def test_a_spoiled_seed_is_not_evaluated(monkeypatch):
    """As it would do nothing, which has a return too."""
    real = stops.finite_seeds
    monkeypatch.setattr(entries, "finite_seeds", lambda state: real(state) & [True, False])
    given = {"steps": 240, "eval_every": 240, "eval_episodes": 2, "sweep": {"actor_lr": [1e-3, 1e-4]}, **SMALL}
    returns = train_objects(Walk(), tiny("sac"), **given).evaluations.returns["train"]
    assert np.isfinite(returns[0]).all() and np.isnan(returns[1]).all()


@pytest.mark.slow
def test_evaluations_of_diverged_points_stay_none(tmp_path):
    """Also where they are lost, and made again from the last state."""
    given = {"steps": 240, "eval_every": 240, "eval_episodes": 2, "sweep": {"actor_lr": [1e-3, 1e38]}, **SMALL}
    train_objects(Walk(), tiny("sac"), **given, directory=tmp_path)
    before = (tmp_path / "evaluations.npz").read_bytes()
    returns = load_evaluations(tmp_path / "evaluations.npz").returns["train"]
    assert np.isfinite(returns[0]).all() and np.isnan(returns[1]).all()
    (tmp_path / "evaluations.npz").write_bytes(before[:100])
    with pytest.warns(Notice, match="which is damaged"):
        train_objects(Walk(), tiny("sac"), **given, directory=tmp_path, resume=True)
    assert (tmp_path / "evaluations.npz").read_bytes() == before


@pytest.mark.slow
def test_policies_are_those_of_a_point(swept):
    """The agent has its values, and the states are of its seeds."""
    first, third = mtjax.load(swept / "run-1", seed=1), mtjax.load(swept / "run-1", seed=2)
    assert first.agent.actor_lr == 1e-3 and third.agent.actor_lr == 1e-4 and third.agent.num_critics == 1
    assert len(first.states.nets["temperature"].own["log"]) == 2 and list(third.seeds) == [0, 1]
    leaf = lambda tree: np.asarray(jax.tree.leaves(tree.nets["actor"])[0])
    np.testing.assert_array_equal(leaf(first.state), leaf(first.states)[1])
    assert np.any(leaf(first.states) != leaf(third.states))
    action = third(jnp.zeros(third.env.spec.obs_size), jax.tree.map(lambda x: x[0], third.env.tasks("train")))
    assert np.isfinite(action).all()
    with pytest.raises(InputError, match="seed must be from 0 to 3"):
        mtjax.load(swept / "run-1", seed=4)


@pytest.mark.slow
def test_a_run_of_several_points_is_not_fine_tuned_by_name(swept):
    """Which of them would be a guess."""
    with pytest.raises(InputError, match="holds 2 of a sweep"):
        run_config.parse([f"--from={swept / 'run-1'}", "--env=finger-short"])


@pytest.mark.slow
def test_fine_tuning_begins_every_point_with_the_same_seeds(swept):
    """Three seeds of each of two points, from a run of two seeds: 0, 1, 0 and again 0, 1, 0."""
    start = mtjax.load(swept / "run-1", seed=0)
    tasks, sweep = start.env.tasks("train"), {"tau": [0.1, 0.2]}
    config = from_keywords(start.env, start.agent, SMALL, plan={"seeds": 3}, start=start, sweep=sweep)
    run = _Run(config, Hooks(start=start, quiet=True))
    seeds, numbers = run.entries.axis
    shapes = jax.eval_shape(lambda: loop.init(start.env, config.trained, config.training, tasks, seeds, numbers)).agent
    fresh = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)._replace(numbers=numbers)
    state = adopted(config, run.hooks, config.trained, fresh)
    np.testing.assert_array_equal(state.numbers["tau"], np.float32([0.1] * 3 + [0.2] * 3))
    began = np.asarray(start.states.nets["temperature"].own["log"])
    taken = state.nets["temperature"].own["log"]
    np.testing.assert_array_equal(taken, began[[0, 1, 0, 0, 1, 0]])
    assert np.any(began[0] != began[1])
    assert jax.tree.structure(state) == jax.tree.structure(fresh)


@pytest.mark.slow
def test_evaluation_is_of_one_point(swept, tmp_path, capsys):
    """By its number."""
    run = shutil.copytree(swept / "run-1", tmp_path / "run")
    with pytest.raises(InputError, match="point must be from 0 to 1, not 2"):
        mtjax.evaluate.main([f"--run={run}", "--point=2"])
    mtjax.evaluate.main([f"--run={run}", "--point=1", "--episodes=1"])
    assert "train" in capsys.readouterr().out and (run / "evaluation-1" / "returns.csv").exists()
