"""The two-goal maze against MTEnv's rules, written out here in float64 with every wall: moves, goals, sign, starts."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, tiny

from mtjax.agents import for_action
from mtjax.config import configure
from mtjax.envs.mtenv.maze import MazeState, TwoGoalMaze
from mtjax.learning import loop
from mtjax.types import Discrete, InputError, Spec

MAZE = TwoGoalMaze(vary={"goal-box": "0,1"}, split="none")
SCORED = TwoGoalMaze(vary={"goal-box": "0,1"}, split="none", scores=True)
SEEING = TwoGoalMaze(vary={"goal-box": "0,1"}, split="none", observe_boxes=True)
LEFT, RIGHT, AHEAD = np.arange(3, dtype=np.int32)
EAST, NORTH, WEST, SOUTH = 0, 2, 4, 6
FAR_BOXES = ((2.4, 2.4), (-2.4, 2.4))


@pytest.fixture(scope="module")
def step():
    return jax.jit(MAZE.step)


def task(number):
    return jax.tree.map(lambda x: x[number], MAZE.tasks())


def state(position, turns=EAST, boxes=FAR_BOXES):
    return MazeState(jnp.float32(position), jnp.int32(turns), jnp.float32(boxes))


def walls():
    """All twelve walls (12, 2, 2): three sides of each of the four strips around the room of 6 x 6 m."""
    east = [((3, -3), (4, -3)), ((4, -3), (4, 3)), ((4, 3), (3, 3))]
    quarter = lambda place, turns: place if turns == 0 else quarter((-place[1], place[0]), turns - 1)
    return np.float64([(quarter(a, turns), quarter(b, turns)) for a, b in east for turns in range(4)])


FROM, TO = np.moveaxis(walls(), 1, 0)


def wall_distance(place):
    """The distance to the nearest of them."""
    share = np.clip(((place - FROM) * (TO - FROM)).sum(axis=1) / ((TO - FROM) ** 2).sum(axis=1), 0, 1)
    return np.linalg.norm(FROM + share[:, None] * (TO - FROM) - place, axis=1).min()


def reference(goal, position, direction, boxes, action):
    """MTEnv's step: position, direction [rad], the observation, reward and end. Directions turn from +x towards -z."""
    direction = direction + (math.pi / 4, -math.pi / 4, 0)[action]
    facing = np.array([math.cos(direction), -math.sin(direction)])
    ahead = position + 0.51 * facing
    if action == 2 and wall_distance(ahead) >= 0.4:
        position = ahead
    near = np.linalg.norm(boxes - position, axis=1) < 2
    heading = math.atan2(*np.round(facing, 12) + 0.0)
    sign = (2 * goal - 1) * (-1.7 < heading < -1.5)
    obs = [*(position / 3 * 2.1 - 1), heading, sign]
    return position, direction, obs, -1.0 if near[1 - goal] else float(near[goal]), bool(near.any())


def test_walks_follow_the_rules():
    """120 episodes of both tasks, mostly ahead: every observation to 1e-5, every reward and end, walls included."""
    random = np.random.default_rng(0)
    tasks, keys = MAZE.tasks(), jax.random.split(jax.random.key(0), 120)
    goals, actions = np.arange(120) % 2, random.choice(3, p=[0.15, 0.15, 0.7], size=(120, 40))
    tasks = jax.tree.map(lambda x: x[goals], tasks)

    def episode(task, key, actions):
        start = MAZE.reset(task, key)
        walk = lambda step, action: (MAZE.step(task, step.state, action),) * 2
        return start, jax.lax.scan(walk, start, actions)[1]

    start, steps = jax.tree.map(np.asarray, jax.jit(jax.vmap(episode))(tasks, keys, actions))
    stops = ends = 0
    for i in range(120):
        position, direction = np.float64(start.state.position[i]), start.state.turns[i] * math.pi / 4
        for t, action in enumerate(actions[i]):
            before = position
            position, direction, obs, reward, end = reference(
                goals[i], position, direction, np.float64(start.state.boxes[i]), action
            )
            assert np.all(np.abs(steps.obs[i, t] - obs) <= 1e-5)
            assert (steps.reward[i, t], steps.terminated[i, t]) == (reward, end)
            stops += action == 2 and before is position
            if end:
                ends += 1
                break
    assert stops > 100 and 30 < ends < 120


