"""Diagnostics of interference: gradients, units and ranks in closed form, and the files that the program writes."""

import csv
import dataclasses
import json
import shutil
from functools import partial
from types import SimpleNamespace

import jax
import jax.flatten_util
import jax.numpy as jnp
import matplotlib.image
import numpy as np
import probes
import pytest
import test_sketches
from probes import (
    OFF_POLICY,
    QUICK,
    Walk,
    learner,
    of_task,
    one_in,
    pick,
    random_batch,
    slow_but,
    tasks_of,
    tiny,
    with_nets,
)

import mtjax
import mtjax.evaluate
from mtjax.agents import for_action
from mtjax.agents.networks import Params
from mtjax.agents.parts.encoders import ENCODERS
from mtjax.agents.state import of_task as state_of_task
from mtjax.experience.rollouts import windows
from mtjax.learning import loop
from mtjax.learning.evaluation import Scores
from mtjax.report import diagnostics, scoring
from mtjax.report import figures as plot
from mtjax.report.diagnostics import Activity, activity, compare_gradients, dormant_share, effective_ranks, utilisation
from mtjax.saved import checkpoint, log
from mtjax.saved.config_json import from_json, to_json
from mtjax.saved.policy import load_experience
from mtjax.types import Continuous, InputError, Spec

TASKS, BATCH, KEY = tasks_of("one-step", (1.0, -0.5, 0.3)), 8, jax.random.key(5)
SPEC = Spec.vector(3, 2, 1)


def started(agent):
    return jax.jit(partial(agent.init, SPEC), compiler_options=QUICK)(TASKS, jax.random.key(1))


def shapes_of(agent, spec=SPEC):
    return jax.eval_shape(partial(agent.init, spec), TASKS, KEY)


def compare(agent, state, batch, tasks=TASKS):
    measure = jax.jit(partial(compare_gradients, agent), compiler_options=QUICK)
    return jax.device_get(measure(state, probes.windows(batch), tasks, KEY))


def ended(seed=0):
    """A batch in which every step is its episode's last, so that the critics' targets are the rewards."""
    batch = random_batch(seed, 3, BATCH, SPEC)
    return batch._replace(discount=jnp.zeros_like(batch.discount))


def distance_to_reward(agent, state, batch):
    """Mean distance (T,) of all critics' estimates from the rewards."""
    distances = []
    for i in range(3):
        one, features = pick(batch, i), agent.view.features(state, pick(TASKS, i))
        estimates = agent.values(of_task(state.nets, i), features, one.obs, one.action)
        distances.append(np.mean(np.abs(estimates - one.reward)))
    return distances


# Gradients.


