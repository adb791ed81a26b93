"""``mtjax.train`` in Python: names and keywords, the folder of a run, its policies, and what is refused and how."""

import dataclasses
import json
import re
import shlex

import jax
import numpy as np
import pytest
from conftest import ShortFinger
from probes import Probe, param, tiny

import mtjax
import mtjax.evaluate
import mtjax.train
from mtjax import agents, checks, envs
from mtjax.command import keywords, run_config
from mtjax.command.flags import switched_off
from mtjax.config import Plan, with_preset
from mtjax.envs.family import Family
from mtjax.learning.loop import Settings
from mtjax.names import in_python
from mtjax.report import curve, read_runs
from mtjax.saved.config_json import from_json
from mtjax.training import memory
from mtjax.types import InputError

SMALL = {"num_envs": 2, "chunk_steps": 25, "batch_size": 4, "replay_size": 200, "warmup_steps": 5, "hidden": (8, 8)}
PLAN = {"seeds": 2, "eval_every": 200, "eval_episodes": 1}


@pytest.fixture(scope="module")
def result(short_family, tmp_path_factory):
    """A run by names and keywords, in a folder that did not exist."""
    place = tmp_path_factory.mktemp("python") / "new" / "run"
    return mtjax.train("finger-short", "sac-conditioned", steps=600, directory=place, **PLAN, **SMALL)


@pytest.mark.slow
def test_a_run_of_python_is_that_of_the_command_line(result, finished_run):
    """The same settings, metrics and evaluations, to the bit."""
    ours, theirs = (from_json(folder / "config.json") for folder in (result.directory, finished_run))
    assert dataclasses.replace(ours, runs=theirs.runs) == theirs
    clocks = {"seconds", "wall_seconds"}
    read = lambda folder: [line.split(",") for line in (folder / "metrics.csv").read_text().splitlines()]
    kept = [i for i, name in enumerate(read(finished_run)[0]) if name not in clocks]
    assert [[row[i] for i in kept] for row in read(result.directory)] == [
        [row[i] for i in kept] for row in read(finished_run)
    ]
    names = lambda folder: {path.name for path in folder.iterdir()}
    assert names(result.directory) == names(finished_run)


@pytest.mark.slow
def test_progress_is_shown_unless_it_should_be_quiet(short_family, capsys):
    """Without being asked for, from the first seconds, in lines that need no terminal."""
    given = {"steps": 100, **PLAN, **SMALL}
    mtjax.train("finger-short", "sac-conditioned", **given)
    lines = capsys.readouterr().out.splitlines()
    begins = (
        "sac-conditioned on finger-short: ",
        "compiling",
        "compiled in ",
        "100 of 100 steps ",
        "evaluation at 100",
    )
    assert all(any(line.startswith(begin) for line in lines) for begin in begins)
    assert not any(mark in "".join(lines) for mark in "\x1b\r")
    mtjax.train("finger-short", "sac-conditioned", quiet=True, **given)
    assert capsys.readouterr().out == ""


def test_its_curve_shades_random_actions(result, monkeypatch, tmp_path):
    """Five steps of two environments of each task."""
    drawn = []
    monkeypatch.setattr(curve.figures, "learning_curve", lambda *given: drawn.append(given))
    config = from_json(result.directory / "config.json")
    curve.draw(config, result.evaluations, tmp_path)
    assert [given[-1] for given in drawn] == [5 * 2 * config.family.train_count]


@pytest.mark.slow
def test_its_folder_is_loaded_evaluated_and_resumed(result, copied_run, capsys):
    """By ``mtjax.load``, by both commands, and by the command that it records."""
    task = jax.tree.map(lambda x: x[0], mtjax.make("finger-short").tasks())
    loaded, ours = mtjax.load(result.directory, seed=1), result.policy(1)
    obs = ours.env.reset(task, jax.random.key(0)).obs
    np.testing.assert_array_equal(loaded(obs, task), ours(obs, task))
    assert np.any(np.asarray(ours(obs, task)) != np.asarray(result.policy(0)(obs, task)))
    mtjax.evaluate.main([f"--run={result.directory}", "--episodes=1"])
    words = shlex.split(json.loads((result.directory / "config.json").read_text())["command"])
    recorded = from_json(result.directory / "config.json")
    assert run_config.parse(words[3:]) == recorded
    more = mtjax.train("finger-short", "sac-conditioned", steps=700, directory=copied_run, resume=True, **PLAN, **SMALL)
    assert more.finished and more.rows[0]["steps"] == 700
    assert from_json(copied_run / "config.json").plan.steps == 700
    mtjax.train.main([f"--resume={copied_run}", "--steps=800"])
    assert "800 of 800 steps" in capsys.readouterr().out


