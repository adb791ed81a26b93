"""DeepMDP and HiP-BMDP under SAC and PPO: their losses in NumPy, which parameters each moves, what they learn."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from probes import (
    QUICK,
    Probe,
    assessed,
    learner,
    of_task,
    one_in,
    only_seed,
    pick,
    random_batch,
    random_past,
    slow_but,
    tasks_of,
    tiny,
    train,
    with_nets,
)
from probes import act as act_once
from probes import values as values_of

from mtjax import agents
from mtjax.agents import replay_batches
from mtjax.agents.base import Memory
from mtjax.agents.fit import learned
from mtjax.agents.networks import Params
from mtjax.agents.parts.gradients.balancing import FAMO
from mtjax.agents.parts.knowing.last_steps import Past, Seen, append
from mtjax.agents.parts.policies import Taken
from mtjax.agents.parts.representations.deepmdp import ModelTargets
from mtjax.agents.replay_batches import Batch, slow_copies
from mtjax.agents.unseen_tasks import describe_unseen
from mtjax.experience.rollouts import windows
from mtjax.types import InputError, Spec, Transition

SPEC, BATCH = Spec.vector(3, 2, 1), 4
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(2)
SMALL = {"latent_widths": (8, 6), "model_widths": (8,)}
INFERRED = {"unseen_theta": "inferred", "theta_from": 2}
OF_CRITICS = ("critic", "representation", "knowing")
jit = partial(jax.jit, compiler_options=QUICK)


def make(name, **settings):
    theta = {"theta_size": 4} if "hip-bmdp" in (name, settings.get("representation")) else {}
    return tiny(name, **{**SMALL, **theta, **settings})


def of_critics(nets):
    """Those networks that learn from the critics' loss."""
    return {name: nets[name] for name in OF_CRITICS}


def start(agent):
    """A fresh state, a batch and the compiled update."""
    init, update = learner(agent, TASKS, BATCH, SPEC)
    return init(TASKS, KEY), random_batch(0, 3, BATCH, SPEC, agent.view.history), update


def random_params(agent, task=0):
    """Actor, critics and what they stand on, of one task, all random, so that no bias is zero."""
    state = jax.eval_shape(lambda: agent.init(SPEC, TASKS, KEY))
    random = np.random.default_rng(4)
    draw = lambda tree: jax.tree.map(lambda x: jnp.float32(random.normal(size=x.shape)), tree)
    return {name: of_task(draw(state.nets[name]), task) for name in ("actor", *OF_CRITICS)}


def one_task(agent):
    """A batch of one task, as the losses see it, and what they fit, which is random: of the models, and of critics."""
    batch, random = pick(random_batch(1, 3, BATCH, SPEC, agent.view.history), 1), np.random.default_rng(6)
    past = batch.memory.past if agent.view.history else None
    next_past = append(past, batch.obs, batch.action, batch.reward) if agent.view.history else None
    see = lambda obs, past: agent.view.see(Params({}, {}), obs, past)
    normal = lambda *shape: jnp.float32(random.normal(size=shape))
    width = len(agent.conditioning.task_vector(jnp.int32(0), pick(TASKS, 0), 3, None))
    drawn = agent.representation.transition == "probabilistic"
    value = normal(BATCH)
    other_theta = normal(agent.representation.theta_size) if agent.representation.embeds else None
    model_targets = ModelTargets(normal(BATCH, 6), normal(BATCH, 6) if drawn else jnp.float32(0), other_theta)
    seen = Batch(
        obs=see(batch.obs, past),
        action=batch.action,
        reward=batch.reward,
        discount=agent.gamma * batch.discount,
        next_obs=see(batch.next_obs, next_past),
        features=normal(width),
        temperature=jnp.float32(0.1),
        mask=None,
        model_targets=model_targets,
    )
    return seen, value


# Plain NumPy: networks from their parameters.


def dense(params, x):
    return x @ np.asarray(params["kernel"]) + np.asarray(params["bias"])


def norm(params, x):
    x = (x - x.mean(axis=-1, keepdims=True)) / np.sqrt(x.var(axis=-1, keepdims=True) + 1e-6)
    return x * np.asarray(params["scale"]) + np.asarray(params["bias"])


def plain_latent(params, obs):
    params = params["params"]
    hidden = np.maximum(dense(params["MLP_0"]["Dense_0"], obs), 0)
    return np.tanh(norm(params["LayerNorm_0"], dense(params["Dense_0"], hidden)))


def plain_model(params, *inputs):
    params = params["params"]
    inner = params["Trunk_0"]["MLP_0"]
    x = np.concatenate([np.broadcast_to(x, (BATCH, x.shape[-1])) for x in inputs], axis=-1)
    return dense(params["Dense_0"], np.maximum(norm(inner["LayerNorm_0"], dense(inner["Dense_0"], x)), 0))