def gradients_by_hand(agent, state, batch):
    """Each task's gradients of critics and actor (T, P) on shared parameters or, without any, on its own."""
    keys = jax.random.split(jax.random.split(KEY)[1], 3)

    def critic_loss(critic, nets, one, features):
        estimates = agent.values(nets | {"critic": critic}, features, one.obs, one.action)
        return jnp.mean(jnp.sum((estimates - one.reward) ** 2, axis=0))

    def actor_loss(actor, nets, one, features, key):
        action, _, log_prob = agent.policy.draw(agent.actor.apply(actor, features, one.obs), None, key)
        estimates = agent.values(nets, features, one.obs, action)
        return jnp.mean(jnp.exp(nets["temperature"].own["log"]) * log_prob - jnp.min(estimates, axis=0))

    @partial(jax.jit, compiler_options=QUICK)
    def slopes(nets, one, task, key):
        features = agent.view.features(state, task)
        of_critic = jax.grad(critic_loss)(nets["critic"], nets, one, features)
        of_actor = jax.grad(actor_loss)(nets["actor"], nets, one, features, key)
        return [jax.flatten_util.ravel_pytree(slope.shared or slope.own)[0] for slope in (of_critic, of_actor)]

    rows = []
    for i in range(3):
        rows.append(slopes(of_task(state.nets, i), *pick((batch, TASKS), i), keys[i]))
    return [np.float64(np.stack(x)) for x in zip(*rows, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sac-conditioned", "multi-head", "disjoint"])
def test_gradients_are_those_of_each_task_alone(name):
    """Gram matrix, cosines, conflict and lengths of both networks; without shared parameters lengths alone."""
    agent = tiny(name, hidden=(4,))
    state, batch = started(agent), ended()
    found = compare(agent, state, batch)
    for network, gradients in zip(("critic", "actor"), gradients_by_hand(agent, state, batch), strict=True):
        lengths, x = np.linalg.norm(gradients, axis=1), found[network]
        np.testing.assert_allclose(x["gradient_norm"], lengths, rtol=1e-4)
        if name == "disjoint":
            assert (x["gram"], x["cosine"], x["conflict"]) == (None, None, None)
            continue
        gram = gradients @ gradients.T
        np.testing.assert_allclose(x["gram"], gram, rtol=1e-3, atol=1e-4 * gram.max())
        np.testing.assert_allclose(x["cosine"], gram / lengths[:, None] / lengths, atol=1e-4)
        assert x["conflict"] == pytest.approx(np.sum(gram < 0) / 6)
    np.testing.assert_allclose(found["td_error"], distance_to_reward(agent, state, batch), rtol=1e-5)


@pytest.mark.slow
def test_training_reports_what_diagnostics_do():
    """An update by PCGrad on the same batch sees the same; lengths and TD errors have columns for each task."""
    agent = tiny("pcgrad", hidden=(4,))
    init, update = learner(agent, TASKS, BATCH, SPEC)
    state, batch = init(TASKS, jax.random.key(1)), ended(3)
    metrics, found = update(state, batch, TASKS, KEY)[1], compare(agent, state, batch)
    np.testing.assert_allclose(metrics["td_error"], found["td_error"], rtol=1e-5)
    np.testing.assert_allclose(metrics["critic_gradient_norm"], found["critic"]["gradient_norm"], rtol=1e-4)
    np.testing.assert_allclose(metrics["critic_cosine"], diagnostics.mean_cosine(found["critic"]["cosine"]), atol=1e-5)
    assert metrics["critic_conflict"] == found["critic"]["conflict"]
    of_run = {name: np.asarray(x)[None] for name, x in metrics.items()} | {"return": np.zeros((1, 3))}
    row = log.metric_rows(of_run, np.array([0]), {})[0]
    for name in ("td_error", "critic_gradient_norm", "actor_gradient_norm"):
        np.testing.assert_allclose([float(row[f"{name}_{t}"]) for t in range(3)], metrics[name], rtol=1e-6)


@pytest.mark.slow
def test_tasks_that_want_opposite_values_conflict():
    """Same steps, rewards of 100 and of -100, told nothing: cosines near 1 within a camp and near -1 between them."""
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), ended())
    batch = batch._replace(reward=jnp.full((3, BATCH), 100.0) * jnp.array([[1.0], [1.0], [-1.0]]))
    agent = tiny("sac", hidden=(4,))
    found = compare(agent, started(agent), batch)["critic"]
    np.testing.assert_allclose(found["cosine"], [[1, 1, -1], [1, 1, -1], [-1, -1, 1]], atol=0.05)
    assert found["conflict"] == pytest.approx(4 / 6)


@pytest.mark.slow
@pytest.mark.parametrize("value", one_in(2, ["c51", "hl-gauss"]))
def test_td_error_of_categorical_critics_is_in_units_of_reward(value):
    """|mean of the distribution - the reward| where every step is its episode's last."""
    agent = tiny("sac", hidden=(4,), value=value, num_bins=201)
    state, batch = started(agent), ended()
    found = compare(agent, state, batch)["td_error"]
    np.testing.assert_allclose(found, distance_to_reward(agent, state, batch), rtol=2e-3)


# Units.


def watched(agent, state, batch, tasks=TASKS):
    return jax.device_get(
        jax.jit(partial(activity, agent), compiler_options=QUICK)(state, probes.windows(batch), tasks)
    )


def constant_layers(params: Params, *levels):
    """A body of two layers whose units put out these constants, whatever they are given."""
    layers = params.shared["body"]["params"]["MLP_0"]
    fixed = {}
    for (name, layer), level in zip(sorted(layers.items()), levels, strict=True):
        bias = jnp.broadcast_to(jnp.float32(level), layer["bias"].shape)
        fixed[name] = {"kernel": jnp.zeros_like(layer["kernel"]), "bias": bias}
    shared = {**params.shared, "body": {"params": {"MLP_0": fixed}}}
    return params._replace(shared=shared)


