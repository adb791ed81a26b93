"""Mazes of corridors: layouts from numbers, walls that hold, pictures whose depths are worked by hand, and rewards."""

from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import QUICK

import mtjax
from mtjax.envs.corridors.layouts import find_ways, make_layout
from mtjax.envs.corridors.maze import CorridorMaze, WalkerState, metres_left
from mtjax.report import render
from mtjax.types import InputError

SIZE = 32
MAZE = CorridorMaze(vary={"layout": "0:3:4"})
OPEN = np.zeros((2, 6, 5), bool)  # five by five cells without a wall but those around
OPEN[:, [0, -1]] = True
RED, GREEN, BLUE = range(3)
EAST, NORTH = 0.0, np.pi / 2
NUMBERS = (*range(20), 0.5, -3.0, 1e6)


def at(place, heading=EAST):
    return WalkerState(jnp.float32(place), jnp.float32(heading), jnp.float32(0))


def task_of(env=MAZE, walls=None, balls=None, colour=RED):
    """The first task of a family, with walls and balls of one's own."""
    task = jax.tree.map(lambda x: x[0], env.tasks())
    goal = task.goal | {"goal-colour": jnp.float32(colour)}
    goal |= {} if balls is None else {"balls": jnp.float32(balls)}
    return task._replace(goal=goal, model=task.model if walls is None else {"walls": jnp.asarray(walls)})


@lru_cache
def stepper(env=MAZE):
    return jax.jit(env.step, compiler_options=QUICK)


# Layouts.


@pytest.mark.parametrize("cells", [2, 5, 9])
def test_every_layout_is_a_tree_with_balls_in_cells_of_their_own(cells):
    """From everywhere a way leads to each ball, and it is the only one: there is a gap less than there are cells."""
    for number in NUMBERS:
        walls, balls = make_layout(number, cells, 3)
        assert np.all(walls[:, [0, -1]])
        assert np.sum(~walls) == cells**2 - 1
        assert len(np.unique(balls, axis=0)) == 3 and set(np.unique(balls % 1)) == {0.5}
        for ball in balls:
            assert np.all(np.isfinite(find_ways(walls, ball).rest))


def test_a_number_always_gives_the_same_layout_and_no_two_the_same():
    first, again = ([make_layout(number, 5, 3) for number in NUMBERS] for _ in range(2))
    for one, other in zip(first, again, strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)
    assert len({layout.walls.tobytes() for layout in first}) == len(NUMBERS)
    gaps = "".join("01"[int(wall)] for wall in make_layout(0, 3, 3).walls.ravel())
    assert gaps == "111010010111111010001111"  # in every version: runs are resumed by numbers


def test_ways_lead_to_the_goal():
    """By hand, around one wall of two cells; and what stays of the way falls by a metre in each cell."""
    walls = np.ones((2, 3, 2), bool)
    walls[0, 1, :] = walls[1, 1, 0] = False  # cell (1, 0) and (1, 1) are apart
    ways = find_ways(walls, np.array([1.5, 1.5]))
    np.testing.assert_array_equal(ways.rest, [[1, 0], [2, 0]])
    np.testing.assert_array_equal(ways.ahead, [[[0.5, 1.5], [1.5, 1.5]], [[0.5, 0.5], [1.5, 1.5]]])
    with pytest.raises(ValueError, match="no way leads"):
        find_ways(np.ones((2, 3, 2), bool), np.array([1.5, 1.5]))


def test_held_out_layouts_are_others():
    """And all tasks of all splits are one program: only arrays differ."""
    env = mtjax.make("corridor-maze-vary-layout")
    walls = np.asarray(env.tasks("all").model["walls"])
    counts = [len(env.tasks(split).id) for split in ("train", "interpolation", "extrapolation")]
    assert counts == [10, 9, 4] and len(np.unique(walls, axis=0)) == 23
    drawn = CorridorMaze(vary={"layout": "0:1000"}, num_draws=16).tasks()
    assert len(np.unique(np.asarray(drawn.draws.model["walls"]), axis=1)[0]) == 16


def test_goals_have_names_and_no_goal_between():
    env = CorridorMaze(vary={"layout": "0,1", "goal-colour": "red,blue"})
    assert [env.describe(i) for i in range(4)] == [
        f"layout={i},goal-colour={c}" for i in (0, 1) for c in ("red", "blue")
    ]
    assert (
        env.sentence(1)
        == "Find the ball of the goal's colour in a maze of corridors, with layout 0 and goal colour blue."
    )
    np.testing.assert_array_equal(env.tasks("interpolation").params["goal-colour"], [RED, BLUE])
    np.testing.assert_array_equal(env.tasks("interpolation").params["layout"], [0.5, 0.5])
    assert len(CorridorMaze(vary={"goal-colour": "red,green"}).tasks("interpolation").id) == 0