def plain_transition(agent, params, features, batch):
    """Mean and deviation of the next latent state."""
    latent = plain_latent(params.shared["latent"], np.asarray(batch.obs))
    outputs = plain_model(params.shared["transition"], latent, np.asarray(batch.action), features)
    if agent.representation.transition == "deterministic":
        return outputs, np.ones_like(outputs)
    mean, raw = np.split(outputs, 2, axis=-1)
    return mean, 0.01 + 0.99 / (1 + np.exp(-raw))


@pytest.mark.parametrize("transition", ["deterministic", "probabilistic"])
@pytest.mark.parametrize("name", ["deepmdp", "hip-bmdp"])
def test_model_losses(name, transition):
    """The likelihood of the target encoder's next state, and the reward predicted from the state that is drawn."""
    agent = make(name, transition=transition)
    nets = random_params(agent)
    params = nets["representation"]
    batch, value = one_task(agent)
    model_targets = batch.model_targets
    features = np.asarray(params.own["embedding"] if name == "hip-bmdp" else batch.features)
    mean, deviation = plain_transition(agent, params, features, batch)
    likelihood = 0.5 * ((mean - model_targets.latent) / deviation) ** 2 + np.log(deviation)
    reward = plain_model(params.shared["reward"], mean + deviation * np.asarray(model_targets.noise), features)[:, 0]
    _, (metrics, *_) = jit(agent.critic_loss)(nets, batch, value)
    np.testing.assert_allclose(metrics["transition_loss"], likelihood.mean(), rtol=1e-4)
    np.testing.assert_allclose(metrics["reward_loss"], np.mean((reward - batch.reward) ** 2), rtol=1e-4)


@pytest.mark.parametrize("transition", ["deterministic", "probabilistic"])
@pytest.mark.parametrize("name", ["deepmdp", "hip-bmdp"])
def test_no_loss_is_less_than_the_least(name, transition, monkeypatch):
    """Where the next state is predicted exactly, and as surely as can be, what is left is the other losses'."""
    without_theta = {"theta_coefficient": 0.0} if name == "hip-bmdp" else {}
    agent = make(name, transition=transition, model_coefficient=0.5, **without_theta)
    deviation = 0.01 if transition == "probabilistic" else 1.0
    exact = lambda self, params, features, latent, a: (jnp.full_like(latent, 0.3), jnp.full_like(latent, deviation))
    monkeypatch.setattr(type(agent.representation.dynamics), "predict", exact)
    batch, value = one_task(agent)
    model_targets = batch.model_targets._replace(latent=jnp.full_like(batch.model_targets.latent, 0.3))
    loss, (found, *_) = agent.critic_loss(random_params(agent), batch._replace(model_targets=model_targets), value)
    least = agent.representation.least_loss
    np.testing.assert_allclose(loss - least, found["critic_loss"] + 0.5 * found["reward_loss"], rtol=1e-4)


def test_networks_on_plain_observations_add_nothing_to_the_least():
    """In SAC as in PPO."""
    assert tiny("sac").representation.least_loss == tiny("ppo").representation.least_loss == 0


@pytest.mark.slow
@pytest.mark.parametrize("transition", slow_but(["deterministic", "probabilistic"], "probabilistic"))
@pytest.mark.parametrize("name", slow_but(["sac", "ppo"], "sac"))
def test_rules_see_losses_from_the_least(name, transition, monkeypatch):
    """What FAMO is given in an update of either agent, and that it sees the losses fall from there."""
    weigh = lambda self, memory, gram, losses, key: (jnp.ones(3) / 3, memory._replace(logits=losses))
    adapt = lambda self, memory, before, after: memory._replace(
        logits=jnp.where((before == memory.logits) & (after > 0) & (after != before), before, jnp.nan)
    )
    monkeypatch.setattr(FAMO, "weigh", weigh)
    monkeypatch.setattr(FAMO, "adapt", adapt)
    settings = {"representation": "deepmdp", "transition": transition, "model_coefficient": 0.5, "gradients": "famo"}
    agent = make_ppo(**settings) if name == "ppo" else make(name, **settings)
    batch = rollouts(agent) if name == "ppo" else random_batch(0, 3, BATCH, SPEC, agent.view.history)
    take = probes.learn if name == "ppo" else probes.update
    state, found = jit(partial(take, agent))(agent.init(SPEC, TASKS, KEY), batch, TASKS, KEY)
    surest = np.log(0.01) if transition == "probabilistic" else 0.0
    expected = found["critic_loss"] + 0.5 * (found["transition_loss"] + found["reward_loss"]) - 0.5 * surest
    np.testing.assert_allclose(state.fits["critic"].rule.logits, expected, rtol=1e-4)


def test_the_losses_add_up():
    """Critics' loss, both models' by their coefficient, and theta's and the guess's."""
    agent = make("hip-bmdp", model_coefficient=0.5, theta_coefficient=0.3, **INFERRED)
    loss, (found, *_) = jit(agent.critic_loss)(random_params(agent), *one_task(agent))
    models = 0.5 * (found["transition_loss"] + found["reward_loss"])
    expected = found["critic_loss"] + models + 0.3 * found["theta_loss"] + found["guess_loss"]
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