def test_dead_units_are_counted():
    """Three of eight units in one layer of two are dead in all critics, one of four in the actor's last layer."""
    agent = tiny("sac-conditioned", hidden=(8, 8), critic_layer_norm=False)
    state = started(agent)
    critic = constant_layers(state.nets["critic"], 1.0, [-1, 1, 2, 0, 1, 3, -2, 1])
    actor = constant_layers(state.nets["actor"], [1, 1, 1, 1, 1, 1, 0, -1], 2.0)
    seen = watched(agent, with_nets(state, critic=critic, actor=actor), random_batch(0, 3, BATCH, SPEC))
    found = utilisation(agent.critic, critic, seen["critic"])
    names = ["Trunk/MLP_0/ReLU_0", "Trunk/MLP_0/ReLU_1"]
    assert found["dormant_by_layer"] == {names[0]: 0, names[1]: 3 / 8} and found["dormant"] == 3 / 16
    assert (found["rank"], found["width"]) == (1, 8)  # the same features in every state
    assert found["entropy_rank"] == pytest.approx(1, abs=1e-3)
    found = utilisation(agent.actor, actor, seen["actor"])
    assert found["dormant_by_layer"] == {names[0]: 2 / 8, names[1]: 0} and found["dormant"] == 2 / 16


def test_threshold_is_a_share_of_the_layers_mean():
    """Whatever the layer's scale; a layer without any activity is dormant altogether."""
    levels = np.array([0.024, 0.026, 1.975, 1.975])  # of mean 1
    assert dormant_share(levels) == dormant_share(1000 * levels) == 0.25
    assert dormant_share(np.array([levels, np.ones(4)])) == 0.125
    assert dormant_share(np.zeros(7)) == 1


def test_unit_that_one_task_uses_is_not_dormant_if_it_is_shared():
    """Two tasks that each use one of two units: all are in use, but half of what tasks have for themselves."""
    seen = Activity({"Trunk/ReLU_0": np.float32([[[1, 0]], [[0, 1]]])}, np.ones((2, 5, 1, 2), np.float32))
    for heads, share in (("shared", 0), ("per-task", 0), ("disjoint", 0.5)):
        agent = tiny("sac", heads=heads)
        assert utilisation(agent.actor, shapes_of(agent).nets["actor"], seen)["dormant"] == share


def test_ranks_are_of_all_tasks_together_if_they_share_a_body():
    """Two tasks whose features each lie on a line of their own: rank 2 together, 1 alone."""
    hidden = np.zeros((2, 5, 1, 3), np.float32)
    hidden[0, :, 0, 0] = hidden[1, :, 0, 1] = 1
    for heads, rank in (("shared", 2), ("disjoint", 1)):
        agent = tiny("sac", heads=heads)
        found = utilisation(agent.actor, shapes_of(agent).nets["actor"], Activity({}, hidden))
        assert found["rank"] == rank and found["entropy_rank"] == pytest.approx(rank)
        assert np.isnan(found["dormant"])


@pytest.mark.parametrize(
    "values, rank, entropy_rank",
    [
        ([1.0] * 10, 10, 10.0),
        ([2.0] * 100, 99, 100.0),
        ([1.0, 0, 0, 0], 1, 1.0),
        ([90.0, 9.0, 0.9, 0.1], 2, np.exp(-sum(p * np.log(p) for p in (0.9, 0.09, 0.009, 0.001)))),
        ([90.0, 8.0, 1.0, 1.0], 3, np.exp(-sum(p * np.log(p) for p in (0.9, 0.08, 0.01, 0.01)))),
        ([0.0, 0.0], 0, 0.0),
    ],
)
def test_effective_ranks_of_known_singular_values(values, rank, entropy_rank):
    """Of a rotated matrix with these singular values."""
    random, size = np.random.default_rng(0), len(values)
    left = np.linalg.qr(random.normal(size=(2 * size, size)))[0]
    right = np.linalg.qr(random.normal(size=(size, size)))[0]
    found = effective_ranks((left * values) @ right)
    assert found[0] == rank and found[1] == pytest.approx(entropy_rank, rel=1e-9, abs=1e-12)


