"""Every MuJoCo domain in every engine: one step from the same states under the same actions.

States are those of random play with MuJoCo C, from the very start of an episode on. Half of the worlds have one model
and half another, so that a step which takes its model from the wrong row is off in every world.
"""

import gc
import importlib.util
import subprocess
import sys
import weakref
from functools import lru_cache, partial
from threading import Thread
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import needs, require
from own_process import environment
from probes import one_in, quick, slow_but

from mtjax import envs
from mtjax.envs.engines import base as physics
from mtjax.envs.engines import c, host, shared
from mtjax.envs.engines.base import World
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.mjx import Mjx
from mtjax.envs.physics import mjx_engine
from mtjax.types import InputError, Task

COUNT = 64  # worlds
AGES = (0, 1, 5, 20, 60, 150)  # control steps before the one that is compared
PLAYED = 60  # the age that is held to the tighter bounds
# Each domain, and what differs between its two tasks. Cartpole and acrobot are integrated by Runge-Kutta.
VARIED = {
    "acrobot-swingup": {"gravity": "8,11"},
    "ball-in-cup-catch": {"mass": "0.8,1.2"},
    "cartpole-swingup": {"pole-length": "0.9,1.2"},
    "cheetah-run": {"torso-length": "0.5,0.6"},
    "dog-walk": {"torso-mass": "0.8,1.2"},
    "finger-spin": {"size": "0.95,1.05"},
    "finger-turn-easy": {"size": "0.95,1.05"},
    "fish-swim": {"fin-size": "0.9,1.1"},
    "hopper-hop": {"foot-length": "0.9,1.1"},
    "humanoid-walk": {"shin-length": "0.28,0.32"},
    "pendulum-swingup": {"length": "0.4,0.6"},
    "point-mass-easy": {"mass": "0.8,1.2"},
    "quadruped-walk": {"foot-length": "0.2,0.3"},
    "reacher-easy": {"mass": "0.8,1.2"},
    "swimmer-swimmer6": {"link-length": "0.09,0.11"},
    "walker-walk": {"foot-length": "0.08,0.12"},
}
DOMAINS, SLOW = list(VARIED), pytest.mark.slow
# MJX takes ten seconds to compile a domain with contact.
QUICK_DOMAINS = ("pendulum-swingup",)
# MJX compiles three of them for long; the fourth is a finger too.
LONG = ("humanoid-walk", "quadruped-walk", "swimmer-swimmer6", "finger-turn-easy")
ALIKE = [name for name in DOMAINS if name != "dog-walk"]  # MJX and Warp step another dog: tests/test_bodies.py
HEAVY = ("dog-walk", "humanoid-walk")  # whose play takes seconds
# Bounds on each world's largest error in velocity, by quantile, relative to the domain's fastest velocity. MJX and Warp
# count in float32, whose relative rounding of 6e-8 ten substeps and the mass matrix's condition amplify up to tenfold;
# in contact the solver stops where float32 sees no more progress, which is a hundred times sooner in elliptic cones.
FREE = {0.5: 1e-6, 1: 1e-5}
TOUCHING = {0.5: 3e-5, 0.9: 3e-4, 1: 1e-2}
# In states of all ages MJX may be off by more than this, relative as above, in such a share of worlds: 0 elsewhere.
OFF = 1e-3
# Limbs that cross, as in 4 of the hopper's 384 states, or that stand on the floor, as in 21 of the humanoid's and in 1
# of the quadruped's: see the domains.
MAY_BE_OFF = {"hopper-hop": 0.013, "humanoid-walk": 0.07, "quadruped-walk": 0.003}
# Factors of these bounds: such limbs, and fifteen substeps of links that weigh 10 g.
ROUGHER = {"humanoid-walk": 3, "swimmer-swimmer6": 3}


class Play(NamedTuple):
    """Worlds that random play has reached, and the step that is compared."""

    tasks: Task
    world: World
    action: np.ndarray  # as controls of the model
    step: object  # C's


def family(name, **settings):
    return envs.make(name, vary=VARIED[name], split="none", **settings)


