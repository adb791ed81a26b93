"""Brax's environments as families: the same trajectories, parameters that act, rewards of goals, clear refusals."""

import subprocess
import sys
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import require
from probes import slow_but

import mtjax.envs.brax as adapter
from mtjax.envs.brax import BACKENDS, NAMES, Brax, BraxAntDirection, BraxHalfcheetahSpeed
from mtjax.envs.parameters import FRICTION, GRAVITY, MASS
from mtjax.gym import FamilyEnv
from mtjax.report import films, render
from mtjax.types import InputError

require("brax")

STEPS = 20
slow = pytest.mark.slow  # an ant or a half-cheetah takes a minute to compile; pendulums stand for them by default
# Four tasks: Brax's own numbers, then a heavier, a lighter-falling and a more slippery world.
FOUR = {"mass": "1,3,1,1", "gravity": "9.81,9.81,3,9.81", "friction": "1,1,1,0.1"}
CONTROL_STEP = 0.05  # [s] of ant and half-cheetah


@lru_cache
def programs(env):
    """Reset, placement and step of an environment, mapped over a flat batch."""
    place = lambda task, qpos, qvel: env.set_physics(task, None, qpos, qvel)
    functions = {"reset": env.reset, "place": place, "step": env.step}
    return SimpleNamespace(**{name: jax.jit(jax.vmap(function)) for name, function in functions.items()})


def actions(size):
    return np.random.default_rng(0).uniform(-1, 1, (STEPS, size)).astype(np.float32)


def repeat(x, count):
    return jnp.broadcast_to(x, (count, *x.shape))


def first(tree):
    return jax.tree.map(lambda x: x[0], tree)


@lru_cache
def rollout(env):
    """Steps of every task of an environment from the key 7, under the same actions: leaves (H + 1, T, ...)."""
    tasks = env.tasks()
    count = len(tasks.id)
    steps = [programs(env).reset(tasks, repeat(jax.random.key(7), count))]
    for action in actions(env.action_size):
        steps.append(programs(env).step(tasks, steps[-1].state, repeat(action, count)))
    return jax.tree.map(lambda *x: np.stack(x), *[step._replace(state=None) for step in steps])


class Trajectory(NamedTuple):
    """What Brax alone says of twenty steps, leaves (H + 1, ...)."""

    obs: np.ndarray
    reward: np.ndarray
    done: np.ndarray
    metrics: dict[str, np.ndarray]
    position: np.ndarray  # (H + 1, links, 3)


@lru_cache
def brax_rollout(name, backend, count):
    """The same by Brax alone, in a batch as large: rounding depends on its size, and contacts amplify it."""
    with adapter._without_remarks():
        theirs = adapter.brax_module().envs.get_environment(name, backend=backend)
    step = jax.jit(jax.vmap(theirs.step))
    states = [jax.jit(jax.vmap(theirs.reset))(repeat(jax.random.key(7), count))]
    for action in actions(theirs.action_size):
        states.append(step(states[-1], repeat(action, count)))
    kept = [first((s.obs, s.reward, s.done, s.metrics, s.pipeline_state.x.pos)) for s in states]
    return Trajectory(*jax.tree.map(lambda *x: np.stack(x), *kept))


ANT = Brax(vary=FOUR, combine="paired", split="none")
CHEETAH = Brax(environment="halfcheetah")
PENDULUM = Brax(environment="inverted_pendulum", vary={"gravity": "2:20:3"})
PENDULUM_MJX = Brax(environment="inverted_pendulum", backend="mjx")


