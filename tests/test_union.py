"""A union of scenes: its worlds go on as those of their own scenes, and parked things touch nothing."""

import dataclasses
from functools import cache, partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import needs
from probes import QUICK
from test_joined import members, played, require_as_alone
from test_metaworld import made

import mtjax
from mtjax.command import run_config
from mtjax.envs import simulator_groups
from mtjax.envs.merged_simulator import United
from mtjax.envs.metaworld.names import BENCHMARKS, TASKS
from mtjax.envs.scene_bodies import Scene
from mtjax.envs.shared_simulator import Alone, Joined
from mtjax.learning import rollout
from mtjax.saved.config_json import from_json, to_flags, to_json
from mtjax.types import Acted, InputError

# The solver stops by a tolerance that counts the whole scene's degrees of freedom and mean inertia. Meta-World's worlds
# go on bit for bit, but for a few in which a thing slips or rolls: these were 4e-6 m off after a step.
ATOL = 2e-5
APART = 5.0  # [m] at least, between a parked thing and anything else
MT10 = tuple(name.removeprefix("metaworld-") for name in BENCHMARKS["mt10"][1])
NIGHTLY = pytest.mark.nightly  # half a minute
small_and_large = pytest.mark.parametrize(
    "names", [pytest.param(MT10, id="mt10"), pytest.param(tuple(TASKS), id="mt50", marks=pytest.mark.slow)]
)


@cache
def recorded(names):
    """A mixture in unions of tasks whose goals are the two recorded ones, the tasks, and what was recorded of each."""
    families, records = zip(*(made(name) for name in names), strict=True)
    env = mtjax.mixture(families, scenes="union")
    return env, env.tasks(), records


def make(*names, held_out=(), **settings):
    make = partial(mtjax.make, num_draws=2, engine="c")
    families = [make(f"metaworld-{name}", held_out=name in held_out) for name in names]
    return mtjax.mixture(families, **settings)


# What is united.


@needs("metaworld")
def test_the_setting_decides_how_many_simulators_there_are():
    env = mtjax.make("mt10", num_draws=1, engine="c")
    groups_of = lambda scenes: [type(group) for group in dataclasses.replace(env, scenes=scenes).groups]
    assert groups_of("union") == [United] and groups_of("apart") == [Alone] * 10
    assert groups_of("auto") == groups_of("joined") and set(groups_of("joined")) == {Joined, Alone}
    whole = dataclasses.replace(env, scenes="union").groups[0].simulator.models[0]
    assert (whole.nv, whole.nu, whole.neq, whole.nmocap) == (25, 2, 1, 1)  # the arm's 9, two free things, four hinges


@needs("metaworld")
def test_unions_have_room_for_so_many_degrees_of_freedom(monkeypatch):
    """Each of these has one beyond the arm's nine, or six. Tasks of one scene stay together."""
    names = ("door-open", "drawer-open", "push", "window-open", "drawer-close")
    assert members(make(*names, scenes="union")) == [list(names)]
    monkeypatch.setattr(simulator_groups, "_MOST_DOFS", 11)
    env = make(*names, scenes="union")
    assert members(env) == [["door-open", "drawer-open", "drawer-close"], ["push"], ["window-open"]]
    assert [type(group) for group in env.groups] == [United, Alone, Alone]


@needs("metaworld")
def test_what_cannot_be_united_goes_its_own_way():
    """Other settings of physics, more than one step at a time, and domains whose scenes are no scenes of things."""
    family = partial(mtjax.make, num_draws=1, engine="c")
    door, drawer = family("metaworld-door-open"), family("metaworld-drawer-open")
    other = family("metaworld-window-open", solver_iterations=7)
    twice = family("metaworld-push", repeat=2)
    walkers = [mtjax.make(name, engine="c") for name in ("walker-walk", "walker-run")]
    env = mtjax.mixture([door, drawer, other, twice, *walkers], scenes="union")
    kinds = [(type(group), len(group.members)) for group in env.groups]
    assert kinds == [(United, 2), (Alone, 1), (Alone, 1), (Joined, 2)]
    same = mtjax.mixture([drawer, family("metaworld-drawer-close")], scenes="union")
    assert [type(group) for group in same.groups] == [Joined]  # one scene, in which nothing would be parked


WORLD = """<mujoco><option gravity="0 0 {gravity}"/><worldbody><geom type="plane" size="1 1 1"/>
  <body name="arm"><joint name="turn"/><geom size="{arm}"/></body>
  <body name="thing" pos="{place} 0 1"><freejoint/><geom size="0.1" friction="{friction}"/></body></worldbody>
  <actuator><motor joint="turn"/></actuator>{more}</mujoco>"""


def world(gravity=-9, arm=0.1, place=1, friction=1, more=""):
    text = WORLD.format(gravity=gravity, arm=arm, place=place, friction=friction, more=more)
    return Scene(mujoco.MjModel.from_xml_string(text))


