"""Every MuJoCo domain against dm_control's: model, one step from the same state, starts; and what parameters change."""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import require
from probes import set_physics, slow_but

from mtjax import envs
from mtjax.envs.domain import Domain
from mtjax.envs.engines.base import World

suite = require("dm_control.suite")
TASKS = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse"),
    "cheetah": ("run",),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "dog": ("run", "stand", "trot", "walk"),
    "fish": ("swim", "upright"),
    "hopper": ("hop", "stand"),
    "humanoid": ("run", "stand", "walk"),
    "pendulum": ("swingup",),
    "point_mass": ("easy",),
    "quadruped": ("run", "walk"),
    "reacher": ("easy", "hard"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("run", "stand", "walk"),
}
SUITE = {f"{domain}-{task}".replace("_", "-"): (domain, task) for domain in TASKS for task in TASKS[domain]}
TOUCHING = ("ball-in-cup-catch", "cheetah-run", "finger-spin", "hopper-stand", "humanoid-stand", "walker-walk")
# Tasks whose target is a geom, by the beginnings of their names, and the axes along which it is put.
TARGETS = {"reacher": "xy", "swimmer": "xy", "fish-swim": "xyz"}
FASTEST = {"fish": 0.1, "swimmer": 0.1}  # beyond which water stops what is this light within a step; elsewhere 10
DYNAMICS = ("body_", "jnt_", "dof_", "geom_", "actuator_", "tendon_", "wrap_", "eq_", "qpos")
# Read by a renderer or the broad phase alone; what touches what is compared by its outcome.
NOT_DYNAMICS = ("bvh", "rgba", "matid", "contype", "conaffinity")
TREES = ("cheetah", "hopper", "humanoid", "quadruped", "walker")
EXCLUDED = {
    # Whether energy is computed: nothing reads it, and MJX refuses it.
    **{name: {"enableflags"} for name, (domain, _) in SUITE.items() if domain in ("acrobot", "cartpole", "pendulum")},
    # Whether islands of constraints are told apart: all bodies are one, whose motion is the same to rounding.
    **{name: {"disableflags"} for name, (domain, _) in SUITE.items() if domain in TREES},
    # Bones are dropped and what touches is shown; "dof_length" decides when a body sleeps, and none does.
    **{name: {"body_geomadr", "body_geomnum", "dof_length"} for name in SUITE if name.startswith("dog")},
    # dm_control resizes the target after compilation, so that its bounds stay those of the big one; it never collides.
    "reacher-hard": {"geom_rbound", "geom_aabb"},
}
# What a parameter may change, by the last word of its name; any other is one of shape. All else must stay.
MASS = ("body_mass", "body_subtreemass", "inertia", "ipos", "iquat", "invweight0", "dof_M0", "dof_length", "acc0")
SHAPE = (*MASS, "body_pos", "jnt_pos", "geom_", "site_", "tendon_range")
PARAMETERS = {
    "mass": MASS,
    "gravity": ("gravity",),
    "friction": ("geom_friction",),
    "frictionloss": ("dof_frictionloss",),
    "damping": ("damping",),
    "gear": ("actuator_gear", "actuator_length0", "acc0"),
    "strength": ("actuator_gainprm", "actuator_biasprm"),
    "density": ("density",),
}
READINGS = {  # where a compiled model shows the value of a parameter
    ("acrobot-swingup", "lower-mass"): lambda model: model.body("lower_arm").mass[0],
    ("acrobot-swingup", "upper-mass"): lambda model: model.body("upper_arm").mass[0],
    ("cartpole-balance", "cart-mass"): lambda model: model.body("cart").mass[0],
    ("cartpole-balance", "gravity"): lambda model: -model.opt.gravity[2],
    ("cartpole-balance", "pole-length"): lambda model: 2 * model.body("pole").ipos[2],
    ("cartpole-balance", "pole-mass"): lambda model: model.body("pole").mass[0],
    ("pendulum-swingup", "length"): lambda model: model.body("pole").ipos[2],
    ("pendulum-swingup", "mass"): lambda model: model.body("pole").mass[0],
    ("point-mass-easy", "goal-x"): lambda model: model.geom("target").pos[0],
    ("point-mass-easy", "goal-y"): lambda model: model.geom("target").pos[1],
    ("reacher-easy", "target-size"): lambda model: model.geom("target").size[0],
}
STARTS, STATES = 1000, 400
FEWER_STATES = {"dog": 100}
SLOW = ("dog-run", "dog-stand", "dog-trot", "dog-walk", "humanoid-run", "humanoid-stand")
SLOW += ("humanoid-walk", "quadruped-run", "swimmer-swimmer15")
FIRST = {domain: name for name, (domain, _) in reversed(SUITE.items())}.values()
NAMES = slow_but(SUITE, *[name for name in SUITE if name not in SLOW])
STARTED = slow_but(SUITE, *[x for x in SUITE if x not in SLOW and not x.startswith(("quadruped", "cheetah"))])


