"""Policies against numbers worked out in NumPy: what they draw, how likely it is, and what masks leave out."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Levers, of_task, slow_but, tiny

import mtjax
from mtjax.agents import for_action
from mtjax.agents.networks import Params
from mtjax.agents.parts.policies import Categorical, Gaussian, MultiCategorical, policy_for
from mtjax.agents.ppo import Batch
from mtjax.config import configure
from mtjax.envs.probes import tasks_of
from mtjax.learning import loop
from mtjax.types import Continuous, Discrete, InputError, MultiDiscrete, Spec, Transition

KEY = jax.random.key(0)
LOGITS = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
MASK = np.float32([1, 0, 1, 1])
POLICY = Categorical(4)


def softmax(logits, mask=None):
    weights = np.exp(np.float64(logits)) * (1 if mask is None else mask)
    return weights / weights.sum(axis=-1, keepdims=True)


def test_the_kind_of_actions_decides():
    assert policy_for(Continuous(3)) == Gaussian() and policy_for(Discrete(3)) == Categorical(3) != Categorical(4)
    assert Continuous(3) != Discrete(3)


@pytest.mark.parametrize("action", [Continuous(3), Discrete(3)])
def test_a_kind_of_actions_says_what_they_are(action):
    """Shape, type, zero, random ones in range, and the vector of size 3 that networks see of each."""
    one, many = action.blank(), action.random(KEY, (500, 2))
    assert one.shape == action.shape and one.dtype == many.dtype == action.dtype and not np.any(one)
    assert many.shape == (500, 2, *action.shape) and action.encode(many).shape == (500, 2, 3)
    if isinstance(action, Discrete):
        assert np.bincount(np.ravel(many), minlength=3).min() > 250
        np.testing.assert_array_equal(action.encode(many), np.eye(3)[np.asarray(many)])
    else:
        assert -1 <= np.min(many) < -0.99 and 0.99 < np.max(many) < 1
    np.testing.assert_array_equal(policy_for(action).encode(many), action.encode(many))
    outputs = policy_for(action).outputs(3)
    nets = {"actor": Params({"head": {"bias": jnp.zeros(outputs)}}, {})}
    assert policy_for(action).blank(nets).shape == one.shape and policy_for(action).first(3, 0.7).shape == (outputs,)


@pytest.mark.parametrize("mask", [None, MASK], ids=["all", "masked"])
def test_categorical_numbers(mask):
    """Log-probabilities, entropy and divergence are those of a softmax over the actions that there are."""
    others = LOGITS[::-1]
    p, q = softmax(LOGITS, mask), softmax(others, mask)
    there = p > 0
    actions = np.int32([0, 2, 3, 0, 2, 3])
    found = POLICY.log_prob(LOGITS, jnp.asarray(actions), mask)
    np.testing.assert_allclose(found, np.log(p[np.arange(6), actions]), rtol=1e-5)
    plogp = np.where(there, p * np.log(np.where(there, p, 1)), 0)
    np.testing.assert_allclose(POLICY.entropy(LOGITS, mask, KEY), -plogp.sum(axis=1), rtol=1e-5)
    expected = np.where(there, p * np.log(np.where(there, p / np.where(there, q, 1), 1)), 0).sum(axis=1)
    np.testing.assert_allclose(POLICY.divergence(LOGITS, others, mask), expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(POLICY.divergence(LOGITS, LOGITS, mask), 0)


def test_categorical_draws():
    """As often as likely, with the log-probability of what was drawn; without a key the likeliest that there is."""
    draw = jax.vmap(lambda key: POLICY.draw(LOGITS[0], MASK, key))
    drawn = draw(jax.random.split(KEY, 20_000))
    assert drawn.action.dtype == jnp.int32 and drawn.action.shape == (20_000,)
    shares = np.bincount(drawn.action, minlength=4) / 20_000
    np.testing.assert_allclose(shares, softmax(LOGITS[0], MASK), atol=0.02)
    assert shares[1] == 0
    np.testing.assert_allclose(drawn.log_prob, np.log(softmax(LOGITS[0], MASK)[drawn.action]), rtol=1e-5)
    high = np.float32([0.0, 9.0, 1.0, 0.5])
    assert POLICY.draw(high, None, None).action == 1 and POLICY.draw(high, MASK, None).action == 2


def test_what_a_task_lacks_has_probability_and_gradient_exactly_zero():
    """Whatever its output is; and with one action left, that has probability exactly 1."""
    outputs = np.float32([[0.3, 80.0, -0.2, 1.0], [0.3, -80.0, -0.2, 1.0], [0, 1e9, 0, 0]])
    chances = jnp.exp(jax.vmap(lambda a: POLICY.log_prob(outputs, jnp.full(3, a), MASK))(jnp.arange(4)))
    assert np.all(chances[1] == 0)
    np.testing.assert_allclose(np.sum(chances, axis=0), 1, rtol=1e-6)
    for value in (
        lambda x: POLICY.log_prob(x, jnp.int32([0, 2, 3]), MASK),
        lambda x: POLICY.entropy(x, MASK, KEY),
        lambda x: POLICY.divergence(x, LOGITS[:3], MASK),
        lambda x: POLICY.divergence(LOGITS[:3], x, MASK),
    ):
        slope = jax.grad(lambda x, value=value: jnp.sum(value(x)))(jnp.asarray(outputs))
        assert np.all(np.isfinite(slope)) and np.all(slope[:, 1] == 0) and np.any(slope[:, 0] != 0)
    alone = np.float32([0, 0, 1, 0])
    assert POLICY.log_prob(LOGITS[0], jnp.int32(2), alone) == POLICY.entropy(LOGITS[0], alone, KEY) == 0


# Several choices at once.

SEVERAL = MultiCategorical(MultiDiscrete((2, 2, 3)))
ALL = np.array(list(itertools.product(range(2), range(2), range(3))), np.int32)  # the 12 actions
MANY = np.random.default_rng(2).normal(size=(2, 7)).astype(np.float32)  # logits of two policies


@pytest.mark.parametrize("sizes", [(3, 5), (2, 2, 3), (4,)])
def test_several_choices_are_numbers_side_by_side(sizes):
    """Every choice of each is drawn; networks see a one-hot of each, one after another."""
    kind = MultiDiscrete(sizes)
    one, many = kind.blank(), kind.random(KEY, (400, 3))
    assert one.shape == kind.shape == (len(sizes),) and one.dtype == many.dtype == jnp.int32 and not one.any()
    assert many.shape == (400, 3, len(sizes)) and kind.size == sum(sizes)
    for i, size in enumerate(sizes):
        assert np.bincount(np.ravel(many[..., i]), minlength=size).min() > 600 / size
    expected = np.concatenate([np.eye(size)[many[..., i]] for i, size in enumerate(sizes)], axis=-1)
    np.testing.assert_array_equal(kind.encode(many), expected)
    policy = policy_for(kind)
    assert policy == MultiCategorical(kind) != MultiCategorical(MultiDiscrete((5, 3)))
    np.testing.assert_array_equal(policy.encode(many), expected)
    assert policy.outputs(kind.size) == kind.size and policy.blank({}).shape == kind.shape


@pytest.mark.parametrize("sizes", [(), (3, 0), (2.5, 2), 3, ((2, 3),)])
def test_sizes_of_several_choices_are_checked(sizes):
    with pytest.raises(InputError, match="number of choices of each action, such as"):
        MultiDiscrete(sizes)


def test_several_choices_by_hand():
    """Probabilities (1/4, 3/4) and (1/2, 3/10, 1/5), with the second's middle one missing (5/7, 0, 2/7)."""
    policy, mask = MultiCategorical(MultiDiscrete((2, 3))), np.float32([1, 1, 1, 0, 1])
    outputs, action = np.log(np.float32([0.25, 0.75, 0.5, 0.3, 0.2])), np.int32([1, 2])
    np.testing.assert_allclose(policy.log_prob(outputs, action), np.log(0.75 * 0.2), rtol=1e-6)
    np.testing.assert_allclose(policy.log_prob(outputs, action, mask), np.log(0.75 * 2 / 7), rtol=1e-6)
    np.testing.assert_allclose(policy.entropy(outputs, None, KEY), 0.562335 + 1.029653, rtol=1e-5)
    np.testing.assert_allclose(policy.entropy(outputs, mask, KEY), 0.562335 + 0.598270, rtol=1e-5)
    even = np.zeros(5, np.float32)
    np.testing.assert_allclose(policy.divergence(outputs, even), 0.130812 + 0.068959, rtol=1e-5)
    np.testing.assert_allclose(policy.divergence(outputs, even, mask), 0.130812 + 0.094877, rtol=1e-5)