@pytest.mark.parametrize(
    "env",
    [
        pytest.param(ANT, id="ant", marks=pytest.mark.nightly),
        pytest.param(CHEETAH, id="halfcheetah", marks=pytest.mark.nightly),
        pytest.param(PENDULUM_MJX, id="inverted_pendulum-mjx", marks=slow),
    ],
)
def test_nominal_parameters_give_the_trajectory_of_brax(env):
    """The same key and actions: observation, reward and termination of twenty steps."""
    ours = rollout(env)
    theirs = brax_rollout(env.environment, env.backend, ours.obs.shape[1])
    assert ours.obs.shape[-1] == env.spec.obs_size
    for i, (mine, other) in enumerate(zip(ours.obs[:, 0], theirs.obs, strict=True)):
        np.testing.assert_allclose(mine, other, rtol=1e-5, atol=1e-5, err_msg=f"step {i}")
    np.testing.assert_allclose(ours.reward[:, 0], theirs.reward, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(ours.terminated[:, 0], theirs.done > 0)
    assert ours.reward.dtype == np.float32 and ours.terminated.dtype == bool


@slow
def test_a_fall_terminates():
    """Random pushes topple the pendulum within twenty steps, and not at the first."""
    terminated = rollout(PENDULUM_MJX).terminated[:, 0]
    assert terminated[-1] and not terminated[1]


@slow
def test_every_parameter_acts():
    """Mass, gravity and friction each change the ant's motion from the same start; mass and friction not its start."""
    obs = rollout(ANT).obs
    np.testing.assert_array_equal(obs[0], np.broadcast_to(obs[0, 0], obs[0].shape))
    for task in (1, 2, 3):
        assert np.abs(obs[-1, task] - obs[-1, 0]).max() > 0.01
    assert np.all(np.isfinite(obs))


@slow
def test_a_falling_ant_obeys_its_gravity():
    """High above the floor, at rest: velocity -g t whatever the mass, and Euler's height of semi-implicit steps."""
    tasks, count, steps, substep = ANT.tasks(), 4, 4, 0.01
    qpos = np.array([0, 0, 50, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1], np.float32)
    state = programs(ANT).place(tasks, repeat(qpos, count), jnp.zeros((count, 14)))
    for _ in range(steps):
        step = programs(ANT).step(tasks, state, jnp.zeros((count, 8)))
        state = step.state
    gravity, substeps = np.asarray(tasks.params["gravity"]), 5 * steps
    np.testing.assert_allclose(state.qd[:, 2], -gravity * substeps * substep, rtol=1e-3)
    fallen = gravity * substep**2 * substeps * (substeps + 1) / 2
    np.testing.assert_allclose(50 - state.q[:, 2], fallen, rtol=1e-3)
    assert np.all(step.terminated)  # as the ant must keep its torso between 0.2 and 1 m


@slow
def test_an_edited_system_is_what_brax_loads_from_an_edited_model():
    """Every leaf: what MuJoCo derives from masses (constraint weights) included."""
    from brax.io import mjcf
    from etils import epath

    values = {"mass": 1.7, "gravity": 3.0, "friction": 0.5}
    env = Brax(vary=values)
    xml = mjcf.fuse_bodies((epath.resource_path("brax") / "envs/assets/ant.xml").read_text())
    spec = mujoco.MjSpec.from_string(xml)
    for parameter, value in ((MASS, 1.7), (GRAVITY, 3.0), (FRICTION, 0.5)):
        assert parameter.edit is not None
        parameter.edit(spec, value)
    with adapter._without_remarks():
        expected = mjcf.load_model(spec.compile())
    found = env._edited(first(env.tasks())).sys
    names = lambda system: {jax.tree_util.keystr(path): x for path, x in jax.tree_util.tree_leaves_with_path(system)}
    assert names(found).keys() == names(expected).keys()
    for name, leaf in names(expected).items():
        if not any(word in name for word in ("dof_M0", "acc0", "stat", "cam", "light")):  # read by no backend
            np.testing.assert_allclose(names(found)[name], leaf, rtol=2e-5, atol=1e-6, err_msg=name)
    assert not np.allclose(env.original.sys.dof.invweight, expected.dof.invweight, rtol=0.1)


@slow
@pytest.mark.parametrize("direction", [0.0, np.pi / 2, -2.0])
def test_reward_of_a_direction(direction):
    """By hand, from how far the torso came: velocity along the direction, 1 for survival, half the motors' squares."""
    env, theirs, commands = (
        BraxAntDirection(vary={"direction": direction}),
        brax_rollout("ant", "generalized", 4),
        actions(8),
    )
    for i in (0, 5, STEPS - 1):
        travelled = theirs.position[i + 1, 0] - theirs.position[i, 0]
        along = (np.cos(direction) * travelled[0] + np.sin(direction) * travelled[1]) / CONTROL_STEP
        metrics = {name: jnp.float32(x[i + 1]) for name, x in theirs.metrics.items()}
        reward = env.reward(first(env.tasks()), metrics, jnp.float32(0), commands[i])
        assert float(reward) == pytest.approx(along + 1 - 0.5 * np.sum(commands[i] ** 2), abs=1e-4)
        if direction == 0:
            assert float(reward) == pytest.approx(theirs.reward[i + 1], abs=1e-5)


@pytest.mark.parametrize(("speed", "velocity"), [(0.5, 1.25), (2.0, 1.25), (1.0, -3.0)])
def test_reward_of_a_speed(speed, velocity):
    """By hand: minus the miss in speed, minus a twentieth of the motors' squares."""
    env, action = BraxHalfcheetahSpeed(vary={"speed": speed}), np.array([1, -1, 0.5, 0, 0, 0.25])
    reward = env.reward(first(env.tasks()), {"x_velocity": jnp.float32(velocity)}, jnp.float32(0), action)
    assert float(reward) == pytest.approx(-abs(velocity - speed) - 0.05 * 2.3125, abs=1e-6)


@slow
def test_velocity_of_the_half_cheetah_is_that_of_its_torso():
    """Which the reward of a speed is made of, in metres a second."""
    theirs = brax_rollout("halfcheetah", "generalized", 1)
    velocity = np.diff(theirs.position[:, 0, 0]) / CONTROL_STEP
    np.testing.assert_allclose(theirs.metrics["x_velocity"][1:], velocity, atol=1e-4)


def test_goals_are_parameters_of_their_families():
    """Held-out directions stay on the circle, and the context holds a direction as a point there."""
    whole = BraxAntDirection(vary={"direction": f"{-0.75 * np.pi}:{np.pi}:8"})
    assert len(whole.tasks("extrapolation").id) == 0 and len(whole.tasks("interpolation").id) == 7
    arc = BraxAntDirection(vary={"direction": "-1.5:1.5:7"})
    np.testing.assert_allclose(arc.tasks("extrapolation").goal["direction"], [-2.5, -2.0, 2.0, 2.5])
    angles = np.linspace(-1.5, 1.5, 7)
    np.testing.assert_allclose(arc.tasks().context, np.stack([np.sin(angles), np.cos(angles)], axis=1), atol=1e-6)
    assert first(BraxHalfcheetahSpeed().tasks()).goal["speed"] == 1
    with pytest.raises(InputError, match="greater than"):
        BraxAntDirection(vary={"direction": "4"})


@slow
def test_tasks_and_worlds_step_in_one_scan():
    """Three gravities, five worlds, sixty steps with fresh starts after falls: a heavier pole falls sooner."""
    tasks = PENDULUM.tasks()

    def over(function):
        return jax.vmap(jax.vmap(function, (None, 0, 0)), (0, 0, 0))

    def advance(carry, key):
        state, falls = carry
        step = over(PENDULUM.step)(tasks, state, jnp.zeros((3, 5, 1)))
        keys = jax.random.split(key, (3, 5))
        fresh = over(lambda task, key, _: PENDULUM.reset(task, key))(tasks, keys, keys)
        choose = lambda new, old: jnp.where(step.terminated.reshape(3, 5, *[1] * (new.ndim - 2)), new, old)
        return (jax.tree.map(choose, fresh.state, step.state), falls + step.terminated), (step.obs, step.reward)

    @jax.jit
    def play(key):
        keys = jax.random.split(key, (3, 5))
        start = over(lambda task, key, _: PENDULUM.reset(task, key))(tasks, keys, keys).state
        return jax.lax.scan(advance, (start, jnp.zeros((3, 5), jnp.int32)), jax.random.split(key, 60))

    (_, falls), (obs, reward) = play(jax.random.key(0))
    assert obs.shape == (60, 3, 5, 4) and reward.shape == (60, 3, 5)
    assert np.all(np.isfinite(obs)) and len(np.unique(obs[-1, 0], axis=0)) == 5
    assert np.all(np.diff(np.sum(falls, axis=1)) > 0)


SMALL = ("fast", "inverted_pendulum")


@pytest.mark.parametrize("name", slow_but(NAMES, *SMALL, nightly=True))
def test_every_environment_traces(name):
    """Reset and step trace on this JAX, and a state keeps its shapes and dtypes."""
    env = Brax(environment=name)
    task = first(env.tasks())
    start = jax.eval_shape(env.reset, task, jax.random.key(0))
    step = jax.eval_shape(env.step, task, start.state, jnp.zeros(env.spec.action_size))
    same = jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype), start, step)
    assert all(jax.tree.leaves(same)) and not any(x.weak_type for x in jax.tree.leaves((start, step)))
    assert env.episode_length == 1000


