"""Observations with the last steps: what they show, how they are encoded, and that hidden tasks are learned by them."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Probe, Walk, learner, only_seed, pick, quick, random_batch, tasks_of, tiny, train

import mtjax
import mtjax.train
from mtjax import evaluation, history
from mtjax.agents.parts.trajectory import TrajectoryEncoder
from mtjax.history import History, Past, Seen, remember, unpack, widen
from mtjax.loop import Settings
from mtjax.types import InputError, Spec

SPEC, STEPS = Spec(3, 2, 1), 4
WIDE = widen(SPEC, STEPS)
INFERRED = {"conditioning": "inferred", "inferred_from": STEPS}


def random_seen(seed, *lead, obs=3, action=2, steps=STEPS):
    random = np.random.default_rng(seed)
    normal = lambda *shape: np.float32(random.normal(size=(*lead, *shape)))
    known = np.float32(random.random((*lead, steps)) < 0.5)
    return Seen(normal(obs), Past(normal(steps, obs), normal(steps, action), normal(steps), known))


# What is shown.


@pytest.mark.parametrize("lead", [(), (5,), (2, 5)])
def test_what_is_packed_is_unpacked(lead):
    """Whatever the leading axes; and the sizes say how long it is."""
    seen = random_seen(0, *lead)
    packed = history.pack(seen)
    assert packed.shape == (*lead, WIDE.obs_size) and WIDE.obs_size == 3 + 4 * (3 + 2 + 2)
    for a, b in zip(jax.tree.leaves(unpack(packed, 3, STEPS)), jax.tree.leaves(seen), strict=True):
        np.testing.assert_array_equal(a, b)
    assert history.plain_obs_size(WIDE) == 3 and WIDE.history == STEPS
    assert widen(SPEC, 0) == SPEC and history.plain_obs_size(SPEC) == 3


def test_the_past_by_hand_over_an_episode_and_a_reset():
    """Zeros before the episode, then its last three steps, each with the observation in which it was taken."""
    env, task, key = History(Walk(), 3), pick(tasks_of("one-step"), 1), jax.random.key(0)
    step, taken = jax.jit(env.step), []
    now, actions = env.reset(task, key), np.float32([[0.1], [-0.2], [0.3], [-0.4], [0.5]])
    plain = Walk().reset(task, key).obs
    for action in [*actions, None]:
        last = taken[-3:]
        blank = [np.zeros(4, np.float32)] * (3 - len(last))
        rows = np.stack(blank + [np.float32([*o, *a, r, 1]) for o, a, r in last])
        expected = np.concatenate([plain, rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3]])
        np.testing.assert_array_equal(now.obs, expected)
        if action is None:
            break
        after = step(task, now.state, action)
        inner = Walk().step(task, now.state.world, action)
        np.testing.assert_array_equal(after.reward, inner.reward)
        np.testing.assert_array_equal(after.terminated, inner.terminated)
        taken.append((plain, action, after.reward))
        now, plain = after, inner.obs
    again = unpack(env.reset(task, jax.random.key(1)).obs, 1, 3)
    assert all(np.all(np.asarray(x) == 0) for x in again.past) and again.obs != plain


def test_the_wrapper_is_the_family_in_all_else():
    """What is not about observations is the family's own; and it can be a static argument, copied and hashed."""
    env = mtjax.make("control-cartpole")
    wrapped = remember(env, 2)
    assert wrapped.spec == Spec(4 + 2 * (4 + 1 + 2), 1, env.spec.context_size, history=2)
    assert wrapped.episode_length == env.episode_length and wrapped.engine_name == env.engine_name
    assert wrapped.describe(0) == env.describe(0) and wrapped.table is env.table
    np.testing.assert_array_equal(wrapped.task_values("train"), env.task_values("train"))
    assert copy.deepcopy(wrapped) == wrapped == History(env, 2) and hash(wrapped) == hash(History(env, 2))
    assert History(env, 3) != wrapped
    assert remember(env, 0) is env and remember(wrapped, 2) is wrapped
    assert history.forget(wrapped) is env is history.forget(env)
    with pytest.raises(InputError, match="shows 2 past steps already, and the agent needs 3"):
        remember(wrapped, 3)


