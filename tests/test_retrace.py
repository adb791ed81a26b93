"""Retrace in agents with a replay: what is kept, what the targets of windows are, and who cannot have it."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Walk, of_task, pick, quick, random_batch, slow_but, tasks_of, tiny, train, train_objects

from mtjax.agents import replay_batches
from mtjax.agents.networks import Params
from mtjax.agents.parts.policies import Taken
from mtjax.config import configure
from mtjax.experience.replay import Replay
from mtjax.learning import loop
from mtjax.types import InputError, Spec

SPEC, TASKS, KEY = Spec.vector(3, 2, 1), tasks_of("one-step"), jax.random.key(0)
BATCH, LENGTH = 3, 5
SHORT = {"num_envs": 2, "batch_size": 4, "replay_size": 40, "warmup_steps": 8, "chunk_steps": 16}


def tracing(name, lambda_=0.8, **settings):
    return tiny(name, target="retrace", retrace_steps=LENGTH, retrace_lambda=lambda_, **settings)


def windows():
    """Windows (T, B, L, ...) in which some steps terminate, some are cut off, and some were not drawn by the policy."""
    random = np.random.default_rng(0)
    steps = [random_batch(i, 2, BATCH, SPEC) for i in range(LENGTH)]
    steps = jax.tree.map(lambda *x: jnp.stack(x, axis=2), *steps)
    shape = steps.reward.shape
    cut = (steps.discount == 0) | (random.random(shape) < 0.15)
    raw = jnp.arctanh(steps.action)
    raw = raw.at[:, 0, 1].add(0.5)  # a random action was taken instead
    kept = Taken(raw, jnp.float32(random.normal(size=shape) - 1))
    return steps._replace(ended=cut, closed=cut, cut=cut, extras=kept)


def made(agent):
    """A state whose actor has moved on from where its slow critics are, and temperatures of 0.3 and 0.7."""
    state = agent.init(SPEC, TASKS, KEY)
    temperature = Params({}, {"log": jnp.log(jnp.float32([0.3, 0.7]))})
    slow = jax.tree.map(lambda x: 0.9 * x, state.slow)
    return state.with_nets(temperature=temperature)._replace(slow=slow)


def targets_of(agent, steps):
    """The batch (T, N, ...), and the values (T, N) that its targets stand for."""
    state = made(agent)

    def compute(steps):
        batch, target = replay_batches.critic_data(
            agent, state, replay_batches.prepare(agent, state, steps, TASKS), KEY
        )
        return batch, jax.vmap(agent.value.expected)(getattr(target, "target", target))

    return quick(compute, steps)(steps)


@pytest.mark.slow
def test_targets_are_those_worked_step_by_step():
    """Soft values after steps, plain ones of actions, the lower critic, ratios up to 1, and no sum over ends."""
    agent, steps = tracing("sac-conditioned"), windows()
    state, (batch, found) = made(agent), targets_of(agent, steps)
    representation, slow = state.nets["representation"], state.slow["representation"]
    keys = agent.representation.targets(representation, slow, batch.next_obs, KEY)[1]
    assert np.any(steps.cut & (steps.discount == 1)) and np.any(steps.discount == 0) and not np.all(steps.cut)
    for task in range(2):
        nets, one = of_task(state.nets, task), pick(batch, task)
        older = nets | of_task(state.slow, task)
        action, _, log_prob = agent.policy.draw(
            agent.policy_outputs(nets, one.features, one.next_obs), None, keys[task]
        )
        q = np.min(agent.values(older, one.features, one.obs, one.action), axis=0)
        ahead = np.min(agent.values(older, one.features, one.next_obs, action), axis=0)
        ahead = (ahead - [0.3, 0.7][task] * log_prob).reshape(BATCH, LENGTH)
        now = agent.policy.log_prob(
            agent.policy_outputs(nets, one.features, one.obs), steps.extras.raw[task].reshape(-1, 2)
        )
        ratio = np.exp(now.reshape(BATCH, LENGTH) - steps.extras.log_prob[task])
        ratio[0, 1] = 0
        q, expected = q.reshape(BATCH, LENGTH), np.zeros((BATCH, LENGTH))
        for b in range(BATCH):
            for t in reversed(range(LENGTH)):
                later = 0.0
                if t + 1 < LENGTH and not steps.cut[task, b, t]:
                    later = 0.8 * min(1, ratio[b, t + 1]) * (expected[b, t + 1] - q[b, t + 1])
                discount = 0.99 * steps.discount[task, b, t]
                expected[b, t] = steps.reward[task, b, t] + discount * (ahead[b, t] + later)
        np.testing.assert_allclose(found[task].reshape(BATCH, LENGTH), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", slow_but(["sac", "distral", "brc", "xqc", "multi-head"], "sac"))
def test_with_lambda_0_targets_are_those_of_td(name):
    """In every variant; with 0.8 they are not."""
    steps, given = windows(), {"value_low": -20.0, "value_high": 20.0} if name in ("brc", "xqc") else {}
    single = jax.tree.map(lambda x: x.reshape(2, BATCH * LENGTH, 1, *x.shape[3:]), steps._replace(extras=None))
    _, expected = targets_of(tiny(name, **given), single)
    _, found = targets_of(tracing(name, 0.0, **given), steps)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
    assert not np.allclose(targets_of(tracing(name, **given), steps)[1], expected, atol=1e-3)


def test_only_retrace_keeps_what_it_needs():
    """Three numbers a step for an action of two; other agents store what they did."""
    kept = lambda agent: jax.eval_shape(partial(state_of, agent)).data.ring.rows.extras
    assert kept(tiny("sac")) is None
    assert jax.tree.map(lambda x: x.shape[4:], kept(tracing("sac"))) == Taken((1,), ())


def state_of(agent):
    agent, settings = configure(agent, loop.Settings(stagger=False), SHORT)
    return loop.init(Walk(), agent, settings, Walk().tasks(), jnp.zeros(1, jnp.uint32))


@pytest.mark.slow
def test_actions_that_the_policy_did_not_draw_are_known():
    """The random ones of the warm-up, by what the replay holds of a run."""
    state, (metrics,) = train(Walk(), tracing("sac"), SHORT, seeds=(0, 1))
    rows = state.data.ring.rows
    drawn = np.all(np.abs(np.tanh(rows.extras.raw) - rows.action) < replay_batches._ROUNDING, axis=-1)
    assert np.mean(drawn[:, :, :8]) < 0.05 and np.all(drawn[:, :, 8:16])
    assert np.all(np.isfinite(rows.extras.log_prob)) and np.all(np.isfinite(metrics["critic_loss"]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("sac", {"conditioning": "inferred", "inferred_from": 2}),
        ("sac", {"conditioning": "recurrent", "recurrent_steps": 3, "burn_in": 2}),
        ("deepmdp", {}),
        ("distral", {}),
        ("xqc", {}),
    ],
)
def test_variants_learn_from_windows(name, settings):
    """The whole update runs, for two seeds in one program."""
    _, (metrics,) = train(Walk(), tracing(name, **settings), SHORT, seeds=(0, 1))
    assert np.all(metrics["bad_step"] == -1) and np.all(np.isfinite(metrics["critic_loss"]))


@pytest.mark.slow
def test_a_run_goes_on_bit_for_bit(tmp_path):
    """Log-probabilities are in the checkpoint."""

    def play(name, steps, **more):
        (tmp_path / name).mkdir(exist_ok=True)
        plan = {"steps": steps, "eval_every": 0, "eval_episodes": 1}
        return train_objects(Walk(), tracing("sac"), directory=tmp_path / name, **SHORT, **plan, **more)

    whole = play("whole", 128)
    assert play("broken", 64).state.iteration == 16
    resumed = play("broken", 128, resume=True)
    plain = lambda x: np.asarray(jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(plain(x), plain(y)), resumed.state, whole.state)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"experience": Replay(n_step=3)}, "target=retrace needs n-step=1, hindsight=0 and host-replay-size=0"),
        ({"experience": Replay(hindsight=0.5)}, "target=retrace needs n-step=1, hindsight=0"),
        ({"experience": Replay(host_replay_size=200_000)}, "target=retrace needs n-step=1, hindsight=0"),
        ({"experience": Replay(warmup_steps=3)}, "retrace-steps=5 needs .* warmup-steps of at least 4, not 3"),
        ({"lambda_": 1.5}, r"retrace-lambda must be in \[0, 1\], not 1.5"),
    ],
)
def test_what_cannot_be_right_is_refused(settings, message):
    """Before anything compiles."""
    with pytest.raises(InputError, match=message):
        tracing("sac", **settings)


def test_agents_without_a_replay_have_no_such_setting():
    with pytest.raises(InputError, match="unknown setting of ppo 'target'"):
        tiny("ppo", target="retrace")


def test_pictures_are_refused():
    pixels = Spec({"pixels": jax.ShapeDtypeStruct((64, 64, 3), jnp.uint8)}, SPEC.action, 1, frames=1)
    with pytest.raises(InputError, match="target=retrace sums over windows of vectors, not pictures; use target=td"):
        tracing("sac", representation="encoded").init(pixels, TASKS, KEY)