@pytest.mark.parametrize("changed", [{"seeds": 3}, {"seed": 1}, {"eval_every": 300}, {"eval_episodes": 2}])
def test_a_run_goes_on_with_its_own_plan(result, changed):
    """Only steps may differ: seeds would bear wrong numbers, and evaluations would not be alike."""
    ((name, value),) = changed.items()
    given = {"directory": result.directory, "resume": True, "steps": 600, **PLAN, **SMALL, **changed}
    with pytest.raises(InputError, match=rf"had {name}=.*, not {value}; resume it with the same"):
        mtjax.train("finger-short", "sac-conditioned", **given)


def test_nothing_is_overwritten(result, short_family, tmp_path):
    """Neither a run nor what else lies in a folder; and another agent does not go on with a run."""
    before = (result.directory / "metrics.csv").read_bytes()
    with pytest.raises(InputError, match=r"holds config\.json of a run already; give another directory"):
        mtjax.train("finger-short", "sac", directory=result.directory)
    with pytest.raises(InputError, match=r"had gamma=0\.99, not 0\.5; resume it with the same"):
        mtjax.train("finger-short", "sac-conditioned", directory=result.directory, resume=True, gamma=0.5, **SMALL)
    with pytest.raises(InputError, match="had agent='sac-conditioned', not 'sac'"):
        mtjax.train("finger-short", "sac", directory=result.directory, resume=True, **SMALL)
    with pytest.raises(InputError, match=r"had num_envs=2, not 3"):
        given = {**PLAN, **SMALL, "num_envs": 3}
        mtjax.train("finger-short", "sac-conditioned", directory=result.directory, resume=True, **given)
    assert (result.directory / "metrics.csv").read_bytes() == before
    (tmp_path / "metrics.csv").write_text("mine")
    with pytest.raises(InputError, match=r"holds metrics\.csv"):
        mtjax.train("finger-short", "sac", directory=tmp_path)


def test_a_refused_run_leaves_no_folder(short_family, tmp_path, monkeypatch):
    """So that the same command with smaller numbers finds none in its way."""
    monkeypatch.setattr(memory, "physical_bytes", lambda: 1e4)
    for _ in range(2):
        with pytest.raises(InputError, match=r"lower (replay_size|hidden|num_envs)"):
            mtjax.train("finger-short", "sac", steps=1000, directory=tmp_path / "run")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "given", "said"),
    [
        (["--trials=3", "--eval-episodes=10"], {"trials": 3, "eval_episodes": 10}, "10$"),  # though it is the usual
        (["--trials=2", "--eval-episodes=3"], {"trials": 2, "eval_episodes": 3}, "eval-episodes must be a multiple"),
        (["--population=pbt:100"], {"population": "pbt:100"}, "perturbs numbers of the agent that are swept"),
        (["--agent.value=c51"], {"value": "c51"}, "value=c51 reaches returns from -10 to 10"),
        (["--agent.continual=ewc"], {"continual": "ewc"}, "use --curriculum=sequence:STEPS"),
        (["--trials=2", "--hindsight=0.5"], {"trials": 2, "hindsight": 0.5}, "use --hindsight=0 or --trials=1"),
        (
            ["--agent=rl2", "--num-envs=2", "--agent.minibatches=4"],
            {"agent": "rl2", "num_envs": 2, "minibatches": 4},
            "minibatches=4 are too many: .* a task has 2; use --agent.minibatches=2, or --num-envs=4",
        ),
        (
            ["--agent=ppo", "--num-envs=2", "--agent.unroll=4", "--agent.minibatches=9"],
            {"agent": "ppo", "num_envs": 2, "unroll": 4, "minibatches": 9},
            "minibatches=9 are too many: a task's rollout has 8 steps; use --agent.minibatches=8$",
        ),
    ],
)
def test_a_configuration_is_checked_where_it_is_made(words, given, said, monkeypatch):
    """From a command line as from keywords, and no environment is built for it."""
    monkeypatch.setattr(Family, "table", property(lambda family: pytest.fail("a table was built")))
    with pytest.raises(InputError, match=said):
        run_config.parse(["--env=point-mass-vary-goal", "--agent=sac", *words])
    plan = {name: given.pop(name) for name in ("eval_episodes", "population") if name in given}
    agent = given.pop("agent", "sac")
    with pytest.raises(InputError, match=said):
        keywords.from_keywords("point-mass-vary-goal", agent, given, plan=plan)
    run_config.parse(["--env=point-mass-vary-goal", "--agent=sac"])


