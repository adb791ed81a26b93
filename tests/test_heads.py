"""What tasks have for themselves of actor and of critics, chosen apart (Yang et al. 2017)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, SPEC, learner, mean_actions, one_in, only_seed, random_batch, tasks_of, tiny, train
from test_ppo import BEST, LEARN, SCALES

import mtjax
from mtjax.agents import combinations
from mtjax.command import run_config
from mtjax.envs.probes import Probe
from mtjax.types import InputError

TASKS = tasks_of("one-step", (1.0, -0.5, 0.3))
OWN = {"shared": set(), "per-task": {"head"}, "disjoint": {"head", "body"}}


@pytest.mark.parametrize("name", ["sac-conditioned", "ppo"])
@pytest.mark.parametrize("actor", OWN)
@pytest.mark.parametrize("critic", OWN)
def test_actor_and_critics_have_what_is_asked_of_each(name, actor, critic):
    """All nine pairs, by whichever setting: what is each task's own, and the rest that all share."""
    for settings in (
        {"actor_heads": actor, "critic_heads": critic},
        {"heads": actor, "critic_heads": critic},
        {"actor_heads": actor, "heads": critic},
    ):
        agent = tiny(name, **settings)
        init = lambda agent=agent: agent.init(SPEC, TASKS, jax.random.key(0)).nets
        nets = jax.eval_shape(init)
        for network, heads in (("actor", actor), ("critic", critic)):
            assert set(nets[network].own) == OWN[heads]
            assert set(nets[network].shared) == OWN["disjoint"] - OWN[heads]


@pytest.mark.parametrize(
    "actor, critic", one_in(3, [("disjoint", "shared"), ("shared", "disjoint"), ("per-task", "shared")])
)
def test_a_step_moves_what_tasks_share_and_what_is_their_own(actor, critic):
    """Every leaf of both, and every task's part of what is its own."""
    init, update = learner(tiny("sac-conditioned", actor_heads=actor, critic_heads=critic), TASKS, 8)
    start = init(TASKS, jax.random.key(0))
    after, metrics = update(start, random_batch(0, 3, 8), TASKS, jax.random.key(1))
    for name in ("actor", "critic"):
        for part, axes in (("shared", 0), ("own", 1)):
            pairs = (getattr(x.nets[name], part) for x in (start, after))
            for moved in jax.tree.leaves(jax.tree.map(lambda x, y: np.asarray(x != y), *pairs)):
                assert moved.reshape(*(moved.shape[:1] if axes else (1,)), -1).any(axis=1).all()
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(metrics))


def test_a_task_moves_its_own_actor_alone_and_the_critic_of_all():
    """The losses of one task, with an actor for each beside one critic."""
    agent = tiny("ppo", actor_heads="disjoint", critic_heads="shared", conditioning="none")
    state = jax.jit(lambda: agent.init(SPEC, TASKS, jax.random.key(0)), compiler_options=QUICK)()
    obs = jnp.ones((2, 1))

    def output(nets, network):
        nets = {name: net.of_first() for name, net in nets.items()}
        return jnp.sum(getattr(agent, network)(nets, jnp.zeros(0), obs))

    for network, name in (("policy_outputs", "actor"), ("output", "critic")):
        found = jax.grad(lambda nets, network=network: output(nets, network), allow_int=True)(state.nets)[name]
        leaves = [np.asarray(x) for x in jax.tree.leaves(found.own)]
        assert bool(leaves) == (name == "actor") and not any(x[1:].any() for x in leaves)
        assert all(x[0].any() for x in leaves) and all(np.any(x) for x in jax.tree.leaves(found.shared))


@pytest.mark.slow
def test_actors_of_each_task_beside_one_critic_learn_each_tasks_best_action():
    """Though neither sees the task, which one policy for all could not do."""
    agent = tiny("ppo", actor_heads="disjoint", conditioning="none")
    state, _ = train(Probe("by-action"), agent, LEARN)
    tasks = Probe("by-action").tasks()
    found = mean_actions(agent, only_seed(state.agent), tasks, [0.0])
    np.testing.assert_allclose(found, [[BEST["by-action"](scale, 0.0)] for scale in SCALES], atol=0.15)


def test_what_shares_nothing_is_told():
    """Knowledge of the task is each task's own only where both are; rules of gradients need what tasks share."""
    assert combinations.disjoint(mtjax.agent("sac", heads="disjoint"))
    assert not combinations.disjoint(mtjax.agent("sac", heads="disjoint", critic_heads="shared"))
    refused = (
        ("sac", {"actor_heads": "disjoint", "gradients": "pcgrad"}, "actor-heads=disjoint leaves no parameters"),
        ("sac", {"heads": "disjoint", "gradients": "pcgrad"}, "^heads=disjoint leaves no parameters"),
        ("sac", {"heads": "per-task", "critic_heads": "shared", "scaling": "popart"}, "not scalar and shared"),
        ("distral", {"critic_heads": "shared"}, "critic-heads is disjoint, not shared"),
        ("sketches", {"actor_heads": "per-task"}, "actor-heads is disjoint, not per-task"),
        ("maml", {"critic_heads": "per-task"}, "critic-heads is shared, not per-task"),
        ("sac", {"actor_heads": "own"}, "unknown actor-heads 'own'"),
    )
    for name, settings, said in refused:
        with pytest.raises(InputError, match=said):
            mtjax.agent(name, **settings)


def test_a_command_chooses_parts_by_the_heads_of_one_network():
    """PopArt rescales heads of each task's own, which critics alone may have."""
    words = ["--env=point-mass-vary-goal", "--agent=sac", "--agent.scaling=popart", "--agent.critic-heads=per-task"]
    assert run_config.draft(words).learner.scaling.rescales
