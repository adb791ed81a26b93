"""Which values the parameters take in which task: combinations, splits and draws."""

import numpy as np
import pytest

from mtjax.envs.parameters import Parameter
from mtjax.envs.variation import scale, vary, write_values
from mtjax.types import InputError

PARAMETERS = {
    "a": Parameter("1", 1.0, minimum=0.0),
    "b": Parameter("1", 1.0, minimum=0.0),
    "c": Parameter("1", 0.0, minimum=-np.inf, maximum=2.5),
    "d": Parameter("1", 0.0, minimum=-1.0, maximum=2.0, names=("low", "mid", "high")),
}


def rows(given, combine="grid", num_tasks=5, split="dense", seed=0):
    found = vary(given, PARAMETERS, combine, num_tasks, split, 4, seed)
    return {name: x.tolist() for name, x in found.rows.items()}


def test_grid_combines_every_value_and_holds_out_cells_and_one_parameter_beyond():
    """Midpoints of cells are interpolation; beyond, one parameter leaves its range while the other stays mid-way."""
    found = rows({"a": "1:3:3", "b": "5,6"})
    assert found["train"] == [[1, 5], [1, 6], [2, 5], [2, 6], [3, 5], [3, 6]]
    assert found["interpolation"] == [[1.5, 5.5], [2.5, 5.5]]
    assert found["extrapolation"] == [[4, 5], [5, 5], [2, 3], [2, 4], [2, 7], [2, 8]]  # a = 0 and -1 are not allowed


def test_paired_values_go_together():
    """A line of tasks: held out are its midpoints and its continuation, where no parameter leaves what is allowed."""
    found = rows({"a": "4:6:3", "c": "0,1,2"}, "paired")
    assert found["train"] == [[4, 0], [5, 1], [6, 2]]
    assert found["interpolation"] == [[4.5, 0.5], [5.5, 1.5]]
    assert found["extrapolation"] == [[2, -2], [3, -1]]  # c = 3 and 4 exceed its maximum


def test_between_and_beyond_names_there_is_nothing():
    """Held-out tasks have the named values of training, or, beyond another parameter's end, the middle one."""
    found = rows({"a": "2,3", "d": "low,high"})
    assert found["train"] == [[2, 0], [2, 2], [3, 0], [3, 2]]
    assert found["interpolation"] == [[2.5, 0], [2.5, 2]] and found["extrapolation"] == [[1, 0], [4, 0], [5, 0]]
    for given, combine in (({"d": "0:2:3"}, "grid"), ({"a": "2,3", "d": "0,1"}, "paired")):
        assert [len(x) for x in rows(given, combine).values()] == [3 if combine == "grid" else 2, 0, 0]
    assert rows({"a": "2,3", "d": "high"}, "paired")["interpolation"] == [[2.5, 2]]
    for text in ("0:2", "0,0.5", "low:high"):
        with pytest.raises(InputError, match=r"d is one of 0 \(low\), 1 \(mid\), 2 \(high\); .*low,mid; not"):
            rows({"d": text})
    with pytest.raises(InputError, match="combine=random draws between values, and d has names"):
        rows({"a": "2,3", "d": "0,1"}, "random")


def test_a_single_value_pairs_with_any_number():
    assert rows({"a": "4,5", "b": "7"}, "paired")["train"] == [[4, 7], [5, 7]]


def test_random_tasks_fill_the_ranges_and_follow_their_seed():
    """Draws lie in the ranges; held-out draws inside, or with exactly one parameter beyond by at most a fifth."""
    given = {"a": "1:3", "b": "10,20"}
    found = rows(given, "random", num_tasks=50)
    train, inside, beyond = (np.array(found[s]) for s in ("train", "interpolation", "extrapolation"))
    low, high = np.array([1, 10]), np.array([3, 20])
    assert train.shape == (50, 2) and inside.shape == (10, 2) and beyond.shape == (10, 2)
    assert np.all((train >= low) & (train <= high)) and np.all((inside >= low) & (inside <= high))
    assert np.all(np.sum((beyond < low) | (beyond > high), axis=1) == 1)
    margin = 0.2 * (high - low)
    assert np.all((beyond >= low - margin) & (beyond <= high + margin))
    assert np.ptp(train, axis=0) == pytest.approx(high - low, rel=0.2)
    assert rows(given, "random", num_tasks=50) == found != rows(given, "random", num_tasks=50, seed=1)


def test_random_ranges_are_of_fixed_tasks_not_of_episodes():
    found = vary({"a": "1:3"}, PARAMETERS, "random", 3, "none", 4, 0)
    assert found.draws is None and len(found.rows["train"]) == 3 and found.redrawn == ()
    assert (found.low, found.high) == (1, 3)


def test_nothing_varies_in_a_family_without_parameters():
    found = vary({}, PARAMETERS, "grid", 5, "dense", 4, 0)
    assert found.rows["train"].shape == (1, 0) and found.varied == ()


def test_split_none_holds_nothing_out():
    found = rows({"c": "-1,1"}, split="none")
    assert found == {"train": [[-1], [1]], "interpolation": [], "extrapolation": []}


@pytest.mark.parametrize(
    ("given", "combine", "split", "message"),
    [
        ({"a": "1,2", "b": "1,2,3"}, "paired", "dense", r"as many values of each parameter, not \[2, 3\]"),
        ({"a": "1,2,1"}, "paired", "dense", "two tasks have the same values"),
        ({"a": "1,1.00000000001"}, "grid", "dense", "two tasks have the same values"),
        ({"c": "2,3"}, "grid", "dense", "c must be greater than -inf and at most 2.5, not 3"),
        ({"a": "1:2"}, "random", "hip-bmdp", "combine=random"),
        ({"a": ""}, "grid", "dense", "a has no values; give lo:hi:n"),
    ],
)
def test_what_does_not_fit_is_refused(given, combine, split, message):
    with pytest.raises(InputError, match=message):
        rows(given, combine, split=split)


def test_scale_maps_the_training_range_to_one():
    """A column that does not vary is 0."""
    low, high = np.array([1.0, 4.0]), np.array([3.0, 4.0])
    np.testing.assert_allclose(
        scale(np.array([[1.0, 4.0], [2.5, 4.0], [4.0, 4.0]]), low, high), [[-1, 0], [0.5, 0], [2, 0]]
    )


def test_values_are_spelled_as_on_the_command_line():
    assert [write_values(x) for x in (2, [1, 0.5], np.array([0.1]), "1:2:3")] == ["2.0", "1.0,0.5", "0.1", "1:2:3"]
