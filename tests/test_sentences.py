"""What tasks ask for in sentences, the vectors of sentences, and agents that read them."""

import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import require
from probes import pick, tasks_of, tiny, with_nets

import mtjax
from mtjax.agents.networks import Params
from mtjax.agents.parts.knowing import text as sentences
from mtjax.envs import ENVS
from mtjax.learning.evaluation import Episodes
from mtjax.report import scoring
from mtjax.types import InputError, Spec

TASKS, KEY = tasks_of("one-step", (1.0, -0.5)), jax.random.key(0)
SPEC = Spec.vector(3, 2, 1)._replace(sentences=("Walk.", "Run.", "Walk with size 1.5."))  # the last is held out


@pytest.fixture
def hashing():
    require("sklearn")
    return lambda *said, learned=None: sentences.encode("hashing", said, len(said) if learned is None else learned)


# Sentences.


def instruction(name):
    try:
        return mtjax.make(name).instruction
    except InputError:  # its scenes or its library are not installed
        return None


def test_every_family_says_what_it_asks_for():
    """In one plain sentence that no family with other tasks has."""
    said = {name: instruction(name) for name in list(ENVS.data)}
    for name, sentence in said.items():
        if sentence is not None:
            assert sentence[0].isupper() and sentence.endswith(".") and "`" not in sentence and ". " not in sentence, (
                name
            )
    plain = {
        n: x
        for n, x in said.items()
        if x and "vary" not in n and not n.endswith(("-sparse", "-hard", "-seen", "-sketched"))
    }
    assert len(set(plain.values())) >= len(plain) - 3  # Brax's pole, and two reachers, ask for what others do


def test_a_sentence_tells_the_parameters_that_are_given():
    family = mtjax.make("finger-spin", vary={"size": "0.9,1.1", "touch-size": "0.05"})
    assert family.sentences[:2] == (
        "Spin the body with the finger, with size 0.9 and touch size 0.05 m.",
        "Spin the body with the finger, with size 1.1 and touch size 0.05 m.",
    )
    assert len(family.sentences) == len(family.tasks("all").id) == len(set(family.sentences))
    assert family.spec.sentences == family.sentences


def test_a_range_is_told_by_its_ends_and_a_held_out_task_by_its_value():
    family = mtjax.make("cheetah-run", vary={"mass": "0.5:1.5"}, num_draws=4)
    first, *rest = family.sentences
    assert first == "Make the cheetah run forwards as fast as it can, with mass from 0.5 to 1.5."
    assert rest and all("from" not in said for said in rest)


def test_sentences_of_a_mixture_are_in_the_order_of_its_tasks():
    env = mtjax.mixture([mtjax.make("walker-stand"), mtjax.make("finger-spin", vary={"size": "0.9,1.1"})])
    rows = env.tasks("all").row.tolist()
    assert env.sentences == tuple(env.sentence(row) for row in rows) == env.spec.sentences
    assert env.sentences[:2] == ("Make the walker stand upright.", "Spin the body with the finger, with size 0.9.")


# Vectors of sentences.


def test_hashed_sentences_are_alike_as_far_as_they_share_words(hashing):
    walk, run, swing = hashing("Make the walker walk.", "Make the walker run.", "Swing the pole up.")
    np.testing.assert_allclose(np.linalg.norm([walk, run, swing], axis=1), 1, atol=1e-6)
    assert walk @ run > walk @ swing + 0.3


def test_hashing_tells_numbers_apart_and_their_signs(hashing):
    vectors = hashing("Turn, with angle 2 rad.", "Turn, with angle -2 rad.", "Turn, with angle 0.25 rad.")
    assert np.max(vectors @ vectors.T - np.eye(3)) < 0.95


def test_words_that_training_has_not_are_left_out(hashing):
    """What is left of a sentence is what it shares with those of training, at the same places."""
    *known, new = hashing("Go to the red door.", "Walk to the blue door.", "Run to the red door.", learned=2)
    assert not np.any(new[np.all(np.array(known) == 0, axis=0)]) and new @ known[0] > 0.7
    assert np.any(hashing("Go to the red door.", "Run to the red door.")[1][np.array(known[0]) == 0])


