"""Searches: trials are asked for in rounds, the better half goes on, and a killed search goes on as it would have."""

import csv
import dataclasses
import json
import math
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from conftest import SHORT_RUN
from needs import needs

import mtjax
import mtjax.train
from mtjax.command import search as command
from mtjax.command.flags import last_given
from mtjax.learning.evaluation import load_evaluations
from mtjax.saved import checkpoint, survivors
from mtjax.saved.config_json import from_json
from mtjax.saved.policy import state_shapes
from mtjax.training import search as searching
from mtjax.training.search import DIVERGED, FINISHED, GAVE_WAY, RUNNING, Search, Trial
from mtjax.types import InputError

EMPTY = Search({"actor_lr": (1e-5, 1e-1)}, {"actor_lr": 1e-3}, 16, 8, (100, 200, 400), 0, ())


def begun(count):
    """A search whose first round has so many running trials."""
    trials = tuple(Trial(i, 1, {"actor_lr": 10.0 ** -(1 + i % 4)}, {}) for i in range(count))
    return dataclasses.replace(EMPTY, trials=trials)


# Halving.


def test_the_better_half_goes_on_and_the_last_rung_finishes():
    """Eight, four, two: with the returns of every rung, and where each trial was trained last."""
    search = searching.climb(begun(8), [3, 1, 4, 1, 5, 9, 2, 6], "run-1")
    assert [trial.number for trial in search.running] == [2, 4, 5, 7] and search.rung == 1
    search = searching.climb(search, [1, 2, 3, 4], "run-2")
    assert [trial.number for trial in search.running] == [5, 7] and search.best is None
    search = searching.climb(search, [7, 8], "run-3")
    assert not search.running and search.best is not None and search.best.number == 7
    assert search.best.returns == {100: 6, 200: 4, 400: 8} and (search.best.run, search.best.point) == ("run-3", 1)
    states = [trial.state for trial in search.trials]
    assert states.count(FINISHED) == 2 and states.count(GAVE_WAY) == 6


def test_trials_that_diverge_never_go_on():
    """They have no return at that rung, and others take their places."""
    search = searching.climb(begun(4), [math.nan, 1.0, math.nan, math.nan], "run-1")
    assert [trial.state for trial in search.trials] == [DIVERGED, RUNNING, DIVERGED, DIVERGED]
    assert search.trials[0].returns == {} and search.trials[1].returns == {100: 1.0}
    assert not searching.climb(search, [math.nan], "run-2").running


@pytest.mark.parametrize(
    "steps, batch, interval, most, found",
    [
        (400, 8, 100, 3, (100, 200, 400)),
        (400, 2, 100, 3, (200, 400)),
        (400, 1, 100, 3, (400,)),
        (400, 8, 150, 3, (150, 300, 400)),
        (400, 8, 25, 5, (50, 100, 200, 400)),
        (400, 64, 25, 5, (25, 50, 100, 200, 400)),
        (400, 64, 25, 1, (400,)),
    ],
)
def test_rungs_are_halves_at_evaluations(steps, batch, interval, most, found):
    """As many as a batch can be halved, and no more than are asked for."""
    assert searching.rungs(steps, batch, interval, most) == found


@pytest.mark.parametrize("most, share", [(1, 1.0), (3, 0.5), (5, 0.1875)])
def test_five_rungs_find_the_best_of_64_with_less_than_a_quarter_of_the_steps(most, share):
    """Where early returns tell which trial is the best, though they are noisy; one that diverged took steps too."""
    rungs, random = searching.rungs(1600, 64, 100, most), np.random.default_rng(0)
    search = dataclasses.replace(begun(64), count=64, batch=64, rungs=rungs)
    quality = random.permutation(64)
    while search.running:
        told = [quality[trial.number] + random.normal() * 1600 / rungs[search.rung] / 4 for trial in search.running]
        search = searching.climb(search, told, "run")
    assert search.best is not None and quality[search.best.number] >= 62
    assert searching.taken(search) == share * 64 * 1600
    lost = searching.climb(begun(4), [math.nan, 1.0, 2.0, 3.0], "run-1")
    assert searching.taken(lost) == 4 * 100


# Asking.


@needs("optuna")
def test_the_first_trial_is_the_presets_and_the_others_lie_in_their_ranges():
    """With four digits, which a table shows whole."""
    search = searching.ask(EMPTY)
    values = [trial.values["actor_lr"] for trial in search.trials]
    assert len(values) == 8 == len(set(values)) and values[0] == 1e-3
    assert all(1e-5 <= x <= 1e-1 and float(f"{x:.4g}") == x for x in values)
    outside = dataclasses.replace(EMPTY, preset={"actor_lr": 1.0})
    assert all(trial.values["actor_lr"] < 1 for trial in searching.ask(outside).trials)


