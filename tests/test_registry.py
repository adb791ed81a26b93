"""Every registered family, whatever runs it: it starts, steps, stays finite, repeats itself and names its tasks."""

import dataclasses
import importlib
import json
import re
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import SHORT_RUN
from probes import FEW, METAWORLD, Levers, param, set_physics, slow_but

import mtjax
import mtjax.evaluate
import mtjax.train
from mtjax import register
from mtjax.agents import AGENTS, PARTS
from mtjax.agents.parts.knowing import Parameters
from mtjax.command import help, keywords, run_config
from mtjax.envs import ENVS, Domain, Family, Parameter, effects, registration_checks
from mtjax.envs.brax import Brax
from mtjax.learning import loop
from mtjax.saved.config_json import to_flags, to_json
from mtjax.tasks import episode_task
from mtjax.types import SPLITS, InputError, MultiDiscrete

STEPS = 200
# Classes that differ in their reward alone have one family here.
alike = lambda cls: (cls.__module__, cls.start, cls.observe) if issubclass(cls, Domain) else cls
FIRST = {alike(cls): name for name, (cls, _) in reversed(list(ENVS.items()))}.values()
QUICK = [name for name in FIRST if name in FEW and not name.startswith("brax-")]  # Brax's take ten seconds each


def ends(env):
    """The first and last task of each split, twice: the ends of the range, and beyond."""
    tasks, rows = env.tasks("all"), [env.table.rows[split] for split in SPLITS]
    chosen = np.repeat([end for row in rows if len(row) for end in (row[0], row[-1])], 2)
    return jax.tree.map(lambda x: x[chosen], tasks)


@partial(jax.jit, static_argnums=0)
def play(env, tasks, keys):
    """Random actions for 200 steps in every world: first observations, and all that followed."""
    tasks = jax.vmap(episode_task)(tasks, keys)
    start = jax.vmap(env.reset)(tasks, keys)

    def step(state, i):
        draw = lambda key: env.spec.action.random(jax.random.fold_in(key, i))
        after = jax.vmap(env.step)(tasks, state, jax.vmap(draw)(keys))
        return after.state, (after.obs, after.reward, after.terminated)

    return start, *jax.lax.scan(step, start.state, jnp.arange(STEPS))


SHORT = ("ant", "fast", "inverted-pendulum")  # of Brax's, those that compile in seconds, and an ant
NIGHTLY = [name for name in ENVS if name.startswith("brax-") and not name.endswith(SHORT)]
LONG = ("dog-run", "errands", "racing")  # seconds each
AT_THE_ENDS = [param(name, nightly=True) for name in NIGHTLY]
AT_THE_ENDS += slow_but([x for x in ENVS if x not in NIGHTLY], *[x for x in QUICK[::4] if x not in LONG])


@pytest.mark.parametrize("name", AT_THE_ENDS)
def test_family_steps_at_the_ends_of_its_range(name):
    """200 random steps: sizes as declared, all finite until an episode ends, starts that differ, and the same again."""
    env = mtjax.make(name)
    tasks = ends(env)
    keys = jax.random.split(jax.random.key(0), len(tasks.id))
    start, state, (obs, reward, terminated) = play(env, tasks, keys)
    count = len(tasks.id)
    assert obs.shape == (STEPS, count, env.spec.obs_size) and obs.dtype == reward.dtype == jnp.float32
    assert tasks.context.shape == (count, env.spec.context_size) and env.episode_length >= 1
    alive = np.cumsum(terminated, axis=0) - np.asarray(terminated) == 0
    assert np.all(np.isfinite(np.asarray(obs)[alive])) and np.all(np.isfinite(np.asarray(reward)[alive]))
    assert max(np.ptp(np.asarray(x)[alive], axis=0).max() for x in (obs, reward)) > 0
    again = play(env, tasks, keys)
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    for one, other in zip(
        jax.tree.leaves((start, state, obs)), jax.tree.leaves((*again[:2], again[2][0])), strict=True
    ):
        np.testing.assert_array_equal(plain(one), plain(other))  # after its end a world may be anything, but the same


