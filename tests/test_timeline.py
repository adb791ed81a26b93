"""Timelines of sub-policies: which symbol or option acts in each step, the strips of films, and the figure."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from probes import QUICK, pick, tiny

import mtjax
from mtjax.agents import for_action
from mtjax.envs.craft.sketched import due, due_in
from mtjax.report import films, render, timeline
from mtjax.report.timeline import Timeline, colours, spans, strips
from mtjax.saved.policy import Policy


def test_symbols_are_those_that_were_due_before_each_step():
    """Of the first step the sketch's first one, and after the last one none, as worlds themselves say."""
    env = mtjax.make("craft-sketched")
    task = pick(env.tasks("all"), 3)
    length, row = int(task.goal["length"]), int(task.row)
    after = np.array([[0, 0, 1, 1, *range(2, length + 1), length]])
    before = [0, *after[0, :-1]]
    expected = [int(due(task, jnp.int32(place))) for place in before]
    assert due_in(env, [row], after).tolist() == [expected]
    names = env.sketches[env.name_of(row)]
    assert env.symbols[expected[0]] == names[0] and expected[-1] == -1


def test_spans_are_stretches_of_one_number():
    assert spans(np.array([2, 2, -1, 0, 0, 0])) == [(0, 2, 2), (2, 1, -1), (3, 3, 0)]


@pytest.mark.parametrize("count", [1, 8, 18])
def test_names_have_colours_of_their_own(count):
    assert len({*colours(count), timeline._GREY}) == count + 1


def test_a_strip_shows_the_whole_episode_and_where_it_is():
    """Four steps of ten pixels: two of one, one of none, one of another; a white mark, and the name."""
    acting = Timeline(("a", "b"), np.array([[0, 0, -1, 1, 0, 0]]), np.array([[4]]))
    found = strips(acting, 0, [0, 3, 3], 40)
    assert found.shape[0] == 3 and found.shape[2:] == (40, 3)
    first, second = colours(2)
    middles = [tuple(found[0, 4, x].tolist()) for x in (8, 15, 25, 35)]
    assert middles == [first, first, timeline._GREY, second]
    white = [np.flatnonzero((row[0] == 255).all(axis=-1)).tolist() for row in found]
    assert white == [[4, 5, 6], [34, 35, 36], [34, 35, 36]]
    line = found.shape[1] // 2
    assert [tuple(picture[line + line // 2, 5].tolist()) for picture in found] == [first, second, second]
    assert all((picture[line:, line + 3 :] > 200).any() for picture in found)  # the name


def test_a_strip_of_a_later_episode_begins_where_that_does():
    """The second episode of a trial is the last two steps, in both of which the second one acts."""
    acting = Timeline(("a", "b"), np.array([[0, 0, 0, 1, 1]]), np.array([[3, 2]]))
    found = strips(acting, 0, [0], 40, 1)
    assert {tuple(found[0, 4, x].tolist()) for x in (5, 25, 35)} == {colours(2)[1]}


CASES = {
    "sketches": ("craft-sketched", {}, "get-wood"),
    "options": ("craft", {"num_options": 3}, "option 0"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_film_of_sub_policies_has_strips_and_a_figure(name, tmp_path, monkeypatch):
    """Of worlds in which they act; others have none."""
    world, settings, known = CASES[name]
    env = mtjax.make(world, vary={"goal": "plank,stick"}, split="none")
    agent = for_action(tiny(name, **settings), env.spec.action)
    tasks = env.tasks("all")
    init = lambda key: agent.init(env.spec, env.tasks("train"), key)
    state = jax.jit(init, compiler_options=QUICK)(jax.random.key(0))
    states = jax.tree.map(lambda x: x[None], state)
    policy, seen = Policy(env, agent, state, states, jnp.zeros(1, jnp.int32)), {}
    monkeypatch.setattr(render, "choose_backend", lambda: None)
    blank = lambda family, row, shown, width, height: np.zeros((len(shown.place), height, width, 3), np.uint8)
    monkeypatch.setattr(render, "film", blank)
    monkeypatch.setattr(render, "write_video", lambda stem, frames, fps: seen.update(frames=frames) or stem)
    monkeypatch.setattr(timeline, "draw", lambda path, acting, labels: seen.update(acting=acting, labels=labels))
    chosen = films.choose(env, ["train"], [0, 1])
    films.write(policy, tasks, chosen, 1.0, 0, tmp_path / "film", {})
    acting = seen["acting"]
    assert known in acting.names and seen["labels"] == ["plank", "stick"]
    assert acting.acting.shape == (2, env.episode_length) and np.all(acting.acting[:, 0] >= 0)
    rows = [row[: lengths.sum()] for row, lengths in zip(acting.acting, acting.lengths, strict=True)]
    played = {number for row in rows for number in row}
    drawn = {tuple(x) for x in seen["frames"].reshape(-1, 3).tolist()}
    assert {colours(len(acting.names))[number] for number in played} <= drawn


def test_the_figure_has_a_row_for_each_task(tmp_path):
    acting = Timeline(("a", "b"), np.array([[0, 1, 1], [1, -1, 0]]), np.array([[3], [2]]))
    timeline.draw(tmp_path / "t.png", acting, ["first", "second"])
    drawn = np.asarray(Image.open(tmp_path / "t.png").convert("RGB")).reshape(-1, 3)
    wide = {colour: int((np.abs(drawn.astype(int) - colour).max(axis=1) <= 2).sum()) for colour in colours(2)}
    assert wide[colours(2)[1]] > 2 * wide[colours(2)[0]] > 0
