"""XQC: batch normalisation by hand, statistics of every task alone, and both ends of a transition in one batch."""

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from probes import act, learner, of_task, pick, quick, random_batch, slow_but, tasks_of, tiny

from mtjax.agents import agent, replay_batches
from mtjax.agents.networks import STATISTICS, Network, Params
from mtjax.agents.parts.encoders import BatchNorm
from mtjax.agents.unseen_tasks import describe_unseen
from mtjax.types import InputError, Spec

SPEC, BATCH = Spec.vector(3, 2, 1), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(0)
EVERY_HEADS = pytest.mark.parametrize("heads", slow_but(["shared", "per-task", "disjoint"], "per-task"))


def started(**settings):
    """The agent, a state of it, and its compiled update."""
    made = tiny("xqc", **settings)
    init, update = learner(made, TASKS, BATCH, SPEC)
    return made, init(TASKS, KEY), update


def both_ends(made, state, batch, key):
    """Inputs of the critics (T, 2 B, x) at both ends of the transitions, as the update with this key draws actions."""
    target_key = jax.random.split(key, 4)[0]
    seen = probes.prepare(made, state, batch, TASKS)
    _, aim = replay_batches.critic_data(made, state, seen, target_key)
    ends = (batch.obs, batch.action), (batch.next_obs, aim.next_action)
    return np.concatenate([np.concatenate(end, axis=-1) for end in ends], axis=1)


@pytest.mark.slow
def test_targets_are_normalised_by_both_ends_of_the_batch_and_not_by_running_statistics():
    """So they depend on the rest of the batch, and not on what the target critics have seen before."""
    made, state, _ = started()
    batch = random_batch(1, 3, BATCH, SPEC)._replace(discount=jnp.ones((3, BATCH)))

    @jax.jit
    def target(state, batch):
        seen = probes.prepare(made, state, batch, TASKS)
        return replay_batches.critic_data(made, state, seen, KEY)[1].target

    as_it_is = np.asarray(target(state, batch))
    slow = state.slow["critic"]
    other = {STATISTICS: jax.tree.map(lambda x: 3 * x + 1, slow.own[STATISTICS])}
    assert jax.tree.leaves(other)
    moved = state._replace(slow=state.slow | {"critic": slow._replace(own=slow.own | other)})
    np.testing.assert_array_equal(target(moved, batch), as_it_is)
    mates = batch._replace(obs=batch.obs.at[:, 1].add(2.0))
    assert np.abs(target(state, mates)[:, 0] - as_it_is[:, 0]).max() > 1e-4


def test_a_layer_normalises_by_the_batch_by_hand():
    """Inputs 1, 2, 3, 6: mean 3 and variance 3.5; running ones move by a hundredth, and are what acting uses."""
    network = Network(BatchNorm().body((1,), layer_norm=False))
    obs, none = jnp.float32([[1.0], [2.0], [3.0], [6.0]]), jnp.zeros(0)
    params = of_task(network.init(KEY, 1, 1, none, obs[0]), 0)
    body, head = params.shared["body"]["params"], {"kernel": jnp.ones((1, 1)), "bias": jnp.zeros(1)}
    body = body | {
        "UnitDense_0": {"direction": jnp.ones((1, 1))},
        "BatchNorm_1": {"scale": jnp.ones(1), "bias": jnp.ones(1)},
    }
    params = Params({"body": {"params": body}, "head": head}, params.own)
    out, found = network.fit(params, none, obs)
    inputs = (np.array([1, 2, 3, 6]) - 3) / np.sqrt(3.501)
    expected = np.maximum(inputs / np.sqrt(3.5 / 3.501 + 0.001) + 1, 0)
    np.testing.assert_allclose(out[:, 0], expected, rtol=1e-5)
    first, second = (found[STATISTICS][f"BatchNorm_{i}"] for i in (0, 1))
    np.testing.assert_allclose([first["mean"][0], first["var"][0]], [0.03, 0.99 + 0.035], rtol=1e-5)
    np.testing.assert_allclose([second["mean"][0], second["var"][0]], [0, 0.99 + 0.01 * 3.5 / 3.501], atol=1e-6)

    running = {name: {"mean": jnp.full(1, 2.0), "var": jnp.full(1, 8.999)} for name in ("BatchNorm_0", "BatchNorm_1")}
    out = network.apply(Params(params.shared, {STATISTICS: running}), none, obs)
    np.testing.assert_allclose(out[:, 0], np.maximum(((np.array([1, 2, 3, 6]) - 2) / 3 - 2) / 3 + 1, 0), rtol=1e-5)