@pytest.mark.slow
def test_activity_is_that_of_the_networks():
    """Mean activity and hidden layers of every critic and of the actor are what the networks compute for each task."""
    agent = tiny("multi-head", hidden=(8, 4), normalize_observations=True)
    state, batch = started(agent), random_batch(1, 3, BATCH, SPEC)
    seen, batch = watched(agent, state, batch), probes.prepare(agent, state, batch, TASKS)
    for i in range(3):
        hidden = agent.actor.hidden(of_task(state.nets["actor"], i), batch.features[i], batch.obs[i])
        np.testing.assert_allclose(seen["actor"].hidden[i, :, 0], hidden, rtol=1e-4, atol=1e-5)
        level = seen["actor"].layers["Trunk/MLP_0/ReLU_1"][i, 0]
        np.testing.assert_allclose(level, np.mean(hidden, axis=0), rtol=1e-4, atol=1e-5)
        for n in range(2):
            params = pick(of_task(state.nets["critic"], i), n)
            hidden = agent.critic.hidden(params, batch.features[i], batch.obs[i], batch.action[i])
            np.testing.assert_allclose(seen["critic"].hidden[i, :, n], hidden, rtol=1e-4, atol=1e-5)


def trace(agent):
    """What diagnostics of an agent would be: shapes alone."""
    state = shapes_of(agent)
    window = jax.eval_shape(lambda: probes.windows(random_batch(0, 3, BATCH, SPEC, agent.view.history)))
    gradients = jax.eval_shape(partial(compare_gradients, agent), state, window, TASKS, KEY)
    seen = jax.eval_shape(partial(activity, agent), state, window, TASKS)
    return state, gradients, seen


@pytest.mark.parametrize("name", one_in(6, OFF_POLICY, nightly=True))
def test_every_agent_has_diagnostics(name):
    """Matrices unless it is disjoint, TD errors for each task, and layers of both networks."""
    agent = tiny(name)
    state, gradients, seen = trace(agent)
    for network in ("critic", "actor"):
        matrix, params = gradients[network]["cosine"], state.nets[network]
        assert matrix is None if not jax.tree.leaves(params.shared) else matrix.shape == (3, 3)
        assert gradients[network]["gradient_norm"].shape == (3,)
        assert seen[network].hidden.shape[:2] == (3, BATCH)
    assert gradients["td_error"].shape == (3,)


PLAYED = {"ppo": Walk, "impala": Walk, "pqn": partial(mtjax.make, "tabular-mdp"), "sketches": lambda: test_sketches.ENV}
"""Families of agents that have no replay, from a rollout of which diagnostics are."""


def played(agent, env, num_envs=4):
    """The agent of one seed and the steps (T, H, E, ...) of a rollout that it has played and assessed."""
    tasks, keys = env.tasks(), jax.random.split(KEY, 1)
    states = jax.vmap(partial(agent.init, env.spec, tasks))(keys)
    states, steps = loop.rollout(env, agent, loop.Settings(num_envs=num_envs), tasks, states, keys)
    return jax.tree.map(lambda x: x[0], (states, steps))


@pytest.mark.parametrize("name", slow_but(PLAYED, "pqn", "sketches"))
def test_agents_without_a_replay_have_diagnostics_of_a_rollout(name):
    """Of the critic, and of the actor unless the critic chooses. Units inside a map of an agent's own are not seen."""
    env = PLAYED[name]()
    agent = for_action(tiny(name, unroll=8, minibatches=2), env.spec.action)

    def look():
        state, steps = played(agent, env)
        window = agent.experience.draw(env.spec, agent, steps, KEY, 2)
        return compare_gradients(agent, state, window, env.tasks(), KEY), activity(agent, state, window, env.tasks())

    gradients, seen = jax.eval_shape(look)
    networks, count = {"critic"} if name == "pqn" else {"critic", "actor"}, len(env.tasks().id)
    assert seen.keys() == networks and gradients.keys() == networks | {"td_error"}
    assert gradients["td_error"].shape == (count,)
    for network in networks:
        assert gradients[network]["gradient_norm"].shape == (count,)
        if (name, network) == ("sketches", "actor"):
            assert (seen[network].hidden, seen[network].layers) == (None, {})
            assert utilisation(agent.actor, None, seen[network])["rank"] is None
        else:
            assert seen[network].layers and seen[network].hidden.shape[0] == count