class Suite(NamedTuple):
    """One of dm_control's environments, of which only physics and task are used."""

    domain: str
    axes: str  # of its target, or none
    physics: object
    task: object
    num_substeps: int
    episode_length: int

    def reset(self):
        with self.physics.reset_context():
            self.task.initialize_episode(self.physics)
        return self.physics.data.qpos.copy(), self.physics.data.qvel.copy(), self.observe(), *polar(self.target())

    def observe(self):
        return np.concatenate([np.ravel(x) for x in self.task.get_observation(self.physics).values()])

    def step(self, world, action):
        """One control step from the state of one of our worlds."""
        with self.physics.reset_context():
            self.physics.data.qpos[:], self.physics.data.qvel[:] = world.qpos, world.qvel
            self.put_target(world.extra)
            if world.act is not None:
                self.physics.data.act[:] = world.act
        self.physics.data.qacc_warmstart[:] = world.warmstart
        self.task.before_step(action, self.physics)
        self.physics.step(self.num_substeps)
        self.task.after_step(self.physics)
        return self.observe(), self.task.get_reward(self.physics)

    def target(self):
        """The target (2,) or (3,) that our worlds carry beside the physical state; that of finger is from its hinge."""
        model, data = self.physics.named.model, self.physics.named.data
        if self.axes:
            return model.geom_pos["target", list(self.axes)]
        if isinstance(self.task, suite.finger.Turn):
            return model.site_pos["target", ["x", "z"]] - data.xanchor["hinge", ["x", "z"]]

    def put_target(self, target):
        model, data = self.physics.named.model, self.physics.named.data
        if self.axes:
            model.geom_pos["target", list(self.axes)] = target
        if isinstance(self.task, suite.finger.Turn):
            model.site_pos["target", ["x", "z"]] = data.xanchor["hinge", ["x", "z"]] + target


def polar(target):
    """Distance, direction and height, each with a last axis of 1, of a target (..., 2) or (..., 3); or nothing."""
    if target is None:
        return []
    x, y, *z = np.split(np.asarray(target), np.shape(target)[-1], axis=-1)
    return [np.hypot(x, y), np.arctan2(y, x), *z]


@lru_cache
def load(name: str) -> Suite:
    domain, task = SUITE[name]
    made = suite.load(domain, task, task_kwargs={"random": 0})
    made.reset()
    axes = next((axes for start, axes in TARGETS.items() if name.startswith(start)), "")
    return Suite(domain, axes, made.physics, made.task, made._n_sub_steps, made._step_limit)


@lru_cache
def make(name: str, **settings) -> Domain:
    return envs.make(name, engine="c", **settings)


def repeat(env: Domain, count: int):
    return jax.tree.map(lambda x: jnp.repeat(x[:1], count, axis=0), env.tasks())


@lru_cache
def starts(name: str):
    env = make(name)
    return jax.jit(jax.vmap(env.reset))(repeat(env, STARTS), jax.random.split(jax.random.key(0), STARTS))


def play(name: str, begin: World, random: np.random.Generator) -> World:
    """Worlds in the midst of random play, and as many about the model's own pose, fast and slow."""
    env = make(name)
    model, count = env.models[0], FEWER_STATES.get(load(name).domain, STATES) // 2
    data, played = mujoco.MjData(model), []
    for qpos in np.asarray(begin.qpos[:count]):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = qpos
        for _ in range(5):
            data.ctrl[:] = random.uniform(-1, 1, model.nu)
            mujoco.mj_step(model, data, nstep=10 * env.num_substeps)
        played.append((data.qpos.copy(), data.qvel.copy(), data.act.copy()))
    qpos, qvel, act = zip(*played, strict=True)
    posed = model.qpos0 + random.choice([0.01, 0.1], (count, 1)) * random.normal(size=(count, model.nq))
    fastest = FASTEST.get(load(name).domain, 10)
    speed = random.choice([0.1, fastest], (count, 1)) * random.normal(size=(count, model.nv))
    qpos, qvel = np.float32([*qpos, *posed]), np.float32([*qvel, *speed])
    rest = jax.tree.map(lambda x: x[: 2 * count], begin)
    rest = rest._replace(qpos=qpos, qvel=qvel, warmstart=np.zeros_like(qvel))
    return rest._replace(act=np.float32([*act, *act])) if model.na else rest


def fields_of(model, prefixes=DYNAMICS):
    fields = [f for f in dir(model) if f.startswith(prefixes) and not any(word in f for word in NOT_DYNAMICS)]
    options = {f: np.asarray(getattr(model.opt, f)) for f in dir(model.opt) if not f.startswith("_")}
    return {f: np.asarray(getattr(model, f)) for f in fields} | options