_REDO = {"encoder": "identity", "unit_head": False, "plasticity": "redo"}


@pytest.mark.parametrize(
    ("agent", "given"),
    [
        ("sac", {"scaling": "ars", "reset_every": 1000}),
        ("simba-v2", _REDO),
        param(("drq", {"pixels": 32, "n_step": 1, "conditioning": "recurrent", "representation": "plain"}), slow=True),
        param(("drq", {"pixels": 32, "n_step": 1, "target": "retrace"}), slow=True),
        param(("drq", {"pixels": 32, "n_step": 1, "representation": "deepmdp"}), slow=True),
        ("rl2", {"minibatches": 3, "unroll": 16}),
        ("sac", {"hidden": (8, 8, 8), "tune": "all", "combine": "grid", "split": "none", "stagger": False}),
    ],
)
def test_a_command_and_keywords_make_one_configuration(agent, given):
    """Settings are checked together with those of which the agent's own default is refused."""
    made = keywords.from_keywords("cartpole-swingup-vary-pole-mass", agent, given, plan={"steps": 3000})
    words = [word for name, value in given.items() for word in _as_words(made, name, value)]
    said = run_config.parse(["--env=cartpole-swingup-vary-pole-mass", f"--agent={agent}", "--steps=3000", *words])
    assert said == made


def _as_words(config, name, value):
    """Return a setting as words of a command line."""
    flag = name.replace("_", "-")
    flag = next(each for each in run_config.flags(config) if re.fullmatch(rf"--((env|agent)\.)?{flag}", each))
    if isinstance(value, bool):
        return [flag if value else switched_off(flag)]
    return [flag, *map(str, value)] if isinstance(value, tuple) else [f"{flag}={value}"]


def test_evaluations_that_are_given_stay():
    """Though they are the usual ones; else a short run has fewer, of whole trials."""
    make = lambda given, **plan: keywords.from_keywords("finger-spin", "sac", given, plan={"steps": 9000} | plan)
    plan_of = lambda given, **plan: make(given, **plan).plan
    assert plan_of({"trials": 3}).eval_episodes == 12
    assert plan_of({}).eval_every == 4500
    assert plan_of({}, eval_every=0).eval_every == 0


def test_names_bring_the_tuned_settings_and_objects_their_own(monkeypatch):
    """What is given by keyword changes them."""
    make = lambda *words, **given: keywords.from_keywords(*words, given, plan={})
    assert make("finger-spin-vary-size", "care") == with_preset("finger-spin-vary-size", "care")
    env = mtjax.make("finger-spin-vary-size")
    tuned = make(env, "care", num_envs=3, num_experts=2)
    assert tuned.training.num_envs == 3 and tuned.learner.encoder.num_experts == 2
    assert tuned.learner.actor_lr == with_preset("finger-spin-vary-size", "care").learner.actor_lr
    assert tuned.plan == Plan() and tuned.family is env
    plain = make("finger-spin", mtjax.agent("sac-conditioned"), vary={"size": "1:1.1:3"}, encoder="film")
    assert plain.training == Settings() and plain.family.train_count == 3
    assert agents.settings(plain.learner)["encoder"] == "film"


def test_a_presets_worlds_are_of_the_tasks_that_keywords_play():
    """Whether the curriculum is given by name or inside of settings; what else is given there stays."""
    vary = {"vary": {"size": "0.9:1.1:200"}}
    make = lambda given=vary, **more: keywords.from_keywords("finger-spin", "sac", given, plan={}, **more)
    named = make(vary | {"curriculum": "random:10:4000"})
    assert (named.training.num_envs, named.learner.experience.batch_size) == (16, 32)
    assert named.training.curriculum == "random:10:4000"
    inside = make(settings=Settings(num_envs=3, curriculum="random:10:4000"))
    assert (inside.training.num_envs, inside.learner.experience.batch_size) == (3, 32)
    of_all = make()
    assert (of_all.training.num_envs, of_all.learner.experience.batch_size) == (1, 4)
    with pytest.raises(InputError, match="plays 1 to 200 of the 200 training tasks at a time, not 201"):
        make(vary | {"curriculum": "random:201:4000"})
    with pytest.raises(InputError, match="curriculum"):
        make(vary | {"curriculum": 4})


