"""The command line: what it accepts, what it records, and how it says what is wrong."""

import contextlib
import dataclasses
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib import resources

import jax
import numpy as np
import pytest
from conftest import SHORT_RUN
from needs import needs
from own_process import environment
from probes import FEW, OFF_POLICY, family_for, one_in, slow_but

import mtjax.evaluate
import mtjax.plot
import mtjax.train
from mtjax.agents import AGENTS
from mtjax.agents import settings as settings_of
from mtjax.agents.hyperparameters import CHOICES
from mtjax.agents.parts.representations import DeepMDP
from mtjax.command import class_sources, flag_files, process, run_config
from mtjax.command.run_config import parse
from mtjax.config import Plan, for_tasks, load_preset, with_preset
from mtjax.envs import BENCHMARKS, ENVS, SUITES
from mtjax.learning.loop import Settings
from mtjax.names import notice
from mtjax.saved import pretrained
from mtjax.saved.config_json import from_json, to_flags, to_json
from mtjax.training import launch
from mtjax.training.launch import slow_on_cpu
from mtjax.training.memory import explaining
from mtjax.types import InputError

COMMANDS = {"train": mtjax.train.main, "evaluate": mtjax.evaluate.main}
PRESET_FILES = [file for file in (resources.files("mtjax") / "configs").iterdir() if file.name.endswith(".toml")]


