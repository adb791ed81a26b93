"""Trials: when worlds, tasks, memories and sums of rewards begin anew."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import SPEC, Goals, Stub, Walk, one_in, slow_but, tiny, train
from test_loop import Drifting

import mtjax
from mtjax.agents.parts import targets
from mtjax.envs.mtenv.tabular import TabularMDP
from mtjax.experience import multistep
from mtjax.learning import loop
from mtjax.learning.evaluation import (
    Episodes,
    Evaluations,
    evaluate,
    load_evaluations,
    no_evaluations,
    require_same_run,
)
from mtjax.learning.trials import EachEpisode, Repeated, ResetFree
from mtjax.report.tables import split_table
from mtjax.types import Acted, InputError, Transition

STEPS, ENVS, K = 60, 6, 3
SETTINGS = {"num_envs": ENVS, "replay_size": STEPS * ENVS, "chunk_steps": STEPS, "updates_per_step": 0, "trials": K}


# What ends when.


def test_each_episode_is_a_trial_that_a_limit_cuts_off_and_a_terminal_state_ends():
    """Of a lost world nothing is terminal either."""
    terminated, timeout, lost = (jnp.array(x) for x in ([0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]))
    ends = EachEpisode().ends(terminated > 0, timeout > 0, lost > 0, None)
    for found in (ends.episode, ends.trial, ends.cut, ends.world):
        np.testing.assert_array_equal(found, [0, 1, 1, 1])
    np.testing.assert_array_equal(ends.terminal, [0, 1, 0, 0])


def test_a_repeated_trial_ends_with_its_last_episode_and_is_terminal_where_that_is():
    """Inside the trial no end is terminal for the learner, and at its end no limit is. A limit cuts sums everywhere."""
    terminated = jnp.array([0, 1, 0, 0, 0, 1, 0, 0]) > 0
    timeout = jnp.array([0, 0, 1, 0, 0, 0, 1, 0]) > 0
    lost = jnp.array([0, 0, 0, 1, 0, 0, 0, 1]) > 0
    ends = Repeated(3).ends(terminated, timeout, lost, jnp.array([1] * 4 + [2] * 4))
    np.testing.assert_array_equal(ends.episode, [0, 1, 1, 1, 0, 1, 1, 1])
    np.testing.assert_array_equal(ends.world, ends.episode)
    np.testing.assert_array_equal(ends.trial, [0, 0, 0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(ends.terminal, [0, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_array_equal(ends.cut, [0, 0, 1, 1, 0, 1, 1, 1])


def test_a_reset_free_world_goes_on_unless_it_is_lost():
    """And no limit is terminal."""
    timeout, lost = jnp.array([False, True, False]), jnp.array([False, False, True])
    ends = ResetFree().ends(lost & False, timeout, lost, None)
    np.testing.assert_array_equal(ends.trial, [0, 1, 1])
    np.testing.assert_array_equal(ends.world, [0, 0, 1])
    assert not ends.terminal.any()


@pytest.mark.parametrize("count", [1, 0, 10**9])
def test_a_repeated_trial_has_several_episodes(count):
    """One is the other kind."""
    with pytest.raises(InputError, match=f"not {count}"):
        Repeated(count)


# A hand-made world.


class Counting(Stub):
    """Remembers how many steps and ends of episodes it has seen, and what the task was; acts by the first two."""

    def begin(self, state, task):
        return jnp.zeros(2)

    def act(self, state, memory, obs, task, key):
        return Acted(jnp.sum(memory * jnp.array([1.0, 100.0]))[None])

    def remember(self, state, memory, transition, task):
        return memory + jnp.stack([1.0, jnp.float32(transition.ended)])


@dataclasses.dataclass(frozen=True)
class Finite(Drifting):
    """The same, with five steps an episode by its rules."""

    finite_horizon = True


def play(env, seeds=(0,), chunks=1, **given):
    """The steps (S, T, E, H, ...) of a run without random actions, as its replay holds them, and its last state."""
    state, history = train(env, Counting(), {"warmup_steps": 1, **SETTINGS, **given}, seeds=seeds, chunks=chunks)
    return jax.tree.map(lambda x: np.moveaxis(np.asarray(x), 2, 3), state.data.ring.rows), state, history


@pytest.fixture(scope="module")
def drifting():
    """Steps of walks that end early or not, and draw a task for every trial of three episodes."""
    return play(Drifting())


def episodes_of(rows):
    """The number (S, T, E, H) of the episode that each step belongs to, counted in each world from 0."""
    return np.cumsum(rows.ended, axis=3) - rows.ended


@pytest.mark.slow
def test_a_trial_closes_with_every_third_episode(drifting):
    """In every world, whatever the lengths of its episodes."""
    rows, state, _ = drifting
    lengths = np.diff(np.flatnonzero(rows.ended[0, 0, 0]))
    assert set(lengths) == {3, 5}
    np.testing.assert_array_equal(rows.closed, rows.ended & (episodes_of(rows) % K == K - 1))
    np.testing.assert_array_equal(state.worlds.episode, np.sum(rows.ended, axis=3) % K)


def test_only_the_end_of_a_trial_is_terminal(drifting):
    """Though a third of the episodes terminate in it; and only if it is no limit of time, which five steps are."""
    rows, *_ = drifting
    limit = np.zeros(rows.ended.shape, bool)
    limit[..., 4:] = rows.ended[..., 4:] & ~np.any([rows.ended[..., k : k - 4] for k in range(4)], axis=0)
    assert rows.closed[limit].any() and rows.closed[~limit].any()
    np.testing.assert_array_equal(rows.discount[..., 4:], 1.0 - (rows.closed & ~limit)[..., 4:])


@pytest.mark.slow
def test_a_trial_is_terminal_where_its_length_is_part_of_the_problem():
    """Whatever ends its last episode."""
    rows, *_ = play(Finite())
    np.testing.assert_array_equal(rows.discount, 1.0 - rows.closed)


@dataclasses.dataclass(frozen=True)
class Brief(TabularMDP):
    """Processes that a limit of time cuts off after four steps."""

    episode_steps = 4


class Still(Stub):
    """Finds all five choices alike."""

    def choose(self, state, obs, task, key):
        return jnp.zeros(5)


@pytest.mark.parametrize("curriculum", one_in(2, ["all", "sequence:60"]))
def test_a_mixtures_limit_is_part_of_the_problem_in_those_families_alone_where_it_is(curriculum):
    """As in each of them by itself: sums of rewards run through a trial there, and are cut elsewhere."""
    grid, table = mtjax.make("grid-navi", size=3, steps=3, scores=True), Brief(scores=True, num_tasks=1)
    settings = {**SETTINGS, "warmup_steps": 1, "trials": 2, "curriculum": curriculum}
    state, _ = train(mtjax.mixture([grid, table]), Still(), settings)
    rows = state.data.ring.rows
    for i, finite in enumerate([True, False][: len(rows.ended[0])]):
        ended, closed = rows.ended[0, i], rows.closed[0, i]
        assert closed.any() and (ended & ~closed).any()
        np.testing.assert_array_equal(rows.discount[0, i], 1.0 - (closed & finite))
        np.testing.assert_array_equal(rows.cut[0, i], closed if finite else ended)


def test_tasks_tell_of_a_finite_horizon_only_where_families_differ():
    """Else the environment does, and programs have no data of it."""
    grid, longer, table = mtjax.make("grid-navi"), mtjax.make("grid-navi", steps=20), mtjax.make("tabular-mdp")
    for families, finite in (([grid, longer], True), ([table, mtjax.make("errands")], False)):
        mixed = mtjax.mixture(families)
        assert mixed.finite_horizon is finite and mixed.tasks().finite_horizon is None
    np.testing.assert_array_equal(mtjax.mixture([grid, table]).tasks().finite_horizon, [True] + [False] * 10)


def test_what_follows_inside_a_trial_is_the_next_episode_unless_a_limit_cuts_sums_off(drifting):
    """To the bit; each episode begins elsewhere. After a limit, and at the trial's end, it is the last state."""
    rows, *_ = drifting
    following, cut, ended = rows.obs[..., 1:, 0], rows.cut[..., :-1], rows.ended[..., :-1]
    np.testing.assert_array_equal(rows.next_obs[..., :-1, 0][~cut], following[~cut])
    np.testing.assert_allclose(rows.next_obs[rows.cut], rows.obs[rows.cut] + 1, rtol=1e-6)
    assert np.any(rows.cut & ~rows.closed) and np.any(rows.ended & ~rows.cut)
    assert np.all(following[ended] < 1) and len(np.unique(following[ended])) == ended.sum()


