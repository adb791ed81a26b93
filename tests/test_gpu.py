"""On an NVIDIA GPU: that it computes what the CPU does. ``pytest -m gpu`` there; elsewhere they are left out.

Workers take one test after another in the order of this file. Those that take longest come first, and those that share
kernels of Warp with them last, as workers that start together would all compile the same kernels.
"""

import dataclasses
import signal
import subprocess
import sys
import threading
import time
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from needs import needs
from own_process import environment
from probes import learn, random_batch, update, with_memory, with_nets
from test_joined import require_as_alone
from test_kills import outcome
from test_painters import SIZE, similarity, states_of
from test_rocking import ROCKING, tilting

import mtjax
from mtjax.agents import AGENTS, for_action, options
from mtjax.agents.base import Memory
from mtjax.agents.hyperparameters import replace
from mtjax.agents.parts.policies import Gaussian, Taken
from mtjax.agents.parts.values import C51
from mtjax.compiling.programs import compile_lowered
from mtjax.config import configure
from mtjax.envs.engines.base import World
from mtjax.envs.engines.c import MujocoC
from mtjax.envs.engines.mjx import Mjx
from mtjax.envs.merged_simulator import United
from mtjax.envs.mixtures import States
from mtjax.envs.physics import mjx_engine
from mtjax.envs.probes import tasks_of
from mtjax.envs.shared_simulator import Joined
from mtjax.learning import loop, rollout
from mtjax.saved import checkpoint
from mtjax.types import Discrete, MultiDiscrete, Spec

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(jax.default_backend() != "gpu", reason="there is no GPU"),
]
SPEC = Spec.vector(9, 2, 1)
# Acting: (S, T, E), and how often such a program runs in a run.
SHAPES = {
    "evaluation of ten seeds": ((10, 8, 5), "seldom"),
    "evaluation": ((1, 10, 10), "seldom"),
    "training": ((1, 4, 64), "often"),
}
SEEDS = 10
QUICK = {"xla_backend_optimization_level": 0}  # of the CPU's program alone, which takes minutes otherwise
PENDULUM = {"vary": {"length": "0.4,0.6"}, "split": "none", "engine": "mjx"}
MJX_SAVE = 50  # iterations between two checkpoints of MJX_RUN
MJX_RUN = (
    "--env=pendulum-swingup --env.vary.length=0.4,0.6 --split=none --engine=mjx --agent=sac-conditioned --seeds=2 "
    "--num-envs=4 --batch-size=8 --replay-size=2000 --warmup-steps=5 --chunk-steps=50 --eval-every=400 "
    "--eval-episodes=1 --steps=12000 --agent.hidden 8 8"
).split()
DOMAINS = {
    "acrobot-swingup": {"gravity": "8,11"},
    "ball-in-cup-catch": {"mass": "0.8,1.2"},
    "cartpole-swingup": {"pole-length": "0.9,1.2"},
    "cheetah-run": {"torso-length": "0.5,0.6"},
    "finger-spin": {"size": "0.95,1.05"},
    "hopper-stand": {"foot-length": "0.9,1.1"},
    "pendulum-swingup": {"length": "0.4,0.6"},
    "point-mass-easy": {"mass": "0.8,1.2"},
    "reacher-easy": {"mass": "0.8,1.2"},
    "walker-walk": {"foot-length": "0.08,0.12"},
}

# Bodies in space, some with activations, some welded to a body that moves by itself.
BODIES = ["swimmer-swimmer6", "fish-upright", "humanoid-walk", "quadruped-walk"]
SCENES = ["push", "door-open", "drawer-close", "button-press-topdown", "peg-insert-side", "window-open"]


def on(platform):
    return jax.default_device(jax.devices(platform)[0])


def run_on(platform, function, *arguments, runs="often"):
    """What a device makes of the arguments, at full float32 precision. A GPU's program is compiled as those of runs."""
    device = jax.devices(platform)[0]
    given = jax.device_put(arguments, device)
    with jax.default_device(device), jax.default_matmul_precision("highest"):
        lowered = jax.jit(function).lower(*given)
        compiled = lowered.compile(QUICK) if platform == "cpu" else compile_lowered(lowered, runs)
        return jax.device_get(compiled(*given))


def both(function, *arguments, runs="often"):
    """What the CPU and the GPU make of the same arguments."""
    return [run_on(platform, function, *arguments, runs=runs) for platform in ("cpu", "gpu")]


