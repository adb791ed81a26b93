"""Fine-tuning: what of a run goes on in another, for which tasks, what stays as it was, and what is refused."""

import contextlib
import dataclasses
import json
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import slow_but, train_objects, with_nets

import mtjax.train
from mtjax.agents import agent
from mtjax.agents.networks import Params
from mtjax.command import run_config
from mtjax.envs import ENVS
from mtjax.envs.contexts import contexts, ranges
from mtjax.envs.family import Family
from mtjax.envs.parameters import Parameter
from mtjax.saved.config_json import from_json, to_flags
from mtjax.training import finetune
from mtjax.training.finetune import adopt
from mtjax.types import InputError, Step


class State(NamedTuple):
    obs: jax.Array


@dataclasses.dataclass(frozen=True)
class Aim(Family):
    """Earns most for the action that the task's goal names; nothing else happens."""

    parameters: ClassVar = {
        "goal": Parameter("1", 0.0, minimum=-10),
        "drift": Parameter("1", 0.25, minimum=-10),
    }
    action_size: ClassVar[int] = 1
    episode_steps: ClassVar[int] = 4

    def reset(self, task, key):
        obs = jax.random.normal(key, (2,))
        return Step(State(obs), obs, jnp.float32(0), jnp.bool_(False))

    def step(self, task, state, action):
        obs = state.obs * 0.9 + task.goal["drift"]
        return Step(State(obs), obs, -jnp.square(action[0] - task.goal["goal"]), jnp.bool_(False))


@dataclasses.dataclass(frozen=True)
class WideAim(Aim):
    """Acts with two numbers."""

    action_size: ClassVar[int] = 2


NEW = "--env=aim --env.vary.goal=0.9,-0.8 --split=none".split()  # nearest to the last and the first of the run's
NEAREST = [2, 0]
SHORT = (
    "--steps=240 --eval-every=1000 --eval-episodes=1 --num-envs=2 --batch-size=4 --replay-size=100 --warmup-steps=2 "
    "--chunk-steps=20"
).split()
BASE = (
    "--env=aim --env.vary.goal=-1:1:3 --split=none --agent=multi-head --agent.conditioning=embedding --seeds=2 "
    "--agent.embedding-size=3 --agent.normalize-observations --agent.hidden 8"
).split()


@contextlib.contextmanager
def quick_programs():
    """Programs that compile fast, out of the user's cache; yields what patches, for families with names."""
    quick = jax.config.read("jax_disable_most_optimizations")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MTJAX_CACHE", "0")
        jax.config.update("jax_disable_most_optimizations", True)
        yield patch
        jax.config.update("jax_disable_most_optimizations", quick)


@contextlib.contextmanager
def named_aims():
    """Families by name, and programs that compile fast."""
    with quick_programs() as patch:
        patch.setitem(ENVS, "aim", (Aim, {"vary": {"goal": "-1:1:3"}, "split": "none"}))
        patch.setitem(ENVS, "aim-wide", (WideAim, {"vary": {"goal": "-1:1:3"}, "split": "none"}))
        yield


@pytest.fixture(scope="module", autouse=True)
def aims():
    with named_aims():
        yield


def train(runs, *words):
    """Train by the program; returns the run's folder."""
    before = set(runs.iterdir())
    mtjax.train.main([*words, *SHORT, f"--runs={runs}"])
    (directory,) = set(runs.iterdir()) - before
    return directory


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """The folder of a run."""
    return train(tmp_path_factory.mktemp("runs"), *BASE)


@pytest.fixture(scope="module")
def learned(base):
    return mtjax.load(base)


def named(tree):
    """Arrays by path."""
    return {jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree.leaves_with_path(tree)}


def bits(tree):
    """The bytes of all arrays, keys of random numbers too."""
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(jnp.result_type(x), jax.dtypes.prng_key) else x
    return [np.asarray(plain(x)).tobytes() for x in jax.tree.leaves(tree)]


