"""Ways to remember tasks of a sequence, through the agent: what is held, what is frozen, and how a run resumes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, Walk, configure, param, pick, prepare, random_batch, tiny

import mtjax
from mtjax.agents import task_changes
from mtjax.agents.networks import Params
from mtjax.agents.parts import continual, forgetting, put
from mtjax.agents.parts.policies import Gaussian
from mtjax.agents.state import of_task
from mtjax.command import run_config
from mtjax.learning import combinations, loop
from mtjax.learning.loop import Settings
from mtjax.types import InputError

GIVEN = {"num_envs": 2, "chunk_steps": 8, "stagger": False, "batch_size": 4, "replay_size": 64, "warmup_steps": 2}
TASKS = jax.tree.map(lambda x: jnp.stack([x[0], x[1], x[0]]), Walk().tasks())._replace(
    id=jnp.arange(3), context=jnp.float32([[0.0], [1.0], [2.0]])
)


def states(name, chunks=3, seeds=(0, 1), learner="sac-conditioned", given=GIVEN, **settings):
    """The agents' states (S, ...) after each of some chunks, each of which plays another task; and the agent."""
    agent, chosen = configure(tiny(learner, continual=name, **settings), Settings(curriculum="sequence:8"), given)
    seeds = jnp.asarray(seeds, jnp.uint32)
    state = loop.init.lower(Walk(), agent, chosen, TASKS, seeds).compile(QUICK)(TASKS, seeds)
    chunk, found = loop.run_chunk.lower(Walk(), agent, chosen, TASKS, state).compile(QUICK), []
    for _ in range(chunks):
        state, _ = chunk(TASKS, state)
        found.append(jax.device_get(state.agent))
    return found, agent


def outputs(agent, state, task, seed=0):
    """The actor's outputs in a task, of one seed, at fixed observations."""
    one = jax.tree.map(lambda x: x[seed], state)
    nets, given = of_task(one.nets, jnp.int32(task)), agent.view.features(one, jax.tree.map(lambda x: x[task], TASKS))
    return jax.vmap(lambda obs: agent.policy_outputs(nets, given, obs))(jnp.linspace(-2, 2, 7)[:, None])


@pytest.fixture(scope="module")
def packed():
    return states("packnet", 4, retrain_updates=3)


@pytest.mark.slow
def test_packnet_forgets_nothing_to_the_bit(packed):
    """Of a task, from where the next one begins on, though all of them learn; also when the first comes again."""
    (first, second, third, again), agent = packed
    for seed in (0, 1):
        for task, earlier, later in ((0, second, third), (0, second, again), (1, third, again)):
            before, after = outputs(agent, earlier, task, seed), outputs(agent, later, task, seed)
            np.testing.assert_array_equal(before, after)
        assert not np.array_equal(outputs(agent, first, 1, seed), outputs(agent, second, 1, seed))
        assert not np.array_equal(outputs(agent, second, 2, seed), outputs(agent, third, 2, seed))


@pytest.mark.slow
def test_packnet_numbers_tasks_as_they_end_and_shares_weights_out(packed):
    (first, second, third, again), _ = packed
    held = [state.nets["continual"] for state in (first, second, third, again)]
    assert [x.own["number"][0].tolist() for x in held] == [[0, 0, 0], [1, 0, 0], [1, 2, 0], [1, 2, 3]]
    kernel = [x.shared["owners"]["body"]["params"]["MLP_0"]["Dense_0"]["kernel"][0] for x in held]
    share = [[float(np.mean(x == task)) for task in range(4)] for x in kernel]
    np.testing.assert_allclose(
        share, [[1, 0, 0, 0], [2 / 3, 1 / 3, 0, 0], [1 / 3] * 3 + [0], [0] + [1 / 3] * 3], atol=0.021
    )
    assert not any(np.any(x.shared["retraining"]) for x in held)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, given",
    [("ewc", {"fisher_samples": 32}), *(param(case, slow=True) for case in (("l2", {}), ("mas", {"mas_samples": 32})))],
)
def test_a_penalty_holds_the_actor_with_which_each_task_ended(name, given):
    """Importances are not negative, not all zero, and add up; before the first task has ended they are 0."""
    found, _ = states(name, **given)
    anchors = [state.nets["continual"].shared["anchor"] for state in found]
    assert all(not np.any(x) for x in jax.tree.leaves(anchors[0].importance))
    for before, anchor in zip(found, anchors[1:], strict=False):
        jax.tree.map(np.testing.assert_array_equal, anchor.params, before.nets["actor"].shared)
    rise = jax.tree.leaves(jax.tree.map(np.subtract, anchors[2].importance, anchors[1].importance))
    assert all(np.all(x >= 0) for x in rise) and any(np.any(x > 0) for x in rise)
    if name == "l2":
        assert all(np.all(x == 1) for x in rise)


