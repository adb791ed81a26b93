"""Curricula: which of the known tasks are played, and what that leaves of the others."""

import csv
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, Walk, configure, param, tiny

import mtjax
from mtjax.agents.networks import Params
from mtjax.agents.state import of_tasks, with_tasks
from mtjax.learning import combinations, curricula, loop
from mtjax.learning.loop import Settings
from mtjax.types import InputError

SMALL = {"num_envs": 2, "chunk_steps": 8, "stagger": False}
REPLAY = {"batch_size": 4, "replay_size": 64, "warmup_steps": 1}
ROLLOUTS = {"unroll": 8, "epochs": 1, "minibatches": 1}


def played(agent, curriculum, chunks, tasks=None, **settings):
    """The states after each of some chunks on the tasks of a walk, and the metrics of each."""
    env, given = Walk(), {**SMALL, **settings}
    agent, chosen = configure(agent, Settings(curriculum=curriculum), given)
    tasks = env.tasks() if tasks is None else tasks
    state = loop.init.lower(env, agent, chosen, tasks, jnp.arange(2)).compile(QUICK)(tasks, jnp.arange(2))
    chunk = loop.run_chunk.lower(env, agent, chosen, tasks, state).compile(QUICK)
    states, metrics = [jax.device_get(state)], []
    for _ in range(chunks):
        state, one = chunk(tasks, state)
        states, metrics = [*states, jax.device_get(state)], [*metrics, jax.device_get(one)]
    return states, metrics


def test_a_sequence_plays_every_task_in_turn_and_begins_again():
    rows = [int(curricula.read("sequence:10").rows(jnp.int32(step), 3)[0]) for step in (0, 9, 10, 29, 30)]
    assert rows == [0, 0, 1, 2, 0]


def test_a_shuffled_sequence_plays_every_task_once_in_each_round():
    """For ten steps each, in another order in every round."""
    curriculum = curricula.read("shuffled:10")
    rows = np.array([int(curriculum.rows(jnp.int32(step), 5)[0]) for step in range(0, 200, 5)]).reshape(4, 5, 2)
    np.testing.assert_array_equal(rows[..., 0], rows[..., 1])
    assert all(sorted(each) == list(range(5)) for each in rows[..., 0].tolist())
    assert len(set(map(tuple, rows[..., 0].tolist()))) > 1 and isinstance(curriculum, curricula.Sequence)


def test_a_random_choice_repeats_no_task_and_changes():
    drawn = [np.asarray(curricula.read("random:3:1").rows(jnp.int32(step), 10)) for step in range(200)]
    assert all(len(set(rows.tolist())) == 3 for rows in drawn)
    counts = np.bincount(np.concatenate(drawn), minlength=10)
    assert counts.sum() == 600 and np.all(np.abs(counts - 60) < 30)


@pytest.mark.parametrize("text", ["random:3:1", "hardest:3:1", "progress:3:1", "growing:3:1:1000"])
def test_a_choice_is_in_the_order_of_the_table(text):
    """So the same tasks are the same rows: all three of three, and the middle three of five that never grow."""
    curriculum, known = curricula.read(text), 5 if text.startswith("growing") else 3
    choose = lambda step: np.asarray(curriculum.rows(jnp.int32(step), known)).tolist()
    assert {tuple(choose(step)) for step in range(20)} == {(1, 2, 3) if known == 5 else (0, 1, 2)}


def heard_of(*fast, slow=None):
    """What was heard of tasks by their fast means; None of one that was never played."""
    fast = np.array([np.nan if x is None else x for x in fast], np.float32)
    return jnp.stack([fast, fast if slow is None else jnp.float32(slow)], axis=1)


