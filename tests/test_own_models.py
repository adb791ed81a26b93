"""Models of a user's own: what actions reach, what engines refuse, and where files are looked for."""

import dataclasses
import importlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mtjax
import mtjax.train
from mtjax import envs
from mtjax.agents.combinations import require_sight
from mtjax.envs import Domain, Parameter
from mtjax.envs.corridors.maze import CorridorMaze
from mtjax.types import InputError


@pytest.fixture
def forget():
    """Forget what a test registers."""
    before = set(envs.ENVS)
    yield
    for name in set(envs.ENVS) - before:
        del envs.ENVS[name]


class Plain(Domain):
    """A family that observes positions and is rewarded for nothing."""

    parameters = {}  # noqa: RUF012
    num_substeps, episode_steps, default_iterations = 5, 100, 4

    def start(self, task, key):
        return jnp.asarray(self.models[0].qpos0, jnp.float32), jnp.zeros(self.models[0].nv)

    def observe(self, task, world):
        return world.qpos

    def reward(self, task, world, action):
        return jnp.float32(0)


def own(model, engine="c", vary=(), **words):
    """Return a family of one's own from an MJCF."""
    cls = dataclasses.dataclass(frozen=True)(type("Own", (Plain,), {"model_file": model, **words}))
    return cls(engine=engine, vary=vary)  # type: ignore


def first_task(env):
    return jax.tree.map(lambda x: x[0], env.tasks())


def play(env, action, steps):
    """Return the last observation (O,) after so many steps of one action."""
    task = first_task(env)
    step = jax.jit(env.step)
    state = env.reset(task, jax.random.key(0)).state
    for _ in range(steps):
        state = step(task, state, jnp.asarray(action, jnp.float32)).state
    return np.asarray(env.observe(task, state))


