"""PQN: its targets by hand, exploration that falls, masks, and tabular processes against value iteration."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import learn, only_seed, pick, quick, random_batch, slow_but, tasks_of, tiny, train
from test_ppo import random_steps

import mtjax
from mtjax import agents, frames
from mtjax.agents import for_action
from mtjax.agents.networks import Params
from mtjax.agents.swept import sweepable
from mtjax.agents.unseen_tasks import describe_unseen
from mtjax.command import run_config
from mtjax.config import with_preset
from mtjax.envs.probes import Pictured, Probe
from mtjax.saved.config_json import from_json, to_json
from mtjax.types import Discrete, InputError, Spec

SPEC = Spec.vector(3, 2, 1)._replace(action=Discrete(4))
TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
KEY = jax.random.key(2)


def small(**settings):
    given = {"epochs": 1, "minibatches": 2, "unroll": 4, **settings}
    return for_action(tiny("pqn", **given), SPEC.action)


def steps_of(agent, seed=0):
    """Rollouts (T, H, E, ...) in which every field is random."""
    steps = random_steps(agent, seed=seed)
    action = np.random.default_rng(seed).integers(4, size=steps.reward.shape).astype(np.int32)
    return steps._replace(action=jnp.asarray(action), extras=None)


def values_of(agent, state, obs, task):
    """The values (..., A) of all actions at observations (..., O) of a task."""
    one = lambda obs: agent.q(*agent.view.acting(state, agent.begin(state, task), obs, task))
    return jax.vmap(one)(obs.reshape(-1, obs.shape[-1])).reshape(*obs.shape[:-1], -1)


@pytest.mark.parametrize("cut", [False, True])
def test_targets_are_those_of_a_plain_loop(cut):
    """With the sum cut at the end of a trial, of the rollout and, if asked, before actions that explore."""
    agent = small(q_lambda=0.6, gamma=0.9, cut_exploration=cut)
    state, steps = agent.init(SPEC, TASKS, KEY), steps_of(agent)
    found = quick(agent.assess, state, steps, TASKS)(state, steps, TASKS)[1].extras
    for task in range(3):
        now, then = (
            np.asarray(values_of(agent, state, x[task], pick(TASKS, task))) for x in (steps.obs, steps.next_obs)
        )
        one = jax.tree.map(np.asarray, pick(steps._replace(memory=None), task))
        for world in range(2):
            later = 0.0
            for t in reversed(range(4)):
                last = t == 3 or one.cut[t, world]
                last |= cut and t < 3 and now[t + 1, world].argmax() != one.action[t + 1, world]
                ahead = then[t, world].max() if last else 0.4 * then[t, world].max() + 0.6 * later
                later = one.reward[t, world] + 0.9 * one.discount[t, world] * ahead
                assert float(found[task, t, world]) == pytest.approx(float(later), abs=1e-4)


def test_targets_are_in_the_units_of_each_task():
    """Rewards are divided by their deviation, if asked."""
    plain, scaled = small(), small(scaling="reward")
    state, steps, std = scaled.init(SPEC, TASKS, KEY), steps_of(scaled), jnp.float32([2.0, 0.5, 4.0])
    memory = state.nets["scaling"].own._replace(variance=jnp.square(std))
    found = scaled.assess(state.with_nets(scaling=Params({}, memory)), steps, TASKS)[1].extras
    divided = steps._replace(reward=steps.reward / std[:, None, None])
    expected = plain.assess(plain.init(SPEC, TASKS, KEY), divided, TASKS)[1].extras
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_the_loss_is_of_the_actions_that_were_taken():
    """No gradient reaches the values of others."""
    agent = small()
    state, steps = agent.init(SPEC, TASKS, KEY), steps_of(agent)
    steps = steps._replace(action=jnp.full_like(steps.action, 2))
    after, metrics = jax.jit(lambda state: learn(agent, state, steps, TASKS, KEY))(state)
    bias = lambda state: np.asarray(state.nets["critic"].shared["head"]["bias"])
    assert np.array_equal(bias(after) != bias(state), [False, False, True, False])
    assert metrics["critic_loss"].shape == (3,) and np.all(np.isfinite(metrics["critic_loss"]))


def test_exploration_falls_along_a_line_and_evaluation_has_none():
    """From 1 to epsilon, rollout by rollout."""
    agent = small(epsilon=0.2, epsilon_rollouts=4)
    state, shares = agent.init(SPEC, TASKS, KEY), []
    for _ in range(6):
        shares.append(float(agent.exploration(state)))
        state = agent.observe(state, steps_of(agent), TASKS)
    np.testing.assert_allclose(shares, [1.0, 0.8, 0.6, 0.4, 0.2, 0.2], rtol=1e-5)
    task, obs = pick(TASKS, 0), jnp.float32([0.3, -1.0, 2.0])
    act = lambda key: int(agent.act(state, agent.begin(state, task), obs, task, key).action)
    best = int(np.argmax(values_of(agent, state, obs[None], task)))
    drawn = jax.vmap(lambda key: agent.act(state, agent.begin(state, task), obs, task, key).action)
    taken = np.asarray(drawn(jax.random.split(KEY, 4000)))
    assert act(None) == best and taken.dtype == np.int32
    np.testing.assert_allclose(np.mean(taken == best), 0.8 + 0.2 / 4, atol=0.03)


def test_actions_that_a_task_lacks_are_never_taken_nor_hoped_for():
    """At random, as the best one, and as what follows."""
    agent = small(epsilon=1.0)
    mask = jnp.float32([[1, 0, 1, 1], [1, 1, 1, 1], [0, 0, 0, 1]])
    tasks = TASKS._replace(action_mask=mask)
    state, obs = agent.init(SPEC, tasks, KEY), jnp.float32([0.3, -1.0, 2.0])
    for i in range(3):
        task = pick(tasks, i)
        draw = lambda key, task=task: agent.act(state, agent.begin(state, task), obs, task, key).action
        taken = set(np.asarray(jax.vmap(draw)(jax.random.split(KEY, 300))).tolist()) | {int(draw(None))}
        assert taken <= set(np.flatnonzero(mask[i]).tolist())
    steps = steps_of(agent)
    found = agent.assess(state, steps, tasks)[1].extras
    only = np.asarray(values_of(agent, state, steps.next_obs[2], pick(tasks, 2)))[..., 3]
    last = steps.reward[2, -1] + agent.gamma * steps.discount[2, -1] * only[-1]
    np.testing.assert_allclose(found[2, -1], last, rtol=1e-4)


def process_of(tasks, i, gamma=0.9):
    """The best values (states, actions) of a tabular process, by value iteration."""
    rewards, chances = (np.asarray(tasks.goal[name][i], float) for name in ("rewards", "transitions"))
    best = np.zeros(rewards.shape)
    for _ in range(300):
        best = rewards + gamma * chances @ best.max(axis=-1)
    return best


@pytest.mark.usefixtures("optimised")
@pytest.mark.slow
def test_greedy_actions_are_those_of_value_iteration():
    """In every state of every process, and values to 0.1 of 5 to 10."""
    env, gamma = mtjax.make("tabular-mdp", num_tasks=3, split="none"), 0.9
    given = dict(q_lambda=0.0, gamma=gamma, epsilon=0.3, epsilon_rollouts=50, lr_schedule="linear", critic_lr=1e-3)
    agent = for_action(mtjax.agent("pqn", hidden=(64, 64), unroll=16, minibatches=8, **given), env.spec.action)
    steps = 3 * 64 * 16 * 600
    result = mtjax.train(env, agent, steps=steps, num_envs=64, chunk_steps=1600, eval_every=steps, quiet=True)
    tasks, state = env.tasks(), only_seed(result.state.agent)
    for i in range(3):
        best = process_of(tasks, i)
        for reward in (0.0, 1.0):  # that of the step before, which tells nothing
            obs = jnp.concatenate([jnp.eye(4), jnp.full((4, 1), reward)], axis=1)
            found = np.asarray(values_of(agent, state, obs, pick(tasks, i)))
            np.testing.assert_array_equal(found.argmax(axis=-1), best.argmax(axis=-1))
            np.testing.assert_allclose(found, best, atol=0.1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"q_lambda": 1.5}, "q-lambda"),
        ({"epsilon": -0.1}, "epsilon"),
        ({"epsilon_rollouts": 0}, "epsilon-rollouts must be at least 1"),
        ({"representation": "deepmdp"}, "use representation=plain or encoded"),
        ({"representation": "autoencoder"}, "use representation=plain or encoded"),
        ({"representation": "asymmetric"}, "use representation=plain or encoded"),
        ({"representation": "encoded", "shift": 2}, "shift=2 is of updates from a replay, and pqn has none"),
        ({"scaling": "popart", "heads": "per-task"}, "no scaling=popart"),
        ({"sampler": "hardest"}, "sampler=uniform"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        agents.agent("pqn", **settings)


OF_AN_ACTOR = {"actor_lr": 9.0, "actor_hidden": (7,), "actor_heads": "per-task", "actor_layer_norm": True}


@pytest.mark.parametrize("name", OF_AN_ACTOR)
def test_it_has_no_settings_of_an_actor(name):
    """As nothing would read them; neither in Python, nor on a command line, nor in a sweep."""
    with pytest.raises(InputError, match=f"unknown setting of pqn '{name}'"):
        agents.agent("pqn", **{name: OF_AN_ACTOR[name]})
    flag = f"--agent.{name.replace('_', '-')}"
    assert flag not in run_config.flags(with_preset("bandit", "pqn"))
    assert name not in agents.agent("pqn").adjustable and name not in sweepable(agents.agent("pqn"))


def test_records_of_when_it_had_them_are_read(tmp_path):
    """As they were of no effect."""
    config, file = with_preset("bandit", "pqn"), tmp_path / "config.json"
    record = json.loads(to_json(config, {"command": "x"}))
    assert not record["learner"].keys() & OF_AN_ACTOR
    file.write_text(json.dumps(record | {"learner": record["learner"] | OF_AN_ACTOR}))
    assert from_json(file) == config
    file.write_text(json.dumps(record | {"learner": record["learner"] | {"actor_rate": 1}}))
    with pytest.raises(InputError, match="unknown setting of pqn 'actor_rate'"):
        from_json(file)


def test_an_unseen_task_uses_the_critic_of_the_nearest():
    """As that acts."""
    assert describe_unseen(agents.agent("pqn", critic_heads="per-task")).startswith("each uses the head of the nearest")


def test_continuous_actions_are_refused():
    """Before anything compiles."""
    with pytest.raises(InputError, match="pqn draws no continuous actions, which finger-spin has: use "):
        mtjax.train("finger-spin", "pqn", steps=100, quiet=True)


class Five:
    """Makes one of five actions stand for -1, -1/2, 0, 1/2 or 1."""

    @property
    def spec(self):
        return super().spec._replace(action=Discrete(5))

    def step(self, task, state, action):
        return super().step(task, state, (action - 2)[None] / 2)


class Choices(Five, Probe):
    """Probes of choices."""


class SeenChoices(Five, Pictured):
    """Probes of choices whose observations are seen."""


GAMMA, SCALES = 0.9, (1.0, -0.5)
KNOWN = {
    "one-step": (lambda scale, obs: scale, [0.0], 0.02),
    "by-observation": (lambda scale, obs: scale * obs, [-1.0, 1.0], 0.05),
    "delayed": (lambda scale, obs: scale * GAMMA ** (1 - obs), [0.0, 1.0], 0.05),
    "endless": (lambda scale, obs: scale * GAMMA ** (1 - obs) / (1 - GAMMA), [0.0, 1.0], 0.4),
    "by-action": (lambda scale, obs: 0.0, [0.0], 0.1),
    "by-both": (lambda scale, obs: 0.0, [-1.0, 1.0], 0.1),
}


@pytest.mark.parametrize("kind", slow_but(KNOWN, "delayed"))
@pytest.mark.slow
def test_probes_are_learned(kind):
    """The best value of every task, and the action that has it."""
    given = {"num_envs": 16, "chunk_steps": 1600, "unroll": 8, "epochs": 4, "minibatches": 4, "gamma": GAMMA}
    given |= {"epsilon": 0.3, "epsilon_rollouts": 40, "q_lambda": 0.0, "critic_lr": 3e-3}
    agent, tasks = for_action(tiny("pqn", hidden=(32,)), Discrete(5)), tasks_of(kind, SCALES)
    state, history = train(Choices(), agent, given, tasks=tasks)
    state, (expected, obs, tolerance) = only_seed(state.agent), KNOWN[kind]
    for i, scale in enumerate(SCALES):
        found = np.asarray(values_of(agent, state, jnp.float32(obs)[:, None], pick(tasks, i)))
        np.testing.assert_allclose(found.max(axis=-1), [expected(scale, x) for x in obs], atol=tolerance)
        if kind == "by-action":
            np.testing.assert_allclose((found.argmax(axis=-1) - 2) / 2, [scale], atol=0.01)
    assert history[0]["bad_step"].max() == -1


SEEING = {"representation": "encoded", "vision": "grid", "latent_widths": ()}
CELLS = SPEC._replace(obs={"pixels": jax.ShapeDtypeStruct((5, 6, 2), jnp.uint8)})


def seen_steps(agent):
    """Rollouts (T, H, E, ...) of random pictures."""
    steps, pictures = steps_of(agent), random_batch(0, 3, 8, CELLS)
    as_steps = lambda obs: {"pixels": obs["pixels"].reshape(*steps.reward.shape, 5, 6, 2)}
    return steps._replace(obs=as_steps(pictures.obs), next_obs=as_steps(pictures.next_obs))


def by_hand(state, obs):
    """The values (..., A) of pictures, of the paper's layers by plain sums."""
    encoder, critic = state.nets["representation"].shared, state.nets["critic"].shared
    cells, dense, head = encoder["latent"]["params"]["Cells_0"], critic["body"]["params"]["MLP_0"], critic["head"]
    normed = lambda x: (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    x, kernel = np.asarray(obs["pixels"], float) / 255, np.asarray(cells["Conv_0"]["kernel"], float)
    place = lambda i, j: np.tensordot(x[..., i : i + 3, j : j + 3, :], kernel, 3)
    found = np.stack([np.stack([place(i, j) for j in range(4)], -2) for i in range(3)], -3)
    flat = np.maximum(normed(found), 0).reshape(*found.shape[:-3], -1)
    hidden = np.maximum(normed(flat @ np.asarray(dense["Dense_0"]["kernel"])), 0)
    return hidden @ np.asarray(head["kernel"]) + np.asarray(head["bias"])


def test_values_of_pictures_are_those_of_the_papers_network():
    """In acting and in targets, both by the present encoder; no projection and no slow copy stands between."""
    # Eight steps, in parts of three, which overlap.
    agent = small(q_lambda=0.0, gamma=0.9, minibatches=3, conditioning="none", **SEEING)
    state, steps = agent.init(CELLS, TASKS, KEY), seen_steps(agent)
    task, one = pick(TASKS, 1), jax.tree.map(lambda x: x[1, 2, 0], steps.obs)
    assert not state.slow and not jax.tree.leaves(state.nets["representation"].shared["projection"])
    acted = agent.act(state, agent.begin(state, task), one, task, None)
    np.testing.assert_allclose(acted.outputs, by_hand(state, one), atol=1e-4)
    found = agent.assess(state, steps, TASKS)[1].extras
    ahead = by_hand(state, jax.tree.map(np.asarray, steps.next_obs)).max(axis=-1)
    np.testing.assert_allclose(found, steps.reward + 0.9 * steps.discount * ahead, atol=1e-4)


def test_the_loss_of_values_trains_the_convolution():
    """An update moves each of its arrays, and the values that the next step acts by."""
    agent = small(**SEEING)
    state, steps = agent.init(CELLS, TASKS, KEY), seen_steps(agent)
    after, metrics = jax.jit(lambda state: learn(agent, state, steps, TASKS, KEY))(state)
    for name in ("representation", "critic"):
        moved = jax.tree.map(lambda x, y: bool(np.any(x != y)), after.nets[name].shared, state.nets[name].shared)
        assert all(jax.tree.leaves(moved)), (name, moved)
    assert np.all(np.isfinite(metrics["critic_loss"]))
    mixed = state.with_nets(representation=after.nets["representation"])
    task, obs = pick(TASKS, 0), jax.tree.map(lambda x: x[0, 0, 0], steps.obs)
    outputs = lambda state: np.asarray(agent.act(state, agent.begin(state, task), obs, task, None).outputs)
    assert np.abs(outputs(mixed) - outputs(state)).max() > 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("vision", [pytest.param("grid", marks=pytest.mark.nightly), "drq"])
def test_what_only_pictures_show_is_learned(vision):
    """The best of five actions, a task's scale times a sign that the picture shows; and that it is worth 0."""
    seeing = SEEING if vision == "grid" else {"representation": "encoded", "latent_widths": (16,)}
    given = {"num_envs": 16, "chunk_steps": 1600, "unroll": 8, "epochs": 4, "minibatches": 4, "gamma": GAMMA}
    given |= {"epsilon": 0.3, "epsilon_rollouts": 40, "q_lambda": 0.0, "critic_lr": 3e-3}
    env, tasks = SeenChoices("by-both"), tasks_of("by-both", SCALES)
    agent = for_action(tiny("pqn", hidden=(32,), **seeing), Discrete(5))
    state = only_seed(train(env, agent, given, tasks=tasks)[0].agent)
    for i, scale in enumerate(SCALES):
        for sign in (-1.0, 1.0):
            step = env.show(env.reset(pick(tasks, i), KEY)._replace(obs=jnp.float32([sign])))
            task, obs = pick(tasks, i), frames.begin(step.obs, env.frames)
            values = np.asarray(agent.act(state, agent.begin(state, task), obs, task, None).outputs)
            assert (values.argmax() - 2) / 2 == scale * sign and values.max() == pytest.approx(0, abs=0.15)