@pytest.mark.parametrize(
    ("name", "heard", "chosen"),
    [
        ("hardest", heard_of(5.0, -1.0, 3.0, 9.0), {1, 2}),
        ("hardest", heard_of(5.0, -1.0, 3.0, None), {1, 3}),
        ("progress", heard_of(5.0, 1.0, 3.0, 9.0, slow=[5.0, 4.0, 2.0, 9.0]), {1, 2}),
        ("progress", heard_of(5.0, None, 3.0, 9.0, slow=[4.0, 0.0, 3.0, 5.0]), {1, 3}),
    ],
)
def test_tasks_are_chosen_by_what_was_heard_of_them(name, heard, chosen, monkeypatch):
    """The least returns, or those that change most, down too; before them tasks that were never played."""
    curriculum = curricula.read(f"{name}:2:10")
    drawn = [set(np.asarray(curriculum.choose(jnp.int32(step), heard)).tolist()) for step in range(0, 3000, 10)]
    share = np.mean([one == chosen for one in drawn])
    assert 0.8 < share < 0.97 and {row for one in drawn for row in one} == {0, 1, 2, 3}  # a tenth is random
    monkeypatch.setattr(curricula, "_RANDOM", 0.0)
    assert set(np.asarray(curriculum.choose(jnp.int32(0), heard)).tolist()) == chosen


def test_a_range_of_tasks_grows_where_its_ends_return_enough():
    """From the middle, to both sides, up to the ends of the table; both ends are always played."""
    curriculum = curricula.read("growing:3:10:6.5")
    rows = lambda *heard, step=0: sorted(np.asarray(curriculum.choose(jnp.int32(step), heard_of(*heard))).tolist())
    assert sorted(np.asarray(curriculum.rows(jnp.int32(0), 7)).tolist()) == rows(*[None] * 7) == [2, 3, 4]
    assert rows(None, None, 6, 9, 6, None, None) == [2, 3, 4]
    low, middle, high = rows(None, None, 7, 9, 6, None, None)
    assert (low, high) == (1, 4) and middle in (2, 3)
    low, middle, high = rows(None, 2, 7, 9, 6.5, None, None)
    assert (low, high) == (1, 5) and middle in (2, 3, 4)
    found = [rows(7, 7, 7, 7, 7, 7, 7, step=step) for step in range(0, 1000, 10)]
    assert {(row[0], row[2]) for row in found} == {(0, 6)} and {row[1] for row in found} == {1, 2, 3, 4, 5}


def test_what_is_heard_are_means_over_seeds_and_chunks():
    """A first return counts whole; a task without an episode keeps what was heard; so do those that were not played."""
    returns = jnp.array([[2.0, jnp.nan, 8.0], [4.0, jnp.nan, jnp.nan]])
    first = curricula.hear(curricula.Hardest(1, 16).heard(5), jnp.array([4, 0, 1]), returns)
    expected = np.full((5, 2), np.nan)
    expected[4], expected[1] = 3, 8
    np.testing.assert_array_equal(first, expected)
    second = curricula.hear(first, jnp.array([4, 1]), jnp.array([[5.0, jnp.nan]]))
    np.testing.assert_allclose(second[4], [4.0, 3.2], rtol=1e-6)
    np.testing.assert_array_equal(second[1], [8, 8])


@pytest.mark.slow
def test_a_curriculum_hears_of_the_tasks_that_it_plays_and_changes_only_when_it_is_due():
    """Of the second of two tasks alone an episode's return is negative, so it is played on as the hardest."""
    tasks = jax.tree.map(lambda x: jnp.stack([x[0], x[0], x[0]]), Walk().tasks())
    tasks = tasks._replace(id=jnp.arange(3), goal={"scale": jnp.array([1.0, -1.0, 1.0])})
    states, metrics = played(tiny("multi-head"), "hardest:1:16", 8, tasks, **REPLAY)
    rows = [int(state.rows[0]) for state in states[1:]]
    assert rows[::2] == rows[1::2] and set(rows) == {0, 1, 2} and rows[-1] == 1
    heard = curricula.Hardest(1, 16).heard(3)
    for row, one in zip(rows, metrics, strict=True):
        heard = curricula.hear(heard, jnp.array([row]), one["return"][:, [row]])
    np.testing.assert_allclose(states[-1].heard, heard, rtol=1e-6)