@pytest.mark.parametrize("name", slow_but(ENVS, *FEW[::2], nightly=True))
def test_family_round_trips_its_tasks(name):
    """A task is found again by its number, has its own name, and is unlike every other of its family."""
    env = mtjax.make(name)
    tasks = env.tasks("all")
    np.testing.assert_array_equal(tasks.id, np.arange(len(tasks.id)))
    parts = [env.tasks(split) for split in SPLITS]
    for leaf, *pieces in zip(*map(jax.tree.leaves, (tasks, *parts)), strict=True):
        np.testing.assert_array_equal(leaf, np.concatenate([np.asarray(x) for x in pieces]))
    assert len({env.describe(row) for row in range(len(tasks.id))}) == len(tasks.id)
    assert len(np.unique(np.asarray(tasks.context), axis=0)) == len(tasks.id)
    assert np.all(np.abs(np.asarray(env.tasks().context)) <= 1 + 1e-5)


@pytest.mark.slow
def test_a_family_of_ones_own_is_trained_and_evaluated(tmp_path, monkeypatch, capsys):
    """The worked example, by the commands that are printed; and it is under 70 lines."""
    file = Path(__file__).parents[1] / "examples" / "own_environment.py"
    assert len(file.read_text().splitlines()) < 70
    monkeypatch.setenv("MTJAX_CACHE", "0")
    small = (
        "--steps=480 --num-envs=2 --batch-size=2 --replay-size=50 --warmup-steps=1 --chunk-steps=20 --agent.hidden 4"
    )
    words = [f"--import={file}", "--env=spring", "--eval-episodes=1", f"--runs={tmp_path}", *small.split()]
    mtjax.train.main(words)
    (run,) = tmp_path.iterdir()
    command = shlex.split(json.loads((run / "config.json").read_text())["command"])
    assert f"--import={file}" in command
    env = mtjax.make("spring")
    assert env.varied == ("stiffness", "goal")
    assert [m.jnt_stiffness[0] for m in env.models[:12:3]] == [5, 10, 15, 20]
    capsys.readouterr()
    mtjax.evaluate.main([f"--run={run}", "--episodes=1"])
    assert "extrapolation" in capsys.readouterr().out
    monkeypatch.delitem(ENVS, "spring")


def test_names_are_given_once_and_with_settings_that_exist():
    with pytest.raises(InputError, match="already"):
        register("finger-spin", ENVS["finger-spin"][0])
    with pytest.raises(InputError, match="unknown setting of mine 'varry'"):
        register("mine", ENVS["finger-spin"][0], varry={})
    assert "mine" not in ENVS


EXAMPLES = Path(__file__).parents[1] / "examples"
OWN = {  # each file, what it registers and where, and the flags of its worked example
    "own_encoder": ("encoder", "gated", ["--agent.encoder=gated", "--agent.gate-widths", "4"]),
    "own_gradient_rule": ("gradients", "consensus", ["--agent.gradients=consensus", "--agent.sharpness=2"]),
    "own_sampler": ("sampler", "below-mark", ["--agent.sampler=below-mark", "--agent.mark=1"]),
    "own_scaling": ("scaling", "largest", ["--agent.scaling=largest"]),
    "own_agent": ("agent", "best-of", ["--agent=best-of", "--agent.candidates=2"]),
}


@pytest.fixture
def forget():
    """Take what a test registers out of the tables again, and its files out of those that were imported."""
    tables = (ENVS, AGENTS, *PARTS.values())
    before, modules = [set(table) for table in tables], set(sys.modules)
    yield
    for table, names in zip(tables, before, strict=True):
        for name in set(table) - names:
            del table[name]
    for name in set(sys.modules) - modules:
        if name.startswith("own_"):
            del sys.modules[name]