@lru_cache
def plays(name):
    """Play at each of ``AGES``."""
    env = family(name, engine="c")
    tasks = jax.tree.map(lambda x: x[np.arange(COUNT) % 2], env.tasks())
    world = jax.jit(jax.vmap(env.reset))(tasks, jax.random.split(jax.random.key(0), COUNT)).state
    if name == "ball-in-cup-catch":  # random play catches the ball too rarely: in half of the worlds it begins there
        caught = jnp.arange(COUNT)[:, None] < COUNT // 2
        world = world._replace(qpos=jnp.where(caught, jnp.array([0, 0, 0, 0.335]), world.qpos))
    actions = np.random.RandomState(1).uniform(-1, 1, (max(AGES) // 5 + 1, COUNT, env.spec.action_size))
    step, found = jax.jit(jax.vmap(env.step)), {}
    control = jax.jit(lambda *given: jax.vmap(env.control)(*given)[1])
    for age in range(max(AGES) + 1):
        action = np.float32(actions[age // 5])
        new = step(tasks, world, action)
        if age in AGES:
            found[age] = Play(tasks, world, control(tasks, world, action), new)
        world = new.state
    return found


def played(name):
    return plays(name)[PLAYED]


def alone(engine, task, world, action):
    """One world's step by plain MuJoCo calls: the state that is handed on, and what is sensed in it."""
    model = engine.models[int(task.row)]
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = *world[:3], action
    data.act[:] = [] if world.act is None else world.act
    for _ in range(engine.num_substeps):
        mujoco.mj_step(model, data)
    state = np.float32(np.concatenate([data.qpos, data.qvel, data.qacc_warmstart]))
    data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = np.split(state, (model.nq, model.nq + model.nv))
    mujoco.mj_step1(model, data)
    return state, np.float32(data.sensordata)


@pytest.mark.parametrize("name", slow_but(DOMAINS, *[name for name in DOMAINS if name not in HEAVY][::8], nightly=True))
def test_c_steps_as_plain_mujoco_does(name):
    """Bit for bit in every world, for three steps of which the later ones go on from the batch's own state."""
    tasks, world, action, _ = played(name)
    engine = family(name, engine="c").simulator
    step = jax.jit(jax.vmap(engine.step))
    for _ in range(3):
        new = step(tasks, world, action)
        state = np.concatenate(new[:3], axis=1)
        for i in range(0, COUNT, 3):
            take = lambda tree, i=i: jax.tree.map(lambda x: np.asarray(x)[i], tree)
            expected, sensed = alone(engine, take(tasks), take(world), action[i])
            np.testing.assert_array_equal(state[i], expected)
            np.testing.assert_array_equal([] if new.sensors is None else new.sensors[i], sensed)
        world = new


def errors(play, new):
    """The largest error in velocity of each world (COUNT,), relative to the fastest velocity of all."""
    exact = np.asarray(play.step.state.qvel)
    return np.max(np.abs(exact - new.qvel), axis=1) / np.max(np.abs(exact))


def assert_agreement(name, new):
    """Hold the worlds of an engine to C's; as C with the other task's model would not be."""
    play, engine = played(name), family(name, engine="c").simulator
    touching = [jax.vmap(engine.touching)(play.tasks, world.qpos) for world in (play.world, play.step.state)]
    touching = np.any(touching, axis=0)
    found = errors(play, new)
    for bounds, worlds in ((FREE, ~touching), (TOUCHING, touching)):
        measured = {q: float(np.quantile(found[worlds], q)) for q in bounds if np.any(worlds)}
        rough = ROUGHER.get(name, 1)
        assert all(measured[q] <= rough * bounds[q] for q in measured), (name, measured, int(worlds.sum()))
    if new.sensors is not None:
        sensed = np.max(np.abs(play.step.state.sensors - new.sensors), axis=1)
        assert np.quantile(sensed, 0.5) <= ROUGHER.get(name, 1) * 1e-6 * max(1, np.max(np.abs(new.sensors)))
    other = play.tasks._replace(row=1 - play.tasks.row)
    wrong = jax.vmap(engine.step)(other, play.world, play.action)
    assert np.median(errors(play, wrong)) > 10 * np.median(found)


def compiled_step(name, env, play):
    """Compile a step in little time; that of some takes ten seconds more, and runs in 0.1 s where it took 20."""
    if name not in ("hopper-hop", "humanoid-walk", "quadruped-walk"):
        return quick(jax.vmap(env.simulator.step), *play[:3])
    some = {"xla_backend_optimization_level": 1}
    return jax.jit(jax.vmap(env.simulator.step)).lower(*play[:3]).compile(compiler_options=some)


@pytest.mark.parametrize(
    "name",
    [
        *slow_but([name for name in ALIKE if name not in LONG], *QUICK_DOMAINS, nightly=True),
        *(pytest.param(name, marks=pytest.mark.nightly) for name in LONG),
    ],
)
def test_mjx_steps_as_c_does(name):
    """With solver iterations to spare, in all but a stated share of the states of play; and rewards are those of C."""
    env, play = family(name, engine="mjx", solver_iterations=10), played(name)
    step = compiled_step(name, env, play)
    found = {age: step(*play[:3]) for age, play in plays(name).items()}
    assert_agreement(name, found[PLAYED])
    off = np.array([errors(play, found[age]) > OFF for age, play in plays(name).items()])
    assert np.mean(off) <= MAY_BE_OFF.get(name, 0), (name, off.sum(axis=1))
    rewards = [jax.vmap(env.reward)(play.tasks, found[age], play.action) for age, play in plays(name).items()]
    expected = np.array([play.step.reward for play in plays(name).values()])
    unlike = np.abs(np.array(rewards) - expected) > 1e-3
    assert not np.any(unlike & ~off), (name, unlike.sum(axis=1))
    if name == "ball-in-cup-catch":
        assert np.sum(expected == 1) > COUNT  # states of success


@SLOW
@pytest.mark.parametrize("name", ALIKE)
@needs("warp")
def test_warp_steps_as_c_does(name):
    """Under a map of a map, which picks every world's own model."""
    from mtjax.envs.engines.warp import Warp

    play, mjx = played(name), mjx_engine(family(name, engine="mjx", solver_iterations=50))
    engine = Warp(mjx.base, mjx.num_substeps)
    nested = jax.tree.map(lambda x: jnp.reshape(x, (4, COUNT // 4, *x.shape[1:])), play[:3])
    new = quick(jax.vmap(jax.vmap(engine.step)), *nested)(*nested)
    assert_agreement(name, jax.tree.map(lambda x: np.reshape(x, (COUNT, *x.shape[2:])), new))


def test_every_domain_is_tested():
    """A MuJoCo domain that has a name has a line here."""
    ours = [cls for cls, _ in envs.ENVS.values() if cls.__module__.startswith("mtjax.envs.dm_control.")]
    assert {envs.ENVS[name][0].model_file for name in DOMAINS} >= {cls.model_file for cls in ours}


def test_host_functions_are_called_by_name():
    """With any number of mapped axes, even an empty one. What they raise is raised."""
    doubled = lambda given, result: np.copyto(result, 2 * given[..., :2])
    host.register("doubled", doubled)
    call = partial(host.call, "doubled", 2)
    for function, shape in ((call, (3,)), (jax.vmap(jax.vmap(call)), (4, 5, 3)), (jax.vmap(call), (0, 3))):
        x = np.random.RandomState(0).normal(size=shape).astype(np.float32)
        np.testing.assert_array_equal(jax.jit(function)(x), 2 * x[..., :2])

    def refuse(given, result):
        raise ValueError("no such world")

    host.register("refuse", refuse)
    with pytest.raises(jax.errors.JaxRuntimeError, match="ValueError: no such world"):
        jax.block_until_ready(jax.jit(partial(host.call, "refuse", 2))(np.zeros(3, np.float32)))


ENDS_EARLY = """
import jax
import jax.numpy as jnp
import mtjax

env = mtjax.make("finger-spin", engine="c")
tasks = jax.tree.map(lambda x: jnp.broadcast_to(x, (1, *x.shape[:1], 256, *x.shape[1:])), env.tasks())
step = jax.jit(env.step_worlds)
state = jax.jit(env.reset_worlds)(tasks, jax.random.split(jax.random.key(0), (1, 1, 256))).state
for _ in range(200):
    state = step(tasks, state, jnp.zeros((1, 1, 256, 2))).state
"""


@pytest.mark.slow
def test_a_process_may_end_while_its_worlds_still_step():
    """They are waited for: below a process that ends, a call would crash it."""
    subprocess.run([sys.executable, "-c", ENDS_EARLY], env=environment(), check=True, timeout=120)


@pytest.mark.parametrize(("name", "sensors"), one_in(2, [("finger-spin", True), ("walker-walk", False)]))
def test_c_results_do_not_depend_on_what_the_batch_did_before(name, sensors):
    """After a start, a question of contact, other worlds or other tasks, a step is that of a fresh engine.

    Worlds keep their own data where these serve sensors. Else all share a thread's, which fit into a cache.
    """
    play, env = played(name), family(name, engine="c")
    tasks, world, action, _ = play
    used, mapped = MujocoC(env.models, env.num_substeps), jax.vmap
    turned = jax.tree.map(lambda x: x[::-1], (tasks, world, action))
    half = world._replace(qpos=jnp.where(np.arange(COUNT)[:, None] % 2, world.qpos, world.qpos[::-1]))
    other = tasks._replace(row=1 - tasks.row)
    calls = [
        lambda e: mapped(e.step)(tasks, world, action),
        lambda e: mapped(e.step)(tasks, mapped(e.step)(tasks, world, action), -action),
        lambda e: mapped(e.step)(other, mapped(e.step)(tasks, world, action), action),
        lambda e: mapped(e.forward)(tasks, world.qpos, world.qvel),
        lambda e: mapped(e.step)(tasks, mapped(e.forward)(tasks, world.qpos, world.qvel), action),
        lambda e: mapped(e.step)(tasks, half, action),
        lambda e: mapped(e.touching)(tasks, world.qpos),
        lambda e: mapped(e.step)(tasks, world._replace(warmstart=0 * world.warmstart), action),
        lambda e: mapped(e.step)(*turned),
    ]
    for i in np.random.RandomState(0).randint(len(calls), size=30):
        fresh = MujocoC(env.models, env.num_substeps)
        jax.tree.map(np.testing.assert_array_equal, calls[i](used), calls[i](fresh))
    held = [worlds for (of, _), (worlds, _) in c._batches.items() if of is c._known[used._digest]]
    assert held and all(worlds.persistent == sensors for worlds in held)


@pytest.mark.slow
def test_extra_is_carried_along():
    """What a domain remembers passes through every method of an engine untouched, or is None."""
    env, mjx = family("finger-spin", engine="c"), mjx_engine(family("finger-spin", engine="mjx"))
    task = jax.tree.map(lambda x: x[0], env.tasks())
    qpos, qvel, extra = jnp.zeros(3), jnp.zeros(3), {"goal": jnp.arange(2.0), "key": jax.random.key(0)}
    for engine in (env.simulator, mjx):
        run = lambda extra, engine=engine: engine.step(task, engine.place(task, qpos, qvel, extra), jnp.zeros(2))
        assert jax.tree.structure(jax.eval_shape(run, extra).extra) == jax.tree.structure(extra)
    world = env.simulator.forward(task, qpos, qvel, extra)
    assert env.simulator.step(task, world, jnp.zeros(2)).extra == extra
    assert env.simulator.forward(task, qpos, qvel).extra is None


ROD = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping="0.1"/><site name="s" pos="1 0 0"/>
<geom type="capsule" fromto="0 0 0 1 0 0" size="0.05"/></body></worldbody>
<tendon><fixed name="t"><joint joint="j" coef="2"/></fixed></tendon>
<actuator><motor name="m" joint="j" gear="3"/></actuator><sensor>%s</sensor></mujoco>"""
INVOLVED = """<tendonpos tendon="t"/><tendonvel tendon="t"/><actuatorpos actuator="m"/><actuatorvel actuator="m"/>
<accelerometer site="s"/>"""


@pytest.mark.slow
def test_rare_sensors_read_as_in_c():
    """Those of motors and tendons after the step, and those of forces, before which MJX stops without constraints."""
    base = mujoco.MjModel.from_xml_string(ROD % INVOLVED)
    zero = np.int32(0)
    task = Task(zero, zero, np.zeros(1, np.float32), {}, {}, {}, horizon=zero)

    def run(engine):
        world = engine.forward(task, jnp.ones(1), jnp.ones(1))
        return world, engine.step(task, world, jnp.ones(1))

    exact, found = (jax.jit(lambda engine=engine: run(engine))() for engine in (MujocoC([base], 2), Mjx(base, 2)))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5), exact, found)
    new = found[1]
    np.testing.assert_allclose(new.sensors[:2], [2 * new.qpos[0], 2 * new.qvel[0]], rtol=1e-6)
    assert np.linalg.norm(new.sensors[4:]) > 1


def test_a_model_with_a_state_of_its_own_is_refused():
    """A clock would read differently in the same state."""
    base = mujoco.MjModel.from_xml_string(ROD % "<clock/>")
    for engine in (Mjx, lambda base, count: MujocoC([base], count)):
        with pytest.raises(InputError, match="remember nothing but positions, velocities and activations"):
            engine(base, 1)


def test_warp_is_refused_where_it_cannot_run(monkeypatch):
    """It says what to install, or which engine to take instead."""
    installed = lambda yes: monkeypatch.setattr(importlib.util, "find_spec", lambda name: yes or None)
    installed(False)
    with pytest.raises(InputError, match=r"pip install 'mtjax\[warp\]'"):
        physics.choose_engine("warp")
    installed(True)
    assert physics.choose_engine("warp") == "warp" and physics.choose_engine("auto", preferred="warp") == "c"
    for platform, engine in (("PJRT C API rocm 6", "mjx"), ("PJRT C API cuda 13", "warp")):
        client = type("Client", (), {"platform_version": platform})
        monkeypatch.setattr(jax, "devices", lambda client=client: [type("Device", (), {"client": client})])
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        assert physics.choose_engine("auto", preferred="warp") == engine
        assert physics.choose_engine("auto") == "mjx"
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    with pytest.raises(InputError, match="needs an NVIDIA GPU"):
        physics.choose_engine("warp")


@pytest.mark.slow
@needs("warp")
def test_warp_compiles_all_kernels_of_a_step_before_it(monkeypatch, tmp_path):
    """With contacts, a loop over solver iterations, and launches of another thread meanwhile."""
    import warp
    from mujoco.mjx.third_party import mujoco_warp

    from mtjax.envs.engines.kernels import compile_kernels, note_kernels
    from mtjax.envs.engines.warp import Warp

    engine = Warp(mjx_engine(envs.make("hopper-stand", engine="mjx")).base, 1)
    engine.provide(3, ())
    monkeypatch.setattr(warp.config, "kernel_cache_dir", str(tmp_path))
    before, loaded, load = (warp.Module.load, warp.capture_while), [], warp.Module.load
    elsewhere = warp.zeros(3, dtype=float)
    other = Thread(target=lambda: warp.map(lambda x: x + 1.0, elsewhere, out=elsewhere))
    place = engine._places["cpu", 3]

    def launch():
        other.start()
        other.join()
        mujoco_warp.step(place.model, place.data)

    qpos = place.data.qpos.numpy()
    compile_kernels("cpu", note_kernels("cpu", launch))
    assert (warp.Module.load, warp.capture_while) == before
    np.testing.assert_array_equal(elsewhere.numpy(), 1)
    np.testing.assert_array_equal(place.data.qpos.numpy(), qpos)
    monkeypatch.setattr(warp.Module, "load", lambda *given: (loaded.append(not given[0].execs), load(*given))[1])
    mujoco_warp.step(place.model, place.data)
    assert len(loaded) > 20 and not any(loaded)
    assert np.all(place.data.time.numpy() > 0)


@needs("warp")
def test_warp_compiles_kernels_while_programs_are_traced(monkeypatch):
    """To note which kernels there are keeps others from making a place, but not from using one."""
    from mtjax.envs.engines import warp as engines

    engine, compiled = engines.Warp(mjx_engine(envs.make("hopper-stand", engine="mjx")).base, 1), []
    engine.provide(3, ())

    def can_provide(count):
        other = Thread(target=engine.provide, args=(count, ()), daemon=True)
        other.start()
        other.join(60)
        return not other.is_alive()

    monkeypatch.setattr(engines, "compile_kernels", lambda _, kernels: compiled.append((kernels, can_provide(4))))
    engine.load_kernels()
    assert compiled[0][1] and len(compiled[0][0]) > 20
    with engines.ALONE:
        assert can_provide(3)


@needs("warp")
def test_warp_refuses_tasks_that_differ_in_the_size_of_sites():
    """Warp holds one value of it for all worlds."""
    from mtjax.envs.engines.warp import Warp

    env = envs.make("finger-spin-vary-touch-size", engine="mjx")
    engine = Warp(mjx_engine(env).base, env.num_substeps)
    task = jax.tree.map(lambda x: x[0], env.tasks())
    world = World(*(jnp.zeros(3),) * 3, jnp.zeros(13))
    with pytest.raises(InputError, match="cannot vary site_size between tasks; use --engine=mjx"):
        jax.eval_shape(engine.step, task, world, jnp.zeros(2))


def test_a_program_runs_after_its_environment_is_gone():
    """Programs call MuJoCo by name, and outlive the objects of Python that made them."""

    def swing(env, torque):
        task = jax.tree.map(lambda x: x[0], env.tasks())
        return env.step(task, env.reset(task, jax.random.key(0)).state, torque).obs

    env = envs.make("pendulum-swingup", engine="c")
    program = jax.jit(partial(swing, env)).lower(jnp.ones(1)).compile()
    before = np.asarray(program(jnp.ones(1)))
    del env
    jax.clear_caches()
    gc.collect()
    np.testing.assert_array_equal(program(jnp.ones(1)), before)


class Owner:
    """What a program calls."""


def kept_program(owner):
    """Compile a program that keeps an object, under maps and in a jitted function."""
    inner = jax.jit(jax.vmap(lambda x: shared.keep(owner, {"x": 2 * x})["x"]))
    return jax.jit(lambda x: jax.vmap(inner)(x)).lower(jnp.ones((2, 3))).compile()


def test_a_program_keeps_what_it_calls_and_frees_it_at_its_own_end():
    """Even if JAX forgets how it was traced."""
    owner = Owner()
    program, gone = kept_program(owner), weakref.ref(owner)
    del owner
    jax.clear_caches()
    gc.collect()
    assert gone() is not None
    np.testing.assert_array_equal(program(jnp.ones((2, 3))), 2)
    del program
    gc.collect()
    assert gone() is None


def test_a_program_that_keeps_something_can_be_exported():
    """A file holds nothing of this process; what a process runs from it is kept by whoever reads it."""
    exported = jax.export.export(jax.jit(lambda x: shared.keep(Owner(), x)))(jnp.ones(3))
    again = jax.export.deserialize(exported.serialize())
    np.testing.assert_array_equal(again.call(jnp.ones(3)), 1)


def test_equal_engines_are_one_until_the_last_is_gone():
    """The calls of a name are made once, and then drop what they held of the engine."""
    forgotten, one, other = [], Owner(), Owner()
    assert shared.first_of("name", one, forgotten.append) is shared.first_of("name", other) is one
    calls = [shared.call_of("name", about, object) for about in (1, 2, 1)]
    assert calls[0] is calls[2] is not calls[1] and not forgotten
    assert shared.living("name") is one
    del one
    gc.collect()
    assert forgotten == calls[:2] and shared.first_of("name", other) is other
    del shared._calls["name"]


@pytest.mark.slow
def test_programs_of_warp_run_after_their_families_are_gone():
    """Ten families, each in two copies that are one engine; and nothing is left after the programs."""
    require("warp")

    def swing(env, torque):
        task = jax.tree.map(lambda x: x[0], env.tasks())
        return env.step(task, env.reset(task, jax.random.key(0)).state, torque).obs

    programs, engines = [], []
    for mass in np.repeat(np.linspace(0.5, 1.5, 10), 2):
        env = envs.make("pendulum-swingup", engine="warp", vary={"mass": mass})
        programs.append(jax.jit(partial(swing, env)).lower(jnp.ones(1)).compile())
        engines.append(weakref.ref(env.simulator))
    del env
    jax.clear_caches()
    gc.collect()
    assert [engine() is None for engine in engines] == [False, True] * 10
    found = np.array([program(jnp.ones(1)) for program in programs])
    np.testing.assert_array_equal(found[::2], found[1::2])
    assert len(np.unique(found[::2, 2])) == 10
    del programs
    jax.clear_caches()
    gc.collect()
    assert all(engine() is None for engine in engines)
