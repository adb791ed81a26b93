"""Whose turn it is to learn: the actor at some updates of the critics, and the agent after some of the steps."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest
from probes import Stub, Walk, learner, one_in, quick, random_batch, tasks_of, tiny, train

from mtjax.agents.swept import with_numbers
from mtjax.experience import Replay
from mtjax.learning import loop
from mtjax.parallel.axes import when
from mtjax.types import InputError, Spec, Weighted

SMALL = {"num_envs": 4, "batch_size": 4, "replay_size": 200, "warmup_steps": 2}
SPEC, TASKS, KEY = Spec.vector(3, 2, 1), tasks_of("one-step"), jax.random.key(2)


def count(memory):
    """Updates that an optimiser has made."""
    return np.asarray(optax.tree_utils.tree_get(memory, "count"))


# The actor's turns.


@pytest.mark.slow
@pytest.mark.parametrize(("updates", "delay", "every"), one_in(4, [(2, 3, 2), (1, 2, 1), (2, 3, 1), (4, 2, 1)]))
def test_every_so_many_updates_of_the_critics_are_the_actors(updates, delay, every):
    """Counted from the first one, over the borders of chunks, and for all seeds alike."""
    given = {**SMALL, "chunk_steps": 6, "updates_per_step": updates, "policy_delay": delay, "update_every": every}
    state, history = train(Walk(), tiny("sac"), given, seeds=(0, 1), chunks=2)
    done = updates * (12 // every - 2 // every)
    for name, expected in {"critic": done, "actor": done // delay, "temperature": done // delay}.items():
        np.testing.assert_array_equal(count(state.agent.fits[name].optimizer), [expected, expected])
    assert all(np.all(np.isfinite(metrics["actor_loss"])) for metrics in history)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", one_in(2, [{"heads": "per-task", "gradients": "pcgrad"}, {}]), ids=["pcgrad", "sac"]
)
def test_an_update_in_the_actors_turn_is_the_whole_one_and_another_leaves_the_actor(settings):
    """To the bit, with the same key."""
    agent = tiny("sac", **settings)
    init, update = learner(agent, TASKS, 4, SPEC)
    state, batch = init(TASKS, KEY), random_batch(0, 2, 4, SPEC)
    whole, metrics = update(state, batch, TASKS, KEY)
    rare = tiny("sac", **settings, experience=Replay(policy_delay=2))
    in_turn = quick(partial(probes.update, rare), state, batch, TASKS, KEY, jnp.int32(1))
    again, sometimes = in_turn(state, batch, TASKS, KEY, jnp.int32(1))
    jax.tree.map(np.testing.assert_array_equal, again, whole)
    np.testing.assert_array_equal(sometimes["actor_loss"].value, metrics["actor_loss"])
    np.testing.assert_array_equal(sometimes["critic_loss"], metrics["critic_loss"])

    critics, others = in_turn(state, batch, TASKS, KEY, jnp.int32(2))
    for name in ("critic", "representation", "inputs"):
        jax.tree.map(np.testing.assert_array_equal, critics.nets[name], whole.nets[name])
    jax.tree.map(np.testing.assert_array_equal, critics.slow, whole.slow)
    for name in ("actor", "temperature"):
        before, after = ((x.nets[name], x.fits[name].optimizer) for x in (state, critics))
        jax.tree.map(np.testing.assert_array_equal, after, before)
    np.testing.assert_array_equal(others["actor_loss"].weight, 0)


@pytest.mark.slow
def test_turns_pass_through_a_sweep():
    """An agent with traced numbers takes them too."""
    agent, batch = tiny("sac", experience=Replay(policy_delay=2)), random_batch(0, 2, 4, SPEC)
    agent = with_numbers(agent, {"actor_lr": jnp.float32(0.1)})
    state = agent.init(SPEC, TASKS, KEY)
    update, first = partial(probes.update, agent), jnp.int32(0)
    after, _ = quick(update, state, batch, TASKS, KEY, first)(state, batch, TASKS, KEY, first)
    fits = after.fits
    assert count(fits["critic"].optimizer) == 1 and count(fits["actor"].optimizer) == 0


def branches(jaxpr):
    """The number of branches in a program: a condition that differs between seeds would be none."""
    inner = [x for equation in jaxpr.eqns for x in jax.tree.leaves(list(equation.params.values()), is_leaf=is_program)]
    below = sum(branches(getattr(x, "jaxpr", x)) for x in inner if is_program(x))
    return below + sum(equation.primitive.name == "cond" for equation in jaxpr.eqns)


def is_program(x):
    return isinstance(x, jax.extend.core.Jaxpr | jax.extend.core.ClosedJaxpr)


@pytest.mark.parametrize("seeds", [1, 2])
def test_the_actors_gradient_is_behind_a_branch_for_any_number_of_seeds(seeds):
    """Under a map over seeds a condition that is mapped too becomes a choice between both results."""
    found = {}
    for delay in (1, 2):
        replay = Replay(updates_per_step=3, batch_size=4, replay_size=8, policy_delay=delay)
        agent = tiny("sac", experience=replay)

        def learn(keys, iteration, agent=agent, replay=replay):
            item = jax.tree.map(lambda x: x[0, 0], random_batch(0, 2, 4, SPEC))
            states = jax.vmap(lambda key: agent.init(SPEC, TASKS, key))(keys)
            data = replay.init(item, SPEC, 2, 4, keys)
            state = loop.TrainState(*[None] * len(loop.TrainState._fields))._replace(data=data, iteration=iteration)
            return loop._learn(Walk(), agent, TASKS, states, state, keys)

        found[delay] = branches(jax.make_jaxpr(learn)(jax.random.split(KEY, seeds), jnp.int32(5)).jaxpr)
    assert found == {1: 1, 2: 2}  # whether to learn at all, and the actor's turn


@dataclasses.dataclass(frozen=True)
class Turns(Stub):
    """Counts its updates, and reports the count as a metric of the actor's turns."""

    def update(self, state, window, tasks, key, number):
        turn = (number + 1) % self.experience.policy_delay == 0
        metrics = {"all": jnp.broadcast_to(jnp.float32(number + 1), len(tasks.id))}
        _, own = when(turn, lambda state: (state, {"own": metrics["all"]}), state)
        return state + 1, metrics | {"own": Weighted(own["own"], jnp.full(len(tasks.id), turn, jnp.float32))}

    def init(self, spec, tasks, key):
        return jnp.float32(0)


