"""Figures and tables of several runs: which runs are joined, what is drawn, and into which files."""

import dataclasses
import json

import numpy as np
import pytest
from needs import needs

import mtjax
import mtjax.plot
from mtjax import report
from mtjax.learning.evaluation import Evaluations, save_evaluations
from mtjax.report import plots, read_runs
from mtjax.report.stats import iqm, probability_of_improvement, seed_interval
from mtjax.saved.config_json import to_json
from mtjax.types import SPLITS, InputError

STEPS = np.array([100, 200, 300])


@pytest.fixture
def make_run(tmp_path):
    """Write a run of an agent on a family, without training it; returns its folder."""

    def make_run(name, env, agent, seed=0, seeds=3, shift=0.0, **given):
        config = mtjax.preset(env, agent)
        plan = dataclasses.replace(config.plan, seed=seed, seeds=seeds, eval_episodes=2)
        learner = mtjax.agents.hyperparameters.replace(config.learner, given)
        config = dataclasses.replace(config, plan=plan, learner=learner)
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        (folder / "config.json").write_text(to_json(config, {"command": ""}))
        random = np.random.default_rng(seed + 7)
        count = lambda split: len(config.family.tasks(split).id)
        draw = lambda split: np.float32(shift + random.uniform(0, 100, (seeds, 3, count(split), 2)))
        returns = {split: draw(split) for split in SPLITS}
        values = {split: config.family.task_values(split) for split in SPLITS}
        metrics = {"success": {split: np.float32(x > 50) for split, x in returns.items()}}
        save_evaluations(folder / "evaluations.npz", Evaluations(STEPS, returns, values, metrics))
        return folder

    return make_run


@pytest.fixture
def runs(make_run, tmp_path):
    """Two agents on two families, one of them over two runs of other seeds."""
    make_run("a1", "finger-spin-vary-size", "sac")
    make_run("a2", "finger-spin-vary-size", "sac", seed=3, seeds=2)
    make_run("b", "finger-spin-vary-size", "care", shift=50)
    make_run("c", "walker-walk-vary-friction", "sac")
    make_run("d", "walker-walk-vary-friction", "care", shift=50)
    return str(tmp_path / "runs" / "*")


def test_seeds_of_equal_settings_are_joined_and_others_are_named_apart(runs, make_run, tmp_path):
    """A seed that two runs share counts once."""
    make_run("e", "finger-spin-vary-size", "sac", gamma=0.5)
    make_run("f", "finger-spin-vary-size", "care", seed=2, seeds=2, shift=50)
    found = {(one.env, one.agent): one for one in read_runs.learned(runs)}
    assert {agent: one.seeds for (env, agent), one in found.items() if env.startswith("finger")} == {
        "sac, gamma 0.99": (0, 1, 2, 3, 4),
        "sac, gamma 0.5": (0, 1, 2),
        "care": (0, 1, 2, 3),
    }
    one = found["finger-spin-vary-size", "sac, gamma 0.99"]
    assert one.returns["train"].shape == (5, 3, 10, 2) and one.axis == ("size", "1")
    parts = [read_runs.learned(tmp_path / "runs" / name)[0] for name in ("a1", "a2")]
    joined = np.concatenate([part.returns["train"] for part in parts])
    np.testing.assert_array_equal(one.returns["train"], joined)


def test_learning_curves_are_means_with_bands(runs, tmp_path):
    """Of one family; several are drawn in a grid."""
    with pytest.raises(
        InputError, match=r"the figure curves is of one family, and .* figure families \(figure='families'\)"
    ):
        report.learning_curves(runs)
    folders = [tmp_path / "runs" / name for name in ("a1", "b")]
    axes = report.learning_curves(folders)
    assert axes.get_legend_handles_labels()[1] == ["sac (3 seeds)", "care (3 seeds)"]
    found = read_runs.learned(folders)
    np.testing.assert_allclose(axes.lines[1].get_ydata(), found[1].returns["train"].mean(axis=(0, 2, 3)))
    assert len(axes.collections) == 2
    grid = report.families(runs)
    assert [axes.get_title() for axes in grid] == ["finger-spin-vary-size", "walker-walk-vary-friction"]
    assert all(len(axes.lines) == 2 for axes in grid)


def test_given_axes_are_drawn_on(runs, tmp_path):
    """As in a figure of one's own."""
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    assert report.learning_curves(tmp_path / "runs" / "b", ax=axes) is axes and axes.lines


