"""Errands in sentences: the grammar, what is held out, the rules, and agents that read."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import plain_craft as plain
import pytest
from needs import needs
from probes import QUICK, tiny, with_nets
from test_craft import restated

import mtjax
from mtjax.agents import for_action
from mtjax.agents.networks import Params
from mtjax.agents.parts.knowing.text import encode
from mtjax.envs.craft.errands import ERRANDS, THINGS

ENV = mtjax.make("errands")
KINDS = {
    "iron": "iron",
    "grass": "grass",
    "wood": "wood",
    "anvil": "workshop 0",
    "loom": "workshop 1",
    "saw": "workshop 2",
}
PATTERNS = (
    r"(?P<verb>\w+) to the (?P<first>\w+), then to the (?P<second>\w+)\.",
    r"Before you (?P<verb>\w+) to the (?P<second>\w+), \w+ to the (?P<first>\w+)\.",
)


def parsed(sentence):
    """First thing, second thing and verb."""
    found = next(filter(None, (re.fullmatch(pattern, sentence) for pattern in PATTERNS)))
    return found["first"], found["second"], found["verb"].lower()


@pytest.fixture(scope="module")
def play():
    """Steps from a start of a task under actions, padded to a hundred: the start, and everything that they return."""

    def run(env, task, key, actions):
        start = env.reset(task, key)
        step = lambda state, action: (lambda after: (after.state, after))(env.step(task, state, action))
        return start, jax.lax.scan(step, start.state, actions)[1]

    run = jax.jit(run, static_argnums=0, compiler_options=QUICK)

    def padded(row, plan, env=ENV):
        """The actions follow from the start by ``plan``."""
        task = jax.tree.map(lambda x: x[row], env.tasks("all"))
        start, _ = run(env, task, jax.random.key(row), jnp.zeros(100, jnp.int32))
        actions = plan(restated(start.state.world.grid))
        _, steps = run(env, task, jax.random.key(row), jnp.int32([*actions, *[0] * (100 - len(actions))]))
        return actions, jax.tree.map(lambda x: np.asarray(x)[: len(actions)], steps)

    return padded


def visit(world, *things):
    """The actions that use things, which stay where they are."""
    actions = []
    for thing in things:
        moves = world.way_to(world.cells_of(KINDS[thing]))
        for action in moves:
            world.step(action)
        actions += [*moves, plain.USE]
    return actions


# Sentences.


def test_sentences_say_what_the_sketch_holds():
    """Each task's sentence, read by rules of this test alone, names the things of its sketch in their order."""
    sketches = np.asarray(ENV.tasks("all").goal["sketch"])
    names = list(THINGS)
    assert len(set(ENV.sentences)) == len(ENV.sentences) == 168 == len(ERRANDS)
    for sentence, sketch in zip(ENV.sentences, sketches, strict=True):
        assert [names.index(thing) for thing in parsed(sentence)[:2]] == sketch.tolist()


def test_new_orders_and_new_words_are_held_out():
    """Training has each thing of a new order in both places, and its other order; it never has the new word."""
    counts = ENV.counts
    ends = np.cumsum([counts[split] for split in ("train", "interpolation", "extrapolation")])
    train, orders, words = (set(map(parsed, x)) for x in np.split(np.array(ENV.sentences), ends[:-1]))
    pairs = {(first, second) for first, second, _ in train}
    new = {(first, second) for first, second, _ in orders}
    assert len(new) == 6 and not new & pairs and {pair[::-1] for pair in new} <= pairs
    assert {first for first, _ in new} == {second for _, second in new} == set(THINGS)
    assert {verb for *_, verb in train | orders} == {"go", "walk"} and {verb for *_, verb in words} == {"run"}
    assert {(first, second) for first, second, _ in words} == pairs and list(counts.values()) == [96, 24, 48]
    spoken = lambda said: {word for sentence in said for word in re.findall(r"\w+", sentence.lower())}
    assert spoken(ENV.sentences[120:]) - spoken(ENV.sentences[:96]) == {"run"}
    assert spoken(ENV.sentences[96:120]) <= spoken(ENV.sentences[:96])


