"""Populations: who copies whom, what a copy takes over, and that a resumed run repeats the choices to the bit."""

import csv
import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, tiny

import mtjax
from mtjax.agents import swept
from mtjax.command import sweep
from mtjax.command.keywords import from_keywords
from mtjax.compiling.programs import Programs
from mtjax.config import configure
from mtjax.learning import loop, populations
from mtjax.learning.evaluation import as_one_seed, no_evaluations
from mtjax.learning.loop import Settings
from mtjax.names import Notice
from mtjax.report import read_runs
from mtjax.saved.config_json import from_json
from mtjax.saved.folder import evaluations_before
from mtjax.training import selection
from mtjax.training.run import _Progress, _Run
from mtjax.types import InputError

KEY = jax.random.key(0)
SMALL = {"num_envs": 2, "batch_size": 4, "replay_size": 40, "warmup_steps": 2, "chunk_steps": 4}


# The rules.


def climb(rounds, population):
    """The toy of Jaderberg et al. (2017, figure 2): what each member reaches of Q = 1.2 - x^2 - y^2, at best 1.2.

    A member ascends 1.2 - h0 x^2 - h1 y^2 instead. No single h of the ten at the start sees both x and y.
    """
    numbers = {"h0": np.resize([1.0, 1e-3], 10), "h1": np.resize([1e-3, 1.0], 10)}
    place = np.full((10, 2), 0.9)
    fitness = lambda: 1.2 - np.sum(place**2, axis=1)
    for i in range(rounds):
        for _ in range(4):
            place = place - 0.02 * 2 * np.stack([numbers["h0"], numbers["h1"]], axis=1) * place
        if population:
            choose, perturb = jax.random.split(jax.random.fold_in(KEY, i))
            sources = populations.exploit(fitness(), choose)
            place, numbers = place[sources], {name: x[sources] for name, x in numbers.items()}
            copies = sources != np.arange(10)
            numbers = populations.explore(numbers, copies, frozenset(), perturb)
    return fitness()


def test_a_population_climbs_where_no_fixed_numbers_do():
    """It reaches 1.2, and the grid of the same numbers stays near 0.4, to which it comes by one coordinate alone."""
    assert climb(100, population=True).max() > 1.19
    np.testing.assert_allclose(climb(100, population=False), 0.4, atol=0.05)


def test_the_worst_fifth_copies_the_best_fifth():
    """At least one does; which of the best is drawn at random."""
    fitness = np.array([3.0, 0, 1, 9, 4, 5, 8, 6, 2, 7])
    drawn = {tuple(populations.exploit(fitness, jax.random.fold_in(KEY, i))) for i in range(20)}
    stay = lambda found: tuple(found[k] for k in (0, 3, 4, 5, 6, 7, 8, 9))
    assert {stay(found) for found in drawn} == {(0, 3, 4, 5, 6, 7, 8, 9)}
    assert {(found[1], found[2]) for found in drawn} == {(3, 3), (3, 6), (6, 3), (6, 6)}
    assert populations.exploit(np.array([2.0, 1.0]), KEY).tolist() == [0, 0]
    assert populations.exploit(np.array([1.0, 2.0, 3.0]), KEY).tolist() == [2, 1, 2]


def test_the_lost_neither_copy_nor_are_copied():
    """Whoever diverged keeps its place, also where nobody is left."""
    assert populations.exploit(np.array([np.nan, 1, 2, 3, np.nan]), KEY).tolist() == [0, 3, 2, 3, 4]
    assert populations.exploit(np.array([np.nan, 1]), KEY).tolist() == [0, 1]
    nothing = np.full(3, np.nan)
    assert populations.exploit(nothing, KEY).tolist() == [0, 1, 2]
    assert populations.halve(nothing, np.arange(3)).tolist() == [0, 1, 2]