@pytest.mark.slow
def test_gradients_of_ppo_are_those_of_the_policy_gradient():
    """As its first ratio is 1: -mean(A grad log pi) - c grad H; and TD errors are mean |y - V|."""
    agent = tiny("ppo", hidden=(4,), unroll=6)

    @partial(jax.jit, compiler_options=QUICK)
    def look(state, steps, tasks):
        flat = jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), steps)
        found = compare_gradients(agent, state, windows(steps, 0), tasks, KEY)
        by_hand = []
        for i, key in enumerate(jax.random.split(KEY, len(tasks.id))):
            (one, task), nets = jax.tree.map(lambda x, i=i: x[i], (flat, tasks)), state_of_task(state.nets, i)
            features = agent.view.features(state, task)
            inputs, kept = agent.view.actor_inputs(nets, features, agent.view.see(nets["inputs"], one.obs)), one.extras

            def of_actor(actor, inputs=inputs, kept=kept, key=key):
                outputs = agent.actor.apply(actor, *inputs)
                gain = kept.advantage * agent.policy.log_prob(outputs, kept.raw, None)
                return -jnp.mean(gain) - agent.entropy_cost * jnp.mean(agent.policy.entropy(outputs, None, key))

            def of_critic(critic, inputs=inputs, kept=kept):
                return jnp.mean((agent.critic.apply(critic, *inputs)[..., 0] - kept.target) ** 2) / 2

            slopes = {"actor": jax.grad(of_actor)(nets["actor"]), "critic": jax.grad(of_critic)(nets["critic"])}
            by_hand.append({name: jax.flatten_util.ravel_pytree(x.shared)[0] for name, x in slopes.items()})
        value, units = flat.extras.value, state.nets["units"].own.moments
        target = units.mean[:, None] + jnp.sqrt(units.variance)[:, None] * flat.extras.target
        return found, by_hand, jnp.mean(jnp.abs(target - value), axis=1)

    found, by_hand, error = jax.device_get(look(*played(agent, Walk()), Walk().tasks()))
    for network in ("actor", "critic"):
        rows = np.float64([x[network] for x in by_hand])
        np.testing.assert_allclose(found[network]["gram"], rows @ rows.T, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(found["td_error"], error, rtol=1e-4)


@pytest.mark.parametrize("name", ["maml", "options", "distil"])
def test_agents_whose_losses_are_not_of_single_steps_are_refused(name):
    refused(tiny(name), Walk(), f"(?i)losses of single steps, and those of {name} are not")


def refused(agent, env, message):
    """Before a run's data are read, and of data that are given."""
    policy = SimpleNamespace(agent=agent, env=env)
    with pytest.raises(InputError, match=message):
        diagnostics.with_experience(policy, "")
    with pytest.raises(InputError, match=message):
        diagnostics.diagnose(policy, None, 4)


def test_memories_and_pictures_are_refused():
    refused(tiny("rl2"), Walk(), "learns from windows")
    shown = SimpleNamespace(spec=Spec({"pixels": jax.ShapeDtypeStruct((64, 64, 3), jnp.uint8)}, Continuous(1), 1))
    refused(tiny("sac"), shown, "networks take vectors")


@pytest.mark.parametrize("encoder", one_in(5, ENCODERS, nightly=True))
def test_units_of_every_encoder_are_seen(encoder):
    """Layers of the right number of networks, all of ReLUs."""
    agent = tiny("xqc" if encoder == "batch-norm" else "sac", encoder=encoder, conditioning="one-hot", hidden=(16, 16))
    _, _, seen = trace(agent)
    for network, count in (("critic", 2), ("actor", 1)):
        layers = seen[network].layers
        assert layers and all(x.shape[:2] == (3, count) and x.ndim == 3 for x in layers.values())


# Metrics of training.


def test_rows_have_columns_for_tasks_where_the_task_matters():
    """TD errors and lengths, before the returns; what is not there has no columns."""
    each = np.array([[1.0, 3.0]])
    row = log.metric_rows({"return": each, "td_error": 2 * each, "value": each}, np.array([0]), {})[0]
    assert list(row.items())[1:] == [
        ("return", "2"),
        ("td_error", "4"),
        ("value", "2"),
        ("td_error_0", "2"),
        ("td_error_1", "6"),
        ("return_0", "1"),
        ("return_1", "3"),
    ]
    row = log.metric_rows({"return": each, "critic_gradient_norm": each}, np.array([0]), {})[0]
    assert (row["critic_gradient_norm_1"], "td_error_0" in row) == ("3", False)


def test_old_file_keeps_its_columns(tmp_path):
    """A run that an earlier version began goes on under the columns that it has."""
    path = tmp_path / "metrics.csv"
    log.append_rows(path, [{"iteration": 1, "return": 2, "gone": 3}])
    log.append_rows(path, [{"iteration": 2, "td_error": 5, "return": 4}])
    assert path.read_text().split() == ["iteration,return,gone", "1,2,3", "2,4,"]
    path.write_text("")  # the process was killed before the header
    log.append_rows(path, [{"iteration": 2, "td_error": 5}])
    assert path.read_text().split() == ["iteration,td_error", "2,5"]


# The program.


@pytest.mark.parametrize("count", [1, 3, 40])
def test_figure_of_any_number_of_tasks(count, tmp_path):
    """Also where one network shares nothing; equal to itself, a task has no colour."""
    cosines = {"critic": np.random.default_rng(0).uniform(-1, 1, (count, count)), "actor": None}
    plot.interference(tmp_path / "a.png", "size", "m", np.arange(count), cosines, {"error": np.ones(count)})
    cosines["critic"] += 5 * np.eye(count)
    plot.interference(tmp_path / "b.png", "size", "m", np.arange(count), cosines, {"error": np.ones(count)})
    first, second = (matplotlib.image.imread(tmp_path / f"{name}.png") for name in "ab")
    np.testing.assert_array_equal(first, second)
    assert first.std() > 0


@pytest.fixture
def run_of(copied_run):
    """Makes the finished run one of another agent, untrained, with the same experience."""

    def remake(name):
        program = from_json(copied_run / "config.json")
        learner = mtjax.agent(name, hidden=program.learner.hidden, experience=program.learner.experience)
        tasks, seeds, checkpoints = program.family.tasks("train"), jnp.arange(2), copied_run / "checkpoints"
        shapes = jax.eval_shape(lambda: loop.init(program.family, program.learner, program.training, tasks, seeds))
        state = checkpoint.load(checkpoints, shapes)
        init = jax.vmap(lambda key: learner.init(program.family.spec, tasks, key))
        fresh = jax.jit(init, compiler_options=QUICK)(jax.random.split(KEY, 2))
        program = dataclasses.replace(program, agent=name, learner=learner)
        (copied_run / "config.json").write_text(to_json(program, {}))
        shutil.rmtree(checkpoints)
        checkpoint.save(checkpoints, state._replace(agent=fresh))

    return remake


@pytest.fixture
def no_episodes(monkeypatch):
    """Leaves out what an evaluation does besides, which compiles for ten seconds."""
    empty = lambda policy, episodes, seed, tasks, tell: {"train": Scores(np.zeros((len(policy.seeds), 2, 1)), {})}
    monkeypatch.setattr(scoring, "score", empty)


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(["sac-conditioned", "pcgrad", "disjoint"], "pcgrad"))
def test_program_writes_and_prints_diagnostics(name, copied_run, run_of, no_episodes, capsys):
    """For a trained agent, for one by whose rule gradients combine, and for one that shares nothing."""
    if name != "sac-conditioned":
        run_of(name)
    capsys.readouterr()
    mtjax.evaluate.main([f"--run={copied_run}", "--diagnostics"])
    out, folder = capsys.readouterr().out, copied_run / "evaluation-1"
    assert {"diagnostics.json", "diagnostics.png"} < {path.name for path in folder.iterdir()}
    assert matplotlib.image.imread(folder / "diagnostics.png").std() > 0

    found, shared = json.loads((folder / "diagnostics.json").read_text()), name != "disjoint"
    assert (found["parameter"], found["values"]) == ("size", pytest.approx([1.0, 1.2]))
    assert np.shape(found["td_error"]) == (2,) and np.all(np.array(found["td_error"]) > 0)
    assert ("tasks share no parameters of the critic" in out) != shared
    for network in ("critic", "actor"):
        x = found[network]
        assert 0 <= x["dormant"] <= 1 and 0 < x["rank"] <= x["width"] and np.all(np.array(x["gradient_norm"]) > 0)
        if shared:
            np.testing.assert_allclose(np.diagonal(x["cosine"]), 1, rtol=1e-4)
            assert x["cosine"][0][1] == x["cosine"][1][0] and f"{x['cosine'][0][1]:.2f}" in out
        else:
            assert x["cosine"] is x["gram"] is x["conflict"] is None
    (line,) = (line.split() for line in out.splitlines() if line.startswith("       1.2 "))
    assert line[1:3] == [f"{found['td_error'][1]:.3g}", f"{found['critic']['gradient_norm'][1]:.3g}"]