def test_the_task_given_is_the_task_played(step):
    """The same walk east reaches the blue box: a goal in task 0, the wrong box in task 1."""
    boxes = ((2, 0), (-2, -2.4))
    for number, reward in ((0, 1.0), (1, -1.0)):
        now, seen = state((-2.6, 0), EAST, boxes), []
        for _ in range(6):
            result = step(task(number), now, AHEAD)
            now, seen = result.state, [*seen, (float(result.reward), bool(result.terminated))]
        assert seen == [(0.0, False)] * 5 + [(reward, True)]
    mirrored = step(task(1), state((0.3, 0), EAST, boxes[::-1]), LEFT)
    assert (mirrored.reward, mirrored.terminated) == (1, True)


def test_within_reach_of_both_boxes_is_the_wrong_one(step):
    """MTEnv looks at the wrong box last."""
    for number in (0, 1):
        result = step(task(number), state((0, 0), EAST, ((1, 0), (-1, 0))), LEFT)
        assert (result.reward, result.terminated) == (-1, True)


def test_resets_keep_the_task():
    """Every reset of a task plays that task, unlike MTEnv's: its sign shows after a turn to the west."""

    def sign(number, key):
        start = MAZE.reset(task(number), key)
        look = start.state._replace(turns=jnp.int32(WEST - 1))
        return MAZE.step(task(number), look, LEFT).obs[3]

    keys = jax.random.split(jax.random.key(0), 50)
    for number, expected in ((0, -1), (1, 1)):
        np.testing.assert_array_equal(jax.jit(jax.vmap(sign, (None, 0)), static_argnums=0)(number, keys), expected)


def test_the_sign_shows_only_to_the_west(step):
    """And never before the first step. Headings are those of atan2(x, z): south is 0."""
    headings = np.array([2, 3, 4, -3, -2, -1, 0, 1]) * math.pi / 4  # of eighths of a turn left from east
    for turns in range(8):
        result = step(task(1), state((0, 0), (turns + 1) % 8), RIGHT)
        assert result.state.turns == turns
        np.testing.assert_allclose(result.obs[2], headings[turns], rtol=1e-6)
        assert result.obs[3] == (turns == WEST)
    starts = jax.jit(jax.vmap(MAZE.reset, (None, 0)))(task(1), jax.random.split(jax.random.key(0), 64))
    assert np.any(starts.state.turns == WEST) and not np.any(starts.obs[:, 3])


@pytest.mark.parametrize(("turns", "move"), [(EAST, (1, 0)), (NORTH, (0, -1)), (WEST, (-1, 0)), (SOUTH, (0, 1))])
def test_walls_stop_a_walker(step, turns, move):
    """In a strip 1 m beyond the room its centre can come 3.6 m from the middle, and no further; it does not slide."""
    towards = np.array(move)
    for start, moved in ((3.05, True), (3.1, False)):
        result = step(task(0), state(start * towards, turns), AHEAD)
        np.testing.assert_allclose(result.state.position, (start + 0.51 * moved) * towards, atol=1e-5)
        np.testing.assert_allclose(result.obs[:2], (start + 0.51 * moved) * towards * 0.7 - 1, atol=1e-5)


def test_corners_of_the_room_stick_out(step):
    """There a walker must pass 0.4 m from the point where two strips' walls meet."""
    for position, moved in (((2.5, 2.3), True), ((2.65, 2.3), False)):
        result = step(task(0), state(position, SOUTH, ((-2, -2), (-2, 2))), AHEAD)
        assert np.allclose(result.state.position, position) != moved