def test_the_task_is_drawn_once_for_a_trial(drifting):
    """And the next trial has another."""
    rows, *_ = drifting
    now, later, closed = rows.context[..., :-1, 0], rows.context[..., 1:, 0], rows.closed[..., :-1]
    np.testing.assert_array_equal(now[~closed], later[~closed])
    assert np.mean(now[closed] != later[closed]) > 0.9


def test_memory_lives_through_a_trial_and_is_new_after_it(drifting):
    """It knows the ends of episodes."""
    rows, *_ = drifting
    for task, env in np.ndindex(2, ENVS):
        steps = ends = 0
        for t in range(STEPS):
            if t >= 1:  # the first action is random
                assert rows.action[0, task, env, t, 0] == steps + 100 * ends
            steps, ends = steps + 1, ends + rows.ended[0, task, env, t]
            if rows.closed[0, task, env, t]:
                steps = ends = 0


def test_returns_are_of_episodes(drifting):
    """As where each is a trial."""
    rows, _, (metrics,) = drifting
    np.testing.assert_array_equal(metrics["episodes"], rows.ended.sum(axis=(2, 3)))
    finished = np.cumsum(rows.ended[..., ::-1], axis=3)[..., ::-1] > 0
    total = np.sum(rows.reward * finished, axis=(2, 3))
    np.testing.assert_allclose(metrics["return"], total / metrics["episodes"], rtol=1e-5)


