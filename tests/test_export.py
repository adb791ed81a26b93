"""Policies in one file: by NumPy and by JAX alone, they act as the policy does on every task."""

import ast
import dataclasses
import importlib.util
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import require
from probes import FEW, Levers, family_for, one_in, pick, slow_but, tiny, with_nets

import mtjax
import mtjax.evaluate
from mtjax import agents, standalone
from mtjax.agents import for_action
from mtjax.agents.networks import Params
from mtjax.agents.state import AgentState
from mtjax.envs.contexts import ranges
from mtjax.saved.export import require_file
from mtjax.saved.operations import steps_of
from mtjax.saved.policy import Policy
from mtjax.tasks import SAME_CONTEXT
from mtjax.types import InputError

ENV = mtjax.make("finger-spin", vary={"size": "1:1.2:3"})
TIES = mtjax.make("finger-spin-vary-size")  # whose held-out tasks are midway between two that trained


def policy_of(agent, env=ENV):
    """A policy that has not learned, with moments of observations that are not those at the start."""
    state = jax.jit(lambda key: agent.init(env.spec, env.tasks(), key))(jax.random.key(0))
    random = np.random.default_rng(3)
    shift = lambda x: jnp.asarray(np.float32(random.uniform(0.5, 2.0, x.shape)))
    state = with_nets(state, inputs=jax.tree.map(shift, state.nets["inputs"]))
    return Policy(env, agent, state, None, jnp.arange(1))


def observations(count, env=ENV):
    return np.float32(np.random.default_rng(0).normal(size=(count, env.spec.obs_size)))


REMEMBER = ("rl2", "options")  # what they have seen, or chosen
CASES = {name: {} for name in agents.AGENTS if family_for(name) == "finger-spin" and name not in REMEMBER} | {
    "care": {"normalize_observations": True},
    "text": {"conditioning": "text"},
    "input-map": {"encoder": "input-map", "conditioning": "parameters"},
    "hypernetwork": {"encoder": "hypernetwork", "conditioning": "parameters"},
    "one-hot": {"conditioning": "one-hot"},
}


@pytest.mark.parametrize("name", slow_but(CASES, "care", "text", nightly=True))
def test_all_forms_act_as_the_policy(name, tmp_path):
    """On tasks that trained and on others, whose context and nearest task are found inside."""
    if name == "text":
        require("sklearn")
    given = CASES[name]
    policy = policy_of(tiny(name if name in agents.AGENTS else "sac", **given), TIES)
    file = mtjax.export(policy, tmp_path / "policy.npz")
    by_numpy, by_jax = standalone.load(file), standalone.load_jax(file)
    tasks, obs = TIES.tasks("all"), observations(len(TIES.tasks("all").id))
    expected = np.asarray(jax.jit(jax.vmap(policy))(obs, tasks))
    sizes = np.asarray(tasks.params["size"])
    np.testing.assert_allclose(by_jax(obs, sizes[:, None]), expected, atol=2e-5)
    found = np.stack([by_numpy(x, size=float(size)) for x, size in zip(obs, sizes, strict=True)])
    np.testing.assert_allclose(found, expected, atol=2e-5)
    assert np.ptp(expected, axis=0).max() > 1e-3
    assert_onnx_acts(policy, tmp_path / "policy.onnx", obs, sizes, expected)


@pytest.mark.slow
def test_a_choice_is_the_policys_in_all_forms(tmp_path):
    """Of a family of discrete actions: a number, of which every one is chosen somewhere."""
    env = mtjax.make("two-goal-maze-seen")
    policy = policy_of(for_action(tiny("ppo", hidden=(16,)), env.spec.action), env)
    actor = policy.state.nets["actor"]
    head = jax.tree.map(lambda x: 100 * x, actor.shared["head"])
    actor = actor._replace(shared=actor.shared | {"head": head})
    policy = dataclasses.replace(policy, state=with_nets(policy.state, actor=actor))
    file = mtjax.export(policy, tmp_path / "policy.npz")
    by_numpy, by_jax = standalone.load(file), standalone.load_jax(file)
    assert "action 0 to 2" in repr(by_numpy) and "action 0 to 2" in repr(policy)
    obs, boxes = observations(60, env), np.repeat(np.float32([0, 1]), 30)
    tasks = jax.tree.map(lambda x: jnp.repeat(x, 30, axis=0), env.tasks())
    expected = np.asarray(jax.jit(jax.vmap(policy))(obs, tasks))
    assert expected.shape == (60,) and expected.dtype == np.int32 and set(expected) == {0, 1, 2}
    np.testing.assert_array_equal(policy(obs, goal_box=boxes), expected)
    np.testing.assert_array_equal(by_jax(obs, boxes[:, None]), expected)
    found = by_numpy(obs, goal_box=boxes)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.int32
    assert_onnx_acts(policy, tmp_path / "policy.onnx", obs, boxes, expected)


