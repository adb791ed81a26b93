"""Lines of metrics in their file."""

import csv
import itertools
import warnings

import numpy as np
import pytest

from mtjax.names import Notice
from mtjax.saved import log


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_header_is_written_once(tmp_path):
    """Rows are appended below those that are there."""
    path = tmp_path / "metrics.csv"
    log.append_rows(path, [{"iteration": 1, "x": 2}])
    log.append_rows(path, [{"iteration": 2, "x": 3}, {"iteration": 3, "x": 4}])
    assert path.read_text().split() == ["iteration,x", "1,2", "2,3", "3,4"]


def test_truncation_keeps_an_iteration_and_what_is_before_it(tmp_path):
    """And tells the seconds of training and of the wall clock up to there."""
    path = tmp_path / "metrics.csv"
    clocks = lambda i: {"seconds": f"{i / 10}", "wall_seconds": f"{i}.5"}
    rows = [{"seed": s, "iteration": i, **clocks(i), "x": ""} for i in (10, 20, 30) for s in (0, 1)]
    log.append_rows(path, rows)
    assert log.last_iteration(path) == 30 and log.last_iteration(tmp_path / "none.csv") == 0
    path.write_text(path.read_text() + "0,40,")  # torn, as by a process that was killed
    assert log.last_iteration(path) == 30
    assert log.truncate_rows(path, 20) == (2.0, 20.5)
    assert read(path) == [{k: str(v) for k, v in row.items()} for row in rows[:4]]
    assert log.truncate_rows(path, 0) == (0, 0) and read(path) == []
    log.append_rows(path, rows[:1])
    assert len(read(path)) == 1 and list(tmp_path.iterdir()) == [path]


def test_a_missing_file_is_told(tmp_path):
    """Unless the run was resumed before its first row."""
    assert log.truncate_rows(tmp_path / "metrics.csv", 0) == (0, 0)
    with pytest.warns(Notice, match=r"metrics.csv' is missing; the run goes on without its earlier rows"):
        assert log.truncate_rows(tmp_path / "metrics.csv", 3) == (0, 0)
    assert not list(tmp_path.iterdir())


LINES = "seed,iteration,seconds,wall_seconds,x", "0,10,1.5,9,3", "0,20,2.5,9,4", "0,30,3.5,9,5"


@pytest.mark.parametrize(
    "content, left",
    [
        (b"", 0),
        (b"\0" * 90, 0),
        (b"\xff\xfe\x00binary\n\x80\x81", 0),
        ("\n".join(LINES[1:]).encode(), 0),  # without its header
        (b"seed,iteration\n0,10\n0,20\n", 0),
        (b"x" * 200_000, 0),
        ("\n".join([*LINES[:2], "0,20," + "9" * 200_000, ""]).encode(), 1),
        ("\n".join([LINES[0], "0,10,fast,9,3", *LINES[2:]]).encode(), 1),
        ("\n".join([LINES[0], "0,10,1.5,late,3", *LINES[2:]]).encode(), 1),
        ("\n".join([LINES[0], "0,\u00b2,1.5,9,3", *LINES[2:]]).encode(), 1),
        ("\n".join([*LINES[:2], "0,2"]).encode(), 1),
    ],
)
def test_what_can_be_read_of_a_damaged_file_is_kept(tmp_path, content, left):
    """The damaged file is kept too, a notice says so, and rows can be written again."""
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    with pytest.warns(Notice, match=f"is damaged: {left} rows .* kept as 'metrics.damaged.csv'"):
        log.truncate_rows(path, 20)
    assert (tmp_path / "metrics.damaged.csv").read_bytes() == content
    row = dict(zip(LINES[0].split(","), LINES[-1].split(","), strict=True))
    log.append_rows(path, [row])
    rows = read(path)
    assert len(rows) == left + 1 and rows[-1] == row


TWO_SEEDS = [LINES[0], *(f"{seed},{i}0,{i}.5,9,3" for i in range(1, 6) for seed in (0, 1))]


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        ([], None),
        ([4], "lacks rows of the run: 7 up to step 40 are left"),  # of one seed
        ([3, 4], "lacks rows of the run: 6 up to step 40 are left"),  # of both
        ([1, 2], "lacks rows of the run: 6 up to step 40 are left"),
        ([5, 6], "lacks rows of the run: 6 up to step 40 are left"),
        ([7, 8], "is damaged: 6 rows up to step 30 are left"),
        ([10], None),  # after the checkpoint, as of a run that was killed
    ],
)
def test_rows_that_are_gone_are_told(tmp_path, lost, said):
    """Of one seed or of all, at either end and in the middle; chunks may be shorter at first."""
    path = tmp_path / "metrics.csv"
    path.write_text("".join(f"{line}\n" for k, line in enumerate(TWO_SEEDS) if k not in lost))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        log.truncate_rows(path, 40, LINES[0].split(","), 2, 10)
    assert [str(each.message).split("metrics.csv' ")[1].split(";")[0] for each in told] == ([said] if said else [])


