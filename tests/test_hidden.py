"""Tasks that nothing shows: what they are drawn from, what they earn, and the most that can be earned in a trial."""

import exact
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, Stub

from mtjax import make
from mtjax.envs.hidden import GridNavi, HiddenBandit, even_points
from mtjax.learning.evaluation import Episodes, evaluate
from mtjax.report import render
from mtjax.types import Acted, InputError


def task_with(env, numbers):
    """The training task with these numbers (C,)."""
    return jax.tree.map(lambda x: x[0], env.tasks()._replace(draws=None))._replace(goal={"task": numbers})


# The exact programs.


@pytest.mark.parametrize(("arms", "pulls", "most"), [(2, 5, 2.8889), (2, 10, 6.0218), (3, 10, 6.4096), (5, 10, 6.66)])
def test_the_best_strategy_for_a_bandit(arms, pulls, most):
    """Between pulling at random and knowing the best arm."""
    assert exact.bandit(arms, pulls) == pytest.approx(most, abs=5e-5)
    assert pulls / 2 < most < pulls * arms / (arms + 1)


@pytest.mark.slow
def test_the_best_strategy_for_many_pulls_of_five_arms():
    """With a quarter of a million states."""
    assert exact.bandit(5, 20) == pytest.approx(14.2873, abs=5e-5)


def test_the_best_strategy_for_small_grids():
    """The first episode of two earns 2.70, and the second what one earns whose goal is known, 4.02."""
    assert exact.grid(3, 6, 1) == pytest.approx(2.7) == exact.bound_of_first(3, 6)
    assert exact.told_grid(3, 6) == pytest.approx(4.02)
    assert exact.grid(3, 6, 2) == pytest.approx(2.7 + 4.02)


def test_a_hidden_task_is_called_by_what_makes_it():
    """In captions and figures, which show what the agent does not see."""
    grid, bandit = GridNavi(), HiddenBandit(num_draws=3)
    assert [grid.describe(row) for row in (1, 21)] == ["goal=0,2", "goal=4,4"]
    first = ",".join(f"{x:.2g}" for x in bandit.pool()[0])
    assert bandit.describe(0) == bandit.describe(1) == f"chances={first}"


# Bandits.


def test_arms_fill_the_cube_evenly():
    """Means, and means of the larger of two, are those of uniform chances to a thousandth; another seed moves them."""
    pool = HiddenBandit(num_arms=3).pool()
    assert pool.shape == (10_000, 3) and np.all((pool >= 0) & (pool < 1))
    np.testing.assert_allclose(pool.mean(axis=0), 0.5, atol=1e-3)
    assert np.mean(pool[:, :2].max(axis=1)) == pytest.approx(2 / 3, abs=1e-3)
    assert np.mean(pool.max(axis=1)) == pytest.approx(3 / 4, abs=2e-3)
    assert not np.allclose(even_points(100, 3, 0), even_points(100, 3, 1))


@pytest.mark.parametrize("scores", [False, True])
def test_a_pull_pays_by_its_arm(scores):
    """As often as its chance says; of scores the highest counts."""
    env = HiddenBandit(num_arms=3, scores=scores)
    task = task_with(env, jnp.array([0.2, 0.9, 0.5]))

    def pull(action, key):
        return env.step(task, env.reset(task, key).state, action)

    by_score = jnp.array([[0.5, -1, 0], [-0.9, -0.8, -1], [0, 0, 0.1]])
    actions, keys = by_score if scores else jnp.arange(3), jax.random.split(jax.random.key(0), 4000)
    step = jax.jit(jax.vmap(jax.vmap(pull, (None, 0)), (0, None)), compiler_options=QUICK)(actions, keys)
    np.testing.assert_allclose(np.mean(step.reward, axis=1), [0.2, 0.9, 0.5], atol=0.04)
    assert set(np.unique(step.reward)) == {0, 1} and not np.any(step.terminated) and not np.any(step.obs)


@pytest.mark.parametrize("name", ["hidden-bandit", "grid-navi"])
def test_the_context_shows_nothing_unless_it_is_told(name):
    """One training task, and none that is held out; all of its draws have its context."""
    hidden, told = make(name).tasks(), make(name, told=True).tasks()
    assert len(hidden.id) == 1 and hidden.draws.context is None and not np.any(hidden.context)
    assert not len(make(name).tasks("interpolation").id) + len(make(name).tasks("extrapolation").id)
    assert told.draws.context.shape == told.draws.goal["task"].shape == (1, *make(name).pool().shape)
    assert np.min(told.draws.context) == pytest.approx(-1, abs=1e-3) == -np.max(told.draws.context)


class Bayes(Stub):
    """Pulls by the best strategy for finding out, given its table (H, H, H, H) of arms by wins and losses."""

    def init(self, spec, tasks, key):
        return jnp.zeros(1)

    def begin(self, state, task):
        return jnp.zeros((2, 2), jnp.int32)

    def act(self, state, memory, obs, task, key):
        arm = jnp.asarray(state)[tuple(memory.ravel())]
        return Acted(arm.astype(jnp.int32))

    def remember(self, state, memory, transition, task):
        outcome = jnp.stack([transition.reward, 1 - transition.reward]).astype(jnp.int32)
        return memory + jnp.outer(jax.nn.one_hot(transition.action, 2, dtype=jnp.int32), outcome)