def test_a_step_takes_the_highest_score():
    """If it takes scores; of equal ones the first."""
    step = jax.jit(SCORED.step)
    for scores, turns in (((0.1, -0.2, 0), 1), ((-1, -0.9, -1), 7), ((0, 0, 0), 1), ((-1, 0, 0), 7)):
        assert step(task(0), state((0, 0)), jnp.float32(scores)).state.turns == turns


def test_episodes_start_apart():
    """Boxes fit the room and do not overlap; the walker is 2 m from both, anywhere, facing any of eight ways."""
    keys = jax.random.split(jax.random.key(3), 4000)
    reset = jax.jit(jax.vmap(SEEING.reset, (None, 0)))
    start = reset(task(0), keys)
    position, turns, boxes = map(np.asarray, start.state)
    gap = lambda a, b: np.linalg.norm(a - b, axis=-1)
    radius = math.sqrt(2) * 0.4
    assert 2.4 < np.abs(boxes).max() <= 3 - radius and 2.55 < np.abs(position).max() <= 2.6
    assert 2 * radius <= gap(boxes[:, 0], boxes[:, 1]).min() < 1.2
    assert 2 <= gap(boxes, position[:, None]).min() < 2.05
    np.testing.assert_allclose(boxes.mean(axis=0), 0, atol=0.1)
    np.testing.assert_allclose(boxes[:, 0].std(axis=0), (3 - radius) / math.sqrt(3), rtol=0.04)
    assert np.all(np.abs(np.bincount(turns, minlength=8) / 4000 - 1 / 8) < 0.03)
    assert not np.any(start.terminated) and not np.any(start.reward)
    np.testing.assert_allclose(start.obs[:, :2], position * 0.7 - 1, atol=1e-6)
    np.testing.assert_allclose(start.obs[:, 4:], boxes.reshape(4000, 4) * 0.7 - 1, atol=1e-6)
    np.testing.assert_array_equal(start.obs, reset(task(0), keys).obs)


def test_both_tasks_and_nothing_between():
    """Blue is context -1 and red 1; what is neither is refused."""
    np.testing.assert_array_equal(MAZE.tasks().context, [[-1], [1]])
    specs = [env.spec._replace(sentences=()) for env in (MAZE, SEEING)]
    assert specs == [Spec.vector(size, 3, 1)._replace(action=Discrete(3)) for size in (4, 8)]
    assert [len(MAZE.tasks(split).id) for split in ("train", "interpolation", "extrapolation")] == [2, 0, 0]
    np.testing.assert_array_equal(TwoGoalMaze().tasks().goal["goal-box"], [0])
    named = TwoGoalMaze(vary={"goal-box": "blue,red"})
    assert [named.describe(i) for i in (0, 1)] == ["goal-box=blue", "goal-box=red"] and named.train_count == 2
    for values in ("0.5", "0:1"):
        with pytest.raises(InputError, match=rf"goal-box is one of 0 \(blue\), 1 \(red\); .*; not {values}"):
            TwoGoalMaze(vary={"goal-box": values})


@pytest.mark.parametrize(
    ("env", "name", "given"),
    [
        (MAZE, "ppo", {"unroll": 2, "minibatches": 1}),
        (SCORED, "sac-conditioned", {"batch_size": 4, "replay_size": 12, "warmup_steps": 1}),
    ],
)
def test_an_agent_trains_on_it(env, name, given):
    """Traced, not run: the loop, agent and tasks fit together; the loop counts time."""
    agent = for_action(tiny(name), env.spec.action)
    agent, settings = configure(agent, loop.Settings(), {"num_envs": 2, "chunk_steps": 2, **given})
    assert env.episode_length == 200
    state = jax.eval_shape(lambda: loop.init(env, agent, settings, env.tasks(), jnp.arange(1)))
    after, _ = jax.eval_shape(lambda state: loop.run_chunk(env, agent, settings, env.tasks(), state), state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)


