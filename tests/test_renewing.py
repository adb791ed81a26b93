"""Units that begin anew through an agent's update: which, what optimisers forget of them, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, prepare, random_batch, tiny, windows

import mtjax
from mtjax.agents import task_changes, unit_resets
from mtjax.agents.networks import Params
from mtjax.agents.parts import put
from mtjax.agents.parts.plasticity import Nothing
from mtjax.types import InputError

TASKS = Walk().tasks()


def made(way, **settings):
    """An agent with two hidden layers, its state after an update, and a batch."""
    agent = tiny("sac-conditioned", hidden=(8, 6), plasticity=way, critic_layer_norm=False, **settings)
    state = agent.init(Walk().spec, TASKS, jax.random.key(0))
    steps = random_batch(0, 2, 16, Walk().spec)
    plain = put(agent, plasticity=Nothing())
    after, _ = jax.jit(plain.update)(state, windows(steps), TASKS, jax.random.key(1), jnp.int32(0))
    return agent, after, prepare(agent, after, steps, TASKS)


def idle(state, unit):
    """A state in which the actor's second layer has one unit that nothing wakes."""
    actor = state.nets["actor"]
    layer = unit_resets._layer(actor.shared, 1)
    quiet = layer._replace(bias=layer.bias.at[unit].set(-100.0))
    return state.with_nets(actor=actor._replace(shared=unit_resets._with_layer(actor.shared, 1, quiet)))


def outputs(agent, state, batch):
    nets = {name: net.of_first() for name, net in state.nets.items()}
    return agent.policy_outputs(nets, batch.features[0], batch.obs[0])


@pytest.mark.slow
def test_redo_renews_idle_units_and_changes_no_output():
    """And the optimiser's moments around them are 0, those of others as they were."""
    agent, state, batch = made("redo", redo_every=1, dormant_threshold=0.0)
    before = idle(state, 3)
    after = unit_resets.renew(agent, before, batch, jax.random.key(2), jnp.int32(0))
    old, new = (unit_resets._layer(x.nets["actor"].shared, 1) for x in (before, after))
    assert new.bias[3] == 0 and not np.any(new.out[3]) and not np.any(new.into[:, 3] == old.into[:, 3])
    np.testing.assert_array_equal(outputs(agent, before, batch), outputs(agent, after, batch))
    moments = lambda x: x.fits["actor"].optimizer[1][0].mu["actor"].shared
    old, new = (unit_resets._layer(moments(x), 1) for x in (before, after))
    assert np.any(old.out[3]) and not np.any(new.out[3]) and not np.any(new.into[:, 3])
    awake = np.flatnonzero(np.any(old.into, axis=0))
    assert len(awake) > 1 and 3 in awake
    others = awake[awake != 3]
    np.testing.assert_array_equal(new.into[:, others], old.into[:, others])
    count = lambda x: x.fits["actor"].optimizer[1][0].count
    assert count(before) == count(after) == 1


@pytest.mark.slow
def test_redo_waits_for_its_turn():
    agent, state, batch = made("redo", redo_every=10, dormant_threshold=1e9)
    renew = jax.jit(lambda number: unit_resets.renew(agent, state, batch, jax.random.key(2), number))
    changed = lambda number: (
        not np.array_equal(
            renew(number).nets["actor"].shared["head"]["kernel"], state.nets["actor"].shared["head"]["kernel"]
        )
    )
    assert [changed(jnp.int32(number)) for number in (0, 8, 9, 10, 19)] == [False, False, True, False, True]


@pytest.mark.slow
def test_critics_are_renewed_each_by_its_own_units():
    """At a threshold above all activities every unit of both begins anew, with weights of its own."""
    agent, state, batch = made("redo", redo_every=1, dormant_threshold=1e9)
    critic = unit_resets.renew(agent, state, batch, jax.random.key(2), jnp.int32(0)).nets["critic"].shared
    into = unit_resets._layer(critic, 0).into
    assert into.shape[0] == 2 and not np.any(into[0] == into[1]) and not np.any(critic["head"]["kernel"])


@pytest.mark.slow
def test_continual_backprop_replaces_one_mature_unit_at_a_time():
    """With a rate of 1/16 for eight and six units: due after two and three updates; the renewed is the youngest."""
    agent, state, batch = made("continual-backprop", replacement_rate=1 / 16, maturity=0)
    renew, ages = jax.jit(lambda state: unit_resets.renew(agent, state, batch, jax.random.key(2), jnp.int32(0))), []
    for _ in range(3):
        state = renew(state)
        ages.append([np.sort(units.age).tolist() for units in state.nets["plasticity"].shared["actor"]])
    assert ages[0] == [[1] * 8, [1] * 6]
    assert ages[1] == [[0] + [2] * 7, [2] * 6]
    assert ages[2][1] == [0] + [3] * 5


@pytest.mark.slow
def test_shrinking_and_perturbing_changes_what_tasks_share_alone():
    agent, state, _ = made("shrink-and-perturb", shrink=0.25, perturb=0.5, heads="per-task")
    fresh = agent.init(Walk().spec, TASKS, jax.random.key(9))
    found = task_changes.change(agent, state, fresh)
    expected = lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-6)
    for name in ("actor", "critic"):
        old, new, drawn = (x.nets[name] for x in (state, found, fresh))
        jax.tree.map(expected, new.shared, jax.tree.map(lambda x, y: 0.25 * x + 0.5 * y, old.shared, drawn.shared))
        jax.tree.map(np.testing.assert_array_equal, new.own, old.own)
    assert isinstance(found.nets["temperature"], Params)


@pytest.mark.parametrize(
    "agent, given, said",
    [
        ("sac", {"heads": "per-task"}, "heads is shared, not per-task"),
        ("sac", {"actor_heads": "per-task"}, "actor-heads is shared, not per-task"),
        ("ppo", {"plasticity": "continual-backprop", "critic_heads": "per-task"}, "critic-heads is shared"),
        ("ppo", {"value_normalization": "popart"}, "value-normalization=popart gives each a head of its critic"),
        ("brc", {}, "encoder=identity"),
        ("sac-conditioned", {"continual": "packnet"}, "redo changes the weights that continual=packnet keeps"),
        ("sac-conditioned", {"continual": "packnet", "plasticity": "shrink-and-perturb"}, "continual=packnet keeps"),
        ("sac", {"redo_every": 0}, "redo-every must be at least 1"),
    ],
)
def test_what_cannot_be_renewed_is_refused(agent, given, said):
    with pytest.raises(InputError, match=said):
        mtjax.agent(agent, **{"plasticity": "redo", "normalize_observations": False, **given})