@pytest.mark.parametrize(("rows", "told"), [(8, True), (10, False)])
def test_a_line_without_its_end_is_told_if_it_is_of_the_checkpoint(tmp_path, rows, told):
    """A kill tears the last line; the file is kept if that cost a row that will not be written again."""
    path = tmp_path / "metrics.csv"
    path.write_text("\n".join(TWO_SEEDS[: rows + 1])[:-1])
    with warnings.catch_warnings(record=True) as notices:
        warnings.simplefilter("always")
        log.truncate_rows(path, 40, LINES[0].split(","), 2, 10)
    assert len(read(path)) == (7 if told else 8)
    assert ["is damaged: 7 rows" in str(each.message) for each in notices] == [True] * told
    assert (tmp_path / "metrics.damaged.csv").exists() == told


def test_chunks_of_a_run_that_was_extended_may_be_shorter(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("".join(f"{line}\n" for line in [LINES[0], "0,5,1.5,9,3", "0,15,1.5,9,3", "0,25,1.5,9,3"]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log.truncate_rows(path, 25, LINES[0].split(","), 1, 10)


WHOLE = "".join(f"{line}\r\n" for line in LINES).encode()


def flipped_rows(tmp_path, place, bit):
    """What is left of the rows up to iteration 20 of a file with one flipped bit, and whether that was told."""
    path = tmp_path / "metrics.csv"
    path.write_bytes(WHOLE[:place] + bytes([WHOLE[place] ^ (1 << bit)]) + WHOLE[place + 1 :])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        log.truncate_rows(path, 20, LINES[0].split(","))
    return read(path), bool(told)


def test_a_flipped_bit_costs_its_own_line_at_most(tmp_path):
    """Any one of the file; two lines if it joins them. What is left is of numbers, and what is lost is told."""
    rows = [dict(zip(LINES[0].split(","), line.split(","), strict=True)) for line in LINES[1:3]]
    for place, bit in itertools.product(range(len(WHOLE)), range(8)):
        left, told = flipped_rows(tmp_path, place, bit)
        line = WHOLE[:place].count(b"\n")
        spoiled = {line, line + 1} if WHOLE[place] == ord("\n") else {line}
        assert all(row in left for k, row in enumerate(rows, 1) if k not in spoiled), (place, bit)
        assert all(float(value) >= 0 for row in left for value in row.values()), (place, bit)
        assert told or len(left) >= 2, (place, bit)


def test_a_damaged_first_line_is_replaced(tmp_path):
    """By the columns that the run writes; those of a file of another version stay."""
    path = tmp_path / "metrics.csv"
    path.write_bytes(WHOLE.replace(b"seconds,x", b"seconds.x"))
    with pytest.warns(Notice, match="is damaged: 2 rows up to step 20 are left"):
        assert log.truncate_rows(path, 20, LINES[0].split(",")) == (2.5, 9.0)
    assert read(path)[1] == {"seed": "0", "iteration": "20", "seconds": "2.5", "wall_seconds": "9", "x": "4"}
    path.write_bytes(WHOLE)
    assert log.truncate_rows(path, 30, [*LINES[0].split(","), "new"]) == (3.5, 9.0)
    assert path.read_bytes() == WHOLE


def test_rows_are_means_over_tasks_and_each_tasks_return():
    """A task without an episode is left empty, and left out of the mean; losses without tasks are as they are.

    Lost worlds are counted over all tasks.
    """
    metrics = {
        "return": np.array([[1.0, np.nan], [np.nan, np.nan]]),
        "loss": np.array([[1.0, 3.0], [5.0, 7.0]]),
        "cosine": np.array([0.25, 0.123456789]),
        "lost": np.array([[2, 1], [0, 0]]),
        "bad_step": np.array([[-1, -1], [-1, -1]]),
        "bad_reward": np.array([[-1, -1], [-1, -1]]),
    }
    rows = log.metric_rows(metrics, np.array([7, 8]), {"steps": 100})
    first = {"return": "1", "loss": "2", "cosine": "0.25", "lost": "3", "return_0": "1", "return_1": ""}
    second = {"return": "", "loss": "6", "cosine": "0.1234568", "lost": "0", "return_0": "", "return_1": ""}
    assert rows == [{"seed": 7, "steps": 100, **first}, {"seed": 8, "steps": 100, **second}]


@pytest.mark.parametrize(
    "given, text", [(np.float32(0.1), "0.1"), (np.nan, ""), (123456789.0, "1.234568e+08"), (np.inf, "inf")]
)
def test_numbers_have_seven_digits(given, text):
    """What is not a number is left empty; what is infinite is not."""
    assert log.number(given) == text


def test_rows_are_kept_as_they_were_given():
    given = [{"seed": s, "steps": 10, "tau": 0.5, "return": text} for s, text in enumerate(["", "1.5", 'x,"y"'])]
    rows = log.Rows()
    rows.extend(given[:1])
    rows.extend(given[1:])
    assert list(rows) == given and rows[-1] == given[-1] and rows[1:] == given[1:] and len(rows) == 3