@pytest.mark.parametrize("members, counts", [(8, [8, 4, 2, 1, 1]), (5, [5, 2, 1, 1]), (64, [64, 32, 16, 8, 4, 2, 1])])
def test_halving_keeps_the_better_half(members, counts):
    """Of the first members, as many as are left have evenly many places; the best one stays to the end."""
    quality = np.random.default_rng(0).permutation(members)
    origins, found = np.arange(members), [members]
    while len(found) < len(counts):
        origins = origins[populations.halve(quality[origins].astype(float), origins)]
        places = np.unique(origins, return_counts=True)[1]
        found.append(len(places))
        assert places.max() - places.min() <= -(-members // len(places))
        assert set(quality[origins]) == set(range(members - len(places), members))
    assert found == counts


def test_halving_counts_the_copies_of_a_member_together():
    """By their mean; the place of a worse one takes the best of the copies. A lost one keeps its place."""
    origins, fitness = np.array([0, 1, 1, 0, 2]), np.array([9.0, 5.0, 7.0, 1.0, np.nan])
    assert populations.halve(fitness, origins).tolist() == [2, 1, 2, 2, 4]


def test_copies_have_perturbed_numbers():
    """By 0.8 or 1.2 each by itself. Of a discount near 1 it is what lacks to 1, so that it stays one."""
    numbers = {name: np.full(400, x, np.float32) for name, x in (("lr", 0.9), ("gamma", 0.99), ("tau", 0.1))}
    copies = np.arange(400) % 2 == 1
    found = populations.explore(numbers, copies, frozenset({"gamma", "tau"}), KEY)
    values = {name: np.unique(x[copies]) for name, x in found.items()}
    np.testing.assert_allclose(values["lr"], [0.72, 1.08], rtol=1e-6)
    np.testing.assert_allclose(values["gamma"], [0.988, 0.992], rtol=1e-6)
    np.testing.assert_allclose(values["tau"], [0.08, 0.12], rtol=1e-6)
    for name, x in found.items():
        np.testing.assert_array_equal(x[~copies], numbers[name][~copies])
        assert x.dtype == np.float32
    together = np.unique(np.stack([found["lr"], found["tau"]])[:, copies], axis=1)
    assert together.shape == (2, 4)


def test_an_agent_tells_which_numbers_end_at_one():
    """By what its constructor refuses."""
    assert swept.shares(tiny("sac"), ["gamma", "tau", "actor_lr", "weight_decay"]) == {"gamma", "tau"}


@pytest.mark.parametrize("text", ["pbt", "pbt:", "pbt:0", "pbt:-5", "halving:x", "evolution:5", "pbt:1:2"])
def test_other_rules_are_refused(text):
    """By a message with both."""
    with pytest.raises(InputError, match="pbt:STEPS or halving:STEPS"):
        populations.read(text)
    assert populations.read("") is None


# Runs.


def of_population(rule, agent=None, sweep=(), **plan):
    plan = {"steps": 400, "population": rule, **plan}
    return from_keywords(Walk(), agent or tiny("sac"), SMALL, plan=plan, sweep=sweep)


@pytest.mark.parametrize(
    "given, said",
    [
        ({"rule": "pbt:100", "seeds": 3}, "perturbs numbers of the agent that are swept, and none is"),
        ({"rule": "pbt:100", "sweep": {"tau": [0.1]}}, "needs several members"),
        ({"rule": "halving:100", "seeds": 1}, "needs several members"),
        ({"rule": "halving:400", "seeds": 2}, "changes nothing in a run of 400 steps"),
        ({"rule": "halving:100", "seeds": 2, "eval_every": 30}, "give a multiple of --eval-every=30"),
        ({"rule": "halving:10", "seeds": 2}, "chooses between chunks, of 16 steps"),
    ],
)
def test_populations_that_cannot_choose_are_refused(given, said):
    """Nothing is swept, or there is one member, or no time at which to choose."""
    with pytest.raises(InputError, match=said):
        of_population(**given)


def test_an_evaluation_comes_with_every_choice():
    """If nobody says how often."""
    assert of_population("halving:100", seeds=2).plan.interval == 100
    assert of_population("halving:100", seeds=2, eval_every=50).plan.interval == 50


@pytest.fixture(scope="module")
def chosen():
    """A population of four after a chunk; and a state after each of two choices, the second by the same program."""
    config = of_population("pbt:100", sweep={"actor_lr": [1e-3, 1e-2], "gamma": [0.5, 0.9]})
    agent, settings = configure(config.learner, Settings(), SMALL)
    seeds, numbers = swept.seed_axis(config.points, np.asarray(config.plan.all_seeds, np.int32))
    tasks = config.family.tasks("train")
    state = loop.init(config.family, agent, settings, tasks, seeds, numbers)
    state = selection.begin(config, loop.run_chunk(config.family, agent, settings, tasks, state)[0])
    returns = np.array([2.0, 4.0, 1.0, 3.0])[:, None, None] * np.ones((1, 2, 1))
    first = selection.select(config, state, returns)
    second = selection.select(config, first.state, -returns)
    return state, first, second


@pytest.mark.slow
def test_a_copy_is_its_source_to_the_bit(chosen):
    """Networks, targets and optimisers; worlds, replay and keys stay, and so does all of the other members."""
    state, first, _ = chosen
    assert first.sources.tolist() == [0, 1, 1, 3]
    old, new = state.agent._replace(numbers={}), first.state.agent._replace(numbers={})
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(np.asarray(x)[first.sources], y), old, new)
    apart = [float(jnp.abs(x[1] - x[2]).max()) for x in jax.tree.leaves(old.nets["actor"])]
    assert max(apart) > 0
    for name in set(state._fields) - {"agent", "origins"}:
        assert getattr(first.state, name) is getattr(state, name)
    assert first.state.origins.tolist() == [0, 1, 1, 3]