def first(count, tree):
    """The first rows of every leaf."""
    return jax.tree.map(lambda x: x[:count], tree)


def learned(name, tasks):
    """The agent called ``name`` by its preset for GPUs, and ``SEEDS`` states whose networks are not as they began.

    An update is one gradient step: each further step of Adam magnifies rounding.
    """
    preset = name.removeprefix("discrete-").removeprefix("several-")
    agent = mtjax.preset("finger-spin-vary-size", preset, "gpu").learner
    spec = spec_for(name)
    agent = for_action(agent, spec.action)
    if not hasattr(agent, "critic_target"):
        agent = replace(agent, {"epochs": 1, "minibatches": 1, "unroll": 8})
    random = np.random.default_rng(0)
    shake = lambda x: x + np.float32(0.1 * random.normal(size=x.shape)) if x.dtype == np.float32 else x
    with on("cpu"):
        init = jax.jit(jax.vmap(lambda key: agent.init(spec, tasks, key)), compiler_options=QUICK)
        states = jax.device_get(init(jax.random.split(jax.random.key(0), SEEDS)))
    acting = "actor" if "actor" in states.nets else "critic"
    return agent, with_nets(states, **{acting: jax.tree.map(shake, states.nets[acting])})


def spec_for(name):
    """The shapes that an agent sees and draws; of discrete actions where it draws these."""
    discrete = name.startswith("discrete-") or name in ("pqn", "sketches")
    action = MultiDiscrete((2, 3)) if name.startswith("several-") else SPEC.action
    spec = SPEC._replace(action=Discrete(SPEC.action_size) if discrete else action)
    return spec._replace(symbols=2) if name == "sketches" else spec


def exactly(family):
    """The family with MuJoCo itself as its engine, which steps on the CPU."""
    exact = dataclasses.replace(family)
    exact.__dict__["simulator"] = MujocoC(exact.models, exact.num_substeps)
    return exact


def played(env, count=64, steps=40):
    """States (count, ...) of random play by MuJoCo itself, actions, and where each leads; tasks in turn."""
    random, found = np.random.default_rng(0), []
    tasks = jax.device_get(env.tasks())
    with on("cpu"):
        each = jax.tree.map(lambda x: x[np.arange(count) % len(tasks.id)], tasks)
        keys = jax.random.split(jax.random.key(0), count)
        starts = jax.device_get(jax.jit(jax.vmap(exactly(env).reset), compiler_options=QUICK)(each, keys).state)
    for i in range(count):
        model = env.models[each.row[i]]
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = starts.qpos[i], starts.qvel[i]
        for step in range(steps + 1):
            if step % 5 == 0:
                data.ctrl[:] = random.uniform(-1, 1, model.nu)
            if step == steps:
                state = [np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl)]
                data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.ctrl[:] = state
            mujoco.mj_step(model, data, env.num_substeps)
        found.append((*state, np.float32(data.qpos), np.float32(data.qvel)))
    return each, [np.stack(x) for x in zip(*found, strict=True)]


# What takes longest.


