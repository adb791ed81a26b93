"""SAC's losses and its update against numbers worked out by hand, with networks that are linear."""

import dataclasses
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import probes
import pytest
from probes import quick, random_batch, tasks_of, with_nets

from mtjax.agents.networks import Params, join
from mtjax.agents.parts.encoders import Identity
from mtjax.agents.parts.knowing import Parameters
from mtjax.agents.parts.policies import Drawn, Gaussian
from mtjax.agents.replay_batches import Batch
from mtjax.agents.sac import SAC
from mtjax.agents.state import AgentState
from mtjax.types import Spec, Transition


class Inputs(nn.Module):
    """A body without parameters: observation, action, features."""

    @nn.compact
    def __call__(self, obs, features, *action):
        return join(obs, *action, task=features)


class Bare(Identity):
    def body(self, hidden, layer_norm):
        return Inputs()


@dataclasses.dataclass(frozen=True)
class LinearSAC(SAC):
    conditioning: Parameters = Parameters()  # noqa: RUF009
    encoder: Identity = dataclasses.field(default_factory=Bare)


def linear_policy(self, outputs, mask, key):
    """The first output is the action and the second its log-probability, so that all is linear and without noise."""
    action, log_prob = jnp.split(outputs, 2, axis=-1)
    return Drawn(action, action, log_prob[..., 0])


@pytest.fixture
def linear(monkeypatch):
    """Swap the policy's distribution; programs traced under it must not be cached beyond the test."""
    monkeypatch.setattr(Gaussian, "draw", linear_policy)


def head(kernel, bias):
    return Params({"body": {}, "head": {"kernel": jnp.float32(kernel), "bias": jnp.float32(bias)}}, {})


# One task with context 0.1, observations of one number and actions of one.
FEATURES = jnp.float32([0.1])
ACTOR = head([[2.0, -0.5], [0.0, 0.0]], [0.0, 0.0])  # a = 2 s, log pi = -s / 2
CRITICS = head([[[1.0], [0.5], [0.0]], [[2.0], [-0.5], [10.0]]], [[0.0], [0.0]])  # s + a / 2 and 2 s - a / 2 + 1
NETS = {"actor": ACTOR, "critic": CRITICS, "representation": Params({}, {}), "knowing": Params({}, {})}


def rows(obs, action, reward, discount, next_obs):
    column = lambda x: jnp.float32(x)[:, None]
    return Transition(column(obs), column(action), jnp.float32(reward), jnp.float32(discount), column(next_obs))


def seen(batch, gamma=1.0, temperature=0.0):
    """What the losses see of transitions."""
    fields = (batch.obs, batch.action, batch.reward, gamma * batch.discount, batch.next_obs)
    return Batch(*fields, features=FEATURES, temperature=temperature, mask=None)


@pytest.mark.parametrize(("discount", "expected"), [(1.0, 4.87), (0.0, 1.0), (0.5, 2.935)])
def test_critic_target(linear, discount, expected):
    """From s' = 3: a' = 6, log pi = -1.5, Q = 6 and 4; y = 1 + 0.9 d (4 + 0.2 1.5)."""
    batch = rows([0.0], [0.0], [1.0], [discount], [3.0])
    target = LinearSAC().critic_target(NETS, NETS, seen(batch, 0.9, 0.2), jax.random.key(0))
    np.testing.assert_allclose(target, [expected], rtol=1e-6)