def networks(state):
    """The parameters of actor and critics, with what these see observations by, by path."""
    return named({name: state.nets[name] for name in ("actor", "critic", "representation", "knowing")})


def inherited(states, seeds, nearest=NEAREST):
    """Actor and critics of new tasks as a run's states (S, ...) leave them."""
    picked = {path: x[np.asarray(seeds)] for path, x in networks(states).items()}
    return {path: x[:, nearest] if ".own" in path else x for path, x in picked.items()}


# End to end.

MOVES = {"all": "", "heads": "['head']", "embedding": "['embedding']"}


@pytest.fixture(scope="module")
def tuned(base, tmp_path_factory):
    """Fine-tune the run's agent, once for each choice of parameters; three seeds from the run's two."""
    done = {}

    def tuned(tune):
        if tune not in done:
            runs = tmp_path_factory.mktemp("tuned")
            done[tune] = train(runs, *NEW, f"--from={base}", f"--tune={tune}", "--agent.actor-lr=0.01", "--seeds=3")
        return done[tune]

    return tuned


@pytest.mark.slow
@pytest.mark.parametrize("tune", slow_but(MOVES, nightly=True))
def test_what_is_tuned_moves_and_all_else_stays_to_the_bit(learned, tuned, tune):
    """From the networks of the run's seeds, and of the nearest tasks."""
    expected = inherited(learned.states, [0, 1, 0])
    after = mtjax.load(tuned(tune)).states
    found = networks(after)
    assert found.keys() == expected.keys() and any(MOVES[tune] in path for path in found)
    for path, leaf in found.items():
        for seed in range(3):
            moved = not np.array_equal(leaf[seed], expected[path][seed])
            assert moved == (MOVES[tune] in path), path


@pytest.mark.parametrize("name", slow_but(["simba-v2", "xqc"], nightly=True))
def test_weights_of_length_one_stay_and_statistics_follow_the_data(name, tmp_path):
    """With heads that learn alone: from the nearest task's statistics, which are no parameters."""
    begun = train(tmp_path, "--env=aim", "--split=none", f"--agent={name}", "--seeds=2", "--agent.hidden", "8")
    after = mtjax.load(train(tmp_path, *NEW, f"--from={begun}", "--tune=heads", "--seeds=3")).states
    expected = inherited(mtjax.load(begun).states, [0, 1, 0])
    found = networks(after)
    assert found.keys() == expected.keys() and any("batch_stats" in path for path in found) == (name == "xqc")
    for path, leaf in found.items():
        for seed in range(3):
            moved = not np.array_equal(leaf[seed], expected[path][seed])
            assert moved == ("['head']" in path or "batch_stats" in path), path


@pytest.mark.slow
def test_a_run_records_where_it_comes_from(base, tuned):
    """Its agent is the run's but for what was given; its contexts are written as the run's."""
    directory = tuned("heads")
    record, program = json.loads((directory / "config.json").read_text()), from_json(directory / "config.json")
    assert (record["start"], record["agent"], record["learner"]["tune"]) == (str(base), "multi-head", "heads")
    begun = from_json(base / "config.json").learner
    assert program.learner == dataclasses.replace(begun, tune="heads", actor_lr=0.01)
    assert ranges(program.family) == (("goal", -1.0, 1.0),)
    np.testing.assert_allclose(program.family.tasks().context, [[0.9], [-0.8]], rtol=1e-6)


@pytest.mark.slow
def test_recorded_command_repeats_the_program(tuned):
    """The run of --from included."""
    program = from_json(tuned("heads") / "config.json")
    again = run_config.parse([*to_flags(program), f"--runs={program.runs}", f"--preset={program.preset}"])
    assert again == program