def test_all_worlds_may_be_reset_at_once():
    """To the same states as some at a time, where draws live for a trial."""

    @dataclasses.dataclass(frozen=True)
    class AtOnce(Drifting):
        @property
        def ends_early(self):
            return False

    some, _, _ = play(Drifting())
    whole, _, _ = play(AtOnce())
    jax.tree.map(np.testing.assert_array_equal, some, whole)


def test_first_ages_and_episodes_spread_over_the_trial():
    """Every number of an episode, and today's ages."""
    _, state, _ = play(Walk(), chunks=0, stagger=True)
    np.testing.assert_array_equal(state.worlds.episode[0, 0], [0, 1, 2, 0, 1, 2])
    np.testing.assert_array_equal(state.worlds.age[0, 0], np.arange(6) * 5 // 6)


def test_one_episode_a_trial_is_what_there_was():
    """Trials and episodes end together, and nothing counts episodes."""
    rows, state, _ = play(Walk(), trials=1)
    np.testing.assert_array_equal(rows.closed, rows.ended)
    assert state.worlds.episode is None and 0 < np.mean(rows.discount == 0) < np.mean(rows.ended)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("sac", {"hindsight": 0.5}, r"hindsight .* use hindsight=0 or trials=1"),
        ("ppo", {"conditioning": "inferred"}, r"inferred .* use conditioning='recurrent'"),
        ("deepmdp", {}, r"models predict .* use representation='plain'"),
    ],
)
def test_who_needs_what_follows_in_an_episode_is_refused_trials_of_several(name, settings, message):
    """What follows a step may be another episode's."""
    experience = {key: settings.pop(key) for key in list(settings) if key == "hindsight"}
    own = {} if name == "ppo" else {"warmup_steps": 1, "replay_size": STEPS * ENVS, **experience}
    given = {"num_envs": ENVS, "chunk_steps": STEPS, "trials": K}
    with pytest.raises(InputError, match=message):
        mtjax.train(Goals(), tiny(name, **settings), eval_episodes=K, **given, **own)


# Sums of rewards.


def rollout(seed=0, length=40, envs=3) -> tuple[np.ndarray, ...]:
    """A window (H, E) with ends of episodes, some of which end trials too."""
    random = np.random.default_rng(seed)
    ended = random.random((length, envs)) < 0.4
    closed = ended & (random.random((length, envs)) < 0.4)
    normal = lambda: random.normal(size=(length, envs)).astype(np.float32)
    return normal(), 1.0 - closed, ended, closed, normal(), normal()


def test_advantages_run_through_episodes_and_stop_at_trials():
    """A plain loop over the sums of errors."""
    reward, discount, ended, closed, value, next_value = map(jnp.asarray, rollout())
    assert np.any(ended & ~closed)
    gamma, decay = 0.9, 0.8
    found = targets.gae(
        Transition(None, None, reward, discount, None, ended, closed, closed), value, next_value, gamma, decay
    )
    for t, e in np.ndindex(*reward.shape):
        total, factor = 0.0, 1.0
        for i in range(t, len(reward)):
            total += factor * (reward[i, e] + gamma * discount[i, e] * next_value[i, e] - value[i, e])
            factor *= gamma * decay
            if closed[i, e]:
                break
        np.testing.assert_allclose(found[t, e], total, rtol=1e-4, atol=1e-5)