@pytest.mark.parametrize("name", slow_but(OWN, nightly=True))
def test_parts_and_agents_of_ones_own_are_trained(name, short_family, forget, tmp_path, capsys):
    """The worked examples, by the command line, and again from the run's own record; each is under 60 lines."""
    kind, own, flags = OWN[name]
    file = EXAMPLES / f"{name}.py"
    assert len(file.read_text().splitlines()) < 60
    mtjax.train.main([f"--import={file}", *SHORT_RUN[:1], *SHORT_RUN[2:], *flags, "--steps=200", f"--runs={tmp_path}"])
    (run,) = tmp_path.iterdir()
    record = json.loads((run / "config.json").read_text())
    assert f"--import={file}" in shlex.split(record["command"])
    assert (record["agent"] if kind == "agent" else record["learner"][kind]) == own
    assert type(mtjax.load(run).agent) is AGENTS[record["agent"]].cls


@pytest.mark.slow
def test_a_run_of_all_examples_together_is_traced(forget):
    """Each does what the loop asks of its kind, as its observing and weighing; no program is compiled."""
    words = [word for name in OWN for word in (f"--import={EXAMPLES / name}.py", *OWN[name][2])]
    config = run_config.parse(["--env=control-cartpole", "--batch-size=4", *words, "--agent.hidden", "8"])
    tasks = config.family.tasks()
    fixed = (config.family, config.learner, config.training)
    state = jax.eval_shape(partial(loop.init, *fixed), tasks, jnp.zeros(1, jnp.uint32))
    after, _ = jax.eval_shape(partial(loop.run_chunk, *fixed), tasks, state)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)


def test_an_agent_is_another_with_other_defaults(forget):
    register("my-care", "care", num_experts=3, actor_lr=1e-2)
    agent = mtjax.agent("my-care")
    assert agent.encoder.num_experts == 3 and agent.actor_lr == 1e-2 and agent.conditioning == Parameters()


@pytest.mark.parametrize(
    "hook, instead", [("check", "in __post_init__"), ("relabel", "relabel steps"), ("consolidate", "a part")]
)
def test_an_agent_with_a_method_that_nothing_calls_is_refused(hook, instead, forget):
    """As it was called once, and would be passed over in silence."""
    own = type("Mine", (AGENTS["sac"].cls,), {hook: lambda self, *given: None})
    with pytest.raises(InputError, match=f"nothing calls Mine.{hook}: .*{instead}"):
        register("mine", own)
    assert "mine" not in AGENTS


def test_what_cannot_be_registered_is_refused(forget):
    """In a line that says why, and without a trace."""

    @dataclasses.dataclass(frozen=True)
    class Clash(PARTS["encoder"]["identity"]):
        gamma: float = 0.5

    with pytest.raises(InputError, match="Clash and agents would both have a setting gamma"):
        register("clash", Clash)
    with pytest.raises(InputError, match="encoder 'care' exists already"):
        register("care", type("Mine", (PARTS["encoder"]["identity"],), {}))
    with pytest.raises(InputError, match="agent 'sac' already"):
        register("sac", "care")
    with pytest.raises(InputError, match="must be a subclass of"):
        register("mine", dict)
    with pytest.raises(InputError, match="actor-lr must be greater than 0"):
        register("mine", "sac", actor_lr=-1.0)
    assert "mine" not in AGENTS and "clash" not in PARTS["encoder"]


# Own files in a run's record, and checks of own families.


@pytest.fixture
def spring(forget):
    """The worked example's class, registered."""
    sys.path.insert(0, str(EXAMPLES))
    yield importlib.import_module("own_environment").Spring
    sys.path.remove(str(EXAMPLES))


def set_missing(spec, value):
    """Edits a joint that the model lacks."""
    spec.joint("slid").stiffness[0] = value


def set_wrongly(spec, value):
    """Fails with a name that the model has."""
    spec.joint("slide").stiffnes = value