SERVO = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" axis="0 1 0" damping="2"/>
<geom size="0.1" pos="0.2 0 0" mass="1"/></body></worldbody><actuator>%s</actuator></mujoco>"""
SPREAD = [  # actuators, and the angles to which -1, 0 and 1 turn the joint
    ('<position joint="j" kp="20" ctrlrange="-3 3"/>', [-3, 0, 3]),
    ('<position joint="j" kp="20" ctrlrange="0.5 1.5"/>', [0.5, 1, 1.5]),
    (  # as a gripper's: 0 to 255 for 0 to 2 rad
        '<general joint="j" ctrlrange="0 255" gainprm="0.15686" biastype="affine" biasprm="0 -20 0"/>',
        [0, 1, 2],
    ),
    ('<position joint="j" kp="20"/>', [-1, 0, 1]),
    ('<position joint="j" kp="20" ctrllimited="false" ctrlrange="-3 3"/>', [-1, 0, 1]),
]


@pytest.mark.parametrize("actuator, angles", SPREAD, ids=range(len(SPREAD)))
def test_actions_span_the_range_of_a_servo(actuator, angles):
    """Where it has a range; else an action is the control."""
    env = own(SERVO % actuator)
    found = [play(env, [action], steps=200)[0] for action in (-1, 0, 1)]
    np.testing.assert_allclose(found, angles, atol=2e-3)


def set_range(spec, value):
    """Set how far a servo turns."""
    spec.actuators[0].ctrlrange = [-value, value]


def test_actions_span_the_range_of_every_task():
    """If a parameter changes it."""
    env = own(
        SERVO % SPREAD[0][0], vary={"range": "1,2"}, parameters={"range": Parameter("rad", 3.0, set_range, minimum=0.0)}
    )
    tasks, action = env.tasks(), jnp.ones(1)
    controls = jax.vmap(lambda task: env.control(task, env.reset(task, jax.random.key(0)).state, action)[1])(tasks)
    np.testing.assert_array_equal(controls, [[1], [2]])


FALL = """<mujoco><option %s/><worldbody>%s<body name="b" pos="0 0 1"><freejoint name="f"/>
<geom name="g" type="box" size="0.1 0.2 0.05" mass="1" %s/></body>
<body name="c" pos="3 0 0"><joint name="j" %s/><geom size="0.1" mass="1"/><site name="s" size="0.1"/></body></worldbody>
<tendon><fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>
<actuator>%s</actuator>%s</mujoco>"""
MOTOR = '<motor joint="j" ctrlrange="-1 1"/>'


def falling(option="", world="", geom="", joint="", actuator=MOTOR, rest=""):
    return FALL % (option, world, geom, joint, actuator, rest)


MJX_REFUSES = [
    (falling('density="1000"', geom='fluidshape="ellipsoid"'), "fluid forces on ellipsoids"),
    (falling(joint='stiffness="1 2 3"'), "nonlinear stiffness of joints"),
    (falling(joint='damping="1 2 3"'), "nonlinear damping"),
    (falling(actuator='<position joint="j" damping="2"/>'), "damping or armature of actuators"),
    (falling(actuator='<general joint="j" dyntype="filter" dynprm="0.1" actearly="true"/>'), "actearly"),
    (falling('actuatorgroupdisable="1"', actuator='<motor joint="j" group="1"/>'), "a disabled group"),
    (falling('noslip_iterations="3"'), "noslip_iterations"),
    (falling('integrator="discrete"'), "the discrete integrator"),
    (falling(rest='<option><flag sleep="enable"/></option>'), "sleeping bodies"),
    (falling(world='<geom type="cylinder" size="1 0.1"/>'), r"collisions not implemented"),
    (falling('integrator="implicit"'), "mjINT_IMPLICIT"),
]


@pytest.mark.parametrize("model, said", MJX_REFUSES, ids=range(len(MJX_REFUSES)))
def test_mjx_refuses_what_it_would_leave_out(model, said):
    """In one line that names the engines that have it; and those run it."""
    env = own(model, engine="mjx")
    with pytest.raises(InputError, match=f"engine 'mjx' cannot run this model: .*{said}.*; use --engine=c or") as error:
        _ = env.simulator
    assert "\n" not in str(error.value)
    assert np.all(np.isfinite(play(own(model), np.zeros(1), 2)))


def test_a_model_that_mjx_cannot_run_leaves_no_folder(tmp_path, monkeypatch):
    """The command says so before it makes one."""
    cls = type(own(MJX_REFUSES[0][0]))
    monkeypatch.setitem(envs.ENVS.data, "falling", (cls, {}))
    with pytest.raises(InputError, match="engine 'mjx' cannot run this model"):
        mtjax.train.main(["--env=falling", "--engine=mjx", "--steps=100", f"--runs={tmp_path / 'runs'}"])
    assert not list(tmp_path.iterdir())


def set_water(spec, value):
    """Fill the world with something thick."""
    spec.option.density = value


def set_friction(spec, value):
    """Set the friction of a joint."""
    spec.joint("j").frictionloss = value


VARIED = {
    "water": (set_water, falling(), "0,5000"),
    "joint-friction": (set_friction, falling(joint='pos="1 0 0"'), "0,3"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIED)
def test_mjx_steps_tasks_that_have_what_the_first_has_not(name):
    """Water, or friction: what a program leaves out if nothing has it."""
    edit, model, values = VARIED[name]
    words = {"vary": {name: values}, "parameters": {name: Parameter("1", 0.0, edit, minimum=-1)}}
    found = []
    for engine in ("c", "mjx"):
        env = own(model, engine, **words)
        tasks, step = env.tasks(), jax.jit(jax.vmap(env.step))
        state = jax.vmap(env.reset, (0, None))(tasks, jax.random.key(0)).state
        for _ in range(20):
            state = step(tasks, state, jnp.ones((2, 1))).state
        found.append(np.asarray(state.qpos))
    np.testing.assert_allclose(found[1], found[0], atol=1e-4)
    assert np.max(np.abs(found[0][0] - found[0][1])) > 1e-2


def test_a_model_file_is_looked_for_beside_the_class(tmp_path, monkeypatch):
    """Wherever the command runs; and a subclass in another file finds it too."""
    (tmp_path / "robot.xml").write_text(falling())
    head = "import dataclasses\nfrom tests_own_base import Plain\n"
    (tmp_path / "own_robot.py").write_text(f"{head}class Robot(Plain):\n    model_file = 'robot.xml'\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "tests_own_base", sys.modules[__name__])
    robot = dataclasses.dataclass(frozen=True)(importlib.import_module("own_robot").Robot)
    sub = dataclasses.dataclass(frozen=True)(type("Sub", (robot,), {"__module__": __name__}))
    assert robot(engine="c").models[0].nu == sub(engine="c").models[0].nu == 1
    with pytest.raises(InputError, match=r"there is no model file .*tests.*none\.xml"):
        _ = own("none.xml", __module__=__name__).models
    assert envs.make("walker-walk").models[0].nu == 6


def log_of_height(self, task, world, action):
    """A reward that is not finite at once."""
    return -jnp.log(0 * world.qpos[0])


@pytest.mark.slow
def test_a_reward_that_is_not_finite_is_named():
    """Rather than learning rates."""
    env = own(falling(), reward=log_of_height)
    said = r"the reward is not finite at step 0 of task 0 \(number 0 .*\. Mend what the environment computes"
    with pytest.raises(FloatingPointError, match=said):
        mtjax.train(env, "sac", steps=40, num_envs=2, batch_size=4, replay_size=100, chunk_steps=10, hidden=(8,))


SEEN = {  # what a family may observe, and whether agents take it
    "vector": (lambda qpos: qpos, True),
    "map": (lambda qpos: jnp.zeros((3, 4)), True),
    "integers": (lambda qpos: jnp.zeros(5, jnp.int32), True),
    "dictionary": (lambda qpos: {"arm": qpos[:2], "rest": {"counts": jnp.zeros(2, jnp.int8)}}, True),
    "picture": (lambda qpos: {"pixels": jnp.zeros((16, 16, 3), jnp.uint8)}, True),
    "both": (lambda qpos: {"pixels": jnp.zeros((16, 16, 3), jnp.uint8), "state": qpos}, True),
    "other picture": (lambda qpos: {"pixels": jnp.zeros((16, 16, 3))}, False),
    "complex": (lambda qpos: qpos * 1j, False),
    "more": (lambda qpos: {"pixels": jnp.zeros((16, 16, 3), jnp.uint8), "depth": jnp.zeros((16, 16, 1))}, True),
}


@pytest.mark.parametrize("kind", SEEN)
def test_observations_are_trees_of_any_shape_and_dtype(kind, forget):
    """They can be registered and stepped; and an agent says in one line what it takes."""
    observe, taken = SEEN[kind]
    base = type(own(falling()))
    seen = lambda self, task, world: observe(world.qpos)
    cls = dataclasses.dataclass(frozen=True)(type("Seen", (base,), {"observe": seen}))
    mtjax.register("seen", cls)
    env = mtjax.make("seen", engine="c")
    step = jax.jit(env.step)(first_task(env), env.reset(first_task(env), jax.random.key(0)).state, jnp.zeros(1))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), step.obs) == jax.tree.map(
        lambda x: (x.shape, x.dtype), env.spec.obs
    )
    if taken:
        return require_sight(mtjax.agent("drq"), env.spec)
    for agent in ("sac", "ppo", "drq"):
        with pytest.raises(InputError, match=r"takes observations of any tree of numbers .*; not ") as error:
            mtjax.train("seen", agent, steps=100, engine="c")
        assert "\n" not in str(error.value)
    return None


@pytest.mark.nightly
def test_a_family_that_is_registered_with_pictures_is_learned(forget):
    """By an agent that sees."""
    mtjax.register("own-corridor", CorridorMaze, pixels=16)
    small = {"batch_size": 2, "replay_size": 50, "chunk_steps": 10, "warmup_steps": 10, "hidden": (4,)}
    result = mtjax.train("own-corridor", "drq", steps=40, num_envs=2, eval_episodes=1, **small)
    assert np.all(np.isfinite(result.evaluations.returns["train"]))


def test_a_family_needs_five_words(forget):
    """All others have a default."""

    @dataclasses.dataclass(frozen=True)
    class Least(Domain):
        model_file = falling()
        episode_steps = 10
        start, observe, reward = Plain.start, Plain.observe, Plain.reward

    mtjax.register("least", Least)
    env = mtjax.make("least", engine="c")
    assert (env.num_substeps, env.default_iterations, dict(env.parameters)) == (1, 8, {})


def set_wind(spec, value):
    """Let the wind blow along x."""
    spec.option.wind[0] = value


def set_damping(spec, value):
    """Set the damping of a joint."""
    spec.joint("j").damping[0] = value


def test_values_may_be_negative_where_physics_has_such():
    """A wind may; a damping may not, and says how to leave it out."""
    windy = own(falling('density="1"'), vary={"wind": "-1:1:3"}, parameters={"wind": Parameter("m/s", 0.0, set_wind)})
    assert [float(m.opt.wind[0]) for m in windy.models[:3]] == [-1, 0, 1]
    damped = {"vary": {"damping": "1:3:3"}, "parameters": {"damping": Parameter("N m s/rad", 1.0, set_damping)}}
    with pytest.raises(InputError, match=r"damping=-1 has a dof_damping below 0; give the parameter minimum=0\.0"):
        _ = own(falling(), **damped).models
    positive = damped | {"parameters": {"damping": Parameter("N m s/rad", 1.0, set_damping, minimum=0.0)}}
    assert min(model.dof_damping[-1] for model in own(falling(), **positive).models) > 0


@pytest.mark.slow
def test_a_model_says_itself_what_it_lacks():
    """MuJoCo did not refuse it, so nothing is said of MuJoCo."""

    def lacking(domain):
        raise InputError("the model is in a package that is not installed")

    with pytest.raises(InputError, match=r"^the model is in a package that is not installed$"):
        _ = own(lacking).models
