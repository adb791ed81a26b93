"""Distillation: the loss by hand, who teaches which task, learners that come to act as taught, and what is refused."""

import dataclasses
import json
import math
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import QUICK, Probe, pick, quick, slow_but, tasks_of, tiny, train_objects
from test_finetune import bits, named_aims

import mtjax
import mtjax.train
from mtjax.agents import for_action
from mtjax.agents.distil import Batch, teaching
from mtjax.agents.hyperparameters import flag_names
from mtjax.agents.state import of_task
from mtjax.agents.swept import sweepable
from mtjax.agents.teacher import Teacher
from mtjax.command import run_config
from mtjax.learning.evaluation import Episodes, evaluate
from mtjax.saved.config_json import from_json, to_flags, to_json
from mtjax.saved.policy import Policy
from mtjax.training.distillation import adopt, lessons
from mtjax.types import Discrete, InputError, Spec, Transition

SPEC, TASKS, KEY = Spec.vector(1, 1, 1), tasks_of("one-step", (1.0, -0.5)), jax.random.key(0)
DISCRETE = SPEC._replace(action=Discrete(2))


def begun(agent, spec, tasks=TASKS, seeds=1):
    """Fresh states of an agent, leaves (S, ...)."""
    keys = jax.random.split(KEY, seeds)
    return jax.jit(jax.vmap(lambda key: agent.init(spec, tasks, key)), compiler_options=QUICK)(keys)


def policy_of(agent, env, states):
    """Trained policies, as a run leaves them."""
    seeds = jnp.arange(len(jax.tree.leaves(states)[0]))
    return Policy(env, agent, pick(states, 0), states, seeds)


def with_biases(states, *biases):
    """States (S, ...) whose actors put out these numbers (T, P) whatever they see, with an output layer for a task."""
    head = states.nets["actor"].own["head"]
    put = {"kernel": jnp.zeros_like(head["kernel"]), "bias": jnp.broadcast_to(jnp.float32(biases), head["bias"].shape)}
    actor = states.nets["actor"]
    return states.with_nets(actor=actor._replace(own=actor.own | {"head": put}))


# The loss.


def loss_of(spec, taught, outputs, mask=None, **settings):
    """The loss of one step, given what the teacher and the learner put out."""
    agent = for_action(tiny("distil", heads="per-task", **settings), spec.action)
    states = with_biases(begun(agent, spec, tasks_of("one-step", (1.0,))), outputs)
    nets = of_task(pick(states, 0).nets, 0)
    batch = Batch(jnp.zeros((1, 1)), jnp.float32([taught]), jnp.zeros(0), mask)
    return float(agent.actor_loss(nets, batch)[0])


@pytest.mark.parametrize(
    ("temperature", "likely"), [(1.0, 2 / 3), (0.5, 4 / 5), (2.0, math.sqrt(2) / (1 + math.sqrt(2)))]
)
def test_the_divergence_of_discrete_actions_by_hand(temperature, likely):
    """Outputs 0 and ln 2 are probabilities 1 to 2, of half the temperature 1 to 4; the learner takes 3 to 1."""
    expected = (1 - likely) * math.log((1 - likely) / 0.75) + likely * math.log(likely / 0.25)
    found = loss_of(DISCRETE, [0.0, math.log(2)], [math.log(3), 0.0], teacher_temperature=temperature)
    assert found == pytest.approx(expected, rel=1e-5)


def test_actions_that_a_task_lacks_do_not_count():
    assert loss_of(DISCRETE, [0.0, 3.0], [0.0, -3.0], jnp.float32([1, 0])) == pytest.approx(0, abs=1e-6)


def test_the_divergence_of_continuous_actions_by_hand():
    """Both standard deviations are e^-1.5, those of outputs 0: ((0.8 - 0.5) / s)^2 / 2."""
    expected = 0.3**2 * math.exp(3) / 2
    assert loss_of(SPEC, [0.8, 0.0], [0.5, 0.0]) == pytest.approx(expected, rel=1e-5)


