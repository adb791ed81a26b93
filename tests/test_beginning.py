"""Options that begin from a run of sketches: what they take, how they act, what they learn, and what is refused."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, tiny, train, train_objects
from test_finetune import bits, quick_programs
from test_sketches import ENV, STOP, made, observations

import mtjax.train
from mtjax.agents import for_action
from mtjax.agents.beginning import beginning
from mtjax.agents.options import ends_of, for_actions
from mtjax.agents.state import of_task
from mtjax.command import run_config
from mtjax.envs import ENVS
from mtjax.saved.config_json import from_json, to_flags
from mtjax.saved.policy import Policy
from mtjax.training import finetune
from mtjax.training.launch import check, load_start
from mtjax.types import InputError

NEW = dataclasses.replace(ENV, vary={"goal": "rl"}, split="none", sketched=False)
TASKS = NEW.tasks()


def policy_of(agent, states):
    """A policy as a run of sketches leaves it."""
    one = jax.tree.map(lambda x: x[0], states)
    return Policy(ENV, agent, one, states, jnp.arange(len(jax.tree.leaves(states)[0])))


def options(**settings):
    asked = {"endings": "stop", "num_options": 2, "normalize_observations": False}
    return for_action(tiny("options", **asked | settings), NEW.action)


def fresh(agent, env, seeds):
    """Random states (S, ...), as each seed draws them."""
    keys = jax.random.split(jax.random.key(5), seeds)
    return jax.jit(jax.vmap(lambda key: agent.init(env.spec, env.tasks(), key)), compiler_options=QUICK)(keys)


@pytest.fixture(scope="module")
def taught():
    """Two seeds of sketches whose sub-policies are far from uniform."""
    agent, random = made(), np.random.default_rng(0)
    states = fresh(agent, ENV, 2)
    noise = lambda x: x + jnp.float32(random.normal(size=x.shape))
    return policy_of(agent, states.with_nets(actor=jax.tree.map(noise, states.nets["actor"])))


# What goes on.


@pytest.mark.slow
def test_each_option_acts_and_ends_as_the_sub_policy_of_its_symbol(taught):
    """By the same outputs in every place, of seed k modulo the run's seeds; all else is fresh, bit for bit."""
    agent = options()
    finetune.require_fit(taught, NEW, agent)
    before = fresh(agent, NEW, 3)
    after = finetune.adopt(taught, agent, TASKS, before)
    places = observations([0] * 7)[:, :7]
    for seed, (symbol, number) in ((s, x) for s in range(3) for x in enumerate([0, 1])):
        ours, theirs = (
            of_task(jax.tree.map(lambda x, i=i: x[i], states.nets), 0)
            for states, i in ((after, seed), (taught.states, seed % 2))
        )
        outputs = taught.agent.policy_outputs(theirs, jnp.zeros(0), observations([symbol] * 7))
        option = jnp.full(7, number)
        np.testing.assert_array_equal(for_actions(agent, ours, places, option), outputs[:, :STOP])
        chance = ends_of(agent, ours, places, option, None)
        np.testing.assert_allclose(chance, jax.nn.softmax(outputs)[:, STOP], rtol=1e-5)
    rest = lambda state: state._replace(nets={name: net for name, net in state.nets.items() if name != "actor"})
    assert bits(rest(after)) == bits(rest(before))


def test_an_agent_begins_from_runs_of_the_classes_that_it_names(taught):
    """A run of its own class goes on whole."""
    assert beginning(options(), taught.agent, taught.env).nets == ("actor",)
    assert beginning(options(), options(), NEW) is None and beginning(made(), options(), NEW) is None


@pytest.mark.parametrize(
    "given, said",
    [
        ({"endings": "learned"}, "the run's networks need endings=stop, not learned"),
        ({"num_options": 3}, "need num-options=2, not 3"),
        ({"normalize_observations": True}, "need normalize-observations=False, not True"),
        ({"hidden": (8,)}, r"need hidden=\(16,\), not \(8,\)"),
        ({"encoder": "simba"}, "need encoder=identity, not simba"),
        ({"tune": "heads"}, "need tune=all, not heads"),
    ],
)
def test_settings_for_which_the_sub_policies_are_not_made_are_refused(taught, given, said):
    with pytest.raises(InputError, match=said):
        finetune.require_fit(taught, NEW, options(**given))


@pytest.mark.parametrize(
    "given, said",
    [
        ({"sharing": "tasks"}, "has sharing=tasks; take one with sharing=symbols"),
        ({"sharing": "all"}, "has sharing=all"),
        ({"conditioning": "parameters"}, "has conditioning=parameters; take one with conditioning=none"),
    ],
)
def test_runs_without_policies_of_symbols_are_refused(taught, given, said):
    start = Policy(ENV, made(**given), taught.state, taught.states, taught.seeds)
    with pytest.raises(InputError, match=said):
        finetune.require_fit(start, NEW, options())