def test_returns_lie_over_the_parameter_in_order(runs, tmp_path):
    """Of all splits, with the training range shaded."""
    axes = report.return_by_parameter(tmp_path / "runs" / "a1")
    (one,) = read_runs.learned(tmp_path / "runs" / "a1")
    values = np.sort(np.concatenate([one.values[split] for split in SPLITS]))
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), values)
    place = int(np.argmin(np.abs(values - one.values["interpolation"][2])))
    score = one.final("interpolation")[:, 2].mean()
    np.testing.assert_allclose(axes.lines[0].get_ydata()[place], score, rtol=1e-6)
    assert axes.get_xlabel() == "size"


def test_numbered_tasks_are_not_joined_by_a_line(make_run):
    """As neighbours in number are none in the plane of two goals."""
    axes = report.return_by_parameter(make_run("g", "point-mass-vary-goal", "sac"))
    assert axes.get_xlabel() == "task [number]" and not axes.collections
    assert all(line.get_linestyle() == "None" for line in axes.lines)
    assert axes.get_legend_handles_labels()[1] == ["sac (3 seeds)"]


def test_aggregates_name_their_families_and_are_as_high_as_their_rows(runs, tmp_path):
    """A figure of two points is no empty page."""
    two = "finger-spin-vary-size\nwalker-walk-vary-friction"
    for figure, rows in ((report.iqm, 2), (report.improvement, 1)):
        axes = figure(runs)
        assert axes.get_title() == two and axes.figure.get_size_inches()[1] == pytest.approx(1.4 + 0.4 * rows)
    assert report.performance_profile(runs).get_title() == two
    assert report.iqm(str(tmp_path / "runs" / "a*")).get_title() == "finger-spin-vary-size"


def test_python_draws_what_the_command_draws(runs, tmp_path):
    """And writes it if a file is named; one figure is asked for by its name."""
    axes = mtjax.plot(runs, "iqm", out=tmp_path / "x.svg")
    assert (tmp_path / "x.svg").is_file() and axes.get_xlabel() == report.iqm(runs).get_xlabel()
    assert mtjax.plot(runs, "iqm", metric="success").get_xlabel().startswith("interquartile mean of the success")
    assert len(mtjax.plot(runs, "families")) == 2
    for given, said in (({"figure": "curve"}, "did you mean 'curves'"), ({"split": "test"}, "unknown split 'test'")):
        with pytest.raises(InputError, match=said):
            mtjax.plot(runs, **given)


def test_own_files_of_all_runs_are_asked_for_at_once(runs, tmp_path):
    """And none of them runs by itself."""
    files = [tmp_path / f"own_{name}.py" for name in ("one", "two")]
    for name, own in zip("ac", files, strict=True):
        own.write_text("raise SystemExit\n")
        path = next((tmp_path / "runs").glob(f"{name}*")) / "config.json"
        record = json.loads(path.read_text())
        path.write_text(json.dumps({**record, "env": "own", "imports": [str(own)]}))
    with pytest.raises(InputError, match=" ".join(rf"--import=\S+{file.name}" for file in files)):
        mtjax.plot.main([runs])


def test_by_default_curves_are_drawn_of_every_family(runs, tmp_path, monkeypatch):
    """In a grid if there are several, by the command and in Python; what was asked for by name is not changed."""
    monkeypatch.chdir(tmp_path)
    for given, name, count in ((runs, "families", 2), (runs.replace("*", "[ab]*"), "curves", 1)):
        mtjax.plot.main([given])
        assert [path.name for path in tmp_path.glob("*.png")] == [f"{name}.png"]
        (tmp_path / f"{name}.png").unlink()
        assert np.size(mtjax.plot(given)) == count
    with pytest.raises(InputError, match="the figure curves is of one family"):
        mtjax.plot(runs, "curves")


def test_aggregates_are_those_of_all_tasks_of_all_families(runs, make_run):
    """Against the functions that compute them; an agent that lacks a family is refused."""
    found = read_runs.learned(runs)
    scores = {}
    for agent in ("sac", "care"):
        own = [one.final() for one in found if one.agent == agent]
        scores[agent] = np.concatenate([x[:3] for x in own], axis=1)
    axes = report.iqm(runs)
    points = [container.lines[0].get_xdata()[0] for container in axes.containers]
    np.testing.assert_allclose(points, [seed_interval(x, iqm).point for x in scores.values()])
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sac", "care"]
    axes = report.improvement(runs)
    (container,) = axes.containers
    expected = probability_of_improvement(scores["care"], scores["sac"])
    assert container.lines[0].get_xdata()[0] == pytest.approx(expected.point)
    axes = report.performance_profile(runs)
    line = axes.lines[1]
    at = line.get_xdata()[40]
    assert line.get_ydata()[40] == pytest.approx(np.mean(scores["care"] > at)) and line.get_ydata()[0] == 1
    make_run("e", "finger-spin-vary-size", "film")
    with pytest.raises(InputError, match="film has no run on walker-walk-vary-friction"):
        report.iqm(runs)