def test_things_are_equal_wherever_they_stand():
    kinds = lambda scene: list(scene.subtrees)
    plain = world()
    assert len(plain.subtrees) == 2 and kinds(world(place=2)) == kinds(plain)
    slippery = world(friction=0.5)
    assert kinds(slippery)[0] == kinds(plain)[0] and kinds(slippery)[1] != kinds(plain)[1]
    assert slippery.frame == plain.frame  # the arm has the motor, and the thing has nothing
    for other in (world(arm=0.2), world(gravity=-8)):
        assert other.frame != plain.frame
    tendon = "<tendon><fixed><joint joint='turn' coef='1'/></fixed></tendon>"
    with pytest.raises(InputError, match="ntendon=1 stays by itself"):
        _ = world(more=tendon).frame
    with pytest.raises(InputError, match="stays by itself"):
        _ = world(more="<sensor><clock/></sensor>").sensors


def test_scenes_is_a_setting_of_mixtures(tmp_path):
    """A run's record and its command keep it."""
    program = run_config.parse(["--env=bandit+tabular-mdp", "--agent=brc", "--env.scenes=union"])
    assert program.family == mtjax.make("bandit+tabular-mdp", scenes="union")
    assert program.family == mtjax.mixture(["bandit", "tabular-mdp"], "union") != mtjax.make("bandit+tabular-mdp")
    (tmp_path / "config.json").write_text(to_json(program, {"command": "x"}))
    assert from_json(tmp_path / "config.json") == run_config.parse(to_flags(program)) == program
    with pytest.raises(InputError, match="unknown scenes 'onion'; did you mean 'union'"):
        run_config.parse(["--env=bandit+tabular-mdp", "--agent=brc", "--env.scenes=onion"])
    with pytest.raises(InputError, match=r"bandit has no flag --env\.scenes"):
        run_config.parse(["--env=bandit", "--agent=brc", "--env.scenes=union"])


# How it steps.