def test_rewards_of_several_steps_are_summed_through_episodes():
    """Up to the end of the trial alone."""
    obs = jnp.arange(3.0)[:, None]
    ended, closed = jnp.array([True, True, False]), jnp.array([False, True, False])
    steps = Transition(obs, obs, jnp.array([8.0, 4.0, 2.0]), jnp.float32(~closed), obs + 10, ended, closed, closed)
    joined = multistep.join(steps, 0.5)
    assert joined.reward == 10 and joined.discount == 0 and joined.next_obs == 11 and joined.closed


# Agents that learn, and runs.


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(["ppo", "sac-conditioned"], "ppo"))
def test_a_run_that_is_resumed_in_the_middle_of_a_trial_is_the_whole_run(name, tmp_path):
    """To the bit: a checkpoint holds which episode it is."""
    own = {"unroll": 5, "minibatches": 1} if name == "ppo" else {"warmup_steps": 4, "replay_size": 64, "batch_size": 4}
    given = dict(num_envs=3, chunk_steps=25, trials=2, eval_every=1, eval_episodes=2, quiet=True, **own)
    env, steps = mtjax.make("bandit", num_tasks=2, split="none", scores=True), 2 * 3 * 25
    run = lambda chunks, folder, **more: mtjax.train(
        env, tiny(name, hidden=(8,)), steps=chunks * steps, directory=tmp_path / folder, **given, **more
    )
    whole, half = run(4, "whole"), run(1, "half").state.worlds
    assert len(np.unique(half.episode)) == 2 and np.any(half.age > 0)
    again = run(4, "half", resume=True)
    raw = lambda x: np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(raw(a), raw(b)), whole.state, again.state)
    np.testing.assert_array_equal(whole.evaluations.returns["train"], again.evaluations.returns["train"])


# Evaluation.


@dataclasses.dataclass(frozen=True)
class Shy(Walk):
    """A walk that earns the action, and tells as success whether that is more than 2."""

    def step(self, task, state, action):
        step = super().step(task, state, action)
        return step._replace(reward=action[0], metrics={"success": jnp.float32(action[0] > 2)})


def evaluated(env, episodes, trial, agent=None):
    """The scores of one evaluation of two seeds, as arrays."""
    states, seeds = jnp.zeros((2, 1)), jnp.arange(2)
    found = evaluate(env, agent or Counting(), Episodes(episodes, trial), states, env.tasks(), seeds, jnp.int32(0))
    return jax.tree.map(np.asarray, found)


def test_the_episodes_of_a_trial_follow_each_other_and_memory_lives_through_them():
    """Returns are sums of how many steps and ends the agent remembers: they tell the lengths of all episodes."""
    scores = evaluated(Shy(), 12, K)
    assert scores.returns.shape == scores.metrics["success"].shape == (2, 2, 12)
    lengths = set()
    for trial in scores.returns.reshape(-1, K):
        steps = 0
        for ends, total in enumerate(trial):
            found = [n for n in (3, 5) if total == sum(range(steps, steps + n)) + 100 * ends * n]
            assert len(found) == 1
            lengths, steps = lengths | set(found), steps + found[0]
    assert lengths == {3, 5}
    first = scores.metrics["success"].reshape(-1, K)[:, 0] * scores.returns.reshape(-1, K)[:, 0]
    np.testing.assert_array_equal(first, np.where(scores.returns.reshape(-1, K)[:, 0] == 10, 10, 0))


def test_episodes_alone_are_trials_of_one():
    """To the bit those that begin trials, where the agent remembers nothing of before."""
    alone, trials = (evaluated(Shy(), count, trial).returns for count, trial in ((4, 1), (12, K)))
    np.testing.assert_array_equal(alone, trials[..., ::K])


class Blind(Stub):
    """Does nothing."""