def test_an_object_that_lacks_what_is_called_is_refused(monkeypatch):
    """By the names of what it lacks."""
    monkeypatch.delattr(Probe, "ends_early")
    with pytest.raises(InputError, match=r"a Probe lacks what mtjax\.types\.Env asks for: ends_early$"):
        mtjax.train(Probe(), tiny("sac"), steps=10)


def test_keywords_of_train_are_known_to_errors():
    """Agents and environments say that these belong to ``mtjax.train``."""
    fields = [field.name for cls in (Plan, Settings) for field in dataclasses.fields(cls)]
    assert sorted(checks.OF_TRAIN) == sorted(fields)


ENV = "finger-spin"
WRONG = [
    (("finger-spi", "sac"), {}, "unknown environment 'finger-spi'; did you mean 'finger-spin'?"),
    ((ENV, "sca"), {}, "unknown agent 'sca'; did you mean 'sac'?"),
    ((3, "sac"), {}, "env is the name of a family, or what mtjax.make returns; not 3"),
    ((ENV,), {}, "agent is a name such as 'care'"),
    ((ENV, agents.SAC), {}, "not the class SAC itself"),
    ((ENV, "sac"), {"size": 1}, "size is a parameter of finger-spin, not a setting: use vary={'size': 1}"),
    ((envs.make(ENV), "sac"), {"size": 1}, "use mtjax.make('finger-spin', vary={'size': 1})"),
    ((envs.make(ENV), "sac"), {"vary": {}}, "vary is a setting of the environment: use mtjax.make('finger-spin', vary"),
    ((ENV, "sac"), {"num_env": 4}, "unknown setting 'num_env'; did you mean 'num_envs'?"),
    ((ENV, "sac"), {"lr": 1e-3}, "unknown setting 'lr'; did you mean 'actor_lr'? choose from: actor_lr, critic_lr, "),
    (([ENV, "walker-walk"], "sac"), {}, "not a list; mtjax.mixture takes several"),
    ((ENV, "sac"), {"sweep": {"hidden": [(8,)]}}, "a sweep gives numbers to hidden, and (8,) is none"),
    ((ENV, "sac"), {"num_experts": 4}, "unknown setting 'num_experts'; it belongs to encoder='care', encoder='moe'"),
    ((ENV, "ppo"), {"batch_size": 4}, "unknown setting 'batch_size'; it belongs to agents with a replay, such as sac"),
    ((envs.make(ENV), tiny("sac")), {"cagrad_radius": 0.5}, "'cagrad_radius'; it belongs to gradients='cagrad'"),
    ((Probe("delayed"), tiny("sac")), {"num_experts": 4}, "it belongs to encoder='care', encoder='moe'"),
    ((ENV, "sac"), {"num_envs": "4"}, "num_envs must be a whole number, not '4'; leave out the quotes"),
    ((ENV, "sac"), {"steps": 1e5}, "steps must be a whole number, not 100000.0; write 100000"),
    ((ENV, "sac"), {"seeds": 2.5}, "seeds must be a whole number, not 2.5"),
    ((ENV, "sac"), {"seeds": True}, "seeds must be a whole number, not True"),
    ((ENV, "sac"), {"gamma": "high"}, "gamma must be a number, not 'high'"),
    ((ENV, "sac"), {"hidden": 64}, "hidden must be a list of whole numbers, such as (64, 64), not 64"),
    ((ENV, "sac"), {"stagger": 1}, "stagger must be True or False, not 1"),
    ((ENV, "sac"), {"encoder": 3}, "encoder must be a name or a part of that kind, not 3"),
    ((ENV, "sac"), {"directory": 3}, "directory must be a path, not 3"),
    ((ENV, "sac"), {"directory": ""}, "directory must be a path, not ''"),
    ((ENV, "sac"), {"resume": "x", "directory": "x"}, "resume must be True or False, not 'x'"),
    ((ENV, "sac"), {"quiet": "no"}, "quiet must be True or False, not 'no'"),
    ((ENV, "sac"), {"wandb": True, "directory": "x"}, "wandb must be a text, not True"),
    ((ENV, "sac"), {"vary": {"size": {}}}, "the values of size are lo:hi:n"),
    ((ENV, "sac"), {"resume": True}, "give directory as well"),
    ((ENV, "sac"), {"tensorboard": True}, "give directory as well"),
    ((ENV, "sac"), {"settings": {"num_envs": 3}}, "settings is a mtjax.Settings, not a dict"),
    ((ENV, "sac"), {"sweep": {"actor_lr": 1e-3}}, "sweep gives each number a list of values"),
    ((ENV, "sac"), {"sweep": {"actor_lr": ["x"]}}, "a sweep gives numbers to actor_lr, and 'x' is none"),
    ((ENV, "sac"), {"sweep": {"num_critics": [1, 2]}}, "num_critics cannot vary inside one program; train once"),
    ((ENV, "sac"), {"start": "nowhere"}, "'nowhere' is not a run"),
    ((ENV, "drq"), {}, "give pixels=64, or for states use agent='sac-conditioned', to which representation='encoded'"),
    ((ENV, "sac"), {"tune": "heads"}, "tune='heads' leaves the rest as a run left it; say which run: start=RUN"),
    ((ENV, "sac"), {"on_chunk": 3}, "on_chunk is a function of a row of metrics, not 3"),
    ((Probe("delayed"), tiny("sac")), {"directory": "x"}, "an environment derived from Family"),
]