WRONG = [
    (
        {"reward": lambda s, t, w, a: jnp.zeros(2)},
        r"Mine\.reward must return a number of shape \(\), not \(2,\)",
    ),
    ({"reward": lambda s, t, w, a: t.goal["gaol"]}, "reward: unknown goal of the task 'gaol'; did you mean 'goal'"),
    ({"reward": lambda s, t, w: 0}, "reward: TypeError: .* takes 3 positional arguments"),
    ({"observe": lambda s, t, w: ()}, r"observe must return an observation of numbers, not \(\)"),
    ({"observe": lambda s, t, w: jax.random.key(0)}, "observe must return an observation of numbers"),
    ({"observe": lambda s, t, w: s.models[0].geom("x")}, "observe: KeyError: .*Invalid name 'x'"),
    ({"start": lambda s, t, k: (jnp.zeros(2), jnp.zeros(1))}, r"start must return positions of shape \(1,\)"),
    ({"start": lambda s, t, k: jnp.zeros(2)}, "start must return positions and velocities"),
    ({"terminates": lambda s, t, w: 1.0}, "terminates must return a bool as an array of bool, not float32"),
    ({"control": lambda s, t, w, a: a}, "control must return the world, and the controls of the step"),
    ({"control": lambda s, t, w, a: (w, jnp.zeros(3))}, r"control must return controls of shape \(1,\), not \(3,\)"),
    ({"control": lambda s, t, w, a: (w, a * t.goal["gaol"])}, "control: unknown goal of the task 'gaol'"),
    ({"metrics": lambda s, t, w, a: {"far": jnp.zeros(1)}}, r"metrics must return 'far' of shape \(\), not \(1,\)"),
    ({"metrics": lambda s, t, w, a: jnp.zeros(1)}, "metrics must return numbers by their names"),
    ({"episode_steps": None}, "episode_steps must be a whole number of at least 1, not None"),
    (
        {"parameters": {"x": Parameter("1", 0.0, set_missing)}},
        r"\(set_missing\): unknown joint .*'slid'; did you",
    ),
    ({"parameters": {"x": Parameter("1", 0.0, set_wrongly)}}, r"parameters\['x'\] \(set_wrongly\): AttributeError"),
    ({"parameters": {"x": Parameter("1", 5.0, maximum=1.0)}}, "the bounds of 'x' are out of order"),
    ({"model_file": "<mujoco><geo/></mujoco>"}, "model_file: ValueError: XML Error"),
    ({"model_file": "none.xml"}, "model_file: there is no model file"),
]


@pytest.mark.parametrize("given, said", WRONG, ids=range(len(WRONG)))
def test_a_wrong_method_of_a_family_is_named_when_it_is_registered(given, said, spring):
    """Without compiling anything; and the name stays free."""
    mine = dataclasses.dataclass(frozen=True)(type("Mine", (spring,), given))
    with pytest.raises(InputError, match=said) as error:
        register("mine", mine)
    assert "\n" not in str(error.value) and "mine" not in ENVS


def test_a_family_that_steps_itself_is_checked_too(forget):
    """Reset and step must agree."""
    corridor = type(mtjax.make("two-goal-maze"))

    @dataclasses.dataclass(frozen=True)
    class Mine(corridor):
        def step(self, task, state, action):
            step = super().step(task, state, action)
            return step._replace(obs=step.obs[:-1])

    with pytest.raises(InputError, match="Mine: reset and step return a different obs"):
        register("mine", Mine)
    with pytest.raises(InputError, match="Family cannot be made"):
        register("mine", mtjax.envs.Family)


def test_a_family_that_gives_its_own_action_is_checked(forget):
    """It is one of the kinds, and size and kind follow from it; the parts that it derives from come before Family."""

    class Late(Family):
        sizes = (3, 5)
        action, best, reset, step, show = Levers.action, Levers.best, Levers.reset, Levers.step, Levers.show
        parameters, episode_steps = Levers.parameters, 6

    class Box(Levers):
        action = (3, 5)

    with pytest.raises(InputError, match=r"Late gives its action itself: derive it from .*Acting before Family"):
        register("late", dataclasses.dataclass(frozen=True)(Late))
    with pytest.raises(InputError, match=r"Box.action must be Continuous, Discrete or MultiDiscrete .*not \(3, 5\)"):
        register("box", Box)
    register("levers", Levers, vary={"turn": "0,1"}, split="none")
    assert mtjax.make("levers").spec.action == MultiDiscrete((3, 5))