@pytest.fixture
def complaint(monkeypatch, capsys, tmp_path, short_family):
    """Run a program that must refuse its command line; returns what it said."""
    monkeypatch.chdir(tmp_path)

    def complaint(command, *words):
        monkeypatch.setattr("sys.argv", [command, *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            process.main(COMMANDS[command])
        said = capsys.readouterr().err
        assert stop.value.code == 2 and said.startswith("error: ") and said.count("\n") == 1
        assert len(said) < 400
        return said

    return complaint


def words_of(text):
    """The words of a help text, whose lines are framed and wrapped."""
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


# Names and settings.


def test_names_choose_the_defaults():
    """What is given changes them, and nothing else."""
    program = parse(["--env=finger-spin-vary-size", "--agent=care", "--agent.num-experts=3", "--preset=gpu"])
    named = with_preset("finger-spin-vary-size", "care", "gpu")
    encoder = dataclasses.replace(named.learner.encoder, num_experts=3)
    assert program == dataclasses.replace(named, learner=dataclasses.replace(named.learner, encoder=encoder))
    assert program.family == mtjax.make("finger-spin-vary-size")
    assert named != with_preset("finger-spin-vary-size", "care", "cpu")


@pytest.mark.parametrize("agent", ["sac", "ppo"])
def test_a_representation_brings_its_flags(agent, tmp_path):
    """Whatever the agent; and a record of them is read back."""
    program = parse([f"--agent={agent}", "--agent.representation=deepmdp", "--agent.latent-widths", "8", "4"])
    assert program.learner.representation == DeepMDP(latent_widths=(8, 4))
    assert settings_of(program.learner)["latent_widths"] == (8, 4)
    (tmp_path / "config.json").write_text(to_json(program, {"command": "x"}))
    assert from_json(tmp_path / "config.json") == program


@pytest.mark.parametrize(
    "words",
    [
        ["--env=finger-spin", "--num-envs=3", "--agent.actor-lr=0.5", "--agent.shared-temperature"],
        ["--env", "finger-spin", "--num-envs", "3", "--agent.actor-lr", "0.5", "--agent.shared-temperature"],
        ["--env=finger-spin", "--num_envs=3", "--agent.actor_lr=0.5", "--agent.shared_temperature"],
    ],
)
def test_flags_may_be_written_in_three_ways(words):
    """With an equals sign, with a space, and with underscores."""
    program = parse(words)
    assert (program.env, program.training.num_envs, program.learner.actor_lr) == ("finger-spin", 3, 0.5)
    assert program.learner.shared_temperature


def test_flags_that_decide_may_be_written_with_underscores():
    """A memory's minibatches are fitted to the worlds that are given."""
    words = ["--env=point-mass-vary-goal", "--env.num-tasks=50", "--split=none", "--agent=rl2", "--preset=gpu"]
    assert parse([*words, "--num_envs=41"]) == parse([*words, "--num-envs=41"])


@pytest.mark.parametrize(
    ("words", "plain"),
    [
        ("--steps=1e6", "--steps=1000000"),
        ("--steps 2.5e5 --seeds=3.0", "--steps=250000 --seeds=3"),
        ("--eval_every=1E+3", "--eval-every=1000"),
        ("--stagger=False", "--no-stagger"),
        ("--stagger=true --profile=false", "--stagger --no-profile"),
        ("--agent.shared_temperature=True", "--agent.shared-temperature"),
        ("--env=bandit+tabular-mdp --stagger=false", "--env=bandit+tabular-mdp --no-stagger"),
    ],
)
def test_numbers_and_switches_may_be_written_as_in_python(words, plain):
    assert parse(words.split()) == parse(plain.split())


def test_last_of_a_repeated_name_counts():
    """As it does for every other flag."""
    program = parse(["--agent=care", "--steps=1", "--agent", "multi-head", "--steps=2"])
    assert (program.agent, program.learner.heads, program.plan.steps) == ("multi-head", "per-task", 2)


PAIRS = [(env, "sac") for env in FEW] + [(family_for(agent), agent) for agent in AGENTS]


@pytest.mark.parametrize("env, agent", one_in(5, PAIRS, nightly=True))
def test_a_record_is_read_back_as_it_was(env, agent, tmp_path):
    """For every family and agent, with settings that no default has."""
    family = mtjax.make(env)
    names = [] if env == "brax-fast" else list(family.parameters)[:1]  # which has nothing that could vary
    given = {name: str(family.parameters[name].nominal) for name in names}
    vary = [f"--env.vary.{name}={values}" for name, values in given.items()]
    words = [f"--env={env}", f"--agent={agent}", "--agent.hidden", "7", "7", "--split=none", *vary]
    program = parse(words)
    assert given.items() <= dict(program.family.vary).items()
    (tmp_path / "config.json").write_text(to_json(program, {"command": "x"}))
    assert from_json(tmp_path / "config.json") == program


SETTINGS = [
    "",
    "--steps=123 --seed=4 --seeds=2 --eval-every=7 --eval-episodes=3",
    "--agent.hidden 6 6 6 --agent.critic-hidden 9 9 --agent.actor-lr=1e-05 --agent.target-entropy=-0.25",
    "--agent.shared-temperature --agent.no-critic-layer-norm --agent.normalize-observations",
    "--env.vary.size=.95,1,1.05,1.1,1.15,1.2,1.25,1.3,1.35,1.4 --split=hip-bmdp --engine=c --env.solver-iterations=3",
    "--env.vary.touch-size 0.1:0.3:3 --env.vary.size=1:1.1 --env.num-draws=5 --engine mjx",
    "--env.vary.touch-size=0.1,0.3 --env.vary.size=1:1.1 --env.combine=random --env.num-tasks=3 --env.task-seed=1",
    "--agent.conditioning=one-hot --agent.encoder=film --agent.film=scalar --agent.scaling=return "
    "--agent.return-range=5 --preset=gpu",  # critics of some reach no further
]


# Reading a command line takes half a second: a part of the pairs by default, in which every line has its turn.
REPEATED = [
    pytest.param(agent, settings, marks=[pytest.mark.slow] if (i + j) % 18 else [])
    for i, agent in enumerate(OFF_POLICY)
    for j, settings in enumerate(SETTINGS)
]


@pytest.mark.parametrize(("agent", "settings"), REPEATED)
def test_repeating_flags_give_the_same_program(agent, settings):
    """The command in config.json, word for word, and whatever the presets are by then."""
    program = parse([f"--agent={agent}", *settings.split()])
    words = shlex.split(shlex.join(["python", "-m", "mtjax.train", *to_flags(program)]))[3:]
    again = parse([*words, "--preset=cpu"])
    assert dataclasses.replace(again, preset=program.preset) == program


def test_repeating_flags_name_the_file_of_vectors(tmp_path):
    """Also where its name has spaces."""
    file = tmp_path / "my vectors.npy"
    program = parse(["--agent=care", "--agent.conditioning=vectors", f"--agent.vectors={file}"])
    words = shlex.split(shlex.join(to_flags(program)))
    assert parse(words) == program and program.learner.conditioning.vectors == str(file)


@pytest.mark.parametrize("file", PRESET_FILES, ids=lambda file: file.name)
def test_presets_name_only_what_there_is(file):
    """A word that is misspelt in a preset would otherwise be left out without a sign."""
    preset = tomllib.loads(file.read_text())
    slow = preset.pop("slow_on_cpu", {})
    assert set(slow) <= set(ENVS) and set(slow.values()) <= {"", *mtjax.AGENTS}
    assert preset and set(preset) <= {"cpu", "gpu"}
    fields = lambda cls: {field.name for field in dataclasses.fields(cls)}
    known = {"plan": fields(Plan), "agent": set(settings_of(mtjax.agent("sac")))}
    known["training"] = known["agent"] | fields(Settings)
    known["pictures"] = known["training"] | fields(Plan)
    of_agents = fields(Settings) | fields(Plan) | {"worlds", "tuned_tasks"}
    known |= {name: set(settings_of(mtjax.agent(name))) | of_agents for name in AGENTS}
    seeing = {name: set(settings_of(mtjax.agent(name, representation="encoded"))) for name in ("ppo", "impala", "pqn")}
    known |= {f"{name}-pictures": settings | of_agents for name, settings in seeing.items()}
    for tables in preset.values():
        for table, settings in tables.items():
            assert set(settings) <= known[table], table


def test_preset_files_are_of_families_that_exist():
    """Each is named after a family, its first words, a benchmark, a suite of another package, or all families."""
    words = [name.split("-") for name in (*ENVS, *BENCHMARKS)]
    names = {"-".join(w[:n]) for w in words for n in range(1, len(w) + 1)} | {"default"}
    of_suites = {*SUITES, "gymnax-minatar"}
    assert {file.name.removesuffix(".toml") for file in PRESET_FILES} <= names | of_suites


def test_a_familys_preset_adds_to_that_of_all():
    own, common = load_preset("mt10", "gpu"), load_preset("+", "gpu")
    assert own["brc"] != common["brc"] and {name: own[name] for name in common if name != "brc"} == {
        name: tables for name, tables in common.items() if name != "brc"
    }
    assert load_preset("mt10", "cpu") == load_preset("+", "cpu")


@pytest.mark.parametrize(
    "env, file",
    [
        ("gymnax:Breakout-MinAtar", "gymnax-minatar"),
        ("gymnax:Breakout-MinAtar+gymnax:Asterix-MinAtar", "gymnax-minatar"),
        ("gymnax:CartPole-v1+gymnax:Asterix-MinAtar", "default"),
        ("envpool:Pong-v5", "envpool"),
        ("envpool:Pong-v5+envpool:Qbert-v5", "envpool"),
        ("envpool:Pong-v5+bandit", "default"),
    ],
)
def test_environments_of_a_package_have_the_preset_of_their_kind(env, file):
    """Or of their suite; mixtures where it is one for all."""
    read = lambda name: tomllib.loads((resources.files("mtjax") / "configs" / f"{name}.toml").read_text())["cpu"]
    assert load_preset(env, "cpu") == read("default") | read(file)


@pytest.mark.parametrize("preset", ("cpu", "gpu"))
@pytest.mark.parametrize("env, agent", one_in(2, PAIRS, nightly=True))
def test_every_preset_makes_a_program(env, agent, preset):
    """Its settings are allowed, and arrive."""
    program = with_preset(env, agent, preset)
    tables = load_preset(env, preset)
    expected = load_preset("+", preset).get(agent, {}) | tables.get(agent, {})
    if type(program.learner).common_presets:  # the tables of all agents are tuned for replay
        expected = tables["training"] | tables["agent"] | expected
    expected = for_tasks(expected, program.family.train_count, preset)
    found = settings_of(program.learner) | dataclasses.asdict(program.training) | dataclasses.asdict(program.plan)
    assert set(expected) <= set(found)
    for name, value in expected.items():
        assert found[name] == (tuple(value) if isinstance(value, list) else value)


@pytest.mark.parametrize(
    "count, worlds, on_gpu, on_cpu, tuned_with_fifty",
    [
        (1, 2048, (160, 320), (16, 32), (16, 32)),
        (4, 512, (40, 80), (16, 32), (16, 32)),
        (10, 205, (16, 32), (16, 32), (16, 32)),
        (50, 41, (4, 7), (4, 7), (16, 32)),
        (200, 11, (1, 4), (1, 4), (4, 8)),
    ],
)
def test_a_preset_is_fitted_to_the_number_of_tasks(count, worlds, on_gpu, on_cpu, tuned_with_fifty):
    """Sizes are of the whole on a GPU, and where a preset says so; else of a task, up to the tuned number of tasks."""
    sizes = {"num_envs": 16, "batch_size": 32}
    fitted = lambda device, **more: tuple(for_tasks(sizes | more, count, device).values())
    for device in ("cpu", "gpu"):
        assert for_tasks({"worlds": 2048, "epochs": 4}, count, device) == {"num_envs": worlds, "epochs": 4}
    assert (fitted("gpu"), fitted("cpu"), fitted("cpu", tuned_tasks=50)) == (on_gpu, on_cpu, tuned_with_fifty)


def test_the_number_of_tasks_decides_however_it_is_given():
    ranges = parse(["--env=finger-spin", "--env.vary.size=0.9:1.1:50"])
    drawn = parse(["--env=point-mass-vary-goal", "--env.num-tasks=50"])
    mixed = parse(["--env=finger-spin+cheetah-run", "--env.vary.finger-spin.size=0.9:1.1:49"])
    for program in (ranges, drawn, mixed):
        assert program.family.train_count == 50
        assert (program.training.num_envs, program.learner.experience.batch_size) == (4, 7)


@pytest.mark.parametrize(
    "env, agent, preset, curriculum, sizes",
    [
        ("finger-spin", "ppo", "gpu", "all", (11, None)),
        ("finger-spin", "ppo", "gpu", "sequence:20000", (2048, None)),
        pytest.param("mt50", "ppo", "gpu", "all", (41, None), marks=needs("metaworld")),
        pytest.param("mt50", "ppo", "gpu", "sequence:20000", (2048, None), marks=needs("metaworld")),
        pytest.param("mt50", "sac", "gpu", "shuffled:20000", (640, 1280), marks=needs("metaworld")),
        ("finger-spin", "sac", "gpu", "hardest:10:20000", (256, 64)),
        ("finger-spin", "sac", "cpu", "random:10:20000", (16, 32)),
        ("finger-spin", "sac", "cpu", "sequence:20000", (16, 32)),
        ("finger-spin", "sac", "cpu", "all", (1, 4)),
    ],
)
def test_tasks_that_are_played_at_a_time_decide(env, agent, preset, curriculum, sizes):
    """Not those that are known, of which the finger has two hundred; from Python as on the command line."""
    vary = {"vary": {"size": "0.9:1.1:200"}} if env == "finger-spin" else {}
    words = [f"--env={env}", f"--agent={agent}", f"--preset={preset}", f"--curriculum={curriculum}"]
    words += ["--env.vary.size=0.9:1.1:200"] * bool(vary)
    from_python = with_preset(env, agent, preset, training_settings={"curriculum": curriculum}, **vary)
    for config in (parse(words), from_python):
        assert (config.training.num_envs, getattr(config.learner.experience, "batch_size", None)) == sizes
        assert config.training.curriculum == curriculum
    given = parse([*words, "--num-envs=7"])
    assert given.training.num_envs == 7 and given.worlds == 7 * given.played_tasks


@pytest.mark.parametrize(
    "device, count, sizes",
    [
        *(("cpu", 10, (32, 4)), ("cpu", 50, (8, 4)), ("cpu", 200, (2, 2))),
        *(("gpu", 1, (2048, 16)), ("gpu", 10, (208, 16)), ("gpu", 50, (42, 14)), ("gpu", 200, (11, 11))),
    ],
)
@pytest.mark.parametrize("memory", ["rl2", "ppo"])
def test_a_memorys_minibatches_share_whole_rollouts_of_worlds(memory, device, count, sizes):
    """None is left out, and worlds and minibatches stay near those of single steps."""
    given = {"conditioning": "transformer"} if memory == "ppo" else {}
    config = with_preset("point-mass-vary-goal", memory, device, given, num_tasks=count, split="none")
    assert (config.training.num_envs, config.learner.experience.minibatches) == sizes
    plain = with_preset("point-mass-vary-goal", "ppo", device, num_tasks=count, split="none")
    asked = plain.training.num_envs, plain.learner.experience.minibatches
    assert asked[0] <= sizes[0] <= asked[0] + 3 and sizes[1] <= asked[1]


@pytest.mark.parametrize(
    "words, sizes",
    [
        (["--num-envs=41"], (41, 16)),
        (["--num-envs=2"], (2, 2)),
        (["--agent.minibatches=16"], (48, 16)),
        (["--num-envs=41", "--agent.minibatches=16"], (41, 16)),
    ],
)
def test_what_is_given_of_worlds_and_minibatches_stays(words, sizes):
    """Of the other there are enough."""
    env = ["--env=point-mass-vary-goal", "--env.num-tasks=50", "--split=none", "--agent=rl2"]
    config = parse([*env, "--preset=gpu", *words])
    assert (config.training.num_envs, config.learner.experience.minibatches) == sizes


def test_a_short_run_is_not_all_warm_up():
    """A tenth of it is, and it has a line of metrics for each tenth; what is given holds."""
    flags = ["--env=finger-spin-vary-size", "--steps=100000"]
    short = parse(flags)
    assert (short.learner.experience.warmup_steps, short.training.chunk_steps) == (62, 62)  # of 625
    assert short.plan.eval_every == 33_334  # three evaluations play as many steps as the run, each
    given = parse([*flags, "--warmup-steps=500", "--chunk-steps=400", "--eval-every=20000"])
    assert (given.learner.experience.warmup_steps, given.training.chunk_steps) == (500, 400)
    assert given.plan.eval_every == 20_000
    assert parse([*flags, "--n-step=100"]).learner.experience.warmup_steps == 100
    whole = parse(flags[:1])
    assert (whole.learner.experience.warmup_steps, whole.training.chunk_steps, whole.plan.eval_every) == (2000, 500, 0)


@pytest.mark.parametrize("agent", slow_but(["drq", "sac-ae", "deepmdp"], "drq"))
def test_pictures_have_a_preset_of_their_own(agent):
    """It holds for every agent with a replay, from Python as on the command line."""
    expected = load_preset("+", "gpu")["pictures"] | load_preset("finger-spin", "gpu")["pictures"]
    expected = for_tasks(expected, 1, "gpu")
    program = with_preset("finger-spin", agent, "gpu", pixels=64)
    found = settings_of(program.learner) | dataclasses.asdict(program.training) | dataclasses.asdict(program.plan)
    assert {name: found[name] for name in expected} == expected
    assert program != with_preset("finger-spin", agent, "gpu")
    flags = ["--env=finger-spin", f"--agent={agent}", "--preset=gpu", "--env.pixels=64"]
    assert parse(flags) == program
    mixed = parse([*flags, "--env=finger-spin+cheetah-run"])
    assert mixed.learner.actor_lr == load_preset("+", "gpu")["pictures"]["actor_lr"]


def test_what_is_tuned_for_an_agent_holds_with_pictures_too():
    """Before what is tuned for pictures."""
    rate = lambda agent: with_preset("cheetah-run", agent, "gpu", pixels=64).learner.actor_lr
    common = load_preset("+", "gpu")
    assert (rate("drq"), rate("xqc")) == (common["pictures"]["actor_lr"], common["xqc"]["actor_lr"])
    assert rate("drq") != rate("xqc")


def test_what_is_given_goes_before_what_is_tuned():
    given = {"actor_lr": 0.5, "critic_lr": 0.25}
    learner = with_preset("cheetah-run", "xqc", "gpu", agent_settings=given).learner
    assert (learner.actor_lr, learner.critic_lr) == (0.5, 0.25)


def test_auto_preset_is_that_of_the_device(monkeypatch):
    """A GPU takes the gpu preset. A record says auto all the same."""
    assert with_preset("finger-spin-vary-size", "sac").preset == "auto"
    assert parse([]).training == with_preset("finger-spin-vary-size", "sac", "cpu").training
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    assert parse([]).training == with_preset("finger-spin-vary-size", "sac", "gpu").training


# Help.


@pytest.fixture(scope="module")
def help_text():
    with contextlib.redirect_stdout(io.StringIO()) as out, pytest.raises(SystemExit) as stop:
        parse(["--agent=care", "--help"])
    assert not stop.value.code
    return words_of(out.getvalue())


def test_help_mentions_every_flag_with_its_default(help_text):
    """Of the agent and family that were named, as the preset leaves them."""
    program = parse(["--agent=care"])
    for flag in run_config.flags(program):
        assert re.search(rf"{re.escape(flag)}[ ,]", help_text), flag
    assert help_text.count("(default: ") == len(run_config.flags(program)) - len(CHOICES)  # which are read before
    learner = program.learner
    for default in (
        program.plan.steps,
        learner.actor_lr,
        learner.gamma,
        learner.conditioning.context_limit,
        learner.encoder.variant,
    ):
        assert f"(default: {default})" in help_text
    for widths in (learner.hidden, learner.encoder.expert_widths):
        assert f"(default: {' '.join(map(str, widths))})" in help_text


@pytest.mark.parametrize("word", ["--help", "-h"])
@pytest.mark.parametrize("name, main", [*COMMANDS.items(), ("plot", mtjax.plot.main)])
def test_help_of_every_command_has_one_form(name, main, word, capsys):
    """How to call it, and groups of flags, each of which stands once, with its default and what it does."""
    main([word])
    usage, *groups = capsys.readouterr().out.strip().split("\n\n")
    calls = [line[7:] for line in usage.splitlines()]
    assert usage.startswith("usage: ") and all(call.startswith(f"python -m mtjax.{name} ") for call in calls)
    assert any("--import=FILE.py" in call for call in calls) and all(re.match(r"\w.*:\n  --", text) for text in groups)
    flags = re.findall(r"^  --([\w-]+)(?:=.+)?\n {6}\w", "\n\n".join(groups), re.MULTILINE)
    fields = dataclasses.fields(getattr(mtjax, name).Request) if name != "train" else ()
    own = {field.name.replace("_", "-") for field in fields} or class_sources.whole_flags()
    assert own <= {*flags} and len(flags) == len({*flags})


def test_list_names_every_family_and_agent(capsys):
    """With a line of documentation each."""
    mtjax.train.main(["--list"])
    lines = capsys.readouterr().out.splitlines()
    names = {line.split()[0] for line in lines if line.startswith("  ")}
    policies = pretrained.names()
    assert names == {*ENVS, *BENCHMARKS, *AGENTS, *policies}
    assert all(len(line.split()) > 3 for line in lines if line.startswith("  ") and line.strip() not in policies)


# What is wrong.


@pytest.mark.parametrize(
    "words, said",
    [
        ("--env=finger-spn", "unknown environment 'finger-spn'; did you mean 'finger-spin'?"),
        ("--env=CartPole-v1", "unknown environment 'CartPole-v1'; did you mean 'gymnasium:CartPole-v1'?"),
        ("--env=finger-spin,walker-walk", "'finger-spin,walker-walk' has commas; a mixture is NAME+NAME"),
        ("--runs=", "--runs needs a folder; that of the command is --runs=."),
        ("--agent carr", "unknown agent 'carr'; did you mean 'care'?"),
        ("--agent=SAC", "unknown agent 'SAC'; did you mean 'sac'?"),
        ("--agent=ddpg", "unknown agent 'ddpg'; did you mean 'sac'?"),
        ("--import", "--import needs a Python file\n"),
        ("--preset=gpus", "unknown preset 'gpus'; did you mean 'gpu'?"),
        ("--num-env=3", "unknown flag '--num-env'; did you mean '--num-envs'?"),
        ("--nam=x", "unknown flag '--nam'; --help lists the flags"),
        ("--device=gpu", "unknown flag '--device'; --help lists the flags"),
        ("--step=3", "unknown flag '--step'; did you mean '--steps'?"),
        ("--total-timesteps=3", "unknown flag '--total-timesteps'; did you mean '--steps'?"),
        ("--agent.learning-rate=3", "unknown flag '--agent.learning-rate'; did you mean '--agent.actor-lr'?"),
        ("--lr=3", "unknown flag '--lr'; did you mean '--agent.actor-lr'?"),
        ("--agent.steps=3", "unknown flag '--agent.steps'; did you mean '--steps'?"),
        ("--no-stager", "unknown flag '--no-stager'; did you mean '--no-stagger'?"),
        ("--foo.bar=2", "unknown flag '--foo.bar'; --help lists the flags"),
        (
            "--agent.num-experts=3 --agent=sac",
            "'--agent.num-experts' of sac; it belongs to --agent.encoder=care, --agent.en",
        ),
        ("--batch-size=3 --agent=ppo", "unknown flag '--batch-size' of ppo; it belongs to agents with a replay"),
        ("--agent.unroll=3 --agent=sac", "it belongs to agents that learn from rollouts, such as ppo"),
        ("--split=dens", "unknown split 'dens'; did you mean 'dense'?"),
        ("--engine=cpp", "unknown engine 'cpp'"),
        ("--env.vary.colour=1,2", "unknown parameter 'colour'; choose from: size, touch-size"),
        ("--env.vary.size", "--env.vary.size needs values; give lo:hi:n"),
        ("--env.vary.size=", "--env.vary.size needs values"),
        ("--env.vary.size=a", "cannot read the values 'a' of size"),
        ("--steps=many", "many"),
        ("--steps=1.5", "--steps must be a whole number, not '1.5'"),
        ("--steps=1e-6", "--steps must be a whole number, not '1e-6'"),
        ("--steps=1e99", "steps must be at most"),
        ("--steps", "--steps"),
        ("--env", "--env needs a value"),
        ("--no-steps", "--steps is no switch"),
        ("finger-spin", "'finger-spin' belongs to no flag; write --NAME=VALUE"),
        ("env=finger-spin", "'env=finger-spin' belongs to no flag; write --NAME=VALUE"),
        ("--profile=3", "--profile is a switch and takes no value: --profile is on, and --no-profile off"),
        ("--stagger=off", "--stagger is a switch and takes no value: --stagger is on, and --no-stagger off"),
        ("--env.vary=3", "--env.vary needs the name of a parameter: --env.vary.NAME=VALUES"),
        ("-x", "'-x' has one dash, and flags have two: --x"),
        ("-env=bandit", "'-env=bandit' has one dash, and flags have two: --env=bandit"),
        ("--env=bandit --engine=c", "bandit has no flag --engine; "),
        ("--agent.hidden=8,8", "--agent.hidden takes values with spaces between them, such as --agent.hidden 8 8\n"),
        ("--env.vary.size 1 2 3", "'2' belongs to no flag"),
        ("--agent.hidden wide", "--agent.hidden cannot take 'wide'; --help says what it takes"),
        ("--agent.actor-lr=fast", "--agent.actor-lr must be a number, not 'fast'"),
        ("--env.pixels --agent=sac", "--env.pixels needs a value"),
        ("--agent.hidden", "at least one layer"),
        ("--agent.conditioning=onehot", "onehot"),
        ("--agent.shared-temperature=yes", "--agent.shared-temperature is on, and --agent.no-shared-temperature off"),
        ("--seed=-1", "seed must be at least 0"),
        ("--seed=3000000000", "seed must be at most 2147483647"),
        ("--steps=0", "steps must be at least 1"),
        ("--num-envs=0", "num-envs must be at least 1"),
        ("--replay-size=3", "must hold one step of num-envs"),
        ("--agent.gamma=1.5", "gamma must be in [0, 1]"),
        ("--agent.actor-lr=nan", "actor-lr must be a finite number, not nan"),
        ("--agent.max-gradient-norm=-1", "max-gradient-norm must be"),
        ("--agent.conditioning=embedding --agent.embedding-size=0", "embedding-size must be"),
        ("--agent=care --agent.expert-widths 8 0", "expert"),
        ("--env.vary.size=2:1:3", "must go from low to high"),
        ("--env.vary.size=1,1", "must increase"),
        ("--env=finger-spin-vary-size --env.vary.size=1:1.1:4 --split=hip-bmdp", "has 4; use --split=dense"),
        ("--agent=care --agent.conditioning=none", "conditioning cannot be none"),
        ("--agent=brc --agent.scaling=none", "and --agent.scaling=none does not keep them there; use --agent.scaling="),
        ("--agent.conditioning=vectors", "go together"),
        ("--agent.vectors=x.npy", "it belongs to --agent.conditioning=vectors"),
        ("--agent.conditioning=vectors", "go together"),
        ("--agent.conditioning=vectors --agent.vectors=missing.npy", "cannot read task vectors from 'missing.npy'"),
        ("--seeds=99999999999999999999", "seeds must be at most 100000, not 99999999999999999999"),
        ("--steps=99999999999999999999", "steps must be at most 1000000000000000"),
        ("--updates-per-step=99999999999", "updates-per-step must be at most 2147483647"),
        ("--agent.actor-lr=inf", "actor-lr must be a finite number, not inf"),
        ("--agent.critic-lr=1e39", "critic-lr must be a finite number, not 1e+39"),
        ("--agent.weight-decay=inf", "weight-decay must be a finite number, not inf"),
        ("--agent.target-entropy=nan", "target-entropy must be a finite number, not nan"),
        ("--agent=ppo --agent.unroll=1000000000", "unroll must be at least 1 and at most 100000"),
        ("--agent.no-sampler", "--agent.sampler is no switch that could be off; give it a value"),
        ("--env.task-seed=-1", "task-seed must be at least 0, not -1"),
        ("--env.vary.size=1:1:1", "1:1:1 asks for one value of size; give it alone, or a range of at least two"),
        ("--env.vary.gear=1:2:1000000000", "gear can have 10000 values at most, each of which is a task"),
        (
            "--env.vary.gear=1:2:1000 --env.vary.size=1:1.1:1000",
            "the grid has 1000000 tasks, and 10000 are most",
        ),
        ("--env.vary.mass=1e300", "mass must be greater than 0 and at most 1e+30, not 1e+300"),
        ("--env=walker-walk --env.vary.torso-mass=1e308", "torso-mass must be greater than 0 and at most 1e+30"),
        ("--env.vary.size=1e15", "FingerSpin with size=1e+15 has a body_mass beyond 32-bit numbers"),
        ("--env.vary.size=1e-8", "MuJoCo cannot build FingerSpin with size=1e-08: "),
        ("--resume=nowhere", "'nowhere' is not a run"),
        ("--resume=", "not a run"),
        ("--resume nowhere --num-envs=3", "only --steps may change, not --num-envs"),
        ("--resume=nowhere --env finger-spin --seed=1", "not --env, --seed"),
    ],
)
def test_train_says_what_is_wrong(complaint, monkeypatch, tmp_path, words, said):
    """In one line, with exit code 2, and before anything is made."""
    monkeypatch.setattr(launch, "train", lambda *_, **__: pytest.fail("it trains"))
    assert said in complaint("train", *words.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "text, said",
    [
        ("\ndef mine(:\n", "mine.py', line 2: SyntaxError: invalid syntax"),
        ("import nothing_of_this_name\n", "line 1: ModuleNotFoundError: No module named 'nothing_of_this_name'"),
        ("import mtjax\n\nmtjax.register('mine', 3)\n", "mine.py', line 3: register takes a class, or the name of"),
        ("def f():\n    return [][0]\n\nf()\n", "line 2: IndexError: list index out of range"),
    ],
)
def test_a_file_of_ones_own_that_fails_is_told_with_its_line(complaint, tmp_path, text, said):
    """And the file can be imported once it is mended."""
    (tmp_path / "mine.py").write_text(text)
    assert said in complaint("train", f"--import={tmp_path / 'mine.py'}", "--list")
    assert "mine" not in sys.modules


OWN_FAMILY = """import dataclasses
import jax.numpy as jnp
import mtjax
from mtjax.envs import Domain, Parameter
def set_mass(spec, value):
    spec.geom("box").mass = value
@dataclasses.dataclass(frozen=True)
class Cart(Domain):
    model_file = '''<mujoco><worldbody><body name="cart"><joint name="x" type="slide"/><geom name="box" size=".1"/>
    </body></worldbody><actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>'''
    episode_steps = 100
    parameters = {"mass": Parameter("kg", 1.0, set_mass)}
    def start(self, task, key):
        return jnp.zeros(1), jnp.zeros(1)
    def observe(self, task, world):
        return world.qpos
    def reward(self, task, world, action):
        return world.qpos[0]
mtjax.register("cart", Cart, vary={"mass": "1,2"})
"""


@pytest.mark.parametrize(
    "right, wrong, said",
    [
        ('geom("box")', 'geom("bos")', r"line 6: Cart\.parameters\['mass'\] \(set_mass\): unknown geom"),
        (".mass = value", ".rgba[0] = value / 9", r"line 12: Cart\.parameters\['mass'\] changes nothing"),
        ("return world.qpos\n", "return world.qpoz\n", r"line 16: Cart\.observe: AttributeError"),
        ("return world.qpos[0]", "return world.qpos", r"line 17: Cart\.reward must return a number"),
        ("def start", "def begin", r"line 8: Cart cannot be made: .* method '?start"),
        ("(Domain)", "", r"line 8: Cart must be a subclass of Domain"),
        ('"1,2"', '"one"', r"line 19: cannot read the values 'one' of mass"),
    ],
)
def test_a_family_of_ones_own_that_is_wrong_is_told_with_its_line(complaint, tmp_path, right, wrong, said):
    """And not with that of the call that registers it."""
    assert OWN_FAMILY.count(right) == 1
    (tmp_path / "mine.py").write_text(OWN_FAMILY.replace(right, wrong))
    assert re.search(said, complaint("train", f"--import={tmp_path / 'mine.py'}", "--list"))


@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
def test_messages_do_not_depend_on_the_terminal(complaint, monkeypatch, encoding):
    """Tyro frames its errors in ASCII where standard output is not UTF-8."""
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    said = complaint("train", "--agent.num-critics=many")
    assert "--agent.num-critics must be a whole number, not 'many'" in said


@pytest.mark.parametrize(
    "words, said",
    [
        ("", "say which run to evaluate: --run=DIR"),
        ("--run=nowhere", "'nowhere' is not a run: there is no such folder"),
        ("--run=brc", "unknown run or trained policy 'brc'; did you mean 'mt10/brc'? choose from: finger-spin-vary-s"),
        ("--run=x --env.combine=grid", "unknown flag '--env.combine'; --help lists the flags"),
        ("--run=x --env.vary", "--env.vary needs the name of a parameter"),
        ("runs/x --video", "say which run to evaluate by --run=runs/x"),
        ("--runs=x", "unknown flag '--runs'; did you mean '--run'?"),
        ("--run=x --episodes=0", "episodes must be at least 1"),
        ("--run=x --episodes=1000000", "and at most 100000, not 1000000"),
        ("--run=x --seed=2147483647", "seed must be at least 0 and at most 2000000000"),
        ("--run=x --episodes=some", "--episodes must be a whole number, not 'some'"),
        ("--run=x --split=train", "unknown flag '--split'; --help lists the flags"),
    ],
)
def test_evaluate_says_what_is_wrong(complaint, words, said):
    """In one line, with exit code 2."""
    assert said in complaint("evaluate", *words.split())


def test_the_newest_run_inside_a_folder_is_named(complaint, tmp_path):
    """Where the folder itself is none."""
    for i, name in enumerate(("a", "b")):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "config.json").touch()
        os.utime(tmp_path / "runs" / name / "config.json", (i, i))
    for command, flag in (("train", "resume"), ("evaluate", "run")):
        assert "has no config.json; it holds runs, the newest is 'runs/b'" in complaint(command, f"--{flag}=runs")


def test_vectors_of_another_number_of_tasks_are_refused(complaint, tmp_path):
    """Before the run's folder is made."""
    np.save(tmp_path / "v.npy", np.zeros((3, 4)))
    said = complaint("train", "--agent.conditioning=vectors", "--agent.vectors=v.npy")
    assert "must hold 10 finite rows" in said and not (tmp_path / "runs").exists()


def test_c_engine_is_for_the_cpu(complaint, monkeypatch):
    """There it is accepted; elsewhere it is refused before the run's folder is made."""
    assert parse(["--engine=c"]).family.engine == "c"
    monkeypatch.setattr("jax.default_backend", lambda: "gpu")
    assert "use --engine=mjx" in complaint("train", "--engine=c")


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"{}", b'{"env": "finger-spin"}', b"\xff\xfe\x00", b'{"env": "x", "agent": "sac", "preset": 1}'],
)
def test_damaged_record_is_refused(complaint, tmp_path, content):
    """The message names the file."""
    (tmp_path / "config.json").write_bytes(content)
    for command, flag in (("train", "--resume"), ("evaluate", "--run")):
        assert "config.json' does not describe a run" in complaint(command, f"{flag}={tmp_path}")