@pytest.mark.slow
def test_several_choices_are_the_policys_in_all_forms(tmp_path):
    """Numbers side by side, each of which differs somewhere."""
    env = Levers(vary={"turn": "0:3"}, split="none", num_draws=8)
    policy = policy_of(for_action(tiny("ppo", hidden=(16,)), env.action), env)
    actor = policy.state.nets["actor"]
    head = actor.shared["head"] | {"kernel": jax.random.normal(jax.random.key(1), (16, 8))}
    actor = actor._replace(shared=actor.shared | {"head": head})
    policy = dataclasses.replace(policy, state=with_nets(policy.state, actor=actor))
    file = mtjax.export(policy, tmp_path / "policy.npz")
    by_numpy, by_jax = standalone.load(file), standalone.load_jax(file)
    assert all("action (2,) below (3, 5)" in repr(x) for x in (by_numpy, policy))
    obs, turns = observations(60, env), np.linspace(0, 3, 60, dtype=np.float32)
    expected = np.asarray(policy(obs, turn=turns))
    assert expected.shape == (60, 2) and expected.dtype == np.int32
    assert all(len(set(x)) > 1 for x in expected.T)
    np.testing.assert_array_equal(by_jax(obs, turns[:, None]), expected)
    found = by_numpy(obs, turn=turns)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.int32
    assert_onnx_acts(policy, tmp_path / "policy.onnx", obs, turns, expected)


# Their bodies are built anew for every task.
COSTLY = {f"cheetah-run-vary-{name}" for name in ("back-foot-length", "foot-position", "foot-size")} | {
    "brax-ant-vary-direction"
}
CHEAP = [name for name in FEW if "vary" in name and name not in COSTLY][::2]


@pytest.mark.parametrize("name", slow_but([name for name in FEW if "vary" in name], *CHEAP, nightly=True))
@pytest.mark.slow
def test_a_file_knows_every_listed_task_by_its_parameters(name):
    """By the number and by the context that the family gives it; an unlisted one has no number of theirs."""
    env = mtjax.make(name)
    listed = env.tasks("all")
    values = np.stack([np.asarray(listed.params[name]) for name, _, _ in ranges(env)], axis=1)
    policy = policy_of(tiny("sac"), env)
    found = jax.jit(jax.vmap(policy.task_of))(values)
    np.testing.assert_array_equal(found.id, listed.id)
    np.testing.assert_allclose(found.context, listed.context, atol=SAME_CONTEXT)
    assert policy.task_of(jnp.asarray(values[0] + 0.003)).id == len(listed.id)


@pytest.mark.slow
def test_an_equally_near_task_is_the_lower_one_however_it_is_rounded():
    """Among 200 tasks, all that lie midway between two; a file's contexts differ from the family's by rounding."""
    env = mtjax.make("finger-spin", vary={"size": "0.95:1.13:200"})
    contexts = env.tasks().context
    random = np.random.default_rng(0)
    midway = (contexts[1:] + contexts[:-1]) / 2
    noise = random.uniform(-SAME_CONTEXT / 2, SAME_CONTEXT / 2, (5, *midway.shape))
    unseen = pick(env.tasks(), 0)._replace(id=jnp.int32(500))
    state = AgentState({"tasks": Params({"known": contexts}, {})}, {}, {})
    nearest = lambda context: state.known(unseen._replace(context=context))
    found = jax.vmap(jax.vmap(nearest))(midway + jnp.float32(noise))
    np.testing.assert_array_equal(found, np.broadcast_to(np.arange(199), (5, 199)))


