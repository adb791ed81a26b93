"""Meta-World's tasks as environments: steps against recorded ones, the hand, goals, and benchmarks as mixtures."""

import importlib.util
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from needs import needs
from probes import set_physics

import mtjax
from mtjax.command import run_config
from mtjax.envs import BENCHMARKS, name_of
from mtjax.envs.engines.base import at_rest
from mtjax.envs.metaworld import sawyer, scene
from mtjax.envs.metaworld.names import TASKS
from mtjax.envs.physics import base_model
from mtjax.names import load
from mtjax.report import render, scoring
from mtjax.report.tables import split_table
from mtjax.saved.config_json import from_json, to_json
from mtjax.types import InputError

DATA = Path(__file__).parent / "data" / "metaworld"
QUICK = ("drawer-close", "push")
one_or_all = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in TASKS]
)


@cache
def made(name):
    """Return a task's family whose goals are the two recorded ones, and the recorded arrays."""
    with np.load(DATA / f"{name}.npz") as file:
        recorded = dict(file)
    cls = load(f"mtjax.envs.metaworld.{TASKS[name]}")
    given = type(cls.__name__, (cls,), {"vectors": lambda self: recorded["rand_vec"]})
    return given(num_draws=2, engine="c"), recorded


def goals(env):
    """Return the tasks of a family's goals, leaves (P, ...)."""
    return jax.tree.map(lambda x: jnp.asarray(x[0]), env.tasks().draws)


def begin(env):
    """Return the goals, and a first step of each."""
    tasks = goals(env)
    return tasks, jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), len(tasks.id)))


@needs("metaworld")
@one_or_all
def test_a_step_is_that_of_the_original(name):
    """From every recorded state: physics, observation, reward and success after one step.

    MuJoCo 3.17 solves contacts a little unlike 3.3. A reward with a threshold may fall on its other side.
    """
    env, recorded = made(name)
    tasks, start = begin(env)
    np.testing.assert_allclose(start.obs, recorded["start_obs"], atol=4e-3)
    np.testing.assert_array_equal(start.obs[:, :18], start.obs[:, 18:36])
    episode, time = recorded["episode"], recorded["time"]
    before = np.flatnonzero((episode[:-1] == episode[1:]) & (time[:-1] + 1 == time[1:]))
    part = lambda key, rows: jnp.asarray(recorded[key][rows])

    def step(task, qpos, qvel, mocap, seen, action):
        return env.step(task, env.simulator.forward(task, qpos, qvel, seen[:18], mocap[None]), action)

    states = [part(key, before) for key in ("qpos", "qvel", "mocap", "obs")]
    each = jax.tree.map(lambda x: x[episode[before]], tasks)
    after = jax.jit(jax.vmap(step))(each, *states, part("action", before + 1))
    expected = np.concatenate([part("obs", before + 1)[:, :18], states[3][:, :18], part("obs", before + 1)[:, 18:]], 1)
    np.testing.assert_allclose(after.obs, expected, atol=3e-2)
    assert np.mean(np.abs(after.obs - expected).max(1)) < 6e-3
    off = np.abs(after.reward - recorded["reward"][before + 1])
    assert np.median(off) < 5e-3 and np.sum(off > 0.2) <= 3
    np.testing.assert_array_equal(after.metrics["success"], recorded["success"][before + 1])


@pytest.mark.slow
@needs("metaworld")
def test_the_hand_follows_its_target_inside_the_box():
    """At most 0.01 m a step, and the gripper closes as the action says."""
    env, _ = made("push")
    tasks, start = begin(env)
    actions = jnp.repeat(jnp.array([[3.0, 0.5, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]]), jnp.array([20, 40]), axis=0)
    drive = lambda task, state: jax.lax.scan(lambda state, a: (env.step(task, state, a).state, state), state, actions)
    last, before = jax.jit(jax.vmap(drive))(tasks, start.state)
    way = np.diff(before.mocap[:, :, 0, :3], axis=1)
    np.testing.assert_allclose(way[:, 0], [[0.01, 0.005, -0.01]] * 2, atol=1e-6)
    np.testing.assert_allclose(last.mocap[:, 0, :3], [[0.2, 0.7, env.hand_low[2]]] * 2, atol=1e-5)
    assert np.abs(last.sensors[:, :3] - last.mocap[:, 0, :3]).max() < 0.02
    opened = jax.vmap(env.observe)(tasks, last)[:, 3]
    assert np.all(start.obs[:, 3] > 0.99) and np.all(opened < 0.3)


