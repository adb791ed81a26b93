"""PPO: advantages, losses, minibatches and units against numbers worked by hand, and probes learned by the loop."""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import (
    Walk,
    assessed,
    learn,
    mean_actions,
    of_task,
    one_in,
    only_seed,
    pick,
    quick,
    random_past,
    tiny,
    train,
    with_nets,
)

from mtjax import agents
from mtjax.agents import clipped_ratio, critics, normalize
from mtjax.agents.base import Memory
from mtjax.agents.critics import Units
from mtjax.agents.networks import OVER_TASKS
from mtjax.agents.on_policy import Batch
from mtjax.agents.parts import targets
from mtjax.agents.parts.encoders import ENCODERS
from mtjax.agents.parts.gradients.surgery import RULES
from mtjax.agents.parts.knowing import CONDITIONINGS
from mtjax.agents.parts.knowing.last_steps import Past, Seen
from mtjax.agents.parts.policies import Gaussian, Taken
from mtjax.agents.parts.samplers import SAMPLERS
from mtjax.agents.parts.scaling import SCALINGS
from mtjax.agents.parts.scaling.base import Moments
from mtjax.agents.ppo import PPO, within
from mtjax.agents.state import of_tasks, with_tasks
from mtjax.agents.view import init_inputs
from mtjax.config import with_preset
from mtjax.envs.probes import Probe, tasks_of
from mtjax.parallel.axes import in_parts
from mtjax.types import InputError, Spec, Transition

SPEC, LENGTH, ENVS = Spec.vector(3, 2, 1)._replace(sentences=("Walk.", "Run.", "Hop.")), 4, 2
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(2)
GAUSSIAN = Gaussian()


def small(**settings):
    return tiny("ppo", **{"epochs": 1, "minibatches": 2, "unroll": LENGTH, **settings})


def random_steps(agent, num_tasks=3, spec=SPEC, seed=0):
    """Rollouts (T, H, E, ...) in which every field is random."""
    random, shape = np.random.default_rng(seed), (num_tasks, LENGTH, ENVS)
    normal = lambda *size: jnp.float32(random.normal(size=(*shape, *size)))
    raw, past = normal(spec.action_size), None
    if agent.view.history:
        past = random_past(random, (*shape, agent.view.history), spec)
    begun = Memory(
        None, agent.conditioning.begin(spec.obs_size, spec.action_size), agent.scaling.begin(), agent.sampler.begin()
    )
    memory = jax.tree.map(lambda x: jnp.zeros((*shape, *x.shape)), begun)
    steps = Transition(
        obs=normal(spec.obs_size),
        action=jnp.tanh(raw),
        reward=normal(),
        discount=jnp.float32(random.random(shape) < 0.75),
        next_obs=normal(spec.obs_size),
        ended=jnp.asarray(random.random(shape) < 0.5),
        extras=Taken(raw, normal() - 2),
        memory=memory._replace(past=past),
    )
    return steps._replace(closed=steps.ended, cut=steps.ended)


# Advantages.


def test_advantages_worked_by_hand():
    """Terminated, cut off and going on; with gamma a half and lambda a half."""
    reward, value, next_value = jnp.ones((3, 1)), jnp.full((3, 1), 2.0), jnp.full((3, 1), 4.0)
    steps = lambda discount, ended: Transition(
        None, None, reward, jnp.float32(discount)[:, None], None, ended, ended, ended
    )
    find = lambda discount, ended: targets.gae(
        steps(discount, jnp.array(ended)[:, None]), value, next_value, jnp.float32(0.5), 0.5
    )[:, 0]
    # Each error is 1 + 0.5 * 4 - 2 = 1, or 1 - 2 = -1 where an episode terminated.
    np.testing.assert_allclose(find([1, 1, 1], [False] * 3), [1 + 0.25 * 1.25, 1.25, 1])
    np.testing.assert_allclose(find([1, 0, 1], [False, True, False]), [1 - 0.25, -1, 1])
    np.testing.assert_allclose(find([1, 1, 1], [False, True, False]), [1.25, 1, 1])


def test_advantages_are_those_of_a_plain_loop():
    """Random rollouts of three tasks, each with a discount of its own, by the sum over errors of each episode."""
    random, (length, envs) = np.random.default_rng(0), (7, 5)
    for gamma in (0.9, 0.99, 1.0):
        reward, value, next_value = random.normal(size=(3, length, envs))
        ended = random.random((length, envs)) < 0.3
        discount = 1.0 - ended * (random.random((length, envs)) < 0.5)
        steps = Transition(None, None, jnp.asarray(reward), jnp.asarray(discount), None, *[jnp.asarray(ended)] * 3)
        found = targets.gae(steps, jnp.asarray(value), jnp.asarray(next_value), jnp.float32(gamma), 0.8)
        error = reward + gamma * discount * next_value - value
        for t, e in np.ndindex(length, envs):
            expected = 0.0
            for k in range(t, length):
                expected += (gamma * 0.8) ** (k - t) * error[k, e]
                if ended[k, e]:
                    break
            assert found[t, e] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("parts", (1, 3, 4))