@pytest.mark.slow
def test_without_a_replay_the_task_that_ends_is_played_once_more():
    """PPO's Fisher information is of a last rollout, and the run goes on as if that had not been."""
    rollouts = {"num_envs": 2, "chunk_steps": 8, "unroll": 8, "epochs": 1, "minibatches": 1}
    given = {"learner": "ppo", "given": rollouts, "conditioning": "one-hot"}
    (first, second), _ = states("ewc", 2, fisher_samples=32, ewc_coefficient=0.0, **given)
    anchor = second.nets["continual"].shared["anchor"]
    jax.tree.map(np.testing.assert_array_equal, anchor.params, first.nets["actor"].shared)
    assert all(np.all(x >= 0) for x in jax.tree.leaves(anchor.importance)) and np.any(anchor.importance["head"]["bias"])
    (_, plain), _ = states("none", 2, **given)
    jax.tree.map(np.testing.assert_array_equal, second.nets["actor"], plain.nets["actor"])


@pytest.mark.slow
def test_a_clone_holds_what_the_actor_put_out_where_each_task_ended():
    """The penalty is 0 for that actor, and more for another one; of its own task none is stored while it is played."""
    (first, second, third), agent = states("clone", clone_samples=6, clone_batch=4, heads="per-task")
    known = [state.nets["continual"].shared["known"][0].tolist() for state in (first, second, third)]
    assert known == [[False] * 3, [True, False, False], [True, True, False]]
    one = lambda state: jax.tree.map(lambda x: jnp.asarray(x[0]), state.nets)
    held = one(second)["continual"].shared
    ended, inputs = of_task(one(first), jnp.int32(0)), jax.tree.map(lambda x: x[0], held["inputs"])
    outputs = jax.vmap(lambda *x: agent.actor.apply(ended["actor"], *x))(*inputs)
    np.testing.assert_allclose(held["outputs"][0], outputs, rtol=1e-5, atol=1e-6)
    assert np.any(outputs) and len(np.unique(inputs[1])) > 1
    penalty = lambda nets: float(agent.continual.penalty(nets, agent, jax.random.key(0)))
    playing = of_task(one(second), jnp.int32(1))
    same = playing | {"actor": playing["actor"]._replace(shared=ended["actor"].shared)}
    assert penalty(same) < 1e-6 < 1e-4 < penalty(playing)
    assert penalty(of_task(one(first), jnp.int32(1))) == 0 == penalty(of_task(one(second), jnp.int32(0)))


def test_the_penalty_is_a_part_of_the_actors_loss():
    """Of one parameter that lies 0.5 beside its anchor, at importance 3: 10 / 2 * 3 * 0.25."""
    way = continual.EWC(ewc_coefficient=10.0)
    actor = Params({"w": jnp.array([1.0])}, {})
    nets = {"actor": actor} | way.init(actor, 2, (), 2)
    penalty = lambda nets: float(way.penalty(nets, None, jax.random.key(0)))
    assert penalty(nets) == 0
    held = forgetting.Anchor({"w": jnp.array([0.5])}, {"w": jnp.array([3.0])})
    assert penalty(nets | {"continual": Params({"anchor": held}, {})}) == pytest.approx(3.75)
    agent = tiny("sac-conditioned", continual="ewc")
    state = agent.init(Walk().spec, TASKS, jax.random.key(0))
    seen = pick(prepare(agent, state, random_batch(0, 3, 4, Walk().spec), TASKS), 0)
    nets = of_task(state.nets, jnp.int32(0))
    strict = put(agent, continual=put(agent.continual, penalty=lambda *_: 7.0))
    (free, _), (held, aux) = (each.actor_loss(nets, seen, jax.random.key(1)) for each in (agent, strict))
    assert float(held - free) == pytest.approx(7.0)
    assert float(aux.metrics["actor_loss"]) == pytest.approx(float(free))


def test_the_information_of_a_policy_is_that_of_its_gaussian():
    """1 / s^2 of means; of outputs o for log deviations 2 (d log s / do)^2, with d log s / do = 3.5 (1 - tanh(o)^2)."""
    outputs = jnp.float32([0.3, -0.2, 0.1, -0.6])
    slope = 3.5 * (1 - np.tanh(outputs[2:]) ** 2)
    deviation = np.exp(-5 + 3.5 * (np.tanh(outputs[2:]) + 1))
    found = task_changes.information(Gaussian(), None, outputs)
    np.testing.assert_allclose(found, np.concatenate([deviation**-2.0, 2 * slope**2]), rtol=1e-4)


@pytest.mark.slow
def test_seeds_remember_apart(packed):
    """A seed of several is the seed alone, but for the order of sums."""
    (_, _, third, _), _ = packed
    alone, _ = states("packnet", 3, seeds=(1,), retrain_updates=3)
    close = lambda x, y: np.testing.assert_allclose(x[1], y[0], rtol=1e-4, atol=1e-5)
    jax.tree.map(close, third.nets, alone[2].nets)