@pytest.mark.slow
def test_a_copy_has_numbers_of_its_own(chosen):
    """Near those of its source."""
    state, first, _ = chosen
    before, after = selection.numbers_of(state), selection.numbers_of(first.state)
    for name, factors in (("actor_lr", (0.8, 1.2)), ("gamma", ((1 - 0.1 * 0.8) / 0.9, (1 - 0.1 * 1.2) / 0.9))):
        np.testing.assert_array_equal(np.delete(after[name], 2), np.delete(before[name], 2))
        assert np.isclose(after[name][2] / before[name][1], factors).any()


@pytest.mark.slow
def test_choices_compile_one_program(chosen):
    """Whoever is copied."""
    assert chosen[2].sources.tolist() != chosen[1].sources.tolist()
    assert selection._gather(None)._cache_size() == 1


def test_values_that_an_agent_refuses_are_not_taken(monkeypatch):
    """The copy keeps its source's."""
    monkeypatch.setattr(swept, "allows", lambda agent, point: point["tau"] < 0.5)
    numbers = {"tau": np.full(50, 0.45, np.float32)}
    found = selection._explored(tiny("sac"), numbers, np.ones(50, bool), KEY)
    np.testing.assert_allclose(np.unique(found["tau"]), [0.36, 0.45], rtol=1e-6)


def test_a_member_that_diverged_is_given_up(capsys):
    """The others go on, though nothing is swept."""
    run = _Run(of_population("halving:100", seeds=3))
    now = _Progress(None, 0, 0.0, 0.0, None, np.zeros(3, bool))
    chunk = lambda state: (state, dict.fromkeys(("bad_step", "bad_reward"), np.array([[-1], [4], [-1]])))
    assert run._play(chunk, now, 0)[0].diverged.tolist() == [False, True, False]
    assert capsys.readouterr().out.splitlines() == ["number 1 diverged and is given up"]


def test_who_was_given_up_stays_so_in_a_resumed_run():
    """As its last returns say."""
    run, programs = _Run(of_population("halving:100", seeds=3, eval_episodes=1)), Programs(None, None, {})
    returns = {split: np.zeros((3, 1, *x.shape[2:])) for split, x in evaluations_before(run.config).returns.items()}
    returns["train"][1] = np.nan
    past = evaluations_before(run.config)._replace(steps=np.array([96]), returns=returns)
    records = types.SimpleNamespace(
        earlier_evaluations=lambda *_: past, earlier_seconds=lambda *_: (0.0, 0.0), keep_history=lambda steps: None
    )
    run.journal.__dict__["records"] = records
    state = loop.TrainState(*[None] * 5, np.int32(0), None)
    assert run._begin(programs, state, 96).diverged.tolist() == [False, True, False]