@needs("metaworld")
def test_a_fixed_body_that_is_moved_is_felt_where_it_is():
    """Two worlds press the place of the first one's button. The other's box is elsewhere."""
    env = mtjax.make("metaworld-button-press-topdown", num_draws=8, engine="c")
    tasks = goals(env)
    x = np.asarray(tasks.goal["target"][:, 0])
    chosen = np.array([x.argmin(), x.argmax()])
    assert np.ptp(x[chosen]) > 0.1
    tasks = jax.tree.map(lambda leaf: leaf[chosen], tasks)
    target = tasks.goal["target"][0]

    def press(task):
        def step(state, _):
            hand = state.sensors[:3]
            aside = jnp.linalg.norm((target - hand)[:2]) > 0.02
            aim = target.at[2].set(jnp.where(aside, 0.4, 0.1))
            after = env.step(task, state, jnp.append(jnp.clip(10 * (aim - hand), -1, 1), 1.0))
            return after.state, after.metrics["success"]

        return jax.lax.scan(step, env.reset(task, jax.random.key(0)).state, length=150)[1]

    success = np.asarray(jax.jit(jax.vmap(press))(tasks))
    assert success[0].any() and not success[1].any()


@needs("metaworld")
def test_goals_differ_by_the_seed_of_tasks_and_may_be_hidden():
    one, other = (mtjax.make("metaworld-reach", num_draws=3, task_seed=seed, engine="c") for seed in (0, 1))
    assert not np.intersect1d(one.vectors()[:, 3:], other.vectors()[:, 3:]).size
    hidden = mtjax.make("metaworld-reach", num_draws=3, goal_hidden=True, engine="c")
    tasks, start = begin(hidden)
    after = jax.jit(jax.vmap(hidden.step))(tasks, start.state, jnp.zeros((3, 4)))
    for step in (start, after):
        assert not step.obs[:, 36:].any() and step.obs[:, :18].any()
    np.testing.assert_allclose(tasks.goal["target"], one.vectors()[:, 3:], atol=1e-6)
    assert np.ptp(after.reward) > 0
    table = one.table
    assert table.draws.shape == (1, 3) and one.train_count == 1
    assert len({id(model) for model in one.models}) == 1  # nothing fixed is moved


@needs("metaworld")
@pytest.mark.parametrize("name, seed", [("mt10", 0), ("mt25", 1), ("mt50", 1), ("ml10", 3), ("ml45", 1)])
def test_goals_are_those_of_the_originals_benchmark_for_a_seed(name, seed):
    """Number for number: the first and the last goal of every task, which depend on all that were drawn before."""
    with np.load(DATA.parent / "metaworld-goals.npz") as file:
        recorded = file[f"{name}-{seed}"]
    families = mtjax.make(name, task_seed=seed).families
    assert len(recorded) == len(families)
    for family, expected in zip(families, recorded, strict=True):
        vectors = family.vectors()
        size = vectors.shape[1]
        np.testing.assert_array_equal(vectors[[0, -1]], expected[:, :size])
        assert vectors.shape == (50, size) and not expected[:, size:].any()


@needs("metaworld")
def test_goals_of_a_task_alone_are_those_of_mt1():
    with np.load(DATA.parent / "metaworld-goals.npz") as file:
        alone, tasks_of_mt10 = file["push-3"][0], file["mt10-0"]
    push = mtjax.make("metaworld-push", task_seed=3)
    np.testing.assert_array_equal(push.vectors()[[0, -1]], alone)
    of_benchmark = mtjax.make("metaworld-push", benchmark="mt10", task_seed=0)  # its second task
    np.testing.assert_array_equal(of_benchmark.vectors()[[0, -1]], tasks_of_mt10[1])
    with pytest.raises(InputError, match="did you mean 'mt10'"):
        mtjax.make("metaworld-push", benchmark="mt1O")
    with pytest.raises(InputError, match="ml10 does not have the task soccer"):
        mtjax.make("metaworld-soccer", benchmark="ml10")


