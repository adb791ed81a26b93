"""What each command imports: answers that need names alone come without JAX, and MuJoCo C without the other engines."""

import contextlib
import dataclasses
import inspect
import itertools
import json
import os
import subprocess
import sys
from threading import Event
from types import SimpleNamespace

import pytest
from mujoco import mjx
from own_process import environment
from probes import FEW, family_for, param

import mtjax
from mtjax import names, train
from mtjax.agents import AGENTS, CHOICES, PARTS, settings
from mtjax.agents.hyperparameters import flag_names
from mtjax.command import class_sources, help, refusals, run_config, xla_flags
from mtjax.config import with_preset
from mtjax.envs import ENVS, SUITES, fields, outline
from mtjax.envs.brax import NAMES
from mtjax.names import InputError, load

TILINGS = "xla_gpu_experimental_cost_model_gemm_tiling_options"
HEAVY = ("jax", "flax", "optax", "mujoco", "orbax", "brax", "warp", "matplotlib", "mtjax.config")
ENGINES = ("mujoco.mjx", "warp", "brax")
# Runs a command and says, as the last line of its output, which of some modules were imported.
SCRIPT = """
import json, runpy, sys
module, words, asked = json.loads(sys.argv[1])
sys.argv = [module, *words]
try:
    runpy.run_module(module, run_name="__main__") if "." in module else __import__(module)
finally:
    print(json.dumps([name for name in asked if name in sys.modules]))
"""


def run(module, words, asked, folder):
    """Run a command in a process of its own; returns its exit code, its output, and what of ``asked`` it imported."""
    env = environment(MTJAX_CACHE="0", JAX_PLATFORMS="cpu")
    given = json.dumps([module, words, asked])
    command = [sys.executable, "-c", SCRIPT, given]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=600)
    *output, imported = done.stdout.splitlines()
    return done.returncode, "\n".join([*output, done.stderr]), json.loads(imported)


@pytest.fixture
def ours(monkeypatch):
    """Forgets the families that other tests have registered."""
    monkeypatch.setattr(ENVS, "data", {name: entry for name, entry in ENVS.data.items() if isinstance(entry[0], str)})


@pytest.mark.parametrize(
    "module, words, code, said",
    [
        ("mtjax", [], 0, ""),
        ("mtjax.train", ["--list"], 0, "two-goal-maze-seen"),
        ("mtjax.train", ["--help"], 0, "--eval-every"),
        ("mtjax.train", ["--env=finger-spn"], 2, "did you mean 'finger-spin'?"),
        ("mtjax.train", ["--agent", "carr"], 2, "did you mean 'care'?"),
        ("mtjax.train", ["--preset=gpus"], 2, "did you mean 'gpu'?"),
        ("mtjax.train", ["--seeds", "3.5"], 2, "--seeds must be a whole number, not '3.5'"),
        (
            "mtjax.train",
            ["--num-env=3"],
            2,
            "'--num-env'; did you mean '--num-envs'? --help lists the flags",
        ),
        ("mtjax.train", ["--agent.num_expert", "3"], 2, "did you mean '--agent.num-experts'?"),
        ("mtjax.train", ["--import=nothing.py"], 2, "--import needs a Python file"),
        ("mtjax.train", ["--resume=nowhere"], 2, "'nowhere' is not a run"),
        ("mtjax.train", ["--resume=nowhere", "--num-envs=3"], 2, "only --steps may change, not --num-envs"),
        ("mtjax.train", ["--from=nowhere"], 2, "'nowhere' is not a run"),
        ("mtjax.evaluate", ["--help"], 0, "--episodes"),
        ("mtjax.evaluate", ["--run=nowhere"], 2, "'nowhere' is not a run"),
        ("mtjax.evaluate", ["--runs=x"], 2, "did you mean '--run'?"),
        ("mtjax.evaluate", ["--run=x", "--episodes=some"], 2, "some"),
        ("mtjax.evaluate", [], 2, "say which run to evaluate"),
        ("mtjax.evaluate", ["--run=x", "--video-tasks=1"], 2, "give --video as well"),
        ("mtjax.plot", ["--help"], 0, "--figure"),
        ("mtjax.plot", ["x", "--figure=curve"], 2, "did you mean 'curves'?"),
    ],
)
def test_names_are_answered_without_jax(tmp_path, module, words, code, said):
    """Nor anything else that takes long to import."""
    found, output, imported = run(module, words, HEAVY, tmp_path)
    assert (found, imported) == (code, []) and said in output


