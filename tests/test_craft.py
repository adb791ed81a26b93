"""The craft world against its rules, written out in plain Python: every step, plans for every task, and sketches."""

import jax
import jax.numpy as jnp
import numpy as np
import plain_craft as plain
import pytest
from probes import QUICK

import mtjax
from mtjax.envs.craft import crafts, grid
from mtjax.types import InputError

CRAFT = mtjax.make("craft")
SKETCHED = mtjax.make("craft", sketched=True)
NAMES = tuple(plain.SKETCHES)
SYMBOLS = CRAFT.symbols


def pick(env, row, split="train"):
    return jax.tree.map(lambda x: x[row], env.tasks(split))


@pytest.fixture(scope="module")
def begin():
    """Resets of both environments, compiled, of a task and a seed."""
    reset = jax.jit(lambda env, task, key: env.reset(task, key), static_argnums=0, compiler_options=QUICK)
    return lambda env, row, seed: reset(env, pick(env, row), jax.random.key(seed))


@pytest.fixture(scope="module")
def play():
    """Steps under actions, padded to a hundred: everything that they return."""

    def run(env, task, state, actions):
        step = lambda state, action: (lambda after: (after.state, after))(env.step(task, state, action))
        return jax.lax.scan(step, state, actions)[1]

    run = jax.jit(run, static_argnums=0, compiler_options=QUICK)

    def padded(env, row, state, actions):
        wait = env.action_size - 1
        steps = run(env, pick(env, row), state, jnp.int32([*actions, *[wait] * (100 - len(actions))]))
        return jax.tree.map(lambda x: np.asarray(x)[: len(actions)], steps)

    return padded


def restated(world):
    """The world in plain Python."""
    things = {(int(x), int(y)): grid.KINDS[world.things[x, y]] for x, y in np.argwhere(np.asarray(world.things))}
    return plain.Craft(things, np.asarray(world.place).tolist())


def held(world):
    return {item: int(n) for item, n in zip(crafts.ITEMS, world.held, strict=True) if n}


# Rules.


def test_sketches_and_recipes_are_the_papers():
    assert {name: " ".join(sketch) for name, sketch in CRAFT.sketches.items()} == plain.SKETCHES
    made = {(r.product, f"workshop {r.workshop}", r.inputs) for r in crafts.RECIPES}
    assert made == {(p, shop, tuple(x)) for shop, rows in plain.RECIPES.items() for p, *x in rows}


@pytest.mark.parametrize("row", range(10))
def test_random_steps_follow_the_rules(row, begin, play):
    """A hundred steps, mostly of use: things, place, facing and items after each."""
    start = begin(CRAFT, row, row)
    world, actions = restated(start.state.world), np.random.default_rng(row).choice(5, 100, p=[0.15] * 4 + [0.4])
    steps = play(CRAFT, row, start.state, actions.tolist())
    for i, action in enumerate(actions):
        world.step(int(action))
        after = jax.tree.map(lambda x, i=i: x[i], steps.state.world)
        expected = restated(after)
        assert (expected.things, expected.place, int(after.facing)) == (world.things, world.place, world.facing)
        assert held(after) == {item: n for item, n in world.held.items() if n}


@pytest.mark.parametrize("first, then", [("bridge", "water"), ("axe", "stone")])
def test_tools_clear_the_way(first, then):
    """A bridge is used up, and an axe is kept; without them nothing happens."""
    kind, item = grid.KINDS.index(then), crafts.ITEMS.index(first)
    for count in (0, 2):
        items = jnp.zeros(len(crafts.ITEMS), jnp.int32).at[item].set(count)
        after, clears = CRAFT.use(items, jnp.int32(kind))
        assert clears == (count > 0)
        assert after[item] == (count - (first == "bridge") if count else 0) and after.sum() == after[item]


def test_a_workshop_makes_all_that_it_can_in_order():
    """A stick and iron are shears at once, and so a stick of this moment is."""
    items = {"wood": 2, "iron": 1, "plank": 1, "grass": 1}
    start = jnp.int32([items.get(item, 0) for item in crafts.ITEMS])
    after = crafts.make(start, jnp.int32(1))
    assert {item: int(n) for item, n in zip(crafts.ITEMS, after, strict=True) if n} == {
        "wood": 1,
        "bed": 1,
        "shears": 1,
    }
    np.testing.assert_array_equal(crafts.make(start, jnp.int32(-3)), start)


# Layouts and plans.


def layouts(row, count):
    reset = jax.jit(jax.vmap(CRAFT.reset, (None, 0)), compiler_options=QUICK)
    world = reset(pick(CRAFT, row), jax.random.split(jax.random.key(7), count)).state.world
    return [jax.tree.map(lambda x, i=i: np.asarray(x)[i], world) for i in range(count)]