@pytest.mark.parametrize("unit, length", [(False, 5), (True, 1)])
def test_vectors_of_tasks_have_length_one_if_the_agent_says_so(unit, length):
    """One of length 0 stays as it is."""
    theta_of = make("hip-bmdp", unit_theta=unit).representation.theta
    found = [theta_of(Params({}, {"embedding": jnp.array(theta)})) for theta in ([3.0, 0.0, 4.0], [0.0] * 3)]
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), (length, 0), rtol=1e-6)


@pytest.mark.parametrize("transition", ["deterministic", "probabilistic"])
def test_theta_loss(transition):
    """Per sample: the distance of two vectors against that of the two predictions, in mean and deviation."""
    agent = make("hip-bmdp", transition=transition)
    params = random_params(agent)["representation"]
    batch, _ = one_task(agent)
    theta, other_theta = np.asarray(params.own["embedding"]), np.asarray(batch.model_targets.other_theta)
    ours, theirs = (np.stack(plain_transition(agent, params, x, batch)) for x in (theta, other_theta))
    moved = np.sqrt(((ours - theirs) ** 2).sum(axis=(0, 2)))
    loss = jit(agent.representation.theta_loss)(params, batch.features, batch.obs, batch.action, other_theta)
    np.testing.assert_allclose(loss, (np.linalg.norm(theta - other_theta) - moved) ** 2, rtol=1e-4)


def test_theta_loss_of_three_tasks_by_hand(monkeypatch):
    """Thetas 3, 4 and 5 apart, and a state s that moves predictions by s theta: (d - |s| d)^2 for each sample."""
    representation = make("hip-bmdp", theta_size=2).representation
    predict = lambda self, p, features, latent, a: (latent * features, 0 * latent * features)
    monkeypatch.setattr(type(representation.dynamics), "predict", predict)
    monkeypatch.setattr(type(representation), "perceive", lambda self, p, features, obs: (p.own["embedding"], obs))
    thetas = np.array([[0, 0], [3, 0], [3, 4]], np.float32)
    obs = jnp.float32([[0.0], [1.0], [-3.0]])
    for i, j, apart in ((0, 1, 3), (1, 2, 4), (2, 0, 5), (0, 0, 0)):
        params = Params({}, {"embedding": jnp.asarray(thetas[i])})
        loss = representation.theta_loss(params, jnp.zeros(0), obs, jnp.zeros((3, 1)), jnp.asarray(thetas[j]))
        np.testing.assert_allclose(loss, np.square([apart, 0.0, 2 * apart]), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_a_rival_is_always_another_task():
    """Over many keys every other task has its turn; one that is alone is its own, and learns nothing of it."""
    agent = make("hip-bmdp")
    state, batch, _ = start(agent)
    seen = probes.prepare(agent, state, batch, TASKS)
    rivals = jit(lambda key: replay_batches.critic_data(agent, state, seen, key)[0].model_targets.other_theta)
    thetas, turns = np.asarray(state.nets["representation"].own["embedding"]), set()
    for seed in range(12):
        found = np.asarray(rivals(jax.random.key(seed)))
        turns.add(tuple(int(np.flatnonzero((thetas == x).all(axis=1))[0]) for x in found))
    assert turns == {(1, 2, 0), (2, 0, 1)}

    first = lambda tree: jax.tree.map(lambda x: x[:1], tree)
    alone = lambda nets: {name: Params(net.shared, first(net.own)) for name, net in nets.items()}
    state = state._replace(nets=alone(state.nets), slow=alone(state.slow))
    data = pick(replay_batches.critic_data(agent, state, first(seen), KEY), 0)
    theta_loss = lambda nets: agent.critic_loss(nets, *data)[1].metrics["theta_loss"]
    value, slope = jit(jax.value_and_grad(theta_loss))(of_critics(of_task(state.nets, 0)))
    np.testing.assert_allclose(value, 0, atol=1e-10)
    assert not any(np.any(x) for x in jax.tree.leaves(slope))


# Which loss reaches which parameters.

BASE = {"latent", "embedding"}
REACHES = {
    "critic_loss": BASE | {"body", "head"},
    "transition_loss": BASE | {"transition"},
    "reward_loss": BASE | {"transition", "reward"},
    "theta_loss": {"embedding"},
    "guess_loss": {"guess"},
}


def reached(slopes):
    """Parts of networks of which some leaf has a slope."""
    parts = [part for net in slopes.values() for part in (*net.shared.items(), *net.own.items())]
    return {name for name, part in parts if any(np.any(x) for x in jax.tree.leaves(part))}


@pytest.mark.slow
def test_each_loss_reaches_its_own_parameters_alone():
    """Encoder and theta learn from critics and models, theta alone from its loss, and the guess by itself."""
    agent = make("hip-bmdp", transition="probabilistic", **INFERRED)
    nets, data = of_critics(random_params(agent)), one_task(agent)
    metrics = lambda nets: agent.critic_loss(nets, *data)[1].metrics
    jacobian = jit(jax.jacrev(lambda nets: {k: metrics(nets)[k] for k in REACHES}))(nets)
    for loss, expected in REACHES.items():
        assert reached(jacobian[loss]) == expected, loss


def test_what_is_detached_stays():
    """The next state, the rival's theta, and whatever the actor stands on."""
    agent = make("hip-bmdp", transition="probabilistic", **INFERRED)
    nets = random_params(agent)
    batch, value = one_task(agent)
    model_targets = batch.model_targets
    model = lambda x: agent.critic_loss(nets, batch._replace(model_targets=model_targets._replace(**x)), value)[0]
    slopes = jit(jax.grad(model))({"latent": model_targets.latent, "other_theta": model_targets.other_theta})
    assert not any(np.any(x) for x in jax.tree.leaves(slopes))
    acted = lambda nets, batch: (jnp.sum(agent.policy_outputs(nets, batch.features, batch.obs) ** 2), None)
    loss, params, data = agent.fits["actor"].problem(acted, nets, (batch,))
    slopes, _ = jit(jax.grad(loss, has_aux=True))(params, data)
    assert set(slopes.shared) == set(slopes.own) == {"actor"}
    assert reached({"actor": Params(slopes.shared["actor"], slopes.own["actor"])}) == {"body", "head"}


@pytest.mark.slow
def test_the_actor_does_not_move_the_critics_parameters():
    """With discount 0 another actor and other temperatures leave critics, encoder, models and theta bit for bit."""
    state, batch, update = start(make("hip-bmdp"))
    batch = batch._replace(discount=jnp.zeros((3, BATCH)))
    actor = jax.tree.map(lambda x: x * 1.5 + 0.05, state.nets["actor"])
    other = with_nets(state, actor=actor, temperature=Params({}, {"log": jnp.ones(3)}))
    plain, moved = (of_critics(update(x, batch, TASKS, KEY)[0].nets) for x in (state, other))
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(moved), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("deepmdp", {}),
        ("deepmdp", {"conditioning": "inferred", "inferred_from": 2}),
        ("hip-bmdp", {"transition": "probabilistic", **INFERRED}),
        ("hip-bmdp", {"heads": "disjoint", "value": "c51"}),
    ],
)
def test_everything_that_should_learn_does(name, settings):
    """After ten updates no leaf is where it began, nor any task's part of it, and shapes are as they were."""
    agent = make(name, **settings)
    before, _, update = start(agent)
    after = before
    for i in range(10):
        after, metrics = update(after, random_batch(i, 3, BATCH, SPEC, agent.view.history), TASKS, jax.random.key(i))
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, before)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((after, metrics)))
    trained = learned(agent.fits.values())
    assert {"actor", *OF_CRITICS} <= set(trained) and set(after.slow) == set(OF_CRITICS)
    networks = lambda state: ({name: state.nets[name] for name in trained}, state.slow)
    old, new = (jax.tree_util.tree_leaves_with_path(networks(x)) for x in (before, after))
    for (path, a), (_, b) in zip(old, new, strict=True):
        rows = range(3) if path[2].name == "own" else (slice(None),)
        for i in rows:
            assert not np.array_equal(a[i], b[i]), f"{jax.tree_util.keystr(path)} stayed"