def test_critic_target_takes_the_least_critic_at_each_transition(linear):
    """From s' = 3 the least is the second critic's 4, and from s' = -3 the first's -6."""
    batch = rows([0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [1.0, 1.0], [3.0, -3.0])
    target = LinearSAC().critic_target(NETS, NETS, seen(batch), jax.random.key(0))
    np.testing.assert_allclose(target, [4.0, -6.0], rtol=1e-6)


def test_critic_loss_sums_over_critics_and_averages_over_the_batch():
    """At (1, 2) Q = 2 and 2, at (0, 4) Q = 2 and -1; against 1 and 0: ((1 + 1) + (4 + 1)) / 2."""
    batch = rows([1.0, 0.0], [2.0, 4.0], [9.0, 9.0], [1.0, 1.0], [9.0, 9.0])
    loss, (metrics, *_) = LinearSAC().critic_loss(NETS, seen(batch), jnp.float32([1.0, 0.0]))
    np.testing.assert_allclose(loss, 3.5, rtol=1e-6)
    np.testing.assert_allclose((metrics["critic_loss"], metrics["value"]), (3.5, 1.25), rtol=1e-6)


def test_actor_loss_weighs_entropy_by_temperature(linear):
    """At s = 3: 0.2 (-1.5) - 4 = -4.3; at s = -1: 0.2 0.5 - min(-2, 0) = 2.1; their mean is -1.1."""
    batch = rows([3.0, -1.0], [9.0, 9.0], [9.0, 9.0], [0.0, 1.0], [9.0, 9.0])
    loss, (metrics, *_) = LinearSAC().actor_loss(NETS, seen(batch, temperature=0.2), jax.random.key(0))
    np.testing.assert_allclose(loss, -1.1, rtol=1e-6)
    np.testing.assert_allclose(metrics["entropy"], (1.5 - 0.5) / 2, rtol=1e-6)


def test_temperature_loss_and_the_sign_of_its_slope():
    """H = -1 for two actions; a policy with more entropy than that lowers its task's temperature, and conversely."""
    temperature, entropy = np.float32([0.5, 0.2]), np.float32([3.0, -2.5])
    nets = lambda log: {"temperature": Params({}, {"log": log})}
    loss = lambda log, entropy: SAC(target_entropy=-0.5).temperature_loss(nets(log), entropy, jnp.int32(2))[0]
    expected = temperature * (entropy + 1)
    np.testing.assert_allclose(jax.vmap(loss)(jnp.log(temperature), entropy), expected, rtol=1e-5)
    slope = jax.vmap(jax.grad(loss))(jnp.log(temperature), entropy)
    np.testing.assert_allclose(slope, expected, rtol=1e-5)
    assert slope[0] > 0 > slope[1]


# A whole update in NumPy. Observations of two numbers, actions of one, one feature: critics have 4 inputs, actors 3.

SPEC, BATCH = Spec.vector(2, 1, 1), 3
RATES = {"actor_lr": 0.05, "critic_lr": 0.5, "temperature_lr": 0.02, "tau": 0.25, "gamma": 0.8}


def start(agent, tasks):
    """Networks with random parameters, the slow critic far from the critic, and temperatures of each task."""
    state, random = agent.init(SPEC, tasks, jax.random.key(0)), np.random.default_rng(5)
    draw = lambda tree: jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape)), tree)
    networks = {name: draw(state.nets[name]) for name in ("actor", "critic")}
    slow = draw(state.slow)
    return with_nets(state, **networks, temperature=draw(state.nets["temperature"]))._replace(slow=slow)


def arrays(params):
    return np.asarray(params.shared["head"]["kernel"]), np.asarray(params.shared["head"]["bias"])


def adam(rate, gradient):
    """Adam's first step."""
    return -rate * gradient / (np.abs(gradient) + 1e-8)


def plain_update(agent, state: AgentState, batch: Transition, context):
    """The gradients of critic, actor and temperature, and what they make of the parameters; loops, no autodiff."""
    num_tasks = len(context)
    share = 1 / (num_tasks * BATCH)
    log_temperature = np.asarray(state.nets["temperature"].parts["log"])
    temperature = np.broadcast_to(np.exp(log_temperature), num_tasks)
    (actor, actor_bias), (target, target_bias) = arrays(state.nets["actor"]), arrays(state.slow["critic"])
    critic, critic_bias = arrays(state.nets["critic"])

    def act(obs, task):
        return np.concatenate([obs, context[task]]) @ actor + actor_bias

    def estimates(kernel, bias, obs, action, task):
        inputs = np.concatenate([obs, [action], context[task]])
        return inputs, inputs @ kernel[..., 0].T + bias[:, 0]

    d_critic, d_critic_bias = np.zeros_like(critic), np.zeros_like(critic_bias)
    for t, b in np.ndindex(num_tasks, BATCH):
        obs, action, reward, discount, next_obs = (np.asarray(x[t, b]) for x in batch[:5])
        next_action, log_prob = act(next_obs, t)
        _, slow = estimates(target, target_bias, next_obs, next_action, t)
        y = reward + agent.gamma * discount * (min(slow) - temperature[t] * log_prob)
        inputs, found = estimates(critic, critic_bias, obs, action[0], t)
        for n in range(agent.num_critics):
            d_critic[n, :, 0] += share * 2 * (found[n] - y) * inputs
            d_critic_bias[n, 0] += share * 2 * (found[n] - y)
    new_critic = critic + adam(agent.critic_lr, d_critic), critic_bias + adam(agent.critic_lr, d_critic_bias)

    d_actor, d_actor_bias, entropy = np.zeros_like(actor), np.zeros_like(actor_bias), np.zeros(num_tasks)
    for t, b in np.ndindex(num_tasks, BATCH):
        obs = np.asarray(batch.obs[t, b])
        action, log_prob = act(obs, t)
        _, found = estimates(*new_critic, obs, action, t)
        slope = np.array([-new_critic[0][np.argmin(found), 2, 0], temperature[t]])
        d_actor += share * np.outer(np.concatenate([obs, context[t]]), slope)
        d_actor_bias += share * slope
        entropy[t] -= log_prob / BATCH
    new_actor = actor + adam(agent.actor_lr, d_actor), actor_bias + adam(agent.actor_lr, d_actor_bias)

    d_temperature = temperature * (entropy - agent.target_entropy) / num_tasks
    d_temperature = d_temperature.sum(keepdims=True) if agent.shared_temperature else d_temperature
    new_target = [
        (1 - agent.tau) * old + agent.tau * new for old, new in zip((target, target_bias), new_critic, strict=True)
    ]
    gradients = {"actor": (d_actor, d_actor_bias), "critic": (d_critic, d_critic_bias), "temperature": d_temperature}
    new_temperature = log_temperature + adam(agent.temperature_lr, d_temperature)
    return gradients, {"actor": new_actor, "critic": new_critic, "target": new_target}, new_temperature


