"""The figure of a belief over a trial: what was believed before each step, what models foretold, and what is drawn."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import pick
from test_posterior import SMALL, WAYS, knowing, params_of, posterior, track_of

import mtjax
import mtjax.plot
from mtjax.agents.parts.knowing.inference import Belief, change
from mtjax.learning.evaluation import record
from mtjax.report import beliefs
from mtjax.saved.policy import Policy
from mtjax.types import InputError

KEY = jax.random.key(4)
TINY = {"hidden": (8,), "unroll": 6, "minibatches": 1, "epochs": 1}


def policy_of(way, env, trial=3):
    """A policy that has not learned, whose networks are no longer those of the start."""
    agent = mtjax.agents.for_action(mtjax.agent("ppo", **TINY, **posterior(way)), env.spec.action)
    state = agent.init(env.spec, env.tasks("train"), KEY)
    known = state.nets["knowing"]
    moved = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(KEY, x.shape), known.shared)
    state = state.with_nets(knowing=known._replace(shared=moved))
    states = jax.tree.map(lambda x: x[None], state)
    return Policy(env, agent, state, states, jnp.asarray([0]), trial=trial)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
def test_what_is_believed_is_what_the_policy_remembers_through_a_trial(way):
    """Before each step of all episodes, a memory that is begun once: what networks see of it."""
    env = mtjax.make("grid-navi", size=3, steps=4)
    policy = policy_of(way, env)
    found, task = beliefs.believed(policy), pick(env.tasks(), 0)
    played = [record(env, policy.agent, policy.state, env.tasks(), s, 3, beliefs._keep) for s in range(beliefs._TRIES)]
    named = {env.describe(int(one.rows[0])): pick(one.kept, 0) for one in reversed(played)}
    assert set(found.names) == set(named) and all(name.startswith("goal=") for name in named)
    remember = jax.jit(lambda memory, x: policy.remember(memory, task, x.obs, x.action, x.reward, x.next_obs, x.ended))
    for i, name in enumerate(found.names):
        memory, steps = policy.begin(task), named[name]
        for t in range(12):
            nets = policy.state.nets["knowing"].parts
            seen = policy.agent.conditioning.show(nets, memory.hidden)
            mean, deviation = found.mean[i, t], found.deviation[i, t]
            told = mean if way == "cadm" else np.concatenate([mean, 2 * np.log(deviation)])
            np.testing.assert_allclose(seen, told, rtol=1e-4, atol=1e-5)
            memory = remember(memory, pick(steps, t))
    np.testing.assert_array_equal(found.ends, np.tile([4, 8, 12], (len(found.names), 1)))
    assert way != "cadm" or not found.deviation.any()


@pytest.mark.slow
def test_models_foretell_what_they_predict_on_average_over_a_belief():
    """VariBAD's by draws, which of a point are all the same; what follows an episode's end is unknown."""
    made = knowing("varibad")
    params, track = params_of(made), track_of(made)
    mean = jax.random.normal(KEY, (len(track.reward), SMALL["latent_size"]))
    point = Belief(mean, jnp.full_like(mean, -jnp.inf))
    told = made.way.foretell(params, track, point, KEY)
    np.testing.assert_allclose(told["reward"][0], made.way.rewards(params, track, mean), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(told["reward"][1], track.reward)
    predicted, came = told["change of state"]
    np.testing.assert_allclose(predicted, made.way.changes(params, track, mean), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(np.isnan(came).all(axis=-1), track.ended)
    np.testing.assert_array_equal(came[~track.ended], change(track)[~track.ended])
    wide = made.way.foretell(params, track, Belief(mean, jnp.zeros_like(mean)), KEY)["reward"][0]
    draw = lambda key: made.way.rewards(params, track, Belief(mean, jnp.zeros_like(mean)).draw(key))
    expected = jax.jit(jax.vmap(draw))(jax.random.split(KEY, 2000))
    np.testing.assert_allclose(wide, expected.mean(axis=0), atol=5 * float(expected.std(axis=0).max()) / np.sqrt(64))


@pytest.mark.slow
def test_cadm_foretells_changes_of_state_and_pearl_nothing():
    made = knowing("cadm")
    params, track = params_of(made), track_of(made)
    mean = jax.random.normal(KEY, (len(track.reward), SMALL["latent_size"]))
    told = made.way.foretell(params, track, Belief(mean, jnp.zeros_like(mean)), KEY)
    model = made.way.dense(track.obs.shape[-1])
    expected = model.apply(params["forward"], track.obs, track.action, mean)
    assert list(told) == ["change of state"]
    np.testing.assert_allclose(told["change of state"][0], expected, rtol=1e-5, atol=1e-6)
    assert knowing("pearl").way.foretell(params, track, told, KEY) == {}


def believed(trials, vectors):
    """Beliefs in two latents over trials of two episodes of three steps."""
    random = np.random.default_rng(0)
    mean = random.normal(size=(trials, 6, 2))
    told = {"reward": (random.normal(size=(trials, 6)), random.normal(size=(trials, 6)))}
    told |= {"change of state": tuple(random.normal(size=(2, trials, 6, 3)))} if vectors else {}
    return beliefs.Believed(mean, np.full_like(mean, 0.5), told, ["a", "b"][:trials], np.tile([3, 6], (trials, 1)))


def test_a_figure_has_a_panel_for_each_latent_and_for_what_was_foretold():
    """A colour for each task, means with bands, predictions as lines, what came as points, and the episode's end."""
    found = believed(2, vectors=True)
    axes = beliefs._draw(found, "x")
    assert [one.get_title() for one in axes] == [
        "latent 1",
        "latent 2",
        "reward: predicted (line), came (points)",
        "error of the predicted change of state",
    ]
    lines = axes[1].get_lines()
    for i, (name, line) in enumerate(zip("ab", [x for x in lines if len(x.get_xdata()) == 6], strict=True)):
        assert line.get_label() == name
        np.testing.assert_array_equal(line.get_ydata(), found.mean[i, :, 1])
    assert lines[0].get_color() != lines[1].get_color()
    assert [list(line.get_xdata()) for line in axes[1].get_lines() if len(line.get_xdata()) == 2] == [[2.5, 2.5]]
    band, _ = axes[0].collections
    assert band.get_paths()[0].get_extents().y1 == pytest.approx(found.mean[0, :, 0].max() + 0.5)
    predicted, came = found.foretold["reward"]
    drawn = [line.get_ydata() for line in axes[2].get_lines() if len(line.get_xdata()) == 6]
    np.testing.assert_array_equal(drawn, [predicted[0], came[0], predicted[1], came[1]])
    guessed, moved = found.foretold["change of state"]
    size = np.sqrt(np.mean(np.sum(moved**2, axis=-1)))
    error = next(line.get_ydata() for line in axes[3].get_lines() if len(line.get_xdata()) == 6)
    np.testing.assert_allclose(error, np.linalg.norm(guessed[0] - moved[0], axis=-1) / size)