@pytest.mark.slow
def test_program_plays_a_rollout_of_an_agent_without_a_replay(short_family, tmp_path, no_episodes, capsys):
    """And writes and prints the same as for others."""
    flags = "--env=finger-short --agent=ppo --steps=64 --num-envs=2 --chunk-steps=16 --agent.hidden 8 8"
    more = f"--agent.unroll=8 --agent.minibatches=2 --eval-episodes=1 --seeds=2 --runs={tmp_path}"
    mtjax.train.main([*flags.split(), *more.split()])
    (run,) = tmp_path.iterdir()
    mtjax.evaluate.main([f"--run={run}", "--diagnostics"])
    found = json.loads((run / "evaluation-1" / "diagnostics.json").read_text())
    assert (found["batch_size"], found["seeds"]) == (8, 2) and np.all(np.array(found["td_error"]) > 0)
    assert 0 < found["actor"]["rank"] <= found["actor"]["width"] == 8
    assert f"{found['td_error'][1]:.3g}" in capsys.readouterr().out


@pytest.mark.slow
def test_seeds_are_averaged(finished_run):
    """By the same keys for every seed, whichever others are there."""
    policy, (replay, batch_size) = mtjax.load(finished_run), load_experience(finished_run)
    both, alone = diagnostics.diagnose(policy, replay, batch_size), []
    for s in (0, 1):
        states, rows, seeds = jax.tree.map(lambda x, s=s: x[s : s + 1], (policy.states, replay.rows, policy.seeds))
        of_seed = dataclasses.replace(policy, states=states, seeds=seeds)
        alone.append(diagnostics.diagnose(of_seed, replay._replace(rows=rows), batch_size))
    assert both.seeds == 2 and not np.array_equal(alone[0].td_error, alone[1].td_error)
    means = jax.tree.map(lambda *x: np.mean(x, axis=0), *alone)
    for network in ("critic", "actor"):
        jax.tree.map(np.testing.assert_allclose, both.networks[network], means.networks[network])
    np.testing.assert_allclose(both.td_error, means.td_error)


