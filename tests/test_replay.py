"""The replay by rows that say which task, environment and step they come from."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mtjax.experience import ring as rings
from mtjax.types import Transition

TASKS, ENVS, SLOTS = 3, 2, 4


def step_of_all(step):
    """Transitions (T, E, ...) of one step, in which every field names task, environment and step from 1."""
    task, env = np.meshgrid(np.arange(TASKS), np.arange(ENVS), indexing="ij")
    code = np.stack([task, env, np.full_like(task, step)], axis=-1).astype(np.float32)
    number = code @ np.float32([10_000, 100, 1])
    return Transition(code, -code[..., :2], number, code[..., 2] % 2, code + 0.5)


def filled(num_steps, num_slots=SLOTS):
    replay = rings.init(jax.tree.map(lambda x: jnp.asarray(x[0, 0]), step_of_all(0)), TASKS, num_slots, ENVS)
    for step in range(1, num_steps + 1):
        replay = rings.add(replay, jax.tree.map(lambda x: x[:, None], step_of_all(step)))
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
    steps = range(max(1, num_steps - SLOTS + 1), num_steps + 1)
    rows = drawn(filled(num_steps), 500)
    for task in range(TASKS):
        expected = {(task, env, step) for env in range(ENVS) for step in steps}
        assert {tuple(code) for code in rows.obs[task]} == expected


@pytest.mark.parametrize(("num_steps", "size", "position"), [(0, 0, 0), (3, 3, 3), (4, 4, 0), (9, 4, 1)])
def test_size_stops_at_the_last_slot_and_position_wraps(num_steps, size, position):
    """Both count slots, of which a step of all environments fills one."""
    replay = filled(num_steps)
    assert (int(replay.size), int(replay.position)) == (size, position)
    assert replay.rows.obs.shape == (TASKS, SLOTS, ENVS, 3) and replay.rows.reward.shape == (TASKS, SLOTS, ENVS)


@pytest.mark.parametrize("num_steps", [9, 30], ids=["part full", "full"])
def test_rows_are_drawn_uniformly(num_steps):
    """Chi-square over rows, whose mean is the degrees of freedom and whose variance is twice that."""
    draws = 20_000
    rows = drawn(filled(num_steps, num_slots=20), draws)
    num_rows = min(num_steps, 20) * ENVS
    for task in range(TASKS):
        _, counts = np.unique(rows.reward[task], return_counts=True)
        chi_square = np.sum(np.square(counts - draws / num_rows)) / (draws / num_rows)
        assert len(counts) == num_rows
        assert abs(chi_square - (num_rows - 1)) < 4 * np.sqrt(2 * (num_rows - 1))


def test_tasks_draw_different_rows():
    """Tasks are not in step: one that draws a row does not make the others draw theirs of the same moment."""
    rows = drawn(filled(30, num_slots=20), 2000)
    same = np.mean(np.all(rows.obs[0, :, 1:] == rows.obs[1, :, 1:], axis=-1))
    assert same < 3 / (20 * ENVS)


def test_a_key_decides_what_is_drawn():
    """The same key draws the same rows, and another key others."""
    replay = filled(7)
    np.testing.assert_array_equal(drawn(replay, 50).obs, drawn(replay, 50).obs)
    assert not np.array_equal(drawn(replay, 50).obs, drawn(replay, 50, seed=1).obs)


def test_each_row_may_be_drawn_from_a_ring_of_its_own():
    """By the number of the ring, in whatever shape these are given."""
    ring = np.arange(600).reshape(2, 300) % TASKS
    rows = jax.tree.map(np.asarray, rings.sample_from(filled(7), jax.random.key(0), jnp.asarray(ring)))
    np.testing.assert_array_equal(rows.obs[..., 0], ring)
    np.testing.assert_array_equal(rows.reward, rows.obs @ np.float32([10_000, 100, 1]))
    assert len(np.unique(rows.reward)) == TASKS * SLOTS * ENVS