# Pictures.


SEEN = TwoGoalMaze(vary={"goal-box": "0,1"}, split="none", pixels=64)


@pytest.fixture(scope="module")
def draw():
    return jax.jit(lambda task, state: SEEN.look_at(task, state)["pixels"], compiler_options=QUICK)


def middle(mask):
    """Where in the maze, x and z, the middle of a mask (64, 64) is, 0.4 m above the floor."""
    rows, columns = np.nonzero(mask)
    return (np.array([columns.mean(), rows.mean()]) - 31.5) * 10.6 * 2 * math.tan(math.radians(22.5)) / 64


@pytest.mark.parametrize(("turns", "goal"), [(EAST, 1), (WEST, 0), (WEST, 1)])
def test_pictures_show_the_maze_from_above(draw, turns, goal):
    """The walker, both boxes, and before the west wall the colour of the goal, while the walker faces it."""
    world = state((1.5, -2.0), turns, ((-2.0, 1.0), (2.0, 2.0)))
    picture = np.int32(draw(task(goal), world))
    red, green, blue = np.moveaxis(picture, -1, 0)
    west = np.arange(64) < 12
    masks = {"blue": (blue > 200) & (red < 150), "red": (red > 200) & (blue < 150) & (green < 150)}
    for i, mask in enumerate(masks.values()):
        assert np.all(np.abs(middle(mask & ~west) - world.boxes[i]) < 0.15)
        assert np.any(mask & west) == (turns == WEST and i == goal)
    walker = (red > 200) & (green > 200) & (blue < 150)
    assert np.all(np.abs(middle(walker) - world.position) < 0.2)
    beside = np.hypot(*(np.indices((64, 64)) - np.argwhere(walker).mean(axis=0)[:, None, None])) < 8
    dark = middle(beside & (picture.max(axis=-1) < 60))
    assert (dark[0] > world.position[0]) == (turns == EAST)


def test_looks_of_tasks_differ():
    """Tasks of two hues have boxes of other colours."""
    env = TwoGoalMaze(vary={"hue": "0,120"}, split="none", pixels=16)
    one, other = env.tasks().scene["geom_rgba"]
    assert not np.array_equal(one, other)


@pytest.mark.slow
def test_pictures_change_nothing_else(step):
    """The state beside them is that without them, at the start and after a step."""
    env = TwoGoalMaze(vary={"goal-box": "0,1"}, split="none", pixels=16, state="also", repeat=2, grey=True)
    begin = jax.jit(lambda key: env.reset(task(1), key).obs["state"], compiler_options=QUICK)  # draws nothing
    key = jax.random.key(4)
    plain = MAZE.reset(task(1), key)
    np.testing.assert_array_equal(begin(key), plain.obs)
    after = jax.jit(env.step, compiler_options=QUICK)(task(1), plain.state, LEFT)
    twice = step(task(1), step(task(1), plain.state, LEFT).state, LEFT)
    np.testing.assert_allclose(after.obs["state"], twice.obs, atol=1e-6)
    assert after.obs["pixels"].shape == (16, 16, 1) and env.episode_length == 100


def test_a_repeated_action_leaves_the_walker_at_the_box(step):
    """Where the first of two steps has ended the episode: neither observation nor place are of a step after the end."""
    env = TwoGoalMaze(vary={"goal-box": "0,1"}, split="none", repeat=2)
    begun = state((0.0, 0.0), boxes=((2.4, 0), (-2, 2)))
    once, again = step(task(0), begun, AHEAD), step(task(0), step(task(0), begun, AHEAD).state, AHEAD)
    both = jax.jit(env.step)(task(0), begun, AHEAD)
    assert once.terminated and both.terminated and both.reward == once.reward == 1
    np.testing.assert_array_equal(both.obs, once.obs)
    assert np.any(again.obs != once.obs)