@pytest.mark.slow
def test_the_slow_encoder_follows_at_its_own_rate():
    """And so does theta; body and head take ``tau``. Models have no slow copy."""
    agent = make("hip-bmdp")
    state, batch, update = start(agent)
    moved = state._replace(slow=jax.tree.map(lambda x: x * 1.5 + 0.05, state.slow))
    after, _ = update(moved, batch, TASKS, KEY)
    of_critic, of_representation = after.slow["critic"], after.slow["representation"]
    assert set(of_critic.shared) == {"body", "head"} and not of_critic.own
    assert set(of_representation.shared) == {"latent"} and set(of_representation.own) == {"embedding"}
    assert set(after.slow) == set(OF_CRITICS) and not after.slow["knowing"].parts
    for name, rate in (("critic", 0.005), ("representation", 0.05)):
        for part, found in after.slow[name].parts.items():
            old, new = moved.slow[name].parts[part], after.nets[name].parts[part]
            mixed = jax.tree.map(lambda a, b, rate=rate: (1 - rate) * a + rate * b, old, new)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), found, mixed)


def test_the_target_is_the_slow_encoders():
    """Next latent states come from the slow copy; the slow critics stand on it, too."""
    agent = make("deepmdp")
    nets = random_params(agent)
    batch, _ = one_task(agent)
    slow = jax.tree.map(lambda x: x * 1.5 + 0.05, slow_copies(agent, nets | {"knowing": Params({}, {})}))
    assert set(slow["critic"].shared) == {"body", "head"} and set(slow["representation"].shared) == {"latent"}
    every = lambda tree: jax.tree.map(lambda x: x[None], tree)  # one task is all
    of_all = lambda params: params._replace(own=every(params.own))
    model_targets, _ = jit(agent.representation.targets)(
        of_all(nets["representation"]), of_all(slow["representation"]), every(batch.next_obs), KEY
    )
    expected = plain_latent(slow["representation"].shared["latent"], np.asarray(batch.next_obs))
    np.testing.assert_allclose(model_targets.latent[0], expected, rtol=1e-4, atol=1e-5)
    features, latent = agent.representation.perceive(slow["representation"], batch.features, batch.obs)
    plain = jax.vmap(agent.critic.apply, (0, None, None, None))(slow["critic"], features, latent, batch.action)
    np.testing.assert_allclose(agent.values(slow, batch.features, batch.obs, batch.action), plain[..., 0], rtol=1e-5)