@pytest.mark.slow
def test_a_fine_tuned_run_goes_on(learned, tuned, capsys):
    """From its own checkpoint, with what stays still staying."""
    directory = tuned("heads")
    before = named(mtjax.load(directory).states.nets["actor"])
    mtjax.train.main([f"--resume={directory}", "--steps=320"])
    assert f"from {from_json(directory / 'config.json').start}: heads" in capsys.readouterr().out
    for path, leaf in named(mtjax.load(directory).states.nets["actor"]).items():
        assert np.array_equal(leaf, before[path]) == ("head" not in path), path


@pytest.mark.slow
@pytest.mark.parametrize(
    "chunks, sweep", [(1, ()), pytest.param(2, {"actor_lr": [1e-3, 1e-4]}, marks=pytest.mark.slow)]
)
def test_a_stopped_fine_tuning_goes_on_to_the_bit(learned, base, tmp_path, chunks, sweep):
    """Before or after its first evaluation: the run that it is from gives nothing more to one that has begun."""
    given = {"vary": {"goal": [0.9, -0.8]}, "split": "none", "seeds": 3, "steps": 240, "eval_every": 160, "num_envs": 2}
    given |= {"eval_episodes": 1, "batch_size": 4, "replay_size": 100, "warmup_steps": 2, "chunk_steps": 20}
    given |= {"tune": "heads", "sweep": sweep}
    whole = mtjax.train("aim", start=learned, directory=tmp_path / "whole", **given)
    lines = []
    stop = lambda line: lines.append(line) or len(lines) == chunks
    stopped = mtjax.train("aim", start=base, directory=tmp_path / "run", on_chunk=stop, **given)
    assert (stopped.finished, stopped.rows[-1]["steps"]) == (False, 80 * chunks)
    resumed = mtjax.train("aim", start=base, directory=tmp_path / "run", resume=True, **given)
    assert resumed.finished and resumed.rows[0]["steps"] == 80 * (chunks + 1)
    assert bits((resumed.state, resumed.evaluations)) == bits((whole.state, whole.evaluations))
    assert bits(stopped.state) != bits(whole.state)
    evaluations = [(tmp_path / name / "evaluations.npz").read_bytes() for name in ("run", "whole")]
    assert evaluations[0] == evaluations[1]


@pytest.mark.slow
def test_training_takes_a_policy(learned):
    """In Python; without updates, what was learned is all there is."""
    env = mtjax.make("aim", {"goal": "0.9,-0.8"}).scaled_as(learned.env)
    settings = {"num_envs": 1, "updates_per_step": 0, "chunk_steps": 5, "replay_size": 10}
    result = train_objects(env, learned.agent, start=learned, steps=10, eval_episodes=1, **settings)
    found = networks(result.state.agent)
    for path, leaf in inherited(learned.states, [0]).items():
        np.testing.assert_array_equal(found[path], leaf)


# What goes on.


@pytest.fixture(scope="module")
def adopted(learned):
    """Fresh states of three seeds on two new tasks, and those with the run in them."""
    env = mtjax.make("aim", {"goal": "0.9,-0.8"}).scaled_as(learned.env)
    tasks, keys = env.tasks(), jax.random.split(jax.random.key(0), 3)
    fresh = jax.jit(jax.vmap(lambda key: learned.agent.init(env.spec, tasks, key)))(keys)
    return tasks, fresh, adopt(learned, learned.agent, tasks, fresh)


@pytest.mark.slow
def test_networks_temperatures_and_moments_go_on(learned, adopted):
    """Those of the nearest task; seeds of the run are taken in turn."""
    _, _, state = adopted
    was = learned.states
    for path, leaf in inherited(was, [0, 1, 0]).items():
        np.testing.assert_array_equal(networks(state)[path], leaf)
    now, before = (np.asarray(x.nets["temperature"].own["log"]) for x in (state, was))
    np.testing.assert_array_equal(now, before[[0, 1, 0]][:, NEAREST])
    assert len(np.unique(before)) == 6  # or nothing was shown
    now, before = (np.asarray(x.nets["inputs"].shared["moments"].mean) for x in (state, was))
    np.testing.assert_array_equal(now, before[[0, 1, 0]])
    now, before = (np.asarray(x.slow["critic"].own["head"]["kernel"]) for x in (state, was))
    np.testing.assert_array_equal(now, before[[0, 1, 0]][:, NEAREST])


