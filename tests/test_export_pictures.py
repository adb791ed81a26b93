"""Policies that see pictures in one file: in every form they act as the policy does along an episode of a maze."""

import json
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import require
from probes import slow_but, tiny
from test_export import policy_of

import mtjax
import mtjax.evaluate
from mtjax import standalone
from mtjax.saved import onnx, policy_files
from mtjax.saved.operations import steps_of
from mtjax.types import InputError

COLOURED = mtjax.make("corridor-maze", pixels=16, frames=3, vary={"hue": "0:200:3"})
BESIDE = mtjax.make("corridor-maze", pixels=16, frames=2, grey=True, state="also", vary={"hue": "0:200:3"})


@lru_cache
def episode(env):
    """What an agent sees in the first steps of the second task: observations with leaves (H, ...)."""
    shown, task = mtjax.stacked(env), jax.tree.map(lambda x: x[1], env.tasks())
    step, found = jax.jit(shown.reset)(task, jax.random.key(0)), []
    advance = jax.jit(shown.step)
    for turn in (1.0, 1.0, -0.5, 0.3):
        found.append(jax.tree.map(np.asarray, step.obs))
        step = advance(task, step.state, np.float32([1.0, turn]))
    return jax.tree.map(lambda *x: np.stack(x), *found)


def by_onnx(file, obs, hue):
    """The actions of ONNX's own runtime, and the names of the model's inputs."""
    session = require("onnxruntime").InferenceSession(file)
    names = [put.name for put in session.get_inputs()]
    given = lambda i: {name: obs[name][i] for name in names if name in obs} | {"parameters": np.float32([hue])}
    count = len(obs["pixels"])
    return [session.run(["action"], {n: given(i)[n] for n in names})[0] for i in range(count)], set(names)