@needs("optuna")
def test_a_search_asks_for_the_same_trials_again():
    """Given the same ones before; another seed, and other returns, bring others."""
    first = searching.ask(EMPTY)
    done = searching.climb(first, [float(i) for i in range(8)], "run-1")
    ended = dataclasses.replace(done, trials=tuple(t._replace(state=GAVE_WAY) for t in done.trials))
    assert searching.ask(EMPTY) == first and searching.ask(ended) == searching.ask(ended)
    assert searching.ask(dataclasses.replace(EMPTY, seed=1)).trials[1:] != first.trials[1:]
    assert [trial.round for trial in searching.ask(ended).trials] == [1] * 8 + [2] * 8


@needs("optuna")
def test_later_rounds_look_near_the_best_of_earlier_ones():
    """Of trials whose return falls with the distance of the logarithm from -2."""
    search, distances = dataclasses.replace(EMPTY, count=48, rungs=(100,)), []
    while len(search.trials) < search.count:
        search = searching.ask(search)
        away = [abs(math.log10(trial.values["actor_lr"]) + 2) for trial in search.running]
        distances.append(np.mean(away))
        search = searching.climb(search, [-x for x in away], "run")
    assert np.mean(distances[-3:]) < 0.6 * distances[0]


def test_a_search_is_read_as_it_was_written(tmp_path):
    """Also between two rungs; a damaged file is told in a line."""
    search = searching.climb(begun(4), [1, 2, math.nan, 3], "run-1")
    searching.write(tmp_path, search)
    assert searching.read(tmp_path) == search
    for text in ("[]", "{", '{"trials": 3}', "{}"):
        (tmp_path / searching.FILE).write_text(text)
        with pytest.raises(InputError, match="does not describe a search"):
            searching.read(tmp_path)


# The command line.


def test_ranges_are_taken_out_of_a_command_line():
    """In either form of a flag; words with dots that are no ranges stay."""
    words = ["--search=4", "--agent.actor_lr=1e-5..1e-2", "--agent.gamma", ".9..0.999", "--runs=../x", "--env=a"]
    found, rest = command.read_ranges(words)
    assert found == {"agent.actor-lr": (1e-5, 1e-2), "agent.gamma": (0.9, 0.999)}
    assert rest == ["--search=4", "--runs=../x", "--env=a"]


RANGE = "--agent.actor-lr=1e-4..1e-2"


@pytest.mark.parametrize(
    "words, said",
    [
        ([RANGE], "--agent.actor-lr has a range, and a run takes one value; --search=20"),
        (["--search=8"], "--search needs ranges"),
        (["--search=1", RANGE], "two trials or more"),
        (["--search=4", "--search-batch=5", RANGE], "--search-batch from 1 to as many"),
        (["--search=4", "--search-rungs=0", RANGE], "--search-rungs must be at least 1"),
        (["--search=4", "--agent.actor-lr=1e-2..1e-4"], "whose end is above its beginning"),
        (["--search=4", RANGE, RANGE], "has two ranges"),
        (["--search=4", "1e-4..1e-2"], "belongs to no flag"),
        (["--search=4", "--num-envs=4..8"], "--num-envs must be a whole number"),
        (["--search=4", "--agent.num-critics=2..8"], "--agent.num-critics is none; --sweep takes others"),
        (["--search=4", "--agent.gamma=0.9..1.5"], "gamma must be in"),
        (["--search=4", RANGE, "--sweep", "agent.tau=0.1,0.2"], "--search and --sweep do not go together"),
        (["--search=4", RANGE, "--seeds=2", "--population=halving:100000"], "--search and --population"),
    ],
)
def test_wrong_searches_are_refused(words, said, monkeypatch, tmp_path):
    """Before any folder is made."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        mtjax.train.main(words)
    assert said in str(error.value) and not list(tmp_path.iterdir())


def test_without_optuna_the_message_has_the_command(monkeypatch, tmp_path):
    """And no folder is made."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(InputError, match=r"--search needs optuna: pip install 'mtjax\[search\]'"):
        mtjax.train.main(["--search=4", RANGE])
    assert not list(tmp_path.iterdir())


def concluded(of_preset, of_other):
    """The lines at the end of a search of two trials, by the returns of the preset and of the other at each rung."""
    words = ("--steps=200000", "--env=point-mass-vary-goal", "--steps=40000")
    trials = (Trial(0, 1, {"actor_lr": 1e-3}, {}), Trial(1, 1, {"actor_lr": 1e-2}, {}))
    search = dataclasses.replace(EMPTY, count=2, batch=2, rungs=(100, 200), words=words, trials=trials)
    search = searching.climb(search, [of_preset[0], of_other[0]], "run-1")
    last = [of[1] for of in (of_preset, of_other) if len(of) == 2]
    return "\n".join(command._conclusion(searching.climb(search, last, "run-2"), Path("here"), ()))


def test_the_end_says_where_the_preset_was_above_the_best():
    """It gave way early, and others were worse later. No flag of the command stands twice."""
    above, below = concluded([37], [38, 34]), concluded([30], [38, 34])
    assert "best at the end: trial 1, 34. the preset, trial 0: 37 after 100 steps, where it gave way" in above
    assert "no gain over the preset is shown" in above and "no gain" not in below
    assert "best at the end: trial 0, 39. the preset, trial 0: 39. it was" in concluded([38, 39], [37])
    assert "mtjax.train --steps=40000 --env=point-mass-vary-goal --agent.actor-lr=0.01" in above