def test_a_reader_may_stop_early(tmp_path):
    """As ``head`` does; nothing is said of it."""
    command = [sys.executable, "-m", "mtjax.train", "--list"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=tmp_path, env=environment(), text=True, **pipes) as process:
        process.stdout.close()
        assert process.stderr.read() == "" and process.wait(60) == 1


@pytest.mark.slow
def test_a_run_of_the_c_engine_imports_no_other(tmp_path):
    """From the command line to the last evaluation."""
    small = (
        "--steps=100 --eval-episodes=1 --num-envs=2 --batch-size=4 --replay-size=200 --warmup-steps=5 --chunk-steps=25"
    )
    words = ["--env=finger-spin", "--engine=c", *small.split(), "--agent.hidden=8", f"--runs={tmp_path}"]
    code, output, imported = run("mtjax.train", words, (*ENGINES, "mujoco"), tmp_path)
    assert code == 0 and "done in" in output
    assert imported == ["mujoco"]


def test_devices_are_found_while_the_rest_is_imported(monkeypatch):
    """A driver that takes long keeps nobody waiting who needs no device, and tells its errors to who needs one."""
    asked, imported, answered, waited = Event(), Event(), Event(), []

    def devices():
        asked.set()
        waited.append(imported.wait(60))
        answered.set()
        raise RuntimeError("no device")

    def load(place):
        rest = lambda *_: (asked.wait(60), imported.set())
        return rest if place == "mtjax.command.train:main" else names.load(place)

    monkeypatch.setattr("jax.devices", devices)
    monkeypatch.setitem(inspect.unwrap(train.main).__globals__, "load", load)
    train.main(["--env=finger-spin"])
    assert answered.wait(60) and waited == [True]


PAIRS = [*((env, "sac") for env in FEW), *((family_for(agent), agent) for agent in AGENTS)]


@pytest.mark.parametrize("env, agent", map(param, PAIRS))
def test_no_flag_is_refused_that_there_is(env, agent, ours):
    """Of any family or agent, before either is known."""
    flags = run_config.flags(with_preset(env, agent, "cpu"))
    refusals.check_flags([*flags, *(f"{flag}=1" for flag in flags)])


def test_flags_of_all_families_and_agents_are_known_without_jax(ours):
    """All of them and no other name, with which are switches of any: what is misspelt is answered with a flag."""
    choices = [{kind: name} for kind in CHOICES for name in PARTS[kind]] + [{"scaling": "ars", "reset_every": 100}]
    real = {"--help": False, "--import": False} | {f"--agent.{kind}": False for kind in CHOICES}
    real |= run_config.flags(mtjax.preset("cartpole-swingup+finger-spin", "sac"))
    for cls in {cls for cls, _ in ENVS.values()} | set(map(load, SUITES.values())):
        for flag, (_, kind) in run_config.setting_flags(cls, "env").items():
            real[flag] = real.get(flag, False) or kind is bool
    for agent, given in itertools.product(
        ("sac", "distral", "brc", "simba-v2", "xqc", "ppo", "impala", "pqn", "sketches", "options", "maml", "distil"),
        [{}, *choices],
    ):
        needed = {"vectors": "file.npy"} if given == {"conditioning": "vectors"} else {}
        with contextlib.suppress(InputError):  # which this agent does not go with
            made = mtjax.agent(agent, **given, **needed)
            real |= {f"--{flag}": isinstance(settings(made)[name], bool) for name, flag in flag_names(made).items()}
    assert class_sources.all_flags() == real


@pytest.mark.parametrize(
    "given, told",
    [
        ("--nam=x", "unknown flag '--nam'; --help lists"),
        ("--no-stager", "did you mean '--no-stagger'"),
        ("--tau=1", "did you mean '--agent.tau'"),
    ],
)
def test_an_unknown_flag_is_answered_with_a_real_one(ours, given, told):
    """If one is near. Other names in the classes' source, such as ``name``, are no flags."""
    with pytest.raises(InputError, match=told):
        refusals.check_flags([given])


