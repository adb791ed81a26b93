"""The coloured maze against its rules in plain Python, the cheapest way through it, and its classes of tasks."""

import heapq

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK

import mtjax
from mtjax.report import render
from mtjax.types import InputError

STEPS = ((0, -1), (0, 1), (-1, 0), (1, 0))
MAZE = mtjax.make("coloured-maze", cells=15, noise=0.0, num_tasks=4)


def pick(env, row):
    return jax.tree.map(lambda x: x[row], env.tasks("all"))


def play(env, row, actions, seed=0):
    """Everything that steps under the actions return."""
    task = pick(env, row)
    step = lambda state, action: (lambda after: (after.state, after))(env.step(task, state, action))
    run = jax.jit(
        lambda actions, key: jax.lax.scan(step, env.reset(task, key).state, actions)[1], compiler_options=QUICK
    )
    return jax.tree.map(np.asarray, run(jnp.int32(actions), jax.random.key(seed)))


class Plain:
    """The maze with these tables."""

    def __init__(self, weights, squares):
        self.weights, self.size = weights, len(squares)
        self.colour = {(x, y): int(8 * squares[x][y]) for x in range(self.size) for y in range(self.size)}

    def around(self, place):
        return [self.colour.get((place[0] + dx, place[1] + dy)) for dx, dy in ((0, 0), *STEPS)]

    def cost(self, place):
        return sum(self.weights[i][colour] for i, colour in enumerate(self.around(place)) if colour is not None)

    def after(self, place, action):
        moved = place[0] + STEPS[action][0], place[1] + STEPS[action][1]
        return moved if moved in self.colour else place

    def best(self):
        """The least cost of a way to the opposite corner, and its actions (Dijkstra)."""
        queue, done = [(0.0, (0, 0), ())], set()
        while queue:
            cost, place, actions = heapq.heappop(queue)
            if place == (self.size - 1, self.size - 1):
                return cost, actions
            if place not in done:
                done.add(place)
                for action in range(4):
                    after = self.after(place, action)
                    heapq.heappush(queue, (cost + self.cost(after), after, (*actions, action)))
        return None


def plain(env, row):
    goal = pick(env, row).goal
    return Plain(np.asarray(goal["weights"], float), np.asarray(goal["squares"], float))


@pytest.mark.parametrize("row", (0, 3))
def test_random_steps_follow_the_rules(row):
    """A hundred steps, also into the borders: places, costs and what is seen."""
    maze, place, random = plain(MAZE, row), (0, 0), np.random.default_rng(row)
    actions = random.choice(4, 100, p=[0.15, 0.35, 0.15, 0.35])
    steps = play(MAZE, row, actions)
    for i, action in enumerate(actions):
        place = maze.after(place, action)
        assert tuple(steps.state.place[i].tolist()) == place
        np.testing.assert_allclose(steps.reward[i], -maze.cost(place), atol=1e-5)
        shown = [[c == colour for c in range(8)] for colour in maze.around(place)]
        np.testing.assert_allclose(steps.obs[i], [*np.ravel(shown), *(np.array(place) / 7 - 1)], atol=1e-6)
        assert steps.terminated[i] == steps.metrics["success"][i] == (place == (14, 14))


@pytest.mark.parametrize("row", range(4))
def test_the_cheapest_way_earns_what_it_costs(row):
    """And more than the way along the borders."""
    cost, actions = plain(MAZE, row).best()
    steps = play(MAZE, row, actions)
    assert steps.terminated.tolist() == [False] * (len(actions) - 1) + [True]
    assert steps.reward.sum() == pytest.approx(-cost, abs=1e-4)
    assert -cost > play(MAZE, row, [3] * 14 + [1] * 14).reward.sum() + 1


def test_rewards_have_noise():
    env = mtjax.make("coloured-maze", cells=15, noise=0.5, num_tasks=4)
    still = [play(env, 0, [0] * 400, seed).reward for seed in (0, 1)]
    assert np.std(still[0]) == pytest.approx(0.5, abs=0.06) and np.corrcoef(*still)[0, 1] < 0.2
    assert np.mean(still) == pytest.approx(play(MAZE, 0, [0]).reward[0], abs=0.08)


def test_tasks_are_near_their_classes_and_more_keep_the_first():
    """With all classes among two hundred; held-out tasks are of the same classes, in mazes of their own."""
    env = mtjax.make("coloured-maze", cells=15, num_tasks=200)
    weights = np.asarray(env.tasks("all").goal["weights"])
    away = np.sqrt(np.mean(np.square(weights[:, None] - env.means), axis=(2, 3)))
    assert (
        set(away.argmin(axis=1)) == {0, 1, 2, 3}
        and np.all(away.min(axis=1) < 0.07)
        and env.counts["interpolation"] == 10
    )
    assert np.all(np.sort(away, axis=1)[:, 1] > 0.3)
    np.testing.assert_array_equal(env.tasks().context, 2 * weights[:200].reshape(200, -1) - 1)
    np.testing.assert_array_equal(env.tasks().goal["squares"][:4], MAZE.tasks().goal["squares"])
    assert len({np.asarray(x).tobytes() for x in env.tasks("all").goal["squares"]}) == 210


@pytest.mark.slow
def test_pictures_show_the_tasks_own_colours():
    env = mtjax.make("coloured-maze", cells=4, num_tasks=2, pixels=32)
    draw = jax.jit(lambda task, state: env.look_at(task, state)["pixels"], compiler_options=QUICK)
    state = env.reset(pick(env, 0), jax.random.key(0)).state
    one, other = (np.int32(draw(pick(env, row), state)) for row in (0, 1))
    assert np.any(one != other, axis=-1).mean() > 0.3
    model = env.scene_model(1)
    render._arrange(model, env.visible(pick(env, 1), state))
    colours = np.unique(model.geom_rgba[:16], axis=0)
    assert len(colours) == len(np.unique(np.floor(8 * env.table.tasks.goal["squares"][1])))


@pytest.mark.parametrize(
    "given, said",
    [
        ({"cells": 2}, "cells must be from 3 to 30, not 2"),
        ({"num_colours": 9}, "num-colours must be from 2 to 8, not 9"),
        ({"num_classes": 0}, "num-classes must be from 1 to 1000, not 0"),
        ({"noise": -1.0}, "noise must be at least 0, not -1.0"),
        ({"cells": 8, "pixels": 64}, "pictures show at most 7 x 7 squares, not cells=8"),
        ({"vary": {"hue": "0,90"}, "pixels": 64}, "unknown parameter 'hue'; this family has none"),
    ],
)
def test_what_makes_no_sense_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        mtjax.make("coloured-maze", **given)