# Tasks that were not trained on.

STRANGER = pick(tasks_of("one-step", [0.2]), 0)._replace(id=jnp.int32(7))


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["nearest", "zero", "mean"])
def test_theta_of_an_unseen_task(strategy):
    """It acts as a training task that had that theta would; training tasks keep their own."""
    agent, plain = make("hip-bmdp", unseen_theta=strategy), make("hip-bmdp")
    state, _, _ = start(plain)
    params, obs = state.nets["representation"], jnp.ones(3)
    thetas = params.own["embedding"]
    act = jit(lambda state, task: act_once(agent, state, obs, task, None))
    stand_in = {"nearest": thetas[2], "zero": jnp.zeros(4), "mean": np.mean(thetas, axis=0)}[strategy]
    given = with_nets(state, representation=params._replace(own={"embedding": thetas.at[0].set(stand_in)}))
    np.testing.assert_allclose(act(state, STRANGER), act(given, pick(TASKS, 0)), atol=1e-6)
    for i in range(3):
        expected = act_once(plain, state, obs, pick(TASKS, i), None)
        np.testing.assert_allclose(act(state, pick(TASKS, i)), expected, atol=1e-6)
    assert make("hip-bmdp").representation.unseen_theta == "mean"  # the others' parameters are hidden
    assert (
        describe_unseen(agent)
        == {
            "nearest": "each uses the theta of the nearest training task",
            "zero": "each has zeros for theta",
            "mean": "each has the mean of the training tasks' thetas",
        }[strategy]
    )


@pytest.mark.slow
def test_theta_of_an_unseen_task_is_inferred_from_its_last_steps():
    """The guess takes theta's place there, follows the steps, and leaves training tasks alone."""
    agent = make("hip-bmdp", **INFERRED)
    state, batch, _ = start(agent)
    act = jit(lambda state, past, task: act_once(agent, state, batch.obs[0, 0], task, None, past))
    past = pick(batch.memory.past, (0, 0))
    params = state.nets["representation"]
    guess = agent.representation.apply(params, "guess", agent.view.see(state.nets["inputs"], batch.obs[0, 0], past))
    thetas = params.own["embedding"]
    given = with_nets(state, representation=params._replace(own={"embedding": thetas.at[0].set(guess)}))
    np.testing.assert_allclose(act(state, past, STRANGER), act(given, past, pick(TASKS, 0)), atol=1e-6)
    other = past._replace(reward=past.reward + 1.0)
    assert not np.allclose(act(state, past, STRANGER), act(state, other, STRANGER))
    np.testing.assert_array_equal(act(state, past, pick(TASKS, 0)), act(state, other, pick(TASKS, 0)))
    assert describe_unseen(agent) == "each has a theta inferred from its last steps"


@pytest.mark.nightly
def test_the_guess_finds_the_theta_of_the_task_that_steps_were_taken_in():
    """Rewards of a step tell the task; after training each task's guess is near its own theta."""
    agent = make("hip-bmdp", critic_lr=1e-2, **INFERRED)
    given = {"num_envs": 4, "updates_per_step": 2, "batch_size": 16, "replay_size": 2000, "warmup_steps": 20}
    env = Probe("endless", episode_length=4)
    state, history = train(env, agent, given | {"warmup_hold": 1, "chunk_steps": 300})
    assert history[0]["guess_loss"].shape == (1, 2)
    params = only_seed(state.agent).nets["representation"]
    thetas = params.own["embedding"]
    reward = jnp.float32([1.0, -0.5])[:, None]  # of a step taken from 1, which comes second
    ones = jnp.ones((2, 2))
    past = Past(jnp.float32([[[0.0], [1.0]]] * 2), jnp.zeros((2, 2, 1)), jnp.concatenate([0 * reward, reward], 1), ones)
    guess = agent.representation.apply(params, "guess", Seen(jnp.ones((2, 1)), past))
    distances = np.linalg.norm(guess[:, None] - thetas, axis=-1)
    assert np.all(np.diagonal(distances) < 0.3 * np.linalg.norm(thetas[0] - thetas[1]))


# Learning.


