"""Progress of a run on the terminal: what lines and bars say, and the time that is left."""

import io
import re
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rich

from mtjax.names import InputError
from mtjax.report import films, waiting
from mtjax.training import console as consoles
from mtjax.training.console import Clock, Console


def test_a_line_says_steps_time_left_rate_and_what_the_range_is(capsys):
    """Of tasks, not of seeds; episodes that still run speak for themselves."""
    clock = Clock(chunks=4, evaluations=2)
    console = Console(2000, clock=clock)
    clock.evaluation(1.0)
    clock.chunk(2.0)
    console.progress(500, 30.0, 512.3, np.array([[np.nan, np.nan]]), "episodes still run")
    clock.evaluation(5.0)
    clock.chunk(2.0)
    console.progress(1000, 75.0, 512.3, np.array([[np.nan, 10.0], [20.0, 60.4]]))
    console.close()
    assert capsys.readouterr().out.splitlines() == [
        "500 of 2,000 steps  30 s, 7.0 s left  512 steps/s  episodes still run",
        "1,000 of 2,000 steps  1 min 15 s, 4.0 s left  512 steps/s  return 30 (worst task 20, best 35)",
    ]


def test_one_task_has_no_worst_one():
    """Whatever the number of seeds."""
    assert consoles.describe_returns(np.array([[3.0], [5.0]])) == "return 4"
    assert consoles.describe_returns(np.full((2, 3), np.nan)) == ""


def test_random_actions_tell_nothing_of_the_time_that_learning_takes():
    """Nor does a chunk in which learning begins; and while no evaluation is timed, they may take longer."""
    clock = Clock(chunks=5, evaluations=2, warmup=2)
    said = []
    for seconds in (0.1, 3.0, 20.0):
        said.append(clock.left)
        clock.chunk(seconds)
    assert said == ["warming up"] * 3 and clock.left == "at least 40 s left"
    clock.evaluation(5.0)
    assert clock.left == "45 s left"
    clock.chunk(10.0)
    assert clock.left == "20 s left"
    clock.chunk(10.0)
    clock.evaluation(5.0)
    assert clock.left == "0.0 s left"


def test_a_run_of_random_actions_alone_has_no_time_to_tell():
    """Nothing is left to learn after its last chunk."""
    clock = Clock(chunks=1, evaluations=1, warmup=1)
    assert clock.left == "warming up"
    clock.chunk(1.0)
    assert clock.left == ""


def test_plain_lines_are_some_fifty_in_a_run_and_never_far_apart(capsys):
    """The first and the last are among them, so that files and notebooks are readable."""
    console = Console(1000)
    for i in range(1000):
        console.progress(i + 1, 0.01 * i, 9.0, np.array([[1.0]]))
    lines = capsys.readouterr().out.splitlines()
    assert 45 <= len(lines) <= 55 and lines[0].startswith("1 of") and lines[-1].startswith("1,000 of")
    console = Console(10**9)
    for i in range(10):
        console.progress(i + 1, 10.0 * i, 9.0, np.array([[1.0]]))
    assert len(capsys.readouterr().out.splitlines()) == 5


def test_running_episodes_count_if_they_began_at_age_zero():
    """Others are shorter, and their returns say little."""
    totals, ages = np.array([[[4.0, 100.0], [8.0, 100.0]]]), np.array([[[30, 930], [30, 930]]])
    counted = np.array([[[True, False], [True, False]]])
    told = consoles.describe_running(totals, ages, counted, 1000)
    assert told == "episodes still run: return 6 so far, at step 30 of 1,000"
    assert consoles.describe_running(totals, ages, ~counted & False, 1000) == ""


@pytest.mark.parametrize("warmup, total, lines", [(0, 100, 0), (30, 100, 1), (34, 100, 2), (500, 100, 2)])
def test_random_actions_are_announced_and_warned_of(warmup, total, lines):
    """If they are more than a third of the run."""
    told = consoles.describe_warmup(warmup, total)
    assert len(told) == lines
    assert not lines or told[0] == f"random actions until step {warmup:,}; learning begins there"
    assert lines < 2 or "are random actions" in told[1]


