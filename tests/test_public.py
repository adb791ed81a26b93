"""What Python shows of the package: functions with their signatures, completion, short errors, and evaluations."""

import csv
import importlib.util
import inspect
import pydoc
import re
import subprocess
import sys
import time
import traceback

import jax
import numpy as np
import pytest
from conftest import ShortFinger
from needs import require

import mtjax
from mtjax import report
from mtjax.command import api
from mtjax.evaluate import main
from mtjax.learning.evaluation import Scores
from mtjax.names import public
from mtjax.report import waiting
from mtjax.types import InputError

FUNCTIONS = [name for name in mtjax.__all__ if inspect.isfunction(getattr(mtjax, name))]


@pytest.mark.parametrize("name", ["agent", "evaluate", "export", "load", "make", "plot", "preset", "runs", "train"])
def test_names_are_functions_that_explain_themselves(name):
    """With the parameters, types and documentation that were written for them, for help and completion."""
    function, text = getattr(mtjax, name), pydoc.plain(pydoc.render_doc(getattr(mtjax, name)))
    parameters = inspect.signature(function).parameters
    assert parameters and all(each.annotation is not inspect.Parameter.empty for each in parameters.values())
    assert "function" in text.splitlines()[0] and all(each in text for each in parameters)
    assert function.__doc__.split("\n")[0] in text


@pytest.mark.parametrize("name", ["train", "evaluate", "plot"])
def test_a_command_has_its_functions_name_and_does_not_take_it_away(name):
    """Whether the command's module was imported or not."""
    module = importlib.import_module(f"mtjax.{name}")
    assert module is getattr(mtjax, name) and inspect.isfunction(module) and inspect.isfunction(module.main)
    spec = importlib.util.find_spec(f"mtjax.{name}")
    assert spec is not None and spec.name == f"mtjax.{name}"


def test_completion_shows_what_there_is():
    """All public names, and no imports of the package's own."""
    assert dir(mtjax) == sorted(mtjax.__all__) and set(dir(mtjax)) >= {"train", "evaluate", "plot", "load", "report"}
    assert dir(report) == sorted(report.__all__) and "learning_curves" in dir(report)


def test_editors_see_every_name():
    """They read imports that never run, so these must be the names that do."""
    source = inspect.getsource(mtjax).partition("if TYPE_CHECKING:")[2].partition("\n\n")[0]
    assert {line.partition("#")[0].split()[-1] for line in source.splitlines()[1:]} == set(mtjax.__all__)


def raised(call):
    """The lines of the traceback that a user sees, and the error."""
    with pytest.raises(InputError) as error:
        call()
    return traceback.extract_tb(error.value.__traceback__), error.value


@pytest.mark.parametrize(
    "call",
    [
        lambda: mtjax.train("finger-spn", "sac"),
        lambda: mtjax.train("finger-spin", "sac", vary={"siez": [1.0, 2.0]}),
        lambda: mtjax.make("finger-spin", vary={"siez": [1.0, 2.0]}),
        lambda: mtjax.agent("sac", gama=3),
        lambda: mtjax.load("nowhere"),
        lambda: mtjax.evaluate("nowhere"),
        lambda: mtjax.plot("nowhere"),
        lambda: mtjax.preset("finger-spin", "sac", "tpu"),
        lambda: mtjax.runs("nowhere"),
        lambda: mtjax.register("mine", int),
        lambda: mtjax.mixture(["finger-spin", "finger-spn"]),
        lambda: report.iqm("nowhere"),
        lambda: mtjax.load("finger-spin-vary-size/sac-conditioned")(np.zeros(2)),
    ],
)
def test_a_mistake_ends_at_the_users_line(call):
    """The user's frames, and one of the package's; no other error is told on the way."""
    frames, error = raised(call)
    assert [frame.filename == __file__ for frame in frames] == [True, True, False]
    assert error.__cause__ is None and error.__suppress_context__


def test_all_frames_are_kept_on_demand(monkeypatch):
    """For who looks for a fault in the package."""
    monkeypatch.setenv("MTJAX_TRACEBACK", "full")
    frames, _ = raised(lambda: mtjax.make("finger-spn"))
    assert frames[-1].name == "make" or len(frames) > 3


def test_faults_keep_their_frames():
    """What is no mistake of the user's is shown whole; and what an own file caused stays beside the error."""

    @public
    def fail():
        raise KeyError("inside")

    with pytest.raises(KeyError) as error:
        fail()
    assert traceback.extract_tb(error.value.__traceback__)[-1].name == "fail"
    cause = ValueError("of the user's code")

    @public
    def refuse():
        raise InputError("no") from cause

    assert raised(refuse)[1].__cause__ is cause


def test_a_script_prints_few_lines(tmp_path):
    """As a user sees it."""
    file = tmp_path / "script.py"
    file.write_text("import mtjax\n\nmtjax.make('finger-spn')\n")
    done = subprocess.run([sys.executable, str(file)], capture_output=True, text=True, timeout=300)
    lines = done.stderr.splitlines()
    assert "did you mean 'finger-spin'?" in lines[-1] and len(lines) <= 6


# Evaluations.

PLAN = {"seeds": 2, "eval_every": 50, "eval_episodes": 1, "quiet": True}
SMALL = {"num_envs": 2, "chunk_steps": 25, "batch_size": 4, "replay_size": 200, "warmup_steps": 5, "hidden": (8, 8)}