# Who teaches which task.


@pytest.fixture(autouse=True)
def aims():
    with named_aims():
        yield


def aim(goals):
    return mtjax.make("aim", vary={"goal": goals}, split="none")


def taught_in(env, name="ppo", seeds=1, **settings):
    agent = for_action(tiny(name, **settings), env.spec.action)
    return policy_of(agent, env, begun(agent, env.spec, env.tasks("train"), seeds))


def test_one_run_teaches_each_task_as_it_plays_it():
    """By the task's number in the run, or as an unseen task, with its own context."""
    run, env = taught_in(aim("-1:1:3"), conditioning="parameters"), aim("1,0.5,-1")
    found = lessons([run], env.scaled_as(run.env).tasks("train"))
    assert found.run.tolist() == [0, 0, 0] and found.number.tolist() == [2, 3, 0]
    np.testing.assert_allclose(found.context[:, 0], [1, 0.5, -1], atol=1e-6)


def test_several_runs_teach_the_tasks_that_they_were_trained_on():
    """Of which they have the context; the first run that knows a task teaches it."""
    runs = [taught_in(aim(goals)) for goals in ("-1,1", "0.5,1", "0,2")]
    found = lessons(runs, aim("-1,0,0.5,1,3").tasks("train"))
    assert found.run.tolist() == [0, 2, 1, 0, -1] and found.number[:4].tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(found.context[:4, 0], [-1, -1, -1, 1], atol=1e-6)


def taught_by(agent, env, *runs, seeds=1):
    """An agent with its teachers, and its states (S, ...) before it learns."""
    first = runs[0]
    sizes = first.state.num_tasks, first.env.spec.context_size, len(runs)
    agent = dataclasses.replace(for_action(agent, env.spec.action), teacher=Teacher(first.agent, *sizes))
    tasks = env.tasks("train")
    return agent, adopt(runs, agent, tasks, begun(agent, env.spec, tasks, seeds))