@pytest.mark.parametrize("mask", [None, np.float32([1, 1, 0, 1, 1, 0, 1])], ids=["all", "masked"])
def test_several_choices_are_a_distribution_over_all_their_combinations(mask):
    """Its probabilities sum to 1; entropy and divergence are those of the twelve, or four, joint actions."""
    p, q = (np.exp(np.float64(SEVERAL.log_prob(np.tile(x, (12, 1)), ALL, mask))) for x in MANY)
    there = p > 0
    assert there.sum() == (12 if mask is None else 4)
    np.testing.assert_allclose([p.sum(), q.sum()], 1, rtol=1e-6)
    p, q = p[there], q[there]
    np.testing.assert_allclose(SEVERAL.entropy(MANY[0], mask, KEY), -p @ np.log(p), rtol=1e-5)
    np.testing.assert_allclose(SEVERAL.divergence(*MANY, mask), p @ np.log(p / q), rtol=1e-5)
    drawn = jax.vmap(lambda key: SEVERAL.draw(MANY[0], mask, key))(jax.random.split(KEY, 20_000))
    assert drawn.action.dtype == jnp.int32 and drawn.action.shape == (20_000, 3)
    counts = np.bincount(drawn.action @ np.array([6, 3, 1]), minlength=12)
    np.testing.assert_allclose(counts[there] / 20_000, p, atol=0.02)
    assert counts[~there].sum() == 0
    again = SEVERAL.log_prob(np.tile(MANY[0], (20_000, 1)), drawn.action, mask)
    np.testing.assert_allclose(drawn.log_prob, again, rtol=1e-5, atol=1e-6)
    mode = SEVERAL.draw(MANY[0], mask, None).action
    np.testing.assert_array_equal(mode, ALL[there][np.argmax(p)])