@pytest.mark.slow
def test_record_of_a_family_that_is_gone_is_refused(complaint, finished_run, tmp_path):
    """As a name is refused on the command line."""
    text = (finished_run / "config.json").read_text()
    (tmp_path / "config.json").write_text(text.replace('"finger-short"', '"finger-shirt"'))
    assert "unknown environment 'finger-shirt'" in complaint("train", f"--resume={tmp_path}")


@pytest.mark.slow
def test_damaged_checkpoints_are_refused(complaint, copied_run):
    """By both programs, if none is whole; the folder stays as it is."""
    for file in (copied_run / "checkpoints").rglob("*"):
        if file.is_file():
            file.write_bytes(b"")
    before = sorted(copied_run.rglob("*"))
    assert "150' is damaged" in complaint("train", f"--resume={copied_run}")
    assert "150' is damaged" in complaint("evaluate", f"--run={copied_run}")
    assert sorted(copied_run.rglob("*")) == before


@pytest.mark.slow
def test_record_of_another_version_is_told(complaint, finished_run, tmp_path):
    """Where it cannot be read; and one that can is read."""
    record = json.loads((finished_run / "config.json").read_text())
    record["versions"]["mtjax"] = "9.9"
    (tmp_path / "config.json").write_text(json.dumps(record))
    assert from_json(tmp_path / "config.json").env == "finger-short"
    record["learner"]["believe"] = "least"
    (tmp_path / "config.json").write_text(json.dumps(record))
    said = complaint("evaluate", f"--run={tmp_path}")
    assert "'believe'" in said and f"(mtjax 9.9 wrote it, and this is {mtjax.__version__})" in said