@pytest.mark.parametrize("name", ["sac-conditioned", "multi-head"])
@pytest.mark.slow
def test_a_file_is_called_as_the_policy_is(name, tmp_path):
    """Alone and in batches, by the same names of parameters, also where the nearest task lends its head."""
    policy = policy_of(tiny(name))
    by_numpy = standalone.load(mtjax.export(policy, tmp_path / "policy.npz"))
    tasks, obs = ENV.tasks("all"), observations(len(ENV.tasks("all").id))
    sizes, few = np.asarray(tasks.params["size"]), {"atol": 2e-5}
    expected = np.asarray(jax.jit(jax.vmap(policy))(obs, tasks))
    for act in (policy, by_numpy):
        np.testing.assert_allclose(act(obs, size=sizes), expected, **few)
        np.testing.assert_allclose(act(obs[0].tolist(), size=float(sizes[0])), expected[0], **few)
        alike = [act(x, size=1.1) for x in obs]
        np.testing.assert_allclose(act(obs, size=1.1), alike, **few)
    sampled = policy(obs, key=jax.random.key(0), size=1.1)
    assert sampled.shape == expected.shape and np.all(np.abs(sampled - np.stack(alike)).sum(axis=1) > 0)


WRONG = {
    "name": ((np.zeros(9),), {"mass": 1.0}, r"give the task's parameters \['size'\], not \['mass'\]"),
    "none": ((np.zeros(9),), {}, r"give the task's parameters \['size'\], not \[\]"),
    "shape": ((np.zeros(3),), {"size": 1.0}, r"obs has shape \(9,\), not \(3,\); a batch has one axis before it"),
    "values": (
        (np.zeros((2, 9)),),
        {"size": np.ones(3)},
        r"size is a number, or an array \(2,\) .* shape \(3,\)",
    ),
    "single": ((np.zeros(9),), {"size": np.ones(2)}, r"size is a number, not of shape \(2,\)"),
    "text": ((np.zeros(9),), {"size": "a"}, "size takes numbers, not text"),
    "texts": ((["a"] * 9,), {"size": 1.0}, "obs takes numbers, not text"),
    "no value": ((np.zeros(9),), {"size": None}, "size takes numbers, not other objects"),
    "too large": ((np.zeros(9),), {"size": 10**5000}, "size takes numbers, not other objects"),
    "complex": ((np.zeros(9),), {"size": 1j}, "size takes numbers, not complex ones"),
    "ragged": (([[1], [1, 2]],), {"size": 1.0}, "obs takes numbers, not lists of different lengths"),
    "key": ((jax.random.key(0),), {"size": 1.0}, "obs takes numbers, not other objects"),
    "dict": (({"pixels": np.zeros(3)},), {"size": 1.0}, r"an observation is a dict of {'obs': \(9,\)}"),
}


@pytest.mark.parametrize("given, parameters, said", WRONG.values(), ids=WRONG)
def test_policy_and_file_refuse_the_same(given, parameters, said, tmp_path):
    """In the same words."""
    policy = policy_of(tiny("sac-conditioned"))
    file = standalone.load(mtjax.export(policy, tmp_path / "x.npz"))
    for act, kind in ((policy, InputError), (file, ValueError)):
        with pytest.raises(kind, match=said):
            act(*given, **parameters)


def test_a_policy_that_reads_no_parameter_needs_none(tmp_path):
    """Though it may be given them."""
    policy, obs = policy_of(tiny("sac")), observations(2)
    for act in (policy, standalone.load(mtjax.export(policy, tmp_path / "x.npz"))):
        np.testing.assert_array_equal(act(obs), act(obs, size=1.1))