def test_values_in_parts_are_those_of_one_call(parts):
    """For counts that the parts do not divide, and features of tasks or of every step."""
    random = np.random.default_rng(0)
    obs = {"pixels": jnp.float32(random.normal(size=(2, 7, 3, 1)))}
    scale = lambda features, place: features[..., place] if features.ndim == 3 else features[:, None, place]
    whole = lambda features, obs: scale(features, 0) * jnp.sum(obs["pixels"], axis=(2, 3)) + scale(features, 1)
    for features in (jnp.float32(random.normal(size=shape)) for shape in ((2, 2), (2, 7, 2))):
        np.testing.assert_allclose(in_parts(whole, features, obs, parts), whole(features, obs), rtol=1e-6)


def test_every_task_has_its_own_discount():
    agent = small(discounting="horizon", value_normalization="none", advantage_normalization="none", gae_lambda=0.0)
    tasks, steps = TASKS._replace(horizon=jnp.array([200, 1000, 125])), random_steps(agent)
    state = agent.init(SPEC, tasks, KEY)
    state, batch, _ = assessed(agent, state, steps, tasks)
    features = agent.view.features_of_all(state, steps, tasks)
    see = lambda obs: agent.view.see(state.nets["inputs"], obs.reshape(3, -1, 3))
    value, following = (critics.values(agent, state, features, see(obs)) for obs in (steps.obs, steps.next_obs))
    gamma = np.array([0.975, 0.995, 0.96])[:, None]
    flat = lambda x: x.reshape(3, -1)
    expected = flat(steps.reward) + gamma * flat(steps.discount) * following - value
    np.testing.assert_allclose(batch.advantage, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_a_target_infers_the_task_from_the_past_with_the_step_in_it():
    """As the policy will, that acts at the next observation."""
    settings = {"value_normalization": "none", "advantage_normalization": "none", "normalize_observations": False}
    agent = small(conditioning="inferred", inferred_from=3, gae_lambda=0.0, **settings)
    state, steps = agent.init(SPEC, TASKS, KEY), random_steps(agent)
    critic = state.nets["critic"]
    head = jax.tree.map(lambda x: 1e3 * x, critic.shared["head"])
    state = with_nets(state, critic=critic._replace(shared=critic.shared | {"head": head}))
    _, batch, _ = assessed(agent, state, steps, TASKS)
    flat = jax.tree.map(lambda x: np.reshape(x, (3, -1, *x.shape[3:])), steps)
    past, latest = flat.memory.past, Past(flat.obs, flat.action, flat.reward, np.ones_like(flat.reward))
    later = Past(*(np.concatenate([x[:, :, 1:], y[:, :, None]], axis=2) for x, y in zip(past, latest, strict=True)))
    value = lambda obs, past: critics.values(agent, state, jnp.zeros((3, 0)), Seen(obs, past))
    now, following = value(flat.obs, past), value(flat.next_obs, later)
    expected = flat.reward + agent.gamma * flat.discount * following - now
    np.testing.assert_allclose(batch.advantage, expected, rtol=1e-4, atol=1e-3)
    assert np.abs(following - value(flat.next_obs, past)).max() > 0.1


# Losses.


def batch_of(agent, state, **fields):
    """Four steps of the first task, with its networks."""
    random = np.random.default_rng(1)
    normal = lambda *size: jnp.float32(random.normal(size=(4, *size)))
    features = agent.view.features(state, pick(TASKS, 0))
    blank = dict.fromkeys(("log_prob", "advantage", "value", "output", "target"), jnp.zeros(4))
    batch = Batch(**{"obs": normal(3), "raw": normal(2), "features": features, "mask": None, **blank, **fields})
    return batch, of_task(state.nets, 0)


def test_actor_loss_worked_by_hand():
    """Ratios of 1.5 and 0.5, clipped at 1.2 and 0.8 only where that lowers the gain."""
    agent = small(clip_range=0.2, entropy_cost=0.0)
    state = agent.init(SPEC, TASKS, KEY)
    ratio, advantage = jnp.array([1.5, 1.5, 0.5, 0.5]), jnp.array([1.0, -1.0, 1.0, -1.0])
    batch, nets = batch_of(agent, state, advantage=advantage)
    now = GAUSSIAN.log_prob(agent.policy_outputs(nets, batch.features, batch.obs), batch.raw)
    batch = batch._replace(log_prob=now - jnp.log(ratio))
    loss, (metrics, kl) = agent.actor_loss(nets, batch, KEY)
    assert loss == pytest.approx(-(1.2 - 1.5 + 0.5 - 0.8) / 4, abs=1e-5)
    assert metrics["kl"] == pytest.approx(float(jnp.mean(ratio - 1 - jnp.log(ratio))), abs=1e-5)
    assert metrics["clip_fraction"] == 1 and metrics["kl"] == kl

    one = lambda i: jax.tree.map(lambda x: x[i : i + 1] if x.shape[:1] == (4,) else x, batch)
    slopes = lambda i: jax.grad(lambda actor: agent.actor_loss(nets | {"actor": actor}, one(i), KEY)[0])(nets["actor"])
    slope = lambda i: sum(float(jnp.sum(jnp.abs(x))) for x in jax.tree.leaves(slopes(i)))
    assert [slope(i) > 0 for i in range(4)] == [False, True, True, False]


def test_entropy_is_paid_for():
    agent, plain = small(entropy_cost=0.5), small(entropy_cost=0.0)
    state = agent.init(SPEC, TASKS, KEY)
    batch, nets = batch_of(agent, state)
    (loss, (metrics, _)), (without, _) = (x.actor_loss(nets, batch, KEY) for x in (agent, plain))
    assert loss == pytest.approx(float(without - 0.5 * metrics["entropy"]), abs=1e-5)


def test_ratios_beyond_all_bounds_stay_finite():
    agent = small()
    state = agent.init(SPEC, TASKS, KEY)
    batch, nets = batch_of(agent, state, log_prob=jnp.full(4, -1e6), advantage=-jnp.ones(4))
    (loss, _), slope = jax.value_and_grad(agent.actor_loss, has_aux=True)(nets, batch, KEY)
    assert all(np.all(np.isfinite(x)) for x in (loss, *jax.tree.leaves(slope)))


def test_critic_loss_worked_by_hand():
    """A value that would leave its clipped range is held to the error at its edge, where that is larger."""
    agent, free = small(value_clip=0.5), small()
    state = agent.init(SPEC, TASKS, KEY)
    batch, nets = batch_of(agent, state)
    now = agent.output(nets, batch.features, batch.obs)
    batch = batch._replace(output=now - jnp.array([0.2, 1.0, -1.0, 1.0]), target=now + jnp.array([1.0, 1, 1, -1]))
    assert free.critic_loss(nets, batch)[0] == pytest.approx(0.5, abs=1e-5)
    # The second value may only be 0.5 above the old one, which is 1.5 from its target; and so on.
    expected = np.mean([1.0, 1.5**2, 1.0, 1.0]) / 2
    assert agent.critic_loss(nets, batch)[0] == pytest.approx(expected, abs=1e-5)


def test_actions_that_a_task_lacks_count_for_nothing():
    """Neither in the density nor in what is taken; the others' are those of a policy that has no more."""
    agent = small(conditioning="none")
    tasks = TASKS._replace(action_mask=jnp.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
    state, obs = agent.init(SPEC, tasks, KEY), jnp.float32([0.3, -1.0, 2.0])
    act = lambda i, key=KEY: agent.act(state, agent.begin(state, pick(tasks, i)), obs, pick(tasks, i), key)
    acted, whole = act(0), act(1)
    assert acted.action[1] == 0 and acted.action[0] == whole.action[0] and act(2, None).action[0] == 0
    outputs = agent.policy_outputs(of_task(state.nets, 0), jnp.zeros(0), obs)
    density = lambda i: float(GAUSSIAN.log_prob(outputs[i::2], acted.extras.raw[i : i + 1]))
    assert acted.extras.log_prob == pytest.approx(density(0), abs=1e-5)
    assert whole.extras.log_prob == pytest.approx(density(0) + density(1), abs=1e-5)
    steps = random_steps(agent)
    _, batch, _ = assessed(agent, state, steps, tasks)
    np.testing.assert_array_equal(batch.mask, tasks.action_mask)


def test_a_loss_counts_only_the_actions_that_its_task_has():
    """Ratio and entropy are those of the first action alone, and no gradient reaches the outputs of the second."""
    agent = small(entropy_cost=0.5)
    state = agent.init(SPEC, TASKS, KEY)
    batch, nets = batch_of(agent, state, advantage=jnp.arange(4.0), mask=jnp.array([1.0, 0.0]))
    outputs = agent.policy_outputs(nets, batch.features, batch.obs)
    batch = batch._replace(log_prob=GAUSSIAN.log_prob(outputs[:, ::2], batch.raw[:, :1]))
    slope, (metrics, _) = jax.grad(agent.actor_loss, has_aux=True)(nets, batch, KEY)
    assert metrics["kl"] < 1e-6 and metrics["clip_fraction"] == 0
    bias = np.asarray(slope["actor"].shared["head"]["bias"])
    assert np.all(bias[1::2] == 0) and np.all(bias[::2] != 0)


def test_policies_begin_wide_and_alike():
    agent = small(initial_std=0.5)
    state = agent.init(SPEC, TASKS, KEY)
    outputs = agent.policy_outputs(of_task(state.nets, 0), TASKS.context[0], jnp.float32([[1, 2, 3], [-3, 0, 1]]))
    np.testing.assert_allclose(outputs[:, :2], 0, atol=0.1)
    at_mean = GAUSSIAN.log_prob(outputs, outputs[:, :2])
    np.testing.assert_allclose(at_mean, -2 * np.log(0.5 * np.sqrt(2 * np.pi)), atol=0.2)


# Minibatches.


def test_every_minibatch_has_as_many_steps_of_every_task():
    """An epoch deals out every step once; what does not divide is left out, other steps in every epoch."""
    agent = small(epochs=3, minibatches=4)
    orders = np.asarray(agent.experience.shuffled(12, KEY))
    assert orders.shape == (12, 3)
    for epoch in orders.reshape(3, -1):
        assert sorted(epoch) == list(range(12))
    assert not np.array_equal(orders[:4], orders[4:8])
    uneven = np.asarray(agent.experience.shuffled(14, KEY)).reshape(3, -1)
    assert uneven.shape == (3, 12) and all(len(set(epoch)) == 12 for epoch in uneven)
    assert len({tuple(set(range(14)) - set(epoch)) for epoch in uneven}) > 1

    state, batch, steps = assessed(agent, agent.init(SPEC, TASKS, KEY), random_steps(agent), TASKS)
    window = agent.experience.window(steps, jnp.array([[5], [0], [3]]))
    _, chosen = agent.prepare(state, window, TASKS)
    assert window.reward.shape == (3, 3, 1) and chosen.advantage.shape == (3, 3)
    for ours, theirs in ((chosen.obs, batch.obs), (chosen.advantage, batch.advantage), (chosen.raw, batch.raw)):
        np.testing.assert_array_equal(ours, theirs[:, np.array([5, 0, 3])])
    with pytest.raises(InputError, match=r"minibatches \(4\) must not be more than a rollout's 3 a task"):
        agent.experience.shuffled(3, KEY)


def test_steps_keep_their_contexts():
    """Where every episode draws its own task, a minibatch tells each step its own."""
    agent = small()
    steps = random_steps(agent)
    context = steps.reward[..., None] * 2
    state, _, steps = assessed(agent, agent.init(SPEC, TASKS, KEY), steps._replace(context=context), TASKS)
    order = jnp.array([1, 6])
    _, batch = agent.prepare(state, agent.experience.window(steps, order[:, None]), TASKS)
    np.testing.assert_array_equal(batch.features, context.reshape(3, -1, 1)[:, order])


@pytest.mark.parametrize("kind", ["none", "all", "task"])
def test_advantages_are_brought_to_one_scale(kind):
    advantage = jnp.float32(np.random.default_rng(0).normal(size=(3, 50)) * [[1], [10], [100]] + 5)
    found = clipped_ratio.normalized(kind, advantage.reshape(3, 10, 5)).reshape(3, 50)
    axis = {"none": (), "all": None, "task": 1}[kind]
    if kind == "none":
        np.testing.assert_array_equal(found, advantage)
    else:
        np.testing.assert_allclose(np.mean(found, axis), 0, atol=1e-5)
        np.testing.assert_allclose(np.std(found, axis), 1, atol=1e-4)


def test_advantages_of_a_task_that_earns_nothing_are_nothing():
    assert np.all(np.asarray(clipped_ratio.normalized("task", jnp.zeros((2, 5, 1)))) == 0)


@pytest.mark.parametrize("most", [0.0, 0.5])
def test_rewards_are_clipped_before_they_are_scaled(most):
    """In the targets; with 0 they are whole."""
    agent = small(reward_clip=most, reward_scale=2.0, value_normalization="none")
    state, steps = agent.init(SPEC, TASKS, KEY), random_steps(agent)
    clipped_first = steps._replace(reward=jnp.clip(steps.reward, -0.5, 0.5) if most else steps.reward)
    plain = small(reward_scale=2.0, value_normalization="none")
    found, expected = agent.assess(state, steps, TASKS)[1], plain.assess(state, clipped_first, TASKS)[1]
    np.testing.assert_array_equal(found.extras.target, expected.extras.target)
    np.testing.assert_array_equal(found.reward, steps.reward)
    assert np.abs(steps.reward).max() > 1


# Units of values.


@pytest.mark.parametrize("kind", ["none", "running", "popart"])
def test_units_are_moments_of_all_targets_at_first(kind):
    """Two rollouts count alike: mean and variance are those of both together. With PopArt values then stay."""
    agent = small(value_normalization=kind, value_rate=0.1)
    state, obs = agent.init(SPEC, TASKS, KEY), jnp.float32(np.random.default_rng(0).normal(size=(3, 5, 3)))
    targets = jnp.float32(np.random.default_rng(0).normal(size=(2, 3, 50)) * 7 + [[[3], [100], [0]]])
    targets = targets.at[1].multiply(2)
    state, _ = critics.renew(agent, state, targets[0])
    before = critics.values(agent, state, TASKS.context, obs)
    state, _ = critics.renew(agent, state, targets[1])
    units = Units.of(state)
    if kind == "none":
        assert np.all(units.count == 0) and np.all(units.std == 1)
        return
    both = np.concatenate(targets, axis=1)
    np.testing.assert_allclose(units.moments.mean, both.mean(axis=1), rtol=1e-4)
    np.testing.assert_allclose(units.moments.variance, both.var(axis=1), rtol=1e-4)
    after = critics.values(agent, state, TASKS.context, obs)
    assert np.allclose(before, after, atol=1e-3) == (kind == "popart")

    many = with_nets(state, units=units._replace(count=jnp.float32(500)).params())
    moved = critics.renew(agent, many, targets[0])[1].moments
    np.testing.assert_allclose(moved.mean, 0.9 * units.moments.mean + 0.1 * targets[0].mean(axis=1), rtol=1e-4)


@pytest.mark.parametrize("kind", ["running", "popart"])
def test_a_task_that_is_played_later_takes_its_first_targets_for_its_units(kind):
    """Whatever was counted of others: its moments are those of its targets, and outputs as they were."""
    agent = small(value_normalization=kind, value_rate=0.1)
    state, obs = agent.init(SPEC, TASKS, KEY), jnp.float32(np.random.default_rng(0).normal(size=(3, 5, 3)))
    targets = jnp.float32(1e-3 * (5 + np.random.default_rng(0).normal(size=(3, 50))))
    outputs = lambda state: critics.outputs(agent, state, TASKS.context, obs)
    before, rows = outputs(state)[1], jnp.array([1])
    for played in (jnp.array([0, 2]), jnp.array([0, 2]), rows):
        part, _ = critics.renew(agent, of_tasks(state, played), targets[played])
        state = with_tasks(state, part, played)
    units = state.nets["units"].own
    np.testing.assert_array_equal(units.count, [2, 1, 2])
    np.testing.assert_allclose(units.moments.mean, targets.mean(axis=1), rtol=1e-4)
    np.testing.assert_allclose(units.std, targets.std(axis=1), rtol=1e-4)
    np.testing.assert_array_equal(outputs(state)[1], before)


@pytest.mark.parametrize("kind", ["none", "running", "popart"])
def test_targets_are_in_the_units_in_which_outputs_are_read(kind):
    """Those that this rollout has moved, while values of the rollout are in those from before."""
    agent = small(value_normalization=kind, advantage_normalization="none")
    state = agent.init(SPEC, TASKS, KEY)
    for seed in range(3):
        steps, before = random_steps(agent, seed=seed), state
        steps = steps._replace(reward=10 + 5 * seed * steps.reward)
        state, batch, _ = assessed(agent, state, steps, TASKS)
        value = critics.values(agent, before, batch.features, batch.obs)
        units, old = (Units.of(x) for x in (state, before))
        np.testing.assert_allclose(units.rewards(batch.target), value + batch.advantage, rtol=1e-4, atol=1e-3)
    assert (kind == "none") == bool(jnp.all(units.moments.mean == old.moments.mean))


def test_popart_gives_the_critic_alone_a_head_for_every_task():
    agent = small(value_normalization="popart")
    state = agent.init(SPEC, TASKS, KEY)
    assert "head" in state.nets["critic"].own and "head" in state.nets["actor"].shared
    with pytest.raises(InputError, match="value-normalization=popart"):
        small(scaling="popart")


def test_units_have_a_least_size():
    assert np.all(np.asarray(Units(jnp.float32(1), Moments(jnp.zeros(2), jnp.zeros(2))).std) > 0)


def test_moments_are_those_of_all_observations():
    """Of rollouts one after the other, as if they had come at once; in a mixture each task has its own."""
    agent, obs = small(), (np.random.default_rng(0).normal(size=(2, 3, 8, 3)) * 3 + 1).astype(np.float32)
    for mixed in (False, True):
        inputs = init_inputs(SPEC._replace(mixed=mixed), 3)
        for batch in obs:
            inputs = agent.view.count(inputs, jnp.asarray(batch))
        rows = np.moveaxis(obs, 1, 0).reshape(3, -1, 3) if mixed else np.asarray(obs).reshape(1, -1, 3)
        expected = [normalize.update(normalize.init(3), jnp.asarray(x)) for x in rows]
        for found, wanted in zip(inputs.parts["moments"], map(jnp.stack, zip(*expected, strict=True)), strict=True):
            np.testing.assert_allclose(found, wanted if mixed else wanted[0], rtol=1e-4)
    still = small(normalize_observations=False)
    assert still.view.count(init_inputs(SPEC, 3), obs[0]).parts["moments"].count == 0


# Updates.


class Ratios(PPO):
    """Tells how far the ratio of policies is from 1 at most."""

    def actor_loss(self, nets, batch, key):
        loss, aux = super().actor_loss(nets, batch, key)
        ratio = jnp.exp(
            GAUSSIAN.log_prob(self.policy_outputs(nets, batch.features, batch.obs), batch.raw) - batch.log_prob
        )
        return loss, aux._replace(metrics=aux.metrics | {"ratio": jnp.max(jnp.abs(ratio - 1))})


RATIOS = [
    {},
    {"kl_limit": 0.01, "value_normalization": "popart"},
    {"representation": "deepmdp", "critic_lr": 0.1},
    {"conditioning": "inferred", "inferred_from": 3},
]


@pytest.mark.parametrize("row", one_in(4, RATIOS), ids=lambda row: "-".join(map(str, row.values())))
def test_the_ratio_is_one_before_the_first_step(row):
    """With one gradient step a rollout every ratio is one before the first: moments and units may not move until then,
    nor may the representation. The walk's observations go up, so that the moments of every rollout are others."""
    agent = small(epochs=1, minibatches=1, **row)
    agent = Ratios(**{field.name: getattr(agent, field.name) for field in dataclasses.fields(agent)})
    state, history = train(Walk(episode_length=40), agent, {"num_envs": 4, "unroll": 5, "chunk_steps": 60})
    assert history[0]["ratio"].max() < 1e-5 and history[0]["clip_fraction"].max() == 0
    moments = state.agent.nets["inputs"].parts["moments"]
    assert moments.count == 2 * 4 * 60 and moments.mean > 1


@pytest.mark.parametrize("kind", ["none", "running", "popart"])
def test_values_are_clipped_around_the_outputs_from_before_the_update(kind):
    """In the units that the critic's outputs have by then: at first the units change from 1, later from others."""
    agent = small(value_normalization=kind, value_clip=0.2)
    state = agent.init(SPEC, TASKS, KEY)
    for seed in range(3):
        steps = random_steps(agent, seed=seed)
        steps = steps._replace(reward=100 + 50 * seed * steps.reward)
        state, batch, _ = assessed(agent, state, steps, TASKS)
        now = critics.outputs(agent, state, batch.features, batch.obs)
        np.testing.assert_allclose(batch.output, now, rtol=1e-3, atol=1e-4)
        loss, params, data = agent.fits["critic"].problem(agent.critic_loss, state.nets, (batch,))
        slope = jax.vmap(jax.grad(loss, has_aux=True), (OVER_TASKS, 0))
        slopes = jax.tree.leaves(slope(params, data)[0])
        assert min(float(jnp.max(jnp.abs(x[task]))) for x in slopes for task in range(3)) > 0


@pytest.mark.slow
def test_the_actor_rests_once_it_is_too_far_away():
    """Its first step is free, as it is no farther than rounding until then; the critic goes on."""
    agent = small(kl_limit=1e-5, minibatches=4, epochs=2, normalize_observations=False, actor_lr=0.1)
    state = agent.init(SPEC, TASKS, KEY)
    steps = random_steps(agent)
    features = TASKS.context[:, None, None] * jnp.ones((3, LENGTH, ENVS, 1))
    outputs = agent.policy_outputs(of_task(state.nets, 0), features, steps.obs)
    raw = steps.extras.raw * 0.5
    steps = steps._replace(extras=Taken(raw, GAUSSIAN.log_prob(outputs, raw)))
    after, _ = jax.jit(partial(learn, agent))(state, steps, TASKS, KEY)

    batch_key, update_key = jax.random.split(KEY)
    begun, rollout = agent.assess(with_nets(state, limit=within(False)), steps, TASKS)
    batches = agent.experience.batches(Walk(), agent, TASKS, rollout, batch_key)
    window, key = agent.experience.window(rollout, batches[0]), jax.random.split(update_key, len(batches))[0]
    first, _ = jax.jit(agent.update)(begun, window, TASKS, key, jnp.int32(0))
    assert first.nets["limit"].shared["within"] and not after.nets["limit"].shared["within"]
    close = lambda x, y: all(np.allclose(a, b, atol=1e-5) for a, b in zip(*map(jax.tree.leaves, (x, y)), strict=True))
    assert close(after.nets["actor"], first.nets["actor"]) and not close(after.nets["actor"], state.nets["actor"])
    assert not close(after.nets["critic"], first.nets["critic"])
    far = small(kl_limit=1e9, minibatches=4, epochs=2, normalize_observations=False, actor_lr=0.1)
    free = small(minibatches=4, epochs=2, normalize_observations=False, actor_lr=0.1)
    starts = (state, state._replace(nets={name: net for name, net in state.nets.items() if name != "limit"}))
    learned_by = [jax.jit(partial(learn, x))(y, steps, TASKS, KEY)[0] for x, y in zip((far, free), starts, strict=True)]
    actors = [x.nets["actor"] for x in learned_by]
    assert close(*actors) and not close(actors[0], after.nets["actor"])


def allowed(row):
    try:
        return bool(small(**row, **({"vectors": "x"} if row.get("conditioning") == "vectors" else {})))
    except InputError:
        return False


def all_allowed(**choices):
    """Every combination of choices that is not refused; all other settings are the usual ones."""
    rows = [dict(zip(choices, row, strict=True)) for row in itertools.product(*choices.values())]
    return [row for row in rows if allowed(row)]


def pairs(*groups):
    """Settings in which every two choices of different kinds meet at least once.

    Each of ``groups`` lists settings of some kinds, and any of one group go with any of the others.
    """
    whole = [{name: x for part in parts for name, x in part.items()} for parts in itertools.product(*groups)]
    np.random.default_rng(0).shuffle(whole)
    numbers = {}  # of every two choices
    number = lambda pair: numbers.setdefault(pair, len(numbers))
    found = np.array([[number(pair) for pair in itertools.combinations(row.items(), 2)] for row in whole])
    rows, missing = [], np.ones(len(numbers), bool)
    while missing.any():
        i = np.argmax(missing[found].sum(axis=1))
        rows.append(whole[i])
        missing[found[i]] = False
    return rows


COMBINED = pairs(
    all_allowed(conditioning=CONDITIONINGS, encoder=ENCODERS),
    all_allowed(heads=["shared", "per-task", "disjoint"], gradients=RULES, gradient_scope=["shared", "per-layer"]),
    all_allowed(value_normalization=["running", "popart"]),
)
COMBINED += [
    row
    for scaling, sampler in itertools.zip_longest(SCALINGS, SAMPLERS, fillvalue="uniform")
    if allowed(row := {"conditioning": "parameters", "scaling": scaling, "sampler": sampler})
]
COMBINED += [
    {"conditioning": conditioning, "representation": kind, **rest}
    for conditioning, kind, rest in [
        ("parameters", "deepmdp", {"gradients": "pcgrad", "encoder": "care", "kl_limit": 0.01}),
        ("inferred", "deepmdp", {"heads": "disjoint", "transition": "probabilistic"}),
        ("embedding", "hip-bmdp", {"value_normalization": "popart"}),
        ("one-hot", "hip-bmdp", {"unseen_theta": "inferred", "heads": "per-task"}),
    ]
]


def test_most_combinations_are_allowed():
    assert len(COMBINED) > 50
    encoders = set(ENCODERS) - {"batch-norm"}  # whose statistics PPO does not keep
    for kind, table in (("encoder", encoders), ("gradients", RULES), ("conditioning", CONDITIONINGS)):
        assert {row[kind] for row in COMBINED if kind in row} == set(table)


@pytest.mark.parametrize("row", one_in(74, COMBINED, nightly=True), ids=lambda row: "-".join(map(str, row.values())))
def test_every_combination_keeps_its_shapes(row, tmp_path):
    """Traced, not run: an update keeps the state's shapes and types, and acting gives an action and its density."""
    if row["conditioning"] == "vectors":
        np.save(tmp_path / "tasks.npy", np.random.default_rng(0).normal(size=(3, 5)))
        row = {**row, "vectors": str(tmp_path / "tasks.npy")}
    agent = small(**row)
    state = jax.eval_shape(lambda: agent.init(SPEC, TASKS, KEY))
    after, metrics = jax.eval_shape(lambda state: learn(agent, state, random_steps(agent), TASKS, KEY), state)
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree)
    assert shapes(after) == shapes(state)
    for name in ("actor_loss", "critic_loss", "entropy", "kl", "clip_fraction", "explained_variance", "value"):
        assert metrics[name].shape == (3,)
    assert ("critic_cosine" in metrics) == (agent.gradients.needs == "gradients")
    task, obs = pick(TASKS, 0), jnp.zeros(3)
    for key in (None, KEY):
        acted = jax.eval_shape(lambda s, key=key: agent.act(s, agent.begin(s, task), obs, task, key), state)
        assert acted.action.shape == (2,) and (key is None or acted.extras.log_prob.shape == ())


RUN = [
    {},
    {"conditioning": "inferred", "gradients": "pcgrad", "heads": "per-task"},
    {"encoder": "care", "gradients": "famo", "value_normalization": "popart"},
    {"conditioning": "embedding", "heads": "disjoint", "value_clip": 0.2, "kl_limit": 1e9, "scaling": "return"},
]


@pytest.mark.slow
@pytest.mark.parametrize("row", one_in(2, RUN), ids=lambda row: "-".join(map(str, row.values())))
def test_updates_are_finite_and_the_key_decides(row):
    agent = small(**row)
    steps = random_steps(agent)
    init = quick(lambda key: agent.init(SPEC, TASKS, key), KEY)
    state = init(KEY)
    update = quick(lambda state, key: learn(agent, state, steps, TASKS, key), state, KEY)
    (after, metrics), (again, _), (other, _) = update(state, KEY), update(state, KEY), update(state, jax.random.key(3))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((after, metrics)))
    policies = ((s.nets["actor"], s.nets["knowing"]) for s in (state, after, again, other))
    leaves = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(policy)]) for policy in policies]
    assert np.array_equal(leaves[1], leaves[2])
    assert not np.array_equal(leaves[0], leaves[1]) and not np.array_equal(leaves[1], leaves[3])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("gae_lambda", 1.5),
        ("epochs", 0),
        ("minibatches", 0),
        ("clip_range", 0.0),
        ("initial_std", 0.0),
        ("initial_std", 20.0),
        ("entropy_cost", -1.0),
        ("value_rate", 0.0),
        ("reward_clip", -1.0),
        ("advantage_normalization", "some"),
    ],
)
def test_numbers_out_of_range_are_refused(name, value):
    with pytest.raises(InputError, match=name.replace("_", "-")):
        agents.agent("ppo", **{name: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sampler": "temperature"}, "sampler=temperature needs an agent with temperatures"),
        ({"scaling": "ars"}, "scaling=ars renews its factors where networks are reset, and here none are"),
        ({"scaling": "popart"}, "use value-normalization=popart"),
        ({"representation": "encoded", "encoder_tau": 0.5}, "encoder-tau=0.5 is of updates from a replay"),
        ({"representation": "asymmetric", "shift": 2}, "shift=2 is of updates from a replay"),
    ],
)
def test_what_would_do_nothing_in_ppo_is_refused(settings, message):
    with pytest.raises(InputError, match=message):
        agents.agent("ppo", **settings)