@pytest.mark.slow
def test_columns_of_a_run(finished_run):
    """TD errors of each task; lengths of gradients only where a rule looks at them."""
    with (finished_run / "metrics.csv").open(newline="") as file:
        row = list(csv.DictReader(file))[-1]
    each = [float(row[f"td_error_{t}"]) for t in (0, 1)]
    assert float(row["td_error"]) == pytest.approx(np.mean(each), rel=1e-5) and each[0] != each[1]
    assert not any("gradient_norm" in name for name in row)


def test_replay_is_read_without_the_rest(copied_run):
    """And is that of the whole state."""
    program = from_json(copied_run / "config.json")
    fixed = (program.family, program.learner, program.training, program.family.tasks("train"), jnp.arange(2))
    whole = checkpoint.load(copied_run / "checkpoints", jax.eval_shape(lambda: loop.init(*fixed)))
    shutil.rmtree(copied_run / "checkpoints" / "150" / "agent")
    replay, batch_size = load_experience(copied_run)
    jax.tree.map(np.testing.assert_array_equal, replay, whole.data.ring)
    assert batch_size == 4 and int(replay.size) == 100


@pytest.mark.parametrize("lost, message", [("*/loop", "is damaged"), ("*", "holds no checkpoint")])
def test_run_without_replay_is_refused(copied_run, lost, message):
    """In a line, and no folder is left in it."""
    for path in (copied_run / "checkpoints").glob(lost):
        shutil.rmtree(path)
    with pytest.raises(InputError, match=message):
        mtjax.evaluate.main([f"--run={copied_run}", "--diagnostics"])
    assert not list(copied_run.glob("evaluation-*"))


def test_empty_replay_is_refused(finished_run):
    """As nothing can be drawn from it."""
    replay, batch_size = load_experience(finished_run)
    with pytest.raises(InputError, match="replay of this run is empty"):
        diagnostics.diagnose(mtjax.load(finished_run), replay._replace(size=jnp.int32(0)), batch_size)