@pytest.mark.parametrize(("updates", "delay"), one_in(2, [(3, 2), (1, 3)]))
def test_metrics_of_the_actor_are_means_over_its_turns(updates, delay):
    """And empty for a chunk without any."""
    given = {**SMALL, "chunk_steps": 7, "updates_per_step": updates, "policy_delay": delay}
    _, history = train(Walk(), Turns(), given, seeds=(0, 1), chunks=2)
    numbers = np.arange(1, updates * 12 + 1)
    for chunk, metrics in zip(np.split(numbers, [updates * 5]), history, strict=True):
        np.testing.assert_allclose(metrics["all"], np.mean(chunk))
        np.testing.assert_allclose(metrics["own"], np.mean(chunk[chunk % delay == 0]), rtol=1e-6)
        assert np.all(metrics["bad_step"] == -1)
    _, (metrics,) = train(Walk(), Turns(), {**given, "chunk_steps": 4, "policy_delay": 50})
    assert np.all(np.isnan(metrics["own"])) and np.all(metrics["bad_step"] == -1)


# The agent's turns.


@dataclasses.dataclass(frozen=True)
class Recorder(Stub):
    """Acts 2, which no random action is; counts its updates and resets."""

    def init(self, spec, tasks, key):
        return {"updates": jnp.int32(0), "resets": jnp.int32(0)}

    def choose(self, state, obs, task, key):
        return jnp.full(1, 2.0)

    def update(self, state, window, tasks, key, number):
        return {**state, "updates": state["updates"] + 1}, {"loss": jnp.float32(tasks.id)}

    def reset(self, state, spec, tasks, key):
        return {**state, "resets": state["resets"] + 1}


