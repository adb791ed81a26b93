"""Benchmarks that compare in parts: which parts run, and what tables make of their results."""

import argparse
import contextlib
import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from needs import require

import mtjax

FOLDER = Path(__file__).parent.parent / "benchmarks"
_SCRIPT = """
import sys, pathlib, time, os
sys.path.insert(0, {folder!r})
import parts
name, out = sys.argv[1:]
if name == "fails":
    raise SystemExit("no")
if name == "lasts":
    time.sleep(60)
parts.write_result(pathlib.Path(out) / (name + ".json"), {{"name": name, "device": os.environ["CUDA_VISIBLE_DEVICES"]}})
"""

# A program of two parts that gets a signal during the first. The signal goes to a second thread, so it interrupts no
# call of the main thread, as one that comes just before the main thread begins to wait.
_DRIVER = """
import sys, argparse, pathlib, signal, threading, time
sys.path.insert(0, {folder!r})
import parts
out = pathlib.Path({out!r})
def stop():
    while not (out / "lasts.log").exists():
        time.sleep(0.05)
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
threading.Thread(target=stop, daemon=True).start()
of_all = [parts.Part(name, [name, str(out)]) for name in ("lasts", "a")]
parts.run_parts({script!r}, of_all, out, argparse.Namespace(within=50.0, devices=["0"]))
"""


@pytest.fixture
def module(monkeypatch):
    """A benchmark's module, by name."""
    monkeypatch.syspath_prepend(str(FOLDER))
    before = set(sys.modules)
    yield importlib.import_module
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) and str(FOLDER) in str(sys.modules[name].__file__):
            sys.modules.pop(name)


def flags(**given):
    return argparse.Namespace(**{"seconds": 30.0, "within": float("inf"), "devices": ["0", "1"], **given})


def test_parts_without_a_result_run_and_others_do_not(module, tmp_path, capfd):
    """One that fails keeps no other from running, and is left."""
    parts, script = module("parts"), tmp_path / "script.py"
    script.write_text(_SCRIPT.format(folder=str(FOLDER)))
    out = tmp_path / "out"
    of_all = [parts.Part(name, [name, str(out)]) for name in ("fails", "a", "b", "c")]
    parts.write_result(out / "a.json", {"name": "a", "device": "old"})
    assert parts.run_parts(str(script), of_all, out, flags()) == ["fails"]
    found = {x["name"]: x["device"] for x in parts.read_results(out)}
    assert found["a"] == "old" and set(found) == {"a", "b", "c"} and {found["b"], found["c"]} <= {"0", "1"}
    told = capfd.readouterr().out
    assert "fails: no result after" in told and f"see {out / 'fails.log'}: no\n" in told


def test_a_part_is_stopped_when_the_time_is_over(module, tmp_path):
    """And those after it are not begun."""
    parts, script = module("parts"), tmp_path / "script.py"
    script.write_text(_SCRIPT.format(folder=str(FOLDER)))
    of_all = [parts.Part(name, [name, str(tmp_path)]) for name in ("lasts", "a")]
    assert parts.run_parts(str(script), of_all, tmp_path, flags(within=0.5, devices=["0"])) == ["lasts", "a"]


def test_parts_stop_with_the_program_that_started_them(tmp_path):
    """On a signal, within a moment; nothing of them is left behind."""
    script, driver = tmp_path / "script.py", tmp_path / "driver.py"
    script.write_text(_SCRIPT.format(folder=str(FOLDER)))
    driver.write_text(_DRIVER.format(folder=str(FOLDER), script=str(script), out=str(tmp_path)))
    process = subprocess.Popen([sys.executable, str(driver)], start_new_session=True)
    try:
        assert process.wait(20) == 128 + signal.SIGTERM and not (tmp_path / "a.log").exists()
        with pytest.raises(ProcessLookupError):
            os.killpg(process.pid, 0)
    finally:  # a program that goes on would fail the next test
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def test_a_part_that_begins_as_all_are_stopped_is_stopped(module, tmp_path, monkeypatch):
    """The stop came when its process was not yet among those that run."""
    parts, script, begin = module("parts"), tmp_path / "script.py", subprocess.Popen
    script.write_text(_SCRIPT.format(folder=str(FOLDER)))
    runner = parts._Runner(str(script), tmp_path, float("inf"), float("inf"))
    monkeypatch.setattr(parts.subprocess, "Popen", lambda *words, **given: (runner.stop(), begin(*words, **given))[1])
    runner.play(parts.Part("lasts", ["lasts", str(tmp_path)]), "0")
    assert not (tmp_path / "lasts.json").exists()