def test_rounding_is_said():
    """Once, where a run takes more steps than were asked for."""
    assert consoles.describe_rounding(600_000, 640_000, 160_000) == [
        "600,000 steps are rounded up to 640,000, whole chunks of 160,000"
    ]
    assert not consoles.describe_rounding(640_000, 640_000, 160_000)


def test_a_resumed_run_says_where_it_goes_on():
    assert consoles.describe_resumption(320, 6400) == "goes on at step 320 of 6,400"
    told = "goes on at step 320 of 6,400; the 80 steps that were made after it are lost, and are made again"
    assert consoles.describe_resumption(320, 6400, 80) == told
    assert consoles.describe_resumption(6400, 6400).startswith("the run has made all its 6,400 steps; --steps=N")


def test_evaluations_name_splits_and_worst_tasks(capsys):
    """A split without tasks is left out, and a single task is not its own worst."""
    returns = {"train": np.array([[[1.0, 3.0], [10.0, 10.0]]]), "interpolation": np.zeros((1, 0, 2))}
    Console(10).evaluation(5, {**returns, "extrapolation": np.ones((1, 1, 2))})
    assert capsys.readouterr().out == "evaluation at 5 steps: train 6 (worst task 2), extrapolation 1\n"
    success = {"train": np.array([[[1.0, 0.0], [np.nan, np.nan]]]), "extrapolation": np.full((1, 1, 2), np.nan)}
    Console(10).evaluation(5, {**returns, "extrapolation": np.ones((1, 1, 2))}, success)
    assert capsys.readouterr().out == "evaluation at 5 steps: train 6 (worst task 2), success 0.50, extrapolation 1\n"


@pytest.mark.parametrize("at_once", [False, True])
def test_what_lasts_is_told_again(monkeypatch, capsys, at_once):
    """Until it ends, whatever its end; at once if that was asked for."""
    monkeypatch.setattr(waiting, "_SOON", 0.01)
    with pytest.raises(InputError), waiting.telling("playing", at_once=at_once):
        time.sleep(0.1)
        raise InputError("ended")
    first, *lines = capsys.readouterr().out.splitlines()
    assert first == ("playing" if at_once else "playing: 0.0 s")
    assert len(lines) > 1 and all(re.fullmatch(r"playing: 0\.\d s", line) for line in lines)
    time.sleep(0.03)
    assert capsys.readouterr() == ("", "")


def test_what_lasts_says_how_far_it_is(monkeypatch):
    """The time that is left is by the share that is done, from where its first part began."""
    now = [100.0]
    monkeypatch.setattr(waiting, "time", SimpleNamespace(monotonic=lambda: now[0]))
    share, said = waiting._Share("playing"), []
    for now[0], done in ((107.0, 0.0), (117.0, 0.01), (307.0, 0.5), (507.0, 1.0)):
        share.reach(done)
        said.append(str(share))
        now[0] += 5
        said.append(str(share))
    assert said == [
        "playing: 7.0 s",
        "playing: 12 s",
        "playing: 1% done  17 s, 16 min 30 s left",
        "playing: 1% done  22 s, 16 min 25 s left",
        "playing: 50% done  3 min 27 s, 3 min 20 s left",
        "playing: 50% done  3 min 32 s, 3 min 15 s left",
        "playing: 100% done  6 min 47 s, 0.0 s left",
        "playing: 100% done  6 min 52 s, 0.0 s left",
    ]