@pytest.mark.parametrize(
    "words, said",
    [
        (["--agent.hidden", "999999999"], "GB of networks, "),
        (["--replay-size=2147483647", "--num-envs=2"], "lower --replay-size, --num-envs or --seeds"),
    ],
)
def test_what_no_memory_could_hold_is_refused(complaint, short_family, tmp_path, words, said):
    """With the sizes, before anything compiles."""
    assert said in complaint("train", "--env=finger-short", f"--runs={tmp_path}", *words)


def test_running_out_of_memory_is_one_line():
    """With what would help. Other errors of the device are shown as they are."""
    with pytest.raises(InputError, match=r"out of memory \(RESOURCE_EXHAUSTED: .*\); lower --num-envs"), explaining():
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 5 bytes.\nand more")
    with pytest.raises(jax.errors.JaxRuntimeError), explaining():
        raise jax.errors.JaxRuntimeError("INTERNAL: no device")


def test_place_that_cannot_be_written_is_refused(complaint, tmp_path):
    """A file where the folder of runs should be."""
    (tmp_path / "taken").write_text("")
    assert "taken' is a file, and runs need a folder" in complaint("train", *SHORT_RUN, f"--runs={tmp_path / 'taken'}")
    said = complaint("train", *SHORT_RUN, f"--runs={tmp_path / 'taken/x'}")
    assert "taken/x' cannot take a run (Not a directory); choose another place with --runs" in said