def test_own_parameters_are_taken_by_number_and_put_back():
    """Also those that optimisers keep; what tasks share is that of the played ones."""
    net = Params({"w": jnp.zeros(2)}, {"h": jnp.arange(3.0)})
    tree, rows = {"net": net, "adam": (jnp.int32(1), {"net": net})}, jnp.int32([2, 0])
    part = of_tasks(tree, rows)
    np.testing.assert_array_equal(part["adam"][1]["net"].own["h"], [2, 0])
    moved = jax.tree.map(lambda x: x + 10, part)
    after = with_tasks(tree, moved, rows)
    np.testing.assert_array_equal(after["net"].own["h"], [10, 1, 12])
    np.testing.assert_array_equal(after["net"].shared["w"], [10, 10])
    assert after["adam"][0] == 11


@pytest.mark.slow
def test_a_state_of_other_tasks_knows_these_alone():
    """Also where they are more than the training tasks: each has what its nearest one has for itself."""
    train = Walk().tasks()
    agent = tiny("multi-head")
    state = agent.init(Walk().spec, train, jax.random.key(0))
    wide = jax.tree.map(lambda x: jnp.stack([x[1], x[0], x[1], x[0], x[1]]), train)._replace(id=jnp.arange(5) + 100)
    found = state.of_tasks(wide)
    assert found.num_tasks == 5
    numbered = wide._replace(id=jnp.arange(5))
    np.testing.assert_array_equal(jax.vmap(found.known)(numbered), np.arange(5))
    head = lambda state: state.nets["actor"].own["head"]["kernel"]
    np.testing.assert_array_equal(head(found), head(state)[np.asarray([1, 0, 1, 0, 1])])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, given", [("multi-head", REPLAY), param(("disjoint", REPLAY), slow=True), param(("ppo", ROLLOUTS), slow=True)]
)
def test_tasks_that_are_not_played_keep_what_is_their_own(name, given):
    """To the bit, while the one that is played learns."""
    agent = tiny(name, **({"heads": "per-task"} if name == "ppo" else {}))
    tasks = jax.tree.map(lambda x: jnp.stack([x[0], x[1], x[0]]), Walk().tasks())._replace(id=jnp.arange(3))
    (start, first, second), metrics = played(agent, "sequence:8", 2, tasks, **given)
    head = lambda state: state.agent.nets["critic"].own["head"]["kernel"]  # (S, T, ...) or (S, T, N, ...)
    for before, after, row in ((start, first, 0), (first, second, 1)):
        for task in range(3):
            same = np.array_equal(head(before)[:, task], head(after)[:, task])
            assert same == (task != row)
    assert first.worlds.age.shape == (2, 1, 2) and second.rows.tolist() == [1]
    assert np.isnan(metrics[0]["return"][:, 1:]).all() and metrics[0]["episodes"].shape == (2, 3)
    assert np.all(metrics[1]["episodes"][:, [0, 2]] == 0) and np.all(metrics[1]["bad_step"] == -1)


@pytest.mark.slow
def test_a_choice_of_all_tasks_learns_the_same_as_all(monkeypatch):
    """Own parameters are gathered, learn, and are put back."""
    monkeypatch.setattr(curricula.Random, "rows", lambda self, step, known: jnp.arange(known))
    agent = tiny("ppo", heads="per-task")
    (_, plain), of_plain = played(agent, "all", 1, **ROLLOUTS)
    (_, found), of_found = played(agent, "random:2:8", 1, **ROLLOUTS)
    jax.tree.map(np.testing.assert_array_equal, plain.agent, found.agent)
    jax.tree.map(np.testing.assert_array_equal, of_plain, of_found)