@dataclasses.dataclass(frozen=True)
class Idle:
    """Acts at random and learns nothing."""

    gamma: float = 0.9
    watches: bool = False
    history: int = 3

    def init(self, spec, tasks, key):
        return jnp.zeros(1)

    def act(self, state, obs, task, key):
        return jax.random.uniform(key, (1,))


def test_the_loop_stores_what_was_seen():
    """Every row remembers as many steps as its episode has had, at most all; these are the rows stored before it."""
    settings = Settings(num_envs=2, updates_per_step=0, replay_size=60, warmup_steps=1, chunk_steps=20)
    state, _ = train(History(Walk(), 3), Idle(), settings, seeds=(0, 1))
    rows = jax.tree.map(lambda x: np.moveaxis(np.asarray(x)[:, :, :20], 2, 3), state.replay.rows)  # (S, T, E, H, ...)
    now, then = (jax.tree.map(np.asarray, unpack(x, 1, 3)) for x in (rows.obs, rows.next_obs))
    age = np.floor(now.obs[..., 0])
    np.testing.assert_array_equal(now.past.known.sum(axis=-1), np.minimum(age, 3))
    np.testing.assert_array_equal(then.past.known.sum(axis=-1), np.minimum(age + 1, 3))
    taken = (now.obs, rows.action, rows.reward)
    for past, first in ((now.past, 1), (then.past, 0)):
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
            for layer in ("Dense_0", "Dense_1"):
                x = np.maximum(dense(x, layers["MLP_0"][layer]), 0)
            rows.append(x[None])
        mean = np.sum(np.concatenate(rows), axis=0) / max(len(rows) - 1, 1)
        np.testing.assert_allclose(found[i], dense(mean, layers["Dense_0"]), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found[0], layers["Dense_0"]["bias"], rtol=1e-6)


def test_only_an_inferring_agent_needs_the_past_and_says_so():
    """An agent whose family does not show the steps, or not as many, fails where it is made, naming the fix."""
    key, tasks = jax.random.key(0), tasks_of("one-step")
    for spec, shown in ((SPEC, 0), (widen(SPEC, 2), 2)):
        with pytest.raises(InputError, match=rf"show the last 4 steps, and these show {shown}; .*remember\(env"):
            tiny("sac", **INFERRED).init(spec, tasks, key)
    assert tiny("sac").history == 0 and tiny("sac", **INFERRED).history == STEPS
    jax.eval_shape(lambda: tiny("sac").init(WIDE, tasks, key))  # may look at the past as at any other observation


def test_every_network_has_an_encoder_of_trajectories_that_learns():
    """All of its leaves move, in actor and critics; if tasks share nothing, they do not share it either."""
    agent, tasks = tiny("sac", normalize_observations=True, **INFERRED), tasks_of("one-step")
    init, update = learner(agent, tasks, 4, WIDE)
    before = state = init(tasks, jax.random.key(0))
    for i in range(3):
        batch = random_batch(i, 2, 4, WIDE)
        state, metrics = update(state, batch, tasks, jax.random.key(i))
        if not i:
            assert_scaled(agent, state, batch)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves((state, metrics)))
    for network in ("actor", "critic", "target"):
        old, new = (getattr(x, network).shared["trajectory"] for x in (before, state))
        moved = jax.tree.map(lambda a, b: not np.array_equal(a, b), old, new)
        assert all(jax.tree.leaves(moved)), network
    alone = jax.eval_shape(lambda: tiny("disjoint", **INFERRED).init(WIDE, tasks, jax.random.key(0)))
    assert not alone.actor.shared and all(len(x) == 2 for x in jax.tree.leaves(alone.actor.own["trajectory"]))