@pytest.mark.slow
def test_the_transition_model_learns_linear_dynamics():
    """s' = M s + N a in another way for each task: the error of the prediction all but vanishes."""
    agent = make("hip-bmdp", latent_widths=(32, 8), model_widths=(64,), critic_lr=3e-3, gamma=0.0)
    turn = jnp.float32([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.0], [0.0, 0.0, 0.5]])
    push = jnp.float32([1.0, -1.0, 0.2])[:, None, None] * jnp.float32([[0.5, 0.0, 0.0], [0.0, 0.5, 0.5]])

    def experience(key):
        obs_key, action_key = jax.random.split(key)
        obs = jax.random.normal(obs_key, (3, 32, 3))
        action = jax.random.uniform(action_key, (3, 32, 2), minval=-1.0)
        then = obs @ turn + action @ push
        return random_batch(0, 3, 32, SPEC)._replace(obs=obs, action=action, next_obs=then, reward=then[..., 0])

    def learn(state, key):
        return probes.update(agent, state, experience(key), TASKS, key)

    state = agent.init(SPEC, TASKS, KEY)
    state, history = jit(lambda state: jax.lax.scan(learn, state, jax.random.split(KEY, 1500)))(state)
    first, last = (np.mean(history["transition_loss"][part], axis=0) for part in (slice(0, 5), slice(-50, None)))
    assert np.all(last < 0.02 * first), (first, last)
    assert np.all(np.mean(history["reward_loss"][-50:], axis=0) < 0.02)

    def predicted(params: Params, batch):
        """The next latent states of one task, as predicted and as they are."""
        features = params.own["embedding"]
        latent, then = (agent.representation.apply(params, "latent", x) for x in (batch.obs, batch.next_obs))
        return agent.representation.dynamics.predict(params, features, latent, batch.action)[0], then

    fresh = experience(jax.random.key(9))
    mean, then = jit(jax.vmap(predicted, (Params(None, 0), 0)))(state.nets["representation"], fresh)
    error, spread = np.mean((mean - then) ** 2, axis=(1, 2)), np.mean(np.var(then, axis=1), axis=-1)
    # Not because all states look alike. Bounds are half as far again as the worst of three seeds, or further.
    assert np.all(spread > 0.01) and np.all(error < 0.2 * spread), (error, spread)


@pytest.mark.nightly
def test_values_are_learned_through_the_slow_encoder():
    """Two steps of which the last earns the scale: Q(1) = scale and Q(0) = gamma scale, whatever the action."""
    rates = {"tau": 0.3, "encoder_tau": 0.3, "actor_lr": 1e-2, "critic_lr": 1e-2}
    agent = make("hip-bmdp", gamma=0.9, initial_temperature=1e-6, temperature_lr=1e-9, **rates)
    tasks = tasks_of("delayed", (0.7, -0.5))
    given = {"num_envs": 8, "updates_per_step": 4, "batch_size": 32, "replay_size": 8000, "warmup_steps": 150}
    state, _ = train(Probe("delayed"), agent, given | {"warmup_hold": 1, "chunk_steps": 300}, tasks=tasks)
    obs, action = np.repeat([0.0, 1.0], 3), np.tile([-0.8, 0.0, 0.8], 2)
    for found, scale in zip(values_of(agent, only_seed(state.agent), tasks, obs, action), (0.7, -0.5), strict=True):
        np.testing.assert_allclose(found, [scale * np.where(obs > 0.5, 1, 0.9)] * 2, atol=0.08)


# Combinations.


@pytest.mark.parametrize(
    "settings",
    one_in(
        4,
        [
            *({"conditioning": conditioning} for conditioning in ("one-hot", "embedding", "parameters", "inferred")),
            {"conditioning": "embedding", "unit_embedding": True, "unit_theta": True, "unseen_theta": "zero"},
            {"conditioning": "inferred", "inferred_from": 2, **INFERRED},
            {"encoder": "care"},
            {"value": "hl-gauss"},
            {"heads": "per-task", "gradients": "pcgrad", "gradient_scope": "per-layer"},
            {"heads": "disjoint", "transition": "probabilistic"},
        ],
    ),
    ids=lambda x: "-".join(map(str, x.values())),
)
@pytest.mark.parametrize("name", slow_but(["deepmdp", "hip-bmdp"], "hip-bmdp"))
def test_parts_combine(name, settings):
    """Traced over two seeds, not run: an update keeps shapes and types, and there is an action for each world."""
    settings = {k: v for k, v in settings.items() if name == "hip-bmdp" or "theta" not in k}
    agent, keys = make(name, **settings), jax.random.split(KEY, 2)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), random_batch(0, 3, BATCH, SPEC, agent.view.history))
    state = jax.eval_shape(jax.vmap(lambda key: agent.init(SPEC, TASKS, key)), keys)
    update = jax.vmap(lambda state, batch, key: probes.update(agent, state, batch, TASKS, key))
    after, metrics = jax.eval_shape(update, state, batch, keys)
    types = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)
    assert types(after) == types(state)
    assert all(metrics[k].shape == (2, 3) for k in ("critic_loss", "transition_loss", "reward_loss", "actor_loss"))
    act = jax.vmap(lambda state, obs: act_once(agent, state, obs, STRANGER, None))
    assert jax.eval_shape(act, state, batch.obs[:, 0, 0]).shape == (2, 2)