@pytest.mark.parametrize("row", (0, 8, 9))
def test_layouts_hold_what_they_should_and_all_of_it_can_be_reached(row):
    """Four of each raw material, three workshops, a treasure in its ring at the lower boundary if it is asked for."""
    worlds = layouts(row, 100)
    assert len({world.things.tobytes() for world in worlds}) == 100
    for world in map(restated, worlds):
        count = {kind: len(world.cells_of(kind)) for kind in grid.KINDS[1:]}
        assert count["boundary"] == 36 and all(count[f"workshop {i}"] == 1 for i in range(3))
        assert count["iron"] == count["grass"] == count["wood"] == 4
        assert count["gold"] == (row == 8) and count["gem"] == (row == 9)
        assert all(
            world.way_to({cell}) is not None
            for kind in (*plain.RECIPES, "iron", "grass", "wood")
            for cell in world.cells_of(kind)
        )
        for treasure in world.cells_of("gold") | world.cells_of("gem"):
            ring = world.cells_of("water") | world.cells_of("stone")
            near = {(treasure[0] + i, 1 + j) for i in (-1, 0, 1) for j in (0, 1)} - {treasure}
            assert ring == {cell for cell in near if 1 <= cell[0] <= 8} and treasure[1] == 1
            assert world.way_to(ring & plain.around(treasure)) is not None
    places = np.array([world.place for world in worlds])
    assert places.min() == 1 and places.max() == 8 and np.ptp(places[:, 1]) >= 5


def test_layouts_that_enclose_something_are_refused():
    """A thing in a corner behind two others, the walker behind two, and treasure whose ring is blocked."""

    def world(things, place=(4, 4)):
        cells = np.zeros((10, 10), np.int32)
        cells[[0, -1]] = cells[:, [0, -1]] = grid.BOUNDARY
        for cell, kind in things.items():
            cells[cell] = kind
        return grid.Grid(jnp.asarray(cells), jnp.int32(place), jnp.int32(0), jnp.zeros(5, jnp.int32))

    corner = {(1, 1): grid.WOOD, (2, 1): grid.IRON}
    assert grid.reachable(world(corner))
    assert not grid.reachable(world({**corner, (1, 2): grid.GRASS}))
    assert not grid.reachable(world({(2, 1): grid.IRON, (1, 2): grid.GRASS, (5, 5): grid.WOOD}, (1, 1)))
    ring = {(x, y): grid.WATER for x in (3, 4, 5) for y in (1, 2)} | {(4, 1): grid.GOLD}
    shops = dict(zip([(2, 1), (6, 1), (4, 3)], grid.WORKSHOPS, strict=True))
    assert grid.reachable(world(ring))
    assert not grid.reachable(world(ring | shops)) and grid.reachable(world(ring | dict(list(shops.items())[:2])))


@pytest.mark.parametrize("row", range(10), ids=NAMES)
def test_the_sketch_solves_the_task_when_each_symbol_is_carried_out(row, begin, play):
    """In eight layouts, within a hundred steps: the reward comes with the last action, and not before."""
    for seed in range(8):
        start = begin(CRAFT, row, seed)
        world, actions = restated(start.state.world), []
        for symbol in CRAFT.sketches[NAMES[row]]:
            actions += world.carry_out(symbol)
        steps = play(CRAFT, row, start.state, actions)
        np.testing.assert_array_equal(steps.reward, [0.0] * (len(actions) - 1) + [1.0])
        np.testing.assert_array_equal(steps.terminated, steps.reward > 0)
        np.testing.assert_array_equal(steps.metrics["success"], steps.reward)


def test_a_sketch_in_another_order_does_not_solve_the_task(begin, play):
    """Without the first symbol nothing is made."""
    start = begin(CRAFT, 0, 0)
    world = restated(start.state.world)
    actions = world.carry_out("make-at-0") + world.carry_out("get-wood")
    assert not play(CRAFT, 0, start.state, actions).reward.any()


# Sketches.


def due_symbols(steps):
    """The symbols that observations show, by number; -1 for none."""
    shown = steps.obs[:, -len(SYMBOLS) :]
    return np.where(shown.any(axis=1), shown.argmax(axis=1), -1)


@pytest.mark.parametrize("row", (0, 5, 9))
def test_stop_goes_on_to_the_next_symbol_and_the_last_one_pays(row, begin, play):
    """Each symbol is shown from the step after which it is due; STOP changes nothing else."""
    env = mtjax.make("craft", sketched=True, symbol_steps=100)
    start = begin(env, row, 3)
    world, actions, expected = restated(start.state.world), [], []
    sketch = env.sketches[NAMES[row]]
    for place, symbol in enumerate(sketch):
        done = world.carry_out(symbol)
        actions += [*done, plain.STOP]
        after = SYMBOLS.index(sketch[place + 1]) if place + 1 < len(sketch) else -1
        expected += [SYMBOLS.index(symbol)] * len(done) + [after]
    steps = play(env, row, start.state, actions)
    np.testing.assert_array_equal(due_symbols(steps), expected)
    np.testing.assert_array_equal(steps.reward, [0.0] * (len(actions) - 1) + [1.0])
    np.testing.assert_array_equal(steps.terminated, steps.reward > 0)
    stop = actions.index(plain.STOP)
    before, after = (jax.tree.map(lambda x, i=i: x[i], steps.state.world) for i in (stop - 1, stop))
    jax.tree.map(np.testing.assert_array_equal, before, after)