@pytest.mark.slow
def test_the_task_of_an_evaluated_trial_stays_and_each_episode_begins_elsewhere():
    """A walk's return tells its task and its start."""
    env = Drifting()
    returns = evaluated(env, 40 * K, K, Blind()).returns.reshape(2, 2, 40, K)
    assert len(np.unique(returns)) == returns.size

    @dataclasses.dataclass(frozen=True)
    class Told(Drifting):
        def rules(self, task, state, action):
            return task.goal["scale"], state.obs[0] + 1, False

    scales = evaluated(Told(), 60 * K, K, Blind()).returns.reshape(2, 2, 60, K)
    np.testing.assert_array_equal(scales, np.broadcast_to(scales[..., :1], scales.shape))
    first, again = scales[..., :50, 0], scales[..., 50:, 0]  # each of the 50 draws once, and then from the first on
    assert all(len(np.unique(of_task)) == 50 for of_task in first.reshape(-1, 50))
    np.testing.assert_array_equal(again, first[..., :10])
    assert not np.array_equal(first[0], first[1])


@pytest.mark.slow
def test_a_run_s_evaluations_know_their_trials(tmp_path, capsys):
    """In the file, for the policy that is scored again, and in what is told of first, last and mean episode."""
    env = mtjax.make("bandit", num_tasks=2, split="none", scores=True)
    given = dict(num_envs=2, chunk_steps=4, warmup_steps=1, replay_size=16, batch_size=2, steps=16, trials=2)
    result = mtjax.train(env, tiny("sac", hidden=(8,)), eval_episodes=4, directory=tmp_path / "run", **given)
    assert "(episode 1 of a trial " in capsys.readouterr().out and "episode 2 " in repr(result)
    found = load_evaluations(tmp_path / "run" / "evaluations.npz")
    assert found.trial == 2 and found.returns["train"].shape == (1, 1, 2, 4)
    returns = found.returns["train"][0, -1].reshape(-1, 2).mean(axis=0)
    told = f"train           episode 1 of a trial {returns[0]:.3g}, episode 2 {returns[1]:.3g}, mean "
    assert told in split_table(found)
    assert result.policy().trial == 2
    with pytest.raises(InputError, match="episodes must be a multiple of a trial's 2 episodes, such as 4; not 3"):
        mtjax.evaluate(result, episodes=3)
    assert mtjax.evaluate(result, episodes=4).returns["train"].shape == (1, 2, 4)
    other = no_evaluations([0], found.values, 4)
    with pytest.raises(InputError, match="trials of 2 episodes, not of 1"):
        require_same_run(tmp_path, found, other)


@pytest.mark.slow
def test_evaluations_play_whole_trials_unless_they_are_told_how_many_episodes(capsys):
    """Three of four episodes, by default, where ten were no whole trials."""
    assert mtjax.evaluate("grid-navi/rl2", quiet=True).returns["train"].shape == (1, 1, 12)
    mtjax.evaluate.main(["--run=grid-navi/rl2"])
    assert "playing 12 episodes" in capsys.readouterr().out
    with pytest.raises(InputError, match="a trial's 4 episodes, such as 12; not 10"):
        mtjax.evaluate.main(["--run=grid-navi/rl2", "--episodes=10", "--export=policy.npz"])
    assert "exported" not in capsys.readouterr().out


def test_a_run_evaluates_whole_trials():
    """Else it is refused before it is compiled."""
    message = "eval-episodes must be a multiple of a trial's 4 episodes, such as 12; not 9"
    with pytest.raises(InputError, match=message):
        mtjax.train("bandit", "ppo", steps=100, trials=4, eval_episodes=9)
    assert mtjax.preset("bandit", "ppo", "cpu").plan.eval_episodes == 10


# Worlds that go on.


@dataclasses.dataclass(frozen=True)
class Endless(Drifting):
    """A walk that never terminates, and observes the scale that it was drawn with beside where it is."""

    spec = SPEC._replace(obs=jax.ShapeDtypeStruct((2,), jnp.float32))
    ends_early = False
    relabels = varied = ("scale",)
    lost: bool = False

    def observe(self, task, state):
        return jnp.append(state.obs, task.goal["scale"])

    def rules(self, task, state, action):
        return task.goal["scale"], state.obs[0] + 1, False

    def reset(self, task, key):
        step = super().reset(task, key)
        return step._replace(obs=self.observe(task, step.state))

    def step(self, task, state, action):
        step = super().step(task, state, action)
        obs = jnp.where(self.lost & (step.state.obs[0] > 12), jnp.nan, self.observe(task, step.state))
        return step._replace(obs=obs)


