"""How an agent knows its task: what networks are shown, what is learned, and by whose loss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import SPEC, learner, of_task, pick, random_batch, slow_but, tasks_of, tiny

from mtjax.agents import PARTS, replay_batches
from mtjax.agents.parts.knowing import CONDITIONINGS, Embedding
from mtjax.agents.view import init_inputs
from mtjax.types import InputError

TASKS = tasks_of("one-step", np.linspace(0.5, 1.5, 3))
BATCH, KEY = 6, jax.random.key(0)


def settings_of(name, tmp_path):
    """Return what a way of knowing needs beside its name."""
    if name != "vectors":
        return {}
    np.save(tmp_path / "vectors.npy", np.float32([[1, 0], [0, 2], [3, 3]]))
    return {"vectors": str(tmp_path / "vectors.npy")}


def same(one, other) -> bool:
    return jax.tree.all(jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), one, other))


def test_every_way_is_one_of_the_parts():
    assert PARTS["conditioning"] is CONDITIONINGS
    assert tiny("sac", conditioning="embedding", embedding_size=5).conditioning == Embedding(embedding_size=5)


@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_an_embedding_is_seen_by_all_networks(agent):
    """A network given the features is what the agent computes from its table."""
    made = tiny(agent, conditioning="embedding", embedding_size=4)
    state = made.init(SPEC, TASKS, KEY)
    table = state.nets["knowing"].own["embedding"]
    assert table.shape == (3, 4)
    assert not any("embedding" in state.nets[name].parts for name in ("actor", "critic"))
    obs = random_batch(0, 3, BATCH, SPEC).obs
    for i in range(3):
        nets = of_task(state.nets, i)
        given = made.view.features(state, pick(TASKS, i))
        assert given.shape == (0,)
        found = made.policy_outputs(nets, given, obs[i])
        np.testing.assert_array_equal(found, made.actor.apply(nets["actor"], table[i], obs[i]))


@pytest.mark.parametrize("conditioning", ["embedding", "inferred"])
@pytest.mark.slow
def test_the_critics_loss_trains_it_and_the_actors_does_not(conditioning):
    """In agents with a replay; its slow copy is the targets'."""
    more = {"inferred_from": 2} if conditioning == "inferred" else {}
    made = tiny("sac", conditioning=conditioning, embedding_size=4, **more)
    init, update = learner(made, TASKS, BATCH)
    state = init(TASKS, KEY)
    batch = random_batch(0, 3, BATCH, SPEC, made.view.history)
    after, _ = update(state, batch, TASKS, KEY)
    assert not same(after.nets["knowing"], state.nets["knowing"])
    assert "knowing" in made.fits["critic"].names and "knowing" not in made.fits["actor"].names
    moved = jax.tree.map(
        lambda new, old, slow: np.testing.assert_allclose(slow, old + made.tau * (new - old), rtol=1e-4, atol=1e-6),
        after.nets["knowing"],
        state.slow["knowing"],
        after.slow["knowing"],
    )
    assert jax.tree.leaves(moved, is_leaf=lambda x: x is None)


def test_in_ppo_the_actors_loss_trains_it():
    fits = tiny("ppo", conditioning="embedding").fits
    assert "knowing" in fits["actor"].names and "knowing" not in fits["critic"].names


def test_a_vector_of_length_one():
    made = tiny("sac", conditioning="embedding", embedding_size=4, unit_embedding=True)
    vector = jnp.float32([3, 0, -4, 0])
    np.testing.assert_allclose(made.conditioning.features({"embedding": vector}, jnp.zeros(0), None), vector / 5)


@pytest.mark.parametrize("name", slow_but(CONDITIONINGS, *(set(CONDITIONINGS) - {"posterior", "transformer"})))
def test_what_is_told_has_the_promised_attributes(name, tmp_path):
    """A way that tells something shows networks at least one number."""
    made = tiny("sac", conditioning=name, **settings_of(name, tmp_path))
    spec = SPEC._replace(sentences=("one", "two", "three"))

    def shown():
        nets = of_task(made.init(spec, TASKS, KEY).nets, 0)
        given = made.conditioning.task_vector(jnp.int32(0), pick(TASKS, 0), 3, jnp.ones((3, 2)))
        return made.view.know(nets, given, made.view.example(spec, init_inputs(spec, 3)))

    features, obs = shown()
    assert (features.shape[-1] > 0) == made.conditioning.tells
    assert obs.shape == SPEC.obs.shape
    assert made.conditioning.by_number == (name == "one-hot")
    assert made.conditioning.by_parameters == (name == "parameters")


def test_slow_vectors_follow_at_the_critics_rate():
    """Also beside a representation that has vectors of its own, which follow at another."""
    made = tiny("hip-bmdp", conditioning="embedding")
    state = made.init(SPEC, TASKS, KEY)
    more = lambda nets: {name: jax.tree.map(lambda x: x + 1, nets[name]) for name in ("knowing", "representation")}
    after = replay_batches.update_target(made, state._replace(nets=state.nets | more(state.nets)))
    step = lambda net: after.slow[net].own["embedding"] - state.slow[net].own["embedding"]
    np.testing.assert_allclose(step("knowing"), made.tau, rtol=1e-3)
    np.testing.assert_allclose(step("representation"), made.representation.encoder_tau, rtol=1e-3)


def test_one_past_has_one_length():
    given = {"conditioning": "inferred", "inferred_from": 3, "unseen_theta": "inferred"}
    with pytest.raises(InputError, match="inferred-from=3 and theta-from=2 are numbers of the same last steps"):
        tiny("hip-bmdp", **given, theta_from=2)
    assert tiny("hip-bmdp", **given, theta_from=3).view.history == 3