@pytest.mark.parametrize(
    "settings",
    [{}, {"shared_temperature": True, "num_critics": 3}, {"gradients": "pcgrad"}],
    ids=["separate temperatures", "shared temperature, three critics", "pcgrad of one task"],
)
def test_an_update_is_the_one_worked_out_in_numpy(linear, settings):
    """Gradients that reach each optimiser, new parameters, and their order: target and actor follow the new critic."""
    agent = LinearSAC(**RATES, **settings)
    tasks = tasks_of("one-step", [0.4] if "gradients" in settings else [0.4, -0.8])
    batch = random_batch(3, len(tasks.id), BATCH, SPEC)
    before = start(agent, tasks)
    after, metrics = quick(partial(probes.update, agent), before, batch, tasks, jax.random.key(1))(
        before, batch, tasks, jax.random.key(1)
    )
    gradients, parameters, log_temperature = plain_update(agent, before, batch, np.asarray(tasks.context))

    mean = lambda who: optax.tree_utils.tree_get(after.fits[who].optimizer, "mu")[who]  # a tenth, after one step
    for who in ("actor", "critic"):
        for ours, theirs in zip(arrays(mean(who)), gradients[who], strict=True):
            np.testing.assert_allclose(10 * ours, theirs, rtol=1e-4, atol=1e-5)
    recorded = mean("temperature").parts["log"]
    np.testing.assert_allclose(10 * recorded, gradients["temperature"], rtol=1e-4, atol=1e-5)
    networks = {"actor": after.nets["actor"], "critic": after.nets["critic"], "target": after.slow["critic"]}
    for who, expected in parameters.items():
        for ours, theirs in zip(arrays(networks[who]), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)
    log_temperatures = [state.nets["temperature"].parts["log"] for state in (before, after)]
    np.testing.assert_allclose(log_temperatures[1], log_temperature, rtol=1e-4)
    used = np.broadcast_to(np.exp(log_temperatures[0]), len(tasks.id))
    np.testing.assert_allclose(metrics["temperature"], used, rtol=1e-5)


def test_temperature_and_target_begin_as_set():
    """Temperatures at the given one, a task or in all; the slow critic at the critic, but in memory of its own."""
    tasks = tasks_of("one-step")
    state = LinearSAC(initial_temperature=0.3).init(SPEC, tasks, jax.random.key(0))
    np.testing.assert_allclose(np.exp(state.nets["temperature"].own["log"]), [0.3, 0.3], rtol=1e-6)
    shared = LinearSAC(initial_temperature=0.3, shared_temperature=True).init(SPEC, tasks, jax.random.key(0))
    assert shared.nets["temperature"].shared["log"].shape == (1,)
    kernel, slow = (x["critic"].shared["head"]["kernel"] for x in (state.nets, state.slow))
    np.testing.assert_array_equal(kernel, slow)
    assert kernel.unsafe_buffer_pointer() != slow.unsafe_buffer_pointer()
    assert not np.allclose(kernel[0], kernel[1])


@pytest.mark.slow
def test_each_transition_is_seen_with_its_own_episodes_context(linear):
    """Contexts stored beside transitions take the place of the tasks' own, sample by sample."""
    tasks, key = tasks_of("one-step", [0.4, -0.8]), jax.random.key(1)
    agent, batch = LinearSAC(**RATES), random_batch(3, 2, BATCH, SPEC)
    before = start(agent, tasks)
    alike = batch._replace(context=jnp.broadcast_to(tasks.context[:, None], (2, BATCH, 1)))
    other = alike._replace(context=alike.context.at[0, 0].add(1.0))
    plain, same, moved = (probes.update(agent, before, x, tasks, key)[1]["critic_loss"] for x in (batch, alike, other))
    np.testing.assert_allclose(plain, same, rtol=1e-5)
    assert abs(plain[0] - moved[0]) > 1e-3 and abs(plain[1] - moved[1]) < 1e-5