def test_worlds_go_on_over_the_limit_with_another_goal():
    """State and count of steps stay; the task changes where an episode's time is up, and with it what is observed."""
    rows, state, (metrics,) = play(Endless(), trials=1, reset_free=True)
    place, scale = rows.obs[..., 0], rows.obs[..., 1]
    np.testing.assert_allclose(place - place[..., :1], np.broadcast_to(np.arange(STEPS), place.shape), rtol=1e-5)
    np.testing.assert_array_equal(rows.closed, np.broadcast_to(np.arange(STEPS) % 5 == 4, place.shape))
    np.testing.assert_array_equal(rows.context[..., 0], scale)
    np.testing.assert_array_equal(rows.discount, 1)
    closed = rows.closed[..., :-1]
    assert np.mean((scale[..., 1:] != scale[..., :-1]) == closed) > 0.99
    np.testing.assert_array_equal(rows.next_obs[..., :-1, :][~closed], rows.obs[..., 1:, :][~closed])
    np.testing.assert_array_equal(rows.next_obs[..., 1], scale)  # the step was the old task's
    np.testing.assert_array_equal(metrics["episodes"], ENVS * STEPS / 5)
    assert np.all(state.worlds.memory[..., 0] == 0)  # which began anew with the last task


def test_a_lost_world_does_not_go_on(monkeypatch):
    """It begins anew, whatever the time."""
    monkeypatch.setattr(loop, "_MOST_LOST", 1.0)
    rows, _, (metrics,) = play(Endless(lost=True), trials=1, reset_free=True)
    assert np.all(np.isfinite(rows.obs)) and rows.obs[..., 0].max() < 13 and np.all(metrics["lost"] >= 3 * ENVS)
    restarted = np.diff(rows.obs[..., 0]) < 0
    np.testing.assert_array_equal(restarted, np.all(rows.obs == rows.next_obs, axis=-1)[..., :-1])


@pytest.mark.slow
def test_a_goal_of_a_body_is_drawn_anew_and_the_body_stays():
    """A point mass goes on from where it is: nothing that it observes jumps."""
    env = mtjax.make("point-mass-vary-goal", combine="grid", engine="c", num_draws=8)
    rows, state, _ = play(env, trials=1, reset_free=True, num_envs=2, chunk_steps=210, replay_size=420)
    np.testing.assert_array_equal(rows.obs[..., 1:, :], rows.next_obs[..., :-1, :])
    assert rows.closed.sum() == 4 and np.all(state.worlds.age == 10)


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (Walk(), "episodes terminate"),
        (lambda: mtjax.make("reacher-easy", engine="c"), "draws its goals with its states"),
        (lambda: mtjax.make("reacher-vary-goal", {"target-angle": "-2:2"}, engine="c"), "hold its goals"),
        (lambda: mtjax.make("walker-walk", {"friction": "0.5:1"}, engine="c"), "states depend on friction"),
        (lambda: mtjax.make("walker-walk+cheetah-run", engine="c"), "not for mixtures"),
    ],
)
def test_families_whose_worlds_cannot_go_on_are_refused(env, said):
    """With the reason, before anything is compiled."""
    with pytest.raises(InputError, match=said):
        mtjax.train(env() if callable(env) else env, tiny("sac"), steps=10, reset_free=True)


def test_a_world_that_goes_on_has_no_episodes_to_repeat():
    """One of the two flags."""
    with pytest.raises(InputError, match=r"--reset-free has no episodes to repeat; use --trials=1, not 3"):
        loop.Settings(trials=3, reset_free=True)


def test_a_table_tells_success_by_the_episode_of_the_trial():
    """At the end and at any step, beside the return; a split whose families do not tell it has no such line."""
    of = lambda *episodes: np.float32([[[[*episodes] * 2] * 3]])  # of one seed, one evaluation, three tasks, two trials
    returns = {"train": of(1, 5), "extrapolation": of(2, 4)}
    metrics = {"success": {"train": of(0, 0.5), "extrapolation": of(np.nan, np.nan)}}
    metrics["success_ever"] = {"train": of(0.25, 1), "extrapolation": of(np.nan, np.nan)}
    lines = split_table(Evaluations(np.arange(1), returns, {}, metrics, trial=2)).splitlines()
    assert lines[-4:] == [
        "train           episode 1 of a trial 1, episode 2 5, mean 3",
        "extrapolation   episode 1 of a trial 2, episode 2 4, mean 3",
        "train           success at the end: episode 1 of a trial 0, episode 2 0.5, mean 0.25",
        "train           success at any step: episode 1 of a trial 0.25, episode 2 1, mean 0.625",
    ]