@pytest.mark.parametrize("family", ["finger-spin", "cheetah-run", "point-mass-vary-goal"])
@pytest.mark.parametrize("preset", ["cpu", "gpu"])
def test_presets_deal_out_every_step(family, preset):
    """No step is left out of an epoch, and a chunk is whole rollouts."""
    config = with_preset(family, "ppo", preset)
    agent, settings = config.learner, config.training
    assert settings.num_envs * agent.experience.unroll % agent.experience.minibatches == 0
    assert settings.chunk_steps % agent.experience.unroll == 0


# Learning, through the whole loop.

GAMMA = 0.9
SCALES = (1.0, -0.5)
LEARN = {"num_envs": 16, "chunk_steps": 1600, "unroll": 8, "epochs": 4, "minibatches": 4, "gamma": GAMMA}
LEARN |= {"actor_lr": 3e-3, "critic_lr": 1e-2, "entropy_cost": 0.0}
# V(scale, obs) at observations, and how far the critic may be from it.
KNOWN = {
    "one-step": (lambda scale, obs: scale, [0.0], 0.02),
    "by-observation": (lambda scale, obs: scale * obs, [-1.0, 1.0], 0.05),
    "delayed": (lambda scale, obs: scale * GAMMA ** (1 - obs), [0.0, 1.0], 0.05),
    "endless": (lambda scale, obs: scale * GAMMA ** (1 - obs) / (1 - GAMMA), [0.0, 1.0], 0.3),
    "by-action": (lambda scale, obs: 0.0, [0.0], 0.15),
    "by-both": (lambda scale, obs: 0.0, [-1.0, 1.0], 0.3),
}
BEST = {"by-action": lambda scale, obs: scale, "by-both": lambda scale, obs: scale * obs}