def test_the_agents_are_sac_with_that_part():
    """And another representation in its place leaves SAC as it is."""
    assert agents.agent("deepmdp") == agents.agent("sac-conditioned", representation="deepmdp")
    assert agents.agent("deepmdp", representation="plain") == agents.agent("sac-conditioned")
    assert agents.agent("hip-bmdp") == agents.agent("sac", representation="hip-bmdp", theta_size=50)


@pytest.mark.parametrize("representation", slow_but(["deepmdp", "hip-bmdp"], "deepmdp"))
@pytest.mark.parametrize(
    "name", one_in(4, ["sac", "care", "soft-modularization", "multi-head", "disjoint", "brc", "cagrad"])
)
def test_other_agents_stand_on_it(name, representation):
    """Traced, not run: actor and critics on latent states, one encoder and one of each model beside them."""
    agent, batch = make(name, representation=representation), random_batch(0, 3, BATCH, SPEC)
    state = jax.eval_shape(lambda: agent.init(SPEC, TASKS, KEY))
    after, metrics = jax.eval_shape(lambda state: probes.update(agent, state, batch, TASKS, KEY), state)
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)
    assert metrics["transition_loss"].shape == metrics["reward_loss"].shape == (3,)
    place = "own" if name == "disjoint" else "shared"
    for nets, there in ((state.nets, {"latent", "transition", "reward"}), (state.slow, {"latent"})):
        assert {"latent", "transition", "reward"} & set(getattr(nets["representation"], place)) == there
        assert not {*agent.representation.slow, *agent.representation.models} & {*nets["critic"].parts}
    assert not {*agent.representation.slow, *agent.representation.models} & {*state.nets["actor"].parts}
    assert jax.eval_shape(lambda s: act_once(agent, s, jnp.ones(3), STRANGER, None), state).shape == (2,)


# PPO, which has neither replay nor slow copies.


def make_ppo(**settings):
    return make("ppo", unroll=4, epochs=1, minibatches=1, normalize_observations=False, **settings)


def rollouts(agent, seed=0):
    """Rollouts (T, H, E, ...) in which every field is random."""
    random, shape = np.random.default_rng(seed), (3, 4, 2)
    normal = lambda *size: jnp.float32(random.normal(size=(*shape, *size)))
    past = random_past(random, (*shape, agent.view.history), SPEC) if agent.view.history else None
    raw, ended = normal(2), jnp.asarray(random.random(shape) < 0.5)
    fields = {"reward": normal(), "discount": jnp.ones(shape), "ended": ended, "closed": ended, "cut": ended}
    fields |= {"extras": Taken(raw, normal() - 2), "memory": Memory(past)}
    return Transition(obs=normal(3), action=jnp.tanh(raw), next_obs=normal(3), **fields)


def of_first_task(agent, state, steps):
    """What the critic's loss of the first task trains, and its steps as the losses see them."""
    _, batch, _ = assessed(agent, state, steps, TASKS)
    params = state.nets["representation"]
    model_targets, _ = agent.representation.targets(params, params, batch.next_obs, KEY)
    return of_critics(of_task(state.nets, 0)), pick(batch._replace(model_targets=model_targets), 0)


@pytest.mark.slow
def test_ppos_critic_loss_reaches_the_representation():
    """Each loss its own part of it; the critic's own is joined by all."""
    agent = make_ppo(representation="hip-bmdp", transition="probabilistic", **INFERRED)
    state = agent.init(SPEC, TASKS, KEY)
    draw = lambda x: x + 0.1 * jnp.float32(np.random.default_rng(4).normal(size=x.shape))  # heads begin near zero
    state = with_nets(state, **jax.tree.map(draw, of_critics(state.nets)))
    nets, batch = of_first_task(agent, state, rollouts(agent))
    jacobian = jit(jax.jacrev(lambda nets: {k: agent.critic_loss(nets, batch)[1][k] for k in REACHES}))(nets)
    for loss, expected in REACHES.items():
        assert reached(jacobian[loss]) == expected, loss
    whole = jit(jax.grad(lambda nets: agent.critic_loss(nets, batch)[0]))(nets)
    assert reached(whole) == set.union(*REACHES.values())
    loss, found = jit(agent.critic_loss)(nets, batch)
    models = found["transition_loss"] + found["reward_loss"]
    expected = found["critic_loss"] + models + 0.01 * found["theta_loss"] + found["guess_loss"]
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