@pytest.mark.parametrize("words, given, said", WRONG, ids=range(len(WRONG)))
def test_wrong_arguments_are_refused_in_a_line(words, given, said, tmp_path, monkeypatch):
    """Before anything compiles, and before a folder is made."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        mtjax.train(*words, **given)
    assert said in str(error.value) and "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_a_command_names_its_flags():
    """Though it calls the functions that name arguments in Python."""
    with pytest.raises(InputError, match=r"give --env\.pixels=64, or for states use --agent=sac-conditioned"):
        mtjax.train.main([f"--env={ENV}", "--agent=drq"])


@pytest.mark.parametrize(
    "flags, arguments",
    [
        ("use --engine=c or --engine=warp", "use engine='c' or engine='warp'"),
        ("use --agent.unit-head=false", "use unit_head=False"),
        ("lower --replay-size, --num-envs or --seeds.", "lower replay_size, num_envs or seeds."),
        ("or choose another place with --runs", "or choose another place with directory"),
        ("leave out --env.pixels and --agent.encoder-tau=0.5.", "leave out pixels and encoder_tau=0.5."),
        ("give --env.vary.size=0.9:1.1:5; or --from=RUN", "give vary={'size': '0.9:1.1:5'}; or start=RUN"),
        ("pip install --no-deps x, --import=FILE.py", "pip install --no-deps x, --import=FILE.py"),
    ],
)
def test_flags_are_written_as_arguments(flags, arguments):
    """Names with underscores, and words as text; what is no argument stays."""
    assert in_python(flags) == arguments


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: mtjax.make(ENV, size=1), "size is a parameter of finger-spin, not a setting: use vary={'size': 1}"),
        (lambda: mtjax.make(ENV, num_envs=4), "give it to mtjax.train(num_envs=...)"),
        (lambda: mtjax.make(ENV, vary=3), "vary maps parameters to values"),
        (lambda: mtjax.make(ENV, num_draws=1.5), "num_draws must be a whole number, not 1.5"),
        (lambda: mtjax.make(3), "an environment is chosen by name"),
        (
            lambda: mtjax.make([ENV, "walker-walk"]),
            "'walker-walk']; mtjax.mixture takes several",
        ),
        (lambda: mtjax.agent("SAC"), "unknown agent 'SAC'; did you mean 'sac'?"),
        (lambda: mtjax.agent(mtjax.agent("sac")), "such as 'care', not by a SAC"),
        (lambda: mtjax.preset(ENV, "sac", "gpus"), "unknown preset 'gpus'; did you mean 'gpu'?"),
        (lambda: mtjax.load("finger-spin-vary-size"), "did you mean 'finger-spin-vary-size/brc'?"),
        (lambda: mtjax.register("", "sac"), "a name is of letters, digits, -, _ and ., such as 'my-own', not ''"),
        (lambda: mtjax.register("a+b", "sac"), "not 'a+b'"),
        (lambda: mtjax.register(3, "sac"), "such as 'my-own', not 3"),
        (lambda: mtjax.agent("sac", num_envs=4), "give it to mtjax.train(num_envs=...)"),
        (lambda: mtjax.agent("sac", num_experts=4), "setting of sac 'num_experts'; it belongs to encoder='care', enc"),
        (lambda: mtjax.agent("sac", unroll=4), "it belongs to agents that learn from rollouts, such as ppo"),
        (lambda: mtjax.agent("sac", batch_size="7"), "batch_size must be a whole number, not '7'"),
        (lambda: mtjax.agent(3), "an agent is chosen by name"),
        (lambda: mtjax.load(3), "directory must be a path, not 3"),
        (lambda: mtjax.make(ENV, vary={"size": [[1, 2], [3, 4]]}), "the values of size are"),
        (lambda: mtjax.make(ENV, vary={"size": None}), "the values of size are"),
        (lambda: mtjax.mixture("bandit"), "a mixture takes a list of families"),
        (lambda: mtjax.mixture(3), "a mixture takes a list of families"),
        (lambda: mtjax.stacked(mtjax.make("bandit")), "there is nothing to stack without pictures"),
        (lambda: mtjax.stacked(3), "there is nothing to stack without pictures"),
        (lambda: mtjax.register("mine", 3), "register takes a class, or the name of an agent, not 3"),
    ],
)
def test_other_functions_say_it_alike(make, said):
    """The command line's kind of message."""
    with pytest.raises(InputError) as error:
        make()
    assert said in str(error.value)