def learned(kind, agent=None, **settings):
    updates = LEARN["chunk_steps"] // LEARN["unroll"] * LEARN["epochs"] * LEARN["minibatches"]
    falling = {"lr_schedule": "linear", "lr_updates": updates}  # else actions sway about the best one to the end
    agent, tasks = agent or tiny("ppo", value_normalization="popart", **falling), tasks_of(kind, SCALES)
    state, history = train(Probe(), agent, LEARN | settings, tasks=tasks)
    return agent, only_seed(state.agent), tasks, history


@pytest.mark.parametrize("kind", one_in(2, KNOWN))
def test_probes_are_learned(kind):
    """Values of every task, and the best action where there is one."""
    agent, state, tasks, history = learned(kind)
    expected, obs, tolerance = KNOWN[kind]
    seen = jax.vmap(lambda x: agent.view.see(state.nets["inputs"], x[None]))(jnp.float32(obs))
    found = critics.values(agent, state, tasks.context, jnp.broadcast_to(seen, (2, *seen.shape)))
    for i, scale in enumerate(SCALES):
        wanted = [expected(scale, x) for x in obs]
        np.testing.assert_allclose(found[i], wanted, atol=tolerance)
    if kind in BEST:
        wanted = [[BEST[kind](scale, x) for x in obs] for scale in SCALES]
        np.testing.assert_allclose(mean_actions(agent, state, tasks, obs), wanted, atol=0.1)
    assert history[0]["bad_step"].max() == -1 and history[0]["return"].shape == (1, 2)


@pytest.mark.slow
def test_a_run_that_infers_its_task_stays_finite():
    """Through the whole loop, where what is remembered of an episode is stored with its steps."""
    agent = tiny("ppo", conditioning="inferred", inferred_from=4)
    state, history = train(Walk(), agent, {**LEARN, "chunk_steps": 80})
    assert history[0]["bad_step"].max() == -1
    policy = state.agent.nets["actor"], state.agent.nets["knowing"]
    assert np.all(np.isfinite(np.concatenate([np.ravel(x) for x in jax.tree.leaves(policy)])))


@pytest.mark.slow
def test_seeds_are_alone():
    """A seed learns beside others what it learns by itself."""
    agent, given = tiny("ppo"), LEARN | {"chunk_steps": 40}
    both, _ = train(Walk(), agent, given, seeds=(3, 4))
    alone, _ = train(Walk(), agent, given, seeds=(4,))
    actors = pick(both.agent.nets["actor"], 1), pick(alone.agent.nets["actor"], 0)
    for x, y in zip(*map(jax.tree.leaves, actors), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-4)