def test_the_last_of_equal_flags_counts():
    words = ["--agent.hidden", "64", "64", "--num_envs=8", "--import=a.py", "--num-envs", "4", "--import=b.py"]
    found = ["--agent.hidden", "64", "64", "--num-envs", "4", "--import=a.py", "--import=b.py"]
    assert last_given(words) == found


def test_one_trial_is_not_several():
    assert (command._trials(1), command._trials(2)) == ("1 trial", "2 trials")


WORDS = [*SHORT_RUN, "--search=6", "--search-batch=4", "--agent.actor-lr=1e-5..1e-2", "--agent.critic-lr=1e-4..1e38"]


def searched(root):
    mtjax.train.main([*WORDS, f"--runs={root}"])
    (folder,) = root.iterdir()
    return folder


@pytest.fixture(scope="module")
def whole(short_family, tmp_path_factory):
    """The folder of a search that nothing stopped, with two rounds of two seeds."""
    return searched(tmp_path_factory.mktemp("search"))


@pytest.mark.slow
@needs("optuna")
def test_a_search_leaves_a_table_and_runs(whole):
    """Each rung is a run of the trials that climbed it, and the table has every trial."""
    search = searching.read(whole)
    with (whole / "search.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6 == len(search.trials) and not search.running
    assert {trial.state for trial in search.trials} == {FINISHED, GAVE_WAY, DIVERGED}
    assert search.best is not None and rows[0]["trial"] == str(search.best.number)
    for trial in search.trials:
        run = whole / trial.run
        assert from_json(run / "config.json").points[trial.point] == trial.values
        last = load_evaluations(run / "evaluations.npz").returns["train"][2 * trial.point :][:2, -1]
        if trial.state == DIVERGED:
            assert not np.isfinite(last).all()
        else:
            assert list(trial.returns.values())[-1] == pytest.approx(float(last.mean()), rel=1e-5)
    assert mtjax.load(whole / search.best.run, seed=2 * search.best.point).agent.actor_lr == pytest.approx(
        search.best.values["actor_lr"]
    )


@pytest.mark.slow
@needs("optuna")
def test_a_killed_search_goes_on_as_it_would_have(whole, tmp_path, monkeypatch, capsys):
    """Killed in its second rung, after an evaluation; and before the third rung has begun."""
    real, calls = command.launch, []

    def die(config, hooks):
        calls.append(hooks.directory.name)
        if len(calls) in (2, 4):
            raise KeyboardInterrupt
        return real(config, hooks)

    monkeypatch.setattr(command, "launch", die)
    with pytest.raises(KeyboardInterrupt):
        searched(tmp_path)
    (folder,) = tmp_path.iterdir()
    for _ in range(3):
        try:
            mtjax.train.main([f"--resume={folder}"])
        except KeyboardInterrupt:
            continue
    assert calls[:3] == ["run-1", "run-2", "run-2"]
    without = lambda place: json.loads((place / searching.FILE).read_text()) | {"words": []}
    assert without(folder) == without(whole)
    before = len(calls)
    mtjax.train.main([f"--resume={folder}"])
    assert len(calls) == before and "best at the end: trial" in capsys.readouterr().out


@pytest.mark.slow
@needs("optuna")
def test_survivors_are_members_of_the_run_before(whole):
    """Their state is the same to the bit, and their metrics and evaluations go on."""
    search = searching.read(whole)
    first, second = (from_json(whole / f"run-{i}" / "config.json") for i in (1, 2))
    members = [2 * first.points.index(point) + seed for point in second.points for seed in (0, 1)]
    state = checkpoint.load(whole / "run-1" / "checkpoints", state_shapes(first))
    taken = survivors.take(state, np.array(members), state_shapes(second))
    jax.tree.map(lambda x, like: np.testing.assert_array_equal(x.shape, like.shape), taken, state_shapes(second))
    for mine, whole_state in zip(jax.tree.leaves(taken.agent), jax.tree.leaves(state.agent), strict=True):
        np.testing.assert_array_equal(mine, np.asarray(whole_state)[members])
    evaluations = [load_evaluations(whole / f"run-{i}" / "evaluations.npz") for i in (1, 2)]
    assert evaluations[1].steps[0] == evaluations[0].steps[0] == search.rungs[0]
    np.testing.assert_array_equal(evaluations[1].returns["train"][:, 0], evaluations[0].returns["train"][members, 0])
    rows = list(csv.DictReader((whole / "run-2" / "metrics.csv").read_text().splitlines()))
    of_first_chunk = [float(row["actor_lr"]) for row in rows[: 2 * len(second.points) : 2]]
    assert of_first_chunk == pytest.approx([point["actor_lr"] for point in second.points])