def test_a_sketch_that_stops_too_early_ends_without_a_reward(begin, play):
    start = begin(SKETCHED, 1, 0)
    steps = play(SKETCHED, 1, start.state, [plain.STOP] * 2)
    assert steps.terminated.tolist() == [False, True] and not steps.reward.any() and not steps.metrics["success"].any()


def test_a_symbol_is_over_after_its_steps(begin, play):
    """Its last action still counts; STOP begins the count anew."""
    start = begin(SKETCHED, 4, 0)
    steps = play(SKETCHED, 4, start.state, [0] * 3 + [plain.STOP] + [0] * 15 + [0] * 15)
    sketch = [SYMBOLS.index(symbol) for symbol in SKETCHED.sketches["bridge"]]
    np.testing.assert_array_equal(due_symbols(steps)[:33], [sketch[0]] * 3 + [sketch[1]] * 15 + [sketch[2]] * 15)
    assert np.flatnonzero(steps.terminated)[0] == 33


# Observations.


def test_observations_show_what_is_around(begin):
    """The near cells and far blocks by brute force, items and facing; the same at the grid's edge."""
    for seed in range(6):
        start = begin(CRAFT, 8, seed)
        world, obs = start.state.world, np.asarray(start.obs)
        x, y = np.asarray(world.place)
        padded = np.zeros((60, 60), int)
        padded[25:35, 25:35] = world.things
        kinds = np.eye(12)[padded][..., 1:]
        near = kinds[25 + x - 2 : 25 + x + 3, 25 + y - 2 : 25 + y + 3]
        wide = kinds[25 + x - 12 : 25 + x + 13, 25 + y - 12 : 25 + y + 13]
        far = wide.reshape(5, 5, 5, 5, 11).max(axis=(1, 3))
        np.testing.assert_array_equal(obs, [*near.ravel(), *far.ravel(), *np.zeros(14), 1, 0, 0, 0])


@pytest.mark.parametrize("row", (0, 8))
def test_films_show_every_thing_in_its_cell(row, begin):
    """And put what is not there under the floor."""
    start = begin(CRAFT, row, 1)
    world, marks = restated(start.state.world), CRAFT.marks(pick(CRAFT, row), start.state)
    shown = [
        (name[:-2], tuple(np.round(mark.position).astype(int)[:2]))
        for name, mark in marks.items()
        if name not in ("walker", "nose") and mark.position[2] > 0
    ]
    there = [(thing, cell) for cell, thing in world.things.items() if thing != "boundary"]
    assert sorted(shown) == sorted(there) and len(marks) == 2 + 15 + 12
    assert {name for name in marks} <= {geom.name for geom in CRAFT.compile_spec().geoms}
    np.testing.assert_allclose(marks["walker"].position[:2], world.place)
    np.testing.assert_allclose(marks["nose"].position[:2], np.add(world.place, (0, -0.3)), rtol=1e-6)


def test_held_out_tasks_have_known_symbols_in_new_orders():
    env = mtjax.make("craft", split="dense")
    assert env.labels("interpolation") == ["bed", "axe"] and len(env.labels("train")) == 8
    assert {s for name in env.labels("train") for s in env.sketches[name]} == set(SYMBOLS)
    everything = env.tasks("all")
    shown = np.asarray(everything.context).reshape(10, 5, len(SYMBOLS))
    np.testing.assert_array_equal(shown, np.eye(len(SYMBOLS) + 1)[np.asarray(everything.goal["sketch"])][..., :-1])
    np.testing.assert_array_equal(shown.sum(axis=(1, 2)), everything.goal["length"])
    other = mtjax.make("craft", split="dense", held_out=("gem",))
    assert other.labels("interpolation") == ["gem"]
    some = mtjax.make("craft", vary={"goal": "plank,bed"}, split="dense")
    assert some.labels("train") == ["plank"] and some.sentences == ("Make a plank.", "Make a bed.")


@pytest.mark.parametrize(
    "given, said",
    [
        ({"held_out": ("sofa",)}, "held-out names tasks, such as plank; there is no sofa"),
        ({"held_out": NAMES, "split": "dense"}, "held-out leaves no task to train on"),
        ({"symbol_steps": 0}, "symbol-steps must be at least 1, not 0"),
        ({"cells": 3}, "cells must be a whole number from 4 to 30, not 3"),
        ({"copies": 12}, "copies must be at least 1 and at most 11 with cells=8, .* not 12"),
        ({"sketched": True, "pixels": 64}, "pictures do not show the symbol that is due"),
        ({"vary": {"goal": "sofa"}}, "cannot read the values 'sofa' of goal"),
    ],
)
def test_what_makes_no_sense_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        mtjax.make("craft", **given)