@pytest.mark.slow
def test_the_rest_is_fresh(adopted):
    """Optimisers, and the contexts among which the nearest is found from now on."""
    tasks, fresh, state = adopted
    for one, other in zip(jax.tree.leaves(state.fits), jax.tree.leaves(fresh.fits), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(state.nets["tasks"].shared["known"], np.broadcast_to(tasks.context, (3, 2, 1)))


def test_one_temperature_for_all_stays_one():
    """Also where there are as many tasks as temperatures."""
    made, old = agent("sac", shared_temperature=True, hidden=(4,)), mtjax.make("aim")
    env = mtjax.make("aim", {"goal": "0.5"}).scaled_as(old)

    def blank(env):
        shapes = jax.eval_shape(lambda: made.init(env.spec, env.tasks(), jax.random.key(0)))
        return jax.tree.map(lambda x: jnp.zeros((1, *x.shape), x.dtype), shapes)

    states = with_nets(blank(old), temperature=Params({"log": jnp.float32([[0.7]])}, {}))
    state = adopt(mtjax.saved.policy.Policy(old, made, None, states, jnp.arange(1)), made, env.tasks(), blank(env))
    now, before = (x.nets["temperature"].shared["log"] for x in (state, states))
    np.testing.assert_array_equal(now, before)
    assert jax.tree.structure(states) == jax.tree.structure(blank(old))


# Contexts.


def test_contexts_are_written_as_the_others():
    """In its ranges and its order; what does not vary here, at its value; what is unknown here, at 0."""
    old = mtjax.make("aim", {"drift": "0:1:2", "goal": "-1:1:3"})
    env = mtjax.make("aim", {"goal": "1,3"}).scaled_as(old)
    assert [name for name, _, _ in ranges(old)] == ["goal", "drift"]
    np.testing.assert_allclose(env.tasks().context, [[1, -0.5], [3, -0.5]], rtol=1e-6)
    assert env.spec.context_size == old.spec.context_size == 2
    set_apart = mtjax.make("aim", {"goal": "1,3", "drift": "1"}).scaled_as(old)
    np.testing.assert_allclose(set_apart.tasks().context, [[1, 1], [3, 1]], rtol=1e-6)
    stranger = mtjax.make("aim", {"goal": "1,3"}, context_ranges=(("size", 3, 4), ("goal", 0, 2)))
    np.testing.assert_allclose(stranger.tasks().context, [[0, 0], [0, 2]], rtol=1e-6)


def test_contexts_of_single_tasks_and_of_drawn_ones():
    """A run of one task has one constant number; draws are written as their tasks are."""
    one, many = mtjax.make("aim", {"goal": "0.5"}), mtjax.make("aim", {"goal": "0:1"}, num_draws=4)
    np.testing.assert_array_equal(many.scaled_as(one).tasks().context, [[0.0]])
    np.testing.assert_array_equal(one.scaled_as(many).tasks().context, [[0.0]])
    wide = many.scaled_as(mtjax.make("aim", {"goal": "-2:2:3"}))
    np.testing.assert_allclose(wide.tasks().draws.context[0], wide.tasks().draws.params["goal"].T / 2, rtol=1e-6)


def test_a_family_written_as_itself_is_the_same():
    """To the bit; and once more after a record was read back."""
    env = mtjax.make("finger-spin-vary-size")
    again = env.scaled_as(env)
    np.testing.assert_array_equal(contexts(env), contexts(again))
    assert mtjax.make("finger-spin-vary-size", **json.loads(json.dumps(dataclasses.asdict(again)))) == again


# What is refused.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--agent=sac", "goes on with the run's agent, multi-head, not with sac"),
        ("--agent.encoder=mlp", "goes on with the run's encoder, identity, not with mlp"),
        ("--agent.hidden 4", r"hidden is the run's, \(8,\), and cannot be \(4,\); what may change is actor-lr"),
        ("--agent.embedding-size=4", "embedding-size is the run's, 3"),
        ("--env=aim-wide", "map 2 observed numbers to 1 continuous actions; the new tasks have 2 .* and 2 continuous"),
        ("--tune=head", "head"),
        ("--reset-every=5", "throws away what --from takes"),
    ],
)
def test_what_does_not_fit_the_run_is_refused(base, tmp_path, words, said):
    """Before a folder is made."""
    given = [*NEW, f"--from={base}", *SHORT, f"--runs={tmp_path / 'runs'}", *words.split()]
    with pytest.raises(InputError, match=said):
        mtjax.train.main(given)
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--from=nowhere", "'nowhere' is not a run"),
        ("--from=", "is not a run"),
        ("--tune=heads", "say which run: --from=RUN"),
        ("--tune=embedding", "--tune=embedding needs --agent.conditioning=embedding, not none"),
    ],
)
def test_flags_that_mean_nothing_are_refused(tmp_path, monkeypatch, words, said):
    """Before anything is made."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=said):
        mtjax.train.main(["--env=aim", "--agent=sac", *words.split()])
    assert not list(tmp_path.iterdir())


SEEN = {"pixels": 16, "frames": 3, "state": "also"}


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        (SEEN | {"pixels": 32}, r"pictures \(32, 32, 9\) with 4 observed numbers and 2 .*; give --env.pixels"),
        (SEEN | {"frames": 2}, r"pictures \(16, 16, 6\) with 4 observed numbers"),
        (SEEN | {"state": "hidden"}, r"pictures \(16, 16, 9\) and 2 continuous actions"),
        ({}, "the new tasks have 4 observed numbers and 2 continuous actions; give --env.pixels"),
    ],
)
def test_other_pictures_are_refused(seen, said):
    """By what networks see, which is a stack."""
    made = agent("drq", hidden=(4,))
    start = mtjax.saved.policy.Policy(mtjax.make("corridor-maze", **SEEN), made, None, None, jnp.arange(1))
    with pytest.raises(InputError, match=rf"map pictures \(16, 16, 9\) with 4 observed numbers to 2 .*{said}"):
        finetune.require_fit(start, mtjax.make("corridor-maze", **seen), made)


@pytest.mark.slow
def test_contexts_of_another_scale_are_refused(learned):
    """In Python, where the family is the caller's."""
    env = mtjax.make("aim", {"goal": "-2:2:3"})
    with pytest.raises(InputError, match=r"give env\.scaled_as"):
        train_objects(env, learned.agent, start=learned)
    finetune.require_fit(learned, env.scaled_as(learned.env), learned.agent)


@pytest.mark.parametrize(("goals", "fits"), [("-0.9,0.1,1.1", True), ("1,0,-1", False), ("0,1", False)])
def test_networks_that_know_tasks_by_number_keep_them(goals, fits):
    """Task i must be nearest to the run's task i."""
    made, old = agent("sac", conditioning="one-hot", hidden=(4,)), mtjax.make("aim")
    state = jax.jit(lambda: made.init(old.spec, old.tasks(), jax.random.key(0)))()
    start = mtjax.saved.policy.Policy(old, made, state, jax.tree.map(lambda x: x[None], state), jnp.arange(1))
    env = mtjax.make("aim", {"goal": goals}).scaled_as(old)
    if fits:
        finetune.require_fit(start, env, made)
        return
    with pytest.raises(InputError, match="know its 3 tasks by number"):
        finetune.require_fit(start, env, made)