@needs("sklearn")
def test_sentences_that_were_never_said_are_understood_by_what_they_share_with_others():
    """A linear reading of hashed sentences, fitted to training: all new orders, and all with the new word.

    By chance it would be 1 in 30.
    """
    vectors, sketches = encode("hashing", ENV.sentences, 96), np.asarray(ENV.tasks("all").goal["sketch"])
    wanted = np.eye(len(THINGS))[sketches].reshape(168, -1)
    train, rest = vectors[:96], vectors[96:]
    reading = np.linalg.solve(train.T @ train + 0.01 * np.eye(train.shape[1]), train.T @ wanted[:96])
    found = (rest @ reading).reshape(72, 2, len(THINGS)).argmax(axis=2)
    assert np.all(found == sketches[96:])
    shuffled = np.random.default_rng(0).permutation(72)
    assert np.all(found[shuffled] == sketches[96:], axis=1).mean() < 0.1


@needs("sklearn")
def test_an_agent_reads_the_sentence_of_every_split():
    """By conditioning=text each task's features are its own sentence's, held out or not."""
    agent = for_action(tiny("ppo", conditioning="text"), ENV.action)
    state = jax.eval_shape(lambda: agent.init(ENV.spec, ENV.tasks(), jax.random.key(0)))
    table, tasks = agent.conditioning.table(ENV.spec, 96), ENV.tasks("all")
    known = Params({"given": table, "known": ENV.tasks().context}, {})
    state = with_nets(state, tasks=known)
    features = jax.vmap(lambda task: agent.view.features(state, task))(tasks)
    np.testing.assert_allclose(features, encode("hashing", ENV.sentences, 96), atol=1e-6)


# Rules.


@pytest.mark.parametrize("row", (0, 33, 95, 100, 167))
def test_both_things_in_their_order_earn_a_half_each(row, play):
    """And end the episode; the things stay."""
    first, second, _ = parsed(ENV.sentences[row])
    actions, steps = play(row, lambda world: visit(world, first, second))
    half = actions.index(plain.USE)
    expected = np.zeros(len(actions))
    expected[[half, -1]] = 0.5
    np.testing.assert_array_equal(steps.reward, expected)
    np.testing.assert_array_equal(steps.terminated, np.arange(len(actions)) == len(actions) - 1)
    np.testing.assert_array_equal(steps.metrics["success"], steps.terminated)
    things = steps.state.world.grid.things
    assert np.all(things == things[0])
    used = np.asarray(steps.obs[-1][-10:-4])
    np.testing.assert_array_equal(used, [name in (first, second) for name in THINGS])


@pytest.mark.parametrize("row", (0, 60))
def test_a_wrong_thing_ends_the_episode_without_a_reward(row, play):
    """The second one first, a third one, or the first one twice."""
    first, second, _ = parsed(ENV.sentences[row])
    other = next(thing for thing in THINGS if thing not in (first, second))
    for wrong, earned in (((second,), 0.0), ((other,), 0.0), ((first, other), 0.5), ((first, first), 0.5)):
        actions, steps = play(row, lambda world, wrong=wrong: visit(world, *wrong))
        assert steps.reward.sum() == earned and not steps.metrics["success"].any()
        np.testing.assert_array_equal(steps.terminated, np.arange(len(actions)) == len(actions) - 1)


def test_a_sketch_pays_at_its_end(play):
    env = mtjax.make("errands", sketched=True, symbol_steps=50)
    first, second, _ = parsed(ENV.sentences[7])
    plan = lambda world: [*visit(world, first), plain.STOP, *visit(world, second), plain.STOP]
    _, steps = play(7, plan, env)
    assert steps.reward.tolist() == [0.0] * (len(steps.reward) - 1) + [1.0] and steps.terminated[-1]
    _, steps = play(7, lambda world: [*visit(world, first), plain.STOP, plain.STOP], env)
    assert not steps.reward.any() and steps.terminated[-1]