def assert_onnx_acts(policy, file, obs, sizes, expected):
    """By ONNX's own runtime, which knows nothing of this package."""
    require("onnx")
    runtime = require("onnxruntime")
    session = runtime.InferenceSession(mtjax.export(policy, file))
    known = {put.name for put in session.get_inputs()}
    for x, size, action in zip(obs, sizes, expected, strict=True):
        given = {"obs": x, "parameters": np.float32([size])}
        (found,) = session.run(["action"], {name: given[name] for name in known})
        np.testing.assert_allclose(found, action, atol=2e-5)
    meta = session.get_modelmeta()
    assert f'"parameters": ["{ranges(policy.env)[0][0]}"]' in meta.custom_metadata_map["mtjax"]


def test_angles_of_goals_are_points_on_the_circle(tmp_path):
    """As in the context that networks learned from."""
    env = mtjax.make("finger-turn-vary-target")
    policy = policy_of(tiny("sac-conditioned"), env)
    by_numpy = standalone.load(mtjax.export(policy, tmp_path / "x.npz"))
    tasks, obs = env.tasks("extrapolation"), observations(4, env)
    for i in range(len(tasks.id)):
        task = jax.tree.map(lambda x, i=i: x[i], tasks)
        action = by_numpy(obs[i], target_angle=float(task.params["target-angle"]))
        np.testing.assert_allclose(action, policy(obs[i], task), atol=2e-5)


def test_the_reader_needs_numpy_alone(tmp_path):
    """Copied elsewhere, in a process that cannot import JAX or this package."""
    policy = policy_of(tiny("sac-conditioned"))
    file = mtjax.export(policy, tmp_path / "policy.npz")
    source = Path(standalone.__file__).read_text()
    (tmp_path / "reader.py").write_text(source)
    script = (
        "import sys; sys.modules['jax'] = sys.modules['mtjax'] = None\n"
        "import numpy as np, reader\n"
        f"policy = reader.load({str(file)!r})\n"
        "print(*policy(np.ones(9), size=1.1).tolist()); print(policy)"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    action, told = done.stdout.splitlines()
    task = jax.tree.map(lambda x: x[1], ENV.tasks())
    np.testing.assert_allclose(np.float32(action.split()), policy(np.ones(9, np.float32), task), atol=2e-5)
    assert told == "Policy(sac-conditioned on finger-spin: observation (9,), action (2,), parameters ['size'])"
    top = [node for node in ast.parse(source).body if isinstance(node, ast.Import | ast.ImportFrom)]
    assert {getattr(node, "module", None) or node.names[0].name for node in top} == {
        "json", "collections.abc", "functools", "typing", "numpy"
    }  # fmt: skip


@pytest.mark.parametrize("content", ["empty", "text", "half", "flipped", "other"])
def test_a_file_that_holds_no_policy_is_refused(content, tmp_path):
    """Whatever it is, and nobody is advised to run what is in it."""
    file = mtjax.export(policy_of(tiny("sac-conditioned")), tmp_path / "x.npz")
    whole = file.read_bytes()
    place = len(whole) // 2
    changed = {"empty": b"", "text": b"text", "half": whole[:place]}
    changed["flipped"] = whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]
    file.write_bytes(changed.get(content, b""))
    if content == "other":
        np.savez(file, weights=np.zeros(3))
    for load in (standalone.load, standalone.load_jax):
        with pytest.raises(ValueError, match=r"x\.npz is no \.npz file of mtjax\.export, or damaged") as caught:
            load(file)
        assert "pickle" not in str(caught.value)


WAYS = {
    "recurrent": {"conditioning": "recurrent", "recurrent_size": 4},
    "inferred": {"conditioning": "inferred", "inferred_from": 3},
    "transformer": {"conditioning": "transformer", "transformer_size": 4, "transformer_heads": 2, "attended_steps": 3},
    **{way: {"conditioning": "posterior", "inference": way, "latent_size": 2} for way in ("varibad", "pearl", "cadm")},
}