def test_nothing_is_drawn_of_what_never_changes():
    """As the state of a bandit."""
    found = believed(1, vectors=True)
    told = {**found.foretold, "change of state": (np.ones((1, 6, 3)), np.zeros((1, 6, 3)))}
    assert len(beliefs._draw(found._replace(foretold=told), "x")) == 3


@pytest.mark.nightly
def test_the_command_draws_one_run_with_a_belief(tmp_path, capsys, monkeypatch):
    """A run's folder, a result and a policy alike."""
    monkeypatch.chdir(tmp_path)
    agent = mtjax.agent("ppo", **TINY, **posterior("varibad"))
    plan = {"steps": 24, "chunk_steps": 6, "num_envs": 2, "eval_episodes": 3, "trials": 3, "quiet": True}
    result = mtjax.train(mtjax.make("hidden-bandit"), agent, **plan, directory=tmp_path / "run")
    mtjax.plot.main(["run", "--figure=posterior", "--out=belief.png"])
    assert capsys.readouterr().out.endswith("written to belief.png\n") and (tmp_path / "belief.png").stat().st_size
    drawn = [mtjax.plot(one, "posterior")[0].get_lines()[0].get_ydata() for one in ("run", {"mine": result})]
    np.testing.assert_allclose(*drawn, rtol=1e-5)
    shutil.copytree("run", "again")
    with pytest.raises(InputError, match="posterior is of one run, and these are several"):
        mtjax.plot("*", "posterior")
    with pytest.raises(InputError, match="has no tasks of the split extrapolation"):
        mtjax.plot(result, "posterior", split="extrapolation")


def test_an_agent_without_a_belief_is_refused():
    policy = policy_of("pearl", mtjax.make("hidden-bandit"))
    blind = dataclasses.replace(policy, agent=mtjax.agent("ppo"))
    with pytest.raises(InputError, match="posterior is of agents that believe"):
        mtjax.plot(blind, "posterior")
    with pytest.raises(InputError, match="unknown split 'test'"):
        mtjax.plot(policy, "posterior", split="test")