CASES = {
    "drq": ("drq", COLOURED, {}),
    "drq-impala": ("drq", BESIDE, {"vision": "impala", "normalize_observations": True}),
    "drq-of-each-task": ("drq", COLOURED, {"heads": "disjoint"}),
    "drq-impala-of-each-task": ("drq", BESIDE, {"heads": "disjoint", "vision": "impala"}),
    "sac-ae": ("sac-ae", COLOURED, {"conditioning": "embedding"}),
    "moore-encoded": ("moore", COLOURED, {"representation": "encoded"}),
    "asymmetric": ("drq", BESIDE, {"representation": "asymmetric", "conditioning": "one-hot"}),
    "hip-bmdp": ("hip-bmdp", COLOURED, {}),
    "ppo": ("ppo", BESIDE, {"representation": "encoded"}),
    "ppo-impala": ("ppo", COLOURED, {"representation": "encoded", "vision": "impala"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_but(CASES, "drq", nightly=True))
def test_every_form_acts_as_the_policy(name, tmp_path):
    """For training tasks and for one between them. Files take of an observation what the policy needs."""
    agent, env, settings = CASES[name]
    policy, obs = policy_of(tiny(agent, **settings), env), episode(env)
    file = mtjax.export(policy, tmp_path / "policy.npz")
    by_numpy, by_jax = standalone.load(file), standalone.load_jax(file)
    require("onnx")
    model = mtjax.export(policy, tmp_path / "policy.onnx")
    taken = {name: obs[name] for name in by_numpy.meta["obs"]}
    assert set(taken) == ({"pixels"} if name == "asymmetric" else set(env.spec.obs))
    act, actions = jax.jit(jax.vmap(policy, (0, None))), []
    for split, number in (("train", 1), ("train", 2), ("interpolation", 0)):
        task = jax.tree.map(lambda x, i=number: x[i], env.tasks(split))
        hue = float(task.params["hue"])
        expected = np.asarray(act(obs, task))
        pick = lambda i: jax.tree.map(lambda x: x[i], obs)
        np.testing.assert_allclose([by_numpy(pick(i), hue=hue) for i in range(4)], expected, atol=2e-5)
        np.testing.assert_allclose(by_jax(taken, np.full((4, 1), hue, np.float32)), expected, atol=2e-5)
        np.testing.assert_allclose(by_onnx(model, obs, hue)[0], expected, atol=2e-5)
        actions.append(expected)
    assert np.ptp(actions, axis=1).max() > 1e-3


@pytest.mark.slow
def test_the_reader_stacks_pictures_as_agents_see_them():
    obs = episode(COLOURED)["pixels"]
    stack = standalone.begin(obs[0][..., -3:], 3)
    np.testing.assert_array_equal(stack, obs[0])
    for after in obs[1:]:
        stack = standalone.push(stack, after[..., -3:])
        np.testing.assert_array_equal(stack, after)
    assert len(np.unique(obs, axis=0)) == len(obs)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A policy that sees pictures beside the state, and does not read the task's parameters."""
    policy = policy_of(tiny("drq", conditioning="none"), BESIDE)
    return mtjax.export(policy, tmp_path_factory.mktemp("exported") / "policy.npz")


@pytest.mark.slow
def test_a_file_tells_how_to_make_what_it_sees(file):
    """Shapes, the order of pictures and channels, and how an episode begins."""
    policy = standalone.load(file)
    assert policy.meta["obs"] == {"pixels": [16, 16, 2], "state": [4]}
    assert (policy.meta["frames"], policy.meta["seconds"]) == (2, 0.1)
    about = policy.meta["about"]
    for told in ("last 2 pictures (16, 16, 1)", "last axis, oldest first", "0.299 red + 0.587 green + 0.114 blue"):
        assert told in about
    assert "begins with its first picture 2 times" in about and "state (4,) float32" in about
    assert "observation pixels (16, 16, 2), state (4,), action (2,), parameters ['hue']" in str(policy)


@pytest.mark.slow
def test_parameters_that_are_not_read_may_be_left_out(file, tmp_path):
    """Looks of a picture vary in training, and nobody knows them later."""
    policy, obs = standalone.load(file), jax.tree.map(lambda x: x[0], episode(BESIDE))
    np.testing.assert_array_equal(policy(obs), policy(obs, hue=100.0))
    with pytest.raises(ValueError, match=r"give the task's parameters \['hue'\], not \['light'\]"):
        policy(obs, light=1.0)
    require("onnx")
    model = mtjax.export(policy_of(tiny("drq", conditioning="none"), BESIDE), tmp_path / "x.onnx")
    assert by_onnx(model, episode(BESIDE), 0.0)[1] == {"pixels", "state"}


@pytest.mark.slow
def test_pictures_that_no_policy_saw_are_refused(file):
    policy, obs = standalone.load(file), jax.tree.map(lambda x: x[0], episode(BESIDE))
    for wrong, said in (
        (obs["pixels"], r"is a dict of {'pixels': \(16, 16, 2\), 'state': \(4,\)}"),
        ({"pixels": obs["pixels"]}, "is a dict of"),
        (obs | {"pixels": obs["pixels"][..., :1]}, r"shape \(16, 16, 2\), not \(16, 16, 1\); begin and push"),
        (obs | {"pixels": obs["pixels"] / 255}, "are uint8, from 0 to 255, not float64"),
    ):
        with pytest.raises(ValueError, match=said):
            policy(wrong)


def test_files_from_before_pictures_are_read(tmp_path):
    """They tell the size of the vector alone."""
    policy = policy_of(tiny("sac-conditioned"), mtjax.make("finger-spin", vary={"size": "1:1.2:3"}))
    with np.load(mtjax.export(policy, tmp_path / "new.npz")) as found:
        arrays = dict(found)
    text = lambda x: np.frombuffer(json.dumps(x).encode(), np.uint8)
    meta, program = (json.loads(bytes(arrays[name])) for name in ("meta", "program"))
    del meta["obs"], program["reads"]
    np.savez(tmp_path / "old.npz", **arrays | {"meta": text(meta | {"obs_size": 9}), "program": text(program)})
    old, new = (standalone.load(tmp_path / f"{name}.npz") for name in ("old", "new"))
    np.testing.assert_array_equal(old(np.ones(9), size=1.1), new(np.ones(9), size=1.1))


@pytest.mark.slow
def test_an_action_depends_on_what_is_shipped_alone():
    """Also of a policy that sees pictures."""
    policy = policy_of(tiny("drq"), COLOURED)
    read, (leaves, form) = policy_files.read_by_acting(policy), jax.tree.flatten(policy.state)
    other = jax.tree.unflatten(form, [x if i in read else jnp.full_like(x, 3) for i, x in enumerate(leaves)])
    task, obs = jax.tree.map(lambda x: x[0], COLOURED.tasks()), jax.tree.map(lambda x: x[0], episode(COLOURED))
    act = jax.jit(lambda state: policy.agent.act(state, policy.agent.begin(state, task), obs, task, None).action)
    assert 0 < len(read) < len(leaves)
    np.testing.assert_array_equal(act(policy.state), act(other))


# Operations on pictures.


def convolution(strides, padding, dilation, layout):
    def apply(x):
        kernel = jnp.float32(np.random.default_rng(1).normal(size=(3, 2, 4, 5)))  # height, width, in, out
        kernel = jnp.transpose(kernel, ["HWIO".index(axis) for axis in layout[1]])
        return jax.lax.conv_general_dilated(x, kernel, strides, padding, None, dilation, layout)

    return apply


def pooling(sizes, strides, padding, dilation=None):
    return lambda x: jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, sizes, strides, padding, None, dilation)


OPERATIONS = {
    "plain": ((2, 9, 8, 4), convolution((1, 1), "VALID", None, ("NHWC", "HWIO", "NHWC"))),
    "same": ((2, 9, 8, 4), convolution((2, 3), "SAME", None, ("NHWC", "HWIO", "NHWC"))),
    "uneven": ((2, 9, 8, 4), convolution((1, 2), ((0, 3), (2, 1)), (2, 3), ("NHWC", "HWIO", "NHWC"))),
    "channels-first": ((2, 4, 9, 8), convolution((2, 1), ((1, 0), (0, 2)), None, ("NCHW", "OIHW", "NHWC"))),
    "channels-last-of-kernels": ((9, 2, 8, 4), convolution((1, 1), "SAME", None, ("HNWC", "WOHI", "CHNW"))),
    "pool": ((2, 9, 8, 4), pooling((1, 3, 3, 1), (1, 2, 2, 1), "SAME")),
    "pool-a-picture": ((9, 8, 4), pooling((2, 3, 1), (2, 1, 1), ((0, 1), (1, 0), (0, 0)), (2, 1, 1))),
    "pool-channels": ((2, 9, 8, 4), pooling((1, 1, 1, 2), (1, 1, 1, 2), "VALID")),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_convolutions_and_pooling_are_those_of_jax(name, tmp_path):
    """In every layout, with strides, gaps and sides that differ."""
    shape, apply = OPERATIONS[name]
    x = np.float32(np.random.default_rng(0).normal(size=shape)) - 3  # so that filling with 0 would show
    expected = np.asarray(apply(x)).ravel()
    program, constants = steps_of(jax.make_jaxpr(lambda x: apply(x).ravel())(x))
    found = standalone._run(json.loads(json.dumps(program)), constants, [x])
    np.testing.assert_allclose(found, expected, atol=1e-4)
    require("onnx")
    runtime = require("onnxruntime")
    meta = {"agent": "one", "env": "none", "about": "", "action_size": expected.size}
    onnx.write(program, constants, {"x": jax.ShapeDtypeStruct(shape, jnp.float32)}, meta, tmp_path / "x.onnx")
    (found,) = runtime.InferenceSession(tmp_path / "x.onnx").run(["action"], {"x": x})
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize(
    ("setting", "values"),
    [("lhs_dilation", {"lhs_dilation": (2, 2)}), ("feature_group_count", {"feature_group_count": 2})],
)
def test_other_convolutions_are_refused(setting, values):
    kernel, layout = jnp.zeros((3, 3, 4 // values.get("feature_group_count", 1), 6)), ("NHWC", "HWIO", "NHWC")
    apply = lambda x: jax.lax.conv_general_dilated(x, kernel, (1, 1), [(0, 0)] * 2, dimension_numbers=layout, **values)
    with pytest.raises(InputError, match=rf"knows no 'conv_general_dilated' with {setting}="):
        steps_of(jax.make_jaxpr(apply)(jnp.zeros((1, 8, 8, 4))))


@pytest.mark.nightly
def test_the_command_exports_a_run_from_pictures(tmp_path, capsys):
    """What it writes plays an episode that the reader's own stacks show it."""
    small = dict(hidden=(8,), latent_widths=(4,), num_envs=2, batch_size=4, replay_size=100, warmup_steps=10)
    run = tmp_path / "run"
    plan = dict(steps=40, chunk_steps=10, eval_episodes=1, n_step=1, directory=run)
    mtjax.train(BESIDE, "drq", normalize_observations=True, **plan, **small)
    exported, model = tmp_path / "policy.npz", tmp_path / "policy.onnx"
    mtjax.evaluate.main([f"--run={run}", "--episodes=1", f"--export={exported}"])
    assert f"exported to {exported}" in capsys.readouterr().out
    policy, reader = mtjax.load(run), standalone.load(exported)
    mtjax.export(policy, model)
    task, obs = jax.tree.map(lambda x: x[1], policy.env.tasks()), episode(BESIDE)
    hue = float(task.params["hue"])
    stack = None
    for i, expected in enumerate(jax.vmap(lambda x: policy(x, task))(obs)):
        picture = obs["pixels"][i][..., -1:]
        stack = standalone.begin(picture, reader.meta["frames"]) if stack is None else standalone.push(stack, picture)
        np.testing.assert_allclose(reader({"pixels": stack, "state": obs["state"][i]}, hue=hue), expected, atol=2e-5)
        np.testing.assert_allclose(by_onnx(model, obs, hue)[0][i], expected, atol=2e-5)
