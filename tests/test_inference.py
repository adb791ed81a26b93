"""What is inferred from the last steps: what is remembered, how it is encoded, and that hidden tasks are learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import probes
import pytest
from probes import Probe, Walk, learner, only_seed, pick, quick, random_batch, tasks_of, tiny, train

import mtjax
import mtjax.train
from mtjax.agents.parts.knowing.last_steps import Past, Seen, TrajectoryEncoder, append
from mtjax.learning import evaluation
from mtjax.types import Spec, Transition

SPEC, STEPS = Spec.vector(3, 2, 1), 4
PLAIN = Spec.vector(1, 1, 1)
INFERRED = {"conditioning": "inferred", "inferred_from": STEPS}


def random_seen(seed, *lead, obs=3, action=2, steps=STEPS):
    random = np.random.default_rng(seed)
    normal = lambda *shape: np.float32(random.normal(size=(*lead, *shape)))
    known = np.float32(random.random((*lead, steps)) < 0.5)
    return Seen(normal(obs), Past(normal(steps, obs), normal(steps, action), normal(steps), known))


# What is remembered.


def test_the_past_by_hand_over_an_episode():
    """Zeros before the episode, then its last three steps, each with the observation in which it was taken."""
    agent, tasks = tiny("sac", conditioning="inferred", inferred_from=3), tasks_of("one-step")
    state = jax.eval_shape(lambda: agent.init(PLAIN, tasks, jax.random.key(0)))
    state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), state)
    env, task, taken = Walk(), pick(tasks, 1), []
    now, memory = env.reset(task, jax.random.key(0)), agent.begin(state, task)
    for action in np.float32([[0.1], [-0.2], [0.3], [-0.4], [0.5]]):
        last = taken[-3:]
        rows = np.stack([np.zeros(4, np.float32)] * (3 - len(last)) + [np.float32([*o, *a, r, 1]) for o, a, r in last])
        for field, expected in zip(memory.past, (rows[:, :1], rows[:, 1:2], rows[:, 2], rows[:, 3]), strict=True):
            np.testing.assert_array_equal(field, expected)
        after = env.step(task, now.state, action)
        taken.append((now.obs, action, after.reward))
        step = Transition(now.obs, action, after.reward, 1.0, after.obs)
        memory, now = agent.remember(state, memory, step, task), after
    assert np.all(agent.begin(state, task).past.known == 0)


def test_who_infers_nothing_remembers_nothing():
    """No past is stored for it."""
    agent, tasks = tiny("sac"), tasks_of("one-step")
    state = jax.eval_shape(lambda: agent.init(SPEC, tasks, jax.random.key(0)))
    assert not jax.tree.leaves(agent.begin(state, tasks)) and agent.view.history == 0
    assert tiny("sac", **INFERRED).view.history == STEPS


@pytest.mark.slow
def test_the_loop_stores_what_was_seen():
    """Every row remembers as many steps as its episode has had, at most all; these are the rows stored before it."""
    settings = {"num_envs": 2, "updates_per_step": 0, "replay_size": 60, "warmup_steps": 1, "chunk_steps": 20}
    agent = tiny("sac", conditioning="inferred", inferred_from=3)
    state, _ = train(Walk(), agent, settings, seeds=(0, 1))
    rows = jax.tree.map(lambda x: np.moveaxis(np.asarray(x)[:, :, :20], 2, 3), state.data.ring.rows)  # (S, T, E, H, .)
    then = jax.tree.map(np.asarray, append(rows.memory.past, rows.obs, rows.action, rows.reward))
    age = np.floor(rows.obs[..., 0])
    np.testing.assert_array_equal(rows.memory.past.known.sum(axis=-1), np.minimum(age, 3))
    np.testing.assert_array_equal(then.known.sum(axis=-1), np.minimum(age + 1, 3))
    taken = (rows.obs, rows.action, rows.reward)
    for past, first in ((rows.memory.past, 1), (then, 0)):
        for back in range(3):
            lag, place = back + first, 2 - back  # so many rows ago, and where it is remembered
            known = past.known[..., place][..., lag:] == 1
            assert known.any() and known.all() == (lag == 0)
            for field, rows_of in zip(past[:3], taken, strict=True):
                remembered = field[..., place] if field.ndim == 5 else field[..., place, :]
                earlier = rows_of[:, :, :, : 20 - lag]
                np.testing.assert_array_equal(remembered[:, :, :, lag:][known], earlier[known])


# What is made of it.


def test_the_encoder_averages_what_an_mlp_makes_of_the_known_steps():
    """By plain NumPy: each step with the change of state that followed; and only the bias where none is known."""
    seen, module = random_seen(0, 8), TrajectoryEncoder(5, (6, 7))
    seen.past.known[0] = 0
    params = jax.eval_shape(module.init, jax.random.key(0), seen)
    params = jax.tree.map(lambda x: np.float32(np.random.default_rng(1).normal(size=x.shape)), params)
    found, layers = quick(module.apply, params, seen)(params, seen), params["params"]
    dense = lambda x, layer: x @ layer["kernel"] + layer["bias"]
    for i in range(8):
        past, rows = jax.tree.map(lambda x, i=i: x[i], seen.past), [np.zeros((0, 7))]
        for t in np.flatnonzero(past.known):
            change = (past.obs[t + 1] if t + 1 < STEPS else seen.obs[i]) - past.obs[t]
            x = np.concatenate([past.obs[t], past.action[t], past.reward[t : t + 1], change])
            for layer in range(2):
                x = dense(x, layers["MLP_0"][f"Dense_{layer}"])
                scale, bias = (layers["MLP_0"][f"LayerNorm_{layer}"][name] for name in ("scale", "bias"))
                x = np.maximum(scale * (x - x.mean()) / np.sqrt(x.var() + 1e-6) + bias, 0)
            rows.append(x[None])
        mean = np.sum(np.concatenate(rows), axis=0) / max(len(rows) - 1, 1)
        np.testing.assert_allclose(found[i], dense(mean, layers["Dense_0"]), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found[0], layers["Dense_0"]["bias"], rtol=1e-6)


@pytest.mark.slow
def test_networks_share_an_encoder_of_trajectories_that_learns():
    """All of its leaves move, and its slow copy's too; if tasks share nothing, they do not share it either."""
    agent, tasks = tiny("sac", normalize_observations=True, **INFERRED), tasks_of("one-step")
    init, update = learner(agent, tasks, 4, SPEC)
    before = state = init(tasks, jax.random.key(0))
    for i in range(3):
        batch = random_batch(i, 2, 4, SPEC, STEPS)
        state = probes.observe(agent, state, batch, tasks)
        state, metrics = update(state, batch, tasks, jax.random.key(i))
        if not i:
            assert_scaled(agent, state, batch)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((state, metrics)))
    for nets in ("nets", "slow"):
        old, new = (getattr(x, nets)["knowing"].shared["trajectory"] for x in (before, state))
        moved = jax.tree.map(lambda a, b: not np.array_equal(a, b), old, new)
        assert all(jax.tree.leaves(moved)), nets
    alone = jax.eval_shape(lambda: tiny("disjoint", **INFERRED).init(SPEC, tasks, jax.random.key(0))).nets
    assert not alone["actor"].shared and not alone["knowing"].shared
    assert all(len(x) == 2 for x in jax.tree.leaves(alone["knowing"].own["trajectory"]))