def test_no_class_variable_is_offered_as_a_setting():
    """They cannot be given."""
    with pytest.raises(InputError) as error:
        mtjax.make(ENV, actionsize=1)
    assert "action_size" not in str(error.value)
    with pytest.raises(InputError, match="unknown setting"):
        mtjax.make(ENV, action_size=1)


def test_a_class_without_a_name_has_no_folder(tmp_path):
    """Nothing could read it again."""

    @dataclasses.dataclass(frozen=True)
    class Nameless(ShortFinger):
        pass

    with pytest.raises(InputError, match=r"needs a name for Nameless: mtjax\.register\('my-env', Nameless\)"):
        mtjax.train(Nameless(), "sac", directory=tmp_path / "x")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("name", agents.AGENTS)
def test_agents_are_called_by_their_names(name):
    """Also with other settings of their own."""
    assert agents.name_of(mtjax.agent(name)) == name
    assert agents.name_of(mtjax.agent(name, hidden=(8,))) == name


def test_what_is_printed_is_a_line(result):
    """Policies, results and tables of tasks; inside a compiled function too."""
    env = mtjax.make("finger-spin-vary-size")
    tasks = env.tasks()
    assert repr(tasks) == "Task(10 tasks: size 0.95 to 1.13)"
    assert repr(jax.tree.map(lambda x: x[0], tasks)) == "Task(one task: size 0.95)"
    assert repr(mtjax.make(ENV).tasks()) == "Task(1 task)"
    seen = []
    jax.make_jaxpr(lambda task: seen.append(repr(task)) or task.id)(tasks)
    assert seen == ["Task(10 tasks: size)"]
    assert repr(result.policy()) == (
        "Policy(sac-conditioned on finger-short: observation (9,), action (2,), one of 2 seeds)"
    )
    assert repr(result).startswith("Result(600 steps, return train ") and "\n" not in repr(result)