def test_lines_on_what_lasts_come_ever_more_rarely(monkeypatch, capsys):
    """At last one every fifteen seconds: a file of half an hour holds some hundred and twenty."""
    now, waits = [0.0], []

    class Ended:
        def wait(self, seconds):
            waits.append(seconds)
            now[0] += seconds
            return now[0] > 1800

        def set(self):
            pass

    monkeypatch.setattr(waiting, "threading", SimpleNamespace(Event=Ended, Thread=threading.Thread))
    monkeypatch.setattr(waiting, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with waiting.telling("playing"):
        pass
    assert waits[:5] == [2, 2, 4, 8, 15] and set(waits[5:]) == {15}
    lines = capsys.readouterr().out.splitlines()
    assert lines[:3] == ["playing: 2.0 s", "playing: 4.0 s", "playing: 8.0 s"] and 115 < len(lines) < 125


def test_what_lasts_is_a_bar_on_a_terminal(monkeypatch):
    """It ends with what was done at last, and leaves the terminal as it was."""
    terminal = Terminal(monkeypatch, 160)
    monkeypatch.setattr(waiting, "_SOON", 0.01)
    monkeypatch.setattr(waiting, "_OFTEN", 0.01)
    with waiting.telling("playing [all]") as tell:
        for done in (0.0, 0.25, 1.0):
            tell(done)
            time.sleep(0.1)
    text = terminal.getvalue()
    assert "playing [all]: 25% done  0." in text and "━" in text and text.count("\n") == 1
    assert text.rfind("100% done") > text.rfind("25% done")
    assert text.count("\x1b[?25l") == text.count("\x1b[?25h") == 1


def test_playing_for_a_film_is_told(monkeypatch, capsys):
    """As its program compiles for seconds before the first task is drawn."""

    def play(*_):
        time.sleep(0.1)
        raise InputError("enough")

    monkeypatch.setattr(waiting, "_SOON", 0.01)
    monkeypatch.setattr(films, "play", play)
    policy, tasks = SimpleNamespace(env=None), SimpleNamespace(id=[0, 1])
    with pytest.raises(InputError, match="enough"):
        films.write(policy, tasks, [], 1.0, 0, Path("film"), {})  # type: ignore
    assert capsys.readouterr().out.startswith("playing 2 tasks for the film: 0.0 s\n")


def test_quiet_console_is_quiet(capsys):
    """Nothing on either stream."""
    console = Console(10, quiet=True)
    console.say("text")
    console.progress(5, 1.0, 5.0, np.zeros((1, 1)))
    console.evaluation(5, {"train": np.zeros((1, 1, 1))})
    console.close()
    assert capsys.readouterr() == ("", "")


class Terminal(io.StringIO):
    """A terminal of some columns, in place of the standard output."""

    def __init__(self, monkeypatch, columns):
        super().__init__()
        monkeypatch.setattr("sys.stdout", self)
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.setenv("COLUMNS", str(columns))
        rich.reconfigure()  # it has one console, which reads COLUMNS once

    def isatty(self):
        return True


def test_console_draws_a_bar_on_a_terminal(monkeypatch):
    """Lines still come out whole, and closing leaves the terminal as it was."""
    terminal = Terminal(monkeypatch, 160)
    console = Console(2000)
    console.say("a [line] with brackets")
    console.doing("evaluating")
    console.evaluation(1000, {"train": np.full((1, 1, 1), 7.0)})
    console.progress(2000, 4.0, 512.3, np.array([[30.0]]))
    console.close()
    text = terminal.getvalue()
    assert "a [line] with brackets\n" in text and "2,000 of 2,000  " in text and "━" in text
    assert "evaluated train 7" in text
    assert text.count("\x1b[?25l") == text.count("\x1b[?25h") == 1


def test_a_narrow_terminal_cuts_off_what_matters_least(monkeypatch):
    """Of 80 columns are left the returns and the time; where all fits, steps, rate and evaluations follow."""
    told = ["return 850 (worst task 700, best 1000)", "31 min 40 s left", "4,000,000 of 100,000,000", "32,700 steps/s"]
    clock = Clock(96, 0)
    clock.chunk(20.0)

    def last_line(columns):
        terminal = Terminal(monkeypatch, columns)
        console = Console(100_000_000, clock=clock)
        console.evaluation(3_000_000, {"train": np.full((1, 2, 1), 840.0)})
        console.progress(4_000_000, 80.0, 32_700.0, np.array([[700.0, 1000.0]]))
        console.close()
        return re.split("[\r\n]", re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal.getvalue()).rstrip())[-1]

    assert last_line(200).lstrip("━╸ ") == "  ".join([*told, "evaluated train 840"])
    line = last_line(80)
    assert len(line) <= 80 and all(text in line for text in told[:2]) and told[3] not in line