def shortened(self, task, state, action):
    """A step with a number less to observe."""
    step = Brax.step(self, task, state, action)
    return step._replace(obs=step.obs[:-1])


def look_for_link(self, task, metrics, reward, action):
    """A reward that looks for a link by a wrong name."""
    return reward * self.original.sys.link_names.index("pol")


WRONG_OF_BRAX = [
    ({"step": shortened}, r"Mine: reset and step return a different obs: .*\(4,\) float32 and .*\(3,\) float32"),
    ({"reward": lambda s, t, m, r, a: jnp.zeros(2)}, r"reward must return a number of shape \(\), not \(2,\)"),
    ({"reward": lambda s, t, m, r, a: None}, "reward must return a number as an array of float, not None"),
    ({"reward": lambda s, t, m: 0}, "reward: TypeError: .* takes 3 positional arguments"),
    ({"reward": lambda s, t, m, r, a: m["height"]}, "reward: .*metric of Brax's inverted_pendulum 'height'"),
    ({"reward": lambda s, t, m, r, a: t.goal["gravty"]}, "reward: unknown goal of the task 'gravty'; did .* 'gravity'"),
    ({"reward": look_for_link}, "reward: unknown link of the model 'pol'; did you mean 'pole'.* cart, pole$"),
    ({"action_size": 3}, "action_size must be 1, as Brax's inverted_pendulum has, not 3"),
    ({"parameters": {"x": Parameter("1", 1.0, set_missing)}}, r"parameters\['x'\]: Brax takes no edits of its models"),
    ({"names": ("ant",)}, "unknown Brax environment 'inverted_pendulum'"),
]


@pytest.mark.parametrize("given, said", WRONG_OF_BRAX, ids=range(len(WRONG_OF_BRAX)))
def test_a_wrong_method_of_a_brax_family_is_named_when_it_is_registered(given, said, forget):
    """In a line; the name stays free, and without the harm the same class is accepted."""
    of_pendulum = {"environment": "inverted_pendulum", "__annotations__": {"environment": str}}
    mine = dataclasses.dataclass(frozen=True)(type("Mine", (Brax,), of_pendulum | given))
    with pytest.raises(InputError, match=said) as error:
        register("mine", mine)
    assert "\n" not in str(error.value) and "mine" not in ENVS


@pytest.mark.slow
def test_a_brax_family_with_a_reward_of_its_own_is_accepted(forget):
    """Which reads a goal, a metric and the place of a link."""

    @dataclasses.dataclass(frozen=True)
    class Mine(Brax):
        environment: str = "reacher"
        parameters: ClassVar = {**Brax.parameters, "ease": Parameter("1", 1.0)}

        def reward(self, task, metrics, reward, action):
            assert self.original.sys.link_names.index("body0") == 0
            return task.goal["ease"] * metrics["reward_dist"] + reward

    register("mine", Mine, vary={"ease": "1,2", "gravity": 5})
    assert mtjax.make("mine").train_count == 2 and type(mtjax.make("mine").original.sys.link_names) is list


@pytest.mark.parametrize("name", slow_but([x for x in ENVS if x.startswith("brax-")], "brax-fast", nightly=True))
def test_every_family_of_brax_passes_the_check(name):
    registration_checks.check(mtjax.make(name))


@pytest.mark.parametrize(
    "name", [param(name) for name in QUICK if name not in METAWORLD]
)  # whose model is no file of ours
def test_every_family_of_the_package_passes_the_check(name):
    """So that the check asks for nothing that a family need not have."""
    registration_checks.check(mtjax.make(name))


@pytest.mark.parametrize("name", [name for name in QUICK if name not in METAWORLD])
def test_every_parameter_of_the_package_changes_something(name):
    """But for one that changes nothing in MTEnv either, as its documentation says."""
    if name != "control-acrobot":
        return effects.require_effects(mtjax.make(name))
    assert "It changes nothing" in (ENVS[name][0].__doc__ or "")
    with pytest.raises(InputError, match=r"'link-length-2'\] changes nothing: reset and step do not read"):
        effects.require_effects(mtjax.make(name))
    return None