def test_the_agent_learns_after_every_so_many_steps():
    """Warm-up, and how long its actions are held, count steps as ever; every step is stored."""
    given = {**SMALL, "warmup_steps": 7, "warmup_hold": 3, "chunk_steps": 12, "updates_per_step": 2, "update_every": 4}
    state, history = train(Walk(), Recorder(), given, seeds=(0, 1), chunks=2)
    np.testing.assert_array_equal(state.agent["updates"], 2 * 5)  # after 8, 12, 16, 20 and 24 steps
    np.testing.assert_array_equal(history[1]["loss"], [[0, 1], [0, 1]])
    assert state.iteration == state.data.count == state.data.ring.size == 24
    rows = jax.tree.map(lambda x: np.asarray(x)[:, :, :24], state.data.ring.rows)
    action = rows.action[..., 0]
    np.testing.assert_array_equal(action[:, :, 7:], 2)
    np.testing.assert_array_equal(action[:, :, :7], np.repeat(action[:, :, :7:3], 3, axis=2)[:, :, :7])
    assert len(np.unique(action[:, :, :7])) == 2 * 2 * 3 * 4
    goes_on = ~rows.ended[:, :, :-1]
    np.testing.assert_array_equal(rows.obs[:, :, 1:][goes_on], rows.next_obs[:, :, :-1][goes_on])


def test_a_ring_holds_whole_iterations_and_wraps_around_between_them():
    """Eleven steps of four environments are two times four; the latest eight stay, in order."""
    given = {**SMALL, "replay_size": 44, "chunk_steps": 20, "update_every": 4}
    state, _ = train(Walk(), Recorder(), given)
    ring = state.data.ring
    assert (int(ring.size), int(ring.position)) == (8, 4) and ring.rows.obs.shape[2] == 8
    in_order = jax.tree.map(lambda x: np.roll(np.asarray(x), -4, axis=2), ring.rows)
    goes_on = ~in_order.ended[:, :, :-1]
    np.testing.assert_array_equal(in_order.obs[:, :, 1:][goes_on], in_order.next_obs[:, :, :-1][goes_on])
    assert goes_on.any()


@pytest.mark.parametrize(("every", "resets"), one_in(2, [(1, 3), (4, 3)]))
def test_networks_are_reset_as_often_however_often_the_agent_learns(every, resets, monkeypatch):
    """After 5, 10 and 15 of 20 steps, at the next time of updates."""
    monkeypatch.setattr(loop, "reset_networks", Recorder.reset)
    given = {**SMALL, "chunk_steps": 20, "update_every": every, "reset_every": 5}
    state, _ = train(Walk(), Recorder(), given)
    assert state.agent["resets"] == resets


@pytest.mark.slow
def test_joined_steps_and_rare_updates_go_together():
    """With the actor's turns as well."""
    given = {**SMALL, "chunk_steps": 12, "update_every": 3, "policy_delay": 2, "n_step": 3, "updates_per_step": 3}
    state, (metrics,) = train(Walk(), tiny("sac"), given)
    fits = state.agent.fits
    assert count(fits["critic"].optimizer) == 12 and count(fits["actor"].optimizer) == 6
    assert np.all(metrics["bad_step"] == -1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"policy_delay": 0}, "policy-delay must be at least 1, not 0"),
        ({"update_every": 0}, "update-every must be at least 1, not 0"),
        ({"update_every": 4, "replay_size": 15}, r"replay-size \(15\) must hold 4 steps of num-envs \(4\)"),
        ({"update_every": 4, "n_step": 5, "replay_size": 31}, "must hold 8 steps"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    """With the flag, what was given and what is allowed."""
    with pytest.raises(InputError, match=message):
        Replay(**settings).check(Walk(), 4)