@pytest.mark.slow
@pytest.mark.parametrize("way", slow_but(WAYS, "recurrent", nightly=True))
@pytest.mark.parametrize("scores", one_in(2, [False, True]))
def test_a_memory_goes_into_the_file(way, scores, tmp_path):
    """By NumPy and by JAX: actions, and memories through the episodes of a trial, for one world and for a batch."""
    env = mtjax.make("grid-navi", size=3, steps=2, scores=scores)
    settings = WAYS[way] | ({"inferred_from": 3} if way == "cadm" else {})
    policy = dataclasses.replace(policy_of(for_action(tiny("ppo", **settings), env.spec.action), env), trial=2)
    file = mtjax.export(policy, tmp_path / "policy.npz")
    reader, act, remember = standalone.load(file), standalone.load_jax(file), standalone.load_jax(file, "remember")
    task, held, random = pick(env.tasks()._replace(draws=None), 0), reader.begin(), np.random.default_rng(0)
    memory = policy.begin(task)
    np.testing.assert_allclose(reader(np.eye(9, dtype=np.float32)[0]), reader(np.eye(9, dtype=np.float32)[0], held))
    for t in range(4):
        obs, after = np.eye(9, dtype=np.float32)[random.integers(9, size=2)]
        action, reward, ended = policy(obs, task, memory=memory), random.normal(), t % 2 == 1
        np.testing.assert_allclose(reader(obs, held), action, atol=2e-5)
        both, many = np.stack([held, held + 0.1]), np.stack([obs, obs])
        np.testing.assert_allclose(act(many, np.zeros((2, 0)), both), reader(many, both), atol=2e-5)
        memory = policy.remember(memory, task, obs, action, reward, after, ended)
        step = np.asarray(action), np.float32(reward), after, np.float32(ended)
        batch = [np.stack([x, x]) for x in step]
        found = remember(many, np.zeros((2, 0)), both, *batch)
        np.testing.assert_allclose(reader.remember(both, many, *batch), found, atol=2e-5)
        held = reader.remember(held, obs, action, reward, after, ended)
        np.testing.assert_allclose(found[0], held, atol=2e-5)
    known = jax.tree.leaves((memory.past, memory.hidden))
    np.testing.assert_allclose(held, np.concatenate([np.ravel(x) for x in known]), atol=2e-5)
    assert reader.meta["trial"] == 2 and not np.allclose(held, reader.begin())
    with pytest.raises(InputError, match=r"remembers its trial is exported to a file that ends with \.npz"):
        mtjax.export(policy, tmp_path / "policy.onnx")


def test_a_policy_without_a_memory_begins_none(tmp_path):
    reader = standalone.load(mtjax.export(policy_of(tiny("sac")), tmp_path / "policy.npz"))
    with pytest.raises(ValueError, match="acts by what it sees, and has no memory to begin"):
        reader.begin()


@pytest.mark.slow
def test_what_cannot_be_exported_is_refused(tmp_path, monkeypatch):
    """In a line, and nothing is overwritten."""
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'mtjax\[onnx\]'"):
        require_file(tmp_path / "x.onnx")
    monkeypatch.undo()
    (tmp_path / "x.npz").touch()
    for file, said in (
        (tmp_path / "x.npz", "exists already"),
        (tmp_path / "x.pt", "ends with .npz or .onnx"),
        (3, "a path"),
    ):
        with pytest.raises(InputError, match=said):
            require_file(file)
    with pytest.raises(InputError, match="export takes a policy"):
        mtjax.export(3, tmp_path / "y.npz")
    with pytest.raises(InputError, match="goes on with what it has chosen"):
        mtjax.export(policy_of(tiny("options")), tmp_path / "y.npz")
    with pytest.raises(InputError, match="knows no operation 'sort'"):
        steps_of(jax.make_jaxpr(jnp.sort)(jnp.zeros(3)))
    assert [path.name for path in tmp_path.iterdir()] == ["x.npz"]


@pytest.mark.slow
def test_the_command_exports_a_run(copied_run, tmp_path, capsys):
    """Beside its scores."""
    file = tmp_path / "policy.npz"
    mtjax.evaluate.main([f"--run={copied_run}", "--episodes=1", f"--export={file}"])
    assert f"exported to {file}" in capsys.readouterr().out
    policy = mtjax.load(copied_run)
    task = jax.tree.map(lambda x: x[0], policy.env.tasks())
    obs = np.ones(9, np.float32)
    np.testing.assert_allclose(standalone.load(file)(obs, size=1.0), policy(obs, task), atol=2e-5)