def test_a_goal_that_only_controls_read_changes_something(spring):
    def control(self, task, world, action):
        return world, action + task.goal["wind"]

    given = {"control": control, "parameters": {**spring.parameters, "wind": Parameter("1", 0.0, minimum=-1.0)}}
    effects.require_effects(dataclasses.dataclass(frozen=True)(type("Windy", (spring,), given))())


def test_a_family_of_random_tasks_takes_ranges_and_says_how_to_list_values():
    """As a list would be drawn from like a range, without a word. A single value is for all tasks."""
    for values in ("4:8:3", "4,6", [4.0, 6.0]):
        with pytest.raises(InputError, match=r"sailing draws its tasks at random, .*wind-speed=lo:hi;.*=.?grid"):
            mtjax.make("sailing", vary={"wind-speed": values})
    listed = mtjax.make("sailing", vary={"wind-speed": "4,6"}, combine="grid")
    assert sorted(set(listed.params("train")["wind-speed"])) == [4, 6]
    assert set(mtjax.make("sailing", vary={"wind-speed": 5.0}).params("train")["wind-speed"]) == {5}


def set_body_mass(spec, value):
    """Set a mass that the body's geoms give instead."""
    spec.body("cart").mass = value


def set_colour(spec, value):
    """Paint a geom."""
    spec.geoms[0].rgba = [value, 0, 0, 1]


IDLE = [
    (Parameter("kg", 1.0, set_body_mass), r"'x'\] changes nothing: the compiled model has the same physics"),
    (Parameter("1", 0.5, set_colour), r"'x'\] changes nothing: the compiled model .* has looks=True"),
    (Parameter("1", 0.5), r"'x'\] changes nothing: reset and step do not read task.goal\['x'\]"),
    (Parameter("1", 0.5, lambda spec, value: None, looks=True), r"'x'\] changes nothing: pictures are the same"),
]


@pytest.mark.parametrize("parameter, said", IDLE, ids=range(len(IDLE)))
def test_a_parameter_that_changes_nothing_is_refused(parameter, said, spring):
    """With its name, before anything varies it."""
    parameters = {**spring.parameters, "x": parameter}
    mine = dataclasses.dataclass(frozen=True)(type("Mine", (spring,), {"parameters": parameters}))
    with pytest.raises(InputError, match=r"Mine\.parameters\[" + said):
        register("mine", mine)
    assert "mine" not in ENVS


def test_parameters_that_only_a_method_or_a_picture_reads_are_accepted(spring):
    """A goal that the start alone reads, and a colour that is said to be one."""

    @dataclasses.dataclass(frozen=True)
    class Mine(spring):
        parameters: ClassVar = {
            **spring.parameters,
            "width": Parameter("m", 0.5),
            "red": Parameter("1", 0.5, set_colour, looks=True),
        }

        def start(self, task, key):
            return task.goal["width"] * jax.random.uniform(key, (1,)), jnp.zeros(1)

    register("mine", Mine)


def test_an_episode_ends_where_the_family_says(spring):
    """With no discount left; the time limit is another matter."""
    env = mtjax.make("spring")
    task = jax.tree.map(lambda x: x[0], env.tasks())
    begun = env.reset(task, jax.random.key(0))
    far = set_physics(env, task, begun.state, jnp.array([2.5]), jnp.zeros(1))
    assert not env.step(task, begun.state, jnp.zeros(1)).terminated and env.step(task, far, jnp.zeros(1)).terminated


OWN_FILES = [EXAMPLES / f"{name}.py" for name in ("own_environment", "own_encoder")]
OWN_FLAGS = [f"--import={file}" for file in OWN_FILES]
OWN_WORDS = ["--env=spring", "--agent=sac-conditioned", "--agent.encoder=gated", "--split=none", "--steps=480"]


def forget_own():
    """Let this process know the files no longer."""
    for table, name in ((ENVS, "spring"), (PARTS["encoder"], "gated")):
        del table[name]
    for file in OWN_FILES:
        del sys.modules[file.stem]