def test_order_is_told_beside_a_new_word(hashing):
    """Two things in either order, with a verb that training has not: only their places differ."""
    said = [f"{verb} past {x}, {verb} past {y}." for verb in ("Go", "Run") for x, y in ("ab", "ba")]
    *known, first, second = hashing(*said, learned=2)
    assert first @ second < 0.9 and first @ known[0] > first @ known[1] + 0.1


def test_a_model_of_sentences_is_asked_once(monkeypatch):
    asked = []

    class Model:
        def __init__(self, name, device):
            asked.append(name)

        def encode(self, said, show_progress_bar):
            return np.array([[len(x), 3.0] for x in said])

    monkeypatch.setitem(sys.modules, "sentence_transformers", types.SimpleNamespace(SentenceTransformer=Model))
    for _ in range(2):
        vectors = sentences.encode("some-model", ("four", "sixsix"), 2)
    np.testing.assert_allclose(vectors, [[0.8, 0.6], [0.8944272, 0.4472136]], atol=1e-6)
    assert asked == ["some-model"]


class Refuses:
    def __init__(self, name, device):
        raise OSError("no such model\nand much more")


@pytest.mark.parametrize(
    "module, found, encoder, said, message",
    [
        ("sklearn.feature_extraction.text", None, "hashing", ("x",), r"pip install 'mtjax\[text\]'"),
        ("sentence_transformers", None, "mini", ("x",), r"pip install 'mtjax\[sentences\]'"),
        (
            "sentence_transformers",
            types.SimpleNamespace(SentenceTransformer=Refuses),
            "mini",
            ("x",),
            "cannot load the encoder of sentences 'mini': no such model$",
        ),
        ("sentence_transformers", None, "hashing", (), "tasks that say what they ask for"),
    ],
)
def test_what_is_missing_is_named(module, found, encoder, said, message, monkeypatch):
    monkeypatch.setitem(sys.modules, module, found)
    with pytest.raises(InputError, match=message):
        sentences.encode.__wrapped__(encoder, said, len(said))


# Agents.


def test_an_agent_reads_a_tasks_own_sentence_also_of_a_held_out_task(hashing):
    """A task of other splits' making has the sentence of the training task whose context is nearest."""
    agent, vectors = tiny("sac", conditioning="text"), hashing(*SPEC.sentences, learned=2)
    state = jax.eval_shape(lambda: agent.init(SPEC, TASKS, KEY))
    known = Params({"given": agent.conditioning.table(SPEC, 2), "known": TASKS.context}, {})
    assert jax.tree.structure(known) == jax.tree.structure(state.nets["tasks"])
    state = with_nets(state, tasks=known)
    task = pick(TASKS, 0)
    for number, expected in ((0, 0), (1, 1), (2, 2), (3, 1)):
        seen = agent.view.features(state, task._replace(id=jnp.int32(number), context=TASKS.context[1]))
        np.testing.assert_allclose(seen, vectors[expected], atol=1e-6)


def test_a_text_needs_the_conditioning():
    with pytest.raises(InputError, match="unknown setting of sac 'text'; it belongs to conditioning='text'"):
        tiny("sac", conditioning="parameters", text="some-model")


@pytest.mark.nightly
def test_a_run_reads_and_its_policy_acts_on_held_out_tasks(hashing, tmp_path):
    """From training to a saved policy, whose vectors are those of all splits, and its scores on held-out tasks."""
    family = mtjax.make("finger-spin", vary={"size": "0.9,1.1"})
    mtjax.train(
        family,
        "sac",
        conditioning="text",
        hidden=(8,),
        steps=24,
        num_envs=2,
        batch_size=4,
        warmup_steps=8,
        replay_size=64,
        directory=tmp_path / "run",
    )
    policy = mtjax.load(tmp_path / "run")
    vectors = policy.state.nets["tasks"].shared["given"]
    np.testing.assert_allclose(vectors, hashing(*family.sentences, learned=2), atol=1e-6)
    assert len(vectors) == len(family.tasks("all").id) > 2
    returns = scoring.score(policy, Episodes(1))["extrapolation"].returns
    assert returns.size and np.isfinite(returns).all()