def test_the_body_is_its_equations(random):
    """Two layers with random parameters and a task's features, which the batch's mean does not take away."""
    obs, features, action = (jnp.float32(random.normal(size=size)) for size in ((4, 3), (2,), (4, 2)))
    module = BatchNorm().body((6, 5), layer_norm=False)
    start = module.init(KEY, obs, features, action)
    params = jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape)), start["params"])
    p = jax.tree.map(np.float64, params)

    def normalized(i, x):
        x = (x - x.mean(axis=0)) / np.sqrt(x.var(axis=0) + 1e-3)
        return x * p[f"BatchNorm_{i}"]["scale"] + p[f"BatchNorm_{i}"]["bias"]

    x = normalized(0, np.concatenate([obs, action], axis=-1, dtype=np.float64))
    for i in (0, 1):
        layer = normalized(i + 1, x @ p[f"UnitDense_{i}"]["direction"])
        x = np.maximum(layer + features @ p[f"task_{i}"]["kernel"], 0)
    found, _ = module.apply({**start, "params": params}, obs, features, action, mutable=STATISTICS)
    np.testing.assert_allclose(found, x, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@EVERY_HEADS
def test_statistics_are_those_of_both_ends_of_every_tasks_own_batch(heads):
    """After one update of every critic; the policy's are those of its observations."""
    made, state, update = started(heads=heads)
    batch = random_batch(0, 3, BATCH, SPEC)
    batch = batch._replace(obs=batch.obs + 5.0 * jnp.arange(3)[:, None, None])
    after, _ = update(state, batch, TASKS, KEY)
    inputs = both_ends(made, state, batch, KEY)
    assert inputs.shape == (3, 2 * BATCH, 5)
    for params, data in ((after.nets["critic"], inputs), (after.nets["actor"], np.asarray(batch.obs))):
        found = params.own[STATISTICS]["BatchNorm_0"]
        for key, start, moment in (("mean", 0.0, data.mean(axis=1)), ("var", 0.99, data.var(axis=1))):
            numbers = np.asarray(found[key]).reshape(3, -1, data.shape[-1])  # (T, N, inputs)
            expected = np.broadcast_to((start + 0.01 * moment)[:, None], numbers.shape)
            np.testing.assert_allclose(numbers, expected, rtol=1e-4, atol=1e-6)
    critic = after.nets["critic"]
    assert STATISTICS not in critic.shared and critic.own[STATISTICS]["BatchNorm_1"]["var"].shape == (3, 2, 16)


@pytest.mark.slow
def test_statistics_are_no_other_tasks():
    """Another batch of the second task changes its statistics alone, in the same update."""
    _, state, update = started()
    batch = random_batch(0, 3, BATCH, SPEC)
    other = batch._replace(obs=batch.obs.at[1].multiply(3.0), next_obs=batch.next_obs.at[1].add(2.0))
    first, second = (update(state, x, TASKS, KEY)[0] for x in (batch, other))
    for network in ("actor", "critic"):
        pairs = zip(*(jax.tree.leaves(x.nets[network].own[STATISTICS]) for x in (first, second)), strict=True)
        for one, two in pairs:
            one, two = np.asarray(one), np.asarray(two)
            np.testing.assert_array_equal(one[[0, 2]], two[[0, 2]])
            assert np.abs(one[1] - two[1]).max() > 0


@pytest.mark.slow
def test_no_slope_reaches_the_statistics():
    """Nor does weight decay: what Adam remembers of them is zero, and they are the batches'."""
    _, state, update = started(weight_decay=0.5, critic_lr=0.1)
    batch = random_batch(0, 3, BATCH, SPEC)
    after, _ = update(state, batch, TASKS, KEY)
    _, same, plain_update = started()
    plain, _ = plain_update(same, batch, TASKS, KEY)
    for one, two in zip(*(jax.tree.leaves(x.nets["critic"].own[STATISTICS]) for x in (after, plain)), strict=True):
        np.testing.assert_array_equal(one, two)
    for memory in (after.fits["actor"].optimizer, after.fits["critic"].optimizer):
        leaves = [
            x for path, x in jax.tree_util.tree_leaves_with_path(memory) if STATISTICS in jax.tree_util.keystr(path)
        ]
        assert leaves and not any(np.any(x) for x in leaves)


@pytest.mark.slow
@EVERY_HEADS
def test_weights_begin_and_stay_on_the_sphere(heads):
    """Of hidden layers and outputs; not those that add the task's features."""
    _, state, update = started(heads=heads, actor_lr=0.1, critic_lr=0.1)
    after, _ = update(state, random_batch(0, 3, BATCH, SPEC), TASKS, KEY)
    for params in (x.nets[network] for x in (state, after) for network in ("actor", "critic")):
        leaves = jax.tree_util.tree_leaves_with_path(params)
        directions = [x for path, x in leaves if path[-1].key == "direction"]
        assert len(directions) == 2 and sum("task_0" in jax.tree_util.keystr(path) for path, _ in leaves) == 1
        for x in directions:
            np.testing.assert_allclose(np.linalg.norm(x, axis=-2), 1, rtol=1e-5)


@pytest.mark.slow
def test_an_action_is_that_of_the_tasks_own_running_statistics():
    """One observation makes no batch, so it is normalised by what its task has seen; unseen tasks by the nearest's."""
    made, state, update = started(conditioning="none")
    for i in range(3):
        state, _ = update(state, random_batch(i, 3, BATCH, SPEC), TASKS, KEY)
    obs = jnp.float32([0.3, -1.0, 2.0])
    actions = np.stack([act(made, state, obs, pick(TASKS, i), None) for i in range(3)])
    for i in range(3):
        outputs = made.actor.apply(of_task(state.nets["actor"], i), jnp.zeros(0), obs)
        np.testing.assert_allclose(actions[i], np.tanh(outputs[:2]), rtol=1e-5)
    assert len(np.unique(actions, axis=0)) == 3
    unseen = pick(tasks_of("one-step", [0.25]), 0)._replace(id=jnp.int32(9))
    np.testing.assert_array_equal(act(made, state, obs, unseen, None), actions[2])
    assert "statistics of the nearest training task" in describe_unseen(made)


def test_a_task_is_seen_though_its_features_are_the_same_in_all_of_its_batch(random):
    """Other features change the outputs in a batch: a mean over it would have taken them away before the layers."""
    network = Network(BatchNorm().body((8, 8), layer_norm=False))
    obs = jnp.float32(random.normal(size=(6, 3)))
    params = of_task(network.init(KEY, 1, 1, jnp.zeros(2), obs[0]), 0)
    one, two = (network.fit(params, jnp.float32(z), obs)[0] for z in ([1.0, 0.0], [0.0, 1.0]))
    assert np.abs((one - one.mean()) - (two - two.mean())).max() > 1e-2


def test_both_ends_are_normalised_together():
    """Outputs at the first end depend on the second, and each critic has its own statistics."""
    made, state, _ = started()
    batch = probes.prepare(made, state, random_batch(0, 3, BATCH, SPEC), TASKS)
    batch = pick(batch._replace(mask=None, model_targets=None), 0)
    nets = of_task(state.nets, 0)
    ends = quick(made.q_of_both, nets, batch, batch.action)
    now, later, found = ends(nets, batch, batch.action)
    assert now.shape == later.shape == (2, BATCH, 101) and found[STATISTICS]["BatchNorm_1"]["mean"].shape == (2, 16)
    moved, _, _ = ends(nets, batch._replace(next_obs=batch.next_obs + 1), batch.action)
    assert np.abs(now - moved).max() > 1e-3
    first, second = found[STATISTICS]["BatchNorm_1"]["var"]
    assert np.abs(first - second).max() > 1e-4


@pytest.mark.parametrize("name", ["sac", "ppo", "distral"])
def test_agents_that_keep_no_statistics_are_refused(name):
    """Their networks would never be normalised when they act."""
    with pytest.raises(InputError, match="batch-norm needs an agent that keeps running statistics, such as xqc"):
        agent(name, encoder="batch-norm")


@pytest.mark.slow
def test_another_body_has_no_statistics():
    """And learns as in any agent."""
    _, state, update = started(encoder="simba")
    after, metrics = update(state, random_batch(0, 3, BATCH, SPEC), TASKS, KEY)
    assert STATISTICS not in after.nets["critic"].own and all(np.all(np.isfinite(x)) for x in metrics.values())