@pytest.mark.slow
def test_ppos_actor_does_not_train_the_representation():
    """Another cost of entropy and another actor leave critic, encoder, models and thetas bit for bit."""
    agents_of = [make_ppo(representation="hip-bmdp", entropy_cost=cost) for cost in (0.0, 1.0)]
    steps = rollouts(agents_of[0])
    state = agents_of[0].init(SPEC, TASKS, KEY)
    other = with_nets(state, actor=jax.tree.map(lambda x: x * 1.5 + 0.05, state.nets["actor"]))
    plain, *moved = (
        jit(partial(probes.learn, agent))(start, steps, TASKS, KEY)[0].nets
        for agent, start in ((agents_of[0], state), (agents_of[1], state), (agents_of[0], other))
    )
    for after in moved:
        for a, b in zip(jax.tree.leaves(of_critics(plain)), jax.tree.leaves(of_critics(after)), strict=True):
            np.testing.assert_array_equal(a, b)
        actors = {"actor": plain["actor"]}, {"actor": after["actor"]}
        assert reached(jax.tree.map(jnp.subtract, *actors)) == {"body", "head"}
    # And what the actor does depends on it: the same actor on another encoder acts otherwise.
    blind = with_nets(state, representation=jax.tree.map(lambda x: x * 1.5 + 0.05, state.nets["representation"]))
    seeing, other = (act_once(agents_of[0], x, jnp.ones(3), pick(TASKS, 0), None) for x in (state, blind))
    assert not np.array_equal(seeing, other)


@pytest.mark.slow
def test_ppos_models_predict_what_the_encoder_saw_before_the_update():
    """The critic's targets do not change with it, the transition loss does."""
    agent = make_ppo(representation="deepmdp")
    state = agent.init(SPEC, TASKS, KEY)
    state, _, steps = assessed(agent, state, rollouts(agent), TASKS)
    window, params = windows(steps, 0), state.nets["representation"]
    before = lambda slow: state._replace(slow={"representation": slow})
    step = jit(lambda slow: agent.update(before(slow), window, TASKS, KEY, jnp.int32(0))[1])
    now, other = step(params), step(jax.tree.map(lambda x: x * 1.5 + 0.05, params))
    np.testing.assert_array_equal(now["critic_loss"], other["critic_loss"])
    assert np.all(np.asarray(now["transition_loss"]) != np.asarray(other["transition_loss"]))
    nets, one = of_first_task(agent, state, rollouts(agent))
    expected = plain_latent(nets["representation"].shared["latent"], np.asarray(one.next_obs))
    np.testing.assert_allclose(one.model_targets.latent, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_ppo_learns_a_model_of_its_rollouts():
    """Everything moves, and after many updates models predict s' = s / 2 + (a, 0) and its first number far better."""
    agent = make_ppo(representation="deepmdp", critic_lr=1e-2, gamma=0.0)
    before, steps = agent.init(SPEC, TASKS, KEY), rollouts(agent)
    then = 0.5 * steps.obs + jnp.pad(steps.action, [(0, 0)] * 3 + [(0, 1)])
    steps = steps._replace(next_obs=then, reward=then[..., 0])
    learn = lambda state, key: probes.learn(agent, state, steps, TASKS, key)
    after, history = jit(lambda state: jax.lax.scan(learn, state, jax.random.split(KEY, 300)))(before)
    moved = jax.tree.map(jnp.subtract, of_critics(after.nets), of_critics(before.nets))
    assert reached(moved) == {"body", "head", "latent", "transition", "reward"}
    for name in ("transition_loss", "reward_loss"):
        assert np.all(history[name][-1] < 0.2 * history[name][0]), (name, history[name][-1] / history[name][0])


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("distral", {"representation": "deepmdp"}, "all tasks share; use representation=plain"),
        ("sac", {"representation": "deepmpd"}, "unknown representation 'deepmpd'; did you mean 'deepmdp'"),
        ("sac", {"latent_widths": (8,)}, "unknown setting of sac 'latent_widths'"),
        ("ppo", {"representation": "hip-bmdp", "encoder": "input-map"}, "input-map maps observations"),
        ("deepmdp", {"transition": "gaussian"}, "unknown transition 'gaussian'.*probabilistic"),
        ("deepmdp", {"latent_widths": ()}, r"latent-widths needs at least one layer .*not \(\)"),
        ("deepmdp", {"model_widths": (8, 0)}, r"model-widths .*at least one unit, not \(8, 0\)"),
        ("deepmdp", {"encoder_tau": 0.0}, r"encoder-tau must be in \(0, 1\], not 0.0"),
        ("deepmdp", {"model_coefficient": 0.0}, "model-coefficient must be greater than 0, not 0.0"),
        ("deepmdp", {"encoder": "input-map"}, "input-map maps observations"),
        ("deepmdp", {"unseen_theta": "zero"}, "unknown setting of deepmdp 'unseen_theta'"),
        ("hip-bmdp", {"unseen_theta": "mean-train"}, "unknown unseen-theta 'mean-train'; did you mean 'mean'"),
        ("hip-bmdp", {"theta_coefficient": -1.0}, "theta-coefficient must be at least 0, not -1.0"),
    ],
)
def test_settings_that_make_no_sense_are_refused(name, settings, message):
    """With what was given and what is allowed."""
    with pytest.raises(InputError, match=message):
        agents.agent(name, **settings)