@needs("metaworld")
def test_an_evaluation_may_draw_other_goals():
    """Those of ML1's test are of the next seed. Tasks keep their numbers, as their contexts are the same."""
    for name in ("metaworld-push", "metaworld-push+metaworld-reach"):
        env, expected = (mtjax.make(name, task_seed=seed, num_draws=2, engine="c") for seed in (3, 4))
        other = scoring.drawn_anew(env, 4)
        for ours, theirs in zip(other.parts, expected.parts, strict=True):
            np.testing.assert_array_equal(ours.family.vectors(), theirs.family.vectors())
        again = scoring.as_unseen(other.tasks("all"), env)
        np.testing.assert_array_equal(again.id, env.tasks("all").id)


@needs("metaworld")
def test_goals_of_ml1s_test_are_those_of_the_next_seed():
    """They are held out in a task of their own; of a benchmark too."""
    for name, given in (("metaworld-push", {}), ("metaworld-reach", {"benchmark": "ml10"})):
        env = mtjax.make(name, task_seed=3, num_draws=2, engine="c", test_goals=True, goal_hidden=True, **given)
        own, other = (mtjax.make(name, task_seed=seed, num_draws=2, **given).vectors() for seed in (3, 4))
        np.testing.assert_array_equal(env.vectors(), np.concatenate([own, other]))
        assert env.counts == {"train": 1, "interpolation": 0, "extrapolation": 1}
        for split, vectors in (("train", own), ("extrapolation", other)):
            tasks = env.tasks(split)
            drawn, first = (x.goal["target"][0, ..., :2] for x in (tasks.draws, tasks))
            np.testing.assert_allclose(drawn, vectors[:, -3:-1], atol=1e-6)
            np.testing.assert_allclose(first, vectors[0, -3:-1], atol=1e-6)
            assert tasks.row.tolist() == [int(split != "train")]
    with pytest.raises(InputError, match="leave out test-goals"):
        mtjax.make("metaworld-push", held_out=True, test_goals=True)


@needs("metaworld")
def test_refused_settings_are_named(monkeypatch):
    with pytest.raises(InputError, match="mjx"):
        mtjax.make("metaworld-reach", engine="mjx")
    with pytest.raises(InputError, match="goals only, not in mass"):
        mtjax.make("metaworld-reach", vary={"mass": "1:2:3"})
    monkeypatch.setattr(sawyer, "choose_engine", lambda *_: "mjx")  # as on a GPU without Warp
    with pytest.raises(InputError, match="mjx"):
        _ = mtjax.make("metaworld-reach").engine_name


def test_the_package_is_asked_for_by_its_command(monkeypatch):
    """Before anything compiles, and for a benchmark too."""
    monkeypatch.setattr(scene.importlib.util, "find_spec", lambda name: None)
    for name in ("metaworld-reach", "mt10"):
        with pytest.raises(InputError, match=r"pip install --no-deps metaworld==3\.1\.1"):
            mtjax.make(name)


def test_benchmarks_have_the_tasks_of_the_original():
    counts = {
        name: (len(own), sum("held_out" in each for each in own.values())) for name, (_, own) in BENCHMARKS.items()
    }
    assert counts == {
        "mt10": (10, 0),
        "mt25": (25, 0),
        "mt50": (50, 0),
        "cw10": (10, 0),
        "ml10": (15, 5),
        "ml45": (50, 5),
    }
    assert all(name.removeprefix("metaworld-") in TASKS for _, own in BENCHMARKS.values() for name in own)
    source = importlib.util.find_spec("metaworld")
    if source is None:
        return
    text = (Path(source.submodule_search_locations[0]) / "env_dict.py").read_text()
    of = lambda part: [word.strip(' ",').removesuffix("-v3") for word in part.splitlines() if "-v3" in word]
    originals = {name: own for name, (_, own) in BENCHMARKS.items() if name != "cw10"}  # which is Continual World's
    for name, own in originals.items():  # in the same order, as one stream draws all goals
        table = "ALL_V3_ENVIRONMENTS" if name == "mt50" else f"{name.upper()}_V3"
        expected = of(text.split(f"\n{table} = ")[1].split("\n)\n")[0])
        assert [family.removeprefix("metaworld-") for family in own] == expected


