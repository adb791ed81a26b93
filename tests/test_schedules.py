"""Schedules of learning rates: their values by hand, how long they take in a run, and what is refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest
from conftest import SHORT_RUN
from probes import Walk, quick, random_batch, tasks_of, tiny, train, train_objects

import mtjax.train
from mtjax.agents.parts.gradients.descent import schedule
from mtjax.agents.swept import with_numbers
from mtjax.command import run_config
from mtjax.experience import Replay
from mtjax.types import InputError, Spec

TASKS, SPEC, KEY = tasks_of("one-step"), Spec.vector(1, 1, 1), jax.random.key(0)
SMALL = {"num_envs": 4, "batch_size": 4, "replay_size": 200, "warmup_steps": 2}
RARELY = {"policy_delay": 2, "update_every": 3}


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("constant", [1, 2, 2, 2, 2, 2, 2]),
        ("linear", [1, 2, 2, 1.6, 1.2, 0.4, 0.4]),
        ("cosine", [1, 2, 2, 0.4 + 1.6 * (1 + np.sqrt(0.5)) / 2, 1.2, 0.4, 0.4]),
    ],
)
def test_rates_are_those_worked_by_hand(shape, expected):
    """From 2 to a fifth of it in ten updates, of which two warm up; after these it stays."""
    rate = schedule(2.0, shape, final=0.2, warmup=2, updates=10)
    np.testing.assert_allclose([rate(jnp.int32(n)) for n in (0, 1, 2, 4, 6, 10, 50)], expected, rtol=1e-6)


def test_without_a_warmup_the_first_rate_is_the_whole_one():
    """And the last one before the end is not yet nothing."""
    rate = schedule(3.0, "linear", final=0.0, warmup=0, updates=4)
    np.testing.assert_allclose([rate(jnp.int32(n)) for n in range(5)], [3, 2.25, 1.5, 0.75, 0], rtol=1e-6)


def counts(fits):
    """Updates of each optimiser, as Adam counts them, of all seeds."""
    found = {}
    for name, fit in fits.items():
        is_adam = lambda x: isinstance(x, optax.ScaleByAdamState)
        (adam,) = (x for x in jax.tree.leaves(fit.optimizer, is_leaf=is_adam) if is_adam(x))
        found[name] = np.asarray(adam.count)
    return found


AGENTS = {
    "sac": ("sac", 10, {**SMALL, "updates_per_step": 2}, {"actor": 36, "critic": 36, "temperature": 36}),
    "rarely": ("sac", 12, {**SMALL, **RARELY}, {"actor": 4, "critic": 8, "temperature": 4}),
    "ppo": ("ppo", 10, {"num_envs": 4, "unroll": 5, "minibatches": 2, "epochs": 3}, {"actor": 24, "critic": 24}),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "chunk", "given", "expected"), AGENTS.values(), ids=AGENTS)
def test_a_schedule_ends_with_the_run(name, chunk, given, expected):
    """All rates are 0 then, and not before: the last updates change what the next would not."""
    agent, settings = tiny(name, lr_schedule="linear"), {"eval_episodes": 1, "chunk_steps": chunk}
    result = train_objects(Walk(), agent, steps=2 * 4 * 2 * chunk, seeds=2, **settings, **given)
    found = counts(result.state.agent.fits)
    for key, number in expected.items():
        np.testing.assert_array_equal(found[key], [number, number])

    given = {**given, "chunk_steps": chunk, "lr_updates": expected["critic"]}
    soon, state, end = (train(Walk(), agent, given, chunks=chunks)[0] for chunks in (1, 2, 3))
    networks = lambda state: {net: state.agent.nets[net] for net in expected}
    jax.tree.map(np.testing.assert_array_equal, networks(end), networks(state))
    assert not any(jax.tree.leaves(jax.tree.map(np.array_equal, networks(soon), networks(state))))


@pytest.mark.slow
def test_a_share_that_is_swept_is_the_one_of_each_point():
    """A final share of 1 takes the steps of constant rates; one of 0, at the end, takes none."""
    plain, planned = tiny("sac"), tiny("sac", lr_schedule="cosine", lr_updates=1)
    batch, ended = random_batch(0, 2, 4, SPEC), {}
    for final in (0.0, 1.0):
        agent = with_numbers(planned, {"lr_final": jnp.float32(final)})
        state = agent.init(SPEC, TASKS, KEY)
        update = quick(partial(probes.update, agent), state, batch, TASKS, KEY)
        for _ in range(2):
            state, _ = update(state, batch, TASKS, KEY)
        ended[final] = state
    state = plain.init(SPEC, TASKS, KEY)
    update = quick(partial(probes.update, plain), state, batch, TASKS, KEY)
    once, _ = update(state, batch, TASKS, KEY)
    twice, _ = update(once, batch, TASKS, KEY)
    for expected, found in ((once, ended[0.0]), (twice, ended[1.0])):
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)
        for net in ("actor", "critic", "temperature"):
            jax.tree.map(close, found.nets[net], expected.nets[net])


@pytest.mark.slow
def test_a_run_that_goes_on_for_longer_says_so(short_family, tmp_path, capsys):
    """Its rates are those of a run of the new length; policies load without knowing the length of their run."""
    words = [*SHORT_RUN, "--agent.lr-schedule=cosine", "--agent.lr-final=0.1", "--agent.lr-warmup=5", "--steps=200"]
    mtjax.train.main([*words, f"--runs={tmp_path}"])
    (directory,) = tmp_path.iterdir()
    assert "learning rates" not in capsys.readouterr().out
    mtjax.train.main([f"--resume={directory}", "--steps=300"])
    assert "learning rates go on along the schedule of a run of 300 steps" in capsys.readouterr().out
    policy = mtjax.load(directory)
    assert (policy.agent.lr_schedule, policy.agent.lr_updates) == ("cosine", 0)
    np.testing.assert_array_equal(counts(policy.states.fits)["critic"], [70, 70])  # 75 steps, 5 of them random


def test_rates_of_what_learns_at_every_fourth_update_fall_with_the_updates():
    """Of a constant gradient Adam's step is the rate: after 10 of its own steps the actor is 40 updates on its way."""
    agent = tiny("sac", lr_schedule="linear", lr_warmup=8, lr_updates=100, experience=Replay(policy_delay=4))
    rates = {"actor": agent.actor_lr, "critic": agent.critic_lr, "temperature": agent.temperature_lr}
    for name, delay in (("actor", 4), ("critic", 1), ("temperature", 4)):
        optimizer, params = agent.fits[name].optimizer, {"x": jnp.ones(1)}
        memory, steps = optimizer.init(params), []
        for _ in range(11):
            step, memory = optimizer.update(params, memory, params)
            steps.append(-step["x"][0] / rates[name])
        warmup, count = 8 / delay, np.arange(11)
        rising = np.minimum((count + 1) / warmup, 1)
        expected = rising * (1 - np.clip((count - warmup) / (100 / delay - warmup), 0, 1))
        np.testing.assert_allclose(steps, expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"lr_schedule": "line"}, "unknown lr-schedule 'line'; did you mean 'linear'"),
        ({"lr_final": 1.5}, r"lr-final must be in \[0, 1\], not 1.5"),
        ({"lr_final": 0.1}, "lr-final=0.1 is where a schedule ends, and lr-schedule=constant is none"),
        ({"lr_updates": 9}, "lr-updates=9 is where a schedule ends, and lr-schedule=constant is none"),
        ({"lr_warmup": -1}, "lr-warmup must be at least 0, not -1"),
        ({"lr_updates": -1}, "lr-updates must be at least 0, not -1"),
        (
            {"lr_schedule": "linear", "experience": Replay(reset_every=9)},
            "reset-every begins the optimisers anew, and lr-schedule=linear with them; use constant",
        ),
        (
            {"lr_schedule": "cosine", "reset_optimizer": True},
            "reset-optimizer begins the optimisers anew, and lr-schedule=cosine with them; use constant",
        ),
        (
            {"lr_schedule": "linear", "continual": "scratch"},
            "continual=scratch begins the optimisers anew, and lr-schedule=linear with them; use constant",
        ),
    ],
)
def test_what_cannot_be_right_is_refused(settings, message):
    """Before anything compiles."""
    with pytest.raises(InputError, match=message):
        tiny("sac", **settings)


def test_a_command_replaces_the_schedule_of_a_preset_before_its_parts_are_chosen():
    """A race's preset has rates that fall, which tasks that are learned from scratch refuse."""
    words = ["--env=racing", "--agent=ppo", "--agent.continual=scratch", "--curriculum=sequence:1000"]
    with pytest.raises(InputError, match="continual=scratch begins the optimisers anew, and lr-schedule=linear"):
        run_config.draft(words)
    assert run_config.draft([*words, "--agent.lr-schedule=constant"]).learner.continual.restarts


def test_a_warmup_is_shorter_than_the_run():
    """Else the schedule would have no time to fall."""
    with pytest.raises(InputError, match="lr-warmup=20 leaves none of the run's 18 updates to lr-schedule=linear"):
        train_objects(Walk(), tiny("sac", lr_schedule="linear", lr_warmup=20), steps=2 * 4 * 20, **SMALL)


def test_a_loop_without_a_plan_needs_a_number_of_updates():
    """Which no run of the package lacks."""
    agent = tiny("sac", lr_schedule="linear")
    with pytest.raises(InputError, match="lr-schedule=linear must know when the run ends"):
        train(Walk(), agent, {**SMALL, "chunk_steps": 4})