def test_tasks_that_follow_a_sketch_are_refused(taught):
    said = "map 7 observed numbers to 2 discrete actions; the new tasks have 9 .* and 3 .*; take tasks .* --env=craft"
    with pytest.raises(InputError, match=said):
        finetune.require_fit(taught, ENV, options())


# From a folder.


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a run of sketches, by a command, where the corridor has a name."""
    with quick_programs() as patch:
        for name, sketched in (("corridor", False), ("corridor-sketched", True)):
            patch.setitem(ENVS, name, (type(ENV), {"vary": {"goal": "l,r,rl"}, "sketched": sketched}))
        runs = tmp_path_factory.mktemp("runs")
        mtjax.train.main([*"--env=corridor-sketched --agent=sketches --seeds=2".split(), *SHORT, f"--runs={runs}"])
        (run,) = runs.iterdir()
        yield run


SHORT = (
    "--steps=64 --eval-every=1000 --eval-episodes=1 --num-envs=2 --agent.unroll=4 --agent.minibatches=2 "
    "--agent.epochs=1 --chunk-steps=4 --agent.hidden 8"
).split()
BEGIN = "--env=corridor --env.vary.goal=rl --split=none --agent=options".split()


@pytest.mark.slow
def test_a_command_begins_from_a_run_and_its_record_repeats_it(folder, tmp_path):
    """Settings that the sub-policies ask for need no flags; contexts are the new tasks' own."""
    words = [*BEGIN, f"--from={folder}", "--agent.keep-options", *SHORT[:-2]]
    config = run_config.parse(words)
    assert (config.learner.endings, config.learner.num_options, config.learner.hidden) == ("stop", 2, (8,))
    assert config.family.context_ranges is None and not config.learner.normalize_observations
    mtjax.train.main([*words, f"--runs={tmp_path}"])
    (run,) = tmp_path.iterdir()
    kept, now = (mtjax.load(each).states.nets["actor"] for each in (folder, run))
    assert bits(jax.tree.map(lambda x: x[:1], kept)) == bits(now)
    recorded = from_json(run / "config.json")
    assert run_config.parse([*to_flags(recorded), f"--runs={recorded.runs}", "--preset=auto"]) == recorded
    mtjax.train.main([f"--resume={run}", "--steps=128"])
    assert bits(mtjax.load(run).states.nets["actor"]) == bits(now)


@pytest.mark.slow
def test_python_begins_from_a_folder_as_from_a_policy(folder):
    given = {"vary": {"goal": "rl"}, "split": "none", "steps": 16, "num_envs": 2, "unroll": 4, "quiet": True}
    given |= {"endings": "stop", "keep_options": True, "minibatches": 2, "epochs": 1, "eval_episodes": 1}
    found = [mtjax.train("corridor", "options", start=start, **given) for start in (folder, mtjax.load(folder))]
    assert bits(found[0].state) == bits(found[1].state)
    kept = jax.tree.map(lambda x: x[:1], mtjax.load(folder).states.nets["actor"])
    assert bits(found[0].state.agent.nets["actor"]) == bits(kept)


@pytest.mark.slow
@pytest.mark.parametrize(
    "words, said",
    [
        ("--agent.endings=learned", "need endings=stop, not learned"),
        ("--agent.num-options=3", "need num-options=2, not 3"),
        ("--agent.encoder=simba", "need encoder=identity, not simba"),
        ("--agent.normalize-observations", "need normalize-observations=False"),
        ("--env=corridor-sketched", "the new tasks have 9 observed numbers"),
        ("--agent=ppo", "goes on with the run's agent, sketches, not with ppo"),
    ],
)
def test_what_does_not_fit_is_refused_before_a_folder_is_made(folder, words, said):
    with pytest.raises(InputError, match=re.escape(said)):
        config = run_config.parse([*BEGIN, f"--from={folder}", *words.split()])
        check(config, load_start(config))


# Learning.


@pytest.mark.nightly
def test_a_new_order_is_learned_without_its_sketch_sooner_than_from_scratch():
    """First right, then left, by sub-policies of other orders that stay as they are; both ways are of 4,096 steps."""
    learn = {"gamma": 0.95, "actor_lr": 3e-3, "critic_lr": 3e-3}
    loop = {"num_envs": 32, "unroll": 16, "minibatches": 4, "epochs": 4}
    sketches = made(**learn, stop_bias=-1.0, return_rate=0.1)
    state, _ = train(ENV, sketches, {**loop, "chunk_steps": 320}, chunks=3)
    agent = options(**learn, deliberation_cost=0.0, keep_options=True)
    play = {"steps": 4096, "seeds": 2, "eval_every": 4096, "eval_episodes": 20, "chunk_steps": 64, **loop}
    found = {}
    for way, start in (("adapted", policy_of(sketches, state.agent)), ("scratch", None)):
        own = agent if start else dataclasses.replace(agent, keep_options=False)
        result = train_objects(NEW, own, start=start, **play)
        found[way] = result.evaluations.returns["train"][:, -1].mean(), float(result.rows[-1]["return"])
    assert min(found["adapted"]) > 0.9 and max(found["scratch"]) < 0.5, found