def test_full_disk_is_refused(complaint, tmp_path, monkeypatch):
    """A run that cannot be kept is not begun."""
    usage = shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    said = complaint("train", *SHORT_RUN, "--runs=runs")
    assert "MB free; lower --replay-size or choose another place with --runs" in said
    of_ppo = complaint("train", "--env=finger-short", "--agent=ppo", "--agent.hidden=8", "--num-envs=2")
    assert "lower --num-envs or choose" in of_ppo
    (tmp_path / "x.toml").write_text("replay-size = 200")
    words = [word for word in SHORT_RUN if not word.startswith("--replay-size")]
    assert "choose another place with --runs" in complaint("train", *words, "--config=x.toml")
    assert not list(tmp_path.glob("runs/*/metrics.csv"))


@pytest.mark.parametrize(
    "error, code, said",
    [
        (FloatingPointError("numbers stopped being finite"), 1, "error: numbers stopped being finite\n"),
        (OSError(28, "No space left on device", "metrics.csv"), 2, "error: No space left on device: metrics.csv\n"),
        (KeyboardInterrupt(), 130, "interrupted\n"),
    ],
)
def test_errors_of_a_run_are_one_line(capsys, error, code, said):
    """With a code that tells what the user got wrong from what the run met."""

    def fails(_):
        raise error

    with pytest.raises((SystemExit, KeyboardInterrupt)) as stop:  # an interrupt let through would end pytest
        process.main(fails)
    assert getattr(stop.value, "code", None) == code and capsys.readouterr().err == said


