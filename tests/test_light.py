"""Rooms with keys and doors against their rules, written out in plain Python: every step, plans, and layouts."""

import jax
import jax.numpy as jnp
import numpy as np
import plain_craft as plain
import pytest
from probes import QUICK

import mtjax
from mtjax.envs.craft.light import Rooms

LIGHT = mtjax.make("light-world")
PATHS = ("LL", "LD", "RD", "UL", "UR", "URU", "DRU", "LLD", "RDD", "LUR")
WAYS = {"L": "left", "R": "right", "U": "up", "D": "down"}


def pick(row):
    return jax.tree.map(lambda x: x[row], LIGHT.tasks())


@pytest.fixture(scope="module")
def play():
    """Steps from a start under actions, padded to a hundred: everything that they return."""

    def run(task, state, actions):
        step = lambda state, action: (lambda after: (after.state, after))(LIGHT.step(task, state, action))
        return jax.lax.scan(step, state, actions)[1]

    run = jax.jit(run, compiler_options=QUICK)

    def padded(row, state, actions):
        steps = run(pick(row), state, jnp.int32([*actions, *[plain.USE] * (100 - len(actions))]))
        return jax.tree.map(lambda x: np.asarray(x)[: len(actions)], steps)

    return padded


@pytest.fixture(scope="module")
def starts():
    """Starts of a task, as many as asked for."""
    reset = jax.jit(jax.vmap(LIGHT.reset, (None, 0)), compiler_options=QUICK)

    def many(row, count=40):
        found = reset(pick(row), jax.random.split(jax.random.key(row), 200))
        return [jax.tree.map(lambda x, i=i: x[i], found) for i in range(count)]

    return many


def restated(world):
    """The rooms in plain Python."""
    doors = {}
    for door, exists, key, locked in zip(
        *map(np.asarray, (world.doors, world.exists, world.keys, world.locked)), strict=True
    ):
        if exists:
            assert tuple(door.tolist()) not in doors
            doors[tuple(door.tolist())] = tuple(key.tolist()) if locked else None
    return plain.Rooms(np.asarray(world.place).tolist(), doors, np.asarray(world.goal).tolist())


def test_sketches_are_the_papers():
    assert LIGHT.sketches == {path: tuple(WAYS[way] for way in path) for path in PATHS}
    assert LIGHT.sentences[7] == "Go left, then left, then down." and len(set(LIGHT.sentences)) == 10


@pytest.mark.parametrize("row", range(10), ids=PATHS)
def test_random_steps_follow_the_rules(row, starts, play):
    """A hundred steps: place, locks, lights and reward after each; most go towards where they went before."""
    random = np.random.default_rng(row)
    start = starts(row, 1)[0]
    rooms = restated(start.state.world)
    actions = np.concatenate(
        [np.full(random.integers(1, 5), random.choice(5, p=[0.22] * 4 + [0.12])) for _ in range(99)]
    )
    steps = play(row, start.state, actions[:100].tolist())
    np.testing.assert_allclose(start.obs, rooms.lights(), atol=1e-6)
    for i, action in enumerate(actions[:100]):
        rooms.step(int(action))
        after = restated(jax.tree.map(lambda x, i=i: x[i], steps.state.world))
        assert (after.place, after.doors) == (rooms.place, rooms.doors)
        np.testing.assert_allclose(steps.obs[i], rooms.lights(), atol=1e-6)
        assert steps.reward[i] == steps.terminated[i] == (rooms.room() == rooms.goal)


@pytest.mark.parametrize("row", range(10), ids=PATHS)
def test_the_sketch_solves_the_task_when_each_symbol_is_carried_out(row, starts, play):
    """In eight layouts, within a hundred steps: the reward comes in the goal's room, and not before."""
    locked = 0
    for start in starts(row, 8):
        rooms, actions = restated(start.state.world), []
        locked += sum(key is not None for key in rooms.doors.values())
        for symbol in LIGHT.sketches[PATHS[row]]:
            actions += rooms.carry_out(symbol)
        steps = play(row, start.state, actions)
        first = np.flatnonzero(steps.terminated)[0]
        assert len(actions) < 100 and steps.reward[first] == 1 and first >= len(actions) - 2
    assert locked


@pytest.mark.parametrize("row", (0, 6))
def test_layouts_are_as_large_as_the_path_and_one_room_more_at_each_side(row, starts):
    """Of all four sides; doors lead between rooms that there are, half are locked, and keys lie before them."""
    path = np.cumsum(
        [(0, 0), *({"L": (-1, 0), "R": (1, 0), "U": (0, 1), "D": (0, -1)}[way] for way in PATHS[row])], axis=0
    )
    found, locked, doors = set(), 0, 0
    for start in starts(row, 200):
        world = start.state.world
        first = np.asarray(world.place) // 6
        assert np.all(np.asarray(world.place) % 6 == 3)
        np.testing.assert_array_equal(world.goal, first + path[-1])
        found.add(tuple((first + path.min(axis=0)).tolist()))
        rooms = restated(world)
        assert len(PATHS[row]) <= len(rooms.doors) <= len(PATHS[row]) + 4
        for door, key in rooms.doors.items():
            assert sorted((door[0] % 6, door[1] % 6)) == [0, 3] and min(door) > 0 and max(door) < 30
            locked, doors = locked + (key is not None), doors + 1
            if key is not None:
                beside = {((door[0] + i) // 6, (door[1] + j) // 6) for i in (-1, 1) for j in (-1, 1)}
                assert (key[0] // 6, key[1] // 6) in beside and all(2 <= x % 6 <= 5 for x in key)
    assert found == {(0, 0), (0, 1), (1, 0), (1, 1)}
    assert abs(locked / doors - 0.5) < 0.05


def test_a_key_opens_its_door_alone(play):
    """A locked door stops the walker, until its key is taken; the other one stays locked."""
    doors = jnp.zeros((7, 2), jnp.int32).at[:2].set(jnp.int32([(6, 3), (3, 6)]))
    keys = jnp.zeros((7, 2), jnp.int32).at[:2].set(jnp.int32([(3, 2), (2, 3)]))
    there = jnp.arange(7) < 2
    start = LIGHT.reset(pick(0), jax.random.key(0)).state
    world = Rooms(jnp.int32([5, 3]), doors, there, keys, there, jnp.int32([4, 4]))
    down, up, left, right = range(4)
    actions = [right, left, left, down, plain.USE, up, up, up, up, down, down, right, right, right, right]
    steps = play(2, start._replace(world=world), actions)
    places = [(5, 3), (4, 3), (3, 3), (3, 2), (3, 2), (3, 3), (3, 4), (3, 5), (3, 5), (3, 4), (3, 3)]
    np.testing.assert_array_equal(steps.state.world.place, [*places, (4, 3), (5, 3), (6, 3), (7, 3)])
    np.testing.assert_array_equal(steps.state.world.locked[-1], [False, True] + [False] * 5)