def whole_and_resumed(env, place, steps, cut, **given):
    """The results of a run of so many steps, and of one that is cut and goes on."""
    given |= {"num_envs": 2, "unroll": 10, "minibatches": 1, "epochs": 1, "eval_episodes": 1, "hidden": (8,)}
    train = partial(mtjax.train, env, "ppo", quiet=True, **given)
    whole = train(steps=steps, directory=place / "whole")
    train(steps=cut, directory=place / "cut")
    return whole, train(steps=steps, directory=place / "cut", resume=True)


def require_same(one, other):
    """Every leaf is the same to the bit."""
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(one), jax.device_get(other))


@pytest.mark.slow
def test_a_run_by_a_sequence_is_recorded_by_known_tasks_and_resumes_to_the_bit(tmp_path):
    """A task without episodes has an empty column; the state of a resumed run is that of one without a stop."""
    given = {"chunk_steps": 150, "curriculum": "sequence:150", "eval_every": 600, "num_tasks": 3}
    whole, again = whole_and_resumed("bandit", tmp_path, 1200, 600, **given)
    require_same(whole.state.agent, again.state.agent)
    with (tmp_path / "whole" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [[bool(row[f"return_{k}"]) for k in range(3)] for row in rows[:3]] == np.eye(3, dtype=bool).tolist()
    assert whole.evaluations.returns["train"].shape[2] == 3


@pytest.mark.slow
def test_a_run_that_heeds_returns_resumes_to_the_bit(tmp_path):
    """What was heard is in its checkpoints."""
    given = {"chunk_steps": 100, "curriculum": "progress:2:100", "eval_every": 1200, "num_tasks": 5}
    whole, again = whole_and_resumed("bandit", tmp_path, 2400, 1200, **given)
    for name in ("agent", "heard", "rows", "begun"):
        require_same(getattr(whole.state, name), getattr(again.state, name))
    assert np.isfinite(whole.state.heard).all()


@pytest.mark.parametrize(
    "agent, given, said",
    [
        ("ppo", {"curriculum": "some"}, "curriculum is all, random:T:STEPS"),
        ("ppo", {"curriculum": "random:0:50"}, "curriculum is all, random:T:STEPS"),
        ("ppo", {"curriculum": "random:4:50"}, "plays 1 to 3 of the 3 training tasks"),
        ("ppo", {"curriculum": "growing:1:50:3"}, "plays both ends of a range"),
        ("ppo", {"curriculum": "growing:2:50"}, "growing:T:STEPS:RETURN"),
        ("ppo", {"curriculum": "hardest:2:50:1"}, "hardest:T:STEPS"),
        ("ppo", {"curriculum": "sequence:60", "unroll": 50}, "give a multiple of chunk_steps=50"),
        ("famo", {"curriculum": "sequence:50"}, "without memory of the tasks"),
        ("maml", {"curriculum": "sequence:100", "unroll": 25}, "adapts to all that it knows"),
    ],
)
def test_what_cannot_be_played_is_refused(agent, given, said):
    env = mtjax.make("bandit", num_tasks=3, scores=True)
    with pytest.raises(InputError, match=said):
        mtjax.train(env, agent, steps=600, **{"num_envs": 2, "chunk_steps": 50, "quiet": True, **given})


@pytest.mark.slow
def test_a_replay_begins_anew_with_random_steps_where_tasks_change_unless_it_is_kept():
    """Of three chunks of eight steps each, in which the first three steps are random and nothing is learned."""
    blind = {**REPLAY, "warmup_steps": 3}
    states, _ = played(tiny("sac"), "sequence:8", 2, **blind)
    assert [int(state.data.ring.size) for state in states] == [0, 8, 8]
    kept, _ = played(tiny("sac"), "sequence:8", 2, keep_replay=True, **blind)
    assert [int(state.data.ring.size) for state in kept] == [0, 8, 16]
    jax.tree.map(np.testing.assert_array_equal, states[1].agent, kept[1].agent)
    updates = lambda state: int(np.max(state.agent.fits["critic"].optimizer[1][0].count))
    assert [updates(state) for state in states] == [0, 5, 10]
    assert [updates(state) for state in kept] == [0, 5, 13]


@pytest.mark.slow
def test_the_same_tasks_go_on_without_a_new_beginning():
    """A choice that names the same tasks keeps worlds and replay, and no action is random a second time."""
    tasks = jax.tree.map(lambda x: jnp.stack([x[0], x[1], x[0]]), Walk().tasks())._replace(id=jnp.arange(3))
    states, _ = played(tiny("sac-conditioned"), "growing:3:8:1000000", 3, tasks, **{**REPLAY, "warmup_steps": 3})
    assert [int(state.data.ring.size) for state in states] == [0, 8, 16, 24]
    assert [int(np.max(state.agent.fits["critic"].optimizer[1][0].count)) for state in states] == [0, 5, 13, 21]
    assert all(int(state.begun) == 0 for state in states)


@pytest.mark.slow
def test_random_steps_follow_where_experience_begins_anew():
    """Of a random task of three at a time: after the same one again none, after another one as many as at first."""
    tasks = jax.tree.map(lambda x: jnp.stack([x[0], x[1], x[0]]), Walk().tasks())._replace(id=jnp.arange(3))
    states, _ = played(tiny("sac"), "random:1:8", 6, tasks, **{**REPLAY, "warmup_steps": 3})
    rows = [int(state.rows[0]) for state in states[1:]]
    fresh = [True, *(one != other for one, other in itertools.pairwise(rows))]
    assert True in fresh[1:] and False in fresh
    begun = np.maximum.accumulate(8 * np.arange(6) * fresh)
    assert [int(state.begun) for state in states[1:]] == begun.tolist()
    assert [int(state.data.ring.size) for state in states[1:]] == (8 * np.arange(1, 7) - begun).tolist()
    count = [int(np.max(state.agent.fits["critic"].optimizer[1][0].count)) for state in states]
    assert np.diff(count).tolist() == [5 if one else 8 for one in fresh]


@pytest.mark.slow
def test_tasks_from_scratch_begin_a_new_agent_where_a_task_ends():
    """As an optimiser's count of updates shows: none is of an earlier task, of which one step is not learned from."""
    states, _ = played(tiny("sac", continual="scratch"), "sequence:8", 2, **REPLAY)
    assert [int(np.max(state.agent.fits["critic"].optimizer[1][0].count)) for state in states] == [0, 7, 7]


@pytest.mark.slow
def test_a_mixtures_tasks_are_played_in_turn_and_a_run_resumes_to_the_bit(tmp_path):
    env = mtjax.mixture([mtjax.make("bandit", num_tasks=2), mtjax.make("two-goal-maze")])
    given = {"chunk_steps": 150, "curriculum": "sequence:150", "eval_every": 600}
    whole, again = whole_and_resumed(env, tmp_path, 900, 600, **given)
    require_same(whole.state.agent, again.state.agent)
    assert [[bool(row[f"return_{k}"]) for k in range(3)] for row in whole.rows[:3]] == np.eye(3, dtype=bool).tolist()


@pytest.mark.parametrize(
    "agent, given",
    [
        ("sac-conditioned", {"curriculum": "sequence:8"}),
        ("sac", {"curriculum": "sequence:8", "n_step": 2, "warmup_steps": 2}),
        ("sac", {"curriculum": "all"}),
        ("ppo", {"curriculum": "sequence:8"}),
    ],
)
def test_steps_of_several_tasks_that_an_agent_would_confuse_are_not_kept(agent, given):
    agent, chosen = configure(tiny(agent), Settings(), {**SMALL, "keep_replay": True, **given})
    with pytest.raises(InputError, match="--keep-replay"):
        combinations.require_agent(chosen, agent)