@pytest.mark.slow
@needs("metaworld")
def test_a_benchmark_is_a_mixture_by_a_name(tmp_path):
    """Its record is read back, its settings are each family's, and flags apply to all."""
    program = run_config.parse(["--env=ml10", "--agent=sac-conditioned", "--env.num-draws=2", "--engine=c"])
    env = program.family
    assert program.env == "ml10" and len(env.families) == 15 and env.train_count == 10
    assert all(family.goal_hidden and family.num_draws == 2 for family in env.families)
    assert [family.held_out for family in env.families] == [False] * 10 + [True] * 5
    assert (env.spec.mixed, mtjax.make("mt10").spec.mixed) == (False, True)  # its test tasks have no units of their own
    (tmp_path / "config.json").write_text(to_json(program, {"command": "x"}))
    assert from_json(tmp_path / "config.json") == program
    assert env.labels("train")[0] == "metaworld-reach" and env.describe(0) == "metaworld-reach"  # draws are no tasks
    assert name_of(mtjax.make("mt10")) == "mt10" and name_of(env).startswith("metaworld-reach+")
    with pytest.raises(InputError, match="did you mean 'mt10'"):
        mtjax.make("mt1O")


@needs("metaworld")
@pytest.mark.nightly
def test_held_out_tasks_are_evaluated_and_an_agent_learns(tmp_path):
    """A few steps of ml10, with success at the end and at any step of each task's episodes."""
    run = mtjax.train(
        mtjax.make("ml10", num_draws=2, engine="c"),
        "sac-conditioned",
        steps=10 * 40,
        num_envs=1,
        chunk_steps=20,
        warmup_steps=5,
        batch_size=4,
        replay_size=50,
        eval_episodes=1,
        hidden=(8,),
        critic_hidden=(8,),
        directory=tmp_path,
    )
    found = run.evaluations
    assert found.returns["train"].shape[2] == 10 and found.returns["extrapolation"].shape[2] == 5
    for split in ("train", "extrapolation"):
        assert np.all(np.isfinite(found.returns[split]))
        assert np.all(found.metrics["success_ever"][split] >= found.metrics["success"][split])
    table = split_table(found._replace(metrics={**found.metrics, "success_ever": {"train": np.ones((1, 1, 10, 1))}}))
    assert "success, at any step" in table and table.splitlines()[1].split()[-1] == "1.00"


@needs("metaworld")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["pick-place", "peg-insert-side"])
@needs("warp")
def test_a_grip_holds_on_warp_as_on_c(name):
    """From recorded states in which the gripper is closed round a thing: the hand rises by ten centimetres."""
    from mtjax.envs.engines.warp import Warp

    env, recorded = made(name)
    task = jax.tree.map(lambda x: x[0], goals(env))
    held = np.flatnonzero((recorded["time"] > 10) & (recorded["action"][:, 3] > 0.5))
    qpos, qvel, mocap = (jnp.float32(recorded[key][held]) for key in ("qpos", "qvel", "mocap"))

    def lifted(engine):
        rest = lambda qpos, qvel, mocap: at_rest(env.models[1], qpos, qvel, None, mocap[None])
        world, step = jax.vmap(rest)(qpos, qvel, mocap), jax.jit(jax.vmap(engine.step, (None, 0, 0)))
        for _ in range(25):
            world = world._replace(mocap=world.mocap.at[:, 0, 2].add(0.004))
            world = step(task, world, jnp.tile(jnp.array([1.0, -1.0]), (len(held), 1)))
        return np.asarray(world.qpos)[:, 9:12]

    exact, found = lifted(env.simulator), lifted(Warp(base_model(env, env.warp_iterations), env.num_substeps))
    assert np.mean(exact[:, 2] - qpos[:, 11] > 0.05) > 0.5
    assert np.mean(np.abs(found - exact).max(axis=1) < 5e-3) > 0.9