@pytest.mark.parametrize("ending, begins", [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")])
def test_the_command_writes_every_kind_of_file(runs, tmp_path, ending, begins, capsys):
    """By the ending; no file is overwritten."""
    out = tmp_path / "figures" / f"x{ending}"
    mtjax.plot.main([runs, "--figure=profile", f"--out={out}"])
    assert out.read_bytes().startswith(begins)
    assert capsys.readouterr().out == f"written to {out}\n"
    with pytest.raises(InputError, match="exists already"):
        mtjax.plot.main([runs, "--figure=profile", f"--out={out}"])


def test_all_figures_at_once(runs, tmp_path, capsys, monkeypatch):
    """Those that need one family are left out with the reason."""
    monkeypatch.chdir(tmp_path)
    mtjax.plot.main([runs, "--figure", "all"])
    names = ("families", "iqm", "profile", "improvement")
    assert {path.name for path in tmp_path.glob("*.png")} == {f"runs-{name}.png" for name in names}
    assert "curves: left out, as the figure curves is of one family" in capsys.readouterr().out


def test_a_metric_is_drawn_in_the_place_of_returns(runs, make_run, tmp_path, monkeypatch):
    """Of joined seeds too, with its own words; one that a run or a task does not have is refused."""
    found = read_runs.of_metric(runs, "success")
    for one, returned in zip(found, read_runs.learned(runs), strict=True):
        np.testing.assert_array_equal(one.returns["train"], returned.returns["train"] > 50)
    axes = report.learning_curves([one for one in found if one.env.startswith("finger")])
    assert (
        axes.get_ylabel() == "success at the end" and report.learning_curves(runs[:-1] + "b").get_ylabel() == "return"
    )
    drawn = []
    monkeypatch.setattr(plots, "save", lambda axes, path: drawn.append(axes))
    mtjax.plot.main([runs, "--figure=iqm", "--metric=success"])
    assert drawn[0].get_xlabel() == "interquartile mean of the success at the end, train"
    with pytest.raises(InputError, match=r"unknown metric .*; did you mean 'success'"):
        mtjax.plot.main([runs, "--metric=sucess"])
    scores = {"success": {split: np.full_like(x, np.nan) for split, x in found[0].returns.items()}}
    with pytest.raises(InputError, match="not all tasks of finger-spin-vary-size tell success"):
        read_runs.of_metric([found[0]._replace(metrics=scores)], "success")


def test_every_figure_has_a_name():
    """The command's list is read without importing what draws."""
    assert ("auto", *plots.FIGURES, "all") == mtjax.plot.FIGURES and plots.ENDINGS == mtjax.plot.ENDINGS


@pytest.mark.parametrize(
    "words, said",
    [
        ([], "say which runs to draw"),
        (["x", "--figure=curve"], "did you mean 'curves'?"),
        (["x", "--split=test"], "unknown split 'test'"),
        (["x", "--out=x.jpg"], "--out must end with"),
        (["x", "--outt=x.png"], "did you mean '--out'?"),
        (["nowhere"], "there is no run with an evaluation in nowhere"),
    ],
)
def test_wrong_words_are_refused(words, said):
    """In a line."""
    with pytest.raises(InputError) as error:
        mtjax.plot.main(words)
    assert said in str(error.value)


def test_a_folder_of_runs_is_told_how_to_give_them(runs):
    """Which is what one types first."""
    folder = runs.removesuffix("/*")
    with pytest.raises(InputError, match=r"in \S+/runs; its folders hold runs: '\S+/runs/\*'"):
        mtjax.plot.main([folder])


@needs("pandas")
def test_runs_are_tables(runs, make_run):
    """A row for each seed, evaluation and task, with the task's parameter."""
    table = mtjax.runs(runs)
    assert list(table.columns[:8]) == ["run", "env", "agent", "seed", "steps", "split", "task", "size"]
    (one,) = read_runs.learned(make_run("z", "finger-spin-vary-size", "film"))
    mine = mtjax.runs(runs.replace("*", "z"))
    row = mine[(mine.seed == 1) & (mine.steps == 200) & (mine.split == "extrapolation")].iloc[2]
    assert row["return"] == pytest.approx(one.returns["extrapolation"][1, 1, 2].mean())
    assert row["size"] == pytest.approx(one.values["extrapolation"][2])
    assert len(mine) == 3 * 3 * 23


@needs("pandas")
def test_a_result_is_a_table(make_run):
    """As is its folder, and the lines of its metrics."""
    from mtjax.learning.evaluation import load_evaluations
    from mtjax.saved.result import Result

    folder = make_run("x", "finger-spin-vary-size", "sac", seeds=2)
    evaluations, env = load_evaluations(folder / "evaluations.npz"), mtjax.make("finger-spin-vary-size")
    rows = [{"seed": 0, "steps": 100, "return": "1.5", "loss": ""}]
    result = Result(None, evaluations, rows, 0.0, 0.0, True, None, env=env, seeds=(0, 1))
    table, read = result.frame(), mtjax.runs(folder)
    assert table.equals(read[table.columns])
    metrics = result.frame("metrics")
    assert metrics["return"][0] == 1.5 and np.isnan(metrics["loss"][0]) and metrics["steps"].dtype == int
    with pytest.raises(InputError, match="unknown table 'metric'"):
        result.frame("metric")


def test_results_are_drawn_like_runs(make_run):
    """Under names of one's own; every point of a sweep is a line."""
    from mtjax.learning.evaluation import load_evaluations
    from mtjax.saved.result import Result

    folder = make_run("x", "finger-spin-vary-size", "sac", seeds=4)
    evaluations, env = load_evaluations(folder / "evaluations.npz"), mtjax.make("finger-spin-vary-size")
    points = ({"actor_lr": 0.1}, {"actor_lr": 0.01})
    given = {"env": env, "agent": mtjax.agent("sac"), "seeds": (0, 1)}
    swept = Result(None, evaluations, [], 0.0, 0.0, True, None, points, **given)
    axes = report.learning_curves({"mine": swept, "theirs": folder})
    names = ["mine, actor-lr 0.1 (2 seeds)", "mine, actor-lr 0.01 (2 seeds)", "theirs (4 seeds)"]
    assert axes.get_legend_handles_labels()[1] == names
    np.testing.assert_allclose(
        axes.lines[1].get_ydata(), evaluations.returns["train"][2:].mean(axis=(0, 2, 3)), rtol=1e-5
    )
    assert report.learning_curves(swept).get_title() == "finger-spin-vary-size"


def test_a_sweep_is_read_with_its_runs(make_run, tmp_path):
    """Its folder stands for them, and settings between programs are columns."""
    for k, critics in enumerate((2, 3)):
        folder = make_run(f"s/run-{k + 1}", "finger-spin-vary-size", "sac", num_critics=critics)
        record = json.loads((folder / "config.json").read_text())
        record["sweep"] = [f"agent.num-critics={critics}"]
        (folder / "config.json").write_text(json.dumps(record))
    found = read_runs.read(tmp_path / "runs" / "s")
    assert [run.settings for run in found] == [{"num-critics": "2"}, {"num-critics": "3"}]
    assert [one.agent for one in read_runs.learned(tmp_path / "runs" / "s")] == [
        "sac, num-critics 2",
        "sac, num-critics 3",
    ]


@pytest.mark.parametrize(("name", "matched"), [("lr[1]", 1), ("a*", 2), ("a?", 2)])
def test_a_folder_of_any_name_is_read(make_run, tmp_path, name, matched):
    """A folder goes before the pattern that its name would be."""
    folder, other = (make_run(f"{each}/run", "finger-spin-vary-size", "sac") for each in (name, "ab"))
    of = lambda pattern: [found.directory for found in read_runs.read(pattern)]
    assert of(folder) == [folder] and of(other) == [other]
    with pytest.raises(InputError, match="its folders hold runs") as caught:
        of(folder.parent)
    assert of(str(caught.value).split("runs: ")[-1].strip("'")) == [folder]
    assert len(of(str(tmp_path / "runs" / f"{name[0]}?*" / "run"))) == matched


def test_without_pandas_the_error_says_what_to_install(monkeypatch, make_run):
    """In a line."""
    monkeypatch.setitem(__import__("sys").modules, "pandas", None)
    with pytest.raises(InputError, match=r"pip install 'mtjax\[pandas\]'"):
        mtjax.runs(make_run("x", "finger-spin", "sac"))