@pytest.mark.slow
@pytest.mark.parametrize("several", [False, True])
def test_a_teacher_says_in_each_task_what_its_own_run_would_do(several):
    """With networks, statistics and numbers of tasks of the run's seed, seed number k modulo theirs."""
    goals, told = ("-1,1", "0,2") if several else ("-1:1:3",), {"conditioning": "one-hot", "heads": "per-task"}
    runs = [taught_in(aim(each), seeds=2, **told) for each in goals]
    env = aim("1,0,-1")
    env = env if several else env.scaled_as(runs[0].env)
    agent, states = taught_by(tiny("distil"), env, *runs, seeds=3)
    tasks, obs = env.tasks("train"), jnp.float32([0.3, -0.7])
    expected = {True: [(0, 1), (1, 0), (0, 0)], False: [(0, 2), (0, 1), (0, 0)]}[several]
    for seed, (i, (run, number)) in ((s, x) for s in range(3) for x in enumerate(expected)):
        state, task = pick(states, seed), pick(tasks, i)
        found = agent.teacher.act(teaching(state, task), agent.begin(state, task).teacher, obs, task)
        own, known = runs[run], pick(runs[run].env.tasks("train"), number)
        state = pick(own.states, seed % 2)
        same = own.agent.act(state, own.agent.begin(state, known), obs, known, None)
        np.testing.assert_allclose(found.outputs, same.outputs, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_a_teacher_that_remembers_hears_of_every_step():
    """Whoever took it: its memory is that of playing these actions itself."""
    env = aim("-1:1:3")
    run = taught_in(env, conditioning="recurrent", recurrent_size=3)
    agent, states = taught_by(tiny("distil", conditioning="recurrent", recurrent_size=4), env, run)
    state = pick(states, 0)
    task = pick(env.tasks("train"), 1)
    memory, alone = agent.begin(state, task), run.agent.begin(run.state, task)
    for i in range(3):
        obs, action = jnp.float32([i, 1 - i]), jnp.float32([0.2 * i])
        step = Transition(obs, action, jnp.float32(i), jnp.float32(1), obs + 1, *[jnp.bool_(False)] * 2)
        memory, alone = agent.remember(state, memory, step, task), run.agent.remember(run.state, alone, step, task)
        np.testing.assert_allclose(memory.teacher.hidden, alone.hidden, rtol=1e-5)
    assert memory.hidden.shape == (4,) and np.any(memory.teacher.hidden)


@pytest.mark.parametrize("name", slow_but(["sac", "pqn", "options", "distral", "impala"], "sac", "pqn"))
def test_agents_tell_what_their_actions_are_drawn_from(name):
    """The likeliest action is that of these outputs, which are values in PQN."""
    spec = DISCRETE if name == "pqn" else SPEC
    agent = for_action(tiny(name), spec.action)
    state, task = pick(begun(agent, spec), 0), pick(TASKS, 1)
    acted = agent.act(state, agent.begin(state, task), jnp.float32([0.4]), task, None)
    np.testing.assert_allclose(acted.action, agent.policy.draw(acted.outputs, None, None).action, rtol=1e-6)


# Learners.


@dataclasses.dataclass(frozen=True)
class Guess(Probe):
    """Six steps, each of which shows nothing and earns -(action - scale)^2."""

    episode_length: int = 6

    def tasks(self, split="train"):
        return tasks_of(self.kind, (0.6, -0.6), self.episode_length)

    def rules(self, task, state, action):
        return -jnp.square(action - task.goal["scale"]), 0.0, False


def told(env, *biases):
    """A policy that knows the tasks of ``env`` apart, and puts out these numbers in each."""
    agent = tiny("ppo", heads="per-task")
    return policy_of(agent, env, with_biases(begun(agent, env.spec, env.tasks()), *biases))


def last_returns(result):
    """The mean return (T,) of the first seed in the last evaluation, with the likeliest actions."""
    return result.evaluations.returns["train"][0, -1].mean(axis=-1)


LEARN = {"steps": 2 * 16 * 30 * 40, "num_envs": 16, "unroll": 30, "actor_lr": 3e-3, "eval_every": 10**6}


@pytest.mark.slow
def test_a_learner_comes_to_act_as_its_teacher():
    """Also in states that tell what to do: the divergence falls to 0, and the return is the teacher's."""
    env = Probe("by-both", 1)
    agent = tiny("ppo", conditioning="one-hot")
    states = begun(agent, env.spec, env.tasks())
    actor = states.nets["actor"]
    shared = actor.shared | {"head": {**actor.shared["head"], "kernel": 50 * actor.shared["head"]["kernel"]}}
    run = policy_of(agent, env, states.with_nets(actor=actor._replace(shared=shared)))
    learner = tiny("distil", conditioning="one-hot", normalize_observations=False)
    result = train_objects(env, learner, start=(run,), **LEARN)
    losses = [float(row["actor_loss"]) for row in result.rows]
    assert losses[0] > 0.05 and losses[-1] < 0.002, losses
    play = lambda states: (
        evaluate(env, run.agent, Episodes(10), states, env.tasks(), jnp.zeros(1, jnp.int32), 0).returns
    )
    expected = quick(play, run.states)(run.states)[0].mean(axis=-1)
    np.testing.assert_allclose(last_returns(result), expected, atol=0.03)


@pytest.mark.slow
def test_one_that_remembers_finds_out_what_its_teacher_knows():
    """One that does not plays between what is best in each task, at -0.36 a step."""
    env = Guess("by-action")
    run, found = told(env, [math.atanh(0.6), 0.0], [-math.atanh(0.6), 0.0]), {}
    for name, settings in {"none": {}, "recurrent": {"recurrent_size": 16}}.items():
        learner = tiny("distil", conditioning=name, **settings)
        found[name] = last_returns(train_objects(env, learner, start=(run,), **LEARN))
    assert np.all(np.abs(found["none"] + 6 * 0.36) < 0.6), found
    assert np.all(found["recurrent"] > -1.3), found


@pytest.mark.parametrize("share", [0.0, 1.0])
@pytest.mark.slow
def test_the_teacher_acts_for_a_share_of_the_steps(share):
    env = Guess("by-action")
    run = told(env, [9.0, -9.0], [9.0, -9.0])  # who always takes nearly 1
    agent, states = taught_by(tiny("distil", teacher_share=share), env, run)
    state = pick(states, 0)
    task = pick(env.tasks(), 0)
    act = lambda key: agent.act(state, agent.begin(state, task), jnp.zeros(1), task, key).action[0]
    taken = jax.vmap(act)(jax.random.split(KEY, 50))
    assert np.all(taken > 0.999) == bool(share)


@pytest.mark.slow
def test_the_teacher_acts_in_no_evaluation():
    """Not in those by drawn actions either, where it would have earned 0: the learner has learned nothing yet."""
    env = Guess("by-action")
    run = told(env, [math.atanh(0.6), -9.0], [-math.atanh(0.6), -9.0])
    few = {**LEARN, "steps": 2 * 16 * 30, "actor_lr": 1e-6, "eval_sampled": True, "eval_episodes": 50}
    found = [last_returns(train_objects(env, tiny("distil", teacher_share=x), start=(run,), **few)) for x in (0.0, 1.0)]
    assert np.all(np.abs(found[0] - found[1]) < 0.5) and np.all(found[1] < -1.5), found


# By the program.


def run_of(runs, *words):
    """Train by the program; returns the run's folder."""
    before = set(runs.iterdir())
    mtjax.train.main(
        [*words, "--eval-every=1000", "--eval-episodes=1", "--num-envs=2", f"--runs={runs}", "--agent.hidden", "8"]
    )
    (directory,) = set(runs.iterdir()) - before
    return directory


PPO = ("--agent=ppo", "--agent.unroll=8", "--agent.minibatches=2", "--steps=32")
DISTIL = ("--env=aim", "--agent=distil", "--agent.unroll=8", "--agent.minibatches=2", "--steps=240", "--chunk-steps=8")


def test_a_record_tells_who_teaches(tmp_path):
    """Of plain values, from which the same agent is made again; without --agent a run that was taught teaches."""
    run, taught, again = tmp_path / "run", tmp_path / "taught", tmp_path / "again"
    for folder, words in {run: PPO, taught: (*DISTIL, f"--from={run},{run}"), again: [f"--from={taught}"]}.items():
        folder.mkdir()
        config = run_config.parse(["--env=aim", *words])
        (folder / "config.json").write_text(to_json(config, {"command": "x"}))
        assert from_json(folder / "config.json") == config
    first, second, third = (from_json(folder / "config.json") for folder in (run, taught, again))
    assert second.learner.teacher == Teacher(first.learner, 3, 1, 2)
    assert third.agent == "distil" and third.learner.teacher.agent.teacher is None
    record = json.loads((again / "config.json").read_text())
    record["teacher"]["settings"] |= OF_CRITICS | OF_REWARDS  # which it had before
    (again / "config.json").write_text(json.dumps(record))
    assert from_json(again / "config.json").learner == third.learner


@pytest.mark.nightly
def test_a_run_that_was_taught_needs_its_teachers_no_more(tmp_path):
    """Two teachers of a task each; the policy is loaded, and goes on to the bit, when their folders are gone."""
    runs = [run_of(tmp_path, "--env=aim", f"--env.vary.goal={goal}", "--split=none", *PPO) for goal in ("0.5", "-1")]
    words = (*DISTIL, "--env.vary.goal=-1,0.5", "--split=none", f"--from={runs[0]},{runs[1]}", "--seeds=2")
    whole = run_of(tmp_path, *words)
    part = run_of(tmp_path, *words, "--steps=128")
    config = from_json(part / "config.json")
    assert config.learner.teacher == from_json(whole / "config.json").learner.teacher
    assert f"--from={runs[0]},{runs[1]}" in to_flags(config)
    for run in runs:
        shutil.rmtree(run)
    mtjax.train.main([f"--resume={part}", "--steps=240"])
    assert bits(mtjax.load(part).states) == bits(mtjax.load(whole).states)
    policy = mtjax.load(whole)
    assert policy(np.zeros(2)).shape == (1,) and "teacher" not in policy.state.nets and policy.agent.teacher is None
    pupil = run_of(tmp_path, *DISTIL, "--env.vary.goal=-1,0.5", "--split=none", f"--from={whole}")
    assert from_json(pupil / "config.json").learner.teacher.agent == policy.agent


REFUSED = [
    (["0.5,1", "-1"], {}, "teachers have as many tasks each, not 2, 1"),
    (["0.5", "0"], {}, "none of the teachers was trained on goal=-1"),
    (["0.5,1", "-1,0"], {}, "none of the teachers was trained on goal=-0.5"),
    (["-1,1"], {}, r"not written as the teacher's; give env.scaled_as\(policy.env\)"),
    (["-1:0.5:4"], {"teacher_temperature": 0.5}, "teacher-temperature is of discrete actions; leave it out"),
]


@pytest.mark.parametrize(("goals", "given", "said"), REFUSED)
def test_what_cannot_teach_is_refused(goals, given, said):
    """Before anything compiles, in a line."""
    runs = tuple(taught_in(aim(each)) for each in goals)
    with pytest.raises(InputError, match=said) as error:
        train_objects(aim("-1:0.5:4"), tiny("distil"), start=runs, **given)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_policies_of_other_shapes_do_not_teach():
    """Nor those that adapt first, or with other networks than each other, or of trials of other lengths."""
    env, wide, run = aim("-1,1"), taught_in(mtjax.make("aim-wide")), taught_in(aim("-1,1"))
    remembers = dataclasses.replace(taught_in(env, "rl2"), trial=3)
    several = (run, taught_in(env, actor_layer_norm=True))
    refused = {
        (wide,): "the teacher maps 2 observed numbers to 2 continuous actions; these tasks have 2 observed",
        (taught_in(env, "maml"),): "maml adapts its policy to each task before it plays; it cannot teach",
        (remembers,): "the teacher remembers trials of 3 episodes; give --trials=3",
        several: "actor-layer-norm is the run's, False, and cannot be True",
    }
    for runs, said in refused.items():
        with pytest.raises(InputError, match=said):
            train_objects(env, tiny("distil"), start=runs)


OF_CRITICS = {"critic_lr": 9.0, "critic_hidden": (7,), "critic_heads": "per-task", "critic_layer_norm": False}
OF_REWARDS = {"gamma": 0.5, "discounting": "horizon"}


@pytest.mark.parametrize(("name", "value"), (OF_CRITICS | OF_REWARDS).items())
def test_it_has_no_settings_of_critics_and_rewards(name, value):
    """As nothing would read them; neither in Python, nor on a command line, nor in a sweep."""
    with pytest.raises(InputError, match=f"unknown setting of distil '{name}'"):
        mtjax.agent("distil", **{name: value})
    agent = mtjax.agent("distil")
    assert f"agent.{name.replace('_', '-')}" not in flag_names(agent).values()
    assert name not in agent.adjustable and name not in sweepable(agent)


def test_an_agent_without_teachers_is_refused():
    """And teachers of one that is not taught, or whose critics would have to learn."""
    with pytest.raises(InputError, match="this agent learns from trained policies; name their runs: --from=RUN"):
        mtjax.train.main(["--env=aim", "--agent=distil"])
    with pytest.raises(InputError, match="'nothing' is not a run"):
        mtjax.train.main(["--env=aim", "--agent=distil", "--from=nothing,too"])
    run = taught_in(aim("-1,1"))
    with pytest.raises(InputError, match="start is one policy, or for agent='distil' a list of those that teach it"):
        mtjax.train("aim", "ppo", start=[run, run])
    for given, said in {"representation": "deepmdp", "sampler": "hardest"}.items():
        with pytest.raises(InputError, match=r"use representation=plain|sampler=uniform"):
            mtjax.agent("distil", **{given: said})