def assert_scaled(agent, state, batch):
    """Present and past observations by the moments of present ones; actions, rewards and what is known as they are."""
    obs = np.asarray(batch.obs).reshape(-1, 3)
    scale = lambda x: (x - obs.mean(axis=0)) / obs.std(axis=0)
    inputs, past = state.nets["inputs"], batch.memory.past
    np.testing.assert_allclose(inputs.parts["moments"].mean, obs.mean(axis=0), rtol=1e-4, atol=1e-6)
    seen = agent.view.see(inputs, batch.obs, past)
    np.testing.assert_allclose(seen.obs, scale(batch.obs), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(seen.past.obs, scale(past.obs), rtol=1e-3, atol=1e-4)
    for field in ("action", "reward", "known"):
        np.testing.assert_array_equal(getattr(seen.past, field), getattr(past, field))


# A hidden task.

SECRETS = (0.7, -0.7)


@dataclasses.dataclass(frozen=True)
class Hidden(Probe):
    """The observation is always 0, and only the reward tells the task: scale / 2 - (action - scale)^2."""

    episode_length: int = 4

    def tasks(self, split="train"):
        tasks = tasks_of("one-step", SECRETS, self.episode_length)
        if split == "train":
            return tasks
        unseen = jnp.arange(2, 4, dtype=jnp.int32)  # of the same secrets, with contexts of the other one
        return tasks._replace(id=unseen, row=unseen, context=-tasks.context)

    def rules(self, task, state, action):
        scale = task.goal["scale"]
        return scale / 2 - jnp.square(action - scale), 0.0, False


def learned(conditioning):
    """Train, and return agent, environment and the learner's states."""
    inference = {"conditioning": conditioning}
    inference |= {"embedding_size": 4, "inferred_from": 2} if conditioning == "inferred" else {}
    plain = {"initial_temperature": 1e-6, "temperature_lr": 1e-9, "gamma": 0.5, "tau": 0.3}
    agent = tiny("sac", **inference, num_critics=1, hidden=(32,), actor_lr=3e-3, critic_lr=3e-3, **plain)
    settings = {"num_envs": 8, "updates_per_step": 4, "batch_size": 64, "warmup_steps": 150, "warmup_hold": 1}
    return agent, Hidden(), train(Hidden(), agent, settings | {"chunk_steps": 400})[0].agent


def returns(agent, env, states, split):
    tasks, seeds = env.tasks(split), jnp.zeros(1, jnp.uint32)
    score = lambda *inputs: evaluation.evaluate(env, agent, evaluation.Episodes(2), *inputs)
    score = quick(score, states, tasks, seeds, jnp.int32(0))
    return np.asarray(score(states, tasks, seeds, jnp.int32(0)).returns)[0]


@pytest.mark.nightly
def test_a_hidden_task_is_told_by_its_rewards():
    """Who remembers acts right from the second step on, also in tasks it has not seen; who does not, never can.

    Without the first reward the best action is 0, which costs scale^2; after it nothing is lost.
    """
    bonus, loss = 4 * np.float32(SECRETS) / 2, 0.49
    agent, env, states = learned("inferred")
    for split in ("train", "unseen"):
        np.testing.assert_allclose(np.mean(returns(agent, env, states, split).T - bonus), -loss, atol=0.3)
    blind, plain, others = learned("none")
    assert np.mean(returns(blind, plain, others, "train").T - bonus) < -3.5 * loss

    # By hand: at first the same in both tasks, and after one reward the task's own, whatever the task's number says.
    state, tasks = only_seed(states), env.tasks()
    step, act_on = (
        jax.jit(env.step),
        jax.jit(lambda memory, obs, task: agent.act(state, memory, obs, task, None).action),
    )
    first = [env.reset(pick(tasks, i), jax.random.key(0)) for i in range(2)]
    blank = agent.begin(state, pick(tasks, 0))
    actions = [act_on(blank, first[i].obs, pick(tasks, i)) for i in range(2)]
    np.testing.assert_array_equal(*actions)
    for i, secret in enumerate(SECRETS):
        second = step(pick(tasks, i), first[i].state, actions[i])
        taken = Transition(first[i].obs, actions[i], second.reward, 1.0, second.obs)
        memory = agent.remember(state, blank, taken, pick(tasks, i))
        for asked in (0, 1):
            np.testing.assert_allclose(act_on(memory, second.obs, pick(tasks, asked)), secret, atol=0.3)


# A whole run.


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run that infers its tasks, with hindsight."""
    runs = tmp_path_factory.mktemp("runs")
    words = (
        "--env=point-mass-vary-goal --env.num-tasks=3 --engine=c --agent=sac --agent.conditioning=inferred "
        "--agent.inferred-from=3 --agent.hidden 8 --steps=300 --eval-episodes=1 --num-envs=2 --batch-size=4 "
        "--replay-size=200 --warmup-steps=5 --hindsight=0.5 --agent.embedding-size=4"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MTJAX_CACHE", "0")
        mtjax.train.main([*words.split(), f"--runs={runs}"])
    (directory,) = runs.iterdir()
    return directory


@pytest.mark.slow
def test_a_run_is_loaded_with_its_past(run):
    """The policy remembers; without a memory, an episode counts as just begun. Films play it from there."""
    policy = mtjax.load(run)
    task = pick(policy.env.tasks("interpolation"), 0)
    start, memory = policy.env.reset(task, jax.random.key(0)), policy.begin(task)
    first = policy(start.obs, task, memory=memory)
    np.testing.assert_array_equal(first, policy(start.obs, task))
    after = policy.env.step(task, start.state, first)
    memory = policy.remember(memory, task, start.obs, first, after.reward, after.obs)
    rewards = lambda i: memory._replace(past=memory.past._replace(reward=memory.past.reward.at[i].add(5.0)))
    action = policy(after.obs, task, memory=memory)
    np.testing.assert_array_equal(policy(after.obs, task, memory=rewards(0)), action)  # from before the episode
    assert not np.array_equal(policy(after.obs, task, memory=rewards(-1)), action)

    played = evaluation.record(policy.env, policy.agent, policy.state, pick(policy.env.tasks(), [0]), 0)
    assert played.kept.qpos.shape == (1, 100, 2) and played.rows.shape == (1,) and played.lengths[0, 0] == 100