# Of the environments, and of the backends of one; fast has nothing to see.
SEEN = [("inverted_pendulum", backend) for backend in BACKENDS]
SEEN += [(name, "generalized") for name in NAMES if name not in ("fast", "inverted_pendulum")]
_QUICK = ("inverted_pendulum", "generalized")


@pytest.mark.parametrize("name, backend", slow_but(SEEN, _QUICK, nightly=True))
def test_a_film_shows_bodies_where_brax_has_its_links(name, backend):
    """MuJoCo puts them there, given the joints that are shown."""
    env = Brax(environment=name, backend=backend)
    assert env.films and env.seconds_per_step == pytest.approx(env.original.dt)
    task, data = first(env.tasks()), mujoco.MjData(env.scene_model(0))
    joints = data.qpos + np.random.default_rng(0).uniform(-0.1, 0.1, len(data.qpos))
    mujoco.mj_normalizeQuat(data.model, joints)
    state = jax.jit(env.set_physics)(task, None, joints, np.zeros(data.model.nv))
    data.qpos[:] = env.visible(task, state).joints
    mujoco.mj_kinematics(data.model, data)
    links = state["x"].pos if backend == "mjx" else state.x.pos
    np.testing.assert_allclose(data.xpos[1:], links, atol=1e-5)


def test_what_has_nothing_to_see_is_not_filmed():
    """Neither by mtjax nor by Gymnasium."""
    with pytest.raises(InputError, match="can be filmed"):
        films.require(Brax(environment="fast"))
    modes = [FamilyEnv(env).metadata["render_modes"] for env in (PENDULUM, Brax(environment="fast"))]
    assert modes == [["rgb_array"], []]


