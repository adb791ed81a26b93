"""The replay by rows that say which task, environment and step they come from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax import replay as rings
from mtjax.types import Transition

TASKS, ENVS, CAPACITY = 3, 2, 8  # the ring holds four steps


def step_of_all(step):
    """Transitions (T, E, ...) of one step, in which every field names task, environment and step from 1."""
    task, env = np.meshgrid(np.arange(TASKS), np.arange(ENVS), indexing="ij")
    code = np.stack([task, env, np.full_like(task, step)], axis=-1).astype(np.float32)
    number = code @ np.float32([10_000, 100, 1])
    return Transition(code, -code[..., :2], number, code[..., 2] % 2, code + 0.5)


def filled(num_steps, capacity=CAPACITY):
    replay = rings.init(jax.tree.map(lambda x: jnp.asarray(x[0, 0]), step_of_all(0)), TASKS, capacity)
    for step in range(1, num_steps + 1):
        replay = rings.add(replay, step_of_all(step))
    return replay


def drawn(replay, number, seed=0):
    return jax.tree.map(np.asarray, rings.sample(replay, jax.random.key(seed), number))


def test_fields_of_a_row_belong_together():
    """Every field of a sampled row decodes to the same task, environment and step."""
    rows = drawn(filled(7), 500)
    np.testing.assert_array_equal(rows.action, -rows.obs[..., :2])
    np.testing.assert_array_equal(rows.reward, rows.obs @ np.float32([10_000, 100, 1]))
    np.testing.assert_array_equal(rows.discount, rows.obs[..., 2] % 2)
    np.testing.assert_array_equal(rows.next_obs, rows.obs + 0.5)


@pytest.mark.parametrize("num_steps", [1, 3, 4, 5, 8, 11])
def test_the_ring_holds_the_last_steps_of_each_task_and_nothing_else(num_steps):
    """Before, at and after wrapping around: no unwritten row, no forgotten row, and no row of another task."""
    steps = range(max(1, num_steps - CAPACITY // ENVS + 1), num_steps + 1)
    rows = drawn(filled(num_steps), 500)
    for task in range(TASKS):
        expected = {(task, env, step) for env in range(ENVS) for step in steps}
        assert {tuple(code) for code in rows.obs[task]} == expected


@pytest.mark.parametrize(("num_steps", "size", "position"), [(0, 0, 0), (3, 6, 6), (4, 8, 0), (9, 8, 2)])
def test_size_stops_at_the_capacity_and_position_wraps(num_steps, size, position):
    """Both count rows, of which a step writes one for each environment."""
    replay = filled(num_steps)
    assert (int(replay.size), int(replay.position), rings.capacity_of(replay)) == (size, position, CAPACITY)


@pytest.mark.parametrize("num_steps", [9, 30], ids=["part full", "full"])
def test_rows_are_drawn_uniformly(num_steps):
    """Chi-square over rows, whose mean is the degrees of freedom and whose variance is twice that."""
    draws = 20_000
    rows = drawn(filled(num_steps, capacity=20 * ENVS), draws)
    num_rows = min(num_steps, 20) * ENVS
    for task in range(TASKS):
        _, counts = np.unique(rows.reward[task], return_counts=True)
        chi_square = np.sum(np.square(counts - draws / num_rows)) / (draws / num_rows)
        assert len(counts) == num_rows
        assert abs(chi_square - (num_rows - 1)) < 4 * np.sqrt(2 * (num_rows - 1))


def test_tasks_draw_different_rows():
    """Tasks are not in step: one that draws a row does not make the others draw theirs of the same moment."""
    rows = drawn(filled(30, capacity=20 * ENVS), 2000)
    same = np.mean(np.all(rows.obs[0, :, 1:] == rows.obs[1, :, 1:], axis=-1))
    assert same < 3 / (20 * ENVS)


def test_a_key_decides_what_is_drawn():
    """The same key draws the same rows, and another key others."""
    replay = filled(7)
    np.testing.assert_array_equal(drawn(replay, 50).obs, drawn(replay, 50).obs)
    assert not np.array_equal(drawn(replay, 50).obs, drawn(replay, 50, seed=1).obs)


def test_a_capacity_that_splits_a_step_is_refused():
    """Else the last rows of the ring would be written out of place."""
    with pytest.raises(AssertionError, match="capacity 7 is not a multiple of 2 environments"):
        filled(1, capacity=7)