@needs("metaworld")
@pytest.mark.parametrize("name", ["mt50", "mt10"])
def test_worlds_of_a_union_go_on_on_warp_as_on_c(name, count=16, steps=30):
    """One step, from worlds in which MuJoCo has played at random in each task's own scene.

    All velocities have a bound of 1e-3 but those by which a thing rocks. A puck on its flat side touches the table in
    one point of its rim, and Warp's contact normals, in single precision, are off by up to 1e-4 rad. MuJoCo itself,
    with a normal that is off by so much, rocks the puck otherwise by a median of 1.4 to 2.0 % of the largest velocity
    (``test_rocking.py``). The bound of medians is below that.
    """
    env = mtjax.make(name, engine="warp", num_draws=count, solver_iterations=50)
    assert {type(group) for group in env.groups} == {United}
    exact = mtjax.mixture([exactly(family) for family in env.families], scenes="apart")
    shape = (1, len(env.families), count)
    action = np.random.default_rng(0).uniform(-1, 1, (steps // 5 + 1, *shape, 4)).astype(np.float32)
    with on("cpu"):
        tasks = jax.device_get(exact.tasks())
        rows = tasks.draws.row[None]
        tasks = rollout.broadcast_tasks(tasks, shape)._replace(row=jnp.asarray(rows), blocks=tasks.blocks)
        reset, step = (jax.jit(f, compiler_options=QUICK) for f in (exact.reset_worlds, exact.step_worlds))
        state = reset(tasks, jax.random.split(jax.random.key(0), shape)).state
        for i in range(steps):
            state = step(tasks, state, action[i // 5]).state
        tasks, state, expected = jax.device_get((tasks, state, step(tasks, state, action[-1])))
    found = jax.device_get(jax.jit(env.step_worlds)(tasks, state, action[-1]))
    errors, steady = [], []
    for family, ours, theirs in zip(env.families, found.state.families, expected.state.families, strict=True):
        error = np.abs(ours.qvel - theirs.qvel) / np.abs(theirs.qvel).max()
        errors.append(error.max(axis=-1))
        steady.append(np.delete(error, tilting(family.models[0]), axis=-1).max(axis=-1))
    for found_errors, median, nine_in_ten in ((steady, 1e-3, 1e-3), (errors, ROCKING, 5e-2)):
        middle = sorted(zip(map(np.median, found_errors), env.names, strict=True), reverse=True)
        assert middle[0][0] < median and np.quantile(found_errors, 0.9) < nine_in_ten, middle[:5]
    assert np.quantile(np.abs(found.obs - expected.obs), 0.9) < 1e-3


def test_a_mixture_steps_as_its_families(sizes=(512, 64)):
    """Ten models in one program, each in memory of its own, with as many worlds of each task as in a run and fewer."""
    env = mtjax.mixture([mtjax.make(name, vary=vary, engine="warp") for name, vary in DOMAINS.items()])
    tasks = env.tasks()
    shape = lambda tasks: (1, len(tasks.id), max(sizes))

    def begin(family):
        tasks = family.tasks()
        reset = lambda tasks, keys: exactly(family).reset_worlds(rollout.broadcast_tasks(tasks, keys.shape), keys).state
        with on("cpu"):
            keys = jax.random.split(jax.random.key(0), shape(tasks))
            return jax.device_get(jax.jit(reset, compiler_options=QUICK)(jax.device_get(tasks), keys))

    @partial(jax.jit, static_argnums=0)
    def play(family, tasks, state, action):
        step = lambda state, action: (
            family.step_worlds(rollout.broadcast_tasks(tasks, action.shape[:3]), state, action).state,
            None,
        )
        return jax.lax.scan(step, state, action)[0]

    states = [begin(part.family) for part in env.parts]
    actions = jax.random.uniform(jax.random.key(1), (3, *shape(tasks), env.spec.action_size), minval=-1.0)
    for count in sizes:
        few, action = jax.tree.map(lambda x, count=count: x[:, :, :count], states), actions[:, :, :, :count]
        together = play(env, tasks, States(tasks.blocks, tuple(few)), action).families
        for i, (part, state) in enumerate(zip(env.parts, few, strict=True)):
            places = [place for owner, place in tasks.blocks.slices() if owner == i]
            own = jnp.concatenate([action[:, :, place] for place in places], axis=2)[
                ..., : part.family.spec.action_size
            ]
            alone = play(part.family, part.family.tasks(), state, own)
            error = np.abs(np.asarray(alone.qpos) - np.asarray(together[i].qpos)).max(axis=-1)
            assert np.quantile(error, 0.9) < 1e-3 and np.all(np.isfinite(error)), (part.name, count)


def test_a_run_that_is_killed_ends_as_any_other(tmp_path):
    """To the byte on MJX. Both runs execute the programs that the first of them compiled."""
    alike = environment(
        MTJAX_CACHE=str(tmp_path / "cache"),
        XLA_PYTHON_CLIENT_PREALLOCATE="false",  # this process has memory of the same device
    )

    def start(*words):
        with (tmp_path / "out").open("a") as file:
            command = [sys.executable, "-m", "mtjax.train", *words]
            return subprocess.Popen(command, env=alike, stdout=file, stderr=subprocess.STDOUT)

    def folder_in(runs):
        return next(iter(runs.glob("pendulum-*")), None)

    def saved(runs):
        names = [path.name for path in runs.glob("pendulum-*/checkpoints/*")]
        return max((int(name) for name in names if name.isdigit()), default=0)

    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert start(*MJX_RUN, f"--runs={whole}").wait(900) == 0, (tmp_path / "out").read_text()[-3000:]
    words = [*MJX_RUN, f"--runs={broken}"]
    for delay in (0.0, 0.05):  # from a checkpoint's seal until the process is killed: beside the next chunk, or save
        process, before, until = start(*words), saved(broken), time.monotonic() + 600
        while saved(broken) < before + 2 * MJX_SAVE:
            assert process.poll() is None and time.monotonic() < until, (tmp_path / "out").read_text()[-3000:]
            time.sleep(0.002)
        time.sleep(delay)
        process.kill()
        assert process.wait(60) == -signal.SIGKILL
        words = [f"--resume={folder_in(broken)}"]
    assert start(*words).wait(900) == 0, (tmp_path / "out").read_text()[-3000:]
    assert outcome(folder_in(broken)) == outcome(folder_in(whole))


def test_a_run_goes_on_bit_for_bit(tmp_path):
    """On MJX-JAX; MuJoCo Warp adds up in another order each time."""
    env = mtjax.make("pendulum-swingup", **PENDULUM)
    settings = {"num_envs": 4, "batch_size": 8, "replay_size": 200, "warmup_steps": 5, "chunk_steps": 25}
    agent = mtjax.agent("sac-conditioned", hidden=(8, 8))
    run = partial(mtjax.train, env, agent, seeds=2, eval_every=4000, eval_episodes=1, directory=tmp_path, **settings)
    run(steps=4000)
    again = run(steps=8000, resume=True)
    whole = mtjax.train(env, agent, seeds=2, steps=8000, eval_every=4000, eval_episodes=1, **settings)
    actors = (jax.device_get(x.state.agent.nets["actor"]) for x in (whole, again))
    for one, other in zip(*map(jax.tree.leaves, actors), strict=True):
        np.testing.assert_array_equal(one, other)


def bytes_of(tree):
    """A copy of every leaf, so that nothing can overwrite it."""
    plain = lambda x: jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
    return [np.asarray(plain(x)).tobytes() for x in jax.tree.leaves(tree)]


def test_a_checkpoint_is_the_state_of_when_it_was_saved(tmp_path, monkeypatch, request):
    """The chunks that follow take over its buffers and end before the checkpoint is sealed."""
    gate, seal = threading.Event(), checkpoint._finish
    request.addfinalizer(gate.set)  # or else a failure would wait for it
    monkeypatch.setattr(checkpoint, "_finish", lambda *given: gate.wait(600) and seal(*given))
    given = {"num_envs": 4, "batch_size": 8, "replay_size": 50_000, "warmup_steps": 5, "chunk_steps": 25}
    agent, settings = configure(mtjax.agent("sac-conditioned", hidden=(8, 8)), loop.Settings(), given)
    env = mtjax.make("pendulum-swingup", **PENDULUM)
    tasks, writer = env.tasks(), checkpoint.Writer(tmp_path)
    chunk = lambda state: loop.run_chunk(env, agent, settings, tasks, state)[0]
    state = chunk(loop.init(env, agent, settings, tasks, jnp.arange(2)))
    expected = bytes_of(jax.tree.map(jnp.copy, state))  # as a buffer that NumPy has seen is not taken over
    writer.save(state)
    after = chunk(state)
    taken = all(x.is_deleted() for x in jax.tree.leaves((state.agent.nets["actor"], state.data.ring.rows)))
    assert taken or jax.default_backend() == "cpu"  # where the host's copy is the buffer, which therefore stays
    after = jax.block_until_ready(chunk(chunk(after)))
    assert not (tmp_path / "25").exists()
    gate.set()
    writer.wait()
    saved = checkpoint.load(tmp_path, after)
    assert bytes_of(saved) == expected != bytes_of(after)
    assert bytes_of(chunk(chunk(chunk(saved)))) == bytes_of(after)


# Agents.


def experience(agent, num_seeds, num_tasks):
    """Batches (S, T, B, ...), or rollouts (S, T, H, E, ...) for agents that learn from these."""
    batches = [random_batch(seed, num_tasks, 64, SPEC, agent.view.history) for seed in range(num_seeds)]
    batch = jax.tree.map(lambda *x: np.stack(x), *(with_memory(agent, batch) for batch in batches))
    if hasattr(agent, "critic_target"):
        return batch
    steps = jax.tree.map(lambda x: x.reshape(*x.shape[:2], 8, 8, *x.shape[3:]), batch)
    random = np.random.default_rng(0)
    raw = np.arctanh(np.clip(steps.action, -0.99, 0.99))
    if not isinstance(agent.policy, Gaussian):
        even = jnp.zeros((*steps.reward.shape, len(agent.policy.encode(agent.policy.blank({})))))
        raw = np.asarray(agent.policy.draw(even, None, jax.random.key(0)).action)
        steps = steps._replace(action=raw)
    ended = random.random(steps.reward.shape) < 0.1
    memory = Memory(None) if steps.memory is None else steps.memory
    returns = agent.sampler.begin()
    memory = memory._replace(sampler=None if returns is None else np.zeros(ended.shape, np.float32))
    taken = Taken(raw, random.normal(size=ended.shape).astype(np.float32) - 2)
    if isinstance(agent, options.Options):
        option = lambda: random.integers(agent.num_options, size=ended.shape).astype(np.int32)
        running, chosen = options.Running(option(), np.ones(ended.shape, np.float32)), random.random(ended.shape) < 0.5
        taken = options.Taken(*taken, option(), running, chosen, taken.log_prob)
    if agent.taught:
        taken = random.normal(size=(*ended.shape, agent.policy.outputs(SPEC.action_size))).astype(np.float32)
    return steps._replace(ended=ended, closed=ended, cut=ended, extras=taken, memory=memory)


@pytest.mark.parametrize("name", [*AGENTS, "discrete-ppo", "discrete-rl2", "several-ppo"])
def test_agents_learn_as_on_the_cpu(name, num_tasks=10):
    """Losses of an update, and its gradients by what Adam remembers, seed by seed; of all seeds and of one alone.

    Matrix products are XLA's own kernels with all seeds, and cuBLAS's with one.
    """
    with on("cpu"):
        tasks = tasks_of("one-step", np.linspace(-1, 1, num_tasks))
    agent, states = learned(name, tasks)
    with on("cpu"):
        given = states, experience(agent, SEEDS, num_tasks), jax.random.split(jax.random.key(1), SEEDS)
    update = updating(agent)
    expected = run_on("cpu", update, *given, tasks)
    for count, runs in ((SEEDS, "often"), (1, "seldom")):
        require_alike(first(count, expected), run_on("gpu", update, *first(count, given), tasks, runs=runs))


def updating(agent):
    """An update of every seed, or for agents that learn from rollouts all that they learn from one."""
    take = update if hasattr(agent, "critic_target") else learn
    return lambda states, data, keys, tasks: jax.vmap(lambda s, d, k: take(agent, s, d, tasks, k))(states, data, keys)


def require_alike(expected, found):
    """Hold an update's metrics, and its gradients by what Adam remembers, on a GPU against those on the CPU."""
    (expected, metrics), (found, measured) = expected, found
    for key, value in metrics.items():
        assert np.abs(value - measured[key]).max() <= 0.02 * np.abs(value).max() + 1e-4, (len(value), key)
    expected, found = ({name: fit.optimizer for name, fit in state.fits.items()} for state in (expected, found))
    leaves = zip(jax.tree_util.tree_leaves_with_path(expected), jax.tree.leaves(found), strict=True)
    for (path, one), other in leaves:
        if ".mu" in jax.tree_util.keystr(path) and one.size:
            difference, size = (np.linalg.norm(x.reshape(len(x), -1), axis=1) for x in (one - other, one))
            assert np.all(difference <= 0.05 * size + 1e-7), (jax.tree_util.keystr(path), difference / size)


@pytest.mark.parametrize("vision", ["drq", "impala", "grid"])
@pytest.mark.parametrize("name", ["drq", "sac-ae"])
def test_agents_learn_from_pictures_as_on_the_cpu(name, vision):
    """Three seeds, whose convolutions follow one another."""
    agent = mtjax.agent(name, hidden=(64, 64), vision=vision)
    spec = SPEC._replace(obs={"pixels": jax.ShapeDtypeStruct((SIZE, SIZE, 3), jnp.uint8)}, frames=3)
    with on("cpu"):
        tasks, keys = tasks_of("one-step", np.linspace(-1, 1, 2)), jax.random.split(jax.random.key(0), 3)
        init = jax.jit(jax.vmap(lambda key: agent.init(spec, tasks, key)), compiler_options=QUICK)
        states = jax.device_get(init(keys))
        data = jax.tree.map(lambda *x: np.stack(x), *(random_batch(seed, 2, 8, spec) for seed in range(3)))
    require_alike(*both(updating(agent), states, data, keys, tasks))


@pytest.mark.parametrize("name", [*AGENTS, "discrete-ppo", "discrete-rl2", "several-ppo"])
def test_agents_act_as_on_the_cpu(name):
    """The mean actions in worlds whose tasks were seen and in others."""
    with on("cpu"):
        tasks = tasks_of("one-step", np.linspace(-1, 1, 4))
    agent, learners = learned(name, tasks)

    def act(states, worlds, obs):
        shape = obs.shape[:3]
        age = jnp.zeros(shape, jnp.int32)
        begin = lambda state, task: agent.begin(state, task)
        memory = jax.vmap(jax.vmap(jax.vmap(begin, (None, 0)), (None, 0)), (0, None))(
            states, jax.tree.map(lambda x: jnp.broadcast_to(x[:, None], (*shape[1:], *x.shape[1:])), worlds)
        )
        return rollout.act(agent, states, worlds, rollout.Worlds((), None, obs, memory, age), None).action

    for what, (shape, runs) in SHAPES.items():
        with on("cpu"):
            worlds = tasks_of("one-step", np.linspace(-1.3, 1.3, shape[1]))
        obs = np.random.default_rng(1).normal(size=(*shape, SPEC.obs_size)).astype(np.float32)
        expected, found = both(act, first(shape[0], learners), worlds, obs, runs=runs)
        error = np.abs(expected - found).reshape(*shape, -1).max(axis=(0, 2, 3))
        assert error.max() < 1e-3, (what, error)


@pytest.mark.parametrize("name", ["control-cartpole", "sailing", "racing", "light-world"])
def test_worlds_whose_starts_are_cheap_go_on_as_on_the_cpu(name, steps=60, count=64):
    """A GPU begins them anew without a branch. Rounding may end an episode a step sooner."""
    env = mtjax.make(name)
    agent = for_action(mtjax.agent("ppo", hidden=(8,)), env.spec.action)
    assert env.cheap_starts
    with on("cpu"):
        tasks, keys = jax.device_get(env.tasks()), jax.random.split(jax.random.key(0), 1)
        learners = jax.device_get(jax.vmap(lambda key: agent.init(env.spec, tasks, key))(keys))
    shape = 1, len(tasks.id), count

    def play(learners, tasks, keys):
        keys, begin_keys = rollout.split_keys(keys, 2)
        worlds = rollout.reset_envs(env, agent, learners, tasks, rollout.world_keys(begin_keys, shape))
        horizon = jnp.maximum(tasks.horizon[:, None] - jnp.arange(count), 0)  # some are near their limit of time
        worlds = worlds._replace(age=jnp.broadcast_to(horizon, shape))

        def step(worlds, number):
            given = jax.vmap(jax.random.fold_in, (0, None))(keys, number)
            act_keys, reset_keys = rollout.split_keys(given, 2)
            stepped, taken = rollout.step_envs(env, agent, learners, tasks, worlds, rollout.world_keys(act_keys, shape))
            fresh = partial(rollout.world_keys, reset_keys, shape)
            return rollout.reset_ended(env, agent, learners, tasks, stepped, taken.ends, fresh)[0], taken.ends.episode

        worlds, ended = jax.lax.scan(step, worlds, jnp.arange(steps))
        return worlds.obs, worlds.age, ended

    (obs, age, ended), (other, other_age, other_ended) = both(play, learners, tasks, keys)
    assert ended.sum() > count and np.mean(ended == other_ended) > 0.999
    alike = age == other_age
    assert np.mean(alike) > 0.98
    assert np.mean(np.abs(obs - other)[alike] > 0.01) < 0.01


def test_a_distribution_is_projected_in_a_kernel_of_its_own(rows=1280):
    """Beside a softmax in one kernel it is many times slower, and XLA takes minutes to compile it."""
    value = C51()
    random = np.random.default_rng(0)
    logits, next_logits = np.float32(random.normal(size=(2, 2, rows, value.num_bins)))
    reward, discount, bonus = np.float32(random.uniform(size=(3, rows)))

    def loss(logits):
        target = value.target(next_logits, False, reward, discount, bonus)
        return jnp.mean(value.loss(logits, target))

    kernels = jax.jit(jax.grad(loss)).lower(logits).compile().as_text().split("\n}\n")
    projecting = [kernel for kernel in kernels if f"{value.num_bins},{value.num_bins}]" in kernel]
    assert projecting
    assert not [kernel for kernel in projecting if " exponential(" in kernel]


# Physics, with Warp's kernels that the first tests compiled, and pictures.


@needs("metaworld")
@pytest.mark.parametrize(
    "names, kind",
    [
        (("reach", "push", "pick-place"), Joined),
        (("window-open", "window-close"), Joined),
        (("push", "door-open", "drawer-close", "drawer-open", "window-open"), United),
        (("stick-push", "button-press", "plate-slide"), United),  # the first one feels forces
    ],
)
def test_tasks_step_together_as_they_do_alone(names, kind):
    """Warp adds up in another order each time."""
    env = mtjax.mixture([mtjax.make(f"metaworld-{name}", num_draws=2, engine="warp") for name in names])
    assert [type(group) for group in env.groups] == [kind]
    require_as_alone(env, atol=2e-3)


@pytest.mark.parametrize(
    "name", [*BODIES, *(pytest.param(f"metaworld-{name}", marks=needs("metaworld")) for name in SCENES)]
)
def test_worlds_go_on_on_warp_as_on_c(name, count=64, steps=30):
    """One step, from worlds in which MuJoCo has played at random: all that a world holds is taken over."""
    env = mtjax.make(name, engine="warp", solver_iterations=50)
    exact = exactly(env)
    action = np.random.default_rng(0).uniform(-1, 1, (steps // 5 + 1, count, env.action_size)).astype(np.float32)
    with on("cpu"):
        tasks = env.tasks()
        tasks = tasks if tasks.draws is None else jax.tree.map(lambda x: x[0], tasks.draws)
        chosen = np.arange(count) % len(tasks.id)
        tasks = jax.device_get(jax.tree.map(lambda x: x[chosen], tasks))
        reset, step = (jax.jit(jax.vmap(f), compiler_options=QUICK) for f in (exact.reset, exact.step))
        world = reset(tasks, jax.random.split(jax.random.key(0), count)).state
        for i in range(steps):
            world = step(tasks, world, action[i // 5]).state
        world, expected = jax.device_get((world, step(tasks, world, action[-1])))
    found = jax.device_get(jax.jit(jax.vmap(env.step))(tasks, world, action[-1]))
    error = np.abs(found.state.qvel - expected.state.qvel).max(axis=1) / np.abs(expected.state.qvel).max()
    assert np.median(error) < 2e-3 and np.quantile(error, 0.9) < 5e-2, np.sort(error)[-16:]  # a puck on its flat side
    assert np.quantile(np.abs(found.obs - expected.obs), 0.9) < 1e-3
    for one, other in ((found.state.act, expected.state.act), (found.state.mocap, expected.state.mocap)):
        np.testing.assert_allclose(np.asarray(one, float), np.asarray(other, float), atol=1e-5)


@pytest.mark.parametrize("engine", ["warp", "mjx"])
@pytest.mark.parametrize("name", DOMAINS)
def test_engines_step_as_mujoco_does(name, engine):
    """One control step from states of play: nearly all worlds to rounding, with solver iterations to spare."""
    from mtjax.envs.engines.warp import Warp

    env = mtjax.make(name, vary=DOMAINS[name], split="none", engine="mjx", solver_iterations=50)
    tasks, (qpos, qvel, warmstart, ctrl, new_qpos, new_qvel) = played(env)
    simulator = env.simulator if engine == "mjx" else Warp(mjx_engine(env).base, env.num_substeps)
    assert isinstance(simulator, Mjx | Warp)
    sensors = np.zeros((len(qpos), env.models[0].nsensordata), np.float32)
    world = World(qpos, qvel, warmstart, sensors if sensors.size else None)
    new = jax.device_get(jax.jit(jax.vmap(simulator.step))(tasks, world, ctrl))
    error = np.abs(new.qvel - new_qvel).max(axis=1) / np.abs(new_qvel).max()
    assert np.median(error) < 1e-4 and np.quantile(error, 0.9) < 1e-2, np.sort(error)[-8:]
    assert np.quantile(np.abs(new.qpos - new_qpos).max(axis=1), 0.9) < 1e-3


@needs("gymnasium")
def test_worlds_outside_of_jax_take_each_step_once(count=64, steps=20):
    """As on the CPU, where a scan keeps their rewards and observations; a step that is made twice is refused."""
    env = mtjax.hosted("CartPole-v1")

    def play(tasks, keys):
        step = lambda states, _: (
            (after := env.step_worlds(tasks, states, jnp.zeros((1, 1, count), jnp.int32))).state,
            (after.reward, after.terminated, after.obs),
        )
        return jax.lax.scan(step, env.reset_worlds(tasks, keys).state, length=steps)[1]

    with on("cpu"):
        keys = jax.random.split(jax.random.key(0), (1, 1, count))
    tasks = rollout.broadcast_tasks(env.tasks(), keys.shape)
    jax.tree.map(np.testing.assert_array_equal, *both(play, tasks, keys))


@pytest.mark.parametrize("name", ["finger-spin-vary-size", "walker-walk-vary-friction"])
def test_steps_on_the_host_are_moved_while_warp_records(name):
    """Warp records CUDA graphs when a program first runs, as the evaluation does beside an exchange of many steps."""
    env, agent = mtjax.make(name, engine="warp"), mtjax.agent("sac-conditioned", hidden=(8, 8))
    steps = 64 * 250 * env.train_count * 8
    settings = {"num_envs": 64, "batch_size": 8, "warmup_steps": 5, "chunk_steps": 250}
    replay = {"replay_size": 64 * 600, "host_replay_size": 64 * 4000}
    found = mtjax.train(env, agent, steps=steps, eval_every=steps // 2, eval_episodes=1, **settings, **replay)
    assert found.finished and len(found.evaluations.steps) == 2


@pytest.mark.parametrize(
    "name", ["ball-in-cup-catch", "cheetah-run", "finger-turn-easy", "swimmer-swimmer6", "walker-walk"]
)
def test_warp_draws_what_the_caster_draws(name):
    """Every task with a colour and a camera of its own, inside a scan that also draws the starts of episodes."""
    vary = {"hue": "0,90", "camera-angle": "-20,20"}
    make = lambda painter: mtjax.make(name, pixels=SIZE, vary=vary, combine="paired", split="none", painter=painter)
    worlds = states_of(name)

    def draw(env):
        def again(states, _):
            pictures = jax.vmap(jax.vmap(env.look_at, (None, 0)), (0, None))(env.tasks(), states)["pixels"]
            started = jax.vmap(env.reset)(env.tasks(), jax.random.split(jax.random.key(0), 2)).obs["pixels"]
            return states._replace(qpos=states.qpos + 1e-3), (pictures, started)

        return jax.device_get(jax.jit(lambda: jax.lax.scan(again, worlds, length=3)[1])())

    ours, theirs = draw(make("caster")), draw(make("warp"))
    for one, other in zip(ours, theirs, strict=True):
        for place in np.ndindex(one.shape[:-3]):
            assert similarity(one[place], other[place]) > 0.9  # the cup's string is thinner than a pixel: 0.948


@pytest.mark.parametrize("name", ["corridor-maze-vary-layout", "two-goal-maze"])
def test_mazes_move_and_are_drawn_as_on_the_cpu(name):
    """Eight starts of every task, and a step from each; edges of shapes may fall on the next pixel."""
    env = mtjax.make(name, pixels=SIZE, state="also")
    keys = jax.random.split(jax.random.key(0), (env.train_count, 8))
    action = env.action.random(jax.random.key(1))

    def play(tasks, keys):
        start = jax.vmap(jax.vmap(env.reset, (None, 0)))(tasks, keys)
        after = jax.vmap(jax.vmap(env.step, (None, 0, None)), (0, 0, None))(tasks, start.state, action)
        return start.obs, after.obs

    cpu, gpu = both(play, env.tasks(), keys)
    for one, other in zip(cpu, gpu, strict=True):
        np.testing.assert_allclose(one["state"], other["state"], atol=1e-4)
        apart = np.abs(np.int32(one["pixels"]) - np.int32(other["pixels"])).max(axis=-1)
        assert np.mean(apart > 3) < 2e-3