@pytest.mark.slow
def test_optimisers_begin_anew_where_a_task_ends():
    """Their counts are of the updates since then: six for the eight steps of a task, of which two are random."""
    count = lambda state: max(
        int(x.max()) for x in jax.tree.leaves(state.fits["critic"].optimizer) if x.dtype == np.int32
    )
    kept, _ = states("none", 2)
    fresh, _ = states("none", 2, reset_optimizer=True)
    assert [count(state) for state in (*kept, *fresh)] == [6, 12, 6, 6]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, given",
    [
        ("packnet", {"retrain_updates": 5}),
        param(("ewc", {"fisher_samples": 64}), slow=True),
        param(("clone", {"clone_samples": 10}), nightly=True),
    ],
)
def test_a_run_resumes_to_the_bit(tmp_path, name, given):
    small = {"num_envs": 2, "chunk_steps": 50, "curriculum": "sequence:50", "quiet": True, "batch_size": 8}
    small |= {
        "eval_every": 200,
        "eval_episodes": 1,
        "hidden": (8,),
        "warmup_steps": 10,
        "normalize_observations": False,
        "continual": name,
        **given,
    }
    run = lambda steps, folder, **more: mtjax.train(
        "point-mass-vary-goal", "sac-conditioned", steps=steps, directory=tmp_path / folder, **small, **more
    )
    per_chunk = 50 * 2  # of two environments of the task that is played
    whole = run(4 * per_chunk, "whole")
    run(2 * per_chunk, "cut")
    again = run(4 * per_chunk, "cut", resume=True)
    jax.tree.map(np.testing.assert_array_equal, jax.device_get(whole.state.agent), jax.device_get(again.state.agent))


@pytest.mark.parametrize(
    "agent, given, said",
    [
        ("sac", {"continual": "packnet", "normalize_observations": True}, "which normalize-observations changes"),
        ("sac", {"continual": "packnet", "conditioning": "embedding"}, "which conditioning=embedding changes"),
        ("sac", {"continual": "ewc", "heads": "disjoint"}, "heads=disjoint shares nothing"),
        ("distral", {"continual": "ewc"}, "heads=disjoint shares nothing"),
        ("xqc", {"continual": "ewc"}, "holds one actor"),
        ("ppo", {"continual": "packnet", "normalize_observations": False}, "PPO has rollouts"),
        ("ppo", {"continual": "packnet", "normalize_observations": False, "retrain_updates": 0}, "PPO has rollouts"),
        ("ppo", {"continual": "ewc", "conditioning": "recurrent"}, "PPO has rollouts; use another conditioning"),
        ("sac", {"continual": "ewc", "fisher_samples": 31}, "fisher-samples must be at least 32"),
        ("sac", {"continual": "packnet", "retrain_updates": -1}, "retrain-updates must be at least 0"),
        ("sac", {"continual": "ewcc"}, "did you mean 'ewc'"),
    ],
)
def test_what_cannot_be_remembered_is_refused(agent, given, said):
    with pytest.raises(InputError, match=said):
        mtjax.agent(agent, **given)


@pytest.mark.parametrize("curriculum", ["all", "random:2:8"])
def test_tasks_have_to_follow_one_another(curriculum):
    agent, chosen = configure(tiny("sac", continual="l2"), Settings(curriculum=curriculum), GIVEN)
    with pytest.raises(InputError, match="use --curriculum=sequence:STEPS"):
        combinations.require_agent(chosen, agent)


def test_a_command_switches_off_what_a_preset_has_and_packnet_refuses():
    """Before the settings of the preset are put together with PackNet."""
    words = ["--env=point-mass-vary-goal", "--agent=sac", "--agent.continual=packnet", "--curriculum=sequence:1000"]
    agent = run_config.parse([*words, "--agent.normalize-observations=false"]).learner
    assert isinstance(agent.continual, continual.PackNet) and not agent.normalize_observations
    with pytest.raises(InputError, match="use normalize_observations="):
        run_config.parse(words)


@pytest.mark.usefixtures("optimised")
@pytest.mark.nightly
def test_fine_tuning_forgets_where_packnet_does_not():
    """Of four goals, the first: what its mean return of three seeds, at most 100, loses by the end of the third."""
    given = {"num_tasks": 4, "num_envs": 8, "chunk_steps": 1000, "curriculum": "sequence:2000", "hidden": (64, 64)}
    given |= {"conditioning": "one-hot", "normalize_observations": False, "split": "none", "quiet": True, "seeds": 3}
    given |= {"steps": 48_000, "eval_every": 8000, "eval_episodes": 2, "batch_size": 64, "replay_size": 40_000}

    def lost(name, **settings):
        result = mtjax.train("point-mass-vary-goal", "sac", continual=name, warmup_steps=200, **given, **settings)
        returns = result.evaluations.returns["train"].mean(axis=(0, 3))
        return returns[1, 0] - returns[2:5, 0].min()

    assert lost("none") > 12
    assert lost("packnet", retrain_updates=2000) < 3