def assert_scaled(agent, state, batch):
    """Present and past observations by the moments of present ones; actions, rewards and what is known as they are."""
    obs = np.asarray(batch.obs[..., :3]).reshape(-1, 3)
    scale = lambda x: (x - obs.mean(axis=0)) / obs.std(axis=0)
    np.testing.assert_allclose(state.moments.mean, obs.mean(axis=0), rtol=1e-4, atol=1e-6)
    seen, raw = agent._see(state.moments, batch.obs), unpack(batch.obs, 3, STEPS)
    np.testing.assert_allclose(seen.obs, scale(raw.obs), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(seen.past.obs, scale(raw.past.obs), rtol=1e-3, atol=1e-4)
    for field in ("action", "reward", "known"):
        np.testing.assert_array_equal(getattr(seen.past, field), getattr(raw.past, field))


# A hidden task.

SECRETS = (0.7, -0.7)


@dataclasses.dataclass(frozen=True)
class Hidden(Probe):
    """The observation is always 0, and only the reward tells the task: scale / 2 - (action - scale)^2."""

    episode_length: int = 4

    def tasks(self, split="train"):
        tasks = tasks_of("one-step", SECRETS)
        if split == "train":
            return tasks
        unseen = jnp.arange(2, 4, dtype=jnp.int32)  # of the same secrets, with contexts of the other one
        return tasks._replace(id=unseen, row=unseen, context=-tasks.context)

    def rules(self, task, state, action):
        scale = task.goal["scale"]
        return scale / 2 - jnp.square(action - scale), 0.0, False


def learned(conditioning):
    """Train, and return agent, environment and the learner's states."""
    told = {"conditioning": conditioning, "embedding_size": 4}
    plain = {"initial_temperature": 1e-6, "temperature_lr": 1e-9, "gamma": 0.5, "tau": 0.3}
    agent = tiny("sac", **told, inferred_from=2, num_critics=1, hidden=(32,), actor_lr=3e-3, critic_lr=3e-3, **plain)
    env = remember(Hidden(), agent.history)
    settings = Settings(num_envs=8, updates_per_step=4, batch_size=64, warmup_steps=150, warmup_hold=1, chunk_steps=400)
    return agent, env, train(env, agent, settings)[0].agent


def returns(agent, env, states, split):
    tasks, seeds = env.tasks(split), jnp.zeros(1, jnp.uint32)
    score = quick(lambda *inputs: evaluation.evaluate(env, agent, 2, *inputs), states, tasks, seeds, jnp.int32(0))
    return np.asarray(score(states, tasks, seeds, jnp.int32(0)))[0]


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
    step, act = jax.jit(env.step), jax.jit(lambda obs, task: agent.act(state, obs, task, None))
    first = [env.reset(pick(tasks, i), jax.random.key(0)) for i in range(2)]
    actions = [act(first[i].obs, pick(tasks, i)) for i in range(2)]
    np.testing.assert_array_equal(*actions)
    for i, secret in enumerate(SECRETS):
        second = step(pick(tasks, i), first[i].state, actions[i])
        for asked in (0, 1):
            np.testing.assert_allclose(act(second.obs, pick(tasks, asked)), secret, atol=0.3)


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


def test_a_run_is_loaded_with_its_past(run):
    """Its environment shows the steps that its agent looks at; scores, films and Gymnasium take it from there."""
    from mtjax.gym.env import FamilyEnv

    policy = mtjax.load(run)
    assert policy.env == History(policy.family, 3) and policy.family.spec.obs_size == 4
    task = pick(policy.env.tasks("interpolation"), 0)
    start = policy.env.reset(task, jax.random.key(0))
    after = policy.env.step(task, start.state, policy(start.obs, task))
    assert start.obs.shape == (4 + 3 * (4 + 2 + 2),)
    rewards = lambda i: history.pack(seen._replace(past=seen.past._replace(reward=seen.past.reward.at[i].add(5.0))))
    seen, action = unpack(after.obs, 4, 3), policy(after.obs, task)
    np.testing.assert_array_equal(policy(rewards(0), task), action)  # from before the episode
    assert not np.array_equal(policy(rewards(-1), task), action)

    _, rows, states = evaluation.record(policy.env, policy.agent, policy.state, pick(policy.env.tasks(), [0]), 0)
    assert states.world.qpos.shape == (1, 100, 2) and rows.shape == (1,)
    world = FamilyEnv(policy.env)
    obs, _ = world.reset(seed=0)
    assert obs["env_obs"].shape == (28,) and world.step(np.zeros(2))[0]["env_obs"][-1] == 1