def test_what_is_overlong_is_shortened():
    """A message stays a line of readable length, with its beginning and its end."""
    told = process.one_line(InputError(f"unknown split {'9' * 5000!r};\nchoose from: dense"))
    assert told.startswith("unknown split '999") and told.endswith("999'; choose from: dense") and len(told) < 620


def test_notices_are_one_line(capsys):
    """On the error stream, without the place in the code."""
    process.main(lambda _: notice("the file is damaged"))
    assert capsys.readouterr() == ("", "warning: the file is damaged\n")


def test_errors_of_ours_are_not_hidden():
    """A mistake in the package keeps its traceback."""

    def fails(_):
        raise KeyError("ours")

    with pytest.raises(KeyError):
        process.main(fails)


@pytest.mark.parametrize(
    "words, said",
    [
        (["mtjax.train", "--env=finger-spn"], "did you mean 'finger-spin'?"),
        (["mtjax.train", "--num-env=3"], "did you mean '--num-envs'?"),
        (["mtjax.evaluate", "--run=nowhere"], "'nowhere' is not a run"),
    ],
)
def test_errors_come_fast_and_without_traceback(tmp_path, words, said):
    """As a user meets them, in a process of their own."""
    children = lambda: sum(os.times()[2:4])  # their processor time, as a busy machine is no fault of ours
    before = children()
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=300
    )
    seconds = children() - before
    assert done.returncode == 2 and said in done.stderr and done.stdout == ""
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert seconds < 8  # two on an idle machine
    assert not list(tmp_path.iterdir())