@needs("metaworld")
def test_films_show_meshes_and_things_where_the_goal_has_them():
    env, _ = made("drawer-close")
    physics, seen = env.models[2], env.scene_model(2)
    assert seen.nmesh > physics.nmesh + 10 and seen.nmat > 0 and seen.ntex > 1
    names = [[model.body(i).name for i in range(model.nbody)] for model in (physics, seen)]
    assert names[0] == names[1] and np.ptp([model.body("drawer").pos[0] for model in env.models]) > 0
    tasks, start = begin(env)
    visible = jax.vmap(env.visible)(tasks, start.state)
    render._arrange(seen, jax.tree.map(lambda x: x[1], visible))
    np.testing.assert_allclose(seen.body_pos, physics.body_pos, atol=1e-6)
    ((name, mark),) = visible.marks.items()
    np.testing.assert_allclose(mark.position, tasks.goal["target"])
    assert seen.geom(name).group == 0 and name in env.hides


@needs("metaworld")
@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("push", marks=pytest.mark.nightly), "stick-push"])  # which feels forces
@needs("warp")
def test_physics_are_set_on_warp_as_on_c(name):
    found = []
    for engine in ("c", "warp"):
        env = mtjax.make(f"metaworld-{name}", num_draws=1, engine=engine)
        task = jax.tree.map(lambda x: x[0], goals(env))
        state = env.reset(task, jax.random.key(0)).state
        world = set_physics(env, task, state, state.qpos + 0.01, state.qvel)
        found.append((world, jax.jit(env.step)(task, world, jnp.array([0.5, 0.2, -0.3, 0.5]))))
    (exact, after), (world, other) = found
    np.testing.assert_allclose(world.sensors[:21], exact.sensors[:21], atol=1e-5)
    np.testing.assert_allclose(other.obs, after.obs, atol=2e-3)


@needs("metaworld")
@pytest.mark.slow
@pytest.mark.parametrize("speed", [1.0, np.nan])
@needs("warp")
def test_a_step_on_warp_depends_on_the_state_alone(speed):
    """And not on what was simulated in the same place before, or was lost there."""
    env = mtjax.make("metaworld-peg-unplug-side", num_draws=1, engine="warp")
    task, step = jax.tree.map(lambda x: x[0], goals(env)), jax.jit(env.step)
    state, action = env.reset(task, jax.random.key(0)).state, jnp.array([0.5, 0.2, -0.3, 0.5])
    first = step(task, state, action)
    other = step(task, state._replace(qvel=state.qvel + speed), action)
    assert not np.array_equal(other.obs, first.obs)
    np.testing.assert_array_equal(step(task, state, action).obs, first.obs)


@needs("metaworld")
@pytest.mark.slow
@needs("warp")
def test_warp_draws_meshes(monkeypatch):
    """On a CPU, where only tests draw by Warp: the arm is red, and the drawer is where its goal has it."""
    from mtjax.envs import pixels
    from mtjax.envs.painters.warp import WarpPainter

    monkeypatch.setattr(pixels, "choose_painter", lambda *_: WarpPainter)
    env = mtjax.make("metaworld-drawer-close", num_draws=2, engine="c", pixels=64)
    drawn = np.asarray(begin(env)[1].obs["pixels"], int)
    red = drawn[..., 0] > 2 * np.max(drawn[..., 1:], axis=-1)
    assert drawn.shape == (2, 64, 64, 3) and np.all(np.mean(red, axis=(1, 2)) > 0.02)
    assert np.mean(np.any(drawn[0] != drawn[1], axis=-1)) > 0.01