@needs("metaworld")
@pytest.mark.parametrize("names", [pytest.param(MT10, id="mt10"), pytest.param(tuple(TASKS), id="mt50", marks=NIGHTLY)])
def test_a_step_is_that_of_the_own_scene(names, count=24):
    """From recorded states of scripted play, with both goals: all that worlds hold, observation, reward and success."""
    env, tasks, records = recorded(names)
    assert {type(group) for group in env.groups} == {United}
    chosen = [np.flatnonzero(record["time"] < record["time"].max())[:: 50 // count][:count] for record in records]
    stack = lambda name: np.stack([x[name][rows] for x, rows in zip(records, chosen, strict=True)])[None]
    actions = jnp.float32(np.stack([x["action"][rows + 1] for x, rows in zip(records, chosen, strict=True)])[None])
    rows = tasks.draws.row[np.arange(len(names))[:, None], stack("episode")[0]][None]
    each = rollout.broadcast_tasks(tasks, rows.shape)._replace(row=jnp.asarray(rows), blocks=tasks.blocks)
    keys = jax.random.split(jax.random.key(0), rows.shape)
    start = jax.jit(env.reset_worlds, compiler_options=QUICK)(each, keys).state
    states = []
    for i, (record, rows) in enumerate(zip(records, chosen, strict=True)):
        state = start.families[i]
        given = {name: jnp.float32(record[name][rows])[None, None] for name in ("qpos", "qvel")}
        mocap = jnp.float32(record["mocap"][rows])[None, None, :, None]
        states.append(state._replace(**given, mocap=mocap, warmstart=0 * state.warmstart))
    states = start._replace(families=tuple(states))
    own, found = (
        jax.jit(mixture.step_worlds, compiler_options=QUICK)(each, states, actions)
        for mixture in (dataclasses.replace(env, scenes="joined"), env)
    )
    np.testing.assert_allclose(found.obs, own.obs, atol=ATOL)
    np.testing.assert_allclose(found.reward, own.reward, atol=10 * ATOL)
    np.testing.assert_array_equal(found.metrics["success"], own.metrics["success"])
    for ours, theirs in zip(found.state.families, own.state.families, strict=True):
        assert ours._replace(extra=None, sensors=None) and jax.tree.map(jnp.shape, ours) == jax.tree.map(
            jnp.shape, theirs
        )
        np.testing.assert_allclose(ours.qpos, theirs.qpos, atol=ATOL)
        np.testing.assert_allclose(ours.qvel, theirs.qvel, atol=100 * ATOL)
        np.testing.assert_allclose(ours.sensors, theirs.sensors, atol=ATOL)
    same = np.mean(np.all(np.asarray(found.obs) == np.asarray(own.obs), axis=-1))
    assert same > 0.9, same


@needs("metaworld")
@small_and_large
def test_parked_things_touch_nothing_and_are_far_in_every_row(names):
    """As episodes begin, and after a control step in which nothing holds the parked ones."""
    env, _, _ = recorded(names)
    for group in env.groups:
        for i, family in group.members.items():
            places = group.union.places[list(group.members).index(i)]
            for row, start in enumerate((family.starts_of_goals[0], *family.starts_of_goals)):
                model = group.simulator.models[group._first[i] + row]
                data = mujoco.MjData(model)
                data.qpos[:] = group.union.qpos
                data.qpos[places.qpos], data.qvel[places.qvel] = start.state["qpos"], start.state["qvel"]
                data.mocap_pos[:], data.mocap_quat[:] = start.state["mocap"][:, :3], start.state["mocap"][:, 3:]
                for steps in (1, family.num_substeps):
                    mujoco.mj_step(model, data, nstep=steps)
                    require_parked(model, data, np.append(places.bodies, 0))


def require_parked(model, data, used):
    own = np.isin(model.geom_bodyid, used)
    assert np.all(own[data.contact.geom]) and not np.all(own)
    middle = lambda body: data.subtree_com[body]
    roots = np.flatnonzero(model.body_parentid[1:] == 0) + 1
    for body in np.setdiff1d(roots, used):
        others = [middle(other) for other in roots if other != body]
        assert np.linalg.norm(middle(body) - others, axis=1).min() > APART
    solid = (model.geom_contype | model.geom_conaffinity) > 0
    away = np.linalg.norm(data.geom_xpos[~own & solid], axis=1) - model.geom_rbound[~own & solid]
    assert away.min() > APART


@needs("metaworld")
@pytest.mark.slow
def test_held_out_tasks_step_in_the_union_as_alone():
    """A split has tasks of some families, in a union with others."""
    names, held_out = ("push", "door-open", "drawer-close", "window-open"), ("door-open", "window-open")
    env = make(*names, held_out=held_out, scenes="union")
    assert [type(group) for group in env.groups] == [United]
    require_as_alone(env, "extrapolation", atol=ATOL)
    calls = {name: about for name, about in env.calls.targets().items() if name.startswith("mujoco_advance")}
    again = make(*names, held_out=held_out, scenes="union")
    provided = {name: again.calls.provide(*about) for name, about in calls.items()}  # as another process does
    assert calls and all(name == found for name, found in provided.items())


@dataclasses.dataclass(frozen=True)
class Waving:
    """An agent that takes uniform actions."""

    def begin(self, state, task):
        return ()

    def act(self, state, memory, obs, task, key):
        return Acted(jax.random.uniform(key, (4,), minval=-1.0))


@needs("metaworld")
@pytest.mark.slow
def test_episodes_begin_anew_in_the_union_as_in_joined_scenes(steps=4, worlds=3):
    """Goals differ between worlds, and every world's episode ends once, each at another step."""
    found, agent, learners = [], Waving(), jnp.zeros(1)
    for scenes in ("union", "joined"):
        env = make("door-open", "drawer-close", "drawer-open", scenes=scenes)
        tasks = env.tasks()
        shape = (1, len(tasks.id), worlds)

        def play(tasks, env=env, shape=shape):
            begin = rollout.world_keys(jax.random.split(jax.random.key(0), 1), shape)
            held = rollout.reset_envs(env, agent, learners, tasks, begin)
            ages = jnp.broadcast_to(tasks.horizon[:, None] - 2 - jnp.arange(worlds), shape)

            def step(held, keys):
                act, reset = keys[:, 0], keys[:, 1]
                held, seen = rollout.step_envs(env, agent, learners, tasks, held, rollout.world_keys(act, shape))
                keys = partial(rollout.world_keys, reset, shape)
                begun, _ = rollout.reset_ended(env, agent, learners, tasks, held, seen.ends, keys)
                return begun, (seen, held.state)

            return jax.lax.scan(step, held._replace(age=ages), jax.random.split(jax.random.key(1), (steps, 1, 2)))[1]

        found.append(jax.jit(play, compiler_options=QUICK)(tasks))
    (seen, states), (expected, others) = found
    np.testing.assert_array_equal(np.sum(expected.transition.ended, axis=0), 1)
    for one, other in zip(jax.tree.leaves((seen, states)), jax.tree.leaves((expected, others)), strict=True):
        np.testing.assert_allclose(one, other, atol=100 * ATOL)
    targets = np.asarray(expected.transition.obs[..., 36:39])
    assert np.all(np.ptp(targets, axis=(0, 3)).max(-1) > 0)


@needs("metaworld")
@pytest.mark.slow
@needs("warp")
def test_the_union_steps_on_warp_as_joined_scenes_do():
    """By default there. Warp solves to less than C does, so a thing that slips is 1e-5 m off."""
    env = mtjax.make("mt10", num_draws=2, engine="warp")
    assert [type(group) for group in env.groups] == [United] and env.groups[0].outside in env.calls.makers
    own, found = (played(mixture, "train") for mixture in (dataclasses.replace(env, scenes="joined"), env))
    np.testing.assert_allclose(found[0], own[0], atol=1e-4)
    np.testing.assert_allclose(found[1], own[1], atol=1e-2)