def test_no_way_to_write_a_flag_is_refused(ours):
    """With underscores, switched off, or by a name that only the command line knows; and values are no flags."""
    words = "--env.vary.mass=1:2:3 --agent.no-shared_temperature --num_envs=3 --no-profile --from=x --help -h 1 -3"
    refusals.check_flags(words.split())


def test_a_class_of_the_users_own_may_have_any_flag(ours, monkeypatch):
    """What its settings are is known once the command line is read in full."""
    with pytest.raises(InputError, match=r"unknown flag '--env\.springiness'"):
        refusals.check_flags(["--env.springiness=3"])
    monkeypatch.setitem(ENVS, "mine", ENVS["finger-spin"])
    refusals.check_flags(["--env.springiness=3"])


@pytest.mark.parametrize("name", map(param, ENVS))
def test_outline_is_what_the_family_says(name):
    """Tasks are counted without its class, and the sentence is read without running its file."""
    count, says = outline(name)
    family = mtjax.make(name)
    assert count == family.train_count
    assert " ".join(type(family).__doc__.split()).startswith(says) and len(says) > 20


def test_outline_of_a_class_that_is_given_is_the_same(monkeypatch):
    """As of a family that a user registers."""
    for name in ("finger-spin-vary-size", "bandit", "control-acrobot"):
        listed = outline(name)
        monkeypatch.setitem(ENVS, name, ENVS[name])
        assert outline(name) == listed and not isinstance(ENVS.data[name][0], str)


def test_every_environment_of_brax_is_registered():
    """By the name that Brax gives it."""
    assert {settings["environment"] for name, (_, settings) in ENVS.items() if "environment" in settings} == set(NAMES)


def test_an_agent_may_be_given_as_a_class(monkeypatch):
    """Beside those that are named by their place."""
    cls = AGENTS["distral"].cls
    assert dataclasses.is_dataclass(cls) and cls.__name__ == "Distral"
    monkeypatch.setitem(AGENTS, "mine", AGENTS["sac"]._replace(place=cls))
    assert type(mtjax.agent("mine")) is cls
    assert "mine" in help.catalogue()


def test_fields_of_models_are_those_of_mjx():
    """Which may differ between tasks, and which must not."""
    model = mtjax.make("finger-spin").models[0]
    traced, static = set(), {"site_size"}
    for owner, prefix, own in ((mjx.Model, "", model), (mjx.Option, "opt.", model.opt)):
        for field in dataclasses.fields(owner):
            if hasattr(own, field.name) and not field.name.startswith(fields.UNUSED) and field.name != "opt":
                (traced if "Array" in str(field.type) else static).add(prefix + field.name)
    assert set(fields.VARIABLE) == traced | {"site_size"}
    assert set(fields.FIXED) == static - {"site_size"}


@pytest.mark.parametrize(
    ("version", "gpu", "given", "expected"),
    [
        ("0.11.2", True, "", f"--{TILINGS}=top=4,top_from_default=1"),
        ("0.10.2", True, "--xla_dump_to=x", f"--xla_dump_to=x --{TILINGS}=top=4,top_from_default=1"),
        ("0.11.0.dev3", True, "", f"--{TILINGS}=top=4,top_from_default=1"),
        ("0.11.2", True, f"--{TILINGS}=top=1", f"--{TILINGS}=top=1"),
        ("0.11.2", False, "", ""),
        ("0.10.1", True, "", ""),
        ("0.12.0.1", True, "", f"--{TILINGS}=top=4,top_from_default=1"),
        ("0.13.0", True, "", ""),
    ],
)
def test_xla_is_given_only_a_flag_that_it_knows(monkeypatch, version, gpu, given, expected):
    """XLA ends the process at others."""
    monkeypatch.setenv("XLA_FLAGS", given)
    monkeypatch.setattr(xla_flags, "metadata", SimpleNamespace(version=lambda package: version))
    monkeypatch.setattr(xla_flags, "util", SimpleNamespace(find_spec=lambda name: object() if gpu else None))
    xla_flags.try_few_tilings()
    assert os.environ["XLA_FLAGS"] == expected


def test_this_xla_knows_the_flag():
    """A program computes under it, on any device."""
    program = "from mtjax.command import xla_flags; xla_flags._has_gpu = lambda: True; xla_flags.try_few_tilings()\n"
    program += "import os, jax; print('gemm_tiling' in os.environ['XLA_FLAGS'], float(jax.numpy.ones(3).sum()))"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["True", "3.0"]