def test_a_part_that_goes_on_when_asked_to_stop_is_ended(module, tmp_path, monkeypatch):
    """After a time of grace, also where the parts have no time limit."""
    parts, script, log = module("parts"), tmp_path / "script.py", tmp_path / "stays.log"
    monkeypatch.setattr(parts, "_GRACE", 0.1)
    script.write_text(
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('begun', flush=True); time.sleep(60)"
    )
    runner = parts._Runner(str(script), tmp_path, float("inf"), float("inf"))
    playing = threading.Thread(target=runner.play, args=(parts.Part("stays", []), ""))
    playing.start()
    while playing.is_alive() and not (log.exists() and log.read_text()):
        time.sleep(0.05)
    runner.stop()
    playing.join(20)
    assert not playing.is_alive()


def peer_result(side, seed, times, returns, cold, compiling=30.0):
    """Times of training at which a side has returns, each after another million of steps."""
    curve = [
        {"steps": k * 1_000_000, "process": compiling + t, "training": t, "mean": x}
        for k, (t, x) in enumerate(zip(times, returns, strict=True))
    ]
    choices = {"gradient_steps_per_million": 500.0, "substeps": 2, "worlds": 1, "passes": 4, "engine": "c"}
    choices |= dict.fromkeys(("samples_per_gradient_step", "substep_seconds", "imported_after"), 1)
    return {
        **{"env": "CheetahRun", "side": side, "seed": seed, "cold": cold, "curve": curve, "choices": choices},
        "machine": {"device": "card"},
    }


def test_seconds_to_a_return_are_of_the_first_evaluation_that_has_it(module, tmp_path):
    """In training over all seeds, from the start of the process over cold ones."""
    peer, parts = module("ppo_peer"), module("parts")
    for result in (
        peer_result("mtjax", 0, [0, 1, 2, 3], [10, 400, 600, 500], cold=True),
        peer_result("mtjax", 1, [0, 2, 4, 6], [10, 500, 600, 800], cold=False, compiling=5.0),
        peer_result("playground-jax", 0, [0, 7, 14, 21], [10, 20, 30, 501], cold=True),
    ):
        parts.write_result(tmp_path / "CheetahRun" / f"{result['side']}-{result['seed']}.json", result)
    lines = peer.tabulate(tmp_path, [500]).splitlines()
    ours, theirs = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:4])
    # task, side, seeds, card, best, cold start, then training and cold to 500 and to 630, then four rates
    assert ours[4:10] == ["700", "30.0", "2.0 [2.0, 2.0]", "32.0", "-", "-"]
    assert theirs[4:10] == ["501", "30.0", "21.0", "51.0", "-", "-"]
    assert ours[10:] == ["750,000", "1,500,000", "375", "500"]
    assert "CheetahRun 630" in lines[-2]


def test_our_side_says_what_it_chose(module):
    """By the preset: four passes over 2,048 worlds x 32 steps in 16 minibatches."""
    config = mtjax.preset("cheetah-run", "ppo", "gpu", engine="c")
    chosen = module("ppo_peer").choices_of(config.family, config.learner, config.training)
    assert (chosen["worlds"], chosen["passes"], chosen["samples_per_gradient_step"]) == (2048, 4, 4096)
    assert chosen["gradient_steps_per_million"] == 1e6 * 4 * 16 / (2048 * 32)


def test_the_first_interval_counts_as_the_median_of_the_others(module):
    """As it compiles, which is no training."""
    peer = module("ppo_peer")
    points = [peer.Reached(k, seconds, None, 0.0) for k, seconds in enumerate((50.0, 150.0, 157.0, 164.0))]
    assert [x.training for x in peer.without_compiling(points)] == [0.0, 7.0, 14.0, 21.0]
    assert peer.without_compiling(points[:2]) == points[:2]


def test_figures_have_their_origin(module, tmp_path, monkeypatch):
    """Settings, versions, commit and date; a folder keeps those of every call that differs."""
    monkeypatch.setenv("MTJAX_COMMIT", "abc")
    report = module("report")
    made = report.record(argparse.Namespace(steps=3, json="x"), {"rows": []})
    assert made["settings"] == {"steps": 3} and made["machine"]["commit"] == "abc" and made["rows"] == []
    assert {"jax", "mujoco", "device", "devices", "date"} <= set(made["machine"])
    for steps in (3, 3, 4):
        report.note_origin(argparse.Namespace(steps=steps), tmp_path)
    lines = [json.loads(line) for line in (tmp_path / "origin.json").read_text().splitlines()]
    assert [line["settings"]["steps"] for line in lines] == [3, 4]