def test_unusable_names_are_input_errors_in_the_library():
    """Which are values that cannot be used."""
    assert issubclass(InputError, ValueError)
    with pytest.raises(InputError, match="unknown agent 'sacc'; did you mean 'sac'"):
        mtjax.agent("sacc")
    with pytest.raises(InputError, match="unknown setting of sac 'hiden'; did you mean 'hidden'"):
        mtjax.agent("sac", hiden=(3,))


def test_a_family_that_a_cpu_does_not_learn_is_known():
    """Alone and in a mixture, and by which agent it does."""
    slow = lambda env: slow_on_cpu(with_preset(env, "sac", "cpu"))
    assert slow("hopper-hop") == slow("finger-spin+hopper-hop") == {"hopper-hop": ""}
    assert slow("finger-spin+cheetah-run") == {}
    assert slow("cartpole-swingup-sparse") == {"cartpole-swingup-sparse": "ppo"}


# Files of flags.


def test_a_file_of_flags_is_a_command_line(tmp_path):
    """With tables, lists and switches; what the command line says counts more."""
    file = tmp_path / "x.toml"
    file.write_text(
        """
steps = 5000
num_envs = 3
stagger = false
[env]
name = "finger-spin"
vary = { size = [1, 1.1, 1.2], touch-size = "0.1:0.3:2" }
[agent]
name = "care"
num-experts = 3
hidden = [8, 8]
actor_lr = 1e-4
"""
    )
    words = "--steps=5000 --num-envs=3 --no-stagger --env=finger-spin --agent=care --agent.num-experts=3".split()
    words += ["--env.vary.size=1,1.1,1.2", "--env.vary.touch-size=0.1:0.3:2", "--agent.hidden", "8", "8"]
    assert parse(flag_files.expand([f"--config={file}"])) == parse([*words, "--agent.actor-lr=1e-4"])
    changed = parse(flag_files.expand(["--config", str(file), "--agent.hidden", "9", "--agent.actor-lr=1"]))
    assert changed.learner.hidden == (9,) and changed.learner.actor_lr == 1 and changed.plan.steps == 5000