# Steps.


def gap_to_walls(walls, places):
    """The distance of places (P, 2) from the nearest wall: every wall of the maze is a segment of 1 m."""
    axis, line, number = np.nonzero(walls)
    start = np.where(axis[:, None] == 0, np.stack([line, number], 1), np.stack([number, line], 1))
    way = np.where(axis[:, None] == 0, [0, 1], [1, 0])
    share = np.clip(np.sum((places[:, None] - start) * way, axis=2), 0, 1)
    return np.linalg.norm(start + share[..., None] * way - places[:, None], axis=2).min(axis=1)


def test_walls_and_their_ends_hold():
    """Long random walks, mostly ahead, in four mazes: never nearer to a wall than the radius, and far about."""
    count = 64
    tasks = jax.tree.map(lambda x: jnp.repeat(x[:4], count // 4, axis=0), MAZE.tasks())
    tasks = tasks._replace(goal=tasks.goal | {"balls": tasks.goal["balls"] + 100})  # no episode ends
    start = at((0.5, 0.5))._replace(heading=jnp.linspace(-3, 3, count), place=jnp.full((count, 2), 0.5))
    start = start._replace(gained=jnp.zeros(count))

    @jax.jit
    def play(state, key):
        def step(state, key):
            action = jax.random.uniform(key, (count, 2), minval=jnp.array([-0.5, -1]), maxval=jnp.array([1.5, 1]))
            state = jax.vmap(MAZE.advance)(tasks, state, action)
            return state, state.place

        return jax.lax.scan(step, state, jax.random.split(key, 400))[1]

    places = np.asarray(play(start, jax.random.key(0)), np.float64)
    for i in range(0, count, 5):
        walls = np.asarray(tasks.model["walls"][i])
        assert gap_to_walls(walls, places[:, i]).min() > 0.2 - 1e-5
        assert np.linalg.norm(np.diff(places[:, i], axis=0), axis=1).max() < 0.4
    assert len(np.unique(np.floor(places.reshape(-1, 2)), axis=0)) > 12


@pytest.mark.parametrize(
    ("place", "heading", "expected"),
    [
        ((2.5, 2.5), EAST, (2.7, 2.5)),
        ((2.5, 2.5), NORTH, (2.5, 2.7)),
        ((4.7, 2.5), EAST, (4.8, 2.5)),  # the wall at x = 5
        ((4.8, 2.5), np.pi / 4, (4.8, 2.5 + 0.2 * np.sin(np.pi / 4))),  # along it
        ((1.9, 3.5), EAST, (2.1, 3.5)),  # past the end of the wall below
        ((1.75, 2.5), EAST, (1.8, 2.5)),  # that wall
        ((2.0, 3.2), -np.pi / 4, (2 + 0.2 * np.cos(np.pi / 8), 3 + 0.2 * np.sin(np.pi / 8))),  # about its end at (2, 3)
    ],
)
def test_a_step_by_hand(place, heading, expected):
    """Of 0.2 m, in a room with one wall, on the line x = 2 from y = 2 to 3."""
    walls = OPEN.copy()
    walls[0, 2, 2] = True
    task = task_of(walls=walls, balls=np.full((3, 2), 100.0))
    step = stepper()(task, at(place, heading), jnp.float32([1, 0]))
    np.testing.assert_allclose(step.state.place, expected, atol=1e-5)
    np.testing.assert_allclose(step.obs[:2], 2 * np.asarray(expected) / 5 - 1, atol=1e-5)
    np.testing.assert_allclose(step.obs[2:], [np.cos(heading), np.sin(heading)], atol=1e-6)


def test_actions_turn_and_go_back():
    """And are clipped to [-1, 1]."""
    step = stepper()(task_of(walls=OPEN), at((2.5, 2.5)), jnp.float32([-3, 0]))
    np.testing.assert_allclose(step.state.place, [2.3, 2.5], atol=1e-6)
    step = stepper()(task_of(walls=OPEN), at((2.5, 2.5), 3.0), jnp.float32([0, 1]))
    np.testing.assert_allclose(step.state.heading, 3.3 - 2 * np.pi, atol=1e-5)
    np.testing.assert_allclose(step.state.place, [2.5, 2.5])


def test_only_the_goal_s_ball_pays_and_ends():
    """On the step that comes within 0.4 m."""
    balls = [[3.5, 2.5], [0.5, 0.5], [2.5, 4.5]]
    for colour, paid in ((RED, 1.0), (GREEN, 0.0)):
        task = task_of(walls=OPEN, balls=balls, colour=colour)
        for x, reached in ((2.85, False), (2.95, True)):  # before the step
            step = stepper()(task, at((x, 2.5)), jnp.float32([1, 0]))
            assert step.reward == step.metrics["success"] == paid * reached
            assert step.terminated == bool(paid * reached)


def test_repeated_actions_stop_at_the_goal():
    """The reward of arriving is paid once, though three more control steps would pass the ball."""
    env = CorridorMaze(repeat=5)
    task = task_of(env, walls=OPEN, balls=[[3.5, 2.5], [0.5, 0.5], [2.5, 4.5]])
    step = stepper(env)(task, at((2.85, 2.5)), jnp.float32([1, 0]))
    assert (step.reward, step.terminated, step.metrics["success"]) == (1, True, 1)
    np.testing.assert_allclose(step.state.place, [3.25, 2.5], atol=1e-6)
    assert (env.episode_length, env.seconds_per_step) == (100, 0.5)


def test_dense_rewards_add_up_to_the_way():
    """Along a corridor 0.2 m a step, and 1 for the goal; to go back and forth brings nothing."""
    env = CorridorMaze(dense=True)
    ways = find_ways(OPEN, np.array([3.5, 2.5]))
    task = task_of(env, walls=OPEN, balls=[[3.5, 2.5], [0.5, 0.5], [2.5, 4.5]])
    task = task._replace(goal=task.goal | {name: jnp.asarray(x) for name, x in ways._asdict().items()})
    state, rewards = at((1.45, 2.5)), []
    for speed in (1, 1, -1, -1, *[1] * 9):
        step = stepper(env)(task, state, jnp.float32([speed, 0]))
        state, rewards = step.state, [*rewards, float(step.reward)]
    np.testing.assert_allclose(rewards, [0.2, 0.2, -0.2, -0.2, *[0.2] * 8, 1.2], atol=1e-5)
    assert step.terminated


@pytest.mark.slow
def test_who_follows_the_ways_arrives():
    """From 64 starts in four mazes: turn to the next cell's middle, and walk when it is ahead. Rewards add up."""
    env = CorridorMaze(vary={"layout": "0:3:4"}, dense=True)
    tasks = jax.tree.map(lambda x: jnp.repeat(x, 16, axis=0), env.tasks())

    def play(task, key):
        def step(state, _):
            i, j = jnp.floor(state.place).astype(jnp.int32)
            left = task.goal["ahead"][i, j] - state.place
            error = jnp.arctan2(left[1], left[0]) - state.heading
            error = jnp.arctan2(jnp.sin(error), jnp.cos(error))
            after = env.step(task, state, jnp.stack([jnp.abs(error) < 0.2, error / 0.3]))
            return after.state, (after.reward, after.terminated)

        state = env.reset(task, key).state
        return metres_left(task, state.place), jax.lax.scan(step, state, length=400)[1]

    way, (rewards, ended) = jax.jit(jax.vmap(play), compiler_options=QUICK)(
        tasks, jax.random.split(jax.random.key(0), 64)
    )
    lengths = np.argmax(ended, axis=1) + 1
    assert np.all(np.any(ended, axis=1)) and np.all(lengths < 2 + 12 * np.asarray(way))
    total = [np.sum(rewards[i, : lengths[i]]) for i in range(64)]
    assert np.all(np.asarray(way) + 1 - total > 0) and np.all(np.asarray(way) + 1 - total < 0.6)


def test_episodes_start_anywhere_but_in_the_goal_s_cell():
    starts = jax.jit(jax.vmap(MAZE.reset, (None, 0)), compiler_options=QUICK)(
        task_of(), jax.random.split(jax.random.key(0), 2000)
    )
    cells = np.floor(np.asarray(starts.state.place))
    goal = np.floor(np.asarray(task_of().goal["balls"][RED]))
    found, counts = np.unique(cells, axis=0, return_counts=True)
    assert len(found) == 24 and not np.any(np.all(found == goal, axis=1)) and counts.min() > 40
    inside = np.asarray(starts.state.place) - cells
    assert 0.3 <= inside.min() < 0.31 and 0.69 < inside.max() <= 0.7
    assert np.ptp(np.asarray(starts.state.heading)) > 6.2 and not np.any(starts.terminated)


def test_the_goal_is_told_by_the_context_or_on_request():
    told = CorridorMaze(vary={"goal-colour": "0,1,2"}, observe_goal=True)
    hidden = CorridorMaze(vary={"goal-colour": "0,1,2"})
    np.testing.assert_array_equal(hidden.tasks().context, [[-1], [0], [1]])
    for env, size in ((told, 7), (hidden, 4)):
        obs = np.asarray(jax.vmap(env.observe, (0, None))(env.tasks(), at((1.5, 1.5))))
        assert obs.shape == (3, size) and len(np.unique(obs, axis=0)) == (3 if env is told else 1)
    np.testing.assert_array_equal(jax.vmap(told.observe, (0, None))(told.tasks(), at((1.5, 1.5)))[:, 4:], np.eye(3))


# Pictures.


@lru_cache
def seeing(**settings):
    return CorridorMaze(vary={"layout": "0:3:4"}, pixels=SIZE, plain=True, **settings)


@lru_cache
def drawer(env):
    return jax.jit(lambda task, state: env.look_at(task, state)["pixels"], compiler_options=QUICK)


def picture(task, state, env=None):
    env = env or seeing()
    return np.asarray(drawer(env)(task, state), np.int32)


def walls_in(seen):
    """Where a picture (H, W, 3) shows a wall: brown, where floor and sky are blue."""
    return seen[..., 0] > seen[..., 2]


FAR = np.full((3, 2), 0.5)  # balls in a corner behind


def test_depths_of_columns_are_the_distances_to_walls():
    """In a room of 5 x 5 m, to the east from (1.5, 2.5): the wall ahead is 3.5 m away in all columns that show it."""
    env = seeing()
    u = (np.arange(SIZE) + 0.5 - SIZE / 2) * 2 * np.tan(np.radians(75 / 2)) / SIZE
    task = task_of(env, walls=OPEN, balls=FAR)

    def depths(task, state):
        painter, visible = env.scenery.painter, env.visible(task, state)
        leaf = partial(env.scenery.field, task, visible)
        return painter._to_walls(painter._view(leaf, env.scenery.poses(task, visible)).grid)

    depths = jax.jit(depths)
    found = depths(task, at((1.5, 2.5)))
    np.testing.assert_allclose(found, np.minimum(3.5, 2.5 / np.abs(u)), rtol=1e-5)
    walls = OPEN.copy()
    walls[0, 2, 2] = True  # from (2, 2) to (2, 3), 0.5 m ahead: it fills the view up to 45 degrees
    np.testing.assert_allclose(depths(task_of(env, walls, FAR), at((1.5, 2.5))), 0.5, rtol=1e-5)
    walls[0, 2, 2], walls[0, 3, 3] = False, True  # 1.5 m ahead on the left, from y = 3 on, to 4
    left = (-1.5 * u > 0.5) & (-1.5 * u < 1.5)
    found = depths(task_of(env, walls, FAR), at((1.5, 2.5)))
    np.testing.assert_allclose(found, np.where(left, 1.5, np.minimum(3.5, 2.5 / np.abs(u))), rtol=1e-5)


def test_a_wall_is_as_high_as_its_distance_says():
    """0.5 m up and down at a depth of d: rows where |v| < 0.5 / d."""
    v = (np.arange(SIZE) + 0.5 - SIZE / 2) * 2 * np.tan(np.radians(75 / 2)) / SIZE
    for x, depth in ((1.5, 3.5), (3.0, 2.0), (4.2, 0.8)):
        shown = walls_in(picture(task_of(seeing(), OPEN, FAR), at((x, 2.5))))
        np.testing.assert_array_equal(shown[:, SIZE // 2], np.abs(v) < 0.5 / depth)


def test_a_ball_is_seen_unless_a_wall_hides_it():
    """Two metres ahead, of all three colours; a wall between the two hides all of it, one behind it nothing."""
    for colour in (RED, GREEN, BLUE):
        balls = FAR.copy()
        balls[colour] = [3.5, 2.5]
        bright = {}
        for wall in (None, 3, 4):
            walls = OPEN.copy()
            if wall:
                walls[0, wall, 2] = True
            seen = picture(task_of(seeing(), walls, balls), at((1.5, 2.5)))
            others = np.delete(seen, colour, axis=-1).max(axis=-1)
            bright[wall] = np.sum(seen[..., colour] > 2 * others)
        radius = 0.2 / 2.0 / (2 * np.tan(np.radians(75 / 2)) / SIZE)  # in pixels
        assert abs(bright[None] - np.pi * radius**2) < 5 and bright[4] == bright[None] and bright[3] == 0


@pytest.mark.slow
def test_the_grid_s_caster_draws_what_the_general_one_draws():
    """Which tests every wall as a box of 4 cm, of two layouts; tiles, sky and shades included."""
    grid, general = (CorridorMaze(cells=2, vary={"layout": "0,1"}, pixels=SIZE, painter=p) for p in ("auto", "caster"))
    blind = CorridorMaze(cells=2, vary={"layout": "0,1"})
    tasks = jax.tree.map(lambda x: jnp.repeat(x, 4, axis=0), blind.tasks())
    states = jax.vmap(lambda *given: blind.reset(*given).state)(tasks, jax.random.split(jax.random.key(1), 8))
    pictures = []
    for env in (grid, general):
        tasks = jax.tree.map(lambda x: jnp.repeat(x, 4, axis=0), env.tasks())
        pictures.append(np.int32(jax.jit(jax.vmap(env.look_at), compiler_options=QUICK)(tasks, states)["pixels"]))
    apart = np.abs(pictures[0] - pictures[1]).max(axis=-1) > 12
    assert np.mean(apart) < 0.04 and np.mean(np.any(pictures[0] != pictures[0][:1], axis=-1)) > 0.5
    turned = np.abs(pictures[0][:, :, ::-1] - pictures[1]).max(axis=-1) > 12
    assert np.mean(turned) > 4 * np.mean(apart)


@pytest.mark.slow
def test_looks_vary_but_for_the_camera():
    env = seeing(repeat=1)
    varied = CorridorMaze(vary={"hue": "0,120", "floor-hue": "0,90"}, combine="paired", pixels=SIZE)
    seen = [picture(jax.tree.map(lambda x, i=i: x[i], varied.tasks()), at((2.5, 2.5)), varied) for i in (0, 1)]
    assert np.mean(np.any(seen[0] != seen[1], axis=-1)) > 0.4
    assert env.spec.obs["pixels"].shape == (SIZE, SIZE, 3)


def test_films_look_through_the_walker_s_eye_at_the_walls_of_the_task():
    """Camera and balls of MuJoCo's scene are where an episode has them; of all walls those of the task stand up."""
    env, row = CorridorMaze(vary={"layout": "0:3:4"}), 2
    task, state = jax.tree.map(lambda x: x[row], env.tasks()), at((1.25, 2.5), 0.7)
    model = env.scene_model(row)
    render._arrange(model, env.visible(task, state))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.cam_xpos[0], [1.25, 2.5, 0.5])
    axes = [[np.sin(0.7), -np.cos(0.7), 0], [0, 0, 1], [-np.cos(0.7), -np.sin(0.7), 0]]
    np.testing.assert_allclose(data.cam_xmat[0].reshape(3, 3).T, axes, atol=1e-6)
    np.testing.assert_allclose(data.geom("blue").xpos[:2], task.goal["balls"][BLUE])
    names = [model.geom(i).name for i in range(model.ngeom)]
    standing = [name for name in names if name.startswith("wall") and data.geom(name).xpos[2] > 0]
    assert len(standing) == 4 + np.sum(task.model["walls"][:, 1:-1])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cells": 1}, "cells must be a whole number from 2 to 20, not 1"),
        ({"cells": 21}, "cells must be a whole number from 2 to 20, not 21"),
        (
            {"vary": {"goal-colour": "0.5"}},
            r"goal-colour is one of 0 \(red\), 1 \(green\), 2 \(blue\); list them.*not 0.5",
        ),
        ({"vary": {"goal-colour": "0:2"}}, r"goal-colour is one of 0 \(red\).*not 0:2"),
        ({"vary": {"goal-colour": "pink"}}, "cannot read the values 'pink' of goal-colour"),
        ({"vary": {"goal-colour": "3"}}, "goal-colour must be greater than -1 and at most 2, not 3"),
        ({"vary": {"goal-colour": "0,1", "layout": "0,1"}, "combine": "random"}, "goal-colour has names"),
        ({"vary": {"camera-angle": "0,9"}, "pixels": 64}, "unknown parameter 'camera-angle'"),
        ({"vary": {"hue": "0,9"}}, "hue changes only what is seen; add pixels=64"),
        ({"pixels": 64, "painter": "caster", "cells": 6}, "at most 63 geoms, .* use --env.painter=auto"),
    ],
)
def test_what_cannot_be_is_refused_in_a_line(settings, message):
    with pytest.raises(InputError, match=message) as error:
        _ = mtjax.make("corridor-maze", **settings).spec
    assert "\n" not in str(error.value)