def test_a_policy_takes_one_task(result):
    """And says how to give it; observations may be many."""
    policy = result.policy()
    tasks = policy.env.tasks()
    one = jax.tree.map(lambda x: x[0], tasks)
    for wrong, fix in ((tasks, r"jax\.tree\.map"), (3, "NAME=VALUE")):
        with pytest.raises(InputError, match=f"takes one task, not .*: .*{fix}"):
            policy(np.zeros(9), wrong)
    for name, said in (("key", r"key is one of jax\.random\.key, not 3"), ("memory", r"memory is what policy\.begin")):
        with pytest.raises(InputError, match=said):
            policy(np.zeros(9), one, **{name: 3})
    with pytest.raises(InputError, match=r"give a task, or its parameters .*, not both"):
        policy(np.zeros(9), one, size=1.0)
    with pytest.raises(InputError, match=r"has shape \(9,\), not \(4, 3, 9\); a batch has one axis before it"):
        policy(np.zeros((4, 3, 9)), one)
    for impossible in (-1.0, [1.0, -1.0, 1.1]):
        with pytest.raises(InputError, match="size must be greater than 0, not -1"):
            policy(np.zeros((3, 9)), size=impossible)
    many = policy(np.ones((3, 9)), one)
    np.testing.assert_allclose(many, np.tile(policy(np.ones(9), one), (3, 1)), rtol=1e-6)
    assert jax.vmap(policy, (0, None))(np.zeros((3, 9)), one).shape == (3, 2)
    with pytest.raises(InputError, match="seed must be from 0 to 1"):
        result.policy(2)


@pytest.mark.slow
def test_a_sweep_of_python_leaves_a_run_too(short_family, tmp_path):
    """Its points are read back, and each has its policies."""
    given = {**PLAN, **SMALL, "sweep": {"actor_lr": [1e-3, 1e-2]}, "eval_every": 100}
    swept = mtjax.train("finger-short", "sac", steps=100, directory=tmp_path / "x", **given)
    recorded = from_json(tmp_path / "x" / "config.json")
    assert recorded.points == ({"actor_lr": 1e-3}, {"actor_lr": 1e-2})
    assert recorded.sweep == ("agent.actor-lr=0.001,0.01",)
    assert swept.policy(3).agent.actor_lr == mtjax.load(tmp_path / "x", 3).agent.actor_lr == 1e-2
    with pytest.raises(InputError, match="seed must be from 0 to 3"):
        swept.policy(4)


WRONG = [
    *({}, {"a": 1}, {1: 2}, [], ["cpu"], [[[]]], ("a",), set(), np.zeros(3), np.zeros(()), np.array(["a"]), 1.5, b"x"),
    *(object(), type, float("nan"), "a\0b", 10**5000),
]
TAKERS = {
    "preset's environment": lambda x: mtjax.preset(x, "sac"),
    "preset's agent": lambda x: mtjax.preset("bandit", x),
    "preset's name": lambda x: mtjax.preset("bandit", "sac", x),
    "environment": mtjax.make,
    "agent": mtjax.agent,
    "part": lambda x: mtjax.agent("sac", representation=x),
    "choice": lambda x: mtjax.agent("sac", conditioning=x),
    "split": lambda x: mtjax.make("finger-spin", split=x),
    "values of mixtures": lambda x: mtjax.train(mtjax.mixture(["bandit"]), "sac", steps=1, vary={"x": x}),
    "run": mtjax.load,
    "seed": lambda x: mtjax.load("reacher-vary-goal/ppo", seed=x),
    "checkpoint": lambda x: mtjax.load("reacher-vary-goal/ppo", checkpoint=x),
    "train's environment": lambda x: mtjax.train(x, "sac", steps=1),
    "train's agent": lambda x: mtjax.train("bandit", x, steps=1),
    "start": lambda x: mtjax.train("bandit", "sac", start=x, steps=1),
    "settings": lambda x: mtjax.train("bandit", "sac", settings=x, steps=1),
    "batch-size": lambda x: mtjax.train("bandit", "sac", batch_size=x, steps=1),
    "file": lambda x: mtjax.export(None, x),
    "runs to draw": read_runs.read,
    "split of tasks": lambda x: mtjax.make("bandit").tasks(x),
}


@pytest.mark.parametrize("taker", TAKERS)
def test_whatever_python_gives_is_used_or_refused(taker):
    """By an InputError of a line or two, before anything compiles."""
    for value in WRONG:
        with pytest.raises(InputError) as caught:
            TAKERS[taker](value)
        assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("vary", [{1: 2}, {"x": 2}, {"bandit.x": 10**5000}, 3])
def test_what_varies_in_a_mixture_is_named_by_text(vary):
    for train in (mtjax.make, lambda env, **given: mtjax.train(env, "sac", steps=1, **given)):
        with pytest.raises(InputError):
            train("bandit+tabular-mdp", vary=vary)