def test_one_of_several_is_a_choice():
    """A single number is as likely as a ``Categorical`` says, bit for bit."""
    one, actions = MultiCategorical(MultiDiscrete((4,))), np.int32([0, 1, 2, 3, 0, 2])
    np.testing.assert_array_equal(one.log_prob(LOGITS, actions[:, None], MASK), POLICY.log_prob(LOGITS, actions, MASK))
    np.testing.assert_array_equal(one.entropy(LOGITS, MASK, KEY), POLICY.entropy(LOGITS, MASK, KEY))
    others = LOGITS[::-1]
    np.testing.assert_array_equal(one.divergence(LOGITS, others, MASK), POLICY.divergence(LOGITS, others, MASK))


@pytest.mark.parametrize("mask", [None, np.float32([1, 0])], ids=["all", "masked"])
def test_gaussian_draws(mask):
    """The action is the tanh of what was drawn, 0 where a task has none, and as likely as ``log_prob`` says."""
    outputs = np.random.default_rng(1).normal(size=(50, 4)).astype(np.float32)
    drawn = Gaussian().draw(outputs, mask, KEY)
    np.testing.assert_array_equal(drawn.action, jnp.tanh(drawn.raw) * (1 if mask is None else mask))
    np.testing.assert_allclose(drawn.log_prob, Gaussian().log_prob(outputs, drawn.raw, mask), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(Gaussian().entropy(outputs, mask, KEY), -drawn.log_prob)


def test_all_actions_are_as_likely_at_first():
    """PPO's first entropy is log A: heads are small, and biases 0."""
    agent, spec = for_action(tiny("ppo"), Discrete(5)), Spec.vector(3, 5, 100)._replace(action=Discrete(5))
    tasks = mtjax.make("tabular-mdp", num_tasks=2).tasks()
    state = agent.init(spec, tasks, KEY)
    task = jax.tree.map(lambda x: x[0], tasks)
    draw = lambda key: agent.act(state, agent.begin(state, task), jnp.ones(3), task, key).extras.log_prob
    np.testing.assert_allclose(jax.vmap(draw)(jax.random.split(KEY, 50)), -np.log(5), atol=0.05)


def test_the_policy_gradient_of_a_bandit():
    """Of the expected reward sum_a pi_a r_a by PPO's actor loss: pi_a (r_a - sum_b pi_b r_b) for the output of a.

    Every arm is in the batch once, and counts by its probability, as if it had been drawn so often.
    """
    rewards, spec = np.float32([0.1, 0.9, 0.4, 0.7]), Spec.vector(1, 4, 1)._replace(action=Discrete(4))
    agent = for_action(tiny("ppo", conditioning="none", entropy_cost=0.0, normalize_observations=False), spec.action)
    tasks = jax.tree.map(lambda x: x[:1], tasks_of("one-step", (1.0, 0.5)))
    nets = of_task(agent.init(spec, tasks, KEY).nets, 0)
    head = nets["actor"].shared["head"] | {"bias": jnp.asarray(LOGITS[0])}
    obs, features, arms = jnp.zeros((4, 1)), jnp.zeros(0), jnp.arange(4)

    def of_bias(bias):
        return nets | {"actor": nets["actor"]._replace(shared=nets["actor"].shared | {"head": head | {"bias": bias}})}

    outputs = agent.policy_outputs(of_bias(head["bias"]), features, obs)
    p = softmax(outputs[0])
    batch = Batch(obs, arms, jnp.log(p), jnp.asarray(4 * p * rewards), rewards, rewards, features, None)
    slope = jax.grad(lambda bias: agent.actor_loss(of_bias(bias), batch, KEY)[0])(head["bias"])
    np.testing.assert_allclose(-slope, p * (rewards - p @ rewards), rtol=1e-4, atol=1e-6)


# Worlds.


@pytest.fixture(scope="module")
def optimum():
    """Value iteration on a family of tabular MDPs: the mean reward of a step from gamma-optimal and other policies."""

    def optimal(rewards, transitions, gamma):
        value = np.zeros(len(rewards))
        for _ in range(2000):
            value = np.max(rewards + gamma * transitions @ value, axis=1)
        return np.argmax(rewards + gamma * transitions @ value, axis=1)

    def reward(rewards, transitions, actions):
        states = np.arange(len(rewards))
        moves = transitions[states, actions]
        shares = np.full(len(rewards), 1 / len(rewards))
        total = 0.0
        for _ in range(100):
            total += shares @ rewards[states, actions]
            shares = shares @ moves
        return total

    return optimal, reward


@pytest.mark.usefixtures("optimised")
@pytest.mark.nightly
def test_ppo_learns_tabular_mdps(optimum):
    """Its greedy actions in every state return at least 97% of what value iteration's do, in every task."""
    env, (optimal, reward) = mtjax.make("tabular-mdp", num_tasks=4), optimum
    given = {"num_envs": 16, "gamma": 0.95, "actor_lr": 1e-3}
    result = mtjax.train(env, "ppo", steps=480_000, quiet=True, eval_episodes=1, **given)
    policy, tasks = result.policy(), env.tasks()
    states = np.eye(4, dtype=np.float32)
    for i in range(4):
        task = jax.tree.map(lambda x, i=i: x[i], tasks)
        rewards, transitions = (np.float64(task.goal[name]) for name in ("rewards", "transitions"))
        best = optimal(rewards, transitions, 0.99)
        most = max(reward(rewards, transitions, np.array(x)) for x in itertools.product(range(5), repeat=4))
        assert reward(rewards, transitions, best) > 0.99 * most  # value iteration finds the best of all policies
        for last in (0.0, 1.0):
            obs = np.concatenate([states, np.full((4, 1), last, np.float32)], axis=1)
            found = reward(rewards, transitions, np.asarray(policy(obs, task)))
            assert found >= 0.97 * reward(rewards, transitions, best), (i, last, found)


@pytest.mark.slow
def test_ppo_finds_the_best_arm_of_every_task():
    env = mtjax.make("bandit", num_tasks=3)
    result = mtjax.train(env, "ppo", steps=30_000, num_envs=8, quiet=True, eval_episodes=1, hidden=(32,))
    policy, tasks = result.policy(), env.tasks()
    for i in range(3):
        task = jax.tree.map(lambda x, i=i: x[i], tasks)
        action = policy(jnp.zeros(1), task)
        assert action.dtype == jnp.int32 and action == np.argmax(task.goal["rewards"])


LEVERS = Levers(vary={"turn": "0,1"}, split="none")


@pytest.mark.slow
def test_ppo_finds_the_best_places_of_two_levers():
    """In all lights of all tasks, so that every episode returns the 6 that is most."""
    given = {"num_envs": 8, "hidden": (32,), "actor_lr": 3e-3, "eval_episodes": 5}
    result = mtjax.train(LEVERS, "ppo", steps=100_000, quiet=True, **given)
    policy, tasks = result.policy(), LEVERS.tasks()
    for i, light in itertools.product(range(2), range(3)):
        task = jax.tree.map(lambda x, i=i: x[i], tasks)
        action = policy(np.eye(3, dtype=np.float32)[light], task)
        assert action.dtype == jnp.int32
        np.testing.assert_array_equal(action, LEVERS.best(task, light))
    np.testing.assert_array_equal(result.evaluations.returns["train"][:, -1], 6)


@pytest.mark.parametrize("name", slow_but(["ppo", "impala", "rl2", "maml", "options"], "ppo", "options"))
def test_agents_train_on_several_choices(name):
    """Traced, not run: the loop, agent and tasks fit together."""
    agent = for_action(tiny(name, unroll=4, minibatches=1, epochs=1), LEVERS.action)
    agent, settings = configure(agent, loop.Settings(), {"num_envs": 2, "chunk_steps": 8})
    state = jax.eval_shape(lambda: loop.init(LEVERS, agent, settings, LEVERS.tasks(), jnp.arange(1)))
    after, _ = jax.eval_shape(lambda state: loop.run_chunk(LEVERS, agent, settings, LEVERS.tasks(), state), state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)


@pytest.mark.parametrize("name", ["sac", "pqn"])
def test_agents_without_several_choices_name_those_with_them(name):
    said = rf"{name} draws no multi-discrete \(3, 5\) actions, which .* has: use ppo, .*impala"
    with pytest.raises(InputError, match=said):
        mtjax.train(LEVERS, name, steps=10)


def test_agents_of_continuous_actions_are_refused_before_anything_is_compiled():
    """By name, with what to use instead; and an agent that was made for other actions."""
    with pytest.raises(InputError, match=r"sac draws no discrete actions, which bandit has: use ppo, .*scores"):
        mtjax.train("bandit", "sac", steps=10)
    with pytest.raises(InputError, match="sac draws no discrete actions, which craft-sketched has: use sketches, ppo"):
        mtjax.train("craft-sketched", "sac", steps=10)
    bandit = mtjax.make("bandit")
    with pytest.raises(InputError, match="SAC draws no discrete actions"):
        tiny("sac").init(bandit.spec, bandit.tasks(), KEY)
    with pytest.raises(InputError, match=r"PPO was not made for these discrete actions: for_action\(agent"):
        tiny("ppo").init(bandit.spec, bandit.tasks(), KEY)


def test_past_actions_are_kept_as_numbers_and_seen_as_vectors():
    """By agents that infer their task from the last steps; those before the first step are not known."""
    env = mtjax.make("bandit", num_tasks=2)
    agent = for_action(tiny("ppo", conditioning="inferred", inferred_from=3), env.spec.action)
    state, task = agent.init(env.spec, env.tasks(), KEY), jax.tree.map(lambda x: x[0], env.tasks())
    step = Transition(jnp.zeros(1), jnp.int32(3), jnp.float32(1), jnp.float32(1), jnp.zeros(1))
    past = agent.remember(state, agent.begin(state, task), step, task).past
    assert past.action.dtype == jnp.int32 and past.action.tolist() == [0, 0, 3] and past.known.tolist() == [0, 0, 1]
    seen = agent.view.see(of_task(state.nets, 0)["inputs"], jnp.zeros(1), past)
    np.testing.assert_array_equal(seen.past.action, np.eye(5)[[0, 0, 3]])


def test_past_choices_of_several_are_kept_side_by_side():
    agent = for_action(tiny("ppo", conditioning="inferred", inferred_from=2), LEVERS.action)
    state, task = agent.init(LEVERS.spec, LEVERS.tasks(), KEY), jax.tree.map(lambda x: x[0], LEVERS.tasks())
    step = Transition(jnp.zeros(3), jnp.int32([2, 1]), jnp.float32(1), jnp.float32(1), jnp.zeros(3))
    past = agent.remember(state, agent.begin(state, task), step, task).past
    assert past.action.dtype == jnp.int32 and past.action.tolist() == [[0, 0], [2, 1]]
    seen = agent.view.see(of_task(state.nets, 0)["inputs"], jnp.zeros(3), past)
    assert seen.past.action.tolist() == [[1, 0, 0, 1, 0, 0, 0, 0], [0, 0, 1, 0, 1, 0, 0, 0]]