@pytest.fixture(scope="module")
def result(short_family, tmp_path_factory):
    place = tmp_path_factory.mktemp("evaluated") / "run"
    return mtjax.train("finger-short", "sac-conditioned", steps=100, directory=place, **PLAN, **SMALL)


@pytest.fixture(scope="module")
def found(result):
    return mtjax.evaluate(result, episodes=2)


@pytest.mark.slow
def test_an_evaluation_is_that_of_the_command(result, found, tmp_path):
    """The same returns in the same rows, of a result and of its folder."""
    main([f"--run={result.directory}", "--episodes=2"])
    with next(result.directory.glob("evaluation-*/returns.csv")).open() as file:
        rows = list(csv.DictReader(file))
    require("pandas")
    table = found.frame()
    assert list(table.columns) == ["seed", "split", "task", "size", "episode", "return"]
    key = lambda split, size, seed, episode: (split, round(float(size), 6), int(seed), int(episode))
    theirs = {key(r["split"], r["size"], r["seed"], r["episode"]): float(r["return"]) for r in rows}
    ours = {key(r["split"], r["size"], r["seed"], r["episode"]): r["return"] for r in table.to_dict("records")}
    assert theirs.keys() == ours.keys()
    np.testing.assert_allclose([theirs[k] for k in ours], list(ours.values()), rtol=1e-6)
    again = mtjax.evaluate(result.directory, episodes=2)
    assert again.seeds == (0, 1) and "2 seeds" in repr(again)
    jax.tree.map(np.testing.assert_array_equal, again.returns, found.returns)


@pytest.mark.slow
def test_a_policy_plays_alone_and_a_split_alone_plays_the_same_episodes(result, found):
    """Those that it plays beside the others."""
    assert {split: x.shape for split, x in found.returns.items()}["train"] == (2, 2, 2)
    one = mtjax.evaluate(result.policy(1), episodes=2)
    assert one.seeds == (1,)
    np.testing.assert_allclose(one.returns["train"], found.returns["train"][1:], rtol=1e-5)
    for split in found.returns:
        alone = mtjax.evaluate(result, split=split, episodes=2)
        assert list(alone.returns) == [split]
        np.testing.assert_allclose(alone.returns[split], found.returns[split], rtol=1e-5)
        np.testing.assert_array_equal(alone.values[split], found.values[split])


@pytest.mark.slow
def test_other_values_are_played(result, found):
    """As the split "given", where a value that trained has the same policy."""
    given = mtjax.evaluate(result, vary={"size": [1.0, 1.1, 1.5]}, episodes=2)
    assert list(given.returns) == ["given"] and given.returns["given"].shape == (2, 3, 2)
    np.testing.assert_allclose(given.values["given"], [1.0, 1.1, 1.5], rtol=1e-6)
    assert not np.array_equal(mtjax.evaluate(result, seed=1, episodes=2).returns["train"], found.returns["train"])


@pytest.mark.parametrize(
    "given, said",
    [
        ({"episodes": 0}, "episodes must be at least 1"),
        ({"episodes": 2.5}, "episodes must be a whole number, not 2.5"),
        ({"seed": -1}, "seed must be at least 0"),
        ({"task_seed": "a"}, "task-seed must be a whole number"),
        ({"split": "test"}, "unknown split 'test'"),
        ({"split": "train", "vary": {"size": [1.0]}}, "leave out split"),
        ({"vary": {"siez": [1.0]}}, "did you mean 'size'"),
        ({"vary": {"size": [-1.0]}}, "size must be greater than 0"),
        ({"task_seed": 1, "vary": {"size": [1.0]}}, "leave out vary"),
        ({"point": 1}, "point must be from 0 to 0"),
        ({"checkpoint": 100}, "checkpoint is of a run's folder"),
    ],
)
def test_wrong_arguments_are_refused_before_anything_is_compiled(result, monkeypatch, given, said):
    monkeypatch.setattr("mtjax.report.scoring.score", lambda *_: pytest.fail("was played"))
    with pytest.raises(InputError, match=said):
        mtjax.evaluate(result, **given)


@pytest.mark.parametrize("quiet", [False, True])
def test_an_evaluation_that_takes_long_says_what_it_plays(result, monkeypatch, capsys, quiet):
    """Unless it is to be quiet; a short one says nothing."""

    def score(policy, episodes, seed, tasks, split, tell):
        tell(0.0)
        tell(0.25)
        time.sleep(0.3)
        return {split: Scores(np.ones((2, len(policy.env.tasks(split).id), episodes.count)), {})}

    monkeypatch.setattr("mtjax.report.scoring.score", score)
    mtjax.evaluate(result, split="train", episodes=3, quiet=quiet)
    assert capsys.readouterr().out == ""
    monkeypatch.setattr(waiting, "_SOON", 0.01)
    mtjax.evaluate(result, split="train", episodes=3, quiet=quiet)
    lines = capsys.readouterr().out.splitlines()
    assert bool(lines) != quiet
    assert quiet or re.fullmatch(r"playing 12 episodes: 25% done  0\.\d s, 0\.\d s left", lines[-1])


@pytest.mark.parametrize("run", [None, 3, "nowhere", ShortFinger()])
def test_what_is_no_run_is_refused(run):
    with pytest.raises(InputError):
        mtjax.evaluate(run)


def test_train_is_the_function_of_its_module():
    """So that it can be pickled by its name."""
    assert mtjax.train is api.train