@pytest.mark.slow
def test_the_best_strategy_earns_in_trials_what_it_must():
    """As exactly computed, to four standard errors of 20,000 trials; it learns which arm is better."""
    pulls, trials = 10, 20_000
    arms, most = exact.two_arms(pulls)
    assert most == pytest.approx(exact.bandit(2, pulls))
    env = HiddenBandit()
    play = jax.jit(
        lambda table: (
            evaluate(
                env, Bayes(), Episodes(trials * pulls, pulls), table[None], env.tasks(), jnp.arange(1), jnp.int32(0)
            ).returns
        ),
        compiler_options=QUICK,
    )
    returns = np.asarray(play(jnp.asarray(arms, jnp.int32))).reshape(trials, pulls)
    total = returns.sum(axis=1)
    assert abs(total.mean() - most) < 4 * total.std() / np.sqrt(trials)
    assert abs(returns[:, 0].mean() - 0.5) < 0.02 and returns[:, -1].mean() > 0.62


# Grids.


def walk(env, plan):
    """Rewards (P, episodes, H) and cells (P, episodes, H, 2) of all goals.

    Args:
        plan: the cells to go to in each episode, (episodes, H, 2); who has found the goal goes there.
    """
    moves = jnp.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])

    def trial(goal):
        task = task_with(env, goal)

        def step(carry, target):
            cell, found = carry
            target = jnp.where(found[0] >= 0, found, target)
            away = jnp.sum(jnp.abs(jnp.clip(cell + moves, 0, env.size - 1) - target), axis=1)
            after = env.step(task, cell, jnp.argmin(away))
            return (after.state, jnp.where(after.reward > 0, after.state, found)), (after.reward, after.state)

        def episode(found, targets):
            (_, found), seen = jax.lax.scan(step, (env.reset(task, jax.random.key(0)).state, found), targets)
            return found, seen

        return jax.lax.scan(episode, jnp.full(2, -1), jnp.asarray(plan))[1]

    run = jax.jit(jax.vmap(trial), compiler_options=QUICK)
    return jax.tree.map(np.asarray, run(jnp.float32(env.pool())))


# Fourteen goals without a gap, and then the others, which lie on one shortest way.
FIRST = [(1, 0), *[(x, 0) for x in (2, 3, 4)], (4, 1), (4, 2), (4, 3), (3, 3), (3, 2), (3, 1), (2, 1), (2, 2)]
FIRST += [(1, 2), (1, 3), (2, 3)]
SECOND = [(0, y) for y in (1, 2, 3, 4)] + [(x, 4) for x in (1, 2, 3, 4)] + [(4, 4)] * 7


def test_the_best_strategy_for_a_grid_of_five_cells():
    """It reaches the bounds of both episodes: no goal is found later than it must be."""
    env = GridNavi()
    rewards, cells = walk(env, [FIRST, SECOND, SECOND])
    by_episode = rewards.sum(axis=2).mean(axis=0)
    np.testing.assert_allclose(by_episode, [4.0, 11.0714, 11.0714], atol=1e-4)
    assert exact.bound_of_first(5, 15) == pytest.approx(4.0) and exact.told_grid(5, 15) == pytest.approx(
        11.0714, abs=1e-4
    )
    assert len(env.pool()) == 21 and cells.min() == 0 and cells.max() == 4


def test_steps_stay_on_the_grid_and_are_observed():
    """As one-hot places."""
    env = GridNavi(size=3, steps=6)
    task = task_with(env, jnp.array([2.0, 1.0]))
    cell, seen = env.reset(task, jax.random.key(0)).state, []
    for move in (2, 4, 0, 1, 1, 1, 3):
        step = env.step(task, cell, jnp.int32(move))
        cell = step.state
        seen.append((*cell.tolist(), round(float(step.reward), 2), int(np.argmax(step.obs))))
        assert np.sum(step.obs) == 1 and not step.terminated
    assert seen[:3] == [(0, 0, -0.1, 0)] * 3
    assert seen[3:] == [(1, 0, -0.1, 3), (2, 0, -0.1, 6), (2, 0, -0.1, 6), (2, 1, 1.0, 7)]


@pytest.mark.parametrize(
    ("cls", "given", "said"),
    [
        (GridNavi, {"size": 2}, "size must be at least 3"),
        (GridNavi, {"steps": 0}, "steps must be at least 1"),
        (HiddenBandit, {"num_arms": 0}, "num-arms must be at least 1"),
    ],
)
def test_worlds_that_make_no_sense_are_refused(cls, given, said):
    """With what is allowed."""
    with pytest.raises(InputError, match=said):
        cls(**given)


# What is seen.


@pytest.mark.slow
def test_pictures_show_a_walker_and_hide_the_goal_that_films_show():
    """The picture that an agent observes is the same for all goals, and changes with the cell."""
    env = GridNavi(size=3, pixels=32)
    at = lambda x, y, goal: np.asarray(env.look_at(task_with(env, jnp.array(goal)), jnp.array([x, y]))["pixels"])
    np.testing.assert_array_equal(at(0, 0, [2, 2]), at(0, 0, [0, 2]))
    assert np.any(at(0, 0, [2, 2]) != at(1, 0, [2, 2]))
    marks = env.visible(task_with(env, jnp.array([0, 2])), jnp.array([1, 0])).marks
    assert [float(x) for x in marks["goal"].position[:2]] == [0, 2]
    assert [float(x) for x in marks["walker"].position[:2]] == [1, 0]


def test_a_film_shows_the_task_that_a_trial_has_drawn():
    """Its row lies behind that of the training task."""
    env = GridNavi(size=3)
    try:
        one, other = (render.film(env, row, jnp.zeros((1, 2), jnp.int32), 32, 24) for row in (1, 5))
    except InputError as error:
        pytest.skip(str(error))
    assert np.any(one != other)