def test_the_quick_start_is_a_file_of_flags():
    """Those beside it change it."""
    quick = parse(flag_files.expand(["--quick", "--seeds=2"]))
    assert (quick.env, quick.agent, quick.plan.seeds) == ("point-mass-vary-goal", "sac-conditioned", 2)
    assert quick.plan.steps <= 250_000 and quick.learner.hidden == (64, 64)


@pytest.mark.parametrize(
    "text, said",
    [
        ("steps = ", "cannot be read as TOML"),
        ("stepps = 5", "did you mean '--steps'?"),
        ('import = "x.py"', "runs no code; give --import on the command line"),
        ('resume = "x"', "gives resume"),
        ("steps = 2020-01-01", "gives steps a value that no flag takes"),
        ("steps = 1.5", "--steps must be a whole number, not '1.5'"),
        ('[agent]\nname = "care"\nnum-expert = 3', "did you mean '--agent.num-experts'?"),
        ('agent = "carr"', "unknown agent 'carr'"),
        ("[env]\npixels = -1", "pixels"),
        ("[agent]\ngamma = 1.5", "gamma must be in [0, 1]"),
        ('[env.vary]\nsize = "a"', "cannot read the values 'a' of size"),
    ],
)
def test_wrong_files_of_flags_are_refused(text, said, complaint, tmp_path):
    """In a line that names the file, like a command line."""
    (tmp_path / "x.toml").write_text(text)
    told = complaint("train", f"--config={tmp_path / 'x.toml'}")
    assert said in told and told.count("x.toml'") == 1


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * 100_000, "a = " + "9" * 5000, f"[a{'.b' * 5000}]\nx = 1", 'runs = "a\\u0000b"'],
)
def test_files_of_flags_of_any_depth_and_length_are_refused(text, complaint, tmp_path):
    (tmp_path / "a.toml").write_text(text)
    said = complaint("train", *SHORT_RUN, f"--config={tmp_path / 'a.toml'}")
    assert said.startswith("error: ") and len(said) < 700


def test_what_is_wrong_beside_a_file_of_flags_is_not_the_files(complaint, tmp_path):
    """Nor is what the command line gives in place of the file's. A switch for the package's file is named itself."""
    (tmp_path / "x.toml").write_text("steps = 5\nseeds = 0")
    for words in (["--stepz=3"], ["--agent=carr"], ["--seeds=-1"]):
        assert "x.toml" not in complaint("train", "--config=x.toml", *words)
    assert complaint("train", "--quick", "--agent=ppo").startswith("error: --quick: unknown flag '--")


def test_a_missing_file_of_flags_is_refused(complaint):
    """As is one of another kind."""
    assert "--config needs a TOML file, and 'none.toml' is none" in complaint("train", "--config=none.toml")