def differing(ours, theirs):
    """Names of the fields that differ by more than the rounding of another order of the same sums."""
    same = lambda a, b: a.shape == b.shape and np.allclose(a, b, rtol=1e-12, atol=1e-12)
    return {name for name in ours if not same(ours[name], theirs[name])}


@pytest.mark.parametrize("name", NAMES)
def test_model_and_timing_are_those_of_dm_control(name):
    """Every field that reaches the dynamics is equal, but for the named exclusions."""
    env, theirs = make(name), load(name)
    if theirs.axes:
        theirs.put_target(env.models[0].geom("target").pos[: len(theirs.axes)])
    ours, expected = fields_of(env.models[0]), fields_of(theirs.physics.model.ptr)
    if theirs.domain == "dog":  # without its bones
        kept = [theirs.physics.model.ptr.geom(env.models[0].geom(i).name).id for i in range(env.models[0].ngeom)]
        expected = {name: x[kept] if name.startswith("geom_") else x for name, x in expected.items()}
    assert len(ours) > 150
    assert differing(ours, expected) == EXCLUDED.get(name, set())
    assert (env.num_substeps, env.episode_length) == (theirs.num_substeps, theirs.episode_length)


@pytest.mark.parametrize("name", slow_but(SUITE, *[name for name in FIRST if name not in SLOW][::4], nightly=True))
def test_a_step_gives_the_observation_and_reward_of_dm_control(name):
    """Of 400 states, or 100 of the dog, the 25 of highest reward and 25 others, to rounding in float32."""
    env, theirs, random = make(name), load(name), np.random.default_rng(0)
    worlds = play(name, starts(name).state, random)
    states = len(worlds.qpos)
    actions = np.float32(random.uniform(-1, 1, (states, env.action_size)))
    task = jax.tree.map(lambda x: x[0], env.tasks())
    controls = np.asarray(jax.vmap(partial(env.control, task, None))(actions)[1])
    after = jax.device_get(jax.jit(jax.vmap(env.step))(repeat(env, states), worlds, actions))
    best, rest = np.split(np.argsort(-after.reward, kind="stable"), [25])
    chosen = [*best, *random.choice(rest, 25, replace=False)]
    expected = [theirs.step(jax.tree.map(lambda x, i=i: np.asarray(x[i]), worlds), controls[i]) for i in chosen]
    obs, reward = (np.array(x) for x in zip(*expected, strict=True))
    assert reward.max() > 0.5 and reward.min() < reward.max()
    np.testing.assert_allclose(after.obs[chosen], obs, rtol=2e-6, atol=2e-6)
    np.testing.assert_allclose(after.reward[chosen], reward, rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("name", TOUCHING)
def test_what_touches_is_what_touches_in_dm_control(name):
    """In 600 random positions the same geoms meet: what we leave out of collision detection is never in reach."""
    model, physics, random = make(name).models[0], load(name).physics, np.random.default_rng(0)
    limits = np.tile([[-1.0], [1.0]], model.nq)  # of quaternions
    for place, kind, limited, given in zip(
        model.jnt_qposadr, model.jnt_type, model.jnt_limited, model.jnt_range, strict=True
    ):
        free = np.pi if kind == mujoco.mjtJoint.mjJNT_HINGE else 0.25  # [rad or m]
        limits[:, place] = given if limited else [-free, free]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            limits[:, place + 2] = [0.2, 1.5]
    data, contacts = mujoco.MjData(model), 0
    for _ in range(600):
        data.qpos[:] = random.uniform(*limits)
        mujoco.mj_forward(model, data)
        with physics.reset_context():
            physics.data.qpos[:] = data.qpos
        assert np.array_equal(data.contact.geom, physics.data.contact.geom)
        contacts += data.ncon
    assert contacts > 30


@pytest.mark.parametrize("name", STARTED)
def test_starts_are_distributed_as_in_dm_control(name):
    """Joint positions, velocities, observations and targets of 1000 starts against 1000.

    Two-sample Kolmogorov-Smirnov: equal laws exceed the bound in any column in one test in 10 000. Rank correlations
    have a standard error of 0.04. Ends of the range differ by less than three times the expected tail of a hundredth.
    Where starts come from a pool, it is the pool's size that counts, and it need not reach the ends.
    """
    step, theirs = starts(name), load(name)
    ours = np.concatenate([step.state.qpos, step.state.qvel, step.obs, *polar(step.state.extra)], axis=1).T
    expected = np.float32([np.concatenate(theirs.reset()) for _ in range(STARTS)]).T
    count = len(np.unique(ours, axis=1).T)
    error = np.sqrt(1 / count + 1 / STARTS)
    spread = np.ptp(expected, axis=1) > 1e-5
    bound = np.sqrt(np.log(2 * len(ours) / 1e-4) / 2) * error
    np.testing.assert_allclose(ours[~spread], expected[~spread], atol=1e-4)
    for a, b in zip(ours[spread], expected[spread], strict=True):
        assert np.abs(share_below(a, [*a, *b]) - share_below(b, [*a, *b])).max() < bound
        low, high = np.quantile(b, [0.01, 0.99])
        beyond = np.array([b.min() - a.min(), a.max() - b.max()])
        tails = 3 * np.array([low - b.min(), b.max() - high]) + 1e-4
        assert np.all(beyond < tails) and (count < STARTS or np.all(-beyond < tails))
    correlations = [np.corrcoef([share_below(x, x) for x in group[spread]]) for group in (ours, expected)]
    np.testing.assert_allclose(*correlations, atol=5 * error)


def share_below(sample, points):
    """The empirical distribution function of a sample at each of the points."""
    return np.searchsorted(np.sort(sample), points, side="right") / len(sample)


# Tasks with the same parameters once.
CLASSES = {id(envs.ENVS[name][0].parameters): name for name in reversed(SUITE) if name in envs.ENVS}
EDITS = [
    (name, parameter)
    for name in CLASSES.values()
    for parameter, given in envs.ENVS[name][0].parameters.items()
    if given.edit is not None
]
assert READINGS.keys() <= set(EDITS)


@pytest.mark.parametrize(("name", "parameter"), EDITS)
def test_a_parameter_changes_what_it_says(name, parameter):
    """Its nominal value is the model's own; another changes the model, and nothing but what its name promises."""
    env = make(name)
    compiled = lambda values: env.compile_spec(values).compile()
    read = lambda values: fields_of(compiled(values), (*DYNAMICS, "site_"))
    nominal = env.parameters[parameter].nominal
    other = nominal * 1.2 or 0.1
    assert differing(read({}), read({parameter: nominal})) == set()
    fields = differing(read({}), read({parameter: other}))
    allowed = PARAMETERS.get(parameter.split("-")[-1], SHAPE)
    assert fields and [f for f in fields if not any(word in f for word in allowed)] == []
    if (name, parameter) in READINGS:
        assert READINGS[name, parameter](compiled({parameter: other})) == pytest.approx(other)


@pytest.mark.parametrize(("part", "nominal"), [("cart", b'mass="1"'), ("pole", b'mass=".1"')])
def test_cartpole_masses_are_those_of_an_edited_dm_control_model(part, nominal):
    """The ten published values (Zhang et al. 2021) give the models that editing dm_control's XML gives."""
    xml, assets = suite.cartpole.get_model_and_assets()
    for mass in make(f"cartpole-swingup-vary-{part}-mass").tasks().params[f"{part}-mass"].tolist():
        edited = xml.replace(nominal, f'mass="{mass!r}"'.encode())
        theirs = mujoco.MjModel.from_xml_string(edited.decode(), assets)
        ours = make("cartpole-swingup").compile_spec({f"{part}-mass": mass}).compile()
        assert differing(fields_of(ours), fields_of(theirs)) == {"enableflags"}


def reach(params):
    """Joint angles that bring the reacher's finger, on two links of 0.12 m, to the target of each task."""
    wrist = 2 * jnp.arccos(0.15 / 0.24)
    return jnp.stack([params["target-angle"] - wrist / 2, jnp.full_like(params["target-angle"], wrist)], axis=1)


AT_GOAL = {
    "point-mass-vary-goal": lambda params: jnp.stack([params["goal-x"], params["goal-y"]], axis=1),
    "reacher-vary-goal": reach,
}


@pytest.mark.parametrize("name", AT_GOAL)
def test_a_goal_is_rewarded_and_not_seen(name):
    """The observation is the same whatever the task; the highest reward is where the task's own goal is."""
    env = make(name)
    tasks = env.tasks()
    begin = jax.vmap(env.reset, in_axes=(0, None))(tasks, jax.random.key(0))
    assert np.all(begin.obs == begin.obs[0])
    put = lambda task, state, qpos: set_physics(env, task, state, qpos, jnp.zeros(2))
    score = lambda task, state, qpos: env.reward(task, put(task, state, qpos), jnp.zeros(2))
    rewards = jax.vmap(jax.vmap(score, (None, None, 0)), (0, 0, None))(tasks, begin.state, AT_GOAL[name](tasks.params))
    np.testing.assert_allclose(jnp.diag(rewards), 1, atol=1e-6)
    assert np.all(rewards[:, 0].min() < 0.8) and np.ptp(rewards, axis=1).min() > 0.1