def test_a_population_is_not_run_in_rounds(monkeypatch, tmp_path):
    """It is refused where it does not fit into memory, and no folder is made."""
    config = dataclasses.replace(of_population("halving:100", seeds=3), runs=str(tmp_path))
    monkeypatch.setenv("MTJAX_MEMORY", "1e-9")
    with pytest.raises(InputError, match="a population is one program"):
        sweep.run_all([config], "rounds")
    assert not list(tmp_path.iterdir())


RUN = {
    "steps": 240,
    "seeds": 2,
    "eval_episodes": 1,
    "population": "pbt:40",
    "quiet": True,
    "hidden": (4,),
    "scores": True,
}
RUN |= {"num_envs": 1, "batch_size": 2, "replay_size": 20, "warmup_steps": 1, "chunk_steps": 2}
SWEEP = {"actor_lr": [1e-3, 1e-2], "gamma": [0.5, 0.99]}


def play(directory, **given):
    return mtjax.train("bandit", "sac-conditioned", directory=directory, sweep=SWEEP, **RUN, **given)


@pytest.fixture(scope="module")
def whole(short_family, tmp_path_factory):
    """A run of eight members that nothing interrupted."""
    return play(tmp_path_factory.mktemp("whole") / "run")


def history(result):
    with (result.directory / "population.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def bytes_of(state):
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return {jax.tree_util.keystr(k): np.asarray(plain(x)).tobytes() for k, x in jax.tree.leaves_with_path(state)}


@pytest.mark.slow
@pytest.mark.parametrize("stop", [80, 100])
def test_a_resumed_population_repeats_every_choice(whole, stop, tmp_path):
    """Whether it stops with a choice or between two; what a killed process wrote after its checkpoint is dropped."""
    stopped = play(tmp_path / "run", on_chunk=lambda row: row["steps"] >= stop)
    assert not stopped.finished
    with (tmp_path / "run" / "population.csv").open("a") as file:
        file.write("120,0,0,3,1.5,0.001,0.9\r\n120,1,")
    resumed = play(tmp_path / "run", resume=True)
    assert (tmp_path / "run" / "population.csv").read_bytes() == (whole.directory / "population.csv").read_bytes()
    assert bytes_of(resumed.state) == bytes_of(whole.state)
    for x, y in zip(jax.tree.leaves(resumed.evaluations), jax.tree.leaves(whole.evaluations), strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
def test_the_history_says_who_copied_whom(whole):
    """A row for each member and choice; the numbers are those with which it goes on, as metrics have them too."""
    rows = history(whole)
    assert [int(row["steps"]) for row in rows] == [steps for steps in (40, 80, 120, 160, 200) for _ in range(8)]
    assert [int(row["member"]) for row in rows] == 5 * [*range(8)]
    copied = [row for row in rows if row["from"] != row["member"]]
    assert len(copied) == 5
    for i, choice in enumerate(rows[k : k + 8] for k in range(0, 40, 8)):
        (row,) = (row for row in choice if row["from"] != row["member"])
        returns = whole.evaluations.returns["train"][:, i].mean(axis=(1, 2))
        assert int(row["from"]) == np.argmax(returns) and float(row["return"]) == pytest.approx(returns.min())
    last = rows[-8:]
    numbers = selection.numbers_of(whole.state)
    for k, row in enumerate(last):
        assert float(row["actor_lr"]) == pytest.approx(numbers["actor_lr"][k], rel=1e-6)
        assert whole.rows[-8 + k]["actor_lr"] == row["actor_lr"] and whole.rows[-8 + k]["gamma"] == row["gamma"]
    start = {(row["actor_lr"], row["gamma"]) for row in whole.rows[:8]}
    assert start == {(lr, gamma) for lr in ("0.001", "0.01") for gamma in ("0.5", "0.99")}


@pytest.mark.slow
def test_members_are_compared_in_the_same_episodes(whole):
    """Those of the first seed, whatever their own seeds are."""
    config = from_json(whole.directory / "config.json")
    seeds = selection.starts(config, np.arange(8))
    assert seeds.tolist() == [0] * 8
    alone = dataclasses.replace(config, plan=dataclasses.replace(config.plan, population=""))
    assert selection.starts(alone, np.arange(8)).tolist() == list(range(8))


@pytest.mark.slow
def test_a_policy_of_a_member_has_its_latest_numbers(whole):
    """From the folder and from the result; it comes alone."""
    numbers = selection.numbers_of(whole.state)
    changed = next(k for k in range(8) if numbers["actor_lr"][k] not in np.float32([1e-3, 1e-2]))
    for policy in (whole.policy(changed), mtjax.load(whole.directory, changed)):
        assert policy.agent.actor_lr == float(numbers["actor_lr"][changed])
        assert policy.agent.gamma == float(numbers["gamma"][changed])
        assert policy.seeds.tolist() == [changed % 2] and not policy.state.numbers
        actor = jax.tree.map(lambda x: x[changed], whole.state.agent.nets["actor"])
        jax.tree.map(np.testing.assert_array_equal, policy.state.nets["actor"], actor)
    found = mtjax.evaluate(whole.directory, point=changed, split="train", episodes=1)
    assert found.returns["train"].shape[0] == 1
    with pytest.raises(InputError, match="from 0 to 7"):
        mtjax.evaluate(whole.directory, point=8)


@pytest.mark.slow
def test_a_population_is_one_seed_in_figures_and_tables(whole):
    """Its members' mean, and a line says why there is no interval."""
    for runs in (whole.directory, whole):
        with pytest.warns(Notice, match="8 members of a population .* have no intervals"):
            (one,) = read_runs.learned(runs)
        assert one.agent == "sac-conditioned, pbt:40" and one.seeds == (0,)
        mean = whole.evaluations.returns["train"].mean(axis=0)
        np.testing.assert_allclose(one.returns["train"], mean[None], rtol=1e-5)
    (row,) = sweep.rows([whole.directory])
    assert row["train_low"] == row["train_high"] == "" and row["seeds"] == 8 and row["actor-lr"] == "0.001 0.01"
    assert float(row["train"]) == pytest.approx(whole.evaluations.returns["train"][:, -1].mean(), rel=1e-5)
    assert "[" not in sweep.table([row])


def test_lost_members_are_left_out_of_the_mean():
    """All are lost where nobody is left."""
    none = no_evaluations(
        range(3), {"train": np.zeros(2), "interpolation": np.zeros(0), "extrapolation": np.zeros(0)}, 1
    )
    returns = np.arange(6.0).reshape(3, 1, 2, 1)
    returns[1] = np.nan
    found = as_one_seed(none._replace(steps=np.array([5]), returns={**none.returns, "train": returns}))
    np.testing.assert_array_equal(found.returns["train"], [[[[2.0], [3.0]]]])
    assert len(found.seeds) == 1


@pytest.mark.slow
def test_halving_ends_with_one_origin(short_family, tmp_path, capsys):
    """Of four seeds with nothing swept; the best one is named after each evaluation."""
    given = RUN | {"population": "halving:80", "seeds": 4, "quiet": False}
    result = mtjax.train("bandit", "sac-conditioned", directory=tmp_path / "run", **given)
    rows = history(result)
    sources, origins = np.array([int(row["from"]) for row in rows]).reshape(2, 4), [np.arange(4)]
    for choice in sources:
        origins.append(origins[-1][choice])
    assert [len(set(x.tolist())) for x in origins] == [4, 2, 1]
    np.testing.assert_array_equal(result.state.origins, origins[-1])
    lines = capsys.readouterr().out.splitlines()
    best = [line for line in lines if line.startswith("best of the population: number ")]
    assert len(best) == len(result.evaluations.steps)
    assert lines.count("2 of 4 members are now copies of 2 better ones") == 1
    assert set(rows[0]) == {"steps", "member", "seed", "from", "return"}