def test_scaling_has_a_row_for_every_result_and_begins_parts_with_their_settings(module, tmp_path, monkeypatch):
    """Each names its folder, also where that is named after the clock, and the device whose values it takes."""
    scaling, parts = module("scaling"), module("parts")
    axes = ["seeds", "devices"]
    arguments = argparse.Namespace(axes=axes, on="cpu", out=tmp_path, plots=tmp_path / "plots", json=None)
    monkeypatch.setattr(sys, "argv", ["scaling.py", "--axes", "seeds"])
    of_all = [scaling.part(*each, arguments) for each in scaling.settings(arguments, 2)]
    assert [x.name for x in of_all] == ["seeds-1", "seeds-2", "seeds-4", "devices-1", "devices-2"]  # there are no four
    assert of_all[1].words[2:] == ["--on", "cpu", "--out", str(tmp_path), "--part", "seeds", "2"]
    line = {"axis": "seeds", "worlds": 8, "steps_per_second": 1000, "substeps_per_second": 2000, "slowest": 1}
    line |= {"fastest": 2, "updates_per_second": 3.0, "compile_seconds": 4.0}
    for value, cost in ((2, 1.5), (1, 1.0)):
        rows = [{**line, "value": value, "cost": cost}]
        parts.write_result(tmp_path / f"seeds-{value}.json", {"machine": {}, "rows": rows})
    lines = scaling.tabulate(arguments).splitlines()
    assert [x.split("|")[7].strip() for x in lines[2:]] == ["1.00", "1.50"]
    assert (tmp_path / "plots" / "scaling-seeds.png").exists()


def test_playground_has_a_second_row_where_its_substeps_differ(module):
    """At the length of ours."""
    require("mujoco_playground")
    steps = module("steps_per_second")
    own = steps.Physics(2, 0.01, "euler")
    default, ours = steps.playground_physics("FingerSpin", own)
    assert default[2].substeps == 4 and ours[2] == own and ours[1] == {"sim_dt": 0.01}
    assert len(steps.playground_physics("CheetahRun", steps.Physics(1, 0.01, "euler"))) == 1


def test_a_run_without_metrics_tells_why_it_ended(module, tmp_path):
    given = argparse.Namespace(patience=60.0, seeds=1, mark=900.0)
    with pytest.raises(SystemExit, match=r"no metrics came from mtjax.train --agent=foo: .*unknown agent 'foo'"):
        module("time_to_return").watch(["--agent=foo"], tmp_path, "cold", given)


def test_solver_iterations_are_those_of_a_mujoco_model(module):
    with pytest.raises(mtjax.InputError, match="'link' is no family of one MuJoCo model"):
        next(module("solver_iterations").measure("link", ("c",), argparse.Namespace(vary=[])))


def test_a_file_without_curves_is_told(module, tmp_path):
    published, (none, other) = module("published"), (tmp_path / "none.csv", tmp_path / "other.csv")
    other.write_text("family,steps\nfish-swim,3\n")
    for file in (none, other):
        with pytest.raises(mtjax.InputError, match=rf"{file.name}' is no file with lines of family, seconds, return"):
            published.read(file)


def test_a_family_is_learned_by_its_share_of_what_is_published(module):
    """Of its nominal task, in the last tenth of a run; of 1000 where nothing is known."""
    published = module("published")
    runs = {"walker-run": [600, 400, 504], "walker-run-vary-friction": [0, 0, 506], "fish-swim": [0, 0, 599]}
    lines = [
        {"family": family, "seconds": str(seconds), "return": str(x)}
        for family, values in runs.items()
        for seconds, x in zip((10, 50, 100), values, strict=True)
    ]
    lines.append({"family": "fish-swim", "seconds": "100", "return": ""})
    returns = published.last_returns(lines)
    assert returns == {"walker-run": 504, "walker-run-vary-friction": 506, "fish-swim": 599}
    assert [published.is_learned(*each) for each in returns.items()] == [False, True, False]  # 0.6 of 842 and of 1000
    assert published.tabulate(returns).endswith("1 of 3 are learned: their share is at least 0.6.")


def test_whole_runs_are_compared_by_the_seeds_that_they_train(module, tmp_path):
    """Steps a second are of all seeds, and the range is that of their returns."""
    peer, parts = module("rejax_peer"), module("parts")
    result = {"machine": {"device": "card"}, "steps": 100, "compile_seconds": 1.0}
    for side, seconds in (("mtjax", 2.0), ("rejax", 4.0)):
        own = {"side": side, "seeds": 2, "seconds": seconds, "returns": [1.0, 3.0], "gradient_steps_per_million": 5.0}
        parts.write_result(tmp_path / f"{side}-2.json", {**result, **own})
    lines = peer.tabulate(tmp_path).splitlines()[2:]
    assert lines[0] == "| rejax | 2 | card | 2 | 1 to 3 | 1.0 | 4.0 | 2.00 | 50 | 5 |"
    assert lines[1] == "| mtjax | 2 | card | 2 | 1 to 3 | 1.0 | 2.0 | 1.00 | 100 | 5 |"
    assert peer.gradient_steps(9, 2, 1024) == pytest.approx(17_578, rel=1e-4)