@pytest.mark.slow
def test_all_files_of_a_run_are_recorded_and_asked_for_and_never_run_by_themselves(forget, tmp_path):
    """By evaluation, by resuming and in Python."""
    config = run_config.parse([OWN_FLAGS[0], "--import", str(OWN_FILES[1]), *OWN_WORDS])
    assert [word for word in to_flags(config) if word.startswith("--import")] == OWN_FLAGS
    (tmp_path / "config.json").write_text(to_json(config, {"command": ""}))
    (tmp_path / "evaluations.npz").touch()
    forget_own()
    for call in (
        lambda: mtjax.evaluate.main([f"--run={tmp_path}"]),
        lambda: mtjax.train.main([f"--resume={tmp_path}", "--steps=960"]),
        lambda: mtjax.load(tmp_path),
        lambda: mtjax.runs(tmp_path),
    ):
        with pytest.raises(InputError, match="uses code of your own: add ") as error:
            call()
        assert " ".join(OWN_FLAGS) in str(error.value)
    assert "own_environment" not in sys.modules and "spring" not in ENVS
    with pytest.raises(InputError, match="holds no checkpoint"):  # the files are found, and the run is read
        mtjax.evaluate.main([f"--run={tmp_path}", *OWN_FLAGS])


@pytest.mark.slow
def test_a_run_of_own_files_is_evaluated_and_resumed_with_them(forget, short_family, tmp_path, capsys):
    """By the flags that the errors ask for."""
    small = [word for word in SHORT_RUN if not word.startswith(("--env", "--agent=", "--steps", "--seeds"))]
    mtjax.train.main([*OWN_FLAGS, *OWN_WORDS, *small, f"--runs={tmp_path}"])
    (run,) = tmp_path.iterdir()
    forget_own()
    mtjax.evaluate.main([f"--run={run}", "--episodes=1", *OWN_FLAGS])
    forget_own()
    mtjax.train.main([*OWN_FLAGS, f"--resume={run}", "--steps=960"])
    assert "done in" in capsys.readouterr().out


def test_an_agent_with_other_defaults_names_its_file(forget, tmp_path):
    """Though its class is the package's own."""
    file = tmp_path / "own_defaults.py"
    file.write_text('import mtjax\n\nmtjax.register("my-care", "care", num_experts=3)\n')
    flag = f"--import={file}"
    config = run_config.parse([flag, "--agent=my-care"])
    assert config.imports == (str(file),) and flag in to_flags(config)
    assert keywords.from_keywords("finger-spin", "my-care", {}, plan={}).imports == (str(file),)


@pytest.mark.parametrize(
    "text, flag, named",
    [
        (
            "class Spring(mtjax.envs.Domain): pass",
            "--env=spring",
            "your Spring has no name: call mtjax.register('spring', Spring)",
        ),
        (
            "class Mine(mtjax.agents.SAC): pass",
            "--agent=mine",
            "your Mine has no name: call mtjax.register('mine', Mine)",
        ),
    ],
)
def test_own_classes_without_a_name_are_told_how_to_get_one(text, flag, named, forget, tmp_path):
    """Where a file defines a class, and calls nothing."""
    file = tmp_path / "own_nameless.py"
    file.write_text(f"import mtjax\n\n{text}\n")
    with pytest.raises(InputError, match=re.escape(named)):
        run_config.parse([f"--import={file}", flag])


def test_unknown_names_of_a_run_mention_import(tmp_path):
    """If the run does not say which file, as it was registered in a notebook."""
    record = json.loads(to_json(run_config.parse([]), {"command": ""}))
    (tmp_path / "config.json").write_text(json.dumps({**record, "env": "gone"}))
    with pytest.raises(InputError, match=r"unknown environment 'gone'.*give --import=FILE\.py with the file that"):
        mtjax.load(tmp_path)


def test_the_list_says_what_varies():
    lines = help.catalogue().splitlines()
    assert any("finger-spin-vary-size " in line and "[size=0.95:1.13:10]" in line for line in lines)