@slow
def test_a_film_of_a_world_without_a_camera_shows_all_of_it():
    """Or says what to install."""
    tasks = PENDULUM.tasks()
    place = lambda angle: PENDULUM.set_physics(first(tasks), None, jnp.array([0.0, angle]), jnp.zeros(2))
    states = jax.tree.map(lambda *x: jnp.stack(x), *map(place, (0.0, 0.5)))
    try:
        frames = render.film(PENDULUM, 0, states, 64, 48)
    except InputError as error:
        assert "apt install" in str(error)
        return
    assert frames.shape == (2, 48, 64, 3) and np.std(frames[0]) > 5 and np.any(frames[0] != frames[1])


def test_a_family_first_used_in_a_trace_keeps_no_tracers():
    """Brax loads inside the trace, and edits its system there."""
    env = Brax(environment="inverted_pendulum", vary={"gravity": "3,4"})
    jax.eval_shape(jax.vmap(env.reset), env.tasks(), jax.random.split(jax.random.key(0)))
    assert not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(env.original.sys))
    assert env.original.sys.gravity[2] == pytest.approx(-9.81)


def test_loading_says_nothing(tmp_path, monkeypatch, capfd):
    """Neither Brax's own warning nor MuJoCo's about half-cheetah's model, which would also write a file."""
    monkeypatch.chdir(tmp_path)
    assert Brax(environment="halfcheetah").action_size == 6
    assert not list(tmp_path.iterdir()) and "".join(capfd.readouterr()) == ""


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"environment": "halfcheeta"}, "did you mean 'halfcheetah'"),
        ({"environment": "swimmer"}, "swimmer does not run here"),
        ({"backend": "mujoco"}, "choose from: generalized, positional, spring, mjx"),
        ({"backend": "spring", "vary": {"mass": "1,2"}}, "use generalized or mjx"),
        ({"environment": "fast", "vary": {"gravity": "1,2"}}, "has no physics"),
        ({"vary": {"direction": "1,2"}}, "unknown parameter 'direction'"),
    ],
)
def test_refusals(settings, message):
    with pytest.raises(InputError, match=message):
        Brax(**settings)


def test_goals_belong_to_one_environment():
    for family, name in ((BraxAntDirection, "humanoid"), (BraxHalfcheetahSpeed, "ant")):
        with pytest.raises(InputError, match="unknown Brax environment"):
            family(environment=name)


def test_brax_is_imported_only_when_it_is_used():
    """And where it is missing, one line says what to do."""
    code = "import sys, mtjax, mtjax.envs.brax; assert not any(m.split('.')[0] == 'brax' for m in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adapter, "find_spec", lambda name: None)
        with pytest.raises(InputError, match=r"^Brax is not installed; pip install brax$"):
            Brax()


def test_backends_are_those_of_brax():
    """Every backend loads, and one pendulum starts alike in all of them."""
    obs = [
        np.asarray(env.reset(first(env.tasks()), jax.random.key(3)).obs)
        for env in (Brax(environment="fast", backend=backend) for backend in BACKENDS)
    ]
    assert all(np.array_equal(obs[0], other) for other in obs)
